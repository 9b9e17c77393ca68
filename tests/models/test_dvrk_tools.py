"""Compares the instruments of the dVRK with its files: table, coupling, DH frames, and the tool frame."""

import json

import numpy as np
import pytest
from dvrk_share import dh_poses, dh_rows, dvrk_share

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ArmError, ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.dvrk_tool import dvrk_tools, read_tool
from dvrk_drake.models.files import read_json_input
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions, shared_plant
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.recordings.writing import write_recording

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
    with pytest.raises(ModelError, match="is for PSM, not for MTML"):
        IdentifiedModel.load(path, load_arm("mtml"))


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
    with pytest.raises(ArmError, match=message):
        load_arm(arm, instrument)


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
    with pytest.raises(ArmError, match=message):
        load_arm("psm", tmp_path / "tool.json")
