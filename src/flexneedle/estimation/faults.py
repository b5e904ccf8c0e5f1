"""Faults of sensors: an error of one of them that grows from some depth on, which the fit does not know.

A fault is a random walk, or a line, over the depth from its onset on, of each value of a sensor or of all together. Its
odds are the logarithm of its Bayes factor, of readings with and without it, by a linear model about the fit. This is
the generalised likelihood ratio for a change of unknown time (Willsky and Jones, IEEE Trans. Autom. Control 21:108,
1976), with a prior on the size of the change.

After a leap of the needle the model is late. So the evidence of the tracker alone against the model is no evidence of a
fault, and is subtracted; and readings of a sensor since which no other has measured do not count.

The model's error lasts over some moves, and is correlated as e^(−moves/length). Readings are averaged over this
number of moves, the last ones over fewer.
"""

import itertools
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.estimation.fit import field_covariance, jacobian_of
from flexneedle.estimation.fitted import LASTING, TRACKER, FittedInsertion
from flexneedle.types import Flags, Floats, X

_ONSETS_MM = (5.0, 10.0, 20.0, np.inf)  # above the tip
_FEW = 2  # moves over which the last readings are averaged
_DOUBT = 2.0  # factor on the model's error for faults of single values, which are as varied as this error is
_ROUNDING = 1e-9  # of mean numbers of moves
_GROWTH_MM = 40.0  # depth over which a fault grows
_SIZE = 1.5  # to this many standard deviations of a sensor's noise or offset


class Fault(NamedTuple):
    """A fault: ln of its Bayes factor, the depth (mm) of the tip at its onset, and the expected error now."""

    log_odds: float
    since: float
    error: float = 0.0


class _Rows(NamedTuple):
    """Mean residuals of a sensor: n values."""

    depth: Floats  # of the tip (n,), mm
    left: Floats  # (n,)
    jacobian: Floats  # (n, K)
    variance: Floats  # of the noise (n,)
    model: Floats  # standard deviation of the model's error (n,)
    move: Floats  # mean number of the move (n,)
    value: NDArray[np.intp]  # number (n,) of the value in a reading
    across: int  # number of values of a lateral pair or of a single value
    shares: Floats  # weights (n, b) of the moves in the means

    def take(self, kept: Flags) -> "_Rows":
        """Return the rows `kept` (n,)."""
        return _Rows._make(part[kept] if isinstance(part, np.ndarray) else part for part in self)

    @property
    def is_common(self) -> bool:
        """True if its values are one lateral pair, or one value."""
        return bool((self.value < self.across).all())


def find_faults(fitted: FittedInsertion) -> dict[str, Fault]:
    """Return for the `TRACKER` and each sensor along the needle, by name, the likeliest fault."""
    rows = _beside_others({name: one for name, one in _all_rows(fitted) if one.left.size})
    if not rows:
        return {}
    left, jacobian, variance = (
        np.concatenate([getattr(one, key) for one in rows.values()])
        for key in ("left", "jacobian", "variance")
    )
    left = left + jacobian @ (fitted.parameters - fitted.prior.mean)
    covariance = jacobian @ fitted.prior.covariance @ jacobian.T + np.diag(variance)
    ends = np.cumsum([0, *(one.left.size for one in rows.values())])
    places = {name: slice(*each) for name, each in zip(rows, itertools.pairwise(ends), strict=True)}
    error = np.zeros_like(covariance)
    for name, one in rows.items():
        lasting = np.exp(-np.abs(one.move[:, None] - one.move) / LASTING) * _is_same(one.value)
        error[places[name], places[name]] = np.multiply.outer(one.model, one.model) * lasting
    if fitted.has_field and TRACKER in rows:
        tip = rows[TRACKER]
        own = places[TRACKER]
        covariance[own, own] += _is_same(tip.value) * (tip.shares @ field_covariance(fitted) @ tip.shares.T)
    leap = 0.0
    if TRACKER in rows:
        own = places[TRACKER]
        leap = _find_leap(fitted, rows[TRACKER], left[own], (covariance + error)[own, own])
    common = _compute_all(fitted, rows, places, left, covariance + error, leap, single=False)
    if all(one.is_common for one in rows.values()):
        return common
    doubted = covariance + _DOUBT**2 * error
    single = _compute_all(fitted, rows, places, left, doubted, leap, single=True)
    return common | {name: max(common[name], one) for name, one in single.items()}


def _beside_others(rows: Mapping[str, _Rows]) -> dict[str, _Rows]:
    """Return the rows of each sensor as far as another has measured since: alone, a fault and a leap are alike."""
    newest = {name: one.move.max() for name, one in rows.items()}
    known = {}
    for name, one in rows.items():
        others = max((move for key, move in newest.items() if key != name), default=-np.inf)
        kept = one.move < others + 0.5 * _FEW + _ROUNDING
        if kept.any():
            known[name] = one.take(kept)
    return known


