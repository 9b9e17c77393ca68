"""Static identification of a PSM: closed-loop plant, collected poses, identified model, command line."""

import numpy as np
import pytest

from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError
from dvrk_drake.experiments.ground_truth import perturbed_arm, simulate_poses
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import ArmEffects, DriveEffect
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions, set_joint_damping
from dvrk_drake.systems.arm_station import ArmStation

pytestmark = pytest.mark.numeric

COUNT = 16


ARM = load_arm("psm")


@pytest.fixture(scope="module")
def ground_truth_arm(tmp_path_factory):
    return perturbed_arm(ARM, tmp_path_factory.mktemp("ground_truth_arm") / "psm.sdf", 5, max_shift=0.002)


@pytest.fixture(scope="module")
def recording(ground_truth_arm):
    """Collects poses with the nominal model, so that the integrator compensates its errors."""
    generator = np.random.default_rng(6)
    laws = [DriveEffect("joint.yaw", "offset", 0.0, 0.05), DriveEffect("joint.roll", "cable sine", 1.0, 0.03)]
    station = ArmStation(
        ARM,
        plant_arm=ground_truth_arm,
        closure="ball",
        modify_plant=lambda plant: set_joint_damping(
            plant, ground_truth_arm, ARM.per_joint(0.03, 0.3) * ARM.effort_limits
        ),
        effects=ArmEffects(cables=laws),
    )
    poses = ARM.sample_poses(COUNT, generator, margin=0.1)
    return simulate_poses(station, IdentifiedModel.from_arm(ARM), poses)


def true_torque(arm, ground_truth_arm, poses):
    plant = make_arm_plant(ground_truth_arm)
    context = plant.CreateDefaultContext()
    tau = []
    for q in poses:
        set_arm_positions(plant, context, arm, q)
        tau.append(holding_torque(plant, context, arm))
    tau = np.array(tau)
    tau[:, 0] += 0.05
    tau[:, 3] += 0.03 * np.sin(poses[:, 3])
    return tau


@pytest.mark.slow
def test_true_torque_is_identified_with_the_closed_linkage(ground_truth_arm, recording):
    np.testing.assert_allclose(recording.tau, true_torque(ARM, ground_truth_arm, recording.q), atol=1e-3)
    model = identify_static(recording, ARM).model
    fresh = ARM.sample_poses(100, np.random.default_rng(7), margin=0.1)
    truth = true_torque(ARM, ground_truth_arm, fresh)
    error = np.sqrt(np.mean((model.holding_torque(fresh) - truth) ** 2, axis=0))
    assert np.all(error < np.maximum(0.03 * np.sqrt(np.mean(truth**2, axis=0)), 1e-3 * ARM.effort_limits))
    found = {str(ActuatorEffect.of(e)) for e in model.effects}
    assert found >= {"joint.yaw offset", "joint.roll cable sine 1"}
    # At a yaw joint the torques of a spring and of a lifted weight are equal. Only one of them may be a candidate.
    assert "joint.yaw cable sine 1" not in found


def test_prismatic_joint_has_no_angular_spring():
    model = IdentifiedModel.from_arm(ARM)
    model.effects = [DriveEffect("joint.insertion", "cable sine", 1.0, 1.0)]
    with pytest.raises(
        ModelError, match=r"effects\[0\]: kind cable sine requires a revolute .*\.insertion is prismatic"
    ):
        model.check()
