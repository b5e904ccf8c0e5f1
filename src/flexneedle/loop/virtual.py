"""Virtual rigs: a phantom with the ports of a rig, from a scenario and its seeds."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexneedle.geometry.quaternion import to_matrix
from flexneedle.geometry.rigid import Rigid, fit_rigid, identity
from flexneedle.loop.events import Stream
from flexneedle.loop.rig import Rig, RigSource
from flexneedle.phantom.draw import draw
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.plants import DEFAULT_PLANT, PlantFactory, find_plant
from flexneedle.phantom.tracking.along import MeasuredNeedle, VirtualSensor
from flexneedle.phantom.tracking.field.field_tracker import FieldTracker
from flexneedle.phantom.tracking.field.poses import SensorPose, placed_references, tip_sensor_pose
from flexneedle.phantom.tracking.field.room import Room
from flexneedle.phantom.tracking.none import NoTracker
from flexneedle.phantom.tracking.simulated import NoisyTracker
from flexneedle.phantom.tracking.stage import OnStage, tilt_of
from flexneedle.plugins import find_part, function_rule
from flexneedle.ports import TipTracker
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.registration import Registration
from flexneedle.types import TIP, Lateral, Point

TipTrackerFactory = Callable[[Scenario, Phantom, np.random.Generator], TipTracker]
"""Makes a tracker of the tip, from a scenario, the phantom (tip_at, pose_at, now) and a random generator."""

SCENARIO_TRACKER = "scenario"
"""Name of the tracker that the scenario describes."""

_INCLUDED: dict[str, TipTrackerFactory | None] = {SCENARIO_TRACKER: None}
_CLEAN = 0.75  # of the indicator's limit: a reference below it is not moved


def find_tracker(given: str | TipTrackerFactory) -> tuple[str, TipTrackerFactory | None]:
    """Return the name of a tracker in records, and its factory; None for the tracker of the scenario.

    Args:
        given: `SCENARIO_TRACKER`, `module:NAME`, or a factory.

    Raises:
        InputError: There is no such tracker.
    """
    return find_part(
        "tracker", given, _INCLUDED, lambda found: function_rule(found, "scenario", "phantom", "rng")
    )


@dataclass(frozen=True)
class Seeds:
    """Seeds of a virtual rig: phantom, noise of the tracker, and the tracker's room."""

    phantom: np.random.SeedSequence
    tracker: np.random.SeedSequence
    room: np.random.SeedSequence

    @classmethod
    def of(cls, seed: int) -> "Seeds":
        """Return the seeds of the virtual rig for a seed of `insert`; the controller has its own."""
        phantom, tracker, _, room = _spawn_seeds(seed)
        return cls(phantom, tracker, room)

    @staticmethod
    def controller(seed: int) -> np.random.Generator:
        """Return the randomness of the controller in `insert` with a seed."""
        return np.random.default_rng(_spawn_seeds(seed)[2])


def _spawn_seeds(seed: int) -> list[np.random.SeedSequence]:
    """Return the seeds of phantom, tracker, controller and room."""
    return np.random.SeedSequence(seed).spawn(4)


class VirtualRig(RigSource):
    """The virtual phantom of a scenario, drawn with the seed of the insertion, and a simulated tracker.

    Args:
        phantom: "exact" or "model", the kind of plant; or `module:NAME`, or a factory (docs/extend.md).
        tracker: "scenario", the tracker that the scenario describes; or `module:NAME`, or a factory.

    Raises:
        InputError: For an unknown name or an unsuitable object.
    """

    def __init__(
        self, phantom: str | PlantFactory = DEFAULT_PLANT, tracker: str | TipTrackerFactory = SCENARIO_TRACKER
    ) -> None:
        self._phantom, self._plant = find_plant(phantom)
        self._tracker, self._factory = find_tracker(tracker)

    @property
    def names(self) -> dict[str, Any]:
        """Names of phantom and tracker in the record."""
        return {"phantom": self._phantom, "tracker": self._tracker}

    @contextmanager
    def open(self, scenario: Scenario, plan: Plan, seed: int, stream: Stream) -> Iterator[Rig]:
        """Yield the ports of a new phantom."""
        yield virtual_rig(scenario, plan.roll, Seeds.of(seed), self._plant, tracker=self._factory)


def virtual_rig(
    scenario: Scenario,
    roll: float,
    seeds: Seeds,
    plant: str | PlantFactory = DEFAULT_PLANT,
    *,
    tracker: TipTrackerFactory | None = None,
    plate_distance_at: Callable[[float], float | None] | None = None,
) -> Rig:
    """Return a virtual phantom with the ports of a rig.

    tracker: factory of the tracker (default: the tracker described by the scenario). plate_distance_at(time): distance
    (mm) of a moving metal plate from the center of the tracker's workspace (default, and None: the environment's).
    Raises InputError if the factory returns no tracker.
    """
    truth = draw(scenario, np.random.default_rng(seeds.phantom))
    phantom = Phantom(truth, roll, plant, keeps_shapes=bool(scenario.sensor))
    sensors = virtual_sensors(scenario, phantom, seeds)
    if tracker is not None or not scenario.tracker.enabled:
        own = tracker(scenario, phantom, np.random.default_rng(seeds.tracker)) if tracker else NoTracker()
        return Rig(phantom, phantom, own, phantom.condition, sensors=sensors)
    wrong = registration_error(scenario.tracker.registration, seeds.room)
    rng = np.random.default_rng(seeds.tracker)
    plate_distance = None if plate_distance_at is None else plate_distance_at(0.0)
    around = virtual_room(scenario, seeds.room, plate_distance)
    if around is None:
        described: TipTracker = _noisy_tracker(scenario, phantom, truth.bias, wrong, rng, truth.drift)
    else:
        described = _field_tracker(scenario, around, phantom, truth.bias, wrong, rng, plate_distance_at)
    return Rig(phantom, phantom, described, phantom.condition, sensors=sensors)