def _compute_all(
    fitted: FittedInsertion,
    rows: Mapping[str, _Rows],
    places: Mapping[str, slice],
    left: Floats,
    covariance: Floats,
    leap: float,
    *,
    single: bool,
) -> dict[str, Fault]:
    """Return the likeliest faults, of single values or of all together; of residuals (n,) with this covariance.

    leap: log odds of a fault by the tracker's readings alone.
    """
    precision = np.linalg.inv(covariance).astype(np.float64)
    weighted, depth = precision @ left, float(fitted.tips[-1, X])
    found = {}
    for name, one in rows.items():
        if single and one.is_common:
            continue
        own, size = places[name], _size(fitted, name)
        value = one.value if single else one.value % one.across
        likeliest = _find_fault(one.depth, value, weighted[own], precision[own, own], size, depth)
        found[name] = likeliest._replace(log_odds=likeliest.log_odds - leap)
    return found


def _find_leap(fitted: FittedInsertion, tip: _Rows, left: Floats, covariance: Floats) -> float:
    """Return the log odds of a fault of the tracker by its own residuals (n,), at least 0."""
    precision = np.linalg.inv(covariance).astype(np.float64)
    size, depth = _size(fitted, TRACKER), float(fitted.tips[-1, X])
    found = _find_fault(tip.depth, tip.value, precision @ left, precision, size, depth)
    return max(0.0, found.log_odds)


def _find_fault(
    places: Floats,
    value: NDArray[np.intp],
    weighted: Floats,
    precision: Floats,
    size: float,
    depth: float,
) -> Fault:
    """Return the likeliest fault of a sensor with residuals (n,); size: to which it grows.

    places: depths (n,), mm, of the tip, which now is at `depth`; value (n,): residuals with the same number err alike;
    weighted, precision: the sensor's parts of C⁻¹ r (n,) and C⁻¹ (n, n), of all residuals r with the covariance C.
    """
    found = [Fault(-np.inf, depth)]
    for back in _ONSETS_MM if depth > _ONSETS_MM[0] else ():  # the fit is late where the needle enters
        since = max(0.0, depth - back)
        late = np.flatnonzero(places > since)
        if late.size:
            way = (places[late] - since) / _GROWTH_MM
            inner = precision[np.ix_(late, late)]
            steps = np.unique(way)
            walk = np.sqrt(np.diff(steps, prepend=0.0)) * (way[:, None] >= steps)
            newest = places[late] == places[late].max()
            for growth in (walk, way[:, None]):
                odds, error = _compare(size * _spread(growth, value[late]), weighted[late], inner)
                found.append(Fault(odds, since, float(np.linalg.norm(error[newest]))))
        if since == 0.0:
            break
    return max(found)


def _spread(growth: Floats, values: NDArray[np.intp]) -> Floats:
    """Return the square root (n, g · v) of the covariance of errors, from one value's (n, g); values: (n,)."""
    own = values[:, None] == np.unique(values)
    spread: Floats = (growth[:, :, None] * own[:, None]).reshape(len(growth), -1)
    return spread


def _compare(root: Floats, weighted: Floats, precision: Floats) -> tuple[float, Floats]:
    """Return ln of the ratio of the densities of residuals with an error of covariance root rootᵀ, and without.

    The second value is the error (n,) that is expected with it.
    """
    lower = np.linalg.cholesky(np.eye(root.shape[1]) + root.T @ precision @ root)
    known = np.linalg.solve(lower, root.T @ weighted)
    odds = float(0.5 * known @ known - np.log(np.diag(lower)).sum())
    return odds, root @ np.linalg.solve(lower.T, known)


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
            len(fitted.moves) - 1,
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
        jacobian = fitted.along_jacobians[k]
        noise = one.sensor.noise**2 / np.where(bins.count > 0.0, bins.count, np.nan)
        yield (
            one.name,
            _average(
                bins.index,
                len(fitted.moves) - 1,
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
    newest: int,
    depth: Floats,
    left: Floats,
    jacobian: Floats,
    noise: Floats,
    model: Floats,
    across: int,
) -> _Rows:
    """Return the means over some moves each of residuals (b, d) in moves (b,), of which `newest` is the last.

    depth: (b,), mm; jacobian: (b, d, K); noise, model: variances (b, d) of the residuals and of the model's error, NaN
    where nothing was measured.
    """
    age = newest - index
    groups = np.where(age < LASTING, age // _FEW, LASTING + age // LASTING)
    shares = (groups == np.unique(groups)[:, None])[:, None, :] & np.isfinite(noise).T  # (g, d, b)
    counts = shares.sum(axis=2)
    seen = counts > 0
    weights = shares / np.maximum(counts, 1)[:, :, None]
    return _Rows(
        (weights @ depth)[seen],
        np.einsum("gdb,bd->gd", weights, left)[seen],
        np.einsum("gdb,bdk->gdk", weights, jacobian)[seen],
        np.einsum("gdb,bd->gd", weights**2, np.nan_to_num(noise))[seen],
        np.sqrt(np.einsum("gdb,bd->gd", weights, model))[seen],
        (weights @ index)[seen],
        np.broadcast_to(np.arange(counts.shape[1]), counts.shape)[seen],
        across,
        weights[seen],
    )
