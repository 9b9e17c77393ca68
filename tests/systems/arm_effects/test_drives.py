"""Measured signals of a real arm and motor efforts for its commands."""

import itertools

import numpy as np
import pytest
from controlled_arm import ControlledArm
from simulated_effects import ARMS, STEP, Run, middle, weightless

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import ArmEffects, DelayEffect, DriveEffect, EffortEffect, EncoderEffect
from dvrk_drake.systems.arm_effects.drive_force import Motors

pytestmark = [pytest.mark.drake_api, pytest.mark.numeric]


@pytest.mark.parametrize("ticks", [0, 1, 2, 5])
def test_measurement_delay_is_exact(ticks):
    arm = load_arm("mtml")
    run = Run(arm, ArmEffects(delay=DelayEffect(measurement=ticks)))
    true, measured = [run.get("state_true")], [run.get("state_estimated")]
    for _ in range(40):
        run.advance()
        true.append(run.get("state_true"))
        measured.append(run.get("state_estimated"))
    for k in range(41):
        np.testing.assert_array_equal(measured[k], true[max(k - ticks, 0)])
    assert np.ptp(true, axis=0).max() > 1e-4


@pytest.mark.parametrize("ticks", [1, 2, 5])
def test_command_delay_is_exact(ticks):
    arm = weightless("psm")
    q = {}
    for n in (0, ticks):
        run = Run(arm, ArmEffects(delay=DelayEffect(command=n)))
        run.fix("effort_commanded", 0.5 * arm.effort_limits)
        path = [run.q]
        for _ in range(30):
            run.advance()
            path.append(run.q)
        q[n] = np.array(path)
    np.testing.assert_allclose(q[ticks][ticks:], q[0][: 31 - ticks], atol=1e-10)
    assert np.abs(q[0] - q[0][0]).max() > 1e-4


@pytest.mark.parametrize("name", ARMS)
def test_positions_are_whole_encoder_counts(name):
    arm = load_arm(name)
    run = Run(arm, arm.effects.only(["encoder"]))
    n = arm.num_joints
    resolution = np.array([arm.effects.encoder.resolution[joint] for joint in arm.joint_names])
    for _ in range(300):
        run.advance()
        counts = arm.transmission.position(run.get("position_measured")) / resolution
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
        error = arm.transmission.position(run.get("position_measured") - run.q)
        assert np.all(np.abs(error) <= 0.5 * resolution * (1 + 1e-9))
        np.testing.assert_array_equal(run.get("state_estimated")[:n], run.get("position_measured"))
        np.testing.assert_array_equal(run.get("state_estimated")[n:], run.get("velocity_estimated"))
    assert np.abs(run.v).max() > 0.1


def test_velocity_is_low_pass_of_count_differences():
    arm = load_arm("mtml")
    h, cut_off = STEP, 30.0
    run = Run(arm, ArmEffects(encoder=EncoderEffect(arm.effects.encoder.resolution, cut_off)))
    a = np.exp(-2 * np.pi * cut_off * h)
    q, v = run.get("position_measured"), np.zeros(7)
    for _ in range(300):
        run.advance()
        new = run.get("position_measured")
        v = a * v + (1 - a) * (new - q) / h
        q = new
        np.testing.assert_allclose(run.get("velocity_estimated"), v, atol=1e-9)
    assert np.abs(v[:3] - run.v[:3]).max() < 0.3 * np.abs(run.v[:3]).max()


@pytest.mark.parametrize("name", ARMS)
def test_each_motor_saturates_at_its_limit(name):
    arm = load_arm(name)
    limit = np.array([arm.effects.saturation[joint] for joint in arm.joint_names])
    run = Run(arm, arm.effects.only(["saturation"]))
    inverse = np.linalg.inv(arm.transmission.matrix)
    for signs in itertools.islice(itertools.product([-1.0, 1.0], repeat=arm.num_joints), 0, 128, 5):
        run.fix("effort_commanded", 10 * np.array(signs) * arm.effort_limits)
        assert np.all(np.abs(inverse.T @ run.get("effort_measured")) <= limit * (1 + 1e-12))
    run.fix("effort_commanded", 0.1 * arm.transmission.pull_back_effort(limit))
    np.testing.assert_allclose(run.get("effort_measured"), 0.1 * arm.transmission.pull_back_effort(limit), atol=1e-12)


