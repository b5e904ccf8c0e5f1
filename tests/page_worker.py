"""A worker of the page without physics: it answers every order at once with made-up news, and reports every signal.

Seeds of a plan choose what goes wrong: 13 the process ends, 14 it does not cancel, 15 it works until it is cancelled.
"""

import json
import os
import struct
import sys
from pathlib import Path
from queue import SimpleQueue

from flexneedle.page.channel import packed, read

CRASHES, HANGS, WORKS_ON = 13, 14, 15
ROWS = 600
FRAME = struct.pack("<BBBBIII", 1, 3, 1, 0, 0, 1, 2_000) + bytes(4 * 3 * 2_000)
"""A needle of the live insertion, 24 kB."""


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


def insertion(order, of, state, summary="", pace=0.0):
    say(
        "insertion",
        of=of,
        name=order.get("name", ""),
        state=state,
        summary=summary,
        controller=order.get("controller", ""),
        seed=order.get("seed", 0),
        target=[40.0, 0.0, 0.0],
        periods=0,
        pace=pace,
        rig=order.get("rig", ""),
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
        ends = signal.get("stop") or signal.get("cancel")
        insertion(order, "live", "interrupted" if ends else "running", json.dumps(signal))
        if ends:
            return "done" if signal.get("stop") else "cancelled"


def do(order, signals):
    match order["do"]:
        case "scene":
            say("scene", revision=order["revision"], target=order["scenario"]["target"]["depth_mm"])
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
            insertion(order, of, "done", order["folder"])
            rows(of, 0, ROWS)
            write(frame(0, source=3 if of == "second" else 2))
        case "save":
            Path(order["folder"]).mkdir()
            (Path(order["folder"]) / "run.json").write_text("{}")
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
