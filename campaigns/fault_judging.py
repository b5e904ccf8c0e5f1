"""Judgement of a trial: recorded states, outcome, times, and true motions against the required reaction."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import degrees, inf
from typing import Any

import numpy as np

from fault_list import RESTED, Fault
from flexneedle.lab.emulators.emulated_rig.truth import TruthRecord
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.types import DB_X, DG_Y, Floats
from rig_trials import is_at_rest, moved_between

MOTION_MM = 0.5
"""The most that the base may move after detection."""
END = "end"
"""The state of a rig whose controller has stopped it, at the end of an insertion."""
_BY_CONTROLLER = "the controller"  # which stops the motors then
_RECORDED = ("holding", "stopped", "fault")  # states that have a reason
_AT_REST = 1e-3  # from where an axis is at the end (mm, rad)
_COLUMNS = {"guide_y": DG_Y}  # of a control, by axes that move seldom
_UNSEEN = 2.0  # tolerances of an axis: a stall in less need not be detected
_PAUSE_S = 0.02  # of the base between two motions; within one it is somewhere else after 4 ms
_REST_S = (
    0.06  # of base and guides between two steps; within one a guide that moves by a few counts pauses less
)
_TOGETHER = {"insertion", "guide_y", "guide_z"}


@dataclass(frozen=True)
class State:
    """A state that the supervisor has entered: when (s, monotonic), which, and why."""

    time: float
    name: str
    why: str


@dataclass(frozen=True)
class Evidence:
    """Evidence of a trial: the fault, the faulty axis, when the fault was ordered and when it is reported to have
    taken effect (s, monotonic), true states, `run.json`, messages, how many processes were left, and for an axis that
    moves seldom the commands (m, 9). step: of the base (mm).

    A supervisor may detect a fault before that is reported, but not before it was ordered.
    """

    fault: Fault
    axis: str
    ordered: float
    injected: float
    truth: TruthRecord
    run: Mapping[str, Any]
    errors: str
    left: int = 0
    commands: Floats | None = None
    step: float = 1.0

    def row(self) -> dict[str, Any]:
        """All that the table, the picture and the judgement need, as plain values."""
        states = entered(self.run, self.ordered)
        detection = next((one for one in states if one.name in self.fault.reaction.detected), None)
        resumed = next((one.time for one in states if one.name == "inserting"), inf)
        span = self._span(detection, resumed)
        return {
            "outcome": self.run.get("status", "none"),
            "reason": self.run.get("reason", ""),
            "states": " ".join(one.name for one in states),
            "why": detection.why if detection else "",
            "detection_s": max(0.0, detection.time - self.injected) if detection else None,
            "from_motion_s": self._from_motion(detection.time) if detection else None,
            "rest_s": self._rest(*span) if span and span[0] == self.injected else None,
            "motion_mm": None if span is None else self._moved("insertion", *span),
            "rolled_deg": None if span is None else degrees(self._moved("rotation", *span)),
            "travelled_mm": self._travelled(),
            "commanded_mm": self._commanded(),
            "during": self._during(),
            "rests": is_at_rest(self.truth),
            "left": self.left,
            "errors": self.errors[-4000:],
        }

    def _span(self, detection: State | None, resumed: float) -> tuple[float, float] | None:
        """Return the times between which only the rest of a motion may move; None: none.

        From detection until the insertion resumes; from the fault on if a process is killed and nothing is recorded;
        during a late decision.
        """
        if self.fault.reaction is RESTED:
            return self.injected, self.injected + self.fault.decision_s
        if detection is not None:
            return detection.time, resumed
        return (self.injected, inf) if "" in self.fault.reaction.outcomes else None

    def _rest(self, since: float, until: float) -> float:
        """Time from the fault until all axes are where they are at the end of a span."""
        at = (self.truth.time >= since) & (self.truth.time <= until)
        moving = [
            self.truth.time[at][np.abs(place[at] - place[at][-1]) > _AT_REST]
            for place in self.truth.positions.values()
        ]
        return max((float(times[-1]) - since for times in moving if len(times)), default=0.0)

    def _moved(self, axis: str, since: float, until: float) -> float:
        return moved_between(self.truth, since, until, axis)

    def _from_motion(self, time: float) -> float | None:
        """Return the time since the fault, or since the axis had to begin to move if that is later; None if it had not.

        Base and guide move together, so that the other axes show when the faulty one had to begin. For a guide, which
        moves seldom, the last time before detection counts; for a base the first one after the fault, and that only if
        the base was at rest at the fault, or next to the end of a step.
        """
        others = [
            self.truth.positions[axis] for axis in _TOGETHER - {self.axis} if axis in self.truth.positions
        ]
        moving = np.any([np.diff(place) != 0.0 for place in others], axis=0)
        moved = self.truth.time[:-1][moving & (self.truth.time[:-1] <= time)]
        begins = moved[np.diff(moved, prepend=-np.inf) > _REST_S]
        if self.axis not in _COLUMNS:
            later = begins[begins >= self.injected] if self._rested() else begins[:0]
            begins = np.append(later, self.injected)[:1]
        return float(time - max(begins[-1], self.injected)) if len(begins) else None

    def _rested(self) -> bool:
        """Return whether the base was at rest at the fault, or too near to the end of a step for a detection."""
        short = -self._travelled() % self.step
        return self._during() != "advance" or min(short, self.step - short) <= _unseen_mm(self.axis)

    def _commanded(self) -> float | None:
        """Return the largest commanded distance (mm) of the faulty axis from its position at the fault."""
        if self.commands is None or not len(self.commands):
            return None
        before = np.cumsum(self.commands[:, DB_X]) - self.commands[:, DB_X]
        after = np.cumsum(self.commands[before > self._travelled(), _COLUMNS[self.axis]])
        return float(np.abs(after).max(initial=0.0))

    def _travelled(self) -> float:
        """Return the advance (mm) of the base at the time of the fault."""
        base = self.truth.positions["insertion"]
        return float(np.interp(self.injected, self.truth.time, base) - base[0])

    def _during(self) -> str:
        """Return the motion of the needle at the time of the fault."""
        for axis, name in (("rotation", "roll"), ("insertion", "advance")):
            if self._moved(axis, self.injected - _PAUSE_S, self.injected) > 1e-4:
                return name
        return "rest"


def entered(run: Mapping[str, Any], since: float) -> Sequence[State]:
    """Return the states that a supervisor has recorded since a time, without changes of the reason alone."""
    ticks = (run.get("timing") or {}).get("ticks") or {}
    return [one for one in _changes(ticks.get("states", ())) if one.time >= since]


def _changes(states: Sequence[Mapping[str, Any]]) -> Iterator[State]:
    before = ""
    for one in states:
        name = END if (one["state"], one["why"]) == ("stopped", _BY_CONTROLLER) else one["state"]
        if name != before:
            yield State(one["time_s"], name, one["why"])
        before = name


def good(fault: Fault, row: Mapping[str, Any]) -> bool:
    """Return whether a trial was as required."""
    return not problems(fault, row)


def problems(fault: Fault, row: Mapping[str, Any]) -> list[str]:
    """Return the requirements that were not met."""
    reaction = fault.reaction
    required = [
        outcome for pattern, outcome in reaction.outcomes.items() if re.fullmatch(pattern, row["states"])
    ]
    checks = {
        f"states: {row['states'] or 'none'}": required,
        f"outcome: {row['outcome']}": not required or row["outcome"] in required,
        f"reason: {_reason(fault, row)}": _is_because(fault, row),
        f"{'rest' if fault.timed == 'rest_s' else 'detection'}: {seconds_of(fault, row)}": _is_timely(
            fault, row
        ),
        f"motion: {row['motion_mm']} mm": row["motion_mm"] is None or row["motion_mm"] <= MOTION_MM,
        "no rest": row["rests"],
        f"processes left: {row['left']}": row["left"] == 0,
    }
    return [problem for problem, fine in checks.items() if not fine]


def seconds_of(fault: Fault, row: Mapping[str, Any]) -> float | None:
    """The time that counts in a trial: to detection or to rest; None without one."""
    found: float | None = row[fault.timed]
    return found


def _reason(fault: Fault, row: Mapping[str, Any]) -> str:
    """Return the reason of the detection: from the state, or from the outcome if the state has none."""
    return str(row["why" if set(fault.reaction.detected) & set(_RECORDED) else "reason"])


def _is_because(fault: Fault, row: Mapping[str, Any]) -> bool:
    """Return whether the reason names the fault, or the supervisor has detected nothing."""
    if row["detection_s"] is None and set(fault.reaction.detected) & set(_RECORDED):
        return True
    return re.search(fault.because.format(axis=row["axis"]), _reason(fault, row)) is not None


def _is_timely(fault: Fault, row: Mapping[str, Any]) -> bool:
    """Return whether the detection was in time. A fault that shows only in a motion need not be detected at rest."""
    seconds = seconds_of(fault, row)
    if fault.within is None:
        return True
    if seconds is None:
        seldom = fault.axis in _COLUMNS and row["detection_s"] is None
        return seldom and (row["commanded_mm"] or 0.0) <= _unseen_mm(fault.axis)
    return seconds <= fault.within


@cache
def _unseen_mm(axis: str) -> float:
    return _UNSEEN * dict(load_rig("emulated").axes.items())[axis].tolerance
