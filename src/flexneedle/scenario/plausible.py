"""Valid but implausible values of a scenario: far outside the usual range, or without effect."""

from collections.abc import Iterator
from itertools import pairwise
from statistics import fmean
from typing import NamedTuple

import numpy as np

from flexneedle.scenario.alternatives import SHEAR, SHEARS_IN_YOUNGS, YOUNG
from flexneedle.scenario.dotted import split_key
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import key_path
from flexneedle.scenario.sections.zones import ImageSettings, ZoneFile
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.scenario.sensors.points import Points
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.scenario.sensors.slice import Slice
from flexneedle.scenario.zone_files import find_lost
from flexneedle.types import Needles, X


class Range(NamedTuple):
    """Usual range of the size of a quantity, in the unit of its key, and its source."""

    low: float
    high: float
    source: str


_STANDARD = "tubing for needles, 34G to 10G, ISO 9626:2016"
_ROBOT = "doi:10.1109/ROBOT.2008.4543587"
_TRAVEL = Range(
    1, 100, f"a robot for prostate needles 100, or 50 to either side ({_ROBOT}); 1 is our estimate"
)
_ALPHA = Range(
    2,
    40,
    "in size: neo-Hookean 2, brain -4.7 (doi:10.1016/S0021-9290(01)00234-2), "
    "skin 40 (Adull Manan et al., SHUSER 2012)",
)
USUAL = {
    "needle.outer_diameter_mm": Range(0.18, 3.4, _STANDARD),
    "needle.inner_diameter_mm": Range(0.05, 3.0, f"less the walls, {_STANDARD}"),
    "needle.length_mm": Range(13, 200, "from hypodermic to brachytherapy needles, as sold"),
    "needle.youngs_modulus_gpa": Range(
        3, 210, "PEEK 3 to 4 (doi:10.1016/j.biomaterials.2007.07.013), nitinol 28 to 83, steel 190 to 210"
    ),
    "needle.bevel.offset_mm": Range(
        0.01,
        14,
        "0.01 for a thin wire in stiff gel (docs/worlds.md), 14 is the model's limit for the usual compression length",
    ),
    "needle.bevel.length_mm": Range(
        0.1, 19, "tubing of 0.18 to 3.4 ground at 60 to 10 degrees (J Biomech 2014;47:3344)"
    ),
    "tissue.*.thickness_mm": Range(
        0.075,
        200,
        "epidermis 0.075 (doi:10.1016/j.burns.2016.11.014); 200, the length of needles, is our estimate",
    ),
    "tissue.*.shear_modulus_kpa": Range(
        0.6, 210, "stomach 0.64, liver 1.8, gallbladder 85, artery 210 (doi:10.1088/1361-6560/ab5010)"
    ),
    "tissue.*.alpha": _ALPHA,
    "tissue.*.compression_length_mm": Range(
        5, 100, "our estimate: nothing has been published; 20 in the presets"
    ),
    "tissue.*.engaged_width_mm": Range(
        1.2,
        70,
        "our estimate: 0.25 to 0.7 times the compression length, Vesic's stiffness (1961) to about twice it",
    ),
    "tissue.*.yield_mm": Range(
        0.3, 1, "0.5 fitted to recorded insertions in gel (docs/worlds.md); the ends are our estimate"
    ),
    "target.depth_mm": Range(
        4,
        200,
        "pen needles 4, lumbar puncture 20 to 130 (Am J Emerg Med 2005;23:742), brachytherapy needles 200",
    ),
    "setup.guide_to_skin_mm": Range(5, 200, "41 in the paper; the ends are our estimate"),
    "setup.guide_clearance_mm": Range(
        0.01, 0.3, "our estimate, from a sliding fit to a guide of the next gauge"
    ),
    "setup.tip_to_skin_mm": Range(1, 200, "28.5 in the paper; the ends are our estimate"),
    "setup.stroke_mm": Range(
        10, 200, f"110 in the paper, 150 for a robot ({_ROBOT}); the ends are our estimate"
    ),
    "setup.max_guide_travel_mm": _TRAVEL,
    "setup.max_base_travel_mm": _TRAVEL,
    "setup.insertion_speed_mm_s": Range(
        1, 280, "robots from 1 (Hing et al., ICRA 2006), brachytherapy by hand up to 280"
    ),
    "tracker.rate_hz": Range(1, 1000, "40 for an NDI Aurora; the ends are our estimate"),
    "tracker.jitter_mm": Range(0.01, 1, "0.07 in the paper; the ends are our estimate"),
    "phantom.friction_mn_per_mm": Range(
        5, 86, "measured in PVC phantoms (Li et al., Procedia Manufacturing 2015;1:866)"
    ),
    "phantom.structure.alpha": _ALPHA,
}
"""By key; * is any layer. Sources are for the ends of the range."""

