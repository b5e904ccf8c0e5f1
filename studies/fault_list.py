"""The faults, as a table of data: how each is injected, the required reaction, and the time to detection."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from signal import SIGINT, SIGSTOP, SIGTERM

from fault_injections import Clock, Device, Disk, Injection, Kill, Nothing, Signal


@dataclass(frozen=True)
class Reaction:
    """What must happen. outcomes: of the insertion, by a pattern of the states that the supervisor has recorded after
    the fault, with spaces; `end` is the stop by the controller at the end of an insertion, "running" an insertion
    whose record has no outcome.

    detected: by which of these states.
    """

    text: str
    outcomes: Mapping[str, str]
    detected: tuple[str, ...] = ("holding", "stopped", "fault")


HELD = Reaction("hold, end held", {"holding end": "held"})
HELD_AND_CONTINUED = Reaction("hold, then continue", {"(holding inserting )+end": "done"})
MAYBE_HELD = Reaction("continue, or hold briefly", {"(holding inserting )*end": "done"})
CONTINUED = Reaction("continue", {"end": "done"})
RESTED = Reaction("rest until it is there", {"end": "done"})
FAULT = Reaction("fault", {"fault": "failed"})
FAULT_ONCE_IT_MOVES = Reaction("fault", {"fault": "failed", "end": "done"})
STOPPED = Reaction("stop", {"stopped": "interrupted"})
STOPPED_UNRECORDED = Reaction("stop", {"": "running"})
BY_THEMSELVES = Reaction("motors stop by themselves", {"": "failed"})
BY_THEMSELVES_UNRECORDED = Reaction("motors stop by themselves", {"": "running"})
ENDED_HELD = Reaction("end held", {"end": "held"}, detected=("end",))


@dataclass(frozen=True)
class Fault:
    """A fault of the table. within: longest time to detection (s), None where none is required.

    because: what the reason of the detection contains, in a pattern, with {axis} for the axis that is faulty; axis: its
    name, outside of rolls; rolls: whether it falls in a roll in no case, in some ("some") or in all ("all").
    decision_s: how long a decision takes, where that is the fault; from_motion: whether the time to detection counts
    from the beginning of the motion in which the fault shows.
    """

    group: str
    name: str
    injection: Injection
    reaction: Reaction
    within: float | None = None
    because: str = ""
    rolls: str = ""
    axis: str = "insertion"
    decision_s: float = field(default=0.0, kw_only=True)
    from_motion: bool = field(default=False, kw_only=True)

    def falls_in_roll(self, rolls: bool) -> bool:
        """Whether it falls in a roll, in a case in which faults do so or not."""
        return self.rolls == "all" or (self.rolls == "some" and rolls)


_tracker = partial(Fault, "tracker")
_motors = partial(Fault, "motors")
_computer = partial(Fault, "computer")
_SOME = "some"

FAULTS: Sequence[Fault] = (
    # As long as monitor.lost_after_s: it may or may not be a hold.
    _tracker("missing for 0.1 s", Device("aurora:missing:0.1"), MAYBE_HELD, None, "missing", _SOME),
    _tracker("missing for 0.5 s", Device("aurora:missing:0.5"), HELD_AND_CONTINUED, 0.25, "missing", _SOME),
    _tracker("missing for 2 s", Device("aurora:missing:2"), HELD, 0.25, "missing", _SOME),
    _tracker("frozen: no new frames", Device("aurora:frozen"), HELD, 0.45),
    _tracker("frozen: values repeat", Device("aurora:stuck"), HELD, 0.6),
    _tracker("not a number", Device("aurora:nan"), HELD, 0.25),
    _tracker("jump of 5 mm", Device("aurora:jump=5"), HELD, 0.15),
    _tracker("garbled", Device("aurora:garbled"), HELD, 0.45),
    _tracker("unplugged", Device("aurora:unplug"), HELD, 0.45),
    _tracker("indicator high", Device("aurora:indicator=0.2"), HELD, 0.9),
    _tracker("0.5 s late", Device("aurora:delay=0.5"), HELD, 0.6),
    _motors("stall", Device("galil:stall={channel}"), FAULT, 0.4, "{axis}"),
    _motors("roll stalls", Device("galil:stall={channel}"), FAULT, 0.4, "{axis}", "all"),
    # It shows in motions faster than max_error / lag = 1.3 mm/s: at worst after a rest and a slow step.
    _motors("lag of 0.15 s", Device("galil:lag={channel}"), FAULT, 1.0, "{axis}", _SOME),
    _motors("overshoot by a fifth", Device("galil:overshoot={channel}"), FAULT, 1.2, "{axis}", _SOME),
    _motors("limit switch", Device("galil:limit={channel}"), FAULT, 0.4, "({axis}|Limit Switch)", _SOME),
    _motors("? in reply", Device("galil:refuse"), FAULT, 0.1, "", _SOME),
    _motors("connection lost", Device("galil:unplug"), FAULT, 0.1, "", _SOME),
    _motors("connection half open", Device("galil:half-open"), FAULT, 0.25, "", _SOME),
    _motors("no replies", Device("galil:silence"), FAULT, 0.25, "", _SOME),
    _motors("garbled replies", Device("galil:garbled"), FAULT, 0.25, "", _SOME),
    _motors("wrong direction", Device("galil:reversed={channel}"), FAULT, 0.4, "{axis}", _SOME),
    _motors("position reset", Device("galil:reset={channel}"), FAULT, 0.1, "{axis}", _SOME),
    _motors("motor off", Device("galil:off={channel}"), FAULT, 0.1, "{axis}", _SOME),
    _motors(
        "guide stalls",
        Device("galil:stall={channel}"),
        FAULT_ONCE_IT_MOVES,
        0.9,
        "{axis}",
        axis="guide_y",
        from_motion=True,
    ),
    _computer("decision of 0.5 s", Nothing(), RESTED, decision_s=0.5),
    _computer("decision of 5 s", Nothing(), STOPPED, 2.3, "no command", decision_s=5.0),
    _computer("controller killed", Kill("controller"), STOPPED_UNRECORDED, rolls=_SOME),
    _computer("supervisor killed", Kill("supervisor"), BY_THEMSELVES, rolls=_SOME),
    _computer("both killed", Kill("supervisor", "controller"), BY_THEMSELVES_UNRECORDED, rolls=_SOME),
    _computer("controller stopped (SIGSTOP)", Signal(SIGSTOP), STOPPED, 2.3, "no (command|heartbeat)", _SOME),
    # Found by the controller when it writes a period, which lasts longer while other programs use the processor.
    _computer("disk full", Disk(), ENDED_HELD, 1.0),
    _computer("clock set back by 1 h", Clock(-3600), CONTINUED),
    _computer("clock set forward by 1 h", Clock(3600), CONTINUED),
    _computer("Ctrl-C", Signal(SIGINT, group=True), STOPPED, 0.1, "signal SIGINT", _SOME),
    _computer("SIGTERM", Signal(SIGTERM, group=True), STOPPED, 0.1, "signal SIGTERM", _SOME),
)
