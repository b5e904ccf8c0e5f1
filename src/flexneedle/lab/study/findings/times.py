"""Computing time of a study by part."""

from dataclasses import dataclass
from math import nan

import numpy as np

from flexneedle.lab.study.findings.rows import Floats, Rows


@dataclass(frozen=True)
class TimeShare:
    """Time of one part of the work: seconds of all processes, share of the total, median of one item (ms)."""

    name: str
    seconds: float
    share: float
    median_ms: float


def division(timing: Rows) -> list[TimeShare]:
    """Return the times of planning, control, plant and the rest; a plan counts once, however often it was used."""
    control, plant, total = (timing.number(name) for name in ("control_s", "plant_s", "total_s"))
    parts = {
        "plan": _plan_seconds(timing),
        "control": control,
        "plant": plant,
        "other": total - np.nan_to_num(control) - np.nan_to_num(plant),
    }
    sums = {name: float(np.nansum(seconds)) for name, seconds in parts.items()}
    whole = sum(sums.values()) or 1.0
    return [
        TimeShare(name, sums[name], sums[name] / whole, _median_ms(values)) for name, values in parts.items()
    ]


def _plan_seconds(timing: Rows) -> Floats:
    first = np.unique(timing.codes("plan"), return_index=True)[1]
    return timing.number("plan_s")[first]


def _median_ms(values: Floats) -> float:
    known = values[~np.isnan(values)]
    return 1e3 * float(np.median(known)) if len(known) else nan
