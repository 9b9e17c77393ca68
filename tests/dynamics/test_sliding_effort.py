"""Friction and cable curves of the drives equal the torques of the model."""

import numpy as np
import pytest

from dvrk_drake.dynamics.actuator_effects import joint_row, position_along, sliding_effort
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import DriveEffect

pytestmark = pytest.mark.numeric

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
