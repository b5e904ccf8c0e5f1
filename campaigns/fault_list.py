"""The faults, as a table of data: how each is injected, the required reaction, and the time to detection."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from signal import SIGINT, SIGSTOP, SIGTERM

from fault_injections import Clock, Device, Disk, Injection, Kill, Nothing, Signal
from flexneedle.lab.rig.rig_file import load_rig


@dataclass(frozen=True)
class Reaction:
    """Required reaction. outcomes: of the insertion, by a pattern of the states that the supervisor has recorded after
    the fault, with spaces; `end` is the stop by the controller at the end of an insertion, "running" an insertion
    whose record has no outcome.

    detected: states that count as detection, none if the supervisor records nothing. The reason is from the state; for
    `end` and for none it is from the outcome.
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
STOPPED_UNRECORDED = Reaction("stop", {"": "running"}, detected=())
BY_THEMSELVES = Reaction("motors stop by themselves", {"": "failed"}, detected=())
BY_THEMSELVES_UNRECORDED = Reaction("motors stop by themselves", {"": "running"}, detected=())
ENDED_HELD = Reaction("end held", {"end": "held"}, detected=("end",))


@dataclass(frozen=True)
class Fault:
    """A fault of the table. within: longest time (s), None where there is nothing to detect.

    because: pattern in the reason, with {axis} for the faulty axis; axis: its name, outside of rolls; rolls: whether
    the fault occurs in a roll in no case, in some ("some") or in all ("all"); decision_s: duration of a decision, if
    that is the fault; fibre: whether the needle has one; timed: the time that counts, by its key in a row: from the
    fault to its detection; from the motion in which the fault shows to the detection, if the motion begins after the
    fault; or from the fault until all axes rest.
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
    fibre: bool = field(default=False, kw_only=True)
    timed: str = field(default="detection_s", kw_only=True)

    def falls_in_roll(self, rolls: bool) -> bool:
        """Return whether the fault falls in a roll. rolls: whether faults of the case do so."""
        return self.rolls == "all" or (self.rolls == "some" and rolls)


_tracker = partial(Fault, "tracker")
_sensors = partial(Fault, "sensors", fibre=True)
_motors = partial(Fault, "motors")
_computer = partial(Fault, "computer")
_SOME = "some"
_NO_READING = "^(missing: no reading|stale)"
_NOT_CONNECTED = "closed the connection|not connected|not sent|reset by peer"
# A character that no reply has, or another digit: another position, or a bit of a state.
_GARBLED = (
    "not a reply|must be .* numbers|more than the replies|before a refusal|no (position|byte)|refused"
    "|jumped|went back|the motor"
)


def _rest_s() -> float:
    """Return the longest time (s) until motors rest without a supervisor: the queue, the deceleration from the
    largest speed, and 50 ms for the emulated controller, which may be late itself.
    """
    rig = load_rig("emulated")
    return rig.loop.queue + max(axis.speed / axis.acceleration for _, axis in rig.axes.items()) + 0.05


# A supervisor whose controller has ended stops the motors at its next tick, which is within the queue.
_rested = partial(_computer, timed="rest_s")

FAULTS: Sequence[Fault] = (
    # As long as monitor.lost_after_s: it may or may not be a hold.
    _tracker("missing for 0.1 s", Device("aurora:missing:0.1"), MAYBE_HELD, None, "^missing: tip", _SOME),
    _tracker(
        "missing for 0.5 s", Device("aurora:missing:0.5"), HELD_AND_CONTINUED, 0.25, "^missing: tip", _SOME
    ),
    _tracker("missing for 2 s", Device("aurora:missing:2"), HELD, 0.25, "^missing: tip", _SOME),
    _tracker("frozen: no new frames", Device("aurora:frozen"), HELD, 0.45, _NO_READING),
    # The tip that is reported stays behind the needle, too. It shows only while the needle travels, after a roll at the
    # earliest.
    _tracker(
        "frozen: values repeat", Device("aurora:stuck"), HELD, 1.2, "^(frozen|innovation|out of plane):"
    ),
    _tracker("not a number", Device("aurora:nan"), HELD, 0.25, "^missing: tip"),
    _tracker("jump of 5 mm", Device("aurora:jump=5"), HELD, 0.15, "^(jump|innovation|out of plane):"),
    _tracker("garbled", Device("aurora:garbled"), HELD, 0.45, _NO_READING),
    _tracker("unplugged", Device("aurora:unplug"), HELD, 0.45, _NO_READING),
    _tracker("indicator high", Device("aurora:indicator=0.2"), HELD, 0.9, "^field distorted:"),
    _tracker("0.5 s late", Device("aurora:delay=0.5"), HELD, 0.6, _NO_READING),
    _sensors("fibre unplugged", Device("fbgs:unplug"), CONTINUED),
    _sensors("tracker unplugged, with a fibre", Device("aurora:unplug"), CONTINUED),
    # A motor that stalls at rest, or has next to nothing left, shows it only in its next step.
    _motors("stall", Device("galil:stall={channel}"), FAULT, 0.4, "{axis}", timed="from_motion_s"),
    _motors("roll stalls", Device("galil:stall={channel}"), FAULT, 0.4, "{axis}", "all"),
    # It shows in motions faster than max_error / lag = 1.3 mm/s: at worst after a rest and a slow step.
    _motors("lag of 0.15 s", Device("galil:lag={channel}"), FAULT, 1.0, "{axis}", _SOME),
    _motors("overshoot by a fifth", Device("galil:overshoot={channel}"), FAULT, 1.2, "{axis}", _SOME),
    _motors("limit switch", Device("galil:limit={channel}"), FAULT, 0.4, "({axis}|[Ll]imit)", _SOME),
    _motors("? in reply", Device("galil:refuse"), FAULT, 0.1, "refused", _SOME),
    _motors("connection lost", Device("galil:unplug"), FAULT, 0.1, f"{_NOT_CONNECTED}|no reply", _SOME),
    _motors(
        "connection half open", Device("galil:half-open"), FAULT, 0.25, f"no reply|{_NOT_CONNECTED}", _SOME
    ),
    _motors("no replies", Device("galil:silence"), FAULT, 0.25, f"no reply|{_NOT_CONNECTED}", _SOME),
    _motors("garbled replies", Device("galil:garbled"), FAULT, 0.25, _GARBLED, _SOME),
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
        timed="from_motion_s",
    ),
    # The needle rests before a decision begins.
    _rested("decision of 0.5 s", Nothing(), RESTED, 0.05, decision_s=0.5),
    _computer("decision of 5 s", Nothing(), STOPPED, 2.3, "no command", decision_s=5.0),
    _rested("controller killed", Kill("controller"), STOPPED_UNRECORDED, _rest_s(), rolls=_SOME),
    _rested("supervisor killed", Kill("supervisor"), BY_THEMSELVES, _rest_s(), "supervisor has ended", _SOME),
    _rested(
        "both killed", Kill("supervisor", "controller"), BY_THEMSELVES_UNRECORDED, _rest_s(), rolls=_SOME
    ),
    _computer("controller stopped (SIGSTOP)", Signal(SIGSTOP), STOPPED, 2.3, "no (command|heartbeat)", _SOME),
    # Found by the controller when it writes a period, which lasts longer while other programs use the processor.
    _computer("disk full", Disk(), ENDED_HELD, 1.0, "cannot be written"),
    _computer("clock set back by 1 h", Clock(-3600), CONTINUED),
    _computer("clock set forward by 1 h", Clock(3600), CONTINUED),
    _computer("Ctrl-C", Signal(SIGINT, group=True), STOPPED, 0.1, "signal SIGINT", _SOME),
    _computer("SIGTERM", Signal(SIGTERM, group=True), STOPPED, 0.1, "signal SIGTERM", _SOME),
    # As from `kill` or a service manager: the controller hands it on, whatever it does then.
    _computer("SIGTERM to the controller alone", Signal(SIGTERM), STOPPED, 0.1, "signal SIGTERM", _SOME),
)
