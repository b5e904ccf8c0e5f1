"""The table of states: what it allows, and what it never does."""

import pytest

from flexneedle.lab.rig.supervisor.machine import MOVING, TABLE, Event, State, accepted, after

REST = [state for state in State if state not in MOVING]


def test_every_state_can_be_stopped_and_can_fail():
    for state in State:
        assert after(state, Event.STOP) in (State.STOPPED, State.FAULT)
        assert after(state, Event.FAULT) is State.FAULT


def test_a_fault_and_a_stop_are_left_by_a_reset_alone_and_then_nothing_moves():
    for state in (State.FAULT, State.STOPPED):
        left = {event: new for (old, event), new in TABLE.items() if old is state and new is not state}
        assert left.pop(Event.FAULT, State.FAULT) is State.FAULT
        assert left == {Event.RESET: State.IDLE}


def test_nothing_moves_before_the_rig_is_armed():
    reached, fresh = set(), {State.IDLE}
    while fresh:
        reached |= fresh
        steps = ((old, event, new) for (old, event), new in TABLE.items() if event is not Event.ARM)
        fresh = {new for old, _, new in steps if old in reached} - reached
    assert not reached & MOVING


@pytest.mark.parametrize("event", [event for event in Event if event not in (Event.STOP, Event.FAULT)])
def test_only_requests_of_a_motion_begin_one(event):
    begins = {new for (old, found), new in TABLE.items() if found is event and old in REST and new in MOVING}
    if begins:
        assert event in (Event.HOME, Event.JOG, Event.RETRACT, Event.STEP)


def test_a_refused_event_changes_nothing_and_the_choices_are_known():
    assert after(State.IDLE, Event.STEP) is None
    assert accepted(State.IDLE) == (Event.ARM, Event.STOP, Event.FAULT)


def test_every_state_can_be_reached():
    reached = {State.IDLE}
    for _ in State:
        reached |= {new for (old, _), new in TABLE.items() if old in reached}
    assert reached == set(State)
