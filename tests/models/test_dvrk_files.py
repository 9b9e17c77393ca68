"""Compares arms and instruments with the configuration files of the dVRK."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_output import assert_refused
from dvrk_judge import judge

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ArmError, ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.dvrk_tool import dvrk_tools, read_tool
from dvrk_drake.models.files import read_json_input
from dvrk_drake.models.plant import dh_frames, holding_torques, make_arm_plant, set_arm_positions, shared_plant
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import Recording

#: Largest rounding error of an angle in the files [rad], e.g. 1.5708 for a quarter turn.
ROUNDING = 1e-5


def dvrk_share(shared_data: Path) -> Path:
    """Returns the folder with the dVRK's configuration files. Skips the test if it is absent."""
    share = shared_data.parent / "peers" / "dvrk_console" / "share"
    if not share.is_dir():
        pytest.skip(f"needs the configuration files of the dVRK in {share}")
    return share


def dh_rows(path: Path) -> list[dict[str, Any]]:
    """Returns the rows of the DH table in a file, with exact eighths of a turn in place of e.g. 1.5708."""
    table = read_json_input(path, ArmError)["DH"]
    assert table["convention"] == "modified"
    return [exact_eighths(row) for row in table.get("joints") or table["links"]]


def exact_eighths(row: dict[str, Any]) -> dict[str, Any]:
    """Returns a row of a DH table with exact eighths of a turn."""
    row = dict(row)
    for key in {"alpha", "theta", "offset"} & row.keys():
        exact = round(row[key] / (np.pi / 4)) * np.pi / 4
        row[key] = exact if abs(row[key] - exact) < ROUNDING else row[key]
    return row


def craig(alpha: float, a: float, theta: float, d: float) -> np.ndarray:
    """Returns the transformation (4, 4) of modified DH parameters."""
    ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
    X_alpha = np.array([[1, 0, 0, a], [0, ca, -sa, 0], [0, sa, ca, 0], [0, 0, 0, 1]])
    return X_alpha @ np.array([[ct, -st, 0, 0], [st, ct, 0, 0], [0, 0, 1, d], [0, 0, 0, 1]])


def dh_poses(rows: list[dict[str, Any]], q: np.ndarray) -> list[np.ndarray]:
    """Returns the pose (4, 4) of each DH frame in the base frame, at the positions q (n,) [rad, m]."""
    X, poses = np.eye(4), []
    for row, position in zip(rows, q, strict=True):
        prismatic = row["type"] == "prismatic"
        offset = position + row.get("offset", 0.0)
        theta = row["theta"] + (0.0 if prismatic else offset)
        X = X @ craig(row["alpha"], row["A"], theta, row["D"] + (offset if prismatic else 0.0))
        poses.append(X)
    return poses


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


# Compares the instruments of the dVRK with its files: table, coupling, DH frames, and the tool frame.


#: One instrument for each shape of a wrist, and the arm that carries it.
WRISTS = {
    "LARGE_NEEDLE_DRIVER_400006": "psm",
    "PROGRASP_FORCEPS_420093": "psm_si",
    "PERMANENT_CAUTERY_HOOK_420183": "psm_si",
    "STAPLER_45_410298": "psm_si",
    "NEEDLE_DRIVER_400117": "psm",
    "MARYLAND_DISSECTOR_400143": "psm",
}


@pytest.fixture
def tools(shared_data):
    return dvrk_share(shared_data) / "tool"


def test_table_equals_all_files(tools):
    files = [path for path in sorted(tools.glob("*.json")) if path.name != "index.json"]
    assert [path.stem for path in files] == sorted(dvrk_tools())
    for path in files:
        assert read_tool(path) == dvrk_tools()[path.stem], path.name


