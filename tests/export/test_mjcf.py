"""Compares the MJCF in MuJoCo with the model, and the friction of MJCF, SDF and URDF with the effects of the drives."""

import contextlib
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError
from dvrk_drake.export.model_export import approximate_drives, export_model
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.models.mjcf import to_mjcf
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions

ARMS = ["mtml", "psm", "psm_si+NEEDLE_DRIVER_420117", "ecm", "ecm_si"]


class Mujoco:
    """MJCF of an arm in MuJoCo."""

    def __init__(self, model, path):
        mujoco = pytest.importorskip("mujoco")
        export_model(model, path, "mjcf")
        with contextlib.chdir(path.parent):  # MuJoCo writes its warnings into a file here
            self.model = mujoco.MjModel.from_xml_path(str(path))
            assert not (path.parent / "MUJOCO_LOG.TXT").exists()
        self.data, self.mujoco = mujoco.MjData(self.model), mujoco
        joints = [self.model.joint(name).id for name in model.arm.tree_joint_names]
        self.places, self.dofs = self.model.jnt_qposadr[joints], self.model.jnt_dofadr[joints]


@pytest.fixture(scope="module", params=ARMS)
def pair(request, tmp_path_factory):
    model = IdentifiedModel.from_arm(load_arm(request.param), dynamics=True)
    return model, Mujoco(model, tmp_path_factory.mktemp("mjcf") / "arm.xml")


def test_gravity_and_inverse_dynamics_equal_the_model(pair):
    model, mujoco = pair
    arm, dynamics, generator = model.arm, DynamicModel(model.arm, model.dynamics), np.random.default_rng(0)
    flags = mujoco.mujoco.mjtDisableBit
    mujoco.model.opt.disableflags |= flags.mjDSBL_CONSTRAINT | flags.mjDSBL_SPRING | flags.mjDSBL_DAMPER
    q, G = arm.sample_poses(200, generator), arm.linkage.matrix
    v, vd = (speed * generator.uniform(-1, 1, q.shape) * np.where(arm.prismatic, 0.1, 1.0) for speed in (1.0, 10.0))
    v[:100] = vd[:100] = 0.0
    tau, data = np.empty(q.shape), mujoco.data
    for i in range(len(q)):
        data.qpos[mujoco.places] = arm.linkage.position(q[i])
        data.qvel[mujoco.dofs], data.qacc[mujoco.dofs] = G @ v[i], G @ vd[i]
        mujoco.mujoco.mj_inverse(mujoco.model, data)
        tau[i] = G.T @ data.qfrc_inverse[mujoco.dofs]
    expected = arm.transmission.pull_back_effort(dynamics.rigid_body_effort(q, v, vd))
    np.testing.assert_allclose(tau, expected, atol=1e-6)


def test_loops_are_closed_and_frames_agree_at_the_keyframes(pair):
    model, mujoco = pair
    arm, plant = model.arm, make_arm_plant(model.arm)
    context = plant.CreateDefaultContext()
    assert mujoco.model.nkey == 11
    assert mujoco.model.neq == len(arm.tree_joint_names) - arm.num_joints
    tree = [arm.tree_joint_names.index(joint) for joint in arm.joint_names]
    for key in range(mujoco.model.nkey):
        mujoco.mujoco.mj_resetDataKeyframe(mujoco.model, mujoco.data, key)
        mujoco.mujoco.mj_forward(mujoco.model, mujoco.data)
        assert mujoco.data.ncon == 0
        q = mujoco.data.qpos[mujoco.places][tree]
        assert not arm.limit_violations(q, 1e-12)
        set_arm_positions(plant, context, arm, q)
        for frame in (arm.frames.hand, *(f for loop in arm.loop_closures for f in (loop.frame_a, loop.frame_b))):
            if mujoco.mujoco.mj_name2id(mujoco.model, mujoco.mujoco.mjtObj.mjOBJ_SITE, frame) >= 0:
                p = plant.GetFrameByName(frame).CalcPoseInWorld(context).translation()
                np.testing.assert_allclose(mujoco.data.site(frame).xpos, p, atol=1e-9)


def test_motors_have_the_limits_of_the_joints(pair):
    model, mujoco = pair
    for joint, limit in zip(model.arm.joint_names, model.arm.effort_limits, strict=True):
        np.testing.assert_allclose(mujoco.model.actuator(joint).ctrlrange, [-limit, limit], atol=1e-12)


def test_friction_without_presliding_is_exact():
    model = IdentifiedModel.from_arm(load_arm("psm"), dynamics=True)
    effects = [("actuator.jaw", "viscous", 0.0, 0.02), ("actuator.jaw", "coulomb", 1e-6, 0.01)]
    model.dynamics.effects[:] = [DriveEffect(*effect) for effect in [*effects, ("joint.yaw", "spring", 5.0, 0.3)]]
    result = approximate_drives(model)
    jaw, yaw = result.drives
    np.testing.assert_allclose([jaw.viscous, jaw.dry, jaw.stiffness, yaw.stiffness], [0.02, 0.01, 0, 0.3], atol=1e-6)
    assert list(jaw.row) == ["wrist_pitch", "wrist_yaw", "jaw"]  # the coupling of the instrument
    np.testing.assert_allclose(result.difference, 0, atol=1e-6)
    # Formats without coupled friction and springs omit those.
    assert approximate_drives(model, coupled=False).difference[0] == pytest.approx(result.effort[0])


@pytest.mark.parametrize("format", ["sdf", "urdf"])
def test_friction_of_the_joints_is_exported(format, tmp_path):
    model = IdentifiedModel.from_arm(load_arm("psm"), dynamics=True)
    path = tmp_path / f"arm.{format}"
    exported = export_model(model, path, friction=True)
    root = ElementTree.parse(path).getroot()
    dynamics = root.find(".//joint[@name='pitch']//dynamics")
    stated = [float(dynamics.get(tag) or dynamics.findtext(tag)) for tag in ("friction", "damping")]
    (pitch,) = (drive for drive in exported.drives.drives if drive.name == "pitch")
    np.testing.assert_allclose(stated, [pitch.dry, pitch.viscous], atol=1e-12)
    np.testing.assert_allclose(stated, [0.187 + 0.098, 0.016], atol=1e-6)  # mechanisms/psm.yaml
    assert not any("friction" in text for text in exported.left_out)
    if format == "sdf":  # Drake has no dry friction
        plant = MultibodyPlant(1e-3)
        Parser(plant).AddModels(str(path))
        assert plant.GetJointByName("pitch").default_damping() == pytest.approx(0.016, abs=1e-6)
    else:
        pinocchio = pytest.importorskip("pinocchio")
        assert pinocchio.buildModelFromUrdf(str(path)).njoints > 1


def test_shapes_that_mjcf_does_not_have_are_refused(tmp_path):
    shape = "<collision name='c'><geometry><cone/></geometry></collision>"
    text = f"<sdf><model name='m'><link name='base_link'>{shape}</link></model></sdf>"
    with pytest.raises(ModelError, match="link base_link, collision c: MJCF has no shape cone"):
        to_mjcf(ElementTree.fromstring(text), [0, 0, -9.81])
