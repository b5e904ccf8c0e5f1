"""`flexneedle em check`: the indicator with the rig's power off and on."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from flexneedle.em.evaluation import published
from flexneedle.em.evaluation.evaluate import Options, read_grids
from flexneedle.em.evaluation.grid import Grid
from flexneedle.em.evaluation.notes import differing_points, lacking_sensors
from flexneedle.em.evaluation.power import Power, compare
from flexneedle.errors import InputError


@dataclass(frozen=True, eq=False)
class Check:
    """What the power of the rig does to each sensor with an indicator both times; notes: what cannot be compared."""

    sensors: list[Power]
    notes: list[str]

    @property
    def above(self) -> bool:
        """Whether the indicator of any sensor is above the threshold with power on."""
        return any(found.above for found in self.sensors)

    @property
    def paper(self) -> float:
        """The indicator of the paper's rig with power on."""
        return published.POWERED

    def values(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "above": self.above,
            "paper_powered": self.paper,
            "notes": self.notes,
            "results": [asdict(s) for s in self.sensors],
        }


def check(
    off: Path, on: Path | None, names: tuple[str | None, str | None], threshold: float, options: Options
) -> Check:
    """Return the comparison of two tables, or of two environments of the table `off`.

    names: of the environments with power off and on; None: the only one of its table, or "off" and "on" if there is
    one table. Raises InputError for a table that cannot be used, or where no sensor has an indicator both times.
    """
    grids = read_grids(off, options)[0]
    if on is None:
        chosen = (_of(off, grids, names[0] or "off"), _of(off, grids, names[1] or "on"))
    else:
        chosen = (_of(off, grids, names[0]), _of(on, read_grids(on, options)[0], names[1]))
    before, after = ({grid.sensor: grid for grid in own if grid.indicators.count} for own in chosen)
    both = [name for name in before if name in after]
    if not both:
        raise InputError(
            f"{on or off}: no sensor has an indicator both with power off ({_listed(before)}) "
            f"and on ({_listed(after)})"
        )
    powered = [
        replace(grid, environment=f"power {power}")
        for power, own in (("off", before), ("on", after))
        for grid in own.values()
    ]
    told = [*lacking_sensors(powered, "no indicator in"), *differing_points(powered)]
    return Check([compare(before[name], after[name], threshold) for name in both], told)


def _of(path: Path, grids: Sequence[Grid], environment: str | None) -> list[Grid]:
    there = list(dict.fromkeys(grid.environment for grid in grids))
    if environment is None and len(there) == 1:
        return list(grids)
    if environment not in there:
        asked = "holds several environments" if environment is None else f"no environment {environment!r}"
        raise InputError(f"{path}: {asked}: choose one by --off or --on: {', '.join(there)}")
    return [grid for grid in grids if grid.environment == environment]


def _listed(grids: dict[str, Grid]) -> str:
    return ", ".join(grids) or "none"