def test_efforts_have_steps_and_noise():
    arm = load_arm("mtml")
    effort = arm.effects.effort
    inverse = np.linalg.inv(arm.transmission.matrix)
    steps = np.array([effort.measured_resolution[joint] for joint in arm.joint_names])
    deviation = np.array([effort.noise[joint] for joint in arm.joint_names])
    run = Run(arm, arm.effects.only(["effort"]))
    command = arm.transmission.pull_back_effort(10.3 * steps)
    run.fix("effort_commanded", command)
    seen = []
    for _ in range(1000):
        seen.append(inverse.T @ run.get("effort_measured"))
        run.advance()
    counts = np.array(seen) / steps
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    # 1000 samples: standard errors are 3 % of a deviation and 2 % of its size; five of them.
    assert np.all(np.abs(counts.mean(axis=0) - 10.0) < 5 * 0.033 * deviation / steps)
    np.testing.assert_allclose(counts.std(axis=0), np.hypot(deviation / steps, 12**-0.5), rtol=0.12, atol=0)
    quiet = Run(arm, ArmEffects(effort=EffortEffect(command_resolution=effort.command_resolution)))
    quiet.fix("effort_commanded", command)
    np.testing.assert_allclose(inverse.T @ quiet.get("effort_measured"), 10 * steps, rtol=0, atol=1e-9 * steps.max())


def test_motors_clamp_step_and_saturate_in_this_order():
    arm = load_arm("mtml")
    n, inverse, limits = arm.num_joints, arm.transmission.inverse, np.full(arm.num_joints, 0.5)
    first, second = arm.joint_names[:2]
    effects = ArmEffects(saturation={first: 0.25}, effort=EffortEffect(command_resolution={first: 0.1, second: 0.1}))
    # The effort does not increase beyond the joints' limits.
    free = Motors(arm, ArmEffects(), limits)
    np.testing.assert_allclose(free.effort(np.full(n, 9.0)), inverse.pull_back_effort(limits), atol=1e-12)
    # 0.33 is three steps, limited to 0.25 by the motor. The second has 0.3, all others the command.
    command = arm.transmission.pull_back_effort(np.array([0.33, -0.33, *[0.05] * (n - 2)]))
    assert np.all(np.abs(command) <= limits)
    effort = Motors(arm, effects, limits).effort(command)
    np.testing.assert_allclose(effort, [0.25, -0.3, *[0.05] * (n - 2)], atol=1e-12)


def test_drive_without_effects_is_ideal():
    arm = weightless("mtml")
    paths = []
    for effects in (None, ArmEffects()):
        run = Run(arm, effects)
        run.fix("effort_commanded", 0.3 * arm.effort_limits)
        run.advance(50)
        paths.append(np.concatenate([run.get("state_estimated"), run.get("effort_measured")]))
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-9)
    assert np.abs(paths[0][:7] - middle(arm)).max() > 1e-3


@pytest.mark.parametrize("effects", [None, ArmEffects()])
def test_controller_receives_state_before_the_step(effects):
    arm = load_arm("mtml")
    model = IdentifiedModel.from_arm(arm)
    controlled = ControlledArm(arm, np.full(7, 0.3), model, effects=effects)
    controlled.station.GetInputPort("mtml.effort_disturbance").FixValue(controlled.context, 0.2 * arm.effort_limits)
    controlled.simulator.Initialize()
    port, own = controlled.controller.GetOutputPort("effort"), controlled.controller_context
    for k in range(1, 30):
        before = controlled.q
        controlled.simulator.AdvanceTo(k * STEP)
        now = controlled.q
        limited = [np.clip(model.holding_torque(q), -arm.effort_limits, arm.effort_limits) for q in (before, now)]
        np.testing.assert_allclose(port.Eval(own), limited[0], atol=1e-12)
    assert np.abs(limited[1] - limited[0]).max() > 1e-6


# Mechanical properties of drive joints, stops, cables and springs of a real arm for any values.


@pytest.mark.parametrize("name", ARMS)
def test_joints_of_drive_coordinates_follow_the_arm(name):
    arm = load_arm(name)
    run = Run(arm, arm.effects.only(["friction", "stops"]))
    plant = run.station.plant
    plant_context = plant.GetMyContextFromRoot(run.context)
    added = run.station._drive.effects.drive._added
    assert len(added) == {"mtml": 2, "mtmr": 2, "psm": 4}[name]
    moved = run.q
    for _ in range(100):
        run.advance(10)
        for joint, row in added:
            # Compliance of the nearly rigid constraints of light bodies under the friction load.
            assert plant.GetPositions(plant_context)[joint.position_start()] == pytest.approx(row @ run.q, abs=3e-4)
    assert np.abs(run.q - moved).max() > 0.1  # the arm fell


