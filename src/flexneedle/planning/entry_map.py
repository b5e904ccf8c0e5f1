"""Maps of entry points: for each the insertion to the target that was found, and the order of the entries."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from flexneedle.planning.entry import with_entry
from flexneedle.scenario.model import Scenario
from flexneedle.types import Flags, Floats

Whole = NDArray[np.intp]
PRECISE_MM = 0.1
"""Largest distance from the target at which an entry reaches it."""
_EQUAL_MM = 0.1  # rooms that differ by less are equal
_APART = 0.25  # of the disc's radius: distance of entries that are distinct


@dataclass(frozen=True, eq=False)
class EntryMap:
    """Entry points of a scenario, E of them, each with the best insertion to the target that was found for it.

    Clearance and tolerance of the best ten are the smaller ones of the simulator's and the exact rod's, as of a plan.

    Attributes:
        scenario: The scenario, with a free entry.
        points: y, z of the entry points on the skin (E, 2), mm.
        slopes: Slopes dy/dx, dz/dx of the axis (E, 2), rad.
        reached: Whether the target is reached (E,), within 0.1 mm, from the entry with a slope that is free, and with
            loads that the guard permits.
        clear: Whether it is reached with all margins of zones kept (E,).
        error_mm: Distance of the tip from the target at the end (E,).
        clearance_mm: Least clearance of the inserted needle from the zones over the insertion (E,), a bound; infinite
            without zones.
        zone: Number of the zone that is nearest, by clearance less margin (E,); −1 without zones.
        length_mm: Length of the needle in the tissue at the end (E,).
        peak_energy_uj, mean_energy_uj: Energy stored in the tissue (E,), as in `Invasiveness`.
        offset_mm: By how much the inserted needle may be displaced along y, and z, in any direction, before it enters
            a margin (E,); a lower bound; 0 where not clear.
        angle_mrad: By how much it may be turned about the entry point (E,), likewise.
        rolls: Angle of the needle before the first step (E,), rad.
        controls: Columns of `Control` (E, m, 9), from the needle at its entry; steps at the end may be 0.
    """

    scenario: Scenario
    points: Floats
    slopes: Floats
    reached: Flags
    clear: Flags
    error_mm: Floats
    clearance_mm: Floats
    zone: Whole
    length_mm: Floats
    peak_energy_uj: Floats
    mean_energy_uj: Floats
    offset_mm: Floats
    angle_mrad: Floats
    rolls: Floats
    controls: Floats

    @property
    def room_mm(self) -> Floats:
        """Tolerance of each entry as a length (E,): of its offset, or of its angle times the length, the smaller."""
        room: Floats = np.minimum(self.offset_mm, 1e-3 * self.angle_mrad * self.length_mm)
        return room

    @property
    def order(self) -> Whole:
        """Entries from the best: reached and clear, then with the larger room, then with less peak energy.

        Of entries that are not clear, those with the larger clearance are first. Rooms within 0.1 mm are equal.
        """
        room = np.where(self.clear, np.round(self.room_mm / _EQUAL_MM), self.clearance_mm)
        return np.lexsort((self.peak_energy_uj, -room, ~self.clear, ~self.reached))

    def best(self, count: int) -> list[int]:
        """Return up to `count` clear entries, from the best, at least a quarter of the disc's radius apart."""
        least, chosen = _APART * self.scenario.entry.free_radius_mm, list[int]()
        for k in self.order[self.clear[self.order]].tolist():
            if len(chosen) < count and all(
                np.linalg.norm(self.points[k] - self.points[other]) >= least for other in chosen
            ):
                chosen.append(k)
        return chosen

    def zone_name(self, entry: int) -> str:
        """Return the name of the nearest zone; "" without zones."""
        return self.scenario.zone[self.zone[entry]].name if self.scenario.zone else ""

    def scenario_at(self, entry: int) -> Scenario:
        """Return the scenario with its entry fixed at one of the map."""
        own = self.scenario.entry
        (y, z), slope = self.points[entry].tolist(), complex(*self.slopes[entry])
        return with_entry(self.scenario, complex(y, z) - own.lateral(0.0), slope - own.slope)

    def take(self, which: Whole) -> "EntryMap":
        """Return the map of some entries."""
        return EntryMap(self.scenario, *(getattr(self, each.name)[which] for each in fields(self)[1:]))
