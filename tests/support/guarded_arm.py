"""Link to a guarded arm, with a simulated clock and without a network."""

from guard_bench import ARM, LIMIT, SESSION, N, Q, Weightless

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.settings import GuardSettings, PlausibilitySettings
from dvrk_drake.systems.lcm.messages import fill_in_guard

INDULGENT = GuardSettings(plausibility=PlausibilitySettings(tracking_error=1.0))


class GuardedArm:
    """Link to an arm that does not move, and to its guard. A status arrives every simulated millisecond.

    The measured effort is constant, so the guard does not compare it with the commands.
    """

    def __init__(self, modes=None):
        self.arm, self.lost, self.utime = ARM, 0, 10**9
        self.guard = CommandGuard(ARM, SESSION, Weightless(), INDULGENT, modes=modes)
        self.commands, self.status = [], Status()
        self.before_step = lambda: None
        self.status.arm_name, self.status.num_joints = ARM.name, N
        self.status.position, self.status.velocity = list(Q), [0.0] * N
        self.status.effort_measured = self.status.effort_commanded = list(0.05 * LIMIT)

    def now(self):
        return 1e-6 * self.utime

    def next_status(self, seconds):
        self.utime += 1000
        self.before_step()
        status = Status.decode(self.status.encode()) if self.status.session_id else self.status
        status.utime, status.sequence = self.utime, self.status.sequence + 1
        self.guard.step(status.utime, status.utime, status.position, status.velocity, status.effort_measured)
        fill_in_guard(status, self.guard)
        self.status = status
        return status

    def release(self):
        return False

    def close(self):
        pass

    def send(self, command):
        self.commands.append(command)
        self.guard.receive(command, self.utime)


def after(count, action):
    """Returns a function that calls `action` at its call number `count`."""
    calls = []

    def step():
        calls.append(None)
        if len(calls) == count:
            action()

    return step
