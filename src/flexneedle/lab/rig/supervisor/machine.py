"""The states of a rig and the events that change them: the table that the supervisor runs from (docs/safety.md)."""

from enum import StrEnum


class State(StrEnum):
    """State of a rig."""

    IDLE = "idle"  # connected; nothing moves, motors may be off
    HOMING = "homing"  # an axis searches its home
    JOGGING = "jogging"  # an axis is moved by the operator
    ARMED = "armed"  # motors on, positions taken as the start; nothing moves
    INSERTING = "inserting"  # steps are carried out; between two of them the needle rests
    HOLDING = "holding"  # the needle is held during an insertion: a reading or the field was rejected
    RETRACTING = "retracting"  # the base is withdrawn
    STOPPED = "stopped"  # by the operator, or since the controller is gone; needs a reset
    FAULT = "fault"  # by a device; needs a reset


class Event(StrEnum):
    """What changes the state."""

    HOME = "home"
    JOG = "jog"
    ARM = "arm"
    STEP = "step"  # a step of an insertion is commanded
    RETRACT = "retract"
    ARRIVED = "arrived"  # a motion of the operator has ended
    HOLD = "hold"  # the monitor rejected the tracker's readings or the field
    STOP = "stop"  # keyboard, signal, ROS, or no heartbeat
    FAULT = "fault"  # a device failed, or did not do what it was commanded
    RESET = "reset"
    OFF = "off"  # motors are switched off


TABLE: dict[tuple[State, Event], State] = {
    (State.IDLE, Event.ARM): State.ARMED,
    (State.ARMED, Event.HOME): State.HOMING,
    (State.ARMED, Event.JOG): State.JOGGING,
    (State.ARMED, Event.RETRACT): State.RETRACTING,
    (State.ARMED, Event.STEP): State.INSERTING,
    (State.ARMED, Event.ARM): State.ARMED,
    (State.HOMING, Event.ARRIVED): State.IDLE,  # positions are others now, and with them what armed has taken
    (State.JOGGING, Event.ARRIVED): State.ARMED,
    (State.RETRACTING, Event.ARRIVED): State.ARMED,
    (State.INSERTING, Event.STEP): State.INSERTING,
    (State.INSERTING, Event.HOLD): State.HOLDING,
    (State.HOLDING, Event.HOLD): State.HOLDING,
    (State.HOLDING, Event.STEP): State.INSERTING,
    (State.STOPPED, Event.RESET): State.IDLE,
    (State.FAULT, Event.RESET): State.IDLE,
    (State.STOPPED, Event.OFF): State.STOPPED,
    (State.FAULT, Event.OFF): State.FAULT,
    **{(state, Event.STOP): State.STOPPED for state in State if state is not State.FAULT},
    **{(state, Event.FAULT): State.FAULT for state in State},
    (State.FAULT, Event.STOP): State.FAULT,
}
"""The state after an event. What is not listed is refused, and changes nothing."""

MOVING = frozenset({State.HOMING, State.JOGGING, State.INSERTING, State.RETRACTING})
"""The states in which motors may move."""


def after(state: State, event: Event) -> State | None:
    """The state after an event; None if the event is refused in this state."""
    return TABLE.get((state, event))


def accepted(state: State) -> tuple[Event, ...]:
    """The events that a state accepts, for messages."""
    return tuple(event for event in Event if (state, event) in TABLE)


def refusal(state: State, event: Event, why: str, *, moving: bool) -> str:
    """Why an event is refused in this state, or "". why: the reason of the state; moving: whether motors still move."""
    because = f": {why}" if why else ""
    if after(state, event) is None:
        return f"{event}: refused while {state}{because}; accepted: {', '.join(accepted(state))}"
    return f"{event}: refused: motors have not come to rest yet{because}" if moving else ""
