"""Soft walls of the guard on simulated arms without stops: no command moves a joint beyond its limit."""

import numpy as np
import pytest
from lcm_arm import ARM, POSES, SOON, CommandSender, SimulatedArm, run, without_stops
from pydrake.lcm import DrakeLcm

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.driver import DvrkDriver

ARMS = ["mtml", pytest.param("psm", marks=pytest.mark.slow)]


@pytest.mark.parametrize("name", ARMS)
def test_feedforward_velocity_keeps_joints_inside_limits(name):
    """Constant positions just inside the limits with outward velocities. The plant has no stops."""
    lcm = DrakeLcm("memq://")
    arm = SimulatedArm(lcm, name, SOON, modify_plant=without_stops)
    A, lower, upper = arm.arm.limit_matrix()
    outward = np.where(np.arange(7) == 2, -1.0, 1.0)  # shoulder and elbow in opposite directions, for the coupled limit
    goal = np.where(outward > 0, arm.arm.position_upper - 1e-3, arm.arm.position_lower + 1e-3)
    sender = CommandSender(lcm, arm.arm, state_desired=np.concatenate([POSES[name], np.zeros(7)]))
    run(lcm, 60, arm, sender)
    sender.fix("state_desired", np.concatenate([goal, np.zeros(7)]))
    run(lcm, 1500, arm, sender)
    sender.fix("state_desired", np.concatenate([goal, 100 * outward]))
    margin = np.minimum(0.05, 0.05 * (upper - lower))
    for _ in range(500):
        run(lcm, 1, arm, sender)
        c = A @ np.array(arm.statuses[-1].position)
        assert np.all(np.maximum(c - upper, lower - c) < 0.5 * margin)
    assert arm.statuses[-1].guard_state == Status.STATE_POSITION


def test_effort_plus_gravity_compensation_stays_limited():
    lcm = DrakeLcm("memq://")
    arm = SimulatedArm(lcm, driver=DvrkDriver(gravity_compensation=True))
    sender = CommandSender(lcm, effort_commanded=np.zeros(7))
    run(lcm, 300, arm, sender)
    for sign in (1, -1):
        sender.fix("effort_commanded", sign * ARM.effort_limits)
        run(lcm, 30, arm, sender)
        commanded = [s.effort_commanded for s in arm.statuses[-30:]]
        assert np.all(np.abs(commanded) <= ARM.effort_limits)
        assert np.any(np.abs(commanded) == ARM.effort_limits)


def pushed(name, push, seconds):
    """Returns the largest excess of a limit [guard's margins] for efforts that ramp to `push` in 0.2 s; last status."""
    lcm = DrakeLcm("memq://")
    arm = SimulatedArm(lcm, name, SOON, modify_plant=without_stops)
    A, lower, upper = arm.arm.limit_matrix()
    held = IdentifiedModel.from_arm(arm.arm).holding_torque(POSES[name])
    sender = CommandSender(lcm, arm.arm, effort_commanded=held)
    run(lcm, 60, arm, sender)
    worst = -np.inf
    for k in range(round(1e3 * seconds)):
        sender.fix("effort_commanded", held + (push - held) * min(1.0, k / 200))
        run(lcm, 1, arm, sender)
        c = A @ np.array(arm.statuses[-1].position)
        worst = max(worst, *(np.maximum(c - upper, lower - c) / np.minimum(0.05, 0.05 * (upper - lower))))
    return worst, arm.statuses[-1]


#: Arm and row of its limit matrix: the coupled limit of the MTM and the insertion of the PSM, then all others.
ROWS = [("mtml", 7), ("psm", 2)]
ROWS += [pytest.param("mtml", k, marks=pytest.mark.slow) for k in range(7)]
ROWS += [pytest.param("psm", k, marks=pytest.mark.slow) for k in range(7) if k != 2]


@pytest.mark.parametrize(("name", "row"), ROWS)
@pytest.mark.parametrize("side", [-1, 1])
def test_full_motor_effort_keeps_joints_inside_limits(name, row, side):
    # The plant has no friction, damping or stops. Only the soft wall acts.
    arm = load_arm(name)
    push = side * np.sign(arm.limit_matrix()[0][row]) * arm.effort_limits
    worst, status = pushed(name, push, 0.6)
    assert worst < 0.5  # beyond half of the wall's width is a fault
    assert (status.guard_state, status.fault_text) == (Status.STATE_EFFORT, "")


#: Arm and a joint of its wrist.
WRISTS = [("mtml", 6)]
WRISTS += [
    pytest.param(*wrist, marks=pytest.mark.slow)
    for wrist in (("mtml", 3), ("mtml", 5), ("psm", 3), ("psm", 4), ("psm", 6))
]


@pytest.mark.parametrize(("name", "joint"), WRISTS)
def test_wrist_on_soft_wall_comes_to_rest(name, joint):
    """On light joints, a wall that is too stiff for one period of delay makes the motors chatter."""
    lcm = DrakeLcm("memq://")
    arm = SimulatedArm(lcm, name, SOON, modify_plant=without_stops)
    held = IdentifiedModel.from_arm(arm.arm).holding_torque(POSES[name])
    push = 0.6 * arm.arm.effort_limits * np.eye(7)[joint]
    sender = CommandSender(lcm, arm.arm, effort_commanded=held)
    run(lcm, 60, arm, sender)
    for k in range(1000):
        sender.fix("effort_commanded", held + push * min(1.0, k / 200))
        run(lcm, 1, arm, sender)
    last = arm.statuses[-100:]
    assert last[-1].joint_flags[joint] & Status.FLAG_POSITION_LIMIT
    effort = np.array([status.effort_commanded[joint] for status in last])
    assert np.abs(np.diff(effort)).max() < 0.01 * arm.arm.effort_limits[joint]
    assert np.abs([status.velocity[joint] for status in last]).max() < 0.1
