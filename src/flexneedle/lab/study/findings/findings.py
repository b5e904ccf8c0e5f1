"""Findings of a report on a study."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from flexneedle.lab.study.findings.design import StudyDesign, find_design
from flexneedle.lab.study.findings.groups import (
    DONE,
    Difference,
    Ending,
    SettingGroup,
    compare_cases,
    compare_controllers,
    count_endings,
    find_worst,
    group_rows,
)
from flexneedle.lab.study.findings.predictions import Predictions, assess_predictions
from flexneedle.lab.study.findings.reading import StudyTables
from flexneedle.lab.study.findings.sensors import SensorGroup, group_sensors
from flexneedle.lab.study.findings.statistics import CONFIDENCE, RESAMPLES, SEED
from flexneedle.lab.study.findings.worlds import WorldGroup, group_worlds

_MOST_KINDS = 20  # of endings in the list


@dataclass(frozen=True, eq=False)
class Findings:
    """Findings of a study.

    outcomes: insertions by outcome, "done" first; whole: one group per controller over all its insertions; groups:
    one per combination of settings; worst: rows with the largest errors, in worlds only of the first controller;
    worlds: empty in other studies; predictions: of controllers that predict the miss; sensors: along the needle.
    """

    study: StudyTables
    design: StudyDesign
    outcomes: Mapping[str, int]
    whole: Sequence[SettingGroup]
    groups: Sequence[SettingGroup]
    against: Sequence[Difference]
    cases: Sequence[Difference]
    endings: Sequence[Ending]
    worst: Sequence[int]
    worlds: Sequence[WorldGroup]
    predictions: Sequence[Predictions]
    sensors: Sequence[SensorGroup]

    @property
    def planned(self) -> int:
        """Number of insertions of the complete study."""
        return self.study.insertions

    @property
    def finished(self) -> int:
        """Number of insertions that finished."""
        return self.outcomes[DONE]

    @property
    def missing(self) -> int:
        """Number of insertions without a row yet."""
        return max(0, self.planned - len(self.study.rows))

    @property
    def energy_means(self) -> str:
        """Name of the means of energies: E₁ of random worlds differs by orders of magnitude."""
        return "geometric means" if self.study.rows.has_worlds else "means"

    @property
    def hits(self) -> int:
        """Number of insertions that finished within 1 mm of the target."""
        return sum(group.known - group.missed for group in self.whole)

    def values(self) -> dict[str, Any]:
        """Return all statistics as plain values, at full precision; NaN becomes null in JSON."""
        rows = self.study.rows
        return {
            "study": self.study.title,
            "insertions": len(rows),
            "planned": self.planned,
            "finished": self.finished,
            "missing": self.missing,
            "outcomes": dict(self.outcomes),
            "statistics": {
                "over": "finished insertions",
                "energies": self.energy_means,
                "quantiles": "linear interpolation between order statistics",
                "intervals": "percentile bootstrap, drawn by seed",
                "confidence": CONFIDENCE,
                "resamples": RESAMPLES,
                "seed": SEED,
            },
            "whole": list(map(asdict, self.whole)),
            "groups": list(map(asdict, self.groups)),
            "controllers": list(map(asdict, self.against)),
            "cases": list(map(asdict, self.cases)),
            "worlds": list(map(asdict, self.worlds)),
            "predictions": list(map(asdict, self.predictions)),
            **({"sensors": list(map(asdict, self.sensors))} if self.sensors else {}),
            "endings": list(map(asdict, self.endings)),
            "worst": [
                {name: rows.value(name, row) for name in ("index", "true_error_mm", "outcome")}
                for row in self.worst
            ],
        }


def compute_findings(study: StudyTables) -> Findings:
    """Return the findings of a study."""
    rows = study.rows
    design = find_design(study)
    groups = group_rows(rows, design.factors)
    controllers_only = len(design.factors) == 1
    return Findings(
        study,
        design,
        {DONE: 0} | Counter(rows.text("outcome")),
        groups if controllers_only else group_rows(rows, [design.controller]),
        groups,
        compare_controllers(rows, design),
        compare_cases(rows, design),
        count_endings(rows)[:_MOST_KINDS],
        find_worst(rows, among=design.controller.codes == 0 if rows.has_worlds else None),
        group_worlds(rows, design),
        assess_predictions(rows, design),
        group_sensors(rows, design),
    )
