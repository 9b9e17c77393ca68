"""Holding torques equal the dynamics at rest, with the same effects in drives and controllers."""

import dataclasses

import numpy as np
import pytest
from motions import true_dynamics

from dvrk_drake.analysis.estimation.motion_estimates import base_parameter_estimates
from dvrk_drake.dynamics.actuator_effects import (
    ActuatorEffect,
    distinct_coordinates,
    effect_fault,
    is_prismatic,
    joint_row,
)
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.identified_model import IdentifiedModel, JointStatistics
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import POSITION_KINDS, DriveEffect

pytestmark = pytest.mark.numeric

SCALES = {"offset": 0.0, "spring": 0.4, "cable sine": 2.0, "cable cosine": 1.5}


def all_effects(arm):
    """Returns all position-dependent effects along all coordinates that can have them."""
    effects = (ActuatorEffect(c, kind, SCALES[kind]) for c in arm.effect_coordinates for kind in POSITION_KINDS)
    return tuple(e for e in effects if not effect_fault(arm, e))


def model_of_all_effects(name, tilt):
    """Returns a physically consistent model with friction and position-dependent effects, and its DynamicModel."""
    generator = np.random.default_rng(3)
    arm = load_arm(name)
    arm = arm.with_gravity([float(g) for g in arm.gravity + tilt])
    estimates = [
        DriveEffect(e.coordinate, e.kind, e.scale, float(generator.normal()), standard_error=0.1)
        for e in all_effects(arm)
    ]
    friction = DriveEffect(f"actuator.{arm.joint_names[0]}", "coulomb", 0.1, 0.3)
    dynamics = true_dynamics(arm, generator, [friction, *estimates])
    section = dataclasses.replace(dynamics.section, gravity_expected=dynamics.section.gravity)
    covariance = np.eye(10 * len(section.links)) * 1e-6
    model = IdentifiedModel(
        arm=arm,
        base_parameters=base_parameter_estimates(arm, section, covariance),
        joints=[JointStatistics(name=joint) for joint in arm.joint_names],
        dynamics=section,
    )
    return arm, model, dynamics


@pytest.fixture(
    scope="module",
    params=[("mtmr", (0.4, 0.2, 0.0)), pytest.param(("psm", (0.0, 0.0, 0.0)), marks=pytest.mark.slow)],
    ids=lambda p: p[0],
)
def case(request):
    name, tilt = request.param
    return model_of_all_effects(name, np.array(tilt))


def test_holding_torque_equals_the_dynamics_at_rest(case):
    """The exceptions are offsets under gravity load without a cable cosine. Here only the PSM insertion has one."""
    arm, model, dynamics = case
    kept = [e for e in dynamics.section.effects if (e.coordinate, e.kind) != ("actuator.insertion", "offset")]
    assert len(dynamics.section.effects) - len(kept) == (arm.name == "PSM")
    dynamics = DynamicModel(arm, dataclasses.replace(dynamics.section, effects=kept))
    q = arm.sample_poses(200, np.random.default_rng(0))
    at_rest = arm.transmission.pull_back_effort(dynamics.effort(q, 0 * q, 0 * q))
    assert np.ptp(dynamics.effect_effort(q, 0 * q, 0 * q), axis=0).min() > 0.1  # there is something to compare
    np.testing.assert_allclose(model.holding_torque(q), at_rest, rtol=0, atol=1e-10)


def test_offset_is_a_holding_torque_without_gravity_load():
    """The nominal axis of the MTM's outer yaw is vertical, also if a motion shows a base tilt."""
    _, model, _ = model_of_all_effects("mtmr", np.array([0.4, 0.2, 0.0]))
    offsets = [e for e in model.dynamics.effects if e.kind == "offset" and e.coordinate.startswith("actuator.")]
    level = [float(g) for g in load_arm("mtmr").gravity]
    section = dataclasses.replace(model.dynamics, effects=offsets, gravity_expected=level)
    holding = DynamicModel(load_arm("mtmr"), section).holding_effects
    assert [offsets[i].coordinate for i in holding] == ["actuator.outer_yaw"]


def test_loaded_model_is_equal_and_conflicts_are_rejected(case, tmp_path):
    arm, model, _ = case
    model.save(tmp_path / "model.yaml")
    q = arm.sample_poses(20, np.random.default_rng(1))
    loaded = IdentifiedModel.load(tmp_path / "model.yaml")
    np.testing.assert_allclose(loaded.holding_torque(q), model.holding_torque(q), atol=1e-12)
    assert all(e.coefficient != 0 and e.standard_error > 0 for e in model.holding_effects)
    cable = next(e for e in model.holding_effects if e.kind == "cable sine")
    with pytest.raises(ModelError, match="allowed in a model with dynamics: offset and spring"):
        dataclasses.replace(model, effects=[cable]).check()
    offset = DriveEffect(cable.coordinate, "offset", 0.0, 0.1)
    with pytest.raises(ModelError, match="has two effects of the kind offset"):
        dataclasses.replace(model, effects=[offset, offset]).check()
    with pytest.raises(ModelError, match=r"gravity must equal dynamics\.gravity"):
        dynamics = dataclasses.replace(model.dynamics, gravity=[float(-g) for g in model.arm.gravity])
        dataclasses.replace(model, dynamics=dynamics).check()


def test_effects_are_bounded_outside_the_recorded_range():
    x = np.linspace(-50, 50, 2001)
    for kind in POSITION_KINDS:
        assert np.abs(ActuatorEffect("joint.yaw", kind, 0.7).column(x, 0 * x)).max() <= 1.0
    inside = np.abs(x) <= 0.7
    spring = ActuatorEffect("joint.yaw", "spring", 0.7).column(x, 0 * x)
    np.testing.assert_allclose(spring[inside], x[inside], atol=1e-12)


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_identical_coordinates_are_listed_once(name):
    arm = load_arm(name)
    rows = {c: joint_row(arm, c) for c in arm.effect_coordinates}
    kept = distinct_coordinates(arm)
    assert {f"actuator.{joint}" for joint in arm.joint_names} <= set(kept)
    unit = np.array([rows[c] / np.linalg.norm(rows[c]) for c in kept])
    assert np.abs(unit @ unit.T - np.eye(len(kept))).max() < 1 - 1e-6
    for c, row in rows.items():
        assert np.abs(unit @ row / np.linalg.norm(row)).max() > 1 - 1e-9, f"{c} is lost"
    assert [c for c in rows if is_prismatic(arm, c)] == [f"{kind}.insertion" for kind in ("actuator", "joint")] * (
        name == "psm"
    )
