"""States of the command guard and the table of its transitions."""

from __future__ import annotations

from enum import Enum, auto

from dvrk_drake.lcmtypes import lcmt_dvrk_status


class State(Enum):
    """State of the guard. `CommandGuard` describes the behaviour of the arm in each state.

    Several states have one code in the status message, because they differ only in what may follow.

    Attributes:
        code: State in the status message, lcmt_dvrk_status.STATE_*.
        is_powered: True if the motors have power.
        is_regulated: True if the arm's own position controller regulates the arm to a target.
        keeps_target: True if the next state continues to hold the target. Otherwise it latches the measured pose. After
            POSITION, the target is kept as well if the arm is near it.
        has_stream: True if the commands of a sender are monitored or act.
        has_acted: True if a POSITION or EFFORT command has acted since the last HOLD. An operator must then resume
            after a watchdog hold.
    """

    #       code, is_powered, is_regulated, keeps_target, has_stream, has_acted
    OFF = lcmt_dvrk_status.STATE_OFF, False, False, False, False, False
    HOLD = lcmt_dvrk_status.STATE_HOLD, True, True, True, False, False
    STARTING = lcmt_dvrk_status.STATE_STARTING, True, True, True, True, False
    #: STARTING after POSITION or EFFORT, because the sender changed the mode.
    CHANGING_MODE = lcmt_dvrk_status.STATE_STARTING, True, True, True, True, True
    POSITION = lcmt_dvrk_status.STATE_POSITION, True, True, False, True, True
    EFFORT = lcmt_dvrk_status.STATE_EFFORT, True, False, False, True, True
    FAULT = lcmt_dvrk_status.STATE_FAULT, True, True, True, False, False
    #: FAULT in which the guard itself regulates the joints with a valid position, with reduced gains.
    SAFE_FAULT = lcmt_dvrk_status.STATE_FAULT, True, False, True, False, False
    UNPOWERED_FAULT = lcmt_dvrk_status.STATE_FAULT, False, False, False, False, False

    def __init__(self, code: int, *flags: bool) -> None:
        """Stores the columns of the table above."""
        self.code = code
        self.is_powered, self.is_regulated, self.keeps_target, self.has_stream, self.has_acted = flags


class Event(Enum):
    """Cause of a transition. The first four are accepted commands."""

    HOLD = auto()
    OFF = auto()
    #: POSITION or EFFORT command that begins a start check.
    START = auto()
    #: HOLD command that resets a fault.
    RESET = auto()
    #: End of a start check for POSITION or EFFORT.
    ACT_POSITION = auto()
    ACT_EFFORT = auto()
    #: Expired command, invalid measurement, long period, HOLD of another sender.
    WATCHDOG = auto()
    FAULT = auto()
    #: Fault whose cause may be the loop of the arm's own position controller.
    UNSAFE_LOOP = auto()
    POWER_LOSS = auto()
    #: Output of the guard that is not finite.
    BAD_OUTPUT = auto()


_WITH_STREAM = tuple(state for state in State if state.has_stream)
_STARTING = (State.STARTING, State.CHANGING_MODE)

#: For each event, the states in which it has an effect, each with the next state.
TRANSITIONS: dict[Event, dict[State, State]] = {
    Event.HOLD: dict.fromkeys((State.OFF, State.HOLD, *_WITH_STREAM), State.HOLD),
    Event.OFF: dict.fromkeys((State.OFF, State.HOLD), State.OFF),
    Event.START: dict.fromkeys((State.HOLD, State.STARTING), State.STARTING)
    | dict.fromkeys((State.CHANGING_MODE, State.POSITION, State.EFFORT), State.CHANGING_MODE),
    Event.RESET: dict.fromkeys((State.FAULT, State.SAFE_FAULT, State.UNPOWERED_FAULT), State.HOLD),
    Event.ACT_POSITION: dict.fromkeys(_STARTING, State.POSITION),
    Event.ACT_EFFORT: dict.fromkeys(_STARTING, State.EFFORT),
    Event.WATCHDOG: dict.fromkeys(_WITH_STREAM, State.HOLD),
    Event.FAULT: {State.OFF: State.UNPOWERED_FAULT} | dict.fromkeys((State.HOLD, *_WITH_STREAM), State.FAULT),
    Event.UNSAFE_LOOP: {State.FAULT: State.SAFE_FAULT},
    Event.POWER_LOSS: dict.fromkeys((State.FAULT, State.SAFE_FAULT), State.UNPOWERED_FAULT),
    Event.BAD_OUTPUT: {State.SAFE_FAULT: State.FAULT},
}
