"""Errors on a grid as defined in the paper, section IV-B (eq:mean_pos, eq:measurement_error, eq:em_rmse, eq:em_std).

err_i = ‖P̄_i − P_i‖ with the mean P̄_i of the samples at grid point i, rmse = √(Σ err_i² / N) over the N points with
equal weights, jitter = √(Σ_i Σ_j ‖P̄_i − P̃_ij‖² / Σ_i M_i) over all samples, which is the paper's for M samples at each
point. A point with one sample adds nothing to the sum of squares; if all points have one, the jitter is unknown.
"""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.geometry.pair_checks import mirrored_frame
from flexneedle.geometry.rigid import Rigid, fiducial_error, fit_rigid
from flexneedle.lab.tracker_evaluation.evaluation.intervals import (
    CONFIDENCE,
    Interval,
    bootstrap,
    deviation,
    mean,
    quantile_interval,
)
from flexneedle.lab.tracker_evaluation.evaluation.moments import MeasuredGrid, Moments

P95 = 0.95
"""Quantiles interpolate linearly at rank (n − 1) q, counted from 0 (Hyndman and Fan 1996, type 7)."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Accuracy:
    """Errors of one sensor in one environment (mm), with the numbers of points and samples.

    n_points: grid points with samples; n_unseen: without; n_single: with one sample, which adds an error but no
    scatter. sd_mm: standard deviation of the errors (n − 1). bias_mm: mean error vector. beyond_max: upper 95 %
    confidence limit of the share of the volume with errors above `max_mm` (Wilks 1941), since a maximum has no useful
    bootstrap interval. intervals: 95 %, bootstrap, but from order statistics for p95_mm. jitter_mm: NaN and without an
    interval if no point has two samples.
    """

    n_points: int
    n_unseen: int
    n_samples: int
    n_missing: int
    n_single: int
    samples_least: int
    samples_most: int
    rmse_mm: float
    p95_mm: float
    max_mm: float
    jitter_mm: float
    mean_mm: float
    sd_mm: float
    bias_mm: tuple[float, float, float]
    max_at: str
    beyond_max: float
    intervals: dict[str, Interval]


@dataclass(frozen=True)
class RigidFit:
    """The rigid transform from tracker to stage, p → R p + t: rows of R, t (mm), RMS residual (mm)."""

    rotation: tuple[tuple[float, ...], ...]
    translation_mm: tuple[float, ...]
    angle_deg: float
    residual_mm: float
    n_points: int


def compute_error_vectors(moments: Moments) -> Floats:
    """Return mean measured minus true position (n, 3), mm; NaN without samples."""
    return moments.position - moments.true


def compute_errors(moments: Moments) -> Floats:
    """Return err_i (n,), mm."""
    lengths: Floats = np.linalg.norm(compute_error_vectors(moments), axis=1)
    return lengths


def root_mean_square(values: Floats) -> float:
    """Return √(Σ v² / n) of values (n,), NaN if there are none."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else nan


def compute_jitter(moments: Moments) -> float:
    """Return the jitter over all samples (mm), NaN if no point has two."""
    if moments.count.max(initial=0) < 2:
        return nan
    return float(np.sqrt(np.nansum(moments.scatter) / moments.count.sum()))


def compute_accuracy(grid: MeasuredGrid) -> Accuracy:
    """Return the errors of a grid. Raises InputError if no grid point has a sample."""
    measured = grid.measured
    if not len(measured):
        raise InputError(f"sensor {grid.sensor!r}, environment {grid.environment!r}: all samples are missing")
    error, count = compute_errors(measured), measured.count
    bias = compute_error_vectors(measured).mean(axis=0).tolist()
    return Accuracy(
        n_points=len(measured),
        n_unseen=len(grid.points) - len(measured),
        n_samples=int(count.sum()),
        n_missing=int(grid.points.missing.sum()),
        n_single=int((count == 1).sum()),
        samples_least=int(count.min()),
        samples_most=int(count.max()),
        rmse_mm=root_mean_square(error),
        p95_mm=float(np.quantile(error, P95)),
        max_mm=float(error.max()),
        jitter_mm=compute_jitter(measured),
        mean_mm=float(error.mean()),
        sd_mm=float(error.std(ddof=1)) if len(error) > 1 else nan,
        bias_mm=(bias[0], bias[1], bias[2]),
        max_at=grid.name_of(error.argmax()),
        beyond_max=1.0 - (1.0 - CONFIDENCE) ** (1.0 / len(error)),
        intervals=_intervals(error, measured),
    )


def _intervals(error: Floats, measured: Moments) -> dict[str, Interval]:
    scatter, count = measured.scatter.sum(axis=1), measured.count.astype(float)
    return {
        "rmse_mm": bootstrap(_rms, error),
        "jitter_mm": bootstrap(_pool_scatter, scatter, count) if count.max() > 1 else None,
        "mean_mm": bootstrap(mean, error),
        "sd_mm": bootstrap(deviation, error),
        "p95_mm": quantile_interval(error, P95),
    }


def _rms(error: Floats, axis: int) -> Floats:
    squares: Floats = (error**2).mean(axis=axis)
    return np.sqrt(squares)


def _pool_scatter(scatter: Floats, count: Floats, axis: int) -> Floats:
    squares: Floats = scatter.sum(axis=axis) / count.sum(axis=axis)
    return np.sqrt(squares)


def register_grid(grid: MeasuredGrid) -> tuple[MeasuredGrid, RigidFit]:
    """Return the grid after a rigid least-squares fit of its mean to its true positions, and the fit.

    Raises InputError for fewer than three points, collinear points, or a mirrored frame.
    """
    measured = grid.measured
    try:
        rigid = fit_rigid(measured.position, measured.true)
        if (problem := mirrored_frame(measured.position, measured.true)) is not None:
            raise InputError(problem)
    except InputError as error:
        raise InputError(
            f"--register: sensor {grid.sensor!r}, environment {grid.environment!r}: {error}"
        ) from None
    residual = fiducial_error(rigid, measured.position, measured.true)
    return grid.transform(rigid), _rigid_fit(rigid, residual, len(measured))


def _rigid_fit(rigid: Rigid, residual: float, points: int) -> RigidFit:
    from scipy.spatial.transform import Rotation

    angle = np.degrees(Rotation.from_matrix(rigid.rotation).magnitude())
    rows = tuple(tuple(row) for row in rigid.rotation.tolist())
    return RigidFit(rows, tuple(rigid.translation.tolist()), float(angle), residual, points)
