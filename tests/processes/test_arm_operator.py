"""State of an arm for its operator, stop and reset, with a simulated clock and without a network."""

from types import SimpleNamespace

import numpy as np
import pytest
from command_output import assert_refused
from guard_bench import ARM
from guarded_arm import GuardedArm
from report_pages import printed

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.arm_operator import observe, observe_dvrk, reset_fault, stop_arm, stop_dvrk
from dvrk_drake.processes.control import first_status
from dvrk_drake.reports.arm_status import status_page
from dvrk_drake.systems.ros.crtk_client import CrtkObserver, JointMeasurement

ALL_MODES = (Command.OFF, Command.HOLD, Command.POSITION, Command.EFFORT)


@pytest.fixture
def controlled():
    """Returns a link to an arm on which the efforts of a controller act, and a function that sends its next command."""
    link, controller = GuardedArm(ALL_MODES), ArmController(ARM, IdentifiedModel.from_arm(ARM), "hold", 1e-3)

    def control():
        link.send(controller.answer(link.next_status(1.0), link.now()))

    while link.guard.state != Status.STATE_EFFORT:
        control()
    return link, control


def test_fault_is_reported_and_cleared():
    link, output = GuardedArm(), []
    link.guard.report_fault("the amplifier is hot")
    with pytest.raises(ControllerError, match=r"has a fault: the amplifier is hot\. Look at the arm, then start again"):
        first_status(link)
    assert not link.commands  # a fault is cleared on request only
    reset_fault(link, lambda text: output.append((text, len(link.commands))))
    assert output == [("MTML has a fault, which is reset now: the amplifier is hot", 0)]
    assert (link.guard.state, link.guard.fault_code) == (Status.STATE_HOLD, Status.FAULT_NONE)
    assert {command.control_mode for command in link.commands} == {Command.HOLD}
    # A new sender is accepted, even with the longest expiry that a guard may have.
    assert link.utime - link.commands[-1].status_utime > 10**6
    status, period = first_status(link)
    assert status.fault_code == Status.FAULT_NONE
    assert period == pytest.approx(1e-3)


def test_lasting_fault_is_an_error():
    link = GuardedArm()
    link.before_step = lambda: link.guard.report_fault("the amplifier is hot")
    with pytest.raises(ControllerError, match="still has a fault after the reset: the amplifier is hot"):
        reset_fault(link, lambda text: None)
    link = GuardedArm()
    reset_fault(link, pytest.fail)
    assert not link.commands


def test_arm_that_does_not_resume_is_an_error():
    link = GuardedArm()

    def take_over():
        link.guard.hold_reason = "its period is 20 ms"

    link.before_step = take_over
    assert_refused(ControllerError, "MTML does not resume: its period is 20 ms", reset_fault, link, lambda text: None)


def fault(link):
    link.guard.report_fault("the amplifier is hot")


def power_off(link):
    stop_arm(link, power_off=True)


def watchdog_hold(link):
    link.guard.hold_reason = "its period is 20 ms"


def own_gravity(link):
    link.status.gravity_compensation = True


def silent(link):
    next_status = link.next_status

    def repeated(seconds):
        status = next_status(seconds)
        status.utime = 10**9  # the bridge repeats the status of the last measurement
        return status

    link.next_status = repeated


def outside(link):
    link.status.position = [0.1 + ARM.position_upper[0], *link.status.position[1:]]


def refused(link):
    wrong = Command()
    wrong.arm_name, wrong.num_joints, wrong.session_id = ARM.name, ARM.num_joints, link.guard.session_id
    wrong.control_mode, wrong.sender_id = Command.EFFORT, 7  # its status is too old
    wrong.position = wrong.velocity = wrong.effort = [0.0] * ARM.num_joints
    link.before_step = lambda: link.guard.receive(wrong, link.utime)


def ignored(link):
    link.before_step = lambda: link.guard.receive(None, link.utime)


