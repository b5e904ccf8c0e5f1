"""`flexneedle em register`: the rigid transform from the tracker's frame to the stage's, from pairs of points."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.figures.style import save
from flexneedle.geometry.pair_checks import check_pairs, find_better_fit, unknown_side
from flexneedle.geometry.quaternion import from_matrix
from flexneedle.geometry.rigid import (
    Rigid,
    fiducial_error,
    fit_rigid,
    localisation_error,
    target_error,
)
from flexneedle.lab.tables.columns import REQUIRED, map_columns
from flexneedle.lab.tables.row_rules import (
    CODE,
    CODED,
    POSITIONS,
    SAME_POSITION_MM,
    TRUE_POSITIONS,
    note_codes,
)
from flexneedle.lab.tables.sample_table import SampleTable, open_table
from flexneedle.lab.tracker_evaluation.figures.registration import draw_registration
from flexneedle.scenario.sections.registration import Registration

Floats = NDArray[np.float64]
Point = tuple[float, float, float]

_NUMBERS = REQUIRED[1:7]
_LABELS = ("point_id", "sensor", "environment")
_HEAD = """\
# Registration of the tracker's frame to the stage's, by flexneedle em register. Paste the first table into a scenario,
# or pass this file to flexneedle insert --registration.
"""


@dataclass(frozen=True, eq=False)
class PointPairs:
    """n fiducials: names, and positions (n, 3) in the frames of stage and tracker (mm).

    samples (n,): number of averaged readings; missing: number of readings without a position, which are ignored; coded:
    with a position that may be a code for missing, codes: its coordinates.
    """

    names: tuple[str, ...]
    stage: Floats
    tracker: Floats
    samples: NDArray[np.int64]
    missing: int
    coded: int = 0
    codes: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """A registration and its errors (mm).

    residuals (n,): of each fiducial; leave_one_out (n,): of each fiducial with a registration from all others; fre: RMS
    residual; fle: estimated RMS localisation error of a fiducial; tre (k,): expected RMS error at the targets (k, 3);
    notes: one line on each doubt.
    """

    pairs: PointPairs
    rigid: Rigid
    residuals: Floats
    leave_one_out: Floats
    fre: float
    fle: float
    targets: Floats
    tre: Floats
    notes: tuple[str, ...] = ()

    @property
    def registration(self) -> Registration:
        """The registration as scenario settings."""
        return Registration(
            rotation=tuple(from_matrix(self.rigid.rotation).tolist()),
            translation_mm=tuple(self.rigid.translation.tolist()),
            localisation_mm=self.fle,
            fiducials_mm=tuple(map(tuple, self.pairs.stage.tolist())),
        )

    def values(self) -> dict[str, Any]:
        """Return the result as plain values; `left_out_rms_mm` is None where the other points lie on a line."""
        names, errors = self.pairs.names, self.leave_one_out
        left_out = None if np.isnan(errors).any() else float(np.sqrt(np.mean(errors**2)))
        return {
            "points": len(names),
            "samples": int(self.pairs.samples.sum()),
            "missing": self.pairs.missing,
            "rotation": from_matrix(self.rigid.rotation).tolist(),
            "translation_mm": self.rigid.translation.tolist(),
            "fre_mm": self.fre,
            "fle_mm": self.fle,
            "max_residual_mm": float(self.residuals.max()),
            "worst_point": names[int(self.residuals.argmax())],
            "left_out_rms_mm": left_out,
            "notes": list(self.notes),
            "tre": [
                {"target_mm": target, "tre_mm": error}
                for target, error in zip(self.targets.tolist(), self.tre.tolist(), strict=True)
            ],
        }


def read_pairs(
    data: Path,
    columns: Sequence[str] = (),
    sensor: str | None = None,
    environment: str | None = None,
    unit: str = "mm",
) -> PointPairs:
    """Return the fiducials of a table: the mean of the rows of each `point_id`, or each row without such a column.

    columns: as for `em evaluate`; sensor, environment: required if the table has several; unit: "mm" or "m", of all
    coordinates. Raises InputError.
    """
    with open_table(data, _NUMBERS, _LABELS, mapping=map_columns(columns), unit=unit) as table:
        return _pairs(table, {"sensor": sensor, "environment": environment})


def register(pairs: PointPairs, targets: Sequence[Point] = ()) -> RegistrationResult:
    """Return the registration of the pairs and its expected error at targets (default: centroid of the fiducials).

    Raises InputError for pairs that no rigid transform can map.
    """
    rigid = fit_rigid(pairs.tracker, pairs.stage)
    codes = note_codes(pairs.coded, int(pairs.samples.sum()), pairs.codes)
    try:
        check_pairs(pairs.tracker, pairs.stage, pairs.names)
    except InputError as error:
        raise InputError("; ".join(filter(None, (codes, str(error))))) from None
    residuals = np.linalg.norm(rigid.apply(pairs.tracker) - pairs.stage, axis=1)
    fre = fiducial_error(rigid, pairs.tracker, pairs.stage)
    fle = localisation_error(fre, len(pairs.names))
    points = np.array(targets, dtype=float) if targets else pairs.stage.mean(axis=0, keepdims=True)
    tre = target_error(pairs.stage, fle, points)
    notes = tuple(note for note in (codes, *_find_notes(pairs, points)) if note is not None)
    return RegistrationResult(pairs, rigid, residuals, _leave_one_out(pairs), fre, fle, points, tre, notes)


def _find_notes(pairs: PointPairs, targets: Floats) -> Iterator[str | None]:
    yield unknown_side(pairs.tracker, pairs.stage, targets)
    yield find_better_fit(pairs.tracker, pairs.stage, pairs.names)


def write_registration(registered: RegistrationResult, path: Path) -> None:
    """Write a TOML file with a table for a scenario and the errors, and its figure as `.png` and `.svg`.

    Raises InputError if the file exists.
    """
    if path.exists():
        raise InputError(f"{path}: already exists: choose another file with --out")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    _draw(registered, path)
    values = {
        "tracker": {"registration": registered.registration.model_dump(mode="json")},
        "result": {name: value for name, value in registered.values().items() if value is not None},
    }
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(_HEAD + tomli_w.dumps(values))
    except FileExistsError:
        raise InputError(f"{path}: already exists: choose another file with --out") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def _draw(registered: RegistrationResult, path: Path) -> None:
    stage, fle = registered.pairs.stage, registered.fle
    figure = draw_registration(
        stage,
        registered.rigid.apply(registered.pairs.tracker),
        registered.targets,
        lambda points: target_error(stage, fle, points),
    )
    save(figure, path.parent, path.stem)


_POINTS = """
    WITH named AS (SELECT row_number() OVER () AS row, * FROM samples)
    SELECT CASE WHEN point_id = '' THEN 'row ' || row ELSE point_id END AS name, count(x_mm) AS n,
        count(*) - count(x_mm) AS missing, count(*) FILTER ({coded}) AS coded, {code} AS code,
        favg(x_mm) AS x, favg(y_mm) AS y, favg(z_mm) AS z,
        first(true_x_mm ORDER BY row) FILTER (x_mm IS NOT NULL) AS true_x,
        first(true_y_mm ORDER BY row) FILTER (x_mm IS NOT NULL) AS true_y,
        first(true_z_mm ORDER BY row) FILTER (x_mm IS NOT NULL) AS true_z,
        greatest(max(true_x_mm) FILTER (x_mm IS NOT NULL) - min(true_x_mm) FILTER (x_mm IS NOT NULL),
                 max(true_y_mm) FILTER (x_mm IS NOT NULL) - min(true_y_mm) FILTER (x_mm IS NOT NULL),
                 max(true_z_mm) FILTER (x_mm IS NOT NULL) - min(true_z_mm) FILTER (x_mm IS NOT NULL)) AS moved
    FROM named WHERE {chosen} GROUP BY name ORDER BY min(row) FILTER (x_mm IS NOT NULL)
