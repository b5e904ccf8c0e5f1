"""Where the time of a study went."""

from dataclasses import dataclass
from math import nan

import numpy as np

from flexneedle.study.report.rows import Floats, Rows


@dataclass(frozen=True)
class Part:
    """A part of the work: seconds of all processes together, share of the whole, median of one (ms)."""

    name: str
    seconds: float
    share: float
    median_ms: float


def division(timing: Rows) -> list[Part]:
    """Return how the time divides into plan, control and plant; a plan counts once, however often it was used."""
    control, plant, total = (timing.number(name) for name in ("control_s", "plant_s", "total_s"))
    parts = {
        "plan": _plan_seconds(timing),
        "control": control,
        "plant": plant,
        "rest of the insertions": total - np.nan_to_num(control) - np.nan_to_num(plant),
    }
    sums = {name: float(np.nansum(seconds)) for name, seconds in parts.items()}
    whole = sum(sums.values()) or 1.0
    return [Part(name, sums[name], sums[name] / whole, _median_ms(values)) for name, values in parts.items()]


def _plan_seconds(timing: Rows) -> Floats:
    first = np.unique(timing.codes("plan"), return_index=True)[1]
    return timing.number("plan_s")[first]


def _median_ms(values: Floats) -> float:
    known = values[~np.isnan(values)]
    return 1e3 * float(np.median(known)) if len(known) else nan
