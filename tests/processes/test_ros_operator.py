"""State of a dVRK arm for its operator, and its stop, without DDS."""

from types import SimpleNamespace

import numpy as np
import pytest
from report_pages import printed

from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.reports.arm_status import status_page

pytest.importorskip("cyclonedds", reason="ROS 2 needs cyclonedds")
from dvrk_drake.processes.ros_operator import observe_dvrk, stop_dvrk
from dvrk_drake.systems.ros.crtk_client import CrtkObserver
from dvrk_drake.systems.ros.joint_state_reader import JointMeasurement

ARM, OPTIONS = load_arm("mtml"), "--arm mtml --transport ros"


class Observed:
    """Substitute for a CrtkObserver: a measurement arrives in each period of its domain [ns]."""

    arm, namespace, not_ready_reason = ARM, "/MTML", CrtkObserver.not_ready_reason

    def __init__(self):
        self.operating_state = SimpleNamespace(state="ENABLED", is_homed=True, is_busy=False)
        self.num_received, self.measurement, self.gravity_compensation, self.others, self.period = (
            0,
            None,
            0.0,
            [],
            1_000_000,
        )
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
        (changed(q=ARM.position_upper + 0.1), "outside its limits, so controllers do not", "move the arm inside"),
        (changed(), "MTML: ENABLED, no process can move the arm.", f"dvrk-drake control {OPTIONS}"),
    ],
)
def test_status_explains_a_dvrk_that_does_not_move(prepare, why, next_step):
    observed = Observed()
    prepare(observed)
    page = status_page(ARM, observe_dvrk(observed, 0.005, OPTIONS))
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
    with pytest.raises(ControllerError, match="the arm did not confirm hold"):
        stop_dvrk(observed)
