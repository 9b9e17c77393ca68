"""Bridge process, operator and monitor of ROS topics, for tests and benchmarks in a network namespace."""

import effort_controller
import lcm
from arm_observer import Observer
from arm_processes import Forked, dvrk_drake
from effort_controller import LENIENT_DRIVER, effort_command
from waiting import wait_until

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.systems.lcm.messages import draw_id


def start_bridge(arm, folder, *options):
    """Starts `dvrk-drake bridge` with a lenient guard; see `LENIENT_DRIVER`."""
    driver = folder / "lenient.yaml"
    driver.write_text(LENIENT_DRIVER)
    return dvrk_drake("bridge", "--arm", arm, "--driver", driver, "--realtime", *options)


def start_controller(arm, *options):
    """Starts a controller that commands efforts of zero; see `effort_controller`."""
    return Forked(effort_controller.main, arm, *options)


def wait_for_line(process, text, after=0):
    """Waits until the output of a process contains a text after a number of characters. Returns this line."""
    try:
        wait_until(lambda: text in process.output()[after:], f"line with {text!r}", process)
    except AssertionError as error:
        raise AssertionError(f"{error}; {process.output()[after:]}") from None
    return next(line for line in process.output()[after:].splitlines() if text in line)


class Operator(Observer):
    """Observer that can also reset a fault of an arm."""

    def reset(self, process):
        """Commands HOLD with a reset until the guard has no fault."""
        network, sender_id, sequence = lcm.LCM(), draw_id(), 0
        start = len(self.received)

        def is_reset():
            nonlocal sequence
            sequence += 1
            status = self.last
            command = effort_command(status, [0.0] * status.num_joints, sender_id, sequence)
            command.control_mode, command.reset_fault = Command.HOLD, sequence % 2 == 0
            network.publish(f"DVRK_COMMAND_{status.arm_name}", command.encode())
            return len(self.received) > start and status.guard_state not in (0, Status.STATE_FAULT)

        wait_until(is_reset, f"reset; {process.output()}", process)


class CommandMonitor:
    """Subscriptions of the topics with which a bridge commands an arm.

    Attributes:
        messages: Received messages so far, each (name of the topic, time of publication [ns since 1970], message).
    """

    def __init__(self, domain, namespace, *more):
        from dvrk_drake.systems.ros.messages import Empty, JointState

        kinds = {"hold": Empty, "servo_jp": JointState, "servo_jf": JointState, **dict.fromkeys(more, JointState)}
        self.messages = []
        # Without wake-ups, this process may publish the same topics, see `RosDomain.subscribe`.
        self._subscriptions = {
            name: domain.subscribe(f"{namespace}/{name}", kind, depth=10_000, wakes=False)
            for name, kind in kinds.items()
        }

    def receive(self):
        """Stores the messages that have arrived. Returns all messages so far."""
        for name, subscription in self._subscriptions.items():
            self.messages += [(name, sent, message) for message, sent in subscription.take()]
        return self.messages

    def first(self, names, after):
        """Returns the time of the first message of the given topics after a time [ns since 1970], or None."""
        times = [sent for name, sent, _ in self.receive() if name in names and sent >= after]
        return min(times, default=None)

    def forget(self):
        """Deletes all messages so far."""
        self.receive()
        self.messages.clear()
