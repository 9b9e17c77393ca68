"""The scripts in examples/ run, and write only to given paths."""

import os
import pty
import re
import shutil
import subprocess
import sys
import urllib.request

import pytest
from repository import ROOT

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.recordings.formats import SAMPLES_FOLDER

pytestmark = pytest.mark.drake_api

EXAMPLES = ROOT / "examples"
#: Scripts that need neither arguments nor another process.
SCRIPTS = [
    "01_load_and_view.py",
    "02_gravity_of_any_robot.py",
    "05_hold.py",
    "06_guide.py",
    "11_inverse_kinematics.py",
    "08_own_controller.py",
    "10_teleoperation.py",
    "arms_and_table.py",
]


def run(folder, *command):
    return subprocess.run(
        [sys.executable, EXAMPLES / command[0], *command[1:]],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )


def test_all_scripts_are_tested():
    assert {path.name for path in EXAMPLES.glob("*.py")} == {
        *SCRIPTS,
        "03_identify.py",
        "04_validate_on_another_day.py",
        "07_force_at_the_tip.py",  # the docstring example of `estimate_force` has the same steps
        "09_hardware_station.py",  # tests/udp/test_crtk_station_udp.py
    }


@pytest.mark.parametrize("script", sorted(path.name for path in EXAMPLES.glob("*.py")))
def test_scripts_import_only_the_public_api(script):
    lines = (EXAMPLES / script).read_text().splitlines()
    assert [line for line in lines if "import" in line and "dvrk_drake" in line] == ["import dvrk_drake as dvrk"]


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_scripts_write_no_files_and_print_no_dead_links(script, tmp_path):
    done = run(tmp_path, script)
    assert done.returncode == 0, done.stderr
    assert done.stdout and "http" not in done.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_page_is_served_until_enter_on_a_terminal(tmp_path):
    controller, terminal = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, EXAMPLES / "05_hold.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,  # Python writes the prompt of input() to stderr
    )
    os.close(terminal)
    printed = b""
    while b"Press Enter" not in printed:
        printed += os.read(controller, 1000)
    address = re.search(rb"http://\S+", printed).group().decode()
    with urllib.request.urlopen(address) as page:
        assert page.status == 200
    assert process.poll() is None
    os.write(controller, b"\n")
    assert process.wait() == 0
    os.close(controller)


@pytest.mark.slow
def test_model_is_written_to_the_given_path(tmp_path):
    poses = tmp_path / "poses.csv"
    shutil.copyfile(SAMPLES_FOLDER / "mtm_poses.csv", poses)
    assert run(tmp_path, "03_identify.py", "poses.csv", "mtmr").returncode == 0
    assert list(tmp_path.iterdir()) == [poses]
    assert run(tmp_path, "03_identify.py", "poses.csv", "mtmr", "own.yaml").returncode == 0
    before = (tmp_path / "own.yaml").read_bytes()
    assert IdentifiedModel.load(tmp_path / "own.yaml").arm.name == "MTMR"
    again = run(tmp_path, "03_identify.py", "poses.csv", "mtmr", "own.yaml")
    assert again.returncode == 1 and "already exists" in again.stderr
    assert (tmp_path / "own.yaml").read_bytes() == before
    validated = run(tmp_path, "04_validate_on_another_day.py", "own.yaml", SAMPLES_FOLDER / "mtm_other_poses.csv")
    assert validated.returncode == 0 and "good" in validated.stdout
