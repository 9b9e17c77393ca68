"""Order, interruption and continuation of the steps of `calibrate`. Substitutes write the files of the commands."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from command_output import refusal
from models_in_directives import OTHER_ARM

import dvrk_drake as dvrk
from dvrk_drake.analysis.excitation.periodic_motion import FourierBasis, PeriodicMotion
from dvrk_drake.analysis.excitation.pose_file import CollectionFile, load_poses, save_poses
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import ValidationSummary
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.processes import calibration
from dvrk_drake.processes.calibration import CalibrationSettings, calibration_steps
from dvrk_drake.processes.motion_parts import MotionPartFile, Rehearsal

ARM = dvrk.load_arm("psm")


def option(words, name):
    return words[words.index(name) + 1]


def record_part(path, motion, begin, end):
    file = MotionPartFile(path, ARM, motion)
    rows = []
    for k, motion_time in enumerate((begin, end)):
        status = lcmt_dvrk_status()
        status.utime = 1_000_000 + round(1e6 * motion_time)
        status.sequence, status.guard_state = k, status.STATE_EFFORT
        status.position = status.velocity = status.effort_measured = [0.0] * ARM.num_joints
        rows.append((status, motion_time))
    file.append(rows)
    file.close()


def substitute(words, folder):
    """Writes the output files of a command of the calibration."""
    match words[0]:
        case "excite" if "--static" in words:
            poses = ARM.sample_poses(8, np.random.default_rng(int(option(words, "--seed"))), margin=0.1)
            save_poses(poses, ARM, folder / option(words, "--output"))
        case "excite":
            coefficients = np.column_stack([ARM.sample_poses(1, np.random.default_rng(0)).T, np.zeros((7, 2))])
            motion = PeriodicMotion.of_coefficients(ARM, FourierBasis.of(15.0, 2), coefficients, 2)
            replace(motion, center=(np.array(motion.center) + 0.01 * int(option(words, "--seed"))).tolist()).save(
                folder / option(words, "--output")
            )
        case "collect" if "poses" in words:
            output = CollectionFile(folder / option(words, "--output"), ARM, both_sides=True)
            for pose in load_poses(folder / words[2], ARM):
                output.append(pose, pose, 0 * pose, 0 * pose)
            output.close()
        case "collect":
            path = folder / words[2]
            motion = PeriodicMotion.load(path, ARM)
            if "--rehearse" in words:
                Rehearsal(arm=ARM.name, motion=motion.digest(), speed=0.2, tracking_error=[0.0] * 7).save(path)
            else:
                record_part(folder / option(words, "--output"), motion, 0.0, 20.0)
                record_part(folder / option(words, "--output").replace(".csv", "_2.csv"), motion, 18.0, motion.duration)
        case "identify":
            dvrk.IdentifiedModel.from_arm(ARM).save(folder / option(words, "--output"))
        case "validate":
            model = dvrk.IdentifiedModel.load(folder / option(words, "--model"))
            verdicts = dict.fromkeys(ARM.joint_names, "good")
            replace(model, validation=ValidationSummary("other.csv", "0", verdicts)).save(
                folder / option(words, "--model")
            )
            (folder / option(words, "--report")).touch()
        case "export":
            (folder / words[-1]).touch()
    return 0


def command(folder, *options, poses=8):
    """Returns a calibration of a PSM in a folder, without questions."""
    return ["calibrate", "--arm", "psm", "--output", str(folder), "--poses", str(poses), "--yes", *map(str, options)]


def refused(capsys, *words):
    capsys.readouterr()
    assert main(list(words)) == 2
    return refusal(capsys.readouterr().err)


@pytest.fixture
def ran(monkeypatch):
    """Commands that ran. The command with the number `ran.interrupt_at` is interrupted before it has an effect."""

    class Ran(list):
        interrupt_at = -1

    commands = Ran()

    def run(words, folder):
        commands.append(words)
        return 130 if len(commands) - 1 == commands.interrupt_at else substitute(words, folder)

    monkeypatch.setattr(calibration, "_run", run)
    return commands


@pytest.mark.parametrize(
    ("like", "joints", "option"),
    [("mtmr", {}, "--dvrk-gc"), ("psm", {}, "--dvrk-kinematic-gc"), ("psm", {"joint_names": tuple("abcdefg")}, None)],
)
def test_gravity_file_is_chosen_by_the_joints_of_the_arm(tmp_path, like, joints, option):
    """The names of the arms say nothing: the first arm of dVRK owners may be called anything."""
    arm = replace(dvrk.load_arm(like), name="MTM of the left cart" if like == "psm" else "master", **joints)
    steps = calibration_steps(tmp_path, CalibrationSettings(arm=like), arm)
    assert [step.words[3] for step in steps if "gravity.json" in step.words] == ([option] if option else [])


def test_only_incomplete_steps_are_repeated(tmp_path, ran, capsys):
    assert main(command(tmp_path / "c")) == 0
    once, count = list(ran), len(ran)
    assert count == 17
    assert "17/17] Export the gravity compensation" in capsys.readouterr().out
    assert main(command(tmp_path / "c")) == 0 and len(ran) == count  # nothing to do
    assert "[1/17] Choose static poses: done" in capsys.readouterr().out

    interrupted = command(tmp_path / "d")
    ran.clear()
    for step in range(count):
        ran.interrupt_at = 2 * step
        assert main(interrupted) == 130
        assert len(ran) == 2 * step + 1
        ran.interrupt_at = 2 * step + 2
        if step < count - 1:
            assert main(interrupted) == 130
            ran.pop()
    ran.interrupt_at = -1
    assert main(interrupted) == 0
    assert ran[::2] == once and ran[1::2] == once


def test_all_parts_of_a_motion_are_identified(tmp_path, ran):
    assert main(command(tmp_path / "c")) == 0
    dynamic = next(words for words in ran if words[0] == "identify" and "model.yaml" in words)
    assert dynamic[1:4] == ["motion.csv", "motion_2.csv", "poses.csv"]


def test_only_the_next_motion_resets_a_fault(tmp_path, ran):
    assert main(command(tmp_path / "c", "--reset", "--realtime")) == 0
    moving = [words for words in ran if words[0] == "collect"]
    assert ["--reset" in words for words in moving] == [True] + 5 * [False]
    assert all("--realtime" in words for words in moving)


def test_designs_avoid_the_objects_around_the_arm(tmp_path, ran, capsys):
    lab = tmp_path / "lab.dmd.yaml"
    lab.write_text(OTHER_ARM.format(x=0.6))
    around = ["--table", "-0.2", "--environment"]
    calibrate = command(tmp_path / "c", *around, lab)
    assert main(calibrate) == 0
    designs = [words for words in ran if words[0] == "excite"]
    assert len(designs) == 4
    for words in designs:
        begin = words.index("--table")
        assert words[begin : begin + 4] == [*around, "environment.dmd.yaml"]
    assert (tmp_path / "c" / "environment.dmd.yaml").read_text() == lab.read_text()
    assert main(calibrate) == 0
    lab.write_text(OTHER_ARM.format(x=0.7))
    assert "began with another --environment" in refused(capsys, *calibrate)
    assert "table is -0.2, but None was given" in refused(
        capsys, *command(tmp_path / "c", "--environment", tmp_path / "c" / "environment.dmd.yaml")
    )
    lab.write_text(OTHER_ARM.format(x=0.6))
    (tmp_path / "c" / "environment.dmd.yaml").write_text(OTHER_ARM.format(x=0.7))
    assert "environment.dmd.yaml: the file was changed" in refused(capsys, *calibrate)


def test_without_terminal_an_arm_moves_only_with_yes(tmp_path, ran, capsys):
    line = refused(capsys, "calibrate", "--arm", "psm", "--output", str(tmp_path / "c"), "--poses", "8")
    assert "no terminal; add --yes" in line and not ran and not (tmp_path / "c").exists()


def test_failed_step_ends_the_calibration(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(calibration, "_run", lambda words, folder: 2)
    line = refused(capsys, *command(tmp_path / "c"))
    assert "Choose static poses failed" in line and "The same command repeats this step" in line


def test_only_a_second_command_accepts_a_model_that_failed(tmp_path, monkeypatch, capsys):
    """The arm would follow motions with it, so the line says what the same command does."""

    def run(words, folder):
        return substitute(words, folder) or 2 * ("validate" in words and "usable" in words)

    monkeypatch.setattr(calibration, "_run", run)
    line = refused(capsys, *command(tmp_path / "c"))
    assert "The same command accepts this result and continues" in line
    assert not (tmp_path / "c" / "motion.yaml").exists()
    assert "accepts this result" in refused(capsys, *command(tmp_path / "c"))  # the full dynamics failed
    assert (tmp_path / "c" / "test_motion.csv").exists() and not (tmp_path / "c" / "gravity.json").exists()
    assert main(command(tmp_path / "c")) == 0


@pytest.mark.parametrize(
    ("poses", "options", "message"),
    [
        (3, [], "poses is 3; allowed: 8..300"),
        (8, ["--duration", "5"], "duration is 5"),
        (8, ["--gravity", "0", "0", "99"], "gravity"),
        (8, ["--table", "nan"], "table"),
    ],
)
def test_invalid_settings_give_one_line(tmp_path, capsys, poses, options, message):
    assert message in refused(capsys, *command(tmp_path / "c", *options, poses=poses))
    assert not (tmp_path / "c").exists()


def test_folder_of_another_calibration_is_refused(tmp_path, ran, capsys):
    assert main(command(tmp_path / "c")) == 0
    assert "poses is 8, but 9 was given" in refused(capsys, *command(tmp_path / "c", poses=9))
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "thesis.tex").touch()
    line = refused(capsys, *command(tmp_path / "d"))
    assert "the folder is not empty and has no calibration" in line
    assert os.listdir(tmp_path / "d") == ["thesis.tex"]


def test_signal_ends_the_running_command(tmp_path):
    """The command ends first, and then the calibration. A killed calibration ends its command."""
    script = (
        "import sys; from pathlib import Path; from dvrk_drake.processes import calibration;"
        "sys.executable = sys.argv[1];"
        "print(calibration._run([sys.argv[2]], Path('.')), flush=True)"
    )
    child = tmp_path / "child"
    child.write_text(
        f"#!{sys.executable}\nimport signal, sys, time\n"
        "def end(number, _):\n    open('ended', 'w').close(); sys.exit(130)\n"
        "signal.signal(signal.SIGINT, end); signal.signal(signal.SIGTERM, end)\n"
        "open('started', 'w').close()\ntime.sleep(60)\n"
    )
    child.chmod(0o755)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        folder = tmp_path / str(int(number))
        folder.mkdir()
        process = subprocess.Popen([sys.executable, "-c", script, str(child), "x"], cwd=folder, stdout=subprocess.PIPE)
        wait_for(folder / "started")
        process.send_signal(number)
        output, _ = process.communicate(timeout=60)
        wait_for(folder / "ended")
        assert output == (b"" if number == signal.SIGKILL else b"130\n")


def wait_for(path, seconds=60.0):
    end = time.monotonic() + seconds
    while not path.exists():
        assert time.monotonic() < end, path
        time.sleep(0.02)
