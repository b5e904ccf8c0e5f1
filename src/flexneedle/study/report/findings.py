"""What a study comes to, as a whole: all that the page and the summary say."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

from flexneedle.control.methods import DEFAULT, METHODS
from flexneedle.study.report.design import Design, design_of
from flexneedle.study.report.predictions import Predictions, predictions_of
from flexneedle.study.report.reading import StudyRecord, asked
from flexneedle.study.report.summary import (
    Difference,
    Ending,
    Group,
    case_differences,
    controller_differences,
    differences_by_depth,
    endings,
    groups_of,
    worst,
)
from flexneedle.study.report.worlds import WorldGroup, has_worlds, world_groups

_MOST_KINDS = 20  # of endings that are listed


@dataclass(frozen=True, eq=False)
class Findings:
    """What a study comes to. planned: insertions that it asks for, None if it does not say.

    worst: rows with the largest errors, in worlds those of the first controller; worlds: empty in other studies;
    predictions: of the controllers that predict.
    """

    study: StudyRecord
    planned: int | None
    design: Design
    groups: Sequence[Group]
    against: Sequence[Difference]
    against_by_depth: Mapping[str, Sequence[Difference]]
    cases: Sequence[Difference]
    endings: Sequence[Ending]
    worst: Sequence[int]
    worlds: Sequence[WorldGroup]
    predictions: Sequence[Predictions]

    @property
    def finished(self) -> int:
        """How many insertions finished."""
        return sum(group.finished for group in self.groups)


def findings_of(study: StudyRecord) -> Findings:
    """Return what a study comes to."""
    rows, wanted = study.rows, asked(study.about)
    design = design_of(rows, controllers_in_order(), wanted.get("axes", ()), _base_case(wanted))
    return Findings(
        study,
        planned_insertions(study.about),
        design,
        groups_of(rows, design),
        controller_differences(rows, design) if design.controller.varies else [],
        differences_by_depth(rows, design) if design.controller.varies else {},
        case_differences(rows, design) if design.cases.varies else [],
        endings(rows)[:_MOST_KINDS],
        worst(rows, among=design.controller.codes == 0 if has_worlds(rows) else None),
        world_groups(rows, design),
        predictions_of(rows, design),
    )


def planned_insertions(about: Mapping[str, Any]) -> int | None:
    """Return how many insertions a study asks for: those that it names, or repeats × cases × values of each axis.

    None if it does not say.
    """
    wanted = asked(about)
    if isinstance(named := wanted.get("insertions"), int):
        return named
    if "repeats" not in wanted or "axes" not in wanted:
        return None
    repeats: int = wanted["repeats"]
    return repeats * max(1, len(wanted.get("cases", ()))) * prod(map(len, wanted["axes"].values()))


def title_of(about: Mapping[str, Any]) -> str:
    """Return the title of a study, or its name."""
    wanted = asked(about)
    return str(wanted.get("title") or wanted.get("name") or "Study")


def _base_case(wanted: Mapping[str, Any]) -> str | None:
    """Return the first case that sets nothing."""
    return next((name for name, settings in wanted.get("cases", {}).items() if not settings), None)


def controllers_in_order() -> list[str]:
    """Return the controllers, the default first."""
    return sorted(METHODS, key=lambda name: name != DEFAULT)