@pytest.mark.parametrize("which", [0, 1])
def test_coupled_stop_limits_motion(which):
    arm = weightless("mtml")
    limit = arm.coupled_limits[0]
    push = (-3.0, 3.0)[which] * np.array([limit.coefficients.get(j, 0.0) for j in arm.joint_names]) / 2
    q = middle(arm)
    q[1:3] = 0.2, 0.0
    ends = []
    for effects in (ArmEffects(), arm.effects.only(["stops"])):
        run = Run(arm, effects, q)
        run.fix("effort_disturbance", push)
        sums = []
        for _ in range(600):
            run.advance()
            sums.append(run.q[1] + run.q[2])
        ends.append(np.array(sums))
    free, stopped = ends
    outside = {0: lambda s: limit.lower - s.min(), 1: lambda s: s.max() - limit.upper}[which]
    assert outside(free) > 0.05
    assert outside(stopped) < 2e-3
    assert np.abs(np.diff(stopped[-50:])).max() < 1e-5  # it stays at rest there


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_coupled_stop_adds_no_energy(direction):
    arm = weightless("mtml")
    energy = {}
    for parts in ([], ["stops"]):
        run = Run(arm, arm.effects.only(parts), [0.0, 0.2, 0.0, *middle(arm)[3:]])
        plant = run.station.plant
        plant_context = plant.GetMyContextFromRoot(run.context)
        run.fix("effort_disturbance", direction * np.array([0.0, 1.5, 1.5, 0.0, 0.0, 0.0, 0.0]))
        run.advance(120)
        run.fix("effort_disturbance", np.zeros(7))
        path = []
        for _ in range(500):
            run.advance()
            path.append(plant.CalcKineticEnergy(plant_context))
        energy[len(parts)] = np.array(path)
    # In free motion, steps of 1 ms change it by 2e-4. The stop dissipates energy and never adds any.
    assert np.all(energy[1] <= energy[1][0] * (1 + 1e-3))
    assert energy[1][-1] < 0.8 * energy[1][0] < energy[0][100]


def drive_force(run):
    prefix = run.station.plant.GetModelInstanceName(run.station._drive.instance)
    return run.station.GetSubsystemByName(f"{prefix}_drive_force")


def test_cable_effort_has_opposite_sign_of_identified_effect():
    arm, q = load_arm("mtml"), np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    sine = DriveEffect("joint.wrist_pitch", "cable sine", 1.0, 0.2)
    offset = DriveEffect("actuator.elbow_pitch", "offset", 0.0, 0.1)
    run = Run(arm, ArmEffects(cables=[sine], springs=[offset]), q)
    force = drive_force(run)
    effort = force.get_output_port().Eval(force.GetMyContextFromRoot(run.context))[run.station._drive.joints.index]
    np.testing.assert_allclose(effort, [0, -0.1, -0.1, 0, -0.2 * np.sin(0.5), 0, 0], atol=1e-12)


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_cables_and_springs_are_conservative(name):
    """Their work on a closed path of the joints is zero."""
    arm = weightless(name)
    run = Run(arm, arm.effects.only(["cables", "springs"]))
    system = drive_force(run)
    context, index = system.CreateDefaultContext(), run.station._drive.joints.index
    phase = np.linspace(0, 2 * np.pi, 2001)
    ranges = 0.4 * (arm.position_upper - arm.position_lower)
    q = middle(arm) + ranges * np.sin(np.outer(phase, np.arange(1, arm.num_joints + 1)) + 0.3)
    forces = []
    state = np.zeros(run.station.plant.num_multibody_states())
    for pose in q:
        state[index] = pose
        system.GetInputPort("plant_state").FixValue(context, state)
        forces.append(system.get_output_port().Eval(context)[index])
    f = np.array(forces)
    work = np.sum(0.5 * (f[1:] + f[:-1]) * np.diff(q, axis=0), axis=1)
    assert abs(work.sum()) < 1e-4 * np.abs(work).sum()
    assert np.abs(f).max() > 1e-3
