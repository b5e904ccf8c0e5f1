"""`flexneedle em register`: the rigid map from the tracker's frame to the stage's, from pairs of points."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from flexneedle.em.figures.registration import registration_figure
from flexneedle.em.table.columns import column_map
from flexneedle.em.table.rules import POSITIONS, SAME_MM, TRUE_POSITIONS, refuse_broken
from flexneedle.em.table.source import LABELS, Table, open_table
from flexneedle.errors import InputError
from flexneedle.figures.style import save
from flexneedle.rig.tracking.quaternion import from_matrix
from flexneedle.rig.tracking.registration import (
    Rigid,
    check_pairs,
    fiducial_error,
    fit_rigid,
    localisation_error,
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
    """n fiducials: names; their positions in the frames of the stage, (n, 3), and of the tracker, (n, 3), mm.

    samples (n,): of how many readings a position is the mean; missing: readings without a position, left out.
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
    residual (FRE); localisation: RMS error of a fiducial estimated from it (FLE); targets (k, 3) with the
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
    with open_table(data, column_map(columns), _NUMBERS, LABELS, unit=unit) as table:
        return _pairs(table, {"sensor": sensor, "environment": environment})


def register(pairs: Pairs, targets: Sequence[Point] = ()) -> Registered:
    """Return the registration of the pairs; without targets with its expected error at the middle of the fiducials.

    Raises InputError for pairs that no rigid body can have.
    """
    rigid = fit_rigid(pairs.tracker, pairs.stage)
    check_pairs(pairs.tracker, pairs.stage)
    residuals = np.linalg.norm(rigid.apply(pairs.tracker) - pairs.stage, axis=1)
    fiducial = fiducial_error(rigid, pairs.tracker, pairs.stage)
    localisation = localisation_error(fiducial, len(pairs.names))
    places = np.array(targets, dtype=float) if targets else pairs.stage.mean(axis=0, keepdims=True)
    expected = target_error(pairs.stage, localisation, places)
    return Registered(pairs, rigid, residuals, _left_out(pairs), fiducial, localisation, places, expected)


def write_registration(registered: Registered, path: Path) -> None:
    """Write a TOML file, a table for a scenario and the errors, and its picture beside it, `.png` and `.svg`.

    Raises InputError if the file exists.
    """
    if path.exists():
        raise InputError(f"{path}: exists: name another file with --out")
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
        raise InputError(f"{path}: exists: name another file with --out") from None
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


_POINTS = """
    WITH named AS (SELECT row_number() OVER () AS row, * FROM samples)
    SELECT CASE WHEN point_id = '' THEN 'row ' || row ELSE point_id END AS name, count(x_mm) AS n,
        count(*) - count(x_mm) AS missing, favg(x_mm) AS x, favg(y_mm) AS y, favg(z_mm) AS z,
        first(true_x_mm ORDER BY row) FILTER (x_mm IS NOT NULL) AS true_x,
        first(true_y_mm ORDER BY row) FILTER (x_mm IS NOT NULL) AS true_y,
        first(true_z_mm ORDER BY row) FILTER (x_mm IS NOT NULL) AS true_z,
        greatest(max(true_x_mm) FILTER (x_mm IS NOT NULL) - min(true_x_mm) FILTER (x_mm IS NOT NULL),
                 max(true_y_mm) FILTER (x_mm IS NOT NULL) - min(true_y_mm) FILTER (x_mm IS NOT NULL),
                 max(true_z_mm) FILTER (x_mm IS NOT NULL) - min(true_z_mm) FILTER (x_mm IS NOT NULL)) AS moved
    FROM named WHERE {chosen} GROUP BY name ORDER BY min(row) FILTER (x_mm IS NOT NULL)
"""


def _pairs(table: Table, wanted: Mapping[str, str | None]) -> Pairs:
    own = {name: value for name, value in wanted.items() if value is not None}
    for name, value in wanted.items():
        _check_label(table, name, value)
    chosen = " AND ".join(["true", *(f"{name} = ${name}" for name in own)])
    refuse_broken(table, POSITIONS, chosen, **own)
    refuse_broken(table, TRUE_POSITIONS, f"{chosen} AND x_mm IS NOT NULL", **own)
    found = table.arrays(_POINTS.format(chosen=chosen), **own)
    known = found["n"] > 0
    if not known.any():
        raise InputError("no reading has a position")
    points = {name: column[known] for name, column in found.items()}
    if (moved := points["moved"] > SAME_MM).any():
        name = points["name"][int(moved.argmax())]
        raise InputError(f"point {name} has several positions on the stage: one point, one position")
    stage, tracker = (
        np.column_stack([points[f"{kind}{axis}"] for axis in "xyz"]).astype(float) for kind in ("true_", "")
    )
    return Pairs(tuple(points["name"].tolist()), stage, tracker, points["n"], int(found["missing"].sum()))


def _check_label(table: Table, name: str, wanted: str | None) -> None:
    query = f"SELECT DISTINCT {name} AS label FROM samples WHERE {name} <> '' ORDER BY label"
    there = table.arrays(query)["label"].tolist() if name in table.columns else []
    if wanted is None and len(there) > 1:
        raise InputError(f"holds several: choose one with --{name}: {', '.join(there)}")
    if wanted is not None and wanted not in there:
        raise InputError(f"--{name} {wanted}: there is {', '.join(there) or 'no such column'}")


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
