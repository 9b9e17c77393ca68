"""Drive joints, stops, cables and springs of a real arm: mechanics that must hold whatever the values are."""

import numpy as np
import pytest
from real_arm import ARMS, Run, middle, weightless

from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.effects_schema import ArmEffects


@pytest.mark.parametrize("name", ARMS)
def test_joints_of_drive_coordinates_follow_the_arm(name):
    arm = load_arm(name)
    run = Run(arm, arm.effects.only(["friction", "stops"]))
    plant = run.station.plant
    plant_context = plant.GetMyContextFromRoot(run.context)
    added = run.station._parts.drive._added
    assert len(added) == {"mtml": 2, "mtmr": 2, "psm": 4}[name]
    moved = run.q
    for _ in range(100):
        run.advance(10)
        for joint, row in added:
            # What near-rigid ties of light bodies give by under the friction's load.
            assert plant.GetPositions(plant_context)[joint.position_start()] == pytest.approx(row @ run.q, abs=3e-4)
    assert np.abs(run.q - moved).max() > 0.1  # the arm fell


@pytest.mark.parametrize("which", [0, 1])
def test_the_coupled_stop_stops(which):
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
    assert np.abs(np.diff(stopped[-50:])).max() < 1e-5  # it rests there


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_the_coupled_stop_gives_no_energy(direction):
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
    # Flying free, steps of 1 ms change it by 2e-4; the stop takes it, and never gives any.
    assert np.all(energy[1] <= energy[1][0] * (1 + 1e-3))
    assert energy[1][-1] < 0.8 * energy[1][0] < energy[0][100]


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_cables_and_springs_give_back_what_they_take(name):
    """Round a closed path of the joints their work is nothing."""
    arm = weightless(name)
    run = Run(arm, arm.effects.only(["cables", "springs"]))
    torque = run.station.GetSubsystemByName("cables_and_springs")
    context = torque.CreateDefaultContext()
    phase = np.linspace(0, 2 * np.pi, 4001)
    ranges = 0.4 * (arm.position_upper - arm.position_lower)
    q = middle(arm) + ranges * np.sin(np.outer(phase, np.arange(1, arm.num_joints + 1)) + 0.3)
    forces = []
    for pose in q:
        torque.get_input_port().FixValue(context, np.concatenate([pose, np.zeros(arm.num_joints)]))
        forces.append(torque.get_output_port().Eval(context).copy())
    f = np.array(forces)
    work = np.sum(0.5 * (f[1:] + f[:-1]) * np.diff(q, axis=0), axis=1)
    assert abs(work.sum()) < 1e-4 * np.abs(work).sum()
    assert np.abs(f).max() > 1e-3
