"""What the closed loop moves and sees: a rig, and the virtual one that a scenario and its seeds make."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from flexneedle.phantom import DEFAULT_PLANT, Condition, Phantom, draw
from flexneedle.ports import Clock, Driver, TipTracker
from flexneedle.scenario import Registration, Scenario
from flexneedle.scenario.environment import Environment
from flexneedle.tracking import NoisyTracker
from flexneedle.tracking.field import FieldTracker, Pose, Room, tip_sensor_pose
from flexneedle.tracking.placement import placed_references
from flexneedle.tracking.plane import InPlane
from flexneedle.tracking.quaternion import to_matrix
from flexneedle.tracking.registration import Rigid, fit_rigid, identity
from flexneedle.tracking.table import TIP

__all__ = ["Rig", "Seeds", "to_stage", "virtual_rig"]

_PLACED = 0.75  # of the threshold: below it a lab leaves a reference where it is


@dataclass(frozen=True)
class Rig:
    """What the closed loop moves and sees; `truth` is for the record alone, None on hardware."""

    clock: Clock
    driver: Driver
    tracker: TipTracker
    truth: Callable[[], Condition] | None = None


@dataclass(frozen=True)
class Seeds:
    """Where the randomness of a virtual rig comes from: what stands in the tank, the noise, the tracker's room."""

    phantom: np.random.SeedSequence
    tracker: np.random.SeedSequence
    room: np.random.SeedSequence


def virtual_rig(
    scenario: Scenario,
    bevel: int,
    seeds: Seeds,
    phantom: str = DEFAULT_PLANT,
    *,
    plate_distance_at: Callable[[float], float] | None = None,
) -> Rig:
    """Return a virtual phantom behind the same ports as a rig.

    plate_distance_at(time): how far a metal plate is from the middle of the tracker's workspace (mm), for one that
    moves; left out, it is the environment's.
    """
    truth = draw(scenario, np.random.default_rng(seeds.phantom))
    tank = Phantom(truth, bevel, phantom)
    step = scenario.setup.max_advance_mm / scenario.setup.insertion_speed_mm_s
    delay, missing = scenario.phantom.delay_periods * step, scenario.phantom.missing_fraction
    rng, settings = np.random.default_rng(seeds.tracker), scenario.tracker
    if settings.environment is not None:
        tracker: TipTracker = _field_tracker(
            scenario, settings.environment, tank, truth.bias, delay, rng, seeds.room, plate_distance_at
        )
    else:
        tracker = NoisyTracker(
            tank.tip_at,
            tank,
            settings.period,
            settings.jitter_per_axis,
            rng,
            delay=delay,
            missing=missing,
            bias=truth.bias,
        )
    return Rig(tank, tank, tracker, tank.condition)


def to_stage(registration: Registration | None) -> Rigid:
    """Return the map from the tracker's frame to the stage's; without a registration they are one."""
    if registration is None:
        return identity()
    return Rigid(to_matrix(np.array(registration.rotation)), np.array(registration.translation_mm))


def _field_tracker(
    scenario: Scenario,
    environment: Environment,
    tank: Phantom,
    bias: tuple[float, float],
    delay: float,
    rng: np.random.Generator,
    room_seed: np.random.SeedSequence,
    plate_distance_at: Callable[[float], float] | None,
) -> InPlane:
    """The tracker in its environment: room, references and error of the registration as the seed draws them."""
    settings, room_rng = scenario.tracker, np.random.default_rng(room_seed)
    drawn = int(room_rng.integers(2**62))
    room = Room(environment, drawn if settings.field_seed is None else settings.field_seed)
    center, offset = settings.workspace_center_mm, settings.tip_offset_mm
    references = placed_references(room, center, _PLACED * scenario.monitor.indicator_limit, room_rng)
    registered = to_stage(settings.registration)

    def poses_at(time: float) -> Mapping[str, Pose]:
        x, y, turn = tank.pose_at(time)
        tip = x + bias[0], y + bias[1], 0.0
        return {TIP: tip_sensor_pose(tip, (math.cos(turn), math.sin(turn), 0.0), offset), **references}

    tracker = FieldTracker(
        room,
        poses_at,
        tank,
        settings.period,
        rng,
        center=center,
        delay=delay,
        missing=scenario.phantom.missing_fraction,
        to_tracker=registered.inverse().after(_registration_error(settings.registration, room_rng)),
        plate_distance_at=plate_distance_at,
    )
    return InPlane(tracker, registered, offset)


def _registration_error(registration: Registration | None, rng: np.random.Generator) -> Rigid:
    """By how much a registration from such fiducials, measured so well, is off the truth."""
    if registration is None or registration.localisation_mm == 0.0:
        return identity()
    fiducials = np.array(registration.fiducials_mm)
    noise = rng.normal(0.0, registration.localisation_mm / math.sqrt(3.0), fiducials.shape)
    return fit_rigid(fiducials + noise, fiducials)
