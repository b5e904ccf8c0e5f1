"""Start of an insertion: limits of the axes and of the tip's pose, so that nothing moves from elsewhere.

Base and guide are mounted on the needle's axis: there their lateral axes are at 0. The insertion axis starts anywhere,
the tip before the skin; the rotation is rolled to the plan's angle before the insertion. Pure functions.
"""

import math
from dataclasses import dataclass

from flexneedle.estimation.prior import Priors
from flexneedle.geometry.rigid import expected_error
from flexneedle.lab.rig.rig_axes import LINEAR_AXES, Axis
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.scenario.model import Scenario
from flexneedle.types import Lateral, Pose

SDS = 3.0
"""Standard deviations by which a start may be off."""
_FAR = 1e6  # mm, where the error of a registration is its rotation's
_MOUNT = "check the mount of the needle, or register the tracker again"


def axis_start_problem(rig: RigFile, name: str, axis: Axis, position: float) -> str:
    """Return the problem of a lateral axis that does not rest at 0, or ""; position: mm.

    It may be off by its uncertainty, as after a motion to 0. The remedy refuses to bend a needle in tissue; a jog does
    not.
    """
    if name not in LINEAR_AXES[1:] or abs(position) <= axis.uncertainty:
        return ""
    return f"must be within {axis.to_text(axis.uncertainty)} mm of 0, on the needle's axis: {_ready(rig)}"


def _ready(rig: RigFile) -> str:
    return f"flexneedle rig ready {rig.source} --scenario SCENARIO"


def air_margin(scenario: Scenario) -> float:
    """Return the distance (mm) before the skin within which a tip may be in tissue."""
    return min(SDS * scenario.control.start_axial_sd_mm, -0.5 * scenario.setup.start_tip_x)


def withdrawal(rig: RigFile) -> str:
    """Return what to do about a tip that may be in tissue."""
    remedy = f"withdraw it first: flexneedle rig retract {rig.source}"
    return f"{remedy}; or, in air, register the tracker again ([registration])"


def with_registration(rig: RigFile, scenario: Scenario) -> Scenario:
    """Return the scenario with the registration of the rig file, if it has one."""
    if rig.registration is None:
        return scenario
    return scenario.with_values({"tracker.registration": rig.registration.model_dump(mode="json")})


@dataclass(frozen=True)
class _Mount:
    """Effect of a base that is off the axis, by Euler–Bernoulli's beam between clamp and guide.

    offset: tip (mm) per mm of the base, turn: tip (mm) per rad; slopes of the tip: rad per mm and rad per rad; guide:
    tip (mm) per mm of the guide.
    """

    offset: float
    turn: float
    offset_slope: float
    turn_slope: float
    guide: float = 0.0

    @classmethod
    def of(cls, scenario: Scenario) -> "_Mount":
        """Return the effect for the needle before the skin."""
        guide, tip = scenario.setup.guide_x, scenario.setup.start_tip_x
        if guide is None:
            return cls(1.0, scenario.needle.length_mm, 0.0, 1.0)
        span, free = guide - scenario.start_base_x, tip - guide
        return cls(1.5 * free / span, 0.5 * free, 1.5 / span, 0.5, 1.0 + 1.5 * free / span)


@dataclass(frozen=True)
class StartLimits:
    """Largest deviations of the tip from the scenario's start: x, y, z (mm); slopes dy/dx, dz/dx (rad)."""

    axial: float
    lateral: Lateral
    slope: Lateral

    @classmethod
    def of(cls, scenario: Scenario, roll: float = 0.0) -> "StartLimits":
        """Return the limits for a needle that is rolled by `roll` (rad).

        Each is three standard deviations of mount, tracker and registration, and what a straight needle lacks: the
        natural bend, the run-out, the clearance in the guide, the bias of the tracker, and half of the diameter.
        """
        control, phantom, tracker = scenario.control, scenario.phantom, scenario.tracker
        mount, entry, length = _Mount.of(scenario), scenario.entry, scenario.needle.length_mm
        error, turn = _measurement_sds(scenario)
        constant = phantom.tracker_bias_mm + 0.5 * scenario.needle.outer_diameter
        constant += phantom.guide_clearance_mm * mount.guide
        constant += entry.free_radius_mm + 1e-3 * entry.free_slope_mrad * scenario.setup.tip_to_skin_mm
        tilt = math.hypot(turn, tracker.direction_jitter or 0.0, _sensor_tilt(scenario))
        lateral, slope = list[float](), list[float]()
        for (offset, angle), share in zip(_mount_sds(scenario), _bend_shares(scenario, roll), strict=True):
            sd = math.hypot(mount.offset * offset, mount.turn * angle, error)
            lateral.append(SDS * sd + constant + share * (phantom.initial_bend_mm + 0.5 * phantom.run_out_mm))
            sd = math.hypot(mount.offset_slope * offset, mount.turn_slope * angle, tilt)
            bend = share * 2.0 * phantom.initial_bend_mm / length  # of a parabola
            slope.append(SDS * sd + bend + 1e-3 * entry.free_slope_mrad)
        axial = SDS * math.hypot(max(control.start_axial_sd_mm, phantom.start_axial_sd_mm), error)
        return cls(axial + phantom.tracker_bias_mm, (lateral[0], lateral[1]), (slope[0], slope[1]))


