"""Crossings of the needle's curve with values of a coordinate: image planes, and points in space or in an image."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]


def cross(along: "Floats", across: "Floats", stations: "Floats") -> "Floats":
    """Return coordinates (m, s, c) of curves where they pass stations (s,).

    along (m, n): rising coordinate of the curves' points; across (m, n, c): the others. Beyond an end the curve
    continues straight.
    """
    last = along.shape[1] - 2
    left = np.clip((along[:, None, :] <= stations[:, None]).sum(axis=2) - 1, 0, last)
    which = np.arange(len(along))[:, None]
    start, end = along[which, left], along[which, left + 1]
    part = ((stations - start) / np.where(end > start, end - start, 1.0))[..., None]
    found: Floats = (1.0 - part) * across[which, left] + part * across[which, left + 1]
    return found


def passed(along: "Floats", stations: "Floats", width: int) -> "Flags":
    """Return which stations curves have passed (m, s · width): those from their base to their tip."""
    seen = (along[:, :1] <= stations) & (stations <= along[:, -1:])
    return np.repeat(seen, width, axis=1)


def to_stations(
    along: "Floats", across: "Floats", stations: "Floats", curve: tuple["Floats", "Floats"]
) -> "Floats":
    """Return the values (s · c,) of points at the nearest stations, NaN where there are none.

    Points are shifted to their station along the predicted curve, and several are averaged. along (k,), across (k, c):
    of the points; curve: the same of the predicted needle's nodes, (n,) and (n, c).
    """
    width = across.shape[1]
    sums, counts = np.zeros((len(stations), width)), np.zeros(len(stations))
    half = 0.5 * (stations[1] - stations[0]) if len(stations) > 1 else np.inf
    nearest = np.abs(along[:, None] - stations).argmin(axis=1) if len(along) else np.zeros(0, dtype=int)
    kept = np.isfinite(across).all(axis=1) & (np.abs(along - stations[nearest]) <= half * (1.0 + 1e-9))
    nodes, lateral = curve[0][None], curve[1][None]
    here, there = cross(nodes, lateral, along[kept])[0], cross(nodes, lateral, stations)[0]
    np.add.at(sums, nearest[kept], across[kept] - here + there[nearest[kept]])
    np.add.at(counts, nearest[kept], 1.0)
    found: Floats = np.where(counts[:, None] > 0.0, sums / np.maximum(counts, 1.0)[:, None], np.nan)
    return found.ravel()
