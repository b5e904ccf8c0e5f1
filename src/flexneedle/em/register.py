"""`flexneedle em register`: pairs of points in, the tracker's place in the stage's frame out."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from flexneedle.em.evaluation.cells import MILLIMETRES_IN, SAME_MM
from flexneedle.em.evaluation.checks import check_true, seen_rows
from flexneedle.em.evaluation.columns import column_map
from flexneedle.em.evaluation.moments import Moments
from flexneedle.em.evaluation.reading import LABELS, read_batches
from flexneedle.em.plot.registration import registration_figure
from flexneedle.errors import InputError
from flexneedle.plot.style import save
from flexneedle.rig.tracking.quaternion import from_matrix
from flexneedle.rig.tracking.registration import (
    Rigid,
    fiducial_error,
    fit_rigid,
    localisation_error,
    refuse_nonsense,
    target_error,
)
from flexneedle.rig.tracking.table import REQUIRED
from flexneedle.scenario.sections.registration import Registration

Floats = NDArray[np.float64]
Point = tuple[float, float, float]

_NUMBERS = REQUIRED[1:7]
_HEAD = """\
# The tracker's frame in the stage's, by flexneedle em register. Paste the first table into a scenario, or give this
# file to flexneedle insert --registration.
"""


@dataclass(frozen=True, eq=False)
class Pairs:
    """n fiducials: names; where they are, stage (n, 3), and where the tracker sees them, tracker (n, 3), mm.

    samples (n,): of how many readings a place is the mean; missing: readings without a place, left out.
    """

    names: tuple[str, ...]
    stage: Floats
    tracker: Floats
    samples: NDArray[np.int64]
    missing: int


@dataclass(frozen=True, eq=False)
class Registered:
    """A registration and its errors (mm).

    residuals (n,): of each fiducial; left_out (n,): of each by a registration from all others; fiducial: RMS
    residual (FRE); localisation: RMS error of a fiducial that it speaks for (FLE); targets (k, 3) with the
    expected RMS error there (TRE), target (k,).
    """

    pairs: Pairs
    rigid: Rigid
    residuals: Floats
    left_out: Floats
    fiducial: float
    localisation: float
    targets: Floats
    target: Floats

    @property
    def registration(self) -> Registration:
        """What a scenario takes."""
        return Registration(
            rotation=tuple(from_matrix(self.rigid.rotation).tolist()),
            translation_mm=tuple(self.rigid.translation.tolist()),
            localisation_mm=self.localisation,
            fiducials_mm=tuple(map(tuple, self.pairs.stage.tolist())),
        )

    def values(self) -> dict[str, Any]:
        """Return the result as plain values."""
        names = self.pairs.names
        return {
            "points": len(names),
            "samples": int(self.pairs.samples.sum()),
            "missing": self.pairs.missing,
            "rotation": from_matrix(self.rigid.rotation).tolist(),
            "translation_mm": self.rigid.translation.tolist(),
            "fre_mm": self.fiducial,
            "fle_mm": self.localisation,
            "max_residual_mm": float(self.residuals.max()),
            "worst_point": names[int(self.residuals.argmax())],
            "left_out_rms_mm": float(np.sqrt(np.mean(self.left_out**2))),
            "tre": [
                {"target_mm": place, "tre_mm": error}
                for place, error in zip(self.targets.tolist(), self.target.tolist(), strict=True)
            ],
        }


def read_pairs(
    data: Path,
    columns: Sequence[str] = (),
    sensor: str | None = None,
    environment: str | None = None,
    unit: str = "mm",
) -> Pairs:
    """Return the fiducials of a table: each row one, or rows of one `point_id` taken together.

    columns: as for `em evaluate`; sensor, environment: which, where the table has several; unit: "mm" or "m", of all
    coordinates. Raises InputError.
    """
    theirs = column_map(columns)
    chosen = {"sensor": sensor, "environment": environment}
    try:
        with closing(read_batches(data, theirs, _NUMBERS, LABELS)) as batches:
            rows = [_rows(batch) for batch in batches]
        if not rows:
            raise InputError("has no rows")
        labels = {name: np.concatenate([part[0][name] for part in rows]) for name in LABELS}
        numbers = np.concatenate([part[1] for part in rows]) * MILLIMETRES_IN[unit]
        return _pairs(labels, numbers, _kept(labels, chosen))
    except InputError as error:
        raise InputError(f"{data}: {error}") from None


def register(pairs: Pairs, targets: Sequence[Point] = ()) -> Registered:
    """Return the registration of the pairs; without targets its error is told at the middle of the fiducials.

    Raises InputError for pairs that no rigid body can have.
    """
    rigid = fit_rigid(pairs.tracker, pairs.stage)
    refuse_nonsense(pairs.tracker, pairs.stage)
    residuals = np.linalg.norm(rigid.apply(pairs.tracker) - pairs.stage, axis=1)
    fiducial = fiducial_error(rigid, pairs.tracker, pairs.stage)
    localisation = localisation_error(fiducial, len(pairs.names))
    places = np.array(targets, dtype=float) if targets else pairs.stage.mean(axis=0, keepdims=True)
    expected = target_error(pairs.stage, localisation, places)
    return Registered(pairs, rigid, residuals, _left_out(pairs), fiducial, localisation, places, expected)


def write_registration(registered: Registered, path: Path) -> None:
    """Write a TOML file, a table for a scenario and the errors, and its picture beside it, `.png` and `.svg`.

    Raises InputError if the file is there already.
    """
    if path.exists():
        raise InputError(f"{path}: is there already: name another with --out")
    if not path.parent.is_dir():
        raise InputError(f"{path}: no such folder: {path.parent}")
    _draw(registered, path)
    values = {
        "tracker": {"registration": registered.registration.model_dump(mode="json")},
        "result": registered.values(),
    }
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(_HEAD + tomli_w.dumps(values))
    except FileExistsError:
        raise InputError(f"{path}: is there already: name another with --out") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def _draw(registered: Registered, path: Path) -> None:
    stage, error = registered.pairs.stage, registered.localisation
    figure = registration_figure(
        stage,
        registered.rigid.apply(registered.pairs.tracker),
        registered.targets,
        lambda points: target_error(stage, error, points),
    )
    save(figure, path.parent, path.stem)


def _rows(batch: Any) -> tuple[dict[str, NDArray[Any]], Floats]:
    texts = {
        name: np.array(batch.labels[name].to_pylist() if name in batch.labels else [None] * batch.rows)
        for name in LABELS
    }
    return texts, np.column_stack([batch.numbers[name] for name in _NUMBERS])


def _kept(labels: Mapping[str, NDArray[Any]], chosen: Mapping[str, str | None]) -> NDArray[np.bool_]:
    kept = np.ones(len(labels["sensor"]), dtype=bool)
    for name, wanted in chosen.items():
        there = sorted({str(value) for value in labels[name] if value is not None})
        if wanted is None and len(there) > 1:
            raise InputError(f"holds several: choose one with --{name}: {', '.join(there)}")
        if wanted is not None:
            if wanted not in there:
                raise InputError(f"--{name} {wanted}: there is {', '.join(there) or 'no such column'}")
            kept &= labels[name] == wanted
    return kept


def _pairs(labels: Mapping[str, NDArray[Any]], numbers: Floats, kept: NDArray[np.bool_]) -> Pairs:
    stage, tracker = numbers[:, :3].T, numbers[:, 3:].T
    # Rows that were not chosen pass for unseen ones: whatever they hold is of no concern.
    own = seen_rows(list(np.where(kept, tracker, np.nan)), 1)
    seen = kept if own is None else own
    if not seen.any():
        raise InputError("no reading has a place")
    check_true(list(np.where(seen, stage, 0.0)), 1)
    ids = [str(name) if name is not None else f"row {k + 1}" for k, name in enumerate(labels["point_id"])]
    names = [name for name, there in zip(ids, seen.tolist(), strict=True) if there]
    order = {name: k for k, name in enumerate(dict.fromkeys(names))}
    point = np.array([order[name] for name in names], dtype=np.int64)
    places, readings = Moments(3), Moments(3)
    places.add(point, stage[:, seen], len(order))
    readings.add(point, tracker[:, seen], len(order))
    apart = np.abs(stage[:, seen].T - places.pivot[point]).max(axis=1) > SAME_MM
    if apart.any():
        raise InputError(
            f"point {names[int(apart.argmax())]} has several places on the stage: one point, one place"
        )
    return Pairs(tuple(order), places.pivot, readings.mean, readings.count, int((kept & ~seen).sum()))


def _left_out(pairs: Pairs) -> Floats:
    """Distance of each fiducial by a registration from all others; NaN where those are too few or on a line."""
    errors = np.full(len(pairs.names), np.nan)
    for k in range(len(errors)):
        others = np.arange(len(errors)) != k
        try:
            rigid = fit_rigid(pairs.tracker[others], pairs.stage[others])
        except InputError:
            continue
        errors[k] = np.linalg.norm(rigid.apply(pairs.tracker[k]) - pairs.stage[k])
    return errors
