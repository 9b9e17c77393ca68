"""Tests of the table of transitions of the command guard."""

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.systems.guard.states import TRANSITIONS, Event, State


def after(event):
    """Returns the codes of all states that follow the event."""
    return {state.code for state in TRANSITIONS[event].values()}


def rows():
    """Returns all transitions: state, event, next state."""
    return [(state, event, after) for event, states in TRANSITIONS.items() for state, after in states.items()]


def test_each_state_is_reached_from_hold():
    reached, new = set(), {State.HOLD}
    while new:
        reached |= new
        new = {next_state for state, _, next_state in rows() if state in reached} - reached
    assert reached == set(State)


def test_each_state_but_a_fault_leads_to_hold_and_to_a_fault():
    for state in State:
        is_fault = state.code == Status.STATE_FAULT
        assert (state in TRANSITIONS[Event.HOLD]) != is_fault
        assert (state in TRANSITIONS[Event.RESET]) == is_fault
        assert (state in TRANSITIONS[Event.FAULT]) != is_fault
        assert (state in TRANSITIONS[Event.WATCHDOG]) == state.has_stream


def test_only_a_start_check_leads_to_commands_that_act():
    for state, event, next_state in rows():
        if next_state in (State.POSITION, State.EFFORT):
            assert state.code == Status.STATE_STARTING and event in (Event.ACT_POSITION, Event.ACT_EFFORT)


def test_only_a_reset_ends_a_fault():
    for state, event, next_state in rows():
        if state.code == Status.STATE_FAULT and next_state.code != Status.STATE_FAULT:
            assert event is Event.RESET and next_state is State.HOLD


def test_motors_get_power_only_by_hold_or_reset():
    for state, event, next_state in rows():
        if not state.is_powered and next_state.is_powered:
            assert event in (Event.HOLD, Event.RESET) and next_state is State.HOLD
