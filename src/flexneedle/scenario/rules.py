"""Rules between sections: geometry, layers, the target, and grids too fine to run."""

from collections.abc import Iterator, Sequence
from math import isfinite

from flexneedle.scenario.problems import Problem
from flexneedle.scenario.sections.apparatus import Entry, Setup, TrackerSettings
from flexneedle.scenario.sections.monitor import GuardSettings, MonitorSettings
from flexneedle.scenario.sections.needle import Bevel, Needle
from flexneedle.scenario.sections.settings import PhantomSettings, PlanSettings, Target
from flexneedle.scenario.sections.zones import Zone, ZoneFile, ZoneSettings
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.scenario.sensors.kinds import broken_rule
from flexneedle.scenario.sensors.points import Range
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.scenario.sensors.slice import Slice
from flexneedle.scenario.tissue.layer import Contact, Layer

_MOST_GRID_POINTS = 20_000
_MOST_READINGS_A_STEP = 10_000
_HALF_TURN_DEG = 180.0
_FRAMES_IN_A_WINDOW = 2
_TRACKER = "tracker"  # its name among the sensors
_ROUNDING_MM = 1e-9  # of an entry that a plan has chosen


def geometry_problems(needle: Needle, setup: Setup) -> Iterator[Problem]:
    """Yield broken rules of the geometry: the tip starts before the guide, and the base ends behind it.

    Without a guide the base ends behind the skin.
    """
    guide, tip = setup.guide_to_skin_mm, setup.tip_to_skin_mm
    if needle.bevel.length_mm >= needle.length_mm:
        rule = f"must be below needle.length_mm ({needle.length_mm:g})"
        yield Problem("needle.bevel.length_mm", needle.bevel.length_mm, rule)
    if guide is not None and tip >= guide:
        rule = f"the tip would start behind the guide: must be below setup.guide_to_skin_mm ({guide:g})"
        yield Problem("setup.tip_to_skin_mm", tip, rule)
    if guide is None and setup.guide_clearance_mm is not None:
        rule = "must not be set without a guide (setup.guide_to_skin_mm)"
        yield Problem("setup.guide_clearance_mm", setup.guide_clearance_mm, rule)
    if setup.max_rotation_deg is not None and setup.half_turns:
        rule = f"must not be set where the needle rolls by half turns ({setup.half_turns_by})"
        yield Problem("setup.max_rotation_deg", setup.max_rotation_deg, rule)
    room = needle.length_mm + tip - (guide or 0.0)
    stop = "skin" if guide is None else "guide"
    if room <= 0.0:
        rule = (
            f"the base would start beyond the {stop}: must be above {(guide or 0.0) - tip:g} with this start"
        )
        yield Problem("needle.length_mm", needle.length_mm, rule)
    elif setup.stroke_mm >= room:
        yield Problem(
            "setup.stroke_mm",
            setup.stroke_mm,
            f"the base would reach the {stop}: must be below {room:g} with this needle length and start",
        )


def layer_problems(tissue: Sequence[Layer], bevel: Bevel) -> Iterator[Problem]:
    """Yield broken rules of the layers: at least one, a thickness for each but the last, a possible bevel offset."""
    if not tissue:
        yield Problem("tissue", None, "needs at least one layer: add a [[tissue]]")
        return
    for i, layer in enumerate(tissue[:-1]):
        if layer.thickness_mm is None:
            yield Problem(
                f"tissue.{i}.thickness_mm", None, "missing: every layer but the last needs a thickness"
            )
    least = min(range(len(tissue)), key=lambda i: tissue[i].largest_bevel_mm)
    limit = tissue[least].largest_bevel_mm
    if bevel.offset_mm >= limit:
        rule = f"must be below {limit:g}, {tissue[least].limit:g} times tissue[{least}].compression_length_mm"
        yield Problem("needle.bevel.offset_mm", bevel.offset_mm, rule)


def entry_problems(setup: Setup, entry: Entry) -> Iterator[Problem]:
    """Yield broken rules of the entry: a needle in the plane enters in the plane."""
    for key in ("lateral_z_mm", "slope_z_mrad"):
        if setup.axes == 1 and (value := getattr(entry, key)) != 0.0:
            yield Problem(f"entry.{key}", value, "must be 0 with setup.axes = 1")