@pytest.mark.parametrize(
    ("prepare", "why", "next_step"),
    [
        (fault, "MTML: fault, fault: the amplifier is hot.", "dvrk-drake control --arm mtml --reset"),
        (power_off, "MTML: off, the motors have no power.", "switch the power on"),
        (watchdog_hold, "until an operator resumes: its period is 20 ms.", "dvrk-drake control --arm mtml --reset"),
        (own_gravity, "the arm adds its own gravity compensation", "switch off gravity_compensation"),
        (lambda link: None, "MTML: hold, no controller sends commands.", "dvrk-drake control --arm mtml"),
        (outside, "MTML: hold, the arm is outside its limits, so controllers do not start: outer_yaw", "move the arm"),
        (silent, "MTML: hold, no new measurement arrives", "check the process of the arm and its connection."),
        (refused, "MTML: hold, commands are refused: ", "correct or end the controller"),
        (ignored, "MTML: hold, messages are ignored: ", "give the arm's key to the controller"),
    ],
)
def test_status_explains_an_arm_that_does_not_move(prepare, why, next_step):
    link = GuardedArm(ALL_MODES)
    prepare(link)
    page = status_page(ARM, observe(link, 0.5, "--arm mtml"))
    assert why in " ".join(printed(page).split())
    assert page.next_step.removeprefix("look at the arm, remove the cause, then: ").startswith(next_step)


def test_status_shows_controller_and_limits(controlled):
    link, control = controlled
    link.before_step = lambda: None
    for _ in range(100):
        control()
    seen = observe(link, 0.001, "")
    assert f"{link.guard.counts.accepted} accepted" in seen.notes[1]
    text = printed(status_page(ARM, seen))
    assert all(name in text for name in ARM.joint_names) and " 5 %" in text


def test_stop_overrules_a_controller(controlled):
    link, control = controlled
    assert stop_arm(link).guard_state == Status.STATE_HOLD
    assert "commanded HOLD" in link.guard.hold_reason
    for _ in range(2000):
        control()
    assert link.guard.state == Status.STATE_HOLD
    reset_fault(link, lambda text: None)
    assert first_status(link)[0].fault_text == ""


def test_stop_switches_power_off_but_never_on(controlled):
    link, _ = controlled
    assert stop_arm(link, power_off=True).guard_state == Status.STATE_OFF
    sent = len(link.commands)
    assert stop_arm(link).guard_state == Status.STATE_OFF and len(link.commands) == sent
    with pytest.raises(
        ControllerError, match=r"driver does not accept OFF \(modes\)\. Press the emergency stop button"
    ):
        stop_arm(GuardedArm(), power_off=True)
    link = GuardedArm(ALL_MODES)
    fault(link)
    with pytest.raises(ControllerError, match="has a fault, in which its guard does not switch the power off"):
        stop_arm(link, power_off=True)


def test_arm_that_does_not_stop_is_an_error():
    link = GuardedArm()
    next_status = link.next_status

    def moving(seconds):
        status = next_status(seconds)
        status.guard_state = Status.STATE_EFFORT
        return status

    link.next_status = moving
    with pytest.raises(ControllerError, match=r"MTML does not stop: its state is effort.*Press the emergency stop"):
        stop_arm(link)


def test_commands_of_the_operator(monkeypatch, capsys):
    link = GuardedArm(ALL_MODES)
    monkeypatch.setattr("dvrk_drake.processes.arm_session.ArmSession.open_lcm_link", lambda _: link)
    for command, code, text in (
        (["status"], 0, "MTML: hold, no controller sends commands."),
        (["stop", "--power-off"], 0, "MTML is stopped: off"),
        (["status"], 0, "MTML: off, the motors have no power."),
    ):
        assert main([*command, "--arm", "mtml"]) == code
        lines = capsys.readouterr().out.splitlines()
        assert lines[0].startswith(text) and (command == ["status"]) == lines[-1].startswith("Next: ")


# State of a dVRK arm for its operator, and its stop, without DDS.


pytest.importorskip("cyclonedds", reason="ROS 2 needs cyclonedds")

ROS_ARM, OPTIONS = load_arm("mtml"), "--arm mtml --transport ros"


