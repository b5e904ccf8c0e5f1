"""States of a rig and the events that change them: the table that the supervisor follows (docs/safety.md)."""

from enum import StrEnum


class SupervisorState(StrEnum):
    """State of a rig."""

    IDLE = "idle"  # connected; nothing moves, motors may be off
    HOMING = "homing"  # an axis searches its home
    JOGGING = "jogging"  # an axis is moved by the operator
    ARMED = "armed"  # motors on, positions taken as the start; nothing moves
    INSERTING = "inserting"  # steps are carried out; between two of them the needle rests
    HOLDING = "holding"  # the needle is held during an insertion: a reading or the field was rejected
    RETRACTING = "retracting"  # the base is withdrawn
    STOPPED = "stopped"  # by the operator, or after the end of the controller; needs a reset
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


TABLE: dict[tuple[SupervisorState, RigEvent], SupervisorState] = {
    (SupervisorState.IDLE, RigEvent.ARM): SupervisorState.ARMED,
    (SupervisorState.ARMED, RigEvent.HOME): SupervisorState.HOMING,
    (SupervisorState.ARMED, RigEvent.JOG): SupervisorState.JOGGING,
    (SupervisorState.ARMED, RigEvent.RETRACT): SupervisorState.RETRACTING,
    (SupervisorState.ARMED, RigEvent.STEP): SupervisorState.INSERTING,
    (SupervisorState.ARMED, RigEvent.ARM): SupervisorState.ARMED,
    (
        SupervisorState.HOMING,
        RigEvent.ARRIVED,
    ): SupervisorState.IDLE,  # positions have changed: the rig must be armed again
    (SupervisorState.JOGGING, RigEvent.ARRIVED): SupervisorState.ARMED,
    (SupervisorState.RETRACTING, RigEvent.ARRIVED): SupervisorState.ARMED,
    (SupervisorState.INSERTING, RigEvent.STEP): SupervisorState.INSERTING,
    (SupervisorState.INSERTING, RigEvent.HOLD): SupervisorState.HOLDING,
    (SupervisorState.HOLDING, RigEvent.HOLD): SupervisorState.HOLDING,
    (SupervisorState.HOLDING, RigEvent.STEP): SupervisorState.INSERTING,
    (SupervisorState.STOPPED, RigEvent.RESET): SupervisorState.IDLE,
    (SupervisorState.FAULT, RigEvent.RESET): SupervisorState.IDLE,
    (SupervisorState.STOPPED, RigEvent.OFF): SupervisorState.STOPPED,
    (SupervisorState.FAULT, RigEvent.OFF): SupervisorState.FAULT,
    **{
        (state, RigEvent.STOP): SupervisorState.STOPPED
        for state in SupervisorState
        if state is not SupervisorState.FAULT
    },
    **{(state, RigEvent.FAULT): SupervisorState.FAULT for state in SupervisorState},
    (SupervisorState.FAULT, RigEvent.STOP): SupervisorState.FAULT,
}
"""State after an event. An event that is not listed is refused, and changes nothing."""

MOVING = frozenset(
    {SupervisorState.HOMING, SupervisorState.JOGGING, SupervisorState.INSERTING, SupervisorState.RETRACTING}
)
"""States in which motors may move."""


def next_state(state: SupervisorState, event: RigEvent) -> SupervisorState | None:
    """Return the state after an event; None if the event is refused in this state."""
    return TABLE.get((state, event))


def accepted_events(state: SupervisorState) -> tuple[RigEvent, ...]:
    """Return the events that a state accepts, for messages."""
    return tuple(event for event in RigEvent if (state, event) in TABLE)


def refusal_reason(state: SupervisorState, event: RigEvent, why: str, *, moving: bool) -> str:
    """Return the reason why an event is refused in this state, or "".

    why: reason of the state; moving: motors still move.
    """
    because = f": {why}" if why else ""
    if next_state(state, event) is None:
        return f"{event}: refused while {state}{because}; accepted: {', '.join(accepted_events(state))}"
    return f"{event}: refused: motors have not come to rest yet{because}" if moving else ""
