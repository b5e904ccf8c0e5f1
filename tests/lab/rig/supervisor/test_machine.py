"""The table of states."""

import pytest

from flexneedle.lab.rig.supervisor.machine import (
    MOVING,
    TABLE,
    RigEvent,
    SupervisorState,
    next_state,
)

REST = [state for state in SupervisorState if state not in MOVING]


def test_every_state_can_be_stopped_and_can_fail():
    for state in SupervisorState:
        assert next_state(state, RigEvent.STOP) in (SupervisorState.STOPPED, SupervisorState.FAULT)
        assert next_state(state, RigEvent.FAULT) is SupervisorState.FAULT


def test_a_fault_and_a_stop_are_left_by_a_reset_alone_and_then_nothing_moves():
    for state in (SupervisorState.FAULT, SupervisorState.STOPPED):
        left = {event: new for (old, event), new in TABLE.items() if old is state and new is not state}
        assert left.pop(RigEvent.FAULT, SupervisorState.FAULT) is SupervisorState.FAULT
        assert left == {RigEvent.RESET: SupervisorState.IDLE}


def test_nothing_moves_before_the_rig_is_armed():
    reached, fresh = set(), {SupervisorState.IDLE}
    while fresh:
        reached |= fresh
        steps = ((old, event, new) for (old, event), new in TABLE.items() if event is not RigEvent.ARM)
        fresh = {new for old, _, new in steps if old in reached} - reached
    assert not reached & MOVING


@pytest.mark.parametrize(
    "event", [event for event in RigEvent if event not in (RigEvent.STOP, RigEvent.FAULT)]
)
def test_only_requests_of_a_motion_begin_one(event):
    begins = {new for (old, found), new in TABLE.items() if found is event and old in REST and new in MOVING}
    if begins:
        assert event in (RigEvent.HOME, RigEvent.JOG, RigEvent.RETRACT, RigEvent.STEP)