class Observed:
    """Substitute for a CrtkObserver: a measurement arrives in each period of its domain [ns]."""

    arm, namespace, not_ready_reason = ROS_ARM, "/MTML", CrtkObserver.not_ready_reason

    def __init__(self):
        self.operating_state = SimpleNamespace(state="ENABLED", is_homed=True, is_busy=False)
        self.num_received, self.measurement, self.gravity_compensation = 0, None, 0.0
        self.others, self.period = [], 1_000_000
        self.q, self.problem, self.is_silent, self.stamp, self.step = np.zeros(7), "", False, 0, 1_000_000
        self.domain = SimpleNamespace(wait=lambda seconds: None, wait_until=lambda condition, seconds: condition())
        self.confirms, self.switches_off = True, True

    def _topic(self, name):
        return f"{self.namespace}/{name}"

    def receive(self):
        self.stamp += self.step
        self.measurement = JointMeasurement(self.q, 0 * self.q, 0 * self.q, self.stamp, 10**9, self.problem)
        return not self.is_silent

    def receive_state(self):
        pass

    def other_publishers(self):
        return self.others

    def hold_until_confirmed(self, seconds):
        return self.confirms

    def switch_power_off(self, seconds):
        self.operating_state.state = "DISABLED" if self.switches_off else "ENABLED"
        return self.switches_off


def changed(**values):
    return lambda observed: vars(observed).update(values)


def state(**values):
    return lambda observed: vars(observed.operating_state).update(values)


@pytest.mark.parametrize(
    ("prepare", "why", "next_step"),
    [
        (state(state="DISABLED"), "MTML: DISABLED, the motors have no power.", "enable and home the arm"),
        (
            state(state="FAULT"),
            "MTML: FAULT, the motors have no power.",
            "remove the cause of the fault, then enable and home",
        ),
        (state(state="PAUSED"), "MTML: PAUSED, it executes no commands.", "resume the arm"),
        (state(is_homed=False), "MTML: ENABLED, the arm is not homed.", "home the arm at its console"),
        (
            state(is_homed=False, is_busy=True),
            "ENABLED, moves by itself, the arm is not homed.",
            "wait until the arm is homed",
        ),
        (changed(is_silent=True), "no message arrives on /MTML/measured_js.", "check the dVRK's console"),
        (changed(operating_state=None), "operating state unknown, no message arrives on /MTML/operating_s", "check"),
        (changed(problem="measured_js has 3 efforts"), "ENABLED, measured_js has 3 efforts.", "check the sensors"),
        (changed(step=0, stamp=5), "/MTML/measured_js repeats the same measurement.", "check the dVRK's console"),
        (changed(others=["/MTML/measured_js"]), "several processes publish /MTML/measured_js.", "end all but"),
        (
            changed(step=10_000_000),
            "no process can move the arm; 100 measurements per second suffice",
            "publish at 500",
        ),
        (changed(q=ROS_ARM.position_upper + 0.1), "outside its limits, so controllers do not", "move the arm inside"),
        (changed(), "MTML: ENABLED, no process can move the arm.", f"dvrk-drake control {OPTIONS}"),
    ],
)
def test_status_explains_a_dvrk_that_does_not_move(prepare, why, next_step):
    observed = Observed()
    prepare(observed)
    page = status_page(ROS_ARM, observe_dvrk(observed, 0.005, OPTIONS))
    text = " ".join(printed(page).split())
    assert why in text and page.next_step.startswith(next_step)
    assert "Unknown over ROS 2: state of a guard, rate of commands" in text


def test_process_that_can_move_the_arm_is_named():
    observed = Observed()
    observed.others, observed.gravity_compensation = ["/MTML/servo_jf"], 0.123
    seen = observe_dvrk(observed, 0.005, OPTIONS)
    assert seen.why.startswith("another process can move the arm") and not seen.next_step
    assert "/MTML/servo_jf" in " ".join(seen.notes) and "on, up to 0.123 N m or N" in " ".join(seen.notes)


def test_stop_waits_for_confirmation_and_power():
    observed = Observed()
    assert stop_dvrk(observed) == "it has confirmed hold, operating state ENABLED"
    assert stop_dvrk(observed, power_off=True) == "it has confirmed hold, operating state DISABLED"
    observed.others = ["/MTML/servo_jf"]
    assert "publishes /MTML/servo_jf, and moves the arm again unless it is a bridge" in stop_dvrk(observed)
    observed.switches_off = False
    with pytest.raises(ControllerError, match=r"its power stays on\. Press the emergency stop button"):
        stop_dvrk(observed, power_off=True)
    observed.confirms = False
    assert_refused(ControllerError, "the arm did not confirm hold", stop_dvrk, observed)