"""


def _pairs(table: SampleTable, labels: Mapping[str, str | None]) -> PointPairs:
    given = {name: value for name, value in labels.items() if value is not None}
    for name, value in labels.items():
        _check_label(table, name, value)
    chosen = " AND ".join(["true", *(f"{name} = ${name}" for name in given)])
    table.refuse(POSITIONS, chosen, **given)
    table.refuse(TRUE_POSITIONS, f"{chosen} AND x_mm IS NOT NULL", **given)
    found = table.arrays(_POINTS.format(chosen=chosen, coded=CODED, code=CODE), **given)
    known = found["n"] > 0
    if not known.any():
        raise InputError("no reading has a position")
    points = {name: column[known] for name, column in found.items()}
    if (moved := points["moved"] > SAME_POSITION_MM).any():
        name = points["name"][int(moved.argmax())]
        raise InputError(
            f"point {name} has several positions in the stage's frame: each position needs its own point_id"
        )
    stage, tracker = (
        np.column_stack([points[f"{kind}{axis}"] for axis in "xyz"]).astype(float) for kind in ("true_", "")
    )
    return PointPairs(
        tuple(points["name"].tolist()),
        stage,
        tracker,
        points["n"],
        int(found["missing"].sum()),
        int(found["coded"].sum()),
        tuple(found["code"][found["coded"] > 0].tolist()),
    )


def _check_label(table: SampleTable, name: str, label: str | None) -> None:
    query = f"SELECT DISTINCT {name} AS label FROM samples WHERE {name} <> '' ORDER BY label"
    present = table.arrays(query)["label"].tolist() if name in table.fields else []
    if label is None and len(present) > 1:
        raise InputError(f"has several values of {name}: choose one with --{name}: {', '.join(present)}")
    if label is not None and label not in present:
        choices = f"choose from {', '.join(present)}" if present else f"the table has no column {name}"
        raise InputError(f"--{name} {label}: {choices}")


def _leave_one_out(pairs: PointPairs) -> Floats:
    """Return the residual of each fiducial (mm) with a registration from the others, NaN if there is none."""
    errors = np.full(len(pairs.names), np.nan)
    for k in range(len(errors)):
        others = np.arange(len(errors)) != k
        try:
            rigid = fit_rigid(pairs.tracker[others], pairs.stage[others])
        except InputError:
            continue
        errors[k] = np.linalg.norm(rigid.apply(pairs.tracker[k]) - pairs.stage[k])
    return errors