_SITES = 0.8  # largest distance of sites over the length over which the needle bends
_FAR = 10**0.5  # ratio to the nearest usual value from which a value is reported: half an order of magnitude


def find_doubts(scenario: Scenario) -> list[str]:
    """Return a line for each value that is implausible.

    A value is implausible if it is half an order of magnitude or more outside the usual range, if it has no effect, if
    it holds the needle from the start, or if it is the file of a zone in the frame of an unknown image. The file of a
    zone that cannot be read, or has changed, has a line, too.
    """
    return [
        *_unusual(scenario),
        *_find_unused(scenario),
        *_stale(scenario),
        *_find_idle_sensors(scenario),
        *_find_far_sites(scenario),
        *find_unplaced(scenario),
        *find_lost(scenario).values(),
    ]


def _unusual(scenario: Scenario) -> Iterator[str]:
    for key, value in scenario.flat().items():
        usual = USUAL.get(_general(key))
        if usual is None or value == 0 or 1.0 / _FAR < (ratio := _ratio(abs(value), usual)) < _FAR:
            continue
        off = (
            f"{_short(ratio)} times the largest"
            if ratio > 1.0
            else f"{_short(1.0 / ratio)} times below the smallest"
        )
        line = f"{off} usual value, {usual.low:g} to {usual.high:g} ({usual.source}): check the unit"
        is_shear = key.endswith(f".{SHEAR}")
        youngs = f" ({YOUNG} = {SHEARS_IN_YOUNGS * value:g}, E = 3μ)" if is_shear else ""
        yield f"{key_path(split_key(key))} = {value:g}{youngs}: {line}"


def _find_unused(scenario: Scenario) -> Iterator[str]:
    last = len(scenario.tissue) - 1
    thickness = scenario.tissue[last].thickness_mm
    if thickness is not None:
        rule = "has no effect: the last layer has no end; leave it out, or add the layer below"
        yield f"tissue[{last}].thickness_mm = {thickness:g}: {rule}"


def _stale(scenario: Scenario) -> Iterator[str]:
    periods, limit = scenario.phantom.delay_periods, scenario.control.stale_after_s
    age = periods * scenario.setup.step_time
    if age > limit:
        rule = f"readings arrive {_short(age)} s old, above control.stale_after_s ({limit:g}), and hold the needle"
        remedy = "lower it, or raise control.stale_after_s"
        yield f"phantom.delay_periods = {periods:g}: {rule}: {remedy} (setup.insertion_speed_mm_s is low)"


def _find_idle_sensors(scenario: Scenario) -> Iterator[str]:
    """Yield a line for each sensor along the needle or setting of theirs without effect, and for an unknown depth."""
    for k, sensor in enumerate(scenario.sensor):
        starts = {"plane_mm": getattr(sensor, "plane_mm", None), "from_mm": getattr(sensor, "from_mm", None)}
        for key, value in starts.items():
            if value is not None and value >= scenario.target.depth_mm:
                rule = f"beyond target.depth_mm ({scenario.target.depth_mm:g}): the sensor measures nothing"
                yield f"sensor[{k}].{key} = {value:g}: {rule}"
        yield from _find_late(f"sensor[{k}]", sensor, scenario)
    control = scenario.control
    if control.essential_points and not any(isinstance(one, Slice | Points) for one in scenario.sensor):
        yield 'control.essential_points = true: has no effect without a [[sensor]] "points" or "slice"'
    yield from _find_unknown_bias(scenario)
    if not scenario.tracker.enabled and control.start_axial_sd_mm:
        rule = "without a tracker this error of the depth remains: home the tip, and set it to what is left"
        yield f"control.start_axial_sd_mm = {control.start_axial_sd_mm:g}: {rule}"
    if not scenario.tracker.enabled and not any(_sees_start(one, scenario) for one in scenario.sensor):
        rule = "no sensor measures the needle at its start, where it is held: add one, such as an fbg"
        yield f"tracker.enabled = false: {rule}"


