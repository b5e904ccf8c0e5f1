"""What the page's worker takes and sends: signals, pace, and an outbox that nobody waits for."""

import io
import json
import math
from threading import Event

import numpy as np
import pytest

from flexneedle.errors import StoppedError
from flexneedle.lab.page import channel
from flexneedle.lab.page.frames import Kind, Source, frame_of, unpacked
from flexneedle.lab.page.messages import Disturb, Job, People, Rows, Runs
from flexneedle.lab.page.orders import Signal, Work
from flexneedle.lab.page.worker.inbox import Inbox
from flexneedle.lab.page.worker.outbox import Outbox
from flexneedle.lab.page.worker.pace import Pacer
from flexneedle.lab.page.worker.signals import Cancelled, Signals
from page_clients import PATIENCE_S


class Pipe:
    """A pipe whose reader waits until it is opened."""

    def __init__(self):
        self.opened, self.entered, self.data = Event(), Event(), io.BytesIO()

    def write(self, data):
        self.entered.set()
        assert self.opened.wait(PATIENCE_S)
        self.data.write(data)

    def messages(self):
        self.data.seek(0)
        while (message := channel.read(self.data)) is not None:
            yield json.loads(message) if isinstance(message, str) else unpacked(message)


ROW = {
    "index": 0,
    "time": 0.0,
    "action": "move",
    "decision": "",
    "verdict": "ok",
    "measured": None,
    "estimate": (0.0, 0.0, 0.0),
    **dict.fromkeys(("true", "error_mm", "indicator", "true_energy_mj", "miss_sd_mm")),
    "guide": (0.0, 0.0),
    "roll_deg": 0.0,
    "energy_mj": 0.0,
    "miss_mm": (None, math.nan),
    "decide_ms": 0.0,
    "late": False,
}


def rows(first, count):
    return Rows(of="live", first=first, rows=[ROW | {"index": first + k} for k in range(count)])


def job(state):
    return Job(job=1, kind="plan", state=state)


@pytest.fixture
def pipe():
    return Pipe()


@pytest.fixture
def outbox(pipe):
    """An outbox whose thread waits to write its first message."""
    outbox = Outbox(pipe.write)
    outbox.put(Runs(runs=[]))
    assert pipe.entered.wait(PATIENCE_S)
    return outbox


def sent(outbox, pipe):
    pipe.opened.set()
    outbox.flush()
    return list(pipe.messages())[1:]


def test_the_newest_of_each_key_is_sent(outbox, pipe):
    for count in range(1000):
        outbox.put(People(clients=count, steering=None))
        outbox.show(frame_of(Kind.SAMPLES, Source.LIVE, count, [[0.0, 0.0, 0.0]]))
    people, frame = sent(outbox, pipe)
    assert people["clients"] == frame.number == 999


def test_no_shape_of_a_period_is_lost(outbox, pipe):
    for number in (0, 1, 3):
        outbox.show(frame_of(Kind.NEEDLE, Source.LIVE, number, [[number, 0.0, 0.0]]))
        outbox.show(frame_of(Kind.NEEDLE, Source.SCENE, number, [[number, 0.0, 0.0]]))
    live, scene = sent(outbox, pipe)
    np.testing.assert_array_equal(live.values[:, 0, 0], [0.0, 1.0, np.nan, 3.0])
    assert (live.number, scene.number, len(scene.values)) == (0, 3, 1)


def test_no_row_is_lost_and_a_new_insertion_begins_again(outbox, pipe):
    for first in range(5):
        outbox.put(rows(first, 1))
    (news,) = sent(outbox, pipe)
    assert (news["first"], [row["index"] for row in news["rows"]]) == (0, [0, 1, 2, 3, 4])
    assert news["rows"][0]["miss_mm"] == [None, None]
    outbox.put(rows(5, 2))
    outbox.put(rows(0, 1))
    outbox.flush()
    first = [(one["first"], len(one["rows"])) for one in list(pipe.messages())[2:]]
    assert first in ([(0, 1)], [(5, 2), (0, 1)])


def test_the_end_of_a_job_is_sent_after_its_results(outbox, pipe):
    outbox.put(job("running"))
    outbox.put(People(clients=1, steering=None))
    outbox.put(job("done"))
    assert [one["type"] for one in sent(outbox, pipe)] == ["people", "job"]


def test_nobody_waits_for_a_server_that_is_gone():
    def write(_data):
        raise BrokenPipeError

    outbox = Outbox(write)
    outbox.put(Runs(runs=[]))
    outbox.flush()


def orders(*messages):
    """An inbox of messages, whose pipe then ends."""
    return Inbox(
        io.BytesIO(b"".join(channel.packed(one.model_dump_json(exclude_defaults=True)) for one in messages))
    )


