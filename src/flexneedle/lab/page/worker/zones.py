"""Zones of a scenario, and the least clearances of needles from them, as messages."""

from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

from flexneedle.lab.page.protocol import (
    NearestZone,
    PageZone,
    ZonesMessage,
    ZoneSurface,
    places_of,
    without_advice,
)
from flexneedle.record.fields import page_values
from flexneedle.results import Period, Plan
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.surfaces import zone_surface
from flexneedle.simulator.zones import ZoneMap, workspace_corners
from flexneedle.types import Floats

_DIGITS = 3  # of coordinates in mm


def describe_zones(
    scenario: Scenario, zones: ZoneMap, of: Literal["scene", "live", "first", "second"]
) -> ZonesMessage:
    """Return the message about the zones of a scenario."""
    low, high = map(np.array, workspace_corners(scenario))

    def surface(number: int, distance: float) -> ZoneSurface:
        found = zone_surface(zones, number, low, high, distance)
        return ZoneSurface(
            points=found.points.round(_DIGITS).ravel().tolist(), triangles=found.triangles.ravel().tolist()
        )

    described = [
        PageZone(
            name=zone.name,
            margin_mm=float(zones.margins[number]),
            places=places_of(zone, number),
            surface=surface(number, 0.0),
            margin=surface(number, float(zones.kept[number])),
        )
        for number, zone in enumerate(scenario.zone)
    ]
    return ZonesMessage(of=of, zones=described)


def find_nearest(zones: ZoneMap, shapes: Iterable[Floats], clearance: float) -> NearestZone | None:
    """Return where shapes (n, ≥ 3) of a needle are nearest to a zone, with the clearance (mm); None before the skin."""
    near = zones.closest(np.stack(list(shapes)), clearance)
    if near is None:
        return None
    needle, surface = (tuple(end.round(_DIGITS).tolist()) for end in (near.needle, near.surface))
    return NearestZone(zone=near.zone, clearance_mm=near.clearance, needle=needle, surface=surface)


def describe_row(period: Period, plan: Plan, zones: ZoneMap) -> dict[str, Any]:
    """Return the row of a period, with the least margin and the nearest zone if there are zones."""
    row = page_values(period, plan)
    row["decision"] = without_advice(row["decision"])
    if not zones:
        return row
    near = find_nearest(zones, [period.shape], period.clearance)
    return row | {"margin_mm": zones.margin, "nearest": None if near is None else near.model_dump()}
