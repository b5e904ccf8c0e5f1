"""The closed loop on a real clock, with an Aurora that is emulated in a process of its own and falls silent."""

import numpy as np

import flexneedle
from emulated import emulated, read_until
from flexneedle.devices.aurora import Aurora
from flexneedle.devices.clock import WallClock
from flexneedle.run.insertion import run
from flexneedle.run.rig import Rig, to_stage
from flexneedle.tracking.plane import InPlane

STILL = (0.0, 0.0, 0.0, 0.0, -1)
# The emulated tip moves on its own: all that asks for a needle's place is out of the way here.
ANYWHERE = {
    "control.innovation_limit_mm": 1e4,
    "monitor.speed_limit_mm_s": 1e4,
    "monitor.out_of_plane_limit_mm": 1e4,
    "control.hold_limit_s": 0.4,
}


class Motors:
    """A driver that takes its time and does what it is told."""

    def __init__(self, clock):
        self.clock = clock

    def apply(self, command, duration):
        self.clock.wait(duration)
        return command


def test_frames_move_the_needle_and_silence_holds_it():
    scenario = flexneedle.load_scenario("phantom").with_values(ANYWHERE)
    plan = flexneedle.plan(scenario, (40.0, 5.0), seed=0)
    clock = WallClock()
    with emulated("--fault", "silence@5:60") as path, Aurora(path, clock) as tracker:
        read_until(tracker, lambda frames: frames and all(r.position for r in frames[-1].readings.values()))
        read_until(tracker, lambda frames: len(frames) >= 40)
        tip = InPlane(tracker, to_stage(None))
        done = run(scenario, plan, Rig(clock, Motors(clock), tip), np.random.default_rng(0))
    assert done.outcome == "held"
    assert done.reason.endswith("(limit 0.4 s): missing: no reading")
    good = [period for period in done.periods if period.verdict == "ok"]
    moved = [period for period in good if period.applied != STILL]
    seen = [period for period in moved if period.readings]
    assert seen
    assert set(seen[-1].readings[-1].sample.frame.readings) == {"tip", "ref1", "ref2", "ref3"}
    last = done.periods[-1].time
    assert all(period.applied == STILL for period in done.periods if period.time > last - 0.35)
    numbers = [one.sample.frame.number for period in done.periods for one in period.readings]
    assert numbers == sorted(set(numbers))
