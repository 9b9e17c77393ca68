"""Tests the properties of the kinds of drive effects."""

import numpy as np
import pytest

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, is_prismatic
from dvrk_drake.dynamics.dynamic_model import effect_shapes
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effect_kinds import EFFECT_KINDS

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
