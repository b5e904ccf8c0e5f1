"""Run of the motions in air on the ports of a rig."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

from flexneedle.errors import DriverError, RunError
from flexneedle.estimation.moves import Move
from flexneedle.lab.rig.preflight.start import air_margin
from flexneedle.lab.rig.sensor_check.motions import REST_S
from flexneedle.loop.rig import Rig
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.control import ROUNDING_S, travel_time
from flexneedle.types import STILL, Control, Measurement, Motion, Reading

_FIRST = 10  # readings of the tip at rest, before it advances
_LATE_S = 0.5  # for which the last readings are awaited, beside their delay


@dataclass(frozen=True)
class AirRun:
    """Moves as carried out, readings of the tracker, and readings of the sensors by name."""

    moves: tuple[Move, ...]
    measurements: tuple[Measurement, ...]
    readings: dict[str, tuple[Reading, ...]]


def run_in_air(
    scenario: Scenario,
    rig: Rig,
    motions: Sequence[Control],
    show: Callable[[int, int], object] = lambda _done, _count: None,
) -> AirRun:
    """Carry out motions; the driver is stopped at their end and after any error.

    show: called after each motion with the number of those done, and of all.

    Raises RunError if the tip comes near the skin or is no longer measured, DriverError if a motion is not completed.
    """
    moves, measurements = list[Move](), list[Measurement]()
    readings: dict[str, list[Reading]] = {one.title: [] for one in scenario.sensor}

    def read() -> None:
        found = [one for one in rig.tracker.read() if one.x is not None and one.y is not None]
        measurements.extend(found)
        for name, sensor in rig.sensors.items():
            readings[name] += sensor.read()

    try:
        read()
        for done, planned in enumerate(motions, 1):
            # Motors of whole steps have advanced a little less, and may not withdraw beyond the start.
            advanced = sum(one.applied.db_x for one in moves)
            ahead = min(max(planned.db_x, -advanced), max(0.0, _room(scenario, measurements) - advanced))
            motion = _carry_out(scenario, rig, planned._replace(db_x=ahead))
            if motion.held:
                raise DriverError(f"the motion was ended: {motion.held}")
            moves.extend(Move.parts_of(motion))
            read()
            _require_air(scenario, measurements, rig.clock.now())
            show(done, len(motions))
        late = _LATE_S + max((one.delay_s for one in scenario.sensor), default=0.0)
        moves.append(Move.of(_rest(rig, late)))
        read()
    finally:
        rig.driver.stop()
    return AirRun(tuple(moves), tuple(measurements), {name: tuple(each) for name, each in readings.items()})


def _carry_out(scenario: Scenario, rig: Rig, command: Control) -> Motion:
    """Move, in the time of the slowest axis rounded up to whole tracker periods; or rest."""
    if command == STILL:
        return _rest(rig, REST_S)
    period = scenario.tracker.period
    count = math.ceil((travel_time(scenario.setup, command) - ROUNDING_S) / period)
    return rig.driver.apply(command, max(1, count) * period)


def _rest(rig: Rig, seconds: float) -> Motion:
    begun = rig.clock.now()
    rig.clock.wait(seconds)
    return Motion(STILL, begun, rig.clock.now())


def _room(scenario: Scenario, measurements: Sequence[Measurement]) -> float:
    """Return the distance (mm) from the first measured tip to the margin before the skin; infinite without any."""
    first = [one.x for one in measurements[:_FIRST] if one.x is not None]
    return -median(first) - air_margin(scenario) if first else math.inf


def _require_air(scenario: Scenario, measurements: Sequence[Measurement], now: float) -> None:
    """Require that the tracker measured the tip lately, before the skin by half of the margin."""
    if not scenario.tracker.enabled:
        return
    limit = scenario.control.hold_limit_s
    newest = measurements[-1] if measurements else None
    if newest is None or newest.x is None or now - newest.time > limit:
        raise RunError(f"tip: not measured for {limit:g} s: stopped")
    if newest.x > -0.5 * air_margin(scenario):
        raise RunError(f"tip: {-newest.x:.1f} mm before the skin: stopped; set setup.tip_to_skin_mm")
