"""Random frames to the supervisor's check: a verdict, not OK if the newest reading is invalid, repeated or stale.

The part `watch` of `fuzz_aurora.py`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from random import Random

import numpy as np

from flexneedle.geometry.quaternion import to_matrix
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.rig.supervisor.protocol import Expectation
from flexneedle.lab.rig.supervisor.tip_watch import TipWatch
from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.phantom.tracking.stage import tip_on_stage
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import VISIBLE, Frame, Measurement, SensorReading
from fuzzing import ODD, Failure

STALE_S, MOST_OFF_MM = 0.25, 3.0


def watch_inputs(random: Random) -> Iterator[str]:
    """Check the frames of one tick after another, by a watch that lasts for some hundred."""
    while True:
        turn = np.array([random.gauss(0, 1) for _ in range(4)])
        to_stage = Rigid(to_matrix(turn), np.array([random.uniform(-100, 100) for _ in range(3)]))
        monitor = Monitor(MonitorSettings(enabled=random.random() < 0.8), random.choice((1, 2)))
        watching = Watching(TipWatch(monitor, STALE_S, 0.0), to_stage, random.choice((0.0, 0.0, 7.5)))
        for _ in range(random.randint(1, 300)):
            check_tick(watching, random)
            yield ""


@dataclass
class Watching:
    """A watch, the map to the stage, the time, and the number of the last frame that was not rejected at once."""

    watch: TipWatch
    to_stage: Rigid
    tip_offset: float
    now: float = 10.0
    sent: int = 0
    accepted: float = -math.inf


def check_tick(watching: Watching, random: Random) -> None:
    """Check the frames of a tick. Raises Failure."""
    watching.now += random.choice((0.025, 0.025, 0.025, 0.0, 0.4))
    if random.random() < 0.1:
        begin, end = ((random.uniform(0, 9), 0.0, 0.0) for _ in range(2))
        most_off = random.choice((MOST_OFF_MM, 1e4, math.inf))
        expected = Expectation(begin, end, most_off)
        watching.watch = watching.watch.with_expectation(
            expected, watching.now, watching.now + random.choice((0.0, 1.0))
        )
    frames = [random_tip_frame(random, watching) for _ in range(random.choice((0, 1, 1, 1, 1, 2, 5)))]
    try:
        with np.errstate(all="ignore"):  # not a number in, not a number out
            found = tuple(tip_on_stage(frame, watching.to_stage, watching.tip_offset) for frame in frames)
        watching.watch = watching.watch.with_readings(
            found, watching.now, random.choice((VISIBLE, "no reply"))
        )
    except Exception as error:
        raise Failure(f"{frames} at {watching.now}: {error!r}") from error
    check_verdict(watching, found)


def check_verdict(watching: Watching, found: tuple[Measurement, ...]) -> None:
    """Raise Failure if the verdict is OK, and the newest reading is not a number, repeated or stale."""
    bad = ""
    for one in found:
        bad = fault_of(one, watching)
        if not bad and one.frame is not None:
            watching.accepted = one.frame.number
    if bad and watching.watch.verdict.ok:
        raise Failure(f"{bad}: {found[-1]} at {watching.now} s is {watching.watch.verdict}")
    if len(watching.watch.monitor.recent) > 5000:
        raise Failure(f"{len(watching.watch.monitor.recent)} readings kept")


def fault_of(one: Measurement, watching: Watching) -> str:
    """Return why a reading must not be used, by its numbers alone, or ""."""
    values = [value for value in (one.time, one.x, one.y, one.z, *(one.direction or ())) if value is not None]
    if not all(map(math.isfinite, values)):
        return "not a number"
    if abs(watching.now - one.time) > STALE_S + 1e-9:
        return "stale"
    return "repeated" if one.frame is not None and one.frame.number <= watching.accepted else ""


def random_tip_frame(random: Random, watching: Watching) -> Frame:
    """A frame, most of them the next one."""
    watching.sent += random.choice(
        (1, 1, 1, 1, 1, 0, -1, 1000, -1000, 2**40) if random.random() < 0.3 else (1,)
    )
    late = random.choice((0.0, 0.1, 0.3, -0.01, -0.3, -5.0, math.nan, math.inf, -math.inf, 1e300))
    time = watching.now - (late if random.random() < 0.2 else random.uniform(0.0, 0.03))
    names = random.choice((("tip", "ref1", "ref2", "ref3"), ("tip",), ("ref1",), (), ("tip", "ref1")))
    return Frame(time, watching.sent, {name: random_reading(random) for name in names})


def random_reading(random: Random) -> SensorReading:
    """A reading, with odd numbers as another tracker's driver may give them."""
    odd = random.random() < 0.15
    drawn = [random.choice(ODD) if odd and random.random() < 0.4 else random.uniform(-1, 1) for _ in range(8)]
    place = None if random.random() < 0.1 else (drawn[0], drawn[1], drawn[2])
    turn = None if random.random() < 0.2 else (drawn[3], drawn[4], drawn[5], drawn[6])
    status = VISIBLE if random.random() < 0.9 else random.choice(("missing", "", "é\n"))
    return SensorReading(place, turn, random.choice((None, 0.02, 0.2, drawn[7])), status)
