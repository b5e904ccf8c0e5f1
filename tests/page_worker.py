"""A worker of the page without physics: it answers each order at once with invented messages, and reports each change.

It runs in a thread of the test, with the interface of a child process.

The seed of a plan chooses a failure: 13 the process ends, 14 it does not cancel, 15 it works until it is cancelled, as
row 15 of a study; so does a retraction. An insertion with seed 14 neither cancels nor stops; a cancelled one sends one
more row.
A save waits for a pipe called GATE in the folder of runs, if there is one. A run called SLOW is read until it is
cancelled. An insertion on a rig waits for "go", also after a hold. Its seeds: 16 a fault follows "go", 17 it does not
stop, 18 its record takes some beats of the server.
"""

import json
import socket
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

import numpy as np

from flexneedle.lab.page.job_orders import JobChange, RigReport, WorkerReady
from flexneedle.lab.page.protocol import (
    EstimateMessage,
    InsertionMessage,
    IterationMessage,
    JobMessage,
    PlanMessage,
    RigCheckMessage,
    RowsMessage,
    StudyRowsMessage,
)
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource, ShapeFrame, pack_frame
from flexneedle.lab.process import MessageChannel

CRASHES, HANGS, WORKS_ON, FAULTY, UNSTOPPABLE, RECORDS = 13, 14, 15, 16, 17, 18
ROWS, SLOW, GATE = 600, "slow", ".gate"


def frame(number, source=FrameSource.LIVE):
    """A sampled path, 24 kB."""
    return ShapeFrame(FrameKind.SAMPLES, source, number, np.zeros((1, 2_000, 3), np.float32))


def packed_frame(number, source=FrameSource.LIVE):
    """The bytes of `frame`, as a client receives them."""
    return pack_frame(frame(number, source))


def as_text(change):
    """The fields that are set, as JSON."""
    values = {key: value for key, value in asdict(change).items() if value}
    return json.dumps(values, default=lambda one: one.model_dump(exclude_defaults=True, exclude={"request"}))


