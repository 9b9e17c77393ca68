"""Tests of the command output, and of exit code 2 with one error line for invalid input."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from command_output import messages, refusal, refused
from forked import forked_program
from recordings import csv_block

from dvrk_drake.analysis.excitation.pose_file import save_poses
from dvrk_drake.cli import main
from dvrk_drake.dynamics.holding_torque import static_model
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes import arm_session, simulated_arm
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import Recording


@pytest.fixture(scope="module")
def folder(tmp_path_factory, identified_poses):
    """Returns a folder with two recordings of static poses and the model identified from the first."""
    folder = tmp_path_factory.mktemp("cli")
    write_recording(identified_poses.recording, folder / "poses.csv")
    write_recording(identified_poses.other, folder / "other.csv")
    identified_poses.result.save(folder / "model.yaml")
    return folder


def test_identify_writes_files_and_prints_parameters(folder, identified_poses, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "160")  # names on one line
    path, plots = tmp_path / "model.yaml", tmp_path / "plots"
    command = ["identify", f"{folder}/poses.csv", "--arm", "mtmr", "--output", str(path)]
    assert main([*command, "--plots", str(plots), "-v"]) == 0
    printed = capsys.readouterr()
    assert f"wrote {path}\n" in printed.out
    assert messages(printed.err) == []
    model, text = IdentifiedModel.load(path), "".join(printed.out.split())
    for parameter in model.base_parameters:
        assert "".join(parameter.name.split()) in text
    q = identified_poses.other.q
    error = (model.holding_torque(q) - identified_poses.nominal.holding_torque(q)) / identified_poses.arm.effort_limits
    assert np.sqrt(np.mean(error[:, 1:6] ** 2, axis=0)).max() < 0.005
    # The function gives the same model.
    np.testing.assert_allclose(model.theta, identified_poses.result.model.theta, rtol=1e-6, atol=1e-9)
    assert {p.name for p in plots.iterdir()} == {"efforts.png", "residuals.png", "error_budget.png"}


def test_validate_writes_json(folder, capsys):
    json_file = folder / "v.json"
    assert main(["validate", f"{folder}/other.csv", "--model", f"{folder}/model.yaml", "--json", str(json_file)]) == 0
    result = json.loads(json_file.read_text())
    assert result["poses"] == 12
    assert [j["name"] for j in result["joints"]] == list(load_arm("mtmr").joint_names)
    recording = read_recording(folder / "other.csv")
    model = IdentifiedModel.load(folder / "model.yaml")
    residual = recording.tau - model.holding_torque(recording.q)
    for j, joint in enumerate(result["joints"]):
        assert joint["rms_error"] == pytest.approx(np.sqrt(np.mean(residual[:, j] ** 2)))
        assert joint["rms_torque"] == pytest.approx(np.sqrt(np.mean(recording.tau[:, j] ** 2)))
        assert joint["relative_error"] == pytest.approx(joint["rms_error"] / joint["rms_torque"])
    table = capsys.readouterr().out
    assert "[N m; N]" in table
    assert "…" not in table


@pytest.mark.parametrize("coordinates", ["joint", "actuator"])
def test_predict_uses_the_coordinates_of_the_recording(folder, tmp_path, coordinates):
    arm = load_arm("mtmr")
    q = read_recording(folder / "other.csv").q
    recorded = q if coordinates == "joint" else arm.transmission.position(q)
    write_recording(Recording(q=recorded, coordinates=coordinates), tmp_path / "only_q.csv")
    out = tmp_path / "predicted.csv"
    command = ["predict", f"{tmp_path}/only_q.csv", "--model", f"{folder}/model.yaml", "--output", str(out)]
    assert main(command) == 0
    rows = csv_block(out, "tau")
    names = [f"tau{i} [N m]" for i in range(1, 8)]
    assert out.read_text().splitlines()[0].split(",") == [*names, "coordinates", "arm"]
    assert out.read_text().splitlines()[1].endswith(f",{coordinates},MTMR")
    expected = IdentifiedModel.load(folder / "model.yaml").holding_torque(q)
    tau = rows if coordinates == "joint" else rows @ arm.transmission.matrix
    np.testing.assert_allclose(tau, expected, atol=1e-12)


def test_predict_of_a_psm_in_wpi_coordinates_writes_them(tmp_path):
    """In these coordinates, the roll is that of the joint. The power is the same in all coordinates."""
    arm = load_arm("psm")
    path, model, out = tmp_path / "poses.csv", tmp_path / "model.yaml", tmp_path / "tau.csv"
    joints = Recording(q=arm.sample_poses(20, np.random.default_rng(0)))
    actuators, roll = joints.in_actuator_coordinates(arm).q, arm.joint_names.index("roll")
    wpi = actuators.copy()
    wpi[:, roll] = joints.q[:, roll]
    write_recording(Recording(q=wpi), path)
    text = path.read_text().replace("joint", "wpi")
    path.write_text(text)
    IdentifiedModel.from_arm(arm).save(model)
    assert main(["predict", str(path), "--model", str(model), "--output", str(out)]) == 0
    tau, expected = csv_block(out, "tau"), IdentifiedModel.load(model).holding_torque(joints.q)
    assert np.abs(expected).max() > 0.1
    velocity = np.random.default_rng(1).normal(size=7)
    velocity_wpi = arm.transmission.velocity(velocity)
    velocity_wpi[roll] = velocity[roll]
    np.testing.assert_allclose(tau @ velocity_wpi, expected @ velocity, atol=1e-9)
    assert out.read_text().splitlines()[1].endswith(",wpi,PSM")


def test_exported_python_and_c_match_the_plant(tmp_path, capsys):
    arm = load_arm("mtml")
    model = static_model(arm)
    q = np.random.default_rng(0).uniform(-2, 2, (5, 7))
    expected = model.torque(q, model.gravity.base_values)

    assert main(["equations", "--arm", "mtml", "--format", "python"]) == 0
    namespace: dict = {}
    exec(capsys.readouterr().out, namespace)
    beta = [value for value, _ in namespace["BASE_PARAMETERS"]]
    out, Y = np.empty(7), np.empty((7, 12))
    for pose, tau in zip(q, expected, strict=True):
        namespace["gravity_torque"](pose, 9.81, beta, out)
        namespace["gravity_regressor"](pose, 9.81, Y)
        np.testing.assert_allclose(out, tau, atol=1e-12)
        np.testing.assert_allclose(Y @ beta, tau, atol=1e-12)

    assert main(["equations", "--arm", "mtml", "--format", "c", "--output", str(tmp_path / "g.c")]) == 0
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler here: the exported C was not compiled")
    library = tmp_path / "g.so"
    subprocess.run(
        [compiler, "-Wall", "-Werror", "-shared", "-fPIC", "-o", library, tmp_path / "g.c", "-lm"], check=True
    )
    import ctypes

    function = ctypes.CDLL(str(library)).mtml_gravity_torque
    array = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    function.argtypes = [array, ctypes.c_double, array, array]
    for pose, tau in zip(q, expected, strict=True):
        function(np.ascontiguousarray(pose), 9.81, np.array(beta), out)
        np.testing.assert_allclose(out, tau, atol=1e-12)


def test_latex_contains_all_parameters_and_torques(capsys):
    assert main(["equations", "--arm", "mtml", "--format", "latex"]) == 0
    text = capsys.readouterr().out
    for i in range(1, 13):
        assert rf"\beta_{{{i}}} &=" in text
    for j in range(1, 8):
        assert rf"\tau_{{{j}}} &=" in text
    assert r"P &= g \left(" in text
    assert r"X_{0,7} &=" in text
    assert r"L_{4} ( m_{4} + \dots + m_{7} ) + m_{3} c_{3z} + m_{4} c_{4y} + m_{crank} c_{crank\,y}" in text
    assert text.count(r"\begin{align*}") == text.count(r"\end{align*}") == 5
    assert text.count(r"\left(") == text.count(r"\right)")


def test_gravity_option_changes_the_base_parameters(capsys):
    assert main(["equations", "--arm", "mtml", "--gravity", "0", "9.81", "0"]) == 0
    assert "m1 c1x" in capsys.readouterr().out
    for language in ("c", "python", "latex"):
        assert main(["equations", "--arm", "mtml", "--format", language, "--gravity", "0", "9.81", "0"]) == 0
        first = capsys.readouterr().out.splitlines()[0]
        assert "gravity (0, 9.81, 0) m/s^2" in first


def test_input_files_are_never_replaced(folder, capsys):
    poses, model = folder / "poses.csv", folder / "model.yaml"
    before = poses.read_bytes(), model.read_bytes()
    assert "is an input" in refused(capsys, "identify", poses, "--arm", "mtmr", "--output", poses)
    assert "is an input" in refused(capsys, "predict", poses, "--model", model, "--output", poses)
    assert "is an input" in refused(capsys, "validate", poses, "--model", model, "--json", model)
    assert "not a regular file" in refused(capsys, "predict", poses, "--model", model, "--output", folder)
    assert "--output requires --format" in refused(capsys, "equations", "--arm", "mtml", "--output", folder / "x.txt")
    assert (poses.read_bytes(), model.read_bytes()) == before


#: Commands that write a file, without its path. The inputs need not exist, because the output is checked first.
WRITE_A_FILE = [
    "identify none.csv --arm mtml --output",
    "validate none.csv --model none.yaml --json",
    "predict none.csv --model none.yaml --output",
    "convert none.csv --output",
    "identify recalibrate none.csv --model none.yaml --output",
    "check none.csv --arm mtml --json",
    "payload none.csv none.csv --arm psm --json",
    "export compare none.json --arm mtml --json",
    "export --arm mtml --sdf",
    "export --arm mtml --urdf",
    "export --arm mtml --dvrk-gc",
    "export --arm psm --dvrk-kinematic-gc",
    "equations --arm mtml --format c --output",
    "simulate --arm mtml --output",
    "simulate tune --arm mtml --output",
    "simulate transparency --arm mtml --output",
    "simulate teleop --output",
    "keygen --output",
    "record --arm mtml --lcm-url memq://",
]
#: Commands that never replace a file.
KEEP_ALWAYS = ("keygen", "record")


@pytest.mark.parametrize("command", WRITE_A_FILE)
def test_existing_file_is_kept_without_overwrite(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mine = tmp_path / "mine.csv"
    mine.write_text("mine")
    error = refused(capsys, *command.split(), "mine.csv")
    assert error.startswith("dvrk-drake: error: mine.csv") and "exists" in error
    if not command.startswith(KEEP_ALWAYS):
        assert error.endswith("already exists. Choose another file, or replace it with --overwrite.")
    if "none" in command:
        assert "none" in refused(capsys, *command.split(), "mine.csv", "--overwrite")
    assert mine.read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


#: Commands that write a folder, without its path.
WRITE_A_FOLDER = [
    "identify none.csv --arm mtml --output new.yaml --plots",
    "check none.csv --arm mtml --plots",
    "export compare none.json --arm mtml --plots",
    "simulate --arm mtml --plots",
    "simulate tune --arm mtml --plots",
    "simulate transparency --arm mtml --plots",
    "demo --folder",
    "reproduce fig7 --folder",
    "samples",
]


@pytest.mark.parametrize("command", WRITE_A_FOLDER)
def test_folder_with_files_is_kept_without_overwrite(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("mine")
    error = refused(capsys, *command.split(), "full")
    assert error.endswith("full: folder is not empty; choose another folder, or write into it with --overwrite")
    if "none" in command:
        assert "none" in refused(capsys, *command.split(), "full", "--overwrite")
    assert [path.name for path in tmp_path.rglob("*")] == ["full", "mine.txt"]


@pytest.mark.parametrize(
    ("command", "written"),
    [
        ("check {0}/poses.csv --arm mtmr --json o.json", ["o.json"]),
        ("convert {0}/poses.csv --output o.csv", ["o.csv"]),
        ("predict {0}/poses.csv --model {0}/model.yaml --output o.csv", ["o.csv"]),
        ("validate {0}/other.csv --model {0}/model.yaml --json o.json --plots p", ["o.json", "p"]),
        ("export --model {0}/model.yaml --sdf o.sdf --urdf o.urdf", ["o.sdf", "o.urdf", "o_meshes"]),
        ("simulate --arm mtmr --set duration=0.02 --output o.csv --plots p", ["o.csv", "p"]),
        ("keygen --output o.key", ["o.key"]),
    ],
)
def test_commands_print_the_written_paths(command, written, folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(command.format(folder).split()) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("wrote ")]
    assert sorted({line.split()[1].rstrip(":") for line in lines}) == written
    assert {path.name for path in tmp_path.iterdir()} >= set(written)


def test_model_of_another_arm_is_named(folder, tmp_path, capsys):
    (tmp_path / "two_joints.csv").write_text("q1,q2,tau1,tau2\n0,0,0,0\n")
    message = refused(capsys, "validate", tmp_path / "two_joints.csv", "--model", folder / "model.yaml")
    assert "missing columns q3" in message and f"{folder}/model.yaml is a model of MTM" in message


INTERRUPTED_IMPORT = """
import os, signal, sys

