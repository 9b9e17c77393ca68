"""Compares the dynamic regressor with Drake's inverse dynamics of the plant, projected through the linkage."""

from __future__ import annotations

import re

import numpy as np
import pytest
from command_output import assert_refused
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces
from pydrake.systems.framework import Context

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor, derive_base_parameters
from dvrk_drake.dynamics.inertial_parameters import LinkInertia
from dvrk_drake.dynamics.regressor_kernel import BLOCK
from dvrk_drake.dynamics.symbolic_gravity import derive_gravity
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant, tree_selector

pytestmark = [pytest.mark.drake_api, pytest.mark.numeric]

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
    assert_refused(ModelError, "C-contiguous", model.regressor, *motion, out=out[:-1])
    assert_refused(ModelError, "C-contiguous", model.regressor, *motion, out=np.asfortranarray(out))


def test_rejects_wrong_shapes(arm):
    model = DynamicRegressor(arm)
    q, v, vd = random_motion(arm, 3)
    assert_refused(ModelError, "allowed", model.regressor, q, v[:2], vd)
    assert_refused(ModelError, "allowed", model.regressor, q[0], v[0], vd[0])
    assert_refused(ModelError, "parameters have shape", model.torque, q, v, vd, model.values[:-1])


# Tests torque, number and names of the base parameters of the full dynamics.


@pytest.fixture(scope="module", params=["mtml", "psm"])
def model(request):
    return DynamicRegressor(load_arm(request.param))


@pytest.fixture(scope="module")
def reduced(model):
    return derive_base_parameters(model)


def lift(reduced):
    """Returns a matrix (p, b) with Y_base = Y lift. phi = lift beta has the base parameters beta."""
    return reduced.to_links[:, reduced.base.columns]


@pytest.fixture(scope="module")
def Y(model, reduced):
    """Returns the regressor at states that were not used to derive the base parameters."""
    generator = np.random.default_rng(7)
    q = model.arm.sample_poses(300, generator)
    Y = model.regressor(q, generator.normal(0, 2, q.shape), generator.normal(0, 5, q.shape))
    return Y[..., : len(reduced.to_links)]  # without terms that couple two rotors


def test_base_regressor_times_base_values_is_the_torque(model, reduced, Y):
    """Tests the parameters of the SDF and random parameters."""
    p = Y.shape[-1]
    for phi in (model.values[:p], np.random.default_rng(1).normal(0, 1, p)):
        tau = Y @ phi
        np.testing.assert_allclose(Y @ lift(reduced) @ (reduced.combination @ phi), tau, rtol=0, atol=1e-9)


def test_number_equals_the_rank_of_the_regressor(reduced, Y):
    """The number of singular values above rounding errors equals the number of base parameters.

    Columns that contain only rounding errors are omitted.
    """
    columns = Y.reshape(-1, Y.shape[-1])
    size = np.linalg.norm(columns, axis=0)
    nonzero = size > 1e-9 * size.max()
    singular = np.linalg.svd(columns[:, nonzero] / size[nonzero], compute_uv=False)
    rank = len(reduced.base.names)
    assert singular[rank - 1] > 1e-5 * singular[0]
    assert singular[rank] < 1e-10 * singular[0]


def test_null_space_does_not_change_the_torque(reduced, Y):
    """Tests all p - b directions of the null space of the combinations."""
    null = np.linalg.svd(reduced.combination)[2][len(reduced.base.names) :]
    assert len(null) == Y.shape[-1] - len(reduced.base.names)
    assert np.abs(Y @ null.T).max() < 1e-9 * np.abs(Y).max()


def test_rank_at_rest_equals_that_of_the_gravity_model(reduced, model):
    """The regressor at rest has the rank of `derive_gravity`, which assumes that the MTM's rotor 4 is balanced."""
    unbalance = {"m_motor_4 c_motor_4_x", "m_motor_4 c_motor_4_y"}
    balanced = [i for i, name in enumerate(reduced.base.names) if name not in unbalance]
    q = model.arm.sample_poses(50, np.random.default_rng(3))
    rest = np.zeros_like(q)
    static = (model.regressor(q, rest, rest)[..., : len(reduced.to_links)] @ lift(reduced))[..., balanced].reshape(
        -1, len(balanced)
    )
    assert np.linalg.matrix_rank(static, tol=1e-8) == len(derive_gravity(model.arm).base.names)


def test_names_and_units_match_the_combination(reduced):
    """Each name contains all inertias of its combination, and its unit matches the name."""
    assert len(set(reduced.base.names)) == len(reduced.base.names)
    for name, unit, row in zip(reduced.base.names, reduced.base.units, reduced.base.combination, strict=True):
        used = [reduced.standard_parameters[i] for i in np.flatnonzero(np.abs(row) > 1e-9)]
        inertias = [str(parameter) for parameter in used if parameter.is_inertia]
        assert all(inertia in name for inertia in inertias)
        prismatic = name == "Ia_3"  # Rotor of the PSM's insertion.
        assert prismatic or bool(inertias) == (unit == "kg m^2")
        # Only inertias have coefficients with squared lengths.
        assert inertias or not re.search(r"\^2", name)


def test_names_of_the_mtm_wrist_agree_with_the_textbook():
    """The base parameters agree with Khalil and Dombre, table 9.3: Iyy of the last link is part of the link before."""
    names = derive_base_parameters(DynamicRegressor(load_arm("mtmr"))).base.names
    assert {"Ixx_7 - Iyy_7", "Izz_7", "Ixx_6 - Izz_6 + Iyy_7", "m6 c6z + m7 c7z", "Ia_7"} <= set(names)
    assert "L2 (m2+...+m7+m_motor_4) + m2 c2x + m_coupler c_coupler_x" in names