def virtual_sensors(scenario: Scenario, phantom: MeasuredNeedle, seeds: Seeds) -> dict[str, VirtualSensor]:
    """Return the scenario's sensors along the needle by name."""
    own = np.random.SeedSequence(entropy=seeds.tracker.entropy, spawn_key=(*seeds.tracker.spawn_key, 0))
    needle, axes, depth = scenario.needle, scenario.setup.axes, scenario.target.depth_mm
    return {
        one.title: VirtualSensor(one, phantom, axes, depth, needle.length_mm, np.random.default_rng(seed))
        for one, seed in zip(scenario.sensor, own.spawn(len(scenario.sensor)), strict=True)
    }


def virtual_room(
    scenario: Scenario, seed: np.random.SeedSequence, plate_distance: float | None = None
) -> tuple[Room, Mapping[str, SensorPose]] | None:
    """Return the tracker's room in a virtual rig of this seed, and the reference sensors in the stage's frame.

    None for a scenario without an environment. plate_distance: distance (mm) of the plate while the references are
    placed (default: the environment's).
    """
    settings = scenario.tracker
    if settings.environment is None:
        return None
    rng = np.random.default_rng(seed)
    drawn = int(rng.integers(2**62))
    room = Room(settings.environment, drawn if settings.field_seed is None else settings.field_seed)
    limit = _CLEAN * scenario.monitor.indicator_limit
    return room, placed_references(room, settings.workspace_center_mm, limit, rng, plate_distance)


def to_stage(registration: Registration | None) -> Rigid:
    """Return the map from the tracker's frame to the stage's; the identity without a registration."""
    if registration is None:
        return identity()
    return Rigid(to_matrix(np.array(registration.rotation)), np.array(registration.translation_mm))


def _noisy_tracker(
    scenario: Scenario, phantom: Phantom, bias: Point, wrong: Rigid, rng: np.random.Generator, drift: Point
) -> NoisyTracker:
    """Return the tracker with white noise, a bias and a growing error `drift` (mm), and a wrong registration."""
    lost, depth = scenario.phantom.tracker_lost_mm, scenario.target.depth_mm

    def tip_at(time: float) -> Point:
        tip = phantom.tip_at(time)
        if any(drift):
            grown = max(0.0, tip[0]) / depth
            tip = tip[0] + grown * drift[0], tip[1] + grown * drift[1], tip[2] + grown * drift[2]
        if scenario.tracker.registration is None:
            return tip
        x, y, z = wrong.apply(np.array(tip)).tolist()
        return x, y, z

    def direction_at(time: float) -> Lateral:
        pose = phantom.pose_at(time)
        if scenario.tracker.registration is None:
            return pose.theta, pose.psi
        return tilt_of(wrong.rotation @ np.array(pose.axis))

    jitter = scenario.tracker.direction_jitter
    return NoisyTracker(
        tip_at,
        phantom,
        scenario.tracker.period,
        scenario.tracker.jitter_per_axis,
        rng,
        delay=_delay(scenario),
        missing=scenario.phantom.missing_fraction,
        bias=bias,
        axes=scenario.setup.axes,
        direction_at=None if jitter is None else direction_at,
        direction_jitter=jitter or 0.0,
        lost_at=None if lost is None else lambda time: phantom.tip_at(time)[0] >= lost,
    )


def _field_tracker(
    scenario: Scenario,
    around: tuple[Room, Mapping[str, SensorPose]],
    phantom: Phantom,
    bias: Point,
    wrong: Rigid,
    rng: np.random.Generator,
    plate_distance_at: Callable[[float], float | None] | None,
) -> OnStage:
    """Return the tracker in its environment; around: room and references."""
    (room, references), settings = around, scenario.tracker
    center, offset = settings.workspace_center_mm, settings.tip_offset_mm
    registered = to_stage(settings.registration)

    def poses_at(time: float) -> Mapping[str, SensorPose]:
        pose = phantom.pose_at(time)
        x, y, z = (value + off for value, off in zip(pose.point, bias, strict=True))
        return {
            TIP: tip_sensor_pose((x, y, z), pose.axis, offset),
            **references,
        }

    tracker = FieldTracker(
        room,
        poses_at,
        phantom,
        settings.period,
        rng,
        center=center,
        delay=_delay(scenario),
        ahead=scenario.monitor.indicator_window_s,  # so that the field is known at the start
        missing=scenario.phantom.missing_fraction,
        to_tracker=registered.inverse().after(wrong),
        plate_distance_at=plate_distance_at,
    )
    return OnStage(tracker, registered, offset)


def _delay(scenario: Scenario) -> float:
    """Return the age (s) of a reading on arrival: `delay_periods` control periods at full step and speed."""
    step = scenario.setup.max_advance_mm / scenario.setup.insertion_speed_mm_s
    return scenario.phantom.delay_periods * step


def registration_error(registration: Registration | None, seed: np.random.SeedSequence) -> Rigid:
    """Return the error of a registration, drawn from its fiducials and their localisation error."""
    if registration is None or registration.localisation_mm == 0.0:
        return identity()
    rng = np.random.default_rng(seed).spawn(1)[0]
    fiducials = np.array(registration.fiducials_mm)
    noise = rng.normal(0.0, registration.localisation_mm / math.sqrt(3.0), fiducials.shape)
    return fit_rigid(fiducials + noise, fiducials)
