"""Response of guard and arm to wrong sensor data and faulty controllers, on simulated arms with real sensors.

`benchmarks/sensor_faults.py` computes the table of all faults and joints.
"""

import dataclasses

import numpy as np
import pytest
from faulty_arm import PERIOD, FaultyArm
from forked import run_forked
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.arm_controller import ArmController

pytestmark = pytest.mark.drake_api

ELBOW, SHOULDER, ROLL = 2, 1, 6


@pytest.fixture(scope="module")
def moving_arm():
    """Returns an MTM that moves under effort commands."""
    arm = FaultyArm("mtml", "effort")
    for _ in range(2600):
        arm.step()
    return arm


@pytest.mark.parametrize(
    ("fault", "joint"),
    [("encoder stuck", ELBOW), ("position jumps", SHOULDER), ("velocity inverted", SHOULDER), ("not finite", ELBOW)],
)
def test_large_joint_moves_below_50_mrad_before_detection(moving_arm, fault, joint):
    def check():
        outcome = moving_arm.fail(fault, joint, at=2.6, seconds=0.5)
        assert outcome.before < 0.05
        # Speed and effort of all joints, from 50 ms after the detection on; see docs/safety.md.
        assert np.max(outcome.speed) < 1.0
        # 0.3 of the limit, and up to a tenth more where the gravity effort is nearly as large: 0.28 of the shoulder's.
        assert outcome.effort < 0.4

    run_forked(check)


@pytest.mark.parametrize("name", ["mtml", pytest.param("psm", marks=pytest.mark.slow)])
def test_a_jump_while_holding_is_a_fault(name):
    outcome = FaultyArm(name, "hold").fail("position jumps", 0, at=0.3, seconds=0.3)
    assert outcome.text.endswith("the position jumps")
    assert outcome.detected <= 2 * PERIOD and max(outcome.before, outcome.after) < 0.01


def test_efforts_do_not_start_with_zero_effort_sensor():
    """The arm would fall: efforts start at the measured ones, and gravity needs a quarter of a joint's limit."""
    poses = load_arm("mtml").sample_poses(200, np.random.default_rng(0), margin=0.1)
    model = IdentifiedModel.from_arm(load_arm("mtml"))
    loads = np.abs(model.holding_torque(poses)[:, :3]) / load_arm("mtml").effort_limits[:3]
    q = poses[np.argmax(loads.max(axis=1))]
    arm = FaultyArm("mtml", "effort", path=PiecewisePolynomial.FirstOrderHold([0.0, 9.0], np.column_stack([q, q])))
    gravity = arm.guard.gravity_effort / arm.arm.effort_limits
    joint = int(np.argmax(np.abs(gravity[:3])))
    assert abs(gravity[joint]) > 0.2
    arm.sensors.fault, arm.sensors.joint, arm.sensors.begin = "effort zero", joint, 0.0
    for _ in range(800):
        arm.step()
        assert arm.guard.state in (Status.STATE_HOLD, Status.STATE_STARTING)
    assert arm.guard.refusal_code == Status.REFUSAL_START_GRAVITY
    assert np.abs(arm.state()[0] - q).max() < 0.01


def run_until_fault(arm, seconds):
    """Returns the time from the first effort to the fault [s]."""
    acted = None
    for _ in range(round(seconds / PERIOD)):
        arm.step()
        if acted is None and arm.guard.state == Status.STATE_EFFORT:
            acted = arm.ticks
        if arm.guard.state == Status.STATE_FAULT:
            return (arm.ticks - acted) * PERIOD
    return None


def test_controller_without_damping_is_stopped():
    """The wrist roll with kd = 0 and ten times ki is unstable."""
    arm = FaultyArm("mtml", "effort", effects=False)
    gains = arm.arm.gains
    kd, ki = list(gains.kd), list(gains.ki)
    kd[ROLL], ki[ROLL] = 0.0, 10 * ki[ROLL]
    model = IdentifiedModel.from_arm(arm.arm)
    gains = dataclasses.replace(gains, kd=kd, ki=ki)
    arm.controller = ArmController(arm.arm, model, "hold", PERIOD, gains=gains)
    time = run_until_fault(arm, 8.0)
    assert time is not None and arm.guard.fault_code == Status.FAULT_OSCILLATION
    assert arm.guard.fault_text.startswith("wrist_roll")


@pytest.mark.parametrize("frequency", [25.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_efforts_jumping_between_limits_are_stopped(frequency):
    """A faulty controller commands efforts between both limits, around the gravity effort."""
    arm = FaultyArm("mtml", "gravity")
    answer = arm.controller.answer

    def bang(status, time, desired=None):
        command = answer(status, time, desired)
        if arm.controller.acting and arm.controller.ramped:
            effort = np.array(command.effort)
            effort[0] += np.sign(np.sin(2 * np.pi * frequency * time)) * arm.arm.effort_limits[0]
            command.effort = effort.tolist()
        return command

    arm.controller.answer = bang
    time = run_until_fault(arm, 6.0)
    assert time is not None and time < 3.5
    assert arm.guard.fault_code in (Status.FAULT_OSCILLATION, Status.FAULT_POSITION_LIMIT)


@pytest.mark.slow
@pytest.mark.parametrize("use", ["effort", "position", "hold"])
def test_safe_state_stops_an_oscillation_by_late_measurements(use):
    """The instrument oscillates, because its measurements are 30 ms late. See `sensor_faults.py --delays`."""
    arm = FaultyArm("psm", use)
    arm.sensors.delays[:] = 30
    for _ in range(2000):
        arm.step()
        if arm.guard.state == Status.STATE_FAULT:
            break
    assert arm.guard.state == Status.STATE_FAULT
    for _ in range(2500):
        arm.step()
    assert np.abs(arm.state()[1]).max() < 0.05