class Worker:
    """The worker of a channel."""

    def __init__(self, channel):
        self._channel = channel
        self._orders, self._changes = SimpleQueue(), SimpleQueue()
        self.listener = Thread(target=self._listen, daemon=True)
        self.listener.start()

    def _listen(self):
        while not self._channel.ended:
            for one in self._channel.receive(None):
                (self._changes if isinstance(one, JobChange) else self._orders).put(one)
        self._changes.put(None)
        self._orders.put(None)

    def report(self, message):
        self._channel.send(message)
        self._channel.flush(10.0)

    def run(self):
        self.report(WorkerReady())
        while True:
            order = self._get(self._orders)
            self.job(order, "running")
            self.job(order, self.do(order))

    def change(self, order):
        """The next change of a job."""
        while (change := self._get(self._changes)).job != order.job:
            pass
        return change

    def _get(self, queue):
        if (one := queue.get()) is None:
            raise SystemExit(0)
        return one

    def job(self, order, state):
        self.report(JobMessage(job=order.job, kind=order.kind, state=state))

    def insertion(self, order, state, summary="", of="live", pace=0.0, periods=0, row=None):
        self.report(
            InsertionMessage(
                of=of,
                name=order.name,
                state=state,
                summary=summary,
                controller=order.controller,
                seed=order.seed,
                target=(40.0, 0.0, 0.0),
                periods=periods,
                pace=pace,
                rig=order.rig,
                row=row,
                folder="recorded" if order.rig else "",
            )
        )

    def rows(self, of, first, count):
        rows = [{"index": index} for index in range(first, first + count)]
        self.report(RowsMessage.model_construct(of=of, first=first, rows=rows))

    def rig(self, state, why="", waits=0):
        self.report(RigReport(state, why, waits, (f"wait {waits}",) if waits else ()))

    def do(self, order):
        """Carry out an order; return the last state of its job."""
        return getattr(self, order.action)(order) or "done"

    def needle(self, _order):
        self.report(frame(0))

    def estimate(self, order):
        self.report(EstimateMessage(revision=order.revision, summary="", error_mm=0.0, roll_deg=0.0))

    def plan(self, order):
        if order.seed == CRASHES:
            raise SystemExit(3)
        while order.seed == HANGS:
            self.change(order)
        if order.seed == WORKS_ON:
            return "cancelled" if self.change(order).cancel else "failed"
        made = {"revision": order.revision, "strategy": order.strategy}
        self.report(IterationMessage.model_construct(**made, iteration=1))
        self.report(PlanMessage.model_construct(**made, cost=order.seed))
        return "done"

    def reach(self, order):
        return "cancelled" if self.change(order).cancel else "failed"

    def insert(self, order):
        """Rows and frames at once unless it is paused, then one for each advance, until it is stopped."""
        if order.rig:
            return self.insert_on_rig(order)
        count = 0
        self.insertion(order, "paused" if order.paused else "running", as_text(order), pace=1.0)
        if not order.paused:
            for count in range(ROWS):
                self.rows("live", count, 1)
                self.report(frame(count))
            count = ROWS
        while True:
            change = self.change(order)
            if change.advance or change.cancel:
                self.rows("live", count, 1)
                count += 1
            if change.cancel:
                self.report(frame(count - 1))
            ends = order.seed != HANGS and (change.stop or change.cancel)
            self.insertion(order, "interrupted" if ends else "running", as_text(change))
            if ends:
                return "done" if change.stop else "cancelled"

    def insert_on_rig(self, order):
        """It waits, goes, holds and stops as the server asks; its number of periods is the number of beats."""
        beats, waits = 0, 1
        self.insertion(order, "ready", text := as_text(order))
        self.rig("idle", waits=waits)
        while True:
            change = self.change(order)
            beat = change == JobChange(order.job)
            beats += beat
            if beat:
                self.insertion(order, "running" if waits == 0 else "ready", text, periods=beats)
            elif change.go and order.seed == FAULTY:
                self.rig("fault", "insertion: the motor is off")
                self.insertion(order, "failed", "the motor is off")
                return "done"
            elif change.go:
                waits = 0
                self.rig("armed")
                self.rig("inserting")
                self.insertion(order, "running", as_text(change))
            elif change.hold:
                waits = 2
                self.rig("holding", change.hold, waits)
                self.insertion(order, "holding", as_text(change))
            elif change.stop and order.seed != UNSTOPPABLE:
                self.rig("stopped", change.stop)
                for _ in range(8 if order.seed == RECORDS else 0):
                    while self.change(order) != JobChange(order.job):
                        pass
                self.insertion(order, "interrupted", as_text(change))
                return "done"

    def retract(self, order):
        """It waits, and is withdrawn by "go", or with seed WORKS_ON retracts until it is stopped."""
        self.rig("idle", waits=1)
        while True:
            change = self.change(order)
            if change.stop:
                self.rig("stopped", change.stop)
                return "cancelled"
            if change.go:
                self.rig("armed")
                self.rig("retracting")
            if change.go and order.seed != WORKS_ON:
                self.rig("ended", "the needle was withdrawn")
                return "done"

    def read(self, order):
        if Path(order.folder).name == SLOW:
            self.change(order)
        self.insertion(order, "done", order.folder, order.of)
        self.rows(order.of, 0, ROWS)
        self.report(frame(0, FrameSource.SECOND if order.of == "second" else FrameSource.FIRST))

    def study(self, order):
        more = {"insertions": 3, "finished": 0, "index": order.row, "rows": []}
        self.report(StudyRowsMessage(name=order.name, title=order.folder, **more))

    def row(self, order):
        if order.row == WORKS_ON:
            return self.reach(order)
        self.insertion(order, "done", json.dumps([order.folder, order.row]), order.of, row=order.row)
        return "done"

    def check(self, order):
        findings = [{"part": "driver", "item": "connection", "found": order.rig, "problem": ""}]
        self.report(RigCheckMessage(revision=order.revision, findings=findings))

    def save(self, order):
        if (gate := Path(order.folder).parent / GATE).exists():
            gate.read_bytes()  # of a pipe: until somebody has written to it
        Path(order.folder).mkdir()
        (Path(order.folder) / "run.json").write_text(as_text(order))

    save_row = save


class WorkerThread:
    """The worker in place of a `ChildProcess`."""

    def __init__(self):
        ours, theirs = socket.socketpair()
        self.channel, self._theirs = MessageChannel(ours), MessageChannel(theirs, most_waiting=1_000_000)
        self._code, self._killed = 0, False
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        worker = Worker(self._theirs)
        try:
            worker.run()
        except SystemExit as end:
            self._code = end.code
        finally:
            self._theirs.end_sending()
            worker.listener.join()
            self._theirs.close()

    def end(self, seconds):
        self._killed |= seconds == 0.0
        self.channel.end_sending()
        self._thread.join(100.0)
        assert not self._thread.is_alive()
        return -9 if self._killed else self._code

    def close(self):
        self.channel.close()
