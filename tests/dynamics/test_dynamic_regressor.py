"""Compares the dynamic regressor with Drake's inverse dynamics of the plant, projected through the linkage."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces
from pydrake.systems.framework import Context

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.inertial_parameters import LinkInertia
from dvrk_drake.dynamics.regressor_kernel import BLOCK
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant, tree_selector

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]

MOUNTINGS = [(0.0, 0.0, -9.81), (1.3, -4.2, 8.5), (0.0, 0.0, 0.0)]


def random_motion(arm: Arm, count: int, seed: int = 0):
    generator = np.random.default_rng(seed)
    q = arm.sample_poses(count, generator)
    return q, generator.normal(0, 2, q.shape), generator.normal(0, 10, q.shape)


def drake_torque(plant: MultibodyPlant, context: Context, arm: Arm, q, v, vd):
    """Returns G' (M vd + C v - tau_g) of the whole tree for each sample."""
    selector = tree_selector(plant, arm)
    tau = np.empty(q.shape)
    for i in range(len(q)):
        q_tree, v_tree, vd_tree = (np.zeros(plant.num_velocities()) for _ in range(3))
        q_tree[selector] = arm.linkage.position(q[i])
        v_tree[selector] = arm.linkage.velocity(v[i])
        vd_tree[selector] = arm.linkage.velocity(vd[i])
        plant.SetPositions(context, q_tree)
        plant.SetVelocities(context, v_tree)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        tau[i] = arm.linkage.pull_back_effort(plant.CalcInverseDynamics(context, vd_tree, forces)[selector])
    return tau


def assert_equal_torque(actual, expected):
    """Compares torques with a tolerance of 1e-10 relative to the largest torque of the joint, at most 1e-10 N m."""
    scale = np.minimum(np.abs(expected).max(axis=0), 1.0)
    np.testing.assert_array_less(np.abs(actual - expected).max(axis=0), 1e-10 * np.maximum(scale, 1e-6))


@pytest.fixture(scope="module", params=["mtml", "mtmr", "psm", "ecm"])
def arm(request):
    return load_arm(request.param)


@pytest.mark.parametrize("gravity", MOUNTINGS)
def test_equals_the_inverse_dynamics_of_the_plant(arm, gravity):
    arm = arm.with_gravity(gravity)
    model = DynamicRegressor(arm)
    motion = random_motion(arm, 100)
    plant = make_arm_plant(arm)
    expected = drake_torque(plant, plant.CreateDefaultContext(), arm, *motion)
    assert_equal_torque(model.regressor(*motion) @ model.values, expected)
    assert_equal_torque(model.torque(*motion, model.values), expected)


@pytest.mark.parametrize("seed", [1, 2])
def test_equals_the_plant_with_other_parameters(arm, seed):
    """All links and rotors have random inertias, in the plant and in the parameters."""
    model = DynamicRegressor(arm)
    generator = np.random.default_rng(seed)
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    parameters = []
    for link in model.links:
        points = generator.normal(0, 0.2, (6, 3))  # The link consists of six point masses.
        masses = generator.uniform(0.1, 1, 6)
        inertia = sum(m * ((p @ p) * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, points, strict=True))
        ten = [masses.sum(), *(masses @ points), *np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
        parameters.append(np.array(ten))
        changed = LinkInertia(link.link, parameters[-1]).to_spatial_inertia()
        plant.GetBodyByName(link.link).SetSpatialInertiaInBodyFrame(context, changed)
    D_joint = np.zeros((arm.num_joints,) * 2)
    for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices()):
        if actuator.default_rotor_inertia() == 0:
            continue  # The SDF models the MTM's motors 3 and 4 as links.
        inertia = generator.uniform(1e-6, 1e-5)
        actuator.SetRotorInertia(context, inertia)
        joint = arm.joint_names.index(actuator.joint().name())
        D_joint[joint, joint] = inertia * actuator.default_gear_ratio() ** 2
    J_inverse = np.linalg.inv(arm.transmission.matrix)
    D = J_inverse.T @ D_joint @ J_inverse
    rotors = [D[tuple(arm.joint_names.index(name) for name in rotor.actuators)] for rotor in model.rotors]
    motion = random_motion(arm, 50, seed)
    actual = model.torque(*motion, np.concatenate([*parameters, rotors]))
    assert_equal_torque(actual, drake_torque(plant, context, arm, *motion))


def test_mass_matrix_equals_that_of_the_plant(arm):
    model = DynamicRegressor(arm)
    q, _, _ = random_motion(arm, 20)
    M = model.mass_matrix(q, model.values)
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    selector, G = tree_selector(plant, arm), arm.linkage.matrix
    for i in range(len(q)):
        q_tree = np.zeros(plant.num_positions())
        q_tree[selector] = arm.linkage.position(q[i])
        plant.SetPositions(context, q_tree)
        M_tree = plant.CalcMassMatrix(context)[np.ix_(selector, selector)]
        np.testing.assert_allclose(M[i], G.T @ M_tree @ G, rtol=0, atol=1e-12)
        assert np.linalg.eigvalsh(M[i])[0] > 0


@pytest.mark.parametrize("count", [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 7])
def test_many_samples_equal_single_samples(arm, count):
    """The last block is full, has one sample or does not exist."""
    model = DynamicRegressor(arm)
    motion = random_motion(arm, count)
    Y = model.regressor(*motion)
    assert Y.shape == (count, arm.num_joints, len(model.names))
    single = [model.regressor(*(x[i : i + 1] for x in motion)) for i in range(count)]
    np.testing.assert_allclose(Y, np.reshape(single, Y.shape), rtol=0, atol=1e-12 * np.abs(Y).max(initial=0.0))


def test_writes_to_the_output_array(arm):
    model = DynamicRegressor(arm)
    motion = random_motion(arm, 700)
    out = np.full((700, arm.num_joints, len(model.names)), np.nan)
    assert model.regressor(*motion, out=out) is out
    np.testing.assert_allclose(out, model.regressor(*motion), rtol=0, atol=1e-12 * np.abs(out).max())
    with pytest.raises(ModelError, match="C-contiguous"):
        model.regressor(*motion, out=out[:-1])
    with pytest.raises(ModelError, match="C-contiguous"):
        model.regressor(*motion, out=np.asfortranarray(out))


def test_rejects_wrong_shapes(arm):
    model = DynamicRegressor(arm)
    q, v, vd = random_motion(arm, 3)
    with pytest.raises(ModelError, match="allowed"):
        model.regressor(q, v[:2], vd)
    with pytest.raises(ModelError, match="allowed"):
        model.regressor(q[0], v[0], vd[0])
    with pytest.raises(ModelError, match="parameters have shape"):
        model.torque(q, v, vd, model.values[:-1])