def _mount_sds(scenario: Scenario) -> tuple[Lateral, Lateral]:
    """Return standard deviations of the base's offset (mm) and slope (rad) along y and z.

    In the plane a controller does not correct z: there it has the phantom's, 0 if they are not set.
    """
    control, phantom = scenario.control, scenario.phantom
    y = (
        max(control.start_offset_sd_mm, phantom.start_offset_sd_mm),
        max(control.start_angle_sd, phantom.start_angle_sd),
    )
    plane = y if scenario.setup.axes == 2 else (0.0, 0.0)
    z = phantom.start_offset_z_sd_mm, phantom.start_angle_z_sd_mrad
    return y, (
        plane[0] if z[0] is None else max(plane[0], z[0]),
        plane[1] if z[1] is None else max(plane[1], 1e-3 * z[1]),
    )


def _bend_shares(scenario: Scenario, roll: float) -> Lateral:
    """Return the largest shares of bend and run-out along y and z: in the plane, z has those that the roll turns."""
    spread = scenario.phantom.direction_spread_deg
    if scenario.setup.axes == 2 and spread is None:
        return 1.0, 1.0
    out = abs(math.remainder(roll, math.pi)) + math.radians(spread or 0.0)
    return 1.0, math.sin(min(out, 0.5 * math.pi))


def _measurement_sds(scenario: Scenario) -> Lateral:
    """Return standard deviations of a measured coordinate (mm) and slope (rad), by tracker and registration."""
    tracker = scenario.tracker
    field, plate, turn = tracker.jitter_mm, 0.0, 0.0
    if (around := tracker.environment) is not None:
        plate = 0.0 if around.plate is None else around.plate.tip_mm
        bias = math.hypot(around.tip.bias_mm, plate)
        field, turn = math.hypot(around.tip.jitter_mm, bias), 1e-3 * around.tilt_mrad_per_mm * bias
    if (registration := tracker.registration) is None:
        return field / math.sqrt(3.0), turn
    at = scenario.entry.lateral(scenario.setup.start_tip_x)
    error = expected_error(registration, (scenario.setup.start_tip_x, at.real, at.imag))
    turned = expected_error(registration, (_FAR, 0.0, 0.0)) / _FAR
    return math.hypot(field, error) / math.sqrt(3.0), math.hypot(turn, turned)


def _sensor_tilt(scenario: Scenario) -> float:
    """Return the standard deviation (rad) of the angle between a sensor and its needle."""
    given = scenario.control.tables.get("adaptive_mpc", {})
    return 1e-3 * float(given.get("tilt_sd_mrad", Priors().tilt_sd_mrad))


def tip_problems(rig: RigFile, scenario: Scenario, tip: Pose, roll: float = 0.0) -> list[str]:
    """Return lines for a measured tip that is not at the scenario's start; slopes that are not known are NaN.

    roll: of the needle (rad). The scenario has the registration of the rig.
    """
    limits, entry = StartLimits.of(scenario, roll), scenario.entry
    at, slope = entry.lateral(tip.x), entry.slope
    places = [
        ("x", tip.x, scenario.setup.start_tip_x, limits.axial),
        ("y", tip.y, at.real, limits.lateral[0]),
        ("z", tip.z, at.imag, limits.lateral[1]),
    ]
    slopes = [
        ("dy/dx", 1e3 * tip.theta, 1e3 * slope.real, 1e3 * limits.slope[0]),
        ("dz/dx", 1e3 * tip.psi, 1e3 * slope.imag, 1e3 * limits.slope[1]),
    ]
    along, mount = f"{_ready(rig)} (setup.tip_to_skin_mm)", f"{_ready(rig)}, {_MOUNT}"
    if tip.x > -air_margin(scenario):
        along = mount = withdrawal(rig)
    found = [
        f"{name} must be within {limit:.1f} mm of {start:.1f}: {along if name == 'x' else mount}"
        for name, value, start, limit in places
        if not abs(value - start) <= limit
    ]
    known = [one for one in slopes if not math.isnan(one[1])]
    return found + [
        f"{name} = {value:.0f} mrad: must be within {limit:.0f} of {start:.0f}, the needle's axis: {mount}"
        for name, value, start, limit in known
        if not abs(value - start) <= limit
    ]
