"""`dvrk-drake sim-arm --transport ros`: a real process over DDS in a network namespace, and refused options."""

import sys

import numpy as np
import pytest
from arm_processes import dvrk_drake
from command_output import refusal, refused
from crtk_conformance import start_simulated_arm
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT, wait_until

from dvrk_drake.cli import main
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.models.arm_files import load_arm

ros = pytest.importorskip("dvrk_drake.systems.ros.domain", reason="needs cyclonedds")
from dvrk_drake.systems.ros.crtk_client import other_publishers  # noqa: E402
from dvrk_drake.systems.ros.messages import Bool, Empty, Header, JointState, PoseStamped, StringStamped  # noqa: E402

pytestmark = pytest.mark.network


@pytest.fixture(autouse=True)
def loopback(monkeypatch):
    """Uses DDS on the loopback interface."""
    monkeypatch.setenv("CYCLONEDDS_URI", DOMAIN_FILE)


def joints(**values):
    return JointState(Header.now(), **{name: list(map(float, numbers)) for name, numbers in values.items()})


def test_client_controls_the_arm():
    zeros = joints(effort=[0.0] * 7)
    with start_simulated_arm("mtml", "MTML", 200.0) as arm:
        message = arm.latest()
        assert (message.header.nanoseconds, message.name, message.position) == (0, [], []), "not homed: invalid"
        warnings, received = arm.domain.subscribe("/MTML/warning", StringStamped), []
        wait_until(warnings.num_publishers, "connection", arm.process)
        arm.command("servo_jf", zeros)
        wait_until(lambda: received.extend(warnings.take()) or received, "warning", arm.process)
        assert received[0][0].string == "servo_jf refused: the arm is DISABLED; allowed: ENABLED, homed"
        arm.enable_and_home()
        assert arm.states == [
            ("DISABLED", False, False),
            ("ENABLED", False, False),
            ("ENABLED", False, True),
            ("ENABLED", True, False),
        ]
        wait_until(lambda: arm.latest().header.nanoseconds, "valid measurements", arm.process)
        for name in ("measured_js", "setpoint_js"):
            message = arm.latest(name)
            assert message.name == list(load_arm("mtml").joint_names)
            assert {len(message.position), len(message.velocity), len(message.effort)} == {7}
        assert arm.latest("gripper/measured_js").position == [0.0]

        goal, before = np.array([0.1, 0.2, -0.1, 0.1, 0.1, 0.1, 0.1]), len(arm.states)
        arm.command("move_jp", joints(position=goal))
        wait_until(lambda: arm.state() and len(arm.states) == before + 2, "busy, then not busy", arm.process)
        assert [is_busy for *_, is_busy in arm.states[before:]] == [True, False]
        arm.wait_for_position(goal, 2e-3)
        np.testing.assert_allclose(arm.latest("setpoint_js").position, goal, rtol=0, atol=1e-12)
        for name in ("measured_cp", "setpoint_cp", "local/measured_cp", "local/setpoint_cp"):
            p = arm.latest(name, PoseStamped).pose.position
            expected = ArmFrame(load_arm("mtml")).pose(goal).translation()
            np.testing.assert_allclose([p.x, p.y, p.z], expected, rtol=0, atol=5e-3)

        arm.command("use_gravity_compensation", Bool(True))
        name = "gravity_compensation/setpoint_js"
        wait_until(lambda: np.any(arm.latest(name).effort), "gravity compensation", arm.process)
        arm.command("servo_jf", zeros)
        arm.command("use_gravity_compensation", Bool(False))
        before = np.array(arm.latest().position)
        wait_until(lambda: np.max(np.abs(arm.latest().position - before)) > 0.1, "the arm falls", arm.process)
        assert arm.latest("setpoint_js").effort == [0.0] * 7
        arm.command("hold", Empty())
        wait_until(lambda: np.any(arm.latest("setpoint_js").effort), "hold", arm.process)
        arm.state_command("disable")
        wait_until(lambda: arm.state()[0] == "DISABLED", "disabled", arm.process)
    output = arm.process.output()
    for line in (
        "simulated MTML on ROS domain 0, topics /MTML/...; press Ctrl-C to end",
        "servo_jf refused: the arm is DISABLED; allowed: ENABLED, homed",
        # A busy computer may handle two commands in one step, so the two texts need not be on the same line.
        "control mode effort",
        "gravity compensation on",
    ):
        assert line in output, output
    assert "late" in output.splitlines()[-1]


def test_psm_has_separate_topics_for_the_jaw():
    psm, options = load_arm("psm"), ("--topic", "/dvrk/PSM2", "--effects", "friction")
    with start_simulated_arm("psm", "dvrk/PSM2", 200.0, *options) as arm:
        arm.enable_and_home()
        wait_until(lambda: arm.latest().name == list(psm.joint_names[:6]), "six joints", arm.process)
        assert arm.latest("jaw/measured_js").name == ["jaw"]
        arm.command("jaw/move_jp", joints(position=[0.3]))
        wait_until(lambda: abs(arm.latest("jaw/measured_js").position[0] - 0.3) < 0.01, "the jaw opens", arm.process)
        arm.command("servo_jp", joints(position=[0.0, 0.0, 0.05, 0.0, 0.0, 0.0]))
        wait_until(lambda: abs(arm.latest().position[2] - 0.05) < 2e-3, "insertion", arm.process)
        # A second arm with the same topics is refused, and a client of the first arm would notice its measurements.
        other = dvrk_drake("sim-arm", "--arm", "psm", "--transport", "ros", "--topic", "dvrk/PSM2")
        assert other.wait() == 2
        assert "another arm publishes /dvrk/PSM2/measured_js in ROS domain 0. End it, or " in other.output()
        arm.advertise("jaw/servo_jf", JointState)
        second, observer = arm.domain.advertise("/dvrk/PSM2/measured_js", JointState), ros.RosDomain(0)

        def others():
            return other_publishers(observer, psm, "/dvrk/PSM2")

        assert observer.wait_until(lambda: "/dvrk/PSM2/measured_js" in others(), TIMEOUT), others()
        assert {"/dvrk/PSM2/servo_jp", "/dvrk/PSM2/jaw/servo_jf"} < set(others())
        del second
        assert observer.wait_until(lambda: "/dvrk/PSM2/measured_js" not in others(), TIMEOUT), others()


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
