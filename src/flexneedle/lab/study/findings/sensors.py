"""Sensors along the needle in the insertions of a study: innovations and exclusions."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from math import nan

import numpy as np

from flexneedle.lab.study.findings.design import StudyDesign
from flexneedle.lab.study.findings.groups import split_rows
from flexneedle.lab.study.findings.rows import Floats, InsertionRows

_COLUMN = re.compile("sensor_(.*)_excluded")


@dataclass(frozen=True)
class SensorGroup:
    """A sensor along the needle in the insertions with the same level of every factor.

    count: insertions that have it, finished or not; median_nis: median of their medians; excluded: number of insertions
    in which it is excluded to the end, by verdict; excluded_mm: median depth of the tip from which it is. NaN: unknown.
    """

    levels: dict[str, str]
    sensor: str
    count: int
    median_nis: float
    excluded: dict[str, int]
    excluded_mm: float

    @property
    def verdicts(self) -> str:
        """Number of exclusions by verdict, in words."""
        return ", ".join(f"{count} {verdict}" for verdict, count in self.excluded.items()) or "0"


def group_sensors(rows: InsertionRows, design: StudyDesign) -> list[SensorGroup]:
    """Return the sensors of each group, in the order of the factors; none in a study without sensors."""
    return [
        group for levels, own in split_rows(design.factors) for group in _groups(rows, levels, own.tolist())
    ]


def _groups(rows: InsertionRows, levels: dict[str, str], own: list[int]) -> Iterator[SensorGroup]:
    for sensor in (found[1] for found in map(_COLUMN.fullmatch, rows.names) if found):
        verdicts = rows.values(f"sensor_{sensor}_excluded")
        known = [row for row in own if verdicts[row] is not None]
        nis, depth = (rows.number(f"sensor_{sensor}_{key}")[known] for key in ("nis", "excluded_mm"))
        excluded = Counter(filter(None, (verdicts[row] for row in known)))
        if known:
            yield SensorGroup(levels, sensor, len(known), _median(nis), dict(excluded), _median(depth))


def _median(values: Floats) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else nan
