"""`dvrk-drake sim-arm --transport ros`: a real process over DDS in a network namespace, and refused options."""

import signal
import sys

import numpy as np
import pytest
from arm_processes import dvrk_drake
from command_output import refusal, refused
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT

from dvrk_drake.cli import main
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.models.arm_files import load_arm

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")
from dvrk_drake.systems.ros.crtk_client import other_publishers  # noqa: E402
from dvrk_drake.systems.ros.messages import (  # noqa: E402
    Bool,
    Empty,
    Header,
    JointState,
    OperatingState,
    PoseStamped,
    StringStamped,
    TwistStamped,
)

pytestmark = pytest.mark.network

COMMANDS = {
    "state_command": StringStamped,
    "servo_jp": JointState,
    "servo_jf": JointState,
    "move_jp": JointState,
    "servo_cp": PoseStamped,
    "move_cp": PoseStamped,
    "hold": Empty,
    "free": Empty,
    "use_gravity_compensation": Bool,
}
STATES = {
    "measured_js": JointState,
    "setpoint_js": JointState,
    "measured_cp": PoseStamped,
    "setpoint_cp": PoseStamped,
    "measured_cv": TwistStamped,
    "local/measured_cp": PoseStamped,
    "local/setpoint_cp": PoseStamped,
    "warning": StringStamped,
    "gravity_compensation/setpoint_js": JointState,
}


class Client:
    """Client of a simulated arm in another process."""

    def __init__(self, arm, namespace, *options):
        self.arm = load_arm(arm)
        self.process = dvrk_drake("sim-arm", "--arm", arm, "--transport", "ros", *options)
        self.domain, self.namespace = ros.RosDomain(0), namespace
        jaw = self.arm.separate_joint
        self.num_main = self.arm.num_joints - bool(jaw)
        jaw_commands = {f"jaw/{name}": JointState for name in ("servo_jp", "servo_jf", "move_jp")}
        jaw_states = {f"jaw/{name}_js": JointState for name in ("measured", "setpoint")}
        self.commands = {
            name: self.domain.advertise(f"{namespace}/{name}", kind)
            for name, kind in {**COMMANDS, **(jaw_commands if jaw else {})}.items()
        }
        states = {**STATES, **(jaw_states if jaw else {"gripper/measured_js": JointState})}
        self.states = {name: self.domain.subscribe(f"{namespace}/{name}", kind) for name, kind in states.items()}
        self.operating_state = self.subscribe_operating_state()
        self.last, self.reached = {}, []
        self.until(
            lambda: (
                all(command.num_subscribers() for command in self.commands.values())
                and all(state.num_publishers() for state in self.states.values())
            ),
            "the topics are connected",
        )

    def subscribe_operating_state(self):
        return self.domain.subscribe(f"{self.namespace}/operating_state", OperatingState, depth=100, latched=True)

    def until(self, condition, what):
        def updated():
            assert self.process.poll() is None, self.process.output()
            for name, subscription in self.states.items():
                for message, _ in subscription.take():
                    self.last[name] = message
            self.reached += [message for message, _ in self.operating_state.take()]
            return condition()

        assert self.domain.wait_until(updated, TIMEOUT), what

    def new(self, name):
        """Returns the next message of a topic."""
        self.last.pop(name, None)
        self.until(lambda: name in self.last, name)
        return self.last[name]

    def send(self, name, *values):
        kind = COMMANDS.get(name, JointState)
        if kind is JointState:
            field = "effort" if name.endswith("servo_jf") else "position"
            message = JointState(Header.now(), **{field: [float(value) for value in values]})
        elif kind is StringStamped:
            message = StringStamped(Header.now(), values[0])
        else:
            message = kind(*values)
        self.commands[name].publish(message)

    def position(self):
        return np.array(self.new("measured_js").position)

    def home(self):
        self.send("state_command", "enable")
        self.until(lambda: self.reached and self.reached[-1].state == "ENABLED", "enabled")
        self.send("state_command", "home")
        self.until(lambda: self.reached and self.reached[-1].is_homed, "homed")


