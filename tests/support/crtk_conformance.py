"""Conformance checks of the ROS 2 topics of an arm: the same checks for the dVRK console and for the simulated arm.

Each check is one short text. Two arms conform to each other if all texts are equal. Set-points are compared where
possible, because they are exact for both arms.
"""

import contextlib
import math
import os
import signal
import time
from pathlib import Path

import numpy as np
from arm_processes import dvrk_drake
from dvrk_console import Console, start_console
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from waiting import wait_until

#: Rate of the topics [Hz].
RATE = 200
#: Time, and number of messages of the arm, after which a command without effect counts as refused [s]. A busy computer
#: delays the messages as well as the effect.
REFUSED, NUM_REFUSED = 0.1, 20
#: Time after which a state is final [s]. A PSM engages its instrument after homing.
STEADY = 0.3
#: Longest duration of a motion, of homing or of a change of state [s].
LONGEST = 20.0


@contextlib.contextmanager
def start_simulated_arm(arm, name, rate=RATE, *options):
    """Context in which a simulated arm runs. It is in the state DISABLED.

    Args:
        arm: Name of the arm for --arm, e.g. "mtml".
        name: Name of the arm in its topics, e.g. "MTML".
        rate: Rate of the measurements [Hz].
        options: Further options of `sim-arm`.
    """
    from dvrk_drake.systems.ros.domain import RosDomain

    process = dvrk_drake("sim-arm", "--arm", arm, "--transport", "ros", "--rate", rate, *options)
    subject = Console(name, process, process.pid, Path(os.devnull), RosDomain(0))
    try:
        wait_until(subject.state, "operating state", process)
        yield subject
    finally:
        process.end(signal.SIGINT)


