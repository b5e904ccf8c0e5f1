"""Faults of sensors: an error of one of them that grows from some depth on, which the fit does not know.

A fault is a random walk, or a line, over the depth from its onset on, of each value of a sensor or of all together. Its
odds are the logarithm of its Bayes factor, of readings with and without it, by a linear model about the fit. This is
the generalised likelihood ratio for a change of unknown time (Willsky and Jones, IEEE Trans. Autom. Control 21:108,
1976), with a prior on the size of the change.

After a leap of the needle the model is late. So the tracker's own evidence against the model is no evidence of its
fault and is subtracted, as is the evidence of a sensor beside which no other measures.

The model's error lasts from move to move, so that the readings are averaged over some moves, whose means have its whole
variance.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.estimation.fit import field_covariance, jacobian_of
from flexneedle.estimation.fitted import LASTING, TRACKER, FittedInsertion
from flexneedle.types import Flags, Floats, X

_ONSETS_MM = (5.0, 10.0, 20.0, np.inf)  # above the tip
_BESIDE_MM = 10.0  # above the tip, where another sensor measured
_GROWTH_MM = 40.0  # depth over which a fault grows
_SIZE = 1.5  # to this many standard deviations of a sensor's noise or offset


class Fault(NamedTuple):
    """A fault: ln of its Bayes factor, and the depth (mm) of the tip at its onset."""

    log_odds: float
    since: float


class _Rows(NamedTuple):
    """Mean residuals of a sensor: n values."""

    depth: Floats  # of the tip (n,), mm
    left: Floats  # (n,)
    jacobian: Floats  # (n, K)
    variance: Floats  # of noise and model error (n,)
    value: NDArray[np.intp]  # number (n,) of the value in a reading
    across: int  # number of values of a lateral pair or of a single value
    shares: Floats  # weights (n, b) of the moves in the means


def find_faults(fitted: FittedInsertion) -> dict[str, Fault]:
    """Return for the `TRACKER` and each sensor along the needle, by name, the likeliest fault."""
    rows = {name: one for name, one in _all_rows(fitted) if one.left.size}
    if not rows:
        return {}
    left, jacobian, variance = (
        np.concatenate([getattr(one, key) for one in rows.values()])
        for key in ("left", "jacobian", "variance")
    )
    left = left + jacobian @ (fitted.parameters - fitted.prior.mean)
    covariance = jacobian @ fitted.prior.covariance @ jacobian.T + np.diag(variance)
    if fitted.has_field and TRACKER in rows:
        tip = rows[TRACKER]
        own = slice(tip.left.size)  # the first rows
        covariance[own, own] += _is_same(tip.value) * (tip.shares @ field_covariance(fitted) @ tip.shares.T)
    precision = np.linalg.inv(covariance)
    weighted, begin, found = precision @ left, 0, {}
    depth = float(fitted.tips[-1, X])
    for name, one in rows.items():
        own, size = slice(begin, begin + one.left.size), _size(fitted, name)
        found[name] = _find_fault(one, weighted[own], precision[own, own], size, depth)
        others = [other.depth.max() for key, other in rows.items() if key != name]
        if name == TRACKER or max(others, default=-np.inf) < depth - _BESIDE_MM:
            alone = np.linalg.inv(covariance[own, own])
            against_model = _find_fault(one, alone @ left[own], alone, size, depth).log_odds
            found[name] = found[name]._replace(log_odds=found[name].log_odds - max(0.0, against_model))
        begin = own.stop
    return found


def _find_fault(rows: _Rows, weighted: Floats, precision: Floats, size: float, depth: float) -> Fault:
    """Return the likeliest fault of a sensor; size: to which it grows.

    weighted, precision: the sensor's parts of C⁻¹ r (n,) and C⁻¹ (n, n), of all residuals r with the covariance C.
    """
    found, common = [Fault(-np.inf, depth)], rows.value % rows.across
    for back in _ONSETS_MM:
        since = max(0.0, depth - back)
        late = np.flatnonzero(rows.depth > since)
        if late.size:
            way = (rows.depth[late] - since) / _GROWTH_MM
            inner = precision[np.ix_(late, late)]
            steps = np.unique(way)
            walk = np.sqrt(np.diff(steps, prepend=0.0)) * (way[:, None] >= steps)
            for growth, values in itertools.product((walk, way[:, None]), (rows.value, common)):
                odds = _compute_log_odds(size * _spread(growth, values[late]), weighted[late], inner)
                found.append(Fault(odds, since))
        if since == 0.0:
            break
    return max(found)


def _spread(growth: Floats, values: NDArray[np.intp]) -> Floats:
    """Return the square root (n, g · v) of the covariance of errors, from one value's (n, g); values: (n,)."""
    own = values[:, None] == np.unique(values)
    spread: Floats = (growth[:, :, None] * own[:, None]).reshape(len(growth), -1)
    return spread


