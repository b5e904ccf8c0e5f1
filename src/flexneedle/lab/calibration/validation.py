"""Validation: predictions of recorded insertions by a calibrated scenario and by simple predictors."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from flexneedle.errors import InputError
from flexneedle.lab.calibration.calibration import Calibration
from flexneedle.lab.calibration.comparison import (
    Errors,
    SensorRow,
    Tested,
    errors_ahead,
    errors_at_end,
    predict_fold,
    sensor_rows,
)
from flexneedle.lab.calibration.folds import split
from flexneedle.lab.calibration.session import Session
from flexneedle.lab.calibration.verdicts import (
    END,
    GUIDED,
    Row,
    Verdict,
    headline,
    judge,
    judge_coverage,
    row_of,
    rows_of,
)
from flexneedle.scenario.model import Scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AHEAD = (5.0, 10.0, 20.0, 40.0)
"""Distances of predictions, in mm."""


@dataclass(frozen=True, eq=False)
class Validation:
    """Predictions of recorded insertions by the model and by simple predictors.

    Attributes:
        tested: The insertions with their predictions, none of which was in the fit that predicts it.
        ahead: Distances (mm) of predictions that have pairs of steps.
        sentence: States which insertions train, and which test.
    """

    tested: tuple[Tested, ...]
    ahead: tuple[float, ...]
    sentence: str

    @cached_property
    def errors(self) -> dict[float, Errors]:
        """Errors by distance ahead (mm)."""
        return {distance: errors_ahead(self.tested, distance) for distance in self.ahead}

    @cached_property
    def ends(self) -> Errors:
        """Errors at the last step, predicted from the first, of insertions in which the guide rests."""
        return errors_at_end(self.tested)

    @property
    def deepest(self) -> float:
        """Depth (mm) of the deepest step."""
        return max(float(one.recording.depth.max()) for one in self.tested)

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """Errors of all groups and distances: all, guided, by depth, by order, by session; then at the end."""
        last = (row_of(END, 0.0, self.ends),) if len(self.ends) else ()
        return (*rows_of(self.errors, self.deepest), *last)

    @cached_property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Comparisons with simple predictors at each distance, of guided predictions if there are any; at the end."""
        found = []
        for ahead, errors in self.errors.items():
            guided = bool(errors.guided.any())
            found.append(
                judge(GUIDED, ahead, errors.select(errors.guided)) if guided else judge("all", ahead, errors)
            )
        return (*found, judge(END, 0.0, self.ends)) if len(self.ends) else tuple(found)

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentences that state where the model wins and where it does not."""
        whole = [row for row in self.rows if row.group == "all"]
        return headline(self.verdicts), *map(str, self.verdicts), judge_coverage(whole)

    @cached_property
    def sensors(self) -> tuple[SensorRow, ...]:
        """Readings of sensors along the needle beside the model's needle."""
        return tuple(sensor_rows(self.tested))

    @property
    def notes(self) -> Iterator[str]:
        """Yield which readings of sensors along the needle are not compared."""
        read = (each.sensor for one in self.tested for each in one.recording.readings)
        compared = {row.sensor for row in self.sensors}
        for name in dict.fromkeys(read):
            if name not in compared:
                yield f"readings of {name} are not compared: no [[sensor]] of this name, or no training with them"

    def __repr__(self) -> str:
        ahead = ", ".join(f"{each:g}" for each in self.ahead)
        return f"<Validation of {len(self.tested)} insertions, {ahead} mm ahead>"

    def plot(self) -> "Figure":
        """Return the figure of errors, coverage, and predicted beside measured paths."""
        from flexneedle.lab.calibration.validation_report.figures import draw_overview

        return draw_overview(self)

    def write(self, folder: Path) -> Path:
        """Write the page and its figures into a folder, and return the path of the page.

        Raises InputError if the folder cannot be written.
        """
        from flexneedle.lab.calibration.validation_report.page import write_page

        return write_page(self, folder)

    def values(self) -> dict[str, Any]:
        """Return tables and verdict as plain values."""
        return {
            "insertions": len(self.tested),
            "ahead_mm": list(self.ahead),
            "split": self.sentence,
            "verdict": list(self.verdict),
            "comparisons": [each.values() for each in self.verdicts],
            "rows": [row.values() for row in self.rows],
            **({"sensors": [row._asdict() for row in self.sensors]} if self.sensors else {}),
        }


def validate(
    given: Calibration | Scenario | str | Path,
    session: Session,
    ahead: Sequence[float] = AHEAD,
    training: Session | None = None,
) -> Validation:
    """Predict recorded insertions with a scenario, and with simple predictors fitted to other insertions.

    The insertions that train give what a scenario does not hold, session by session: the axis of the sensor, the
    direction of the bevel, the errors of readings and of the model; and the simple predictors. Without `training` they
    are the insertions of the scenario's fit. If the fit used all of the session, it is repeated on each half, and a
    scenario without a record of its fit is trained by each half for the other.

    Args:
        given: Calibration, or calibrated scenario, as for `load_scenario`.
        session: Recorded insertions.
        ahead: Distances (mm) of predictions.
        training: Insertions that train; the others of `session` test.

    Raises:
        InputError: No insertion is left to train or to test, or no two steps are as far apart as `ahead`.
        ScenarioError: The scenario cannot be used for these recordings.
    """
    distances = tuple(sorted({float(each) for each in ahead}))
    if not distances or not all(np.isfinite(each) and each > 0.0 for each in distances):
        shown = ", ".join(f"{each:g}" for each in distances) or "nothing"
        raise InputError(f"ahead = {shown}: must be distances in mm above 0")
    if not session.recordings:
        raise InputError("session: has no recordings")
    with threadpool_limits(1, user_api="blas"):  # the matrices are small: more threads wait for each other
        parts = split(given, session, training)
        tested = tuple(one for fold in parts.folds for one in predict_fold(fold, distances))
    known = tuple(_known(tested, distances))
    if not known:
        raise InputError(f"ahead = {distances[0]:g}: no insertion has steps that far apart")
    return Validation(tested, known, parts.sentence)


def _known(tested: Sequence[Tested], distances: Sequence[float]) -> Iterator[float]:
    """Yield the distances that have predictions."""
    for distance in distances:
        if len(errors_ahead(tested, distance)):
            yield distance
