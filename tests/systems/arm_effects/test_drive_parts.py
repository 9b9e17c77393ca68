"""Unit tests of a real arm's drive: motors, sensors, anchors of friction springs, and their plant indices."""

import numpy as np
import pytest
from simulated_effects import Run, middle, weightless

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import ArmEffects, EffortEffect
from dvrk_drake.systems.arm_effects.drive_force import EffortSensor, Motors, round_to_step
from dvrk_drake.systems.arm_effects.drive_step import _measure_into, _move_anchors

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]

ARM = load_arm("mtml")
N = ARM.num_joints
INVERSE = ARM.transmission.inverse  # joints from actuators

# Motors


@pytest.mark.parametrize(("value", "step", "expected"), [(0.34, 0.1, 0.3), (-0.36, 0.1, -0.4), (0.34, 0.0, 0.34)])
def test_round_to_step(value, step, expected):
    assert round_to_step(value, step) == pytest.approx(expected, abs=1e-12)


def test_motors_clamp_step_and_saturate_in_this_order():
    first, second = ARM.joint_names[:2]
    effects = ArmEffects(saturation={first: 0.25}, effort=EffortEffect(command_resolution={first: 0.1, second: 0.1}))
    limits = np.full(N, 0.5)
    motors = Motors(ARM, effects, limits)
    inside = np.linspace(-0.2, 0.2, N)
    free = Motors(ARM, ArmEffects(), limits)
    np.testing.assert_allclose(free.effort(inside), INVERSE.pull_back_effort(inside), atol=1e-12)
    # The effort does not increase beyond the joints' limits.
    np.testing.assert_allclose(free.effort(np.full(N, 9.0)), INVERSE.pull_back_effort(limits), atol=1e-12)
    # 0.33 is three steps, limited to 0.25 by the motor. The second has 0.3, all others the command.
    command = ARM.transmission.pull_back_effort(np.array([0.33, -0.33, *[0.05] * (N - 2)]))
    assert np.all(np.abs(command) <= limits)
    np.testing.assert_allclose(motors.effort(command), [0.25, -0.3, *[0.05] * (N - 2)], atol=1e-12)


# Sensors


def sensor(seed, **effort):
    system = EffortSensor(ARM, Motors(ARM, ArmEffects(), ARM.effort_limits), EffortEffect(**effort), 1e-3, seed)
    context = system.CreateDefaultContext()

    def measured(tick, effort=None):
        context.SetTime(tick * 1e-3)
        if effort is not None:
            system.get_input_port().FixValue(context, effort)
        return INVERSE.pull_back_effort(system.get_output_port().Eval(context))

    return measured


def test_noise_depends_on_seed_and_time_step_only():
    deviation = dict.fromkeys(ARM.joint_names, 0.01)
    once, again, other = sensor(1, noise=deviation), sensor(1, noise=deviation), sensor(2, noise=deviation)
    path = np.array([once(tick) for tick in range(400)])
    for tick in (399, 7, 7, 120):
        np.testing.assert_array_equal(again(tick), path[tick])
    assert not np.any(other(7) == path[7])
    # 2800 numbers: their deviation is known to 1.4 %, their mean to 2 % of it.
    assert np.std(path) == pytest.approx(0.01, rel=0.07)
    assert abs(np.mean(path)) < 1e-3
    assert abs(np.corrcoef(path[1:, 0], path[:-1, 0])[0, 1]) < 0.25


def test_measured_efforts_are_whole_steps():
    measured = sensor(0, measured_resolution=dict.fromkeys(ARM.joint_names, 0.002))
    np.testing.assert_array_equal(measured(0), np.zeros(N))
    effort = np.array([0.0011, -0.0029, 0.0045, 0.0, 0.0009, -0.0011, 0.0031])
    found = measured(0, ARM.transmission.pull_back_effort(effort))
    np.testing.assert_allclose(found, [0.002, -0.002, 0.004, 0.0, 0.0, -0.002, 0.004], atol=1e-12)


def measure(positions, resolution, decay, delay=0):
    """Returns encoder positions and velocities of one actuator for `positions`, one per time step of 0.5 s."""
    one = np.eye(1)
    constants = np.array([resolution, decay, 0.5])
    memory, out, path = np.zeros(2 + 2 * max(delay - 1, 0)), np.zeros(2), []
    for position in positions:
        _measure_into(np.array([position, 7.0]), one, one, one, constants, memory, out)
        path.append(out.copy())
    return np.array(path)


