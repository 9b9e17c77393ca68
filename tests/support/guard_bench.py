"""Test bench for a command guard. The test sets the clock, the measured state and the commands."""

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.measurement import PeriodMonitor
from dvrk_drake.systems.guard.plausibility import Plausibility

ARM = load_arm("mtml")
N = ARM.num_joints
LIMIT = ARM.effort_limits
SESSION = 77
Q = np.array([0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5])  # inside all limits
MS = 1000
#: Damping of the position controller per inertia [1/s], as in the arm files.
DAMPING = 150.0
#: Accepted modes for tests that switch the arm off. By default a guard refuses OFF.
WITH_OFF = (Command.POSITION, Command.EFFORT, Command.OFF)


def modes(*allowed):
    """Returns `accepted_modes` with the given modes."""
    return sum(1 << mode for mode in allowed)


class Weightless:
    """Model without gravity and inertia, for an arm that does not move."""

    def gravity_effort(self, q):
        return np.zeros(len(q))

    def mass_matrix(self, q):
        return np.zeros((len(q), len(q)))


class Heavy(Weightless):
    """Model whose gravity effort is a known function of the pose, up to 0.2 times the effort limits."""

    def gravity_effort(self, q):
        return 0.2 * LIMIT * np.cos(q)


class Inert(Heavy):
    """Model with gravity and constant inertias, for the damping in the safe state."""

    def mass_matrix(self, q):
        return np.diag(np.array(ARM.gains.kd) / DAMPING)


class Unchecked(Plausibility):
    """Plausibility check that accepts all measurements, because the test sets the state of the arm."""

    def check(self, dt, q, v, effort, commanded, invalid_effort=None):
        self.gravity, self._poses = self.model.gravity_effort(q), (q, q)
        return ""


class Untimed(PeriodMonitor):
    """Period monitor that accepts every period."""

    def add(self, period):
        return ""


class Bench:
    """Guard of an arm at rest, with a clock.

    The checks of measurements and of the guard period are disabled unless `checks` is True.
    """

    def __init__(self, arm=ARM, *, q=Q, model=None, checks=False, **arguments):
        self.arm = arm
        model = model or Weightless()
        self.guard = CommandGuard(arm, SESSION, model, **arguments)
        if not checks:
            settings = self.guard.settings
            self.guard._plausibility = Unchecked(arm, model, settings.plausibility, self.guard.limits.speed)
            self.guard._period = Untimed(settings)
        self.utime = 1_700_000_000_000_000
        self.q = np.array(q) if arm is ARM else 0.5 * (arm.position_lower + arm.position_upper)
        self.v, self.effort = np.zeros(arm.num_joints), 0.05 * arm.effort_limits
        self.sequence = 0
        self.age = 0  # age of the measurement [us]
        self.follows = False  # whether the arm reaches commanded positions immediately
        self.output = self.step()

    def at_rest(self):
        """Sets the measured effort to the model's gravity effort."""
        self.effort = self.guard._plausibility.model.gravity_effort(self.q)
        self.tick()
        return self

    def step(self):
        return self.guard.step(self.utime, self.utime - self.age, self.q, self.v, self.effort)

    def command(self, mode=Command.EFFORT, *, sender=5, **fields):
        self.sequence += 1
        command = Command()
        command.utime, command.sequence, command.sender_id = self.utime - 10**15, self.sequence, sender
        command.session_id, command.status_utime = SESSION, self.utime
        command.arm_name, command.control_mode, command.num_joints = self.arm.name, mode, self.arm.num_joints
        command.position, command.velocity, command.effort = (
            list(self.q),
            [0.0] * self.arm.num_joints,
            list(self.effort),
        )
        for name, value in fields.items():
            setattr(command, name, value)
        return command

    def send(self, mode=Command.EFFORT, **fields):
        return self.guard.receive(self.command(mode, **fields), self.utime)

    def tick(self, milliseconds=1):
        for _ in range(milliseconds):
            self.utime += MS
            self.output = self.step()
            if self.follows:
                self.q = self.output.position.copy()
        return self.output

    def run(self, mode, milliseconds, **fields):
        """Sends a stream of valid commands, one per millisecond."""
        for _ in range(milliseconds):
            assert self.send(mode, **fields) == Status.REFUSAL_NONE
            self.tick()
        return self.output

    def started(self, mode=Command.EFFORT):
        self.run(mode, 260)
        assert self.guard.state == {Command.EFFORT: Status.STATE_EFFORT, Command.POSITION: Status.STATE_POSITION}[mode]
        return self
