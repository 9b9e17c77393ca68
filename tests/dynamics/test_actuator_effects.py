"""Kinds of drive effects, their curves, and compiled functions."""

from __future__ import annotations

import numpy as np
import pytest

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, is_prismatic, joint_row, position_along, sliding_effort
from dvrk_drake.dynamics.compiled import sin_cos
from dvrk_drake.dynamics.dynamic_model import effect_shapes
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS, DriveEffect

pytestmark = pytest.mark.numeric

T = np.arange(0, 4, 1e-3)
X = 0.3 * np.sin(2 * np.pi * 0.7 * T) + 0.1 * np.sin(2 * np.pi * 1.9 * T)
V = np.gradient(X, 1e-3)
LOAD = np.abs(np.cos(X))


@pytest.mark.parametrize("kind", EFFECT_KINDS)
def test_steps_equal_the_column(kind):
    effect = ActuatorEffect("actuator.pitch", kind, 0.05)
    state, previous, shapes = 0.0, X[0], []
    for x, v, load in zip(X, V, LOAD, strict=True):
        state, shape = effect.step(state, x - previous, x, v, load)
        shapes.append(shape)
        previous = x
    np.testing.assert_allclose(shapes, effect.column(X, V, LOAD), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", [name for name, kind in EFFECT_KINDS.items() if kind.dissipative])
def test_friction_dissipates_energy(kind):
    column = ActuatorEffect("actuator.pitch", kind, 0.02).column(X, V, LOAD)
    # The energy stored at the end is small compared with the dissipated energy.
    work = np.sum(0.5 * (column[1:] + column[:-1]) * np.diff(X))
    assert work > 0
    assert np.max(np.abs(column)) <= (np.max(np.abs(V)) if kind == "viscous" else 1.0) + 1e-12


def test_presliding_element_is_a_spring_before_sliding():
    d = 0.1
    path = np.concatenate([np.linspace(0, 0.05, 50), np.linspace(0.05, 0.5, 50), np.linspace(0.5, 0.45, 50)])
    shape = ActuatorEffect("actuator.pitch", "presliding", d).column(path, 0 * path)
    np.testing.assert_allclose(shape[:50], path[:50] / d, atol=1e-12)
    assert shape[99] == 1.0
    np.testing.assert_allclose(shape[100:], 1 - (0.5 - path[100:]) / d, atol=1e-12)


def test_load_friction_is_coulomb_friction_times_the_load():
    """The load is the gravity effort of the actuator."""
    arm = load_arm("psm")
    regressor = DynamicRegressor(arm)
    q = arm.sample_poses(40, np.random.default_rng(0))
    v = np.random.default_rng(1).normal(size=q.shape)
    rest = np.zeros_like(q)
    weight = arm.transmission.inverse.pull_back_effort(regressor.torque(q, rest, rest, regressor.values))
    for i, name in enumerate(arm.joint_names):
        plain, loaded = (ActuatorEffect(f"actuator.{name}", kind, 0.02) for kind in ("coulomb", "load coulomb"))
        a, b = effect_shapes(regressor, [plain, loaded], q, v)
        np.testing.assert_allclose(b, a * np.abs(weight[:, i]), atol=1e-12)
    assert np.ptp(weight[:, 1]) > 0.1


def test_coordinates_equal_joint_and_finger_positions():
    for name in ("mtmr", "psm"):
        arm = load_arm(name)
        rows = arm.effect_coordinates
        generator = np.random.default_rng(0)
        q = generator.normal(size=arm.num_joints)
        a = arm.transmission.position(q)
        for j, joint in enumerate(arm.joint_names):
            if f"joint.{joint}" in rows:
                assert rows[f"joint.{joint}"] @ a == pytest.approx(q[j])
        assert len(rows) > arm.num_joints
    arm = load_arm("psm")
    rows = arm.effect_coordinates
    a = arm.transmission.position(q)
    assert rows["finger_1"] @ a == pytest.approx(q[5] - q[6] / 2)
    assert is_prismatic(arm, "actuator.insertion") and not is_prismatic(arm, "finger_1")


# Friction and cable curves of the drives equal the torques of the model.


NAME = "actuator.wrist_yaw"


def test_friction_at_constant_speed():
    effects = [
        DriveEffect(NAME, "viscous", 0.0, 0.2),
        DriveEffect(NAME, "coulomb", 0.05, 0.3),
        DriveEffect(NAME, "presliding", 0.01, 0.1),
        DriveEffect(NAME, "presliding forward", 0.01, 0.04),
        DriveEffect(NAME, "load coulomb", 0.05, 0.5),
        DriveEffect(NAME, "offset", 0.0, 9.0),
    ]
    v = np.array([-2.0, -0.02, 0.0, 0.02, 2.0])
    smoothed = np.tanh(v / 0.05)
    expected = 9.0 + 0.2 * v + (0.3 + 0.5 * 0.6) * smoothed + 0.1 * np.sign(v) + 0.04 * (v > 0)
    np.testing.assert_allclose(sliding_effort(effects, 0.3, v, load=0.6), expected, atol=1e-12)


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_position_curves_add_up_to_the_holding_torque(name):
    arm = load_arm(name)
    effects = [*arm.effects.cables, *arm.effects.springs]
    with_effects, without = (IdentifiedModel.from_arm(arm, given) for given in (effects, []))
    q = arm.sample_poses(20, np.random.default_rng(0))
    tau = np.zeros_like(q)
    for coordinate in dict.fromkeys(e.coordinate for e in effects):
        own = [e for e in effects if e.coordinate == coordinate]
        curve = sliding_effort(own, position_along(arm, coordinate, q), np.zeros(len(q)))
        tau += curve[:, None] * joint_row(arm, coordinate)
    assert np.any(tau)
    np.testing.assert_allclose(tau, with_effects.holding_torque(q) - without.holding_torque(q), atol=1e-9)


# Compares the compiled sine and cosine with numpy.


#: Tolerance for numbers below 1 after a few rounding operations.
ROUNDING = 4 * np.finfo(float).eps


@pytest.mark.parametrize("size", [8.0, 1e6])
def test_equals_numpy(size):
    x = np.random.default_rng(0).uniform(-size, size, 20_000)
    values = np.array([sin_cos(value) for value in x])
    assert np.abs(values - np.column_stack([np.sin(x), np.cos(x)])).max() < ROUNDING


def test_near_multiples_of_90_degrees():
    quarters = np.arange(-9, 10) * np.pi / 2
    for x in np.concatenate([quarters, quarters - np.pi / 4, np.nextafter(quarters, 99), [1e-300, 0.0]]):
        np.testing.assert_allclose(sin_cos(x), [np.sin(x), np.cos(x)], rtol=0, atol=ROUNDING)


def test_small_angles_have_small_relative_errors():
    x = np.logspace(-12, -1, 50)
    assert np.abs([sin_cos(value)[0] / np.sin(value) - 1 for value in x]).max() < ROUNDING


@pytest.mark.parametrize("x", [np.nan, np.inf, -np.inf])
def test_infinity_and_nan_give_nan(x):
    assert np.isnan(sin_cos(x)).all()
