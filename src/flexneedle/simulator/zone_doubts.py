"""Lines about zones above the skin, and about images: where they end in the needle's reach, what readers assumed."""

from collections.abc import Iterator

import numpy as np

from flexneedle.geometry.quaternion import to_matrix
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections import zones as sections
from flexneedle.simulator.zones import BESIDE_MM, ZoneImage, zones_of_record
from flexneedle.types import Floats

_DEPTHS, _RINGS, _ANGLES = 25, 40, 48
_LEAST_MM = 0.5


def find_zone_doubts(scenario: Scenario) -> list[str]:
    """Return lines about a scenario's zones and their images. Raises InputError for a file that cannot be used."""
    images = zones_of_record(scenario).images
    return [*_above_skin(scenario), *(line for image in images for line in describe_image(image, scenario))]


def _above_skin(scenario: Scenario) -> Iterator[str]:
    """Yield how far zones reach above the skin, of shapes with an end."""
    for zone in scenario.zone:
        above = -_top(zone)
        if above >= _LEAST_MM:
            yield f"zone {zone.name}: reaches {above:.1f} mm above the skin, where it is not avoided"


def _top(zone: sections.Zone) -> float:
    """Return the least depth (mm) of a zone; infinite for half-spaces and files."""
    match zone:
        case sections.Sphere():
            return zone.center_mm[0] - zone.radius_mm
        case sections.Capsule():
            return min(zone.from_mm[0], zone.to_mm[0]) - zone.radius_mm
        case sections.Box():
            along = np.abs(to_matrix(np.array(zone.rotation))[0])
            return zone.center_mm[0] - 0.5 * float(along @ np.array(zone.size_mm))
        case _:
            return np.inf


def describe_image(image: ZoneImage, scenario: Scenario) -> Iterator[str]:
    """Yield what is assumed of an image, and how far and how much of the needle's reach is beyond it."""
    for note in image.notes:
        yield f"image {image.name}: {note}"
    points, sizes = _reach(scenario)
    beyond = image.beyond(points)
    if beyond.max() >= _LEAST_MM:
        share = float(sizes @ (beyond > 0.0) / sizes.sum())
        part = f"{100.0 * share:.0f}" if share >= 0.01 else "below 1"
        yield (
            f"image {image.name}: ends up to {beyond.max():.1f} mm before the end of the needle's reach, {part} % of "
            "which between skin and target is beyond it: zones there are unknown"
        )


def _reach(scenario: Scenario) -> tuple[Floats, Floats]:
    """Return points (n, 3) of what a needle from the entries to the target may reach, and sizes (n,) of their parts.

    It is the cone from the free entry to the target, larger by the deflection on all sides.
    """
    entry, target = scenario.entry, np.array(scenario.target.position)
    start = np.array([0.0, entry.lateral_mm, entry.lateral_z_mm])
    part, ring, angle = (
        each.ravel()
        for each in np.meshgrid(
            np.linspace(0.0, 1.0, _DEPTHS),
            np.sqrt(np.linspace(0.0, 1.0, _RINGS + 1)[1:]),
            2.0 * np.pi * np.arange(_ANGLES) / _ANGLES,
        )
    )
    radius = entry.free_radius_mm * (1.0 - part) + BESIDE_MM
    across = np.stack([np.zeros_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    points: Floats = start + part[:, None] * (target - start) + (ring * radius)[:, None] * across
    return points, radius**2