def _compute_log_odds(root: Floats, weighted: Floats, precision: Floats) -> float:
    """Return ln of the ratio of the densities of residuals with an error of covariance root rootᵀ, and without."""
    lower = np.linalg.cholesky(np.eye(root.shape[1]) + root.T @ precision @ root)
    known = np.linalg.solve(lower, root.T @ weighted)
    return float(0.5 * known @ known - np.log(np.diag(lower)).sum())


def _size(fitted: FittedInsertion, name: str) -> float:
    """Return the standard deviation to which the error of a faulty sensor grows."""
    if name == TRACKER:
        return fitted.nominal.scenario.control.miss_limit_mm
    sensor = next(one.sensor for one in fitted.along if one.name == name)
    return _SIZE * max(sensor.noise, sensor.offset_sd)


def _is_same(value: NDArray[np.intp]) -> Flags:
    same: Flags = value[:, None] == value
    return same


def _all_rows(fitted: FittedInsertion) -> Iterator[tuple[str, _Rows]]:
    """Yield the rows of each sensor by name, the tracker first."""
    position, left = fitted.readings[0], fitted.residuals[0]
    jacobian = jacobian_of(fitted)[: len(left)]
    across = [np.real, np.imag][: fitted.axes]
    model = fitted.sensors[0].unexplained(fitted.nominal.scenario, fitted.settings) ** 2
    noise = fitted.variances()[0] + position.estimate_sag(fitted.laterals[0]) ** 2 - model
    shape = (len(left), fitted.axes)
    yield (
        TRACKER,
        _average(
            position.index,
            position.between(fitted.tips[:, X]),
            np.stack([part(left) for part in across], axis=1),
            np.stack([part(jacobian) for part in across], axis=1),
            np.broadcast_to(noise[:, None], shape),
            np.full(shape, model),
            fitted.axes,
        ),
    )
    for k, one in enumerate(fitted.along):
        bins = fitted.bins[k]
        depth = fitted.depths(bins)
        slopes = fitted.along_slopes(depth, k)
        ends, line = fitted.quantities[k], fitted.timeline
        jacobian = one.jacobian(bins, ends, depth, slopes, fitted.parameters, line)
        noise = one.sensor.noise**2 / np.where(bins.count > 0.0, bins.count, np.nan)
        yield (
            one.name,
            _average(
                bins.index,
                depth,
                one.in_its_axes(fitted.along_residuals[k], bins),
                one.in_its_axes(jacobian.transpose(2, 0, 1), bins).transpose(1, 2, 0),
                noise,
                one.sensor.model_error(bins.value) ** 2 + one.sensor.wander_sd**2,
                fitted.axes if one.sensor.paired else 1,
            ),
        )


def _average(
    index: NDArray[np.intp],
    depth: Floats,
    left: Floats,
    jacobian: Floats,
    noise: Floats,
    model: Floats,
    across: int,
) -> _Rows:
    """Return the means over some moves each of residuals (b, d) in moves (b,).

    depth: (b,), mm; jacobian: (b, d, K); noise, model: variances (b, d) of the residuals and of the model's error, NaN
    where nothing was measured.
    """
    groups = index // LASTING
    shares = (groups == np.unique(groups)[:, None])[:, None, :] & np.isfinite(noise).T  # (g, d, b)
    counts = shares.sum(axis=2)
    seen = counts > 0
    weights = shares / np.maximum(counts, 1)[:, :, None]
    level = np.nan_to_num(noise)
    return _Rows(
        np.broadcast_to((weights @ depth), counts.shape)[seen],
        np.einsum("gdb,bd->gd", weights, left)[seen],
        np.einsum("gdb,bdk->gdk", weights, jacobian)[seen],
        (np.einsum("gdb,bd->gd", weights**2, level) + np.einsum("gdb,bd->gd", weights, model))[seen],
        np.broadcast_to(np.arange(counts.shape[1]), counts.shape)[seen],
        across,
        weights[seen],
    )