def zone_problems(zones: Sequence[Zone], settings: ZoneSettings, guard: GuardSettings) -> Iterator[Problem]:
    """Yield margins that the guard would not let a plan use, names given twice, and files with segment and label."""
    margins = {f"zone.{i}.margin_mm": zone.margin_mm for i, zone in enumerate(zones)}
    if None in margins.values():
        margins = {"zones.margin_mm": settings.margin_mm, **margins}
    for key, margin in margins.items():
        if margin is not None and margin < guard.zone_buffer_mm:
            yield Problem(key, margin, f"must be at least guard.zone_buffer_mm ({guard.zone_buffer_mm:g})")
    names = [zone.name for zone in zones]
    for i, zone in enumerate(zones):
        if zone.name in names[:i]:
            yield Problem(
                f"zone.{i}.name", zone.name, f"must differ from the name of zone[{names.index(zone.name)}]"
            )
        if isinstance(zone, ZoneFile) and zone.segment is not None and zone.label is not None:
            yield Problem(f"zone.{i}.label", zone.label, "leave it out: segment names the voxels")


def target_problems(setup: Setup, entry: Entry, target: Target) -> Iterator[Problem]:
    """Yield the reasons why a target is out of reach: not in the tissue, beyond the stroke or the lateral travel."""
    depth, lateral = target.depth_mm, target.lateral_mm
    unknown = {key: value for key, value in vars(target).items() if not isfinite(value)}
    if unknown:
        yield from (
            Problem(f"target.{key}", value, "must be a finite number") for key, value in unknown.items()
        )
        return
    if depth <= 0:
        yield Problem("target.depth_mm", depth, "must be above 0")
    elif depth > setup.max_depth:
        rule = (
            f"beyond the stroke: must be at most {setup.max_depth:g} (setup.stroke_mm - setup.tip_to_skin_mm)"
        )
        yield Problem("target.depth_mm", depth, rule)
    mover, most = "guide" if setup.has_guide else "base", setup.max_lateral
    middle, inside = entry.lateral(depth), True
    for key, value, axis, unit in (
        ("target.lateral_mm", lateral, middle.real, 1.0),
        ("target.lateral_z_mm", target.lateral_z_mm, middle.imag, 1.0j),
    ):
        steeper = [abs(entry.steepening(way * unit)) for way in (-1.0, 1.0)]
        free = [entry.free_radius_mm + slope * depth for slope in steeper]
        least, greatest = axis - most - free[0], axis + most + free[1]
        if not least - _ROUNDING_MM <= value <= greatest + _ROUNDING_MM:
            inside, rule = False, f"must be at most {most:g} in size, the lateral travel of the {mover}"
            if entry.free or middle != 0.0:
                rule = f"must be from {least:g} to {greatest:g}, in reach of the {mover} from the entry"
            yield Problem(key, value, rule)
    if entry.free and inside and depth > 0.0:
        off = complex(lateral, target.lateral_z_mm) - middle
        point, slope = entry.nearest(off, depth, most)
        left = off - point - slope * depth
        if max(abs(left.real), abs(left.imag)) > most + 1e-6:
            rule = f"no free entry brings it and target.lateral_z_mm both within {most:g} mm, in reach of the {mover}"
            yield Problem("target.lateral_mm", lateral, rule)
    if setup.axes == 1 and target.lateral_z_mm != 0.0:
        rule = "must be 0 with setup.axes = 1 (in the plane); for a needle in space set setup.axes = 2"
        yield Problem("target.lateral_z_mm", target.lateral_z_mm, rule)


def plan_problems(plan: PlanSettings) -> Iterator[Problem]:
    """Yield broken rules of the planner's settings: a covariance needs two elite samples."""
    if plan.samples * plan.elite_fraction <= 1.0 + 1e-9:
        rule = f"must leave at least 2 elite samples of plan.samples ({plan.samples})"
        yield Problem("plan.elite_fraction", plan.elite_fraction, rule)