def test_signals_find_their_job_before_it_has_begun():
    work = [Work(job=number, do="plan", kind="plan") for number in (1, 2)]
    inbox = orders(*work, Signal(job=9, stop="x"), Signal(job=2, pace=3.0), Signal(job=1, stop="y"))
    (first, one), (second, other) = inbox.next(), inbox.next()
    assert inbox.next() is None
    assert (first.job, second.job) == (1, 2)
    assert (one.stopped, other.stopped, other.pace) == ("y", "the server of the page has ended", 3.0)


def test_the_end_of_the_pipe_cancels_what_runs():
    inbox = orders(Work(job=1, do="insert", kind="insertion", paused=True))
    _, signals = inbox.next()
    assert inbox.next() is None
    assert signals.pace == 0.0
    with pytest.raises(Cancelled):
        signals.check()


def test_a_stop_is_passed_on_at_once():
    signals, stops = Signals(), []
    signals.on_stop = stops.append
    signals.take(Signal(job=1, pace=0.0))
    assert not stops
    signals.take(Signal(job=1, stop="person 2"))
    assert stops == ["person 2"]


def test_a_rig_is_held_until_it_may_go_and_again_when_it_is_asked():
    inbox = orders(Work(job=1, do="insert", kind="insertion", rig="rig.toml"))
    _, signals = inbox.next()
    assert signals.held == "not armed"
    signals.take(Signal(job=1, alive=True))
    assert signals.held == "not armed"
    signals.take(Signal(job=1, go=True))
    assert signals.held == ""
    signals.take(Signal(job=1, hold="nobody is in control"))
    signals.take(Signal(job=1, alive=True))
    assert signals.held == "nobody is in control"


class Clock:
    """Time that passes only in waits; then: signals by the number of the wait."""

    def __init__(self, signals, then=()):
        self.now, self.waits, self._signals, self._then = 0.0, [], signals, dict(then)

    def wait(self, seconds):
        self.waits.append(seconds)
        signal = self._then.get(len(self.waits))
        if signal is not None:
            self.now += 0.25 * (seconds or 4.0)
            self._signals.take(Signal(job=1, **signal))
        else:
            assert seconds is not None, "it waits for a signal that does not come"
            self.now += seconds


def paced(pace, then=()):
    signals, states = Signals(pace), []
    clock = Clock(signals, then)
    pacer = Pacer(signals, clock.wait, signals.disturbs, states.append, lambda: clock.now)
    pacer.start()
    return pacer, clock, states


@pytest.mark.parametrize(("pace", "seconds"), [(1.0, 0.2), (4.0, 0.05)])
def test_a_period_takes_its_time_by_the_pace(pace, seconds):
    pacer, clock, states = paced(pace)
    pacer.after(0.2)
    assert clock.now == pytest.approx(seconds)
    assert states == [False]


def test_time_of_computing_is_part_of_the_period():
    pacer, clock, _ = paced(1.0)
    clock.now += 0.15
    pacer.after(0.2)
    assert clock.waits == [pytest.approx(0.05)]
    clock.now += 5.0  # a long computation is not caught up
    pacer.after(0.2)
    pacer.after(0.2)
    assert clock.now == pytest.approx(5.4)


def test_the_pace_changes_within_a_period():
    pacer, clock, _ = paced(1.0, {1: {"pace": 10.0}})
    pacer.after(0.4)
    assert clock.now == pytest.approx(0.1 + 0.3 / 10.0)


def test_paused_it_waits_for_an_advance_or_a_pace():
    pacer, clock, states = paced(1.0, {1: {"pace": 0.0}, 2: {"advance": True}, 3: {"pace": 1.0}})
    pacer.after(0.4)
    assert clock.waits == [pytest.approx(0.4), None]
    assert states == [False, True]
    pacer.after(0.4)
    assert states == [False, True, False]


@pytest.mark.parametrize(
    ("signal", "error"), [({"stop": "person 2"}, StoppedError), ({"cancel": True}, Cancelled)]
)
def test_a_stop_ends_a_pause(signal, error):
    pacer, clock, _ = paced(1.0, {1: {"pace": 0.0}, 2: signal})
    with pytest.raises(error):
        pacer.after(0.4)
    assert len(clock.waits) == 2


def test_waits_end_with_a_signal():
    signals = Signals()
    signals.take(Signal(job=1, disturb=Disturb(type="disturb", what="push", size=1.0)))
    signals.wait(None)
    assert [one.what for one in signals.disturbs()] == ["push"]
    assert signals.disturbs() == []
