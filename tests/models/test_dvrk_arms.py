"""Compares the arms of this package with the configuration files of the dVRK: DH tables, limits and masses."""

import json

import numpy as np
import pytest
from dvrk_judge import judge
from dvrk_share import ROUNDING, craig, dh_poses, dh_rows, dvrk_share

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import dh_frames, holding_torques, make_arm_plant, set_arm_positions

ARMS = {"psm": "PSM", "psm_si": "PSM_Si", "ecm": "ECM", "ecm_si": "ECM_Si"}
#: Corners of the parallelogram of an Si arm in the plane of its pitch joint [m], from comments in the files.
LINK, BAR = (-0.0922, -0.1810), (0.33872, -0.0712)
#: Mass of an Si endoscope, which the dVRK's controller sets in the file (mtsIntuitiveResearchKit.h, SiHDMass) [kg].
ENDOSCOPE = 0.9


@pytest.fixture(params=ARMS, scope="module")
def arm(request):
    return load_arm(request.param)


@pytest.fixture
def rows(arm, shared_data):
    return dh_rows(dvrk_share(shared_data) / "kinematic" / f"{ARMS[arm.source]}.json")


def test_frames_equal_the_dh_table(arm, rows):
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    frames = list(dh_frames(plant).values())[: len(rows) + 1]
    for q in arm.sample_poses(50, np.random.default_rng(0)):
        set_arm_positions(plant, context, arm, q)
        poses = dh_poses(rows, q[: len(rows)])
        for frame, X in zip(frames[1:], poses, strict=True):
            np.testing.assert_allclose(frame.CalcPose(context, frames[0]).GetAsMatrix4(), X, atol=1e-12)
        if len(rows) == arm.num_joints == 4:  # mtsIntuitiveResearchKitECM.cpp, tool offset of a straight endoscope
            X = plant.GetFrameByName(arm.frames.hand).CalcPose(context, frames[0]).GetAsMatrix4()
            np.testing.assert_allclose(X, poses[-1] @ craig(0.0, 0.0, -np.pi / 2, 0.0), atol=1e-12)


def test_joints_and_limits_equal_those_of_the_dvrk(arm, rows):
    count = len(rows)
    assert arm.joint_names[:count] == tuple(row["name"] for row in rows)
    np.testing.assert_allclose(arm.position_lower[:count], [row["qmin"] for row in rows], atol=1e-12)
    np.testing.assert_allclose(arm.position_upper[:count], [row["qmax"] for row in rows], atol=1e-12)
    np.testing.assert_allclose(arm.effort_limits[:count], [row["ftmax"] for row in rows], atol=2e-4)


def test_linkage_is_closed_and_remote_centre_is_fixed(arm):
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    for q in arm.sample_poses(50, np.random.default_rng(1)):
        set_arm_positions(plant, context, arm, q)
        for loop in arm.loop_closures:
            A, B = plant.GetFrameByName(loop.frame_a), plant.GetFrameByName(loop.frame_b)
            np.testing.assert_allclose(A.CalcPose(context, B).translation(), 0, atol=1e-12)
        center = plant.GetFrameByName("remote_center").CalcPoseInWorld(context).translation()
        np.testing.assert_allclose(center, 0, atol=1e-12)


def gravity_file(share, name):
    """Returns the content of the gravity file of an Si arm without rounded angles, for the program `judge_psm`."""
    rows = dh_rows(share / "kinematic" / f"{name}_physical.json")
    link, bar = (float(np.arctan2(y, x)) for x, y in (LINK, BAR))
    for i, key, exact in (
        (2, "theta", link),
        (3, "theta", bar - link),
        (4, "theta", -bar),
        (3, "A", float(np.hypot(*LINK))),
        (4, "A", float(np.hypot(*BAR))),
    ):
        assert abs(rows[i][key] - exact) < ROUNDING
        rows[i][key] = exact
    if len(rows) == 6:  # An ECM has one insertion joint with the endoscope, and the program expects two.
        assert rows[5]["mass"] == 0
        zeros = dict.fromkeys(("alpha", "A", "theta", "D"), 0.0)
        rows.append({**rows[5], **zeros, "name": "insertion2", "mass": ENDOSCOPE})
    return {"DH": {"convention": "modified", "joints": rows}}


@pytest.mark.parametrize("name", ["psm_si", "ecm_si"])
def test_gravity_of_si_arms_equals_that_of_the_controller(name, shared_data, tmp_path):
    share = dvrk_share(shared_data)
    (tmp_path / "arm.yaml").write_text(
        f"sdf: package://dvrk_drake/sdf/{name}.sdf\nposition_limits: {{insertion: [0.0, 0.2]}}\n"
    )
    arm = load_arm(tmp_path / "arm.yaml")  # without an instrument
    q = arm.sample_poses(200, np.random.default_rng(2))
    tau = holding_torques(arm, q)
    assert np.abs(tau).max(axis=0)[:3].min() > 5  # The arm is not balanced.
    path = tmp_path / "exact.json"
    path.write_text(json.dumps(gravity_file(share, ARMS[name])))
    np.testing.assert_allclose(judge(shared_data, "judge_psm", path, q[:, :3]), tau[:, :3], atol=1e-9)
    if name == "psm_si":  # The rounded angles of the file cause this difference.
        file = share / "kinematic" / "PSM_Si_physical.json"
        np.testing.assert_allclose(judge(shared_data, "judge_psm", file, q[:, :3]), tau[:, :3], atol=1e-4)


def test_disc_coupling_is_that_of_the_dvrk():
    M = np.array([[-1.5632, 0, 0, 0], [0, 1.0186, 0, 0], [0, -0.8306, 0.6089, 0.6089], [0, 0, -1.2177, 1.2177]])
    disc = np.array([0.1, -0.2, 0.3, 0.5])
    q = np.concatenate([[0.1, 0.2, 0.05], M @ disc])
    a = load_arm("psm").transmission.position(q)
    np.testing.assert_allclose(a, np.concatenate([[0.1, 0.2, 0.05], disc]), atol=1e-12)