class Interruption:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[0]:
            os.kill(os.getpid(), signal.SIGINT)

from dvrk_drake.cli import main
sys.argv = {words!r}
sys.meta_path.insert(0, Interruption())
sys.exit(main())
"""


@pytest.mark.parametrize("module", ["dvrk_drake.cli.program", "pydrake"])
def test_interrupt_at_any_import_gives_one_line(module):
    words = ["check", "none.csv", "--arm", "mtml", "--plots", "never"]
    code = INTERRUPTED_IMPORT.format(words=[module, *words])
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert process.stderr == "dvrk-drake: interrupted\n"
    assert process.returncode == 130


@pytest.mark.parametrize("command", ["sim-arm", "control", "collect", "teach"])
def test_interrupt_is_not_lost_in_extension_modules(command, tmp_path, monkeypatch):
    poses, out = str(tmp_path / "poses.yaml"), str(tmp_path / "out.csv")
    words = [command]
    if command in ("collect", "teach"):
        arm = load_arm("mtml")
        save_poses(arm.sample_poses(1, np.random.default_rng(0)), arm, poses)
        words = ["collect", *(["poses", poses, "--output", out] if command == "collect" else ["teach", poses])]

    def calls_extension_module(*arguments, **options):
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            signal.sigtimedwait([], 0)  # lets Python call the handler
        sys.exit("the interrupt was lost")

    monkeypatch.setattr(arm_session, "first_status", lambda link: (lcmt_dvrk_status(), 1e-3))
    monkeypatch.setattr(arm_session, "ArmController", calls_extension_module)
    monkeypatch.setattr(simulated_arm, "SimulatedArm", calls_extension_module)
    monkeypatch.setattr(sys, "argv", ["dvrk-drake", *words, "--arm", "mtml", "--lcm-url", "memq://"])
    code, printed = forked_program(main)
    assert printed.splitlines()[-1] == "dvrk-drake: interrupted"
    assert code == 130


def test_rejects_the_same_path_for_two_outputs(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    export = ["export", "--model", f"{folder}/model.yaml", "--sdf", "o.sdf", "--urdf"]
    identify = ["identify", f"{folder}/poses.csv", "--arm", "mtmr", "--output", "o", "--plots", "o"]
    for command in ([*export, "./o.sdf"], identify):
        assert "is given for two outputs" in refused(capsys, *command)
    assert not list(tmp_path.iterdir())


def test_meshes_are_not_replaced_by_default(folder, tmp_path, capsys):
    (tmp_path / "o_meshes").mkdir()
    (tmp_path / "o_meshes/mine.txt").write_text("mine")
    export = ["export", "--model", f"{folder}/model.yaml", "--sdf", f"{tmp_path}/o.sdf"]
    assert "o_meshes: the folder contains files already" in refused(capsys, *export)
    assert not (tmp_path / "o.sdf").exists()
    assert main([*export, "--overwrite"]) == 0
    assert (tmp_path / "o_meshes/mine.txt").read_text() == "mine"


def test_model_is_saved_before_a_closed_pipe(folder, tmp_path):
    read, write = os.pipe()
    os.close(read)
    command = ["identify", f"{folder}/poses.csv", "--arm", "mtmr", "--output", f"{tmp_path}/m.yaml"]

    def program():
        os.dup2(write, 1)
        sys.stdout = os.fdopen(1, "w")
        return main(command)

    code, errors = forked_program(program)
    os.close(write)
    assert code == 128 + signal.SIGPIPE and "Traceback" not in errors
    assert IdentifiedModel.load(tmp_path / "m.yaml").arm.name == "MTMR"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full here")
def test_full_disk_gives_one_line():
    command = [sys.executable, "-m", "dvrk_drake.cli", "equations", "--arm", "mtml"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert "No space left on device" in refusal(done.stderr)
