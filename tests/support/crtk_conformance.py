"""Conformance checks of the ROS 2 topics of an arm: the same checks for the dVRK console and for the simulated arm.

`observe` returns one short text per check. Two arms conform to each other if all texts are equal.
"""

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from dvrk_console import Console, start_console
from waiting import TIMEOUT, wait_until

#: Time after which a command that was not executed counts as refused [s].
REFUSED = 0.5
#: Longest duration of a motion or of homing [s].
MOTION = 20.0


class SimulatedArm(Console):
    """Simulated arm `dvrk-drake arm --ros`, with the methods of the console."""

    def enable_and_home(self):
        self.state_command("enable")
        wait_until(lambda: self.state() == ("ENABLED", False, False), "enabled", self.process)
        self.state_command("home")
        wait_until(lambda: self.state() == ("ENABLED", True, False), "homed", self.process)


@contextlib.contextmanager
def start_simulated_arm(arm, name, *options):
    """Context in which a simulated arm runs.

    Args:
        arm: Name of the arm for --arm, e.g. "mtml".
        name: Name of the arm in its topics, e.g. "MTML".
        *options: Further options of `dvrk-drake arm`.
    """
    from dvrk_drake.systems.ros.domain import RosDomain

    command = [sys.executable, "-u", "-m", "dvrk_drake.cli", "arm", "--arm", arm, "--ros", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    subject = SimulatedArm(name, process, process.pid, Path(os.devnull), RosDomain())
    try:
        wait_until(subject.state, "operating state", process)
        yield subject
    finally:
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=TIMEOUT)
        process.kill()


@contextlib.contextmanager
def start(kind, arm, folder, *, motion=False):
    """Context in which a "console" or a "simulated" arm runs, by the name of the arm in its topics."""
    if kind == "console":
        with start_console(arm, folder, motion=motion) as subject:
            yield subject
    else:
        with start_simulated_arm(arm.rstrip("0123456789").lower(), arm) as subject:
            yield subject


class Observer:
    """Observations of one arm.

    Attributes:
        found: Mapping from each check to the observed text.
    """

    def __init__(self, subject):
        from dvrk_drake.systems.ros import messages

        self.subject, self.m, self.found = subject, messages, {}

    def endpoints(self, names):
        """Observes type and quality of service of topics, from DDS discovery."""
        domain, namespace = self.subject.domain, f"/{self.subject.arm}/"
        for name, is_published in names.items():
            discovered = domain.publishers if is_published else domain.subscribers

            def matching(name=name, discovered=discovered):
                return [e for e in discovered() if e.topic == namespace + name and not e.is_own]

            domain.wait_until(matching, 2.0)
            for e in matching()[:1]:
                quality = f"{'reliable' if e.reliable else 'best effort'}, {'latched' if e.latched else 'volatile'}"
                self.found[f"{name}: type, quality of service"] = f"{e.type_name}, {quality}"

    def state_after(self, label, words, goal):
        """Observes the operating state after state commands. Waits at most for a motion if `goal` is not reached."""
        for word in words[:-1]:
            self.subject.state_command(word)
            self.settle(REFUSED)
        self.subject.state_command(words[-1])
        self.subject.domain.wait_until(lambda: self.subject.state() == goal, MOTION if goal else REFUSED)
        state, homed, busy = self.subject.state()
        self.found[label] = f"{state}, {'homed' if homed else 'not homed'}{', busy' if busy else ''}"

    def settle(self, seconds):
        """Receives messages for some seconds."""
        self.subject.domain.wait_until(lambda: bool(self.subject.state()) and False, seconds)

    def position(self):
        return np.array(self.subject.latest().position)

    def moved(self, label, name, message, wait=MOTION, goal=None, tolerance=0.02):
        """Observes whether a command moves the arm, by the joint positions [rad, m] that it reaches."""
        before = self.position()
        self.subject.command(name, message)
        if goal is not None:
            self.subject.domain.wait_until(
                lambda: np.allclose(self.position(), goal, rtol=0, atol=tolerance), wait, poll=0.05
            )
        else:
            self.settle(REFUSED)
        after = self.position()
        if goal is not None and np.allclose(after, goal, rtol=0, atol=tolerance):
            self.found[label] = "reached"
        elif np.allclose(after, before, rtol=0, atol=tolerance):
            self.found[label] = "not moved"
        else:
            self.found[label] = f"moved to {np.round(after, 2).tolist()}"


