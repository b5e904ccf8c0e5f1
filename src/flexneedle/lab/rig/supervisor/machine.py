"""States of a rig and the events that change them: the table that the supervisor follows (docs/safety.md)."""

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


class RigEvent(StrEnum):
    """Event that changes the state."""

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


TABLE: dict[tuple[State, RigEvent], State] = {
    (State.IDLE, RigEvent.ARM): State.ARMED,
    (State.ARMED, RigEvent.HOME): State.HOMING,
    (State.ARMED, RigEvent.JOG): State.JOGGING,
    (State.ARMED, RigEvent.RETRACT): State.RETRACTING,
    (State.ARMED, RigEvent.STEP): State.INSERTING,
    (State.ARMED, RigEvent.ARM): State.ARMED,
    (
        State.HOMING,
        RigEvent.ARRIVED,
    ): State.IDLE,  # positions are others now, and with them what armed has taken
    (State.JOGGING, RigEvent.ARRIVED): State.ARMED,
    (State.RETRACTING, RigEvent.ARRIVED): State.ARMED,
    (State.INSERTING, RigEvent.STEP): State.INSERTING,
    (State.INSERTING, RigEvent.HOLD): State.HOLDING,
    (State.HOLDING, RigEvent.HOLD): State.HOLDING,
    (State.HOLDING, RigEvent.STEP): State.INSERTING,
    (State.STOPPED, RigEvent.RESET): State.IDLE,
    (State.FAULT, RigEvent.RESET): State.IDLE,
    (State.STOPPED, RigEvent.OFF): State.STOPPED,
    (State.FAULT, RigEvent.OFF): State.FAULT,
    **{(state, RigEvent.STOP): State.STOPPED for state in State if state is not State.FAULT},
    **{(state, RigEvent.FAULT): State.FAULT for state in State},
    (State.FAULT, RigEvent.STOP): State.FAULT,
}
"""The state after an event. What is not listed is refused, and changes nothing."""

MOVING = frozenset({State.HOMING, State.JOGGING, State.INSERTING, State.RETRACTING})
"""The states in which motors may move."""


def next_state(state: State, event: RigEvent) -> State | None:
    """Return the state after an event; None if the event is refused in this state."""
    return TABLE.get((state, event))


def accepted_events(state: State) -> tuple[RigEvent, ...]:
    """Return the events that a state accepts, for messages."""
    return tuple(event for event in RigEvent if (state, event) in TABLE)


def refusal_reason(state: State, event: RigEvent, why: str, *, moving: bool) -> str:
    """Return the reason why an event is refused in this state, or "". why: reason of the state; moving: motors still
    move."""
    because = f": {why}" if why else ""
    if next_state(state, event) is None:
        return f"{event}: refused while {state}{because}; accepted: {', '.join(accepted_events(state))}"
    return f"{event}: refused: motors have not come to rest yet{because}" if moving else ""
