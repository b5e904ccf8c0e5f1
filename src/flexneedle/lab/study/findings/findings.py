"""Findings of a report on a study."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from flexneedle.lab.study.findings.design import Design, design_of
from flexneedle.lab.study.findings.predictions import Predictions, predictions_of
from flexneedle.lab.study.findings.reading import StudyRecord
from flexneedle.lab.study.findings.statistics import CONFIDENCE, RESAMPLES, SEED
from flexneedle.lab.study.findings.summary import (
    DONE,
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
from flexneedle.lab.study.findings.worlds import WorldGroup, has_worlds, world_groups

_MOST_KINDS = 20  # of endings in the list


@dataclass(frozen=True, eq=False)
class Findings:
    """Findings of a study.

    outcomes: insertions by outcome, "done" first; whole: one group per controller over all its insertions; groups:
    one per combination of settings; worst: rows with the largest errors, in worlds those of the first controller;
    worlds: empty in other studies; predictions: of controllers that predict the miss.
    """

    study: StudyRecord
    design: Design
    outcomes: Mapping[str, int]
    whole: Sequence[Group]
    groups: Sequence[Group]
    against: Sequence[Difference]
    against_by_depth: Mapping[str, Sequence[Difference]]
    cases: Sequence[Difference]
    endings: Sequence[Ending]
    worst: Sequence[int]
    worlds: Sequence[WorldGroup]
    predictions: Sequence[Predictions]

    @property
    def planned(self) -> int:
        """Number of insertions of the complete study."""
        return self.study.definition.insertions

    @property
    def finished(self) -> int:
        """Number of insertions that finished."""
        return self.outcomes[DONE]

    @property
    def missing(self) -> int:
        """Number of insertions without a row yet."""
        return max(0, self.planned - len(self.study.rows))

    @property
    def hits(self) -> int:
        """Number of insertions that finished within 1 mm of the target."""
        return sum(group.known - group.missed for group in self.whole)

    def values(self) -> dict[str, Any]:
        """Return all statistics as plain values, at full precision; NaN becomes null in JSON."""
        return {
            "insertions": len(self.study.rows),
            "planned": self.planned,
            "finished": self.finished,
            "missing": self.missing,
            "outcomes": dict(self.outcomes),
            "statistics": {
                "over": "finished insertions",
                "quantiles": "linear interpolation between order statistics",
                "intervals": "percentile bootstrap, drawn by seed",
                "confidence": CONFIDENCE,
                "resamples": RESAMPLES,
                "seed": SEED,
            },
            "whole": list(map(asdict, self.whole)),
            "groups": list(map(asdict, self.groups)),
            "controllers": list(map(asdict, self.against)),
            "controllers_by_depth": {
                depth: list(map(asdict, found)) for depth, found in self.against_by_depth.items()
            },
            "cases": list(map(asdict, self.cases)),
            "worlds": list(map(asdict, self.worlds)),
            "predictions": list(map(asdict, self.predictions)),
            "endings": list(map(asdict, self.endings)),
        }


def findings_of(study: StudyRecord) -> Findings:
    """Return the findings of a study."""
    rows = study.rows
    design = design_of(rows, study.definition)
    groups = groups_of(rows, design.factors)
    controllers_only = len(design.factors) == 1
    return Findings(
        study,
        design,
        {DONE: 0} | Counter(rows.text("outcome")),
        groups if controllers_only else groups_of(rows, [design.controller]),
        groups,
        controller_differences(rows, design),
        differences_by_depth(rows, design) if design.controller.varies else {},
        case_differences(rows, design),
        endings(rows)[:_MOST_KINDS],
        worst(rows, among=design.controller.codes == 0 if has_worlds(rows) else None),
        world_groups(rows, design),
        predictions_of(rows, design),
    )