def _sees_start(sensor: Sensor, scenario: Scenario) -> bool:
    """Return if a sensor measures the needle before it moves."""
    along = np.linspace(-scenario.needle.length_mm, 0.0, 21)
    poses = np.zeros((1, along.size, 5))
    poses[0, :, X] = scenario.setup.start_tip_x + along
    return bool(sensor.sees(Needles(poses, along[1] - along[0]), scenario.setup.axes).any())


def _find_late(at: str, sensor: Sensor, scenario: Scenario) -> Iterator[str]:
    """Yield a line for readings too rare or too late for the insertion."""
    setup = scenario.setup
    lasts = (scenario.target.depth_mm - setup.start_tip_x) / setup.insertion_speed_mm_s
    over = f"the needle advances to the target in {_short(lasts)} s"
    if sensor.rate_hz * lasts < 1.0:
        yield f"{at}.rate_hz = {sensor.rate_hz:g}: a reading every {_short(1.0 / sensor.rate_hz)} s, {over}: raise it"
    if sensor.delay_s >= lasts:
        yield f"{at}.delay_s = {sensor.delay_s:g}: readings arrive too late, {over}: lower it, or leave the sensor out"


def _find_unknown_bias(scenario: Scenario) -> Iterator[str]:
    """Yield a line if a constant error of the tracker and an error of the start cannot be separated."""
    given, start = scenario.tracker.bias_sd_mm, scenario.control.start_axial_sd_mm
    if not given:
        return
    placed = scenario.setup.has_guide or any(not sensor.rolls for sensor in scenario.sensor)
    if not placed:
        yield f"tracker.bias_sd_mm = {given:g}: without a guide only a sensor with a position shows it, such as a slice"
    if start:
        rule = (
            "along the needle it cannot be separated from tracker.bias_sd_mm: home the tip, set what is left"
        )
        yield f"control.start_axial_sd_mm = {start:g}: {rule}"


def _find_far_sites(scenario: Scenario) -> Iterator[str]:
    """Yield a line for fibres alone whose sites are too far apart to show the shape of the needle in the tissue.

    The needle bends over 1/β, β⁴ = k/(4EI), as a beam on an elastic foundation.
    """
    foundation = fmean(2.0 * layer.energy_per_mm(1.0) for layer in scenario.tissue)
    bends = (4.0 * scenario.needle.bending_stiffness / foundation) ** 0.25
    for k, sensor in enumerate(scenario.sensor if not scenario.tracker.enabled else ()):
        if isinstance(sensor, Fbg):
            depth = scenario.target.depth_mm
            ends = [0.0, *(site for site in sensor.sites_mm if site < depth), depth]
            if (gap := max(b - a for a, b in pairwise(ends))) > _SITES * bends:
                rule = f"{gap:.0f} mm of the inserted needle without a site; it bends over {bends:.0f} mm"
                yield f"sensor[{k}].sites_mm: {rule}: the tip is known better with at most {_SITES * bends:.0f} mm"


def find_unplaced(scenario: Scenario) -> Iterator[str]:
    """Yield a line for each zone whose file is in the frame of an unknown image."""
    if scenario.image == ImageSettings():
        for zone in scenario.zone:
            if isinstance(zone, ZoneFile):
                yield (
                    f"zone {zone.name}: file in the image's frame, but the scenario has no [image]: taken as the "
                    "needle's frame"
                )


def _general(key: str) -> str:
    parts = split_key(key)
    return ".".join("*" if isinstance(part, int) else part for part in parts)


def _short(ratio: float) -> str:
    """Return a number with three digits, never as 1e+03."""
    return f"{float(f'{ratio:.3g}'):.0f}" if ratio >= 100.0 else f"{ratio:.3g}"


def _ratio(value: float, usual: Range) -> float:
    """Return the ratio of the size of a value to the nearest one in a range."""
    return value / min(max(value, usual.low), usual.high)