class Observer:
    """Observations of one arm.

    Attributes:
        found: Mapping from each check to the observed text.
    """

    def __init__(self, subject, arm):
        from dvrk_drake.dynamics.kinematics import ArmFrame
        from dvrk_drake.systems.ros import messages

        self.subject, self.arm, self.m, self.found = subject, arm, messages, {}
        self.kinematics = ArmFrame(arm)

    def wait_for(self, condition, seconds=LONGEST):
        """Waits at most some seconds for a condition. Returns whether it holds."""
        return self.subject.domain.wait_until(condition, seconds, poll=0.01)

    def endpoints(self):
        """Observes types and qualities of service, from DDS discovery, of the topics of the console's `run.py`."""
        domain, namespace = self.subject.domain, f"/{self.subject.arm}/"
        published = ["measured_js", "operating_state"]
        received = ["servo_jp", "servo_jf", "hold", "free", "state_command", "use_gravity_compensation"]
        if self.arm.separate_joint:
            received.append(f"{self.arm.separate_joint}/servo_jf")
        else:
            published.append("gravity_compensation/setpoint_js")
        for name in published + received:
            discovered = domain.publishers if name in published else domain.subscribers

            def matching(name=name, discovered=discovered):
                return [e for e in discovered() if e.topic == namespace + name and not e.is_own]

            self.wait_for(matching)
            e = matching()[0]
            quality = f"{'reliable' if e.reliable else 'best effort'}, {'latched' if e.latched else 'volatile'}"
            self.found[f"{name}: type, quality of service"] = f"{e.type_name}, {quality}"

    def rate(self):
        """Observes the rate of measured_js."""
        times = []
        topic = self.subject.domain.subscribe(f"/{self.subject.arm}/measured_js", self.m.JointState, depth=1000)
        self.wait_for(lambda: times.extend(published for _, published in topic.take()) or len(times) > 2 * RATE)
        # On a busy computer, single messages are late.
        rate = 1e9 / np.median(np.diff(times))
        self.found[f"measured_js: rate, {RATE} Hz requested"] = (
            "within 25 %" if abs(rate / RATE - 1.0) < 0.25 else f"{rate:.0f} Hz"
        )

    def state_after(self, label, words, goal=None, seconds=LONGEST):
        """Observes the operating state after state commands.

        Args:
            label: Name of the check.
            words: State commands, sent one after the other.
            goal: State (state, is_homed) that ends the wait. None: the state after `pause`.
            seconds: Longest time to wait for `goal` [s].
        """
        for word in words:
            self.subject.state_command(word)
            self.pause()
        if goal is not None:
            self.wait_for_state(*goal, seconds)
        state, homed, busy = self.subject.state()
        self.found[label] = f"{state}, {'homed' if homed else 'not homed'}{', busy' if busy else ''}"

    def wait_for_state(self, state, is_homed, seconds=LONGEST):
        """Waits until an arm is in a state and not busy for the time `STEADY`."""
        reached = None

        def is_steady():
            nonlocal reached
            if self.subject.state() != (state, is_homed, False):
                reached = None
            elif reached is None:
                reached = time.monotonic()
            return reached is not None and time.monotonic() > reached + STEADY

        return self.wait_for(is_steady, seconds)

    def home_again(self):
        """Disables, enables and homes the arm."""
        for word, state in {"disable": "DISABLED", "enable": "ENABLED", "home": "ENABLED"}.items():
            self.subject.state_command(word)
            wait_until(lambda state=state: self.subject.state()[0] == state, word, self.subject.process)
            self.wait_for_state("ENABLED", word == "home") if state == "ENABLED" else self.pause()

    def pause(self):
        """Waits for the effects of a command."""
        end = time.monotonic() + REFUSED
        for _ in range(NUM_REFUSED):
            self.subject.latest("setpoint_js")
        wait_until(lambda: time.monotonic() > end, "effects", self.subject.process)

    def setpoint(self):
        return np.array(self.subject.latest("setpoint_js").position)

    def command(self, label, name, message, goal=None):
        """Observes the set-point after a command.

        Args:
            label: Name of the check.
            name: Name of the command topic.
            message: Message of the command.
            goal: Expected set-point [rad, m]. None: the set-point before the command.
        """

        def is_at(q):
            return np.allclose(self.setpoint(), q, rtol=0, atol=1e-4)

        before = self.setpoint()
        self.subject.command(name, message)
        if goal is None:
            self.pause()
        elif self.wait_for(lambda: is_at(goal)):
            self.found[label] = "set-point reached"
            return
        moved = np.round(self.setpoint(), 2) + 0.0
        self.found[label] = "set-point unchanged" if is_at(before) else f"set-point {moved.tolist()}"

    def pose_of(self, q):
        """Returns the pose of the arm's kinematics at the joint positions of a message."""
        return self.kinematics.pose(np.append(q, np.zeros(self.arm.num_joints - len(q))))

    def measured_pose(self):
        pose = self.subject.latest("measured_cp", self.m.PoseStamped).pose
        p, o = pose.position, pose.orientation
        return RigidTransform(Quaternion(wxyz=np.array([o.w, o.x, o.y, o.z])), [p.x, p.y, p.z])

    def pose(self, label):
        """Observes whether measured_cp is the pose at the joint positions in measured_js."""

        def agrees():
            error = self.pose_of(self.subject.latest().position).inverse() @ self.measured_pose()
            return np.linalg.norm(error.translation()) < 1e-3 and error.rotation().ToAngleAxis().angle() < 5e-3

        # The messages differ while a simulated arm still moves to its set-point.
        self.found[label] = "equal" if self.wait_for(agrees, 5.0) else "different"


def observe_endpoints(subject, arm):
    """Returns the observations of the topics of the console's `run.py`: types, qualities of service and rate."""
    look = Observer(subject, arm)
    look.endpoints()
    look.rate()
    return look.found