def test_encoders_count_and_differentiate():
    positions = [0.0, 0.24, 0.26, 0.76, 0.8]
    counted = np.array([0.0, 0.0, 0.5, 1.0, 1.0])
    path = measure(positions, 0.5, decay=0.25)
    np.testing.assert_allclose(path[:, 0], counted, atol=1e-12)
    v, expected = 0.0, []
    for change in np.diff(counted, prepend=0.0):
        v = 0.25 * v + 0.75 * change / 0.5
        expected.append(v)
    np.testing.assert_allclose(path[:, 1], expected, atol=1e-12)
    # Without an encoder both are exact.
    np.testing.assert_array_equal(measure(positions, 0.5, decay=-1.0), np.column_stack([positions, [7.0] * 5]))


@pytest.mark.parametrize("delay", [2, 4])
def test_measurement_queue_keeps_order(delay):
    # `DriveStep` stores the newest one for the step that follows: the queue is one shorter than the delay.
    positions = np.arange(1.0, 9.0)
    path = measure(positions, 0.0, decay=-1.0, delay=delay)
    np.testing.assert_array_equal(path[delay - 1 :, 0], positions[: 9 - delay])
    np.testing.assert_array_equal(path[: delay - 1], np.zeros((delay - 1, 2)))


# Anchors of friction springs


def anchors(positions, *, fall_speed=0.0, side=1.0, code=5, velocity=0.0):
    """Returns the anchor of one slider that slips at 0.1, after each position."""
    places, laws = np.array([[code, 0, 0]]), np.array([[0.1, fall_speed, side]])
    anchor, path = np.zeros(1), []
    for position in positions:
        _move_anchors(np.array([position, velocity]), places, laws, 1e-3, anchor)
        path.append(anchor[0])
    return path


def test_anchor_follows_when_spring_slips():
    assert anchors([0.05, 0.09, -0.09]) == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(anchors([0.3, 0.25, 0.15, 0.05, 0.2]), [0.2, 0.2, 0.2, 0.15, 0.15], atol=1e-12)
    np.testing.assert_allclose(anchors([-0.3, -0.15]), [-0.2, -0.2], atol=1e-12)
    # "presliding forward" holds in one direction only. It follows in the other one without deflection.
    np.testing.assert_allclose(anchors([0.3, 0.1], code=6), [0.2, 0.1], atol=1e-12)
    np.testing.assert_allclose(anchors([-0.3, -0.1], code=6, side=-1.0), [-0.2, -0.1], atol=1e-12)


def test_anchor_moves_closer_with_fall_speed():
    (still,), (moving,) = anchors([0.3], fall_speed=1.0), anchors([0.3], fall_speed=1.0, velocity=1.0)
    assert still == pytest.approx(0.2, abs=1e-12)
    # It holds 1/e of its travel, minus the motion of the arm in two steps.
    assert moving == pytest.approx(0.3 - (0.1 * np.exp(-1.0) - 2e-3), abs=1e-12)


# Complete drive


def test_power_of_motors_equals_power_of_actuators():
    """The matrix from velocities to actuators is the transpose of the matrix from motor efforts."""
    parts = Run(ARM, ArmEffects()).station._drive.effects
    np.testing.assert_allclose(parts.to_actuators, parts.from_motors.T, atol=1e-12)
    assert np.linalg.matrix_rank(parts.to_actuators) == N


def test_drive_coordinates_are_plant_joints():
    run = Run(ARM, ARM.effects.only(["friction", "stops"]), middle(ARM))
    drive, plant = run.station._drive.effects.drive, run.station.plant
    joint, ratio = drive.joint(-2.0 * np.eye(N)[4])
    assert (joint.name(), ratio) == (ARM.joint_names[4], -2.0)
    q, q_plant = np.linspace(-0.2, 0.3, N), np.zeros(plant.num_positions())
    drive.set_positions(q_plant, q)
    for added, row in drive._added:
        assert q_plant[added.position_start()] == pytest.approx(row @ q)
        assert drive.joint(row) == (added, 1.0)  # it is found, not created again


def test_drive_without_effects_is_ideal():
    arm = weightless("mtml")
    paths = []
    for effects in (None, ArmEffects()):
        run = Run(arm, effects)
        run.fix("effort_commanded", 0.3 * arm.effort_limits)
        run.advance(50)
        paths.append(np.concatenate([run.get("state_estimated"), run.get("effort_measured")]))
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-9)
    assert np.abs(paths[0][:N] - middle(arm)).max() > 1e-3