def test_client_controls_the_arm(monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    client = Client("mtml", "/MTML")
    names = list(client.arm.joint_names)
    message = client.new("measured_js")
    assert (message.header.nanoseconds, message.name, message.position) == (0, [], []), "not homed: invalid"
    client.send("servo_jf", *[0.0] * 7)
    client.until(lambda: "warning" in client.last, "warning")
    assert client.last["warning"].string == "servo_jf refused: the arm is DISABLED; allowed: ENABLED, homed"
    client.home()
    described = [(state.state, state.is_homed, state.is_busy) for state in client.reached]
    assert described == [
        ("DISABLED", False, False),
        ("ENABLED", False, False),
        ("ENABLED", False, True),
        ("ENABLED", True, False),
    ]
    client.until(lambda: client.new("measured_js").header.nanoseconds, "valid")
    for name in ("measured_js", "setpoint_js"):
        message = client.new(name)
        assert message.name == names and {len(message.position), len(message.velocity), len(message.effort)} == {7}
    assert client.new("gripper/measured_js").position == [0.0]

    goal = np.array([0.1, 0.2, -0.1, 0.1, 0.1, 0.1, 0.1])
    before = len(client.reached)
    client.send("move_jp", *goal)
    client.until(lambda: len(client.reached) == before + 2, "busy, then not busy")
    assert [state.is_busy for state in client.reached[before:]] == [True, False]
    client.until(lambda: np.max(np.abs(client.position() - goal)) < 2e-3, "the arm arrives at the goal")
    np.testing.assert_allclose(client.new("setpoint_js").position, goal, rtol=0, atol=1e-12)
    kinematics = ArmFrame(client.arm)
    for name in ("measured_cp", "setpoint_cp"):
        p = client.new(name).pose.position
        np.testing.assert_allclose([p.x, p.y, p.z], kinematics.pose(goal).translation(), rtol=0, atol=5e-3)

    # A cartesian target 5 mm away.
    target = client.new("setpoint_cp")
    target.pose.position.z += 0.005
    client.commands["servo_cp"].publish(target)
    client.until(lambda: abs(client.new("setpoint_cp").pose.position.z - target.pose.position.z) < 1e-6, "servo_cp")
    target.pose.position.z -= 0.005
    client.commands["move_cp"].publish(target)
    reached = "local/setpoint_cp"
    client.until(lambda: abs(client.new(reached).pose.position.z - target.pose.position.z) < 1e-6, "move_cp")

    client.send("use_gravity_compensation", True)
    client.until(lambda: np.any(client.new("gravity_compensation/setpoint_js").effort), "gravity compensation")
    client.send("servo_jf", *[0.0] * 7)
    # The two messages are not of the same time, so the efforts differ slightly while the arm moves.
    client.until(
        lambda: np.allclose(client.new("setpoint_js").effort, client.new("measured_js").effort, rtol=0, atol=0.02),
        "efforts",
    )
    client.send("use_gravity_compensation", False)
    before = client.position()
    client.until(lambda: np.max(np.abs(client.position() - before)) > 0.1, "the arm falls")
    assert client.new("setpoint_js").effort == [0.0] * 7
    assert np.any(np.abs(client.new("measured_js").velocity) > 0.01)
    twist = client.new("measured_cv").twist
    assert np.all(np.isfinite([twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.x]))
    client.send("hold")
    client.until(lambda: np.any(client.new("setpoint_js").effort), "hold")

    # A subscription that joins later receives all operating states, the oldest first.
    late = client.subscribe_operating_state()
    received = []

    def has_present_state():
        received.extend((state.state, state.is_homed) for state, _ in late.take())
        return received[-1:] == [("ENABLED", True)]

    assert client.domain.wait_until(has_present_state, TIMEOUT), received
    assert received[0] == ("DISABLED", False)
    client.send("state_command", "disable")
    client.until(lambda: client.reached[-1].state == "DISABLED", "disabled")
    output = client.process.end(signal.SIGTERM)
    for line in (
        "simulated MTML on ROS domain 0, topics /MTML/...; press Ctrl-C to end",
        "servo_jf refused: the arm is DISABLED; allowed: ENABLED, homed",
        # A busy computer may handle two commands in one step, so the two texts need not be on the same line.
        "control mode effort",
        "gravity compensation on",
    ):
        assert line in output, output
    assert "late" in output.splitlines()[-1]


def test_psm_has_separate_topics_for_the_jaw(monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)
    client = Client("psm", "/dvrk/PSM2", "--topic", "/dvrk/PSM2", "--rate", "200", "--effects", "friction")
    client.home()
    client.until(lambda: client.new("measured_js").name == list(client.arm.joint_names[:6]), "six joints")
    assert client.new("jaw/measured_js").name == ["jaw"]
    client.send("jaw/move_jp", 0.3)
    client.until(lambda: abs(client.new("jaw/measured_js").position[0] - 0.3) < 0.01, "the jaw opens")
    client.send("servo_jp", 0.0, 0.0, 0.05, 0.0, 0.0, 0.0)
    client.until(lambda: abs(client.position()[2] - 0.05) < 2e-3, "insertion")
    # A second arm with the same topics is refused, and a client of the first arm would notice its measurements.
    other = dvrk_drake("sim-arm", "--arm", "psm", "--transport", "ros", "--topic", "dvrk/PSM2")
    assert other.wait() == 2
    assert "another arm publishes /dvrk/PSM2/measured_js in ROS domain 0. End it, or " in other.output()
    second = client.domain.advertise("/dvrk/PSM2/measured_js", JointState)
    observer = ros.RosDomain(0)

    def others():
        return other_publishers(observer, client.arm, "/dvrk/PSM2")

    assert observer.wait_until(lambda: "/dvrk/PSM2/measured_js" in others(), TIMEOUT), others()
    assert {"/dvrk/PSM2/servo_jp", "/dvrk/PSM2/jaw/servo_jf"} < set(others())
    del second
    assert observer.wait_until(lambda: "/dvrk/PSM2/measured_js" not in others(), TIMEOUT), others()
    client.process.end(signal.SIGTERM)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--transport", "ros", "--driver", "d.yaml"], "error: --driver: only with --transport lcm"),
        (["--rate", "500"], "error: --rate: only with --transport ros"),
        (["--transport", "ros", "--rate", "5000"], "rate is 5000; allowed: 10..1000 Hz"),
        (["--transport", "ros", "--domain", "300"], "ROS domain 300: allowed: 0 to 232 (--domain, or ROS_DOMAIN_ID)"),
        (["--transport", "ros", "--model", "missing.yaml"], "missing.yaml"),
        (["--transport", "ros", "--effects", "magic"], "magic"),
    ],
)
def test_wrong_options_are_refused(options, message, capsys):
    assert message in refused(capsys, "sim-arm", "--arm", "mtml", *options)


def test_package_is_required(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    assert main(["sim-arm", "--arm", "mtml", "--transport", "ros"]) == 2
    assert "ROS 2 needs the package cyclonedds: pip install cyclonedds" in refusal(capsys.readouterr().err)