def observe(subject, arm):
    """Returns a mapping from each check of states, commands and measurements to the observed text.

    Args:
        subject: Console with the topics for motions, or simulated arm, in the state DISABLED.
        arm: The `Arm`.
    """
    look = Observer(subject, arm)
    m, found = look.m, look.found
    n = arm.num_joints - bool(arm.separate_joint)

    def joints(values):
        return m.JointState(m.Header.now(), position=list(map(float, values)))

    # Early publishers, so that the first messages are not lost.
    for name in ("servo_jp", "move_jp", "servo_jf"):
        subject.advertise(name, m.JointState)
    subject.advertise("servo_cp", m.PoseStamped)
    subject.advertise("hold", m.Empty)
    late = subject.domain.subscribe(f"/{subject.arm}/operating_state", m.OperatingState, depth=100, latched=True)
    found["operating_state for a late subscription"] = "received" if look.wait_for(late.take) else "not received"

    for name, kind in {"measured_js": m.JointState, "setpoint_js": m.JointState, "measured_cp": m.PoseStamped}.items():
        found[f"{name} before homing: header stamp"] = str(subject.latest(name, kind).header.nanoseconds)
    found["measured_js before homing: names, positions"] = (
        f"{len(subject.latest().name)}, {len(subject.latest().position)}"
    )
    for word in ("pause", "home", "resume", "dance"):
        look.state_after(f"DISABLED, then {word}", [word])
    look.state_after("enable", ["enable"], ("ENABLED", False))
    for word in ("resume", "enable"):
        look.state_after(f"ENABLED, not homed, then {word}", [word])
    before = len(subject.states)
    look.state_after("home", ["home"], ("ENABLED", True))
    found["is_busy while homing"] = str(any(busy for *_, busy in subject.states[before:]))
    look.wait_for(lambda: len(subject.latest().name) == n)

    message = subject.latest()
    found["measured_js: names"] = ", ".join(message.name)
    found["measured_js: positions, velocities, efforts"] = ", ".join(
        str(len(values)) for values in (message.position, message.velocity, message.effort)
    )
    is_now = abs(message.header.nanoseconds - time.time_ns()) < 5e9
    found["measured_js: header stamp"] = "time of day" if is_now else "other"
    stamps = [subject.latest().header.nanoseconds for _ in range(50)]
    found["measured_js: header stamps increase"] = str(bool(np.all(np.diff(stamps) > 0)))
    found["measured_cp: header frame"] = subject.latest("measured_cp", m.PoseStamped).header.frame_id
    found["measured_cv: header frame"] = subject.latest("measured_cv", m.TwistStamped).header.frame_id
    look.pose("measured_cp and measured_js at the home pose")

    home = look.setpoint()
    near = home + np.where(arm.prismatic[:n], 0.005, 0.05)
    look.state_after("pause", ["pause"], ("PAUSED", True))
    look.command("servo_jp while PAUSED", "servo_jp", joints(near))
    look.state_after("resume", ["resume"], ("ENABLED", True))
    look.command("servo_jp", "servo_jp", joints(near), near)
    look.command("hold", "hold", m.Empty())
    for label, values in {
        "servo_jp with a number too few": home[:-1],
        "servo_jp with a number too many": [*home, 0.0],
        "servo_jp with NaN": [math.nan, *home[1:]],
        "servo_jp without numbers": [],
    }.items():
        look.command(label, "servo_jp", joints(values))
    far = near + np.array([0.1, -0.1, 0.02, 0.2, 0.2, -0.1, 0.3])[:n]
    before = len(subject.states)
    look.command("move_jp", "move_jp", joints(far), far)
    look.wait_for(lambda: not subject.state()[2])
    found["is_busy during move_jp"] = str(any(busy for *_, busy in subject.states[before:]))
    look.pose("measured_cp and measured_js at a second pose")
    look.command("move_jp with a number too few", "move_jp", joints(near[:-1]))
    limit = far.copy()
    limit[0], beyond = arm.position_upper[0], 0.3 * np.eye(n)[0]
    look.command("move_jp beyond a limit, goal at the limit", "move_jp", joints(limit + beyond), limit)
    look.wait_for(lambda: not subject.state()[2])
    look.command("servo_jp beyond a limit, goal at the limit", "servo_jp", joints(limit + beyond), limit)
    look.command("move_jp to a third pose", "move_jp", joints(near), near)
    look.pose("measured_cp and measured_js at a third pose")

    X = look.pose_of(look.setpoint())
    p, o = X.translation() + np.array([0, 0, 0.005]), X.rotation().ToQuaternion()
    goal = m.PoseStamped(m.Header.now(), m.Pose(m.Point(*p), m.Quaternion(o.x(), o.y(), o.z(), o.w())))
    subject.command("servo_cp", goal)

    def distance():
        return np.linalg.norm(look.pose_of(look.setpoint()).translation() - p)

    found["servo_cp, 5 mm along z"] = (
        "set-point reached" if look.wait_for(lambda: distance() < 1e-4) else f"{1e3 * distance():.1f} mm away"
    )

    effort = np.round(0.01 * arm.effort_limits[:n], 4)
    subject.command("servo_jf", m.JointState(m.Header.now(), effort=effort.tolist()))

    def is_applied():
        return np.allclose(subject.latest("setpoint_js").effort, effort, rtol=0, atol=1e-6)

    found["servo_jf: setpoint_js.effort is the command"] = str(look.wait_for(is_applied, 5.0))
    subject.command("hold", m.Empty())
    found["hold after servo_jf: setpoint_js.effort is the command"] = str(
        not look.wait_for(lambda: not is_applied(), 5.0)
    )
    if not arm.separate_joint:
        subject.command("use_gravity_compensation", m.Bool(False))
        name = "gravity_compensation/setpoint_js"
        is_off = look.wait_for(lambda: subject.latest(name).effort == [0.0] * n, 5.0)
        found["gravity compensation off: efforts are 0"] = str(is_off)
        found["gravity_compensation/setpoint_js: names"] = ", ".join(subject.latest(name).name)
    else:
        subject.command("jaw/move_jp", joints([0.2]))
        opens = look.wait_for(lambda: abs(subject.latest("jaw/setpoint_js").position[0] - 0.2) < 1e-4)
        found["jaw/move_jp"] = "set-point reached" if opens else "not reached"
        found["jaw/measured_js: names"] = ", ".join(subject.latest("jaw/measured_js").name)

    look.state_after("disable", ["disable"], ("DISABLED", True))
    found["measured_js after disable: positions"] = str(len(subject.latest().position))
    look.state_after("enable after disable", ["enable"], ("ENABLED", False))
    look.state_after("home again", ["home"], ("ENABLED", True))
    look.state_after("pause, pause, resume", ["pause", "pause", "resume"], ("ENABLED", True), 2.0)
    look.home_again()
    if arm.separate_joint:
        jump = look.setpoint() + np.array([0, 0, 0.07, 0, 0, 0])
        subject.command("servo_jp", joints(jump))
        look.state_after("servo_jp with a jump of 70 mm", [], ("FAULT", True), 5.0)
        look.home_again()
    look.state_after("unhome", ["unhome"], ("ENABLED", False))
    found["measured_js after unhome: header stamp"] = "0" if subject.latest().header.nanoseconds == 0 else "time of day"
    look.state_after("unhome, then home", ["home"], ("ENABLED", True), 5.0)
    return found


def compare(name, folder):
    """Returns the observations of both arms: a mapping from each check to the pair (console, simulated arm).

    Args:
        name: Name of the arm in its topics, e.g. "MTML".
        folder: Existing folder for temporary files.
    """
    from dvrk_drake.models.arm_files import load_arm

    file = name.rstrip("1").lower()
    arm = load_arm(file)
    with start_console(name, folder, rate=RATE) as console:
        expected = observe_endpoints(console, arm)
    with start_console(name, folder, rate=RATE, motion=True) as console:
        expected |= observe(console, arm)
    with start_simulated_arm(file, name) as simulated:
        found = observe_endpoints(simulated, arm) | observe(simulated, arm)
    assert found.keys() == expected.keys()
    return {check: (text, found[check]) for check, text in expected.items()}