@pytest.mark.parametrize(("name", "carrier"), WRISTS.items())
def test_frames_limits_and_coupling_equal_the_file(name, carrier, tools):
    arm, content = load_arm(carrier, name), read_json_input(tools / f"{name}.json", ArmError)
    coupling = np.array(content["coupling"]["ActuatorToJointPosition"])
    np.testing.assert_allclose(arm.transmission.inverse.matrix[3:, 3:], coupling, atol=1e-12)
    rows, snake = dh_rows(tools / f"{name}.json"), content.get("snake-like", False)
    upper = np.array([row["qmax"] for row in rows[:3]]) * (1, 2, 2) if snake else [row["qmax"] for row in rows]
    np.testing.assert_allclose(arm.position_upper[3:], [*upper, content["jaw"]["qmax"]], atol=1e-12)
    rows = dh_rows(tools.parent / "kinematic" / f"{'PSM' if carrier == 'psm' else 'PSM_Si'}.json") + rows
    R = np.array(content["tooltip_offset"])
    R[:3, :3] = np.sign(R[:3, :3]) * np.sqrt(np.round(R[:3, :3] ** 2, 4))  # 0.7071 is rounded
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    for q in arm.sample_poses(10, np.random.default_rng(0)):
        set_arm_positions(plant, context, arm, q)
        wrist = [q[4] / 2, q[5] / 2, q[5] / 2, q[4] / 2] if snake else q[4:6]
        poses = dh_poses(rows, np.array([*q[:4], *wrist]))
        for i, X in [*enumerate(poses, 1), ("tool", poses[-1] @ R)]:
            frame = plant.GetFrameByName(i if isinstance(i, str) else f"dh_{i}")
            np.testing.assert_allclose(frame.CalcPoseInWorld(context).GetAsMatrix4(), X, atol=1e-12)


def test_file_of_the_dvrk_gives_the_arm_of_the_table(tools, tmp_path):
    by_file, by_name = (
        load_arm("psm", tools / "PROGRASP_FORCEPS_400093.json"),
        load_arm("psm", "prograsp_forceps_400093"),
    )
    assert by_name.source == "psm+PROGRASP_FORCEPS_400093"
    IdentifiedModel.from_arm(by_file).save(tmp_path / "model.yaml")
    assert IdentifiedModel.load(tmp_path / "model.yaml").arm is by_file
    assert load_arm(by_file.source) is by_file and load_arm(by_name.source) is by_name
    np.testing.assert_allclose(by_file.transmission.matrix, by_name.transmission.matrix, atol=0)
    assert shared_plant(by_file).CalcTotalMass(shared_plant(by_file).CreateDefaultContext()) == pytest.approx(
        shared_plant(by_name).CalcTotalMass(shared_plant(by_name).CreateDefaultContext())
    )


def test_model_stores_its_instrument(tmp_path):
    path = tmp_path / "model.yaml"
    IdentifiedModel.from_arm(load_arm("psm", "CADIERE_FORCEPS_400049")).save(path)
    assert IdentifiedModel.load(path).arm is load_arm("psm", "CADIERE_FORCEPS_400049")
    with pytest.warns(UserWarning, match="instrument CADIERE_FORCEPS_400049, but the arm has large_needle_driver"):
        IdentifiedModel.load(path, load_arm("psm"))
    assert_refused(ModelError, "is for PSM, not for MTML", IdentifiedModel.load, path, load_arm("mtml"))


def test_recording_stores_the_instrument(tmp_path):
    path, arm = tmp_path / "r.csv", load_arm("psm", "CADIERE_FORCEPS_400049")
    q = np.zeros((20, 7))
    write_recording(Recording(q=q, qd=q, tau=q, t=0.01 * np.arange(20)), path, arm)
    assert read_recording(path, arm).arm_name == "PSM+CADIERE_FORCEPS_400049"
    (note,) = set(read_recording(path, load_arm("psm")).notes) - set(read_recording(path, arm).notes)
    assert note == "recorded with the instrument CADIERE_FORCEPS_400049, but the selected arm has large_needle_driver"


@pytest.mark.parametrize(
    ("arm", "instrument", "message"),
    [
        ("ecm", "CADIERE_FORCEPS_400049", "ecm: the arm carries no instrument"),
        ("psm", "CADIERE_FORCEPS_40004", 'unknown instrument "CADIERE_FORCEPS_40004"; did you mean "CADIERE'),
        ("psm", "gone.json", "gone.json"),
        ("my.yaml", "CADIERE_FORCEPS_400049", "my.yaml: state the instrument in the arm file"),
    ],
)
def test_unusable_instruments_are_refused(arm, instrument, message):
    assert_refused(ArmError, message, load_arm, arm, instrument)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("jaw"), r"is not an instrument file of the dVRK \(KeyError\('jaw'\)\)"),
        (lambda c: c["DH"]["joints"][1].update(A=0.1), "the wrist of this instrument is not supported"),
        (lambda c: c["DH"]["joints"][0].update(D=467), r"shaft is 467.*is it in mm\?"),
    ],
)
def test_unusable_files_are_refused(change, message, tools, tmp_path):
    content = read_json_input(tools / "CADIERE_FORCEPS_400049.json", ArmError)
    change(content)
    (tmp_path / "tool.json").write_text(json.dumps(content))
    assert_refused(ArmError, message, load_arm, "psm", tmp_path / "tool.json")
