"""A worker of the page without physics: it answers every order at once with made-up news, and reports every signal.

Seeds of a plan choose what goes wrong: 13 the process ends, 14 it does not cancel, 15 it works until it is cancelled.
Row 15 of a study does that, too; with 14 an insertion neither cancels nor stops.
A save waits for a pipe called GATE in the folder of runs, if there is one.
An insertion that is cancelled still sends a row, and a run called SLOW is read only when it is cancelled.
An insertion on a rig waits until it may go, and after a hold; seeds: 16 it has a fault then, 17 does
not stop, 18 takes some beats of the server for its record.
"""

import json
import os
import struct
import sys
from pathlib import Path
from queue import SimpleQueue

from flexneedle.lab.page.channel import packed, read

CRASHES, HANGS, WORKS_ON, FAULTY, UNSTOPPABLE, RECORDS = 13, 14, 15, 16, 17, 18
ROWS, SLOW, GATE = 600, "slow", ".gate"
FRAME = struct.pack("<BBBBIII", 4, 3, 1, 0, 0, 1, 2_000) + bytes(4 * 3 * 2_000)
"""A sampled path of the live insertion, 24 kB."""


def say(type_, **values):
    write(json.dumps({"type": type_, **values}))


def write(message):
    sys.stdout.buffer.write(packed(message))
    sys.stdout.buffer.flush()


def frame(number, source=1):
    """FRAME with a number and a source."""
    return FRAME[:2] + bytes([source]) + FRAME[3:4] + struct.pack("<I", number) + FRAME[8:]


def job(order, state, text=""):
    say("job", job=order["job"], kind=order["kind"], state=state, text=text)


def insertion(order, of, state, summary="", pace=0.0, periods=0, row=None):
    say(
        "insertion",
        of=of,
        name=order.get("name", ""),
        state=state,
        summary=summary,
        controller=order.get("controller", ""),
        seed=order.get("seed", 0),
        target=[40.0, 0.0, 0.0],
        periods=periods,
        pace=pace,
        rig=order.get("rig", ""),
        row=row,
        folder="recorded" if order.get("rig") else "",
    )


def rows(of, first, count):
    say("rows", of=of, first=first, rows=[{"index": index} for index in range(first, first + count)])


class Signals:
    """The signals of one job."""

    def __init__(self, signals, number):
        self._signals, self._number = signals, number

    def get(self):
        while (signal := self._signals.get())["job"] != self._number:
            pass
        return signal


def plan(order, signals):
    if order["seed"] == CRASHES:
        os._exit(3)
    while order["seed"] == HANGS:
        signals.get()
    if order["seed"] == WORKS_ON:
        return "cancelled" if signals.get().get("cancel") else "failed"
    say("iteration", revision=order["revision"], strategy=order["strategy"], iteration=1)
    say("plan", revision=order["revision"], strategy=order["strategy"], seed=order["seed"])
    return "done"


def insert(order, signals):
    """Rows and frames at once where it is not paused, then one for each advance, until it is stopped."""
    if order.get("rig"):
        return insert_on_rig(order, signals)
    count = 0
    insertion(order, "live", "paused" if order.get("paused") else "running", json.dumps(order), pace=1.0)
    if not order.get("paused"):
        for _ in range(ROWS):
            rows("live", count, 1)
            write(frame(count))
            count += 1
    while True:
        signal = signals.get()
        if signal.get("advance"):
            rows("live", count, 1)
            count += 1
        ends = order["seed"] != HANGS and (signal.get("stop") or signal.get("cancel"))
        if signal.get("cancel"):
            rows("live", count, 1)
            write(frame(count))
        insertion(order, "live", "interrupted" if ends else "running", json.dumps(signal))
        if ends:
            return "done" if signal.get("stop") else "cancelled"


def rig_is(state, why="", waits=0):
    say("rig_report", state=state, why=why, waits=waits, moves=[f"wait {waits}"] if waits else [])


def insert_on_rig(order, signals):
    """It waits, goes, holds and stops as it is signalled; its number of periods is that of the server's beats."""
    beats, waits = 0, 1
    insertion(order, "live", "ready", text := json.dumps(order))
    rig_is("idle", waits=waits)
    while True:
        signal = signals.get()
        beats += "alive" in signal
        if "alive" in signal:
            insertion(order, "live", "running" if waits == 0 else "ready", text, periods=beats)
        elif signal.get("go") and order["seed"] == FAULTY:
            rig_is("fault", "insertion: the motor is off")
            insertion(order, "live", "failed", "the motor is off")
            return "done"
        elif signal.get("go"):
            waits = 0
            rig_is("armed")
            rig_is("inserting")
            insertion(order, "live", "running", json.dumps(signal))
        elif "hold" in signal:
            waits = 2
            rig_is("holding", signal["hold"], waits)
            insertion(order, "live", "holding", json.dumps(signal))
        elif "stop" in signal and order["seed"] != UNSTOPPABLE:
            rig_is("stopped", signal["stop"])
            for _ in range(3 if order["seed"] == RECORDS else 0):
                while "alive" not in signals.get():
                    pass
            insertion(order, "live", "interrupted", json.dumps(signal))
            return "done"


def do(order, signals):
    match order["do"]:
        case "needle":
            write(frame(0, source=1))
        case "estimate":
            say("estimate", revision=order["revision"])
        case "plan":
            return plan(order, signals)
        case "reach":
            return "cancelled" if signals.get().get("cancel") else "failed"
        case "insert":
            return insert(order, signals)
        case "read":
            of = order.get("of", "first")
            if Path(order["folder"]).name == SLOW:
                signals.get()
            insertion(order, of, "done", order["folder"])
            rows(of, 0, ROWS)
            write(frame(0, source=3 if of == "second" else 2))
        case "study":
            more = {"insertions": 3, "finished": 0, "index": order.get("row"), "rows": []}
            say("study", name=order["name"], title=order["folder"], **more)
        case "row":
            if order["row"] == WORKS_ON:
                return "cancelled" if signals.get().get("cancel") else "failed"
            shown = json.dumps([order["folder"], order["row"]])
            insertion(order, order.get("of", "first"), "done", shown, row=order["row"])
        case "check":
            findings = [{"part": "driver", "item": "connection", "found": order["rig"], "problem": ""}]
            say("check", revision=order["revision"], findings=findings)
        case "save" | "save_row":
            if (gate := Path(order["folder"]).parent / GATE).exists():
                gate.read_bytes()  # of a pipe: until somebody has written to it
            Path(order["folder"]).mkdir()
            (Path(order["folder"]) / "run.json").write_text(json.dumps(order))
    return "done"


def main():
    from threading import Thread

    works, signals = SimpleQueue(), SimpleQueue()

    def listen():
        while (message := read(sys.stdin.buffer)) is not None:
            order = json.loads(message)
            (works if "do" in order else signals).put(order)
        os._exit(0)

    Thread(target=listen, daemon=True).start()
    say("ready")
    while True:
        order = {"seed": 0, "revision": 0, "strategy": "manipulation"} | works.get()
        job(order, "running")
        job(order, do(order, Signals(signals, order["job"])))


if __name__ == "__main__":
    main()