def grid_problems(
    setup: Setup, contact: Contact, phantom: PhantomSettings, tracker: TrackerSettings
) -> Iterator[Problem]:
    """Yield spacings, steps and rates with which a run would not end."""
    smallest = setup.stroke_mm / _MOST_GRID_POINTS
    grids = {
        "setup.max_advance_mm": setup.max_advance_mm,
        "contact.spacing_mm": contact.spacing_mm,
        "phantom.contact_spacing_mm": phantom.contact_spacing_mm,
        "phantom.step_mm": phantom.step_mm,
    }
    for key, value in grids.items():
        if value < smallest:
            yield Problem(key, value, f"must be at least {smallest:g}, setup.stroke_mm / {_MOST_GRID_POINTS}")
    fastest = _MOST_READINGS_A_STEP / setup.step_time
    if tracker.rate_hz > fastest:
        rule = f"must be at most {fastest:g}, {_MOST_READINGS_A_STEP} readings in a control step"
        yield Problem("tracker.rate_hz", tracker.rate_hz, rule)
        return
    for key, travel in (
        ("guide_speed_mm_s", setup.max_guide_step_mm),
        ("base_speed_mm_s", setup.max_base_step_mm),
        ("base_turn_speed_mrad_s", setup.max_base_turn_step_mrad),
        ("rotation_speed_deg_s", _HALF_TURN_DEG),
    ):
        speed, slowest = getattr(setup, key), travel * tracker.rate_hz / _MOST_READINGS_A_STEP
        if speed is not None and speed < slowest:
            rule = f"must be at least {slowest:g}, {_MOST_READINGS_A_STEP} readings in a motion by {travel:g}"
            yield Problem(f"setup.{key}", speed, rule)


def monitor_problems(monitor: MonitorSettings, tracker: TrackerSettings) -> Iterator[Problem]:
    """Yield broken rules of the monitor: a window needs two frames, or the field would never be known."""
    least = _FRAMES_IN_A_WINDOW * tracker.period
    judged = monitor.enabled and monitor.references > 0 and tracker.environment is not None
    if judged and monitor.indicator_window_s < least:
        rule = f"must be at least {least:g}, {_FRAMES_IN_A_WINDOW} frames at tracker.rate_hz ({tracker.rate_hz:g})"
        yield Problem("monitor.indicator_window_s", monitor.indicator_window_s, rule)


def sensor_problems(
    sensors: Sequence[Sensor], tracker: TrackerSettings, needle: Needle, setup: Setup, target: Target
) -> Iterator[Problem]:
    """Yield broken rules of sensors along the needle: names, kinds of a user, and places that no needle reaches."""
    if not tracker.enabled and not sensors:
        yield Problem(
            "tracker.enabled", False, "nothing measures the needle: must be true without a [[sensor]]"
        )
    names = [sensor.title for sensor in sensors]
    for i, (sensor, name) in enumerate(zip(sensors, names, strict=True)):
        at = f"sensor.{i}"
        if name in names[:i] or name == _TRACKER:
            other = "the tracker" if name == _TRACKER else f"sensor[{names.index(name)}]"
            yield Problem(f"{at}.name", name, f"must differ from the name of {other}")
        if rule := broken_rule(sensor, setup.axes, needle.length_mm, target.depth_mm):
            yield Problem(f"{at}.kind", sensor.kind, rule)
        fastest = _MOST_READINGS_A_STEP / setup.step_time
        if sensor.rate_hz > fastest:
            rule = f"must be at most {fastest:g}, {_MOST_READINGS_A_STEP} readings in a control step"
            yield Problem(f"{at}.rate_hz", sensor.rate_hz, rule)
        yield from _place_problems(at, sensor, needle, setup)


def _place_problems(at: str, sensor: Sensor, needle: Needle, setup: Setup) -> Iterator[Problem]:
    """Yield sites beyond the needle, and images that the tip never reaches."""
    reach = f"the tip goes to {setup.max_depth:g} (setup.stroke_mm - setup.tip_to_skin_mm)"
    base = setup.start_tip_x - needle.length_mm
    start = f"the base starts at {base:g} (setup.tip_to_skin_mm, needle.length_mm)"
    if isinstance(sensor, Fbg) and sensor.sites_mm[-1] + 0.5 * sensor.gauge_mm > needle.length_mm:
        rule = f"the last gauge must end at most {needle.length_mm:g} from the tip, at needle.length_mm"
        yield Problem(f"{at}.sites_mm", sensor.sites_mm[-1], rule)
    if isinstance(sensor, Slice) and sensor.plane_mm >= setup.max_depth:
        yield Problem(f"{at}.plane_mm", sensor.plane_mm, f"is never crossed: {reach}")
    if isinstance(sensor, Slice) and sensor.plane_mm <= base:
        yield Problem(f"{at}.plane_mm", sensor.plane_mm, f"is never crossed: {start}")
    if isinstance(sensor, Range) and sensor.from_mm >= setup.max_depth:
        yield Problem(f"{at}.from_mm", sensor.from_mm, f"no needle is there: {reach}")
    if isinstance(sensor, Range) and sensor.to_mm <= base:
        yield Problem(f"{at}.to_mm", sensor.to_mm, f"no needle is there: {start}")