def observe(subject, arm, *, motion):
    """Returns a mapping from each check to the observed text.

    Args:
        subject: Console or simulated arm in the state DISABLED.
        arm: The `Arm`.
        motion: Whether to observe move_jp, servo_cp and the Cartesian topics.
    """
    look = Observer(subject)
    m, found = look.m, look.found
    n = arm.num_joints - bool(arm.separate_joint)
    published = ["measured_js", "operating_state"]
    received = ["servo_jp", "servo_jf", "hold", "free", "state_command", "use_gravity_compensation"]
    if arm.console_gravity_compensation:
        published.append("gravity_compensation/setpoint_js")
    if motion:
        published += ["setpoint_js", "measured_cp", "measured_cv"]
        received += ["move_jp", "servo_cp"]
    look.endpoints(dict.fromkeys(published, True))
    look.endpoints(dict.fromkeys(received, False))
    late = subject.domain.subscribe(f"/{subject.arm}/operating_state", m.OperatingState, depth=100, latched=True)
    found["operating_state for a late subscription"] = (
        "received" if subject.domain.wait_until(lambda: bool(late.take()), 5.0) else "not received"
    )
    first = subject.latest()
    found["measured_js before home: header stamp"] = "0" if first.header.nanoseconds == 0 else "valid"
    look.state_after("DISABLED, then pause", ["pause"], None)
    look.state_after("DISABLED, then home", ["home"], None)
    look.state_after("DISABLED, then an unknown word", ["dance"], None)
    look.state_after("enable", ["enable"], ("ENABLED", False, False))
    look.settle(2.0)  # the console cannot home an arm immediately after its start
    look.state_after("home", ["home"], ("ENABLED", True, False))
    look.settle(1.0)
    message = subject.latest()
    found["measured_js after home: names"] = ", ".join(message.name)
    sizes = [len(message.position), len(message.velocity), len(message.effort)]
    found["measured_js after home: numbers"] = ", ".join(map(str, sizes))
    found["measured_js after home: header stamp"] = (
        "time of day" if abs(message.header.nanoseconds - time.time_ns()) < 5e9 else "other"
    )
    look.state_after("pause", ["pause"], ("PAUSED", True, False))
    q = look.position()
    goal = q + 0.05 * np.where(arm.prismatic[:n], 0.1, 1.0)
    look.moved("servo_jp while PAUSED", "servo_jp", m.JointState(m.Header.now(), position=goal.tolist()))
    look.state_after("resume", ["resume"], ("ENABLED", True, False))
    look.moved("servo_jp", "servo_jp", m.JointState(m.Header.now(), position=goal.tolist()), goal=goal)
    look.moved("hold", "hold", m.Empty())
    for label, values in {
        "servo_jp with a number too few": q[:-1].tolist(),
        "servo_jp with a number too many": [*q.tolist(), 0.0],
        "servo_jp with NaN": [math.nan, *q[1:].tolist()],
        "servo_jp without numbers": [],
    }.items():
        look.moved(label, "servo_jp", m.JointState(m.Header.now(), position=values), tolerance=0.02)
        subject.command("hold", m.Empty())
    over = look.position()
    over[0] = arm.position_upper[0] + 0.3
    limit = over.copy()
    limit[0] = arm.position_upper[0]
    look.moved(
        "servo_jp beyond a limit: joint at its limit",
        "servo_jp",
        m.JointState(m.Header.now(), position=over.tolist()),
        goal=limit,
        tolerance=0.05,
    )
    subject.command("servo_jp", m.JointState(m.Header.now(), position=goal.tolist()))
    subject.wait_for_position(goal, 0.02)
    if arm.console_gravity_compensation:
        subject.command("use_gravity_compensation", m.Bool(False))
        look.settle(REFUSED)
        effort = subject.latest("gravity_compensation/setpoint_js").effort
        found["gravity_compensation/setpoint_js after false"] = (
            f"{len(effort)} efforts, largest {max(map(abs, effort))}"
        )
    if motion:
        busy = []
        subject.command("move_jp", m.JointState(m.Header.now(), position=(goal + 0.2 * (q - goal)).tolist()))
        subject.domain.wait_until(lambda: busy.append(subject.state()) or subject.state()[2], 2.0, poll=0.001)
        found["is_busy during move_jp"] = str(any(state[2] for state in busy))
        look.moved("move_jp", "move_jp", m.JointState(m.Header.now(), position=q.tolist()), goal=q)
        pose = subject.latest("measured_cp", m.PoseStamped).pose
        p, o = pose.position, pose.orientation
        found["measured_cp: orientation is a unit quaternion"] = str(abs(math.hypot(o.x, o.y, o.z, o.w) - 1.0) < 1e-6)
        found["measured_cp: distance from the origin [m]"] = f"{math.hypot(p.x, p.y, p.z):.2f}"
        above = m.PoseStamped(m.Header.now(), m.Pose(m.Point(p.x, p.y, p.z + 0.01), o))
        subject.command("servo_cp", above)
        subject.domain.wait_until(
            lambda: subject.latest("measured_cp", m.PoseStamped).pose.position.z > p.z + 0.008, 5.0, poll=0.05
        )
        rise = subject.latest("measured_cp", m.PoseStamped).pose.position.z - p.z
        found["servo_cp 10 mm along z: rise [mm]"] = f"{1e3 * rise:.0f}"
    look.state_after("disable", ["disable"], ("DISABLED", True, False))
    look.state_after("enable after disable", ["enable"], ("ENABLED", False, False))
    return found
