"""Programs that simulate start again with a faster allocator: once, as the same process, with the same words."""

import subprocess
import sys

import pytest
from patience import PATIENCE

from dvrk_drake import allocation
from dvrk_drake.cli import main

PROGRAM = """
import os, sys
from dvrk_drake.allocation import restart_with_faster_allocator
print("start", flush=True)
restart_with_faster_allocator()
print(os.getpid(), os.environ.get("GLIBC_TUNABLES"), os.environ.get("LD_PRELOAD"), sys.argv[1:], input())
"""
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="other systems' allocators are left alone")


@pytest.fixture(autouse=True)
def nothing_said(monkeypatch):
    for variable in ("LD_PRELOAD", "GLIBC_TUNABLES"):
        monkeypatch.delenv(variable, raising=False)


@LINUX
def test_a_program_starts_again_once(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    command = [sys.executable, str(program), "a b", "--c=d"]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    out, errors = process.communicate("and its input\n", timeout=PATIENCE)
    assert not errors
    expected = allocation.allocator_environment()
    tunables, library = expected.get("GLIBC_TUNABLES"), expected.get("LD_PRELOAD")
    last = f"{process.pid} {tunables} {library} ['a b', '--c=d'] and its input"
    assert out.splitlines() == ["start", "start", last]


@LINUX
@pytest.mark.parametrize("said", ["LD_PRELOAD", "GLIBC_TUNABLES"])
def test_what_somebody_chose_stays(monkeypatch, said):
    assert allocation.allocator_environment()
    monkeypatch.setenv(said, "")
    assert allocation.allocator_environment() == {}


@LINUX
def test_what_came_from_a_pipe_is_not_started_again():
    program = PROGRAM.replace("input()", "0")
    command = [sys.executable, "-"]
    done = subprocess.run(command, check=True, input=program, capture_output=True, text=True, timeout=PATIENCE)
    assert done.stdout.count("start") == 1
    assert not done.stderr


@LINUX
def test_tcmalloc_is_taken_where_it_is_installed(monkeypatch, tmp_path):
    monkeypatch.setattr(allocation, "_library_folders", lambda: [tmp_path])
    assert set(allocation.allocator_environment()) == {"GLIBC_TUNABLES"}
    (tmp_path / allocation.LIBRARY).touch()
    assert allocation.allocator_environment() == {"LD_PRELOAD": allocation.LIBRARY}


@LINUX
@pytest.mark.slow
def test_the_same_scenario_gives_the_same_bytes(tmp_path, capsys):
    here, restarted = tmp_path / "here.csv", tmp_path / "restarted.csv"
    words = ["simulate", "mtml", "--set", "real_arm=[all]", "--set", "duration=0.3", "--output"]
    assert main([*words, str(here)]) == 0
    command = [sys.executable, "-m", "dvrk_drake.cli", *words, str(restarted)]
    subprocess.run(command, check=True, timeout=PATIENCE, capture_output=True)
    assert here.read_bytes() == restarted.read_bytes()
