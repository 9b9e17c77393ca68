"""Mechanical properties of drive joints, stops, cables and springs of a real arm for any values."""

import numpy as np
import pytest
from simulated_effects import ARMS, Run, middle, weightless

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import ArmEffects, DriveEffect

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]


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
