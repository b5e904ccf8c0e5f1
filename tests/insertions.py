"""Insertions for tests: phantoms with modified and recorded trackers, and replays without a phantom."""

import dataclasses
import itertools
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.loop import closed_loop
from flexneedle.loop.choices import Choices
from flexneedle.loop.events import Gate, PeriodEnded, Stream
from flexneedle.loop.insertions import prepare
from flexneedle.loop.rig import Rig
from flexneedle.phantom.draw import draw
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.tracking.simulated import NoisyTracker
from flexneedle.planning.origin import with_planned_entry
from flexneedle.types import STILL, VISIBLE, Measurement, Motion

PHANTOM = flexneedle.load_scenario("phantom")
READING = PHANTOM.tracker.period
HELD, RESTING = "held: measurement missing: tip not measured", "waiting for the last reading"


class RecordedPhantom:
    """A phantom with recorded driver calls, and a tracker with modified and recorded batches."""

    status = VISIBLE

    def __init__(self, roll, seed=2000, spoil=lambda batch: batch, scenario=PHANTOM, delay=0.0):
        self.phantom = Phantom(draw(scenario, np.random.default_rng(seed)), roll)
        self.spoil, self.tape, self.moves, self.applied = spoil, [], [], []
        noise = np.random.default_rng(seed + 1)
        jitter = scenario.tracker.jitter_per_axis
        self.tracker = NoisyTracker(
            self.phantom.tip_at, self.phantom, scenario.tracker.period, jitter, noise, delay=delay
        )

    def read(self):
        if self.phantom.now() == 0.0:
            return self.tracker.read()  # the first reading, before the first motion
        self.tape.append(self.spoil(self.tracker.read()))
        return self.tape[-1]

    def apply(self, command, duration):
        self.moves.append((self.phantom.now(), command))
        motion = self.phantom.apply(command, duration)
        self.applied.append(motion.control)
        return motion

    def stop(self):
        self.phantom.stop()

    def rig(self):
        return Rig(self.phantom, self, self, self.phantom.condition)


class TapedRig:
    """No phantom: a clock, and a driver and a tracker that replay recordings; then commands are applied exactly."""

    status = VISIBLE

    def __init__(self, tape, applied=()):
        first = (Measurement(0.0, -28.5, 0.0),)  # where the needle starts
        self.time, self.tape, self.applied = 0.0, itertools.chain([first], tape), iter(applied)

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds

    def apply(self, command, duration):
        begun, self.time = self.time, self.time + duration
        return Motion(next(self.applied, command), begun, self.time)

    def stop(self):
        """Nothing moves between commands."""

    def read(self):
        return next(self.tape)

    def rig(self):
        return Rig(self, self, self)


def run(plan, rig, scenario=PHANTOM, *, controller="resolved-rate", listeners=(), gate=None, **choices):
    """Carry out a plan on the ports of a rig, with a controller that decides three times as fast as the default."""
    scenario, stream = flexneedle.load_scenario(scenario), Stream(tuple(listeners), gate or Gate())
    chosen = Choices.of(5, controller, rig, **choices)
    steering = prepare(with_planned_entry(scenario, plan), plan, chosen, stream)
    return closed_loop.run(replace(steering, rng=np.random.default_rng(5)), rig)


def on_period(listener):
    """Return a listener that is called with the periods alone."""
    return lambda event: listener(event.period) if isinstance(event, PeriodEnded) else None


def of_any_scenario(plan):
    """The plan without its scenario, so that it is valid for any."""
    return replace(plan, scenario=None)


class Enough(Exception):
    """The remaining periods are not needed."""


def first_periods(count, plan, rig, scenario=PHANTOM, **options):
    """The first periods of an insertion, which is then interrupted."""
    periods = []

    def watch(period):
        periods.append(period)
        if len(periods) == count:
            raise Enough

    with pytest.raises(Enough):
        run(plan, rig, scenario, listeners=[on_period(watch)], **options)
    return periods


def facts(period):
    """All values of a period except wall-clock durations, in comparable form."""
    names = [field.name for field in dataclasses.fields(period) if field.name != "durations"]
    values = {name: getattr(period, name) for name in names}
    return {k: repr(v) if not isinstance(v, np.ndarray) else v.tobytes() for k, v in values.items()}


def acted(period):
    """All values of a period except its readings."""
    return {name: value for name, value in facts(period).items() if name != "readings"}


def commanded_and_estimated(period):
    """Commands and estimates of a period, without the true state."""
    return {name: value for name, value in facts(period).items() if not name.startswith("true_")}


def moving(done):
    """The periods with a motion: without rests and holds."""
    return [period for period in done.periods if period.command != STILL]


def lost(_measurement):
    return None


def blind(measurement):
    return replace(measurement, x=None, y=None)


def spoilt_tape(tape, which, fault):
    """The tape with one reading of every batch modified or removed."""
    changed = []
    for batch in tape:
        readings = list(batch)
        if len(readings) > 2:
            bad = fault(readings[which])
            readings[which : which + 1 or None] = [] if bad is None else [bad]
        changed.append(tuple(readings))
    return changed


def loop(tape):
    """The tape, then its last batch repeatedly."""
    yield from tape
    while True:
        yield tape[-1]
