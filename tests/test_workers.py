"""Worker processes of computations that are started by a script without `if __name__ == "__main__":`."""

import os
import signal
import subprocess
import sys
import textwrap

import pytest
from waiting import TIMEOUT

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.workers import local_executor

#: Environment variables that workers read at their start.
VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LD_PRELOAD", "GLIBC_TUNABLES")


def run_script(folder, text):
    """Runs a script as a process of its own."""
    path = folder / "script.py"
    path.write_text(textwrap.dedent(text))
    return subprocess.run(
        [sys.executable, path], check=False, capture_output=True, text=True, timeout=TIMEOUT, cwd=folder
    )


def test_plain_script_uses_workers_and_runs_once(tmp_path):
    done = run_script(
        tmp_path,
        """
        from dvrk_drake.workers import local_executor
        print("once")
        with local_executor(2) as executor:
            print(list(executor.map(abs, [-1, -2, -3])))
        """,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "once\n[1, 2, 3]\n", "")


@pytest.mark.parametrize("task", ["executor.submit(own)", "executor.submit(abs, Own())"])
def test_function_or_class_of_the_script_is_refused(tmp_path, task):
    done = run_script(
        tmp_path,
        f"""
        from dvrk_drake.workers import local_executor
        from dvrk_drake.errors import DvrkDrakeError
        def own():
            pass
        class Own:
            pass
        try:
            with local_executor(1) as executor:
                {task}
        except DvrkDrakeError as error:
            print(error)
        """,
    )
    text = (
        ": the function or an argument is defined in the main script, which worker processes do not import. Define it "
        "in a module\n"
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, ("own" if "own" in task else "abs") + text, "")


def test_environment_is_that_of_the_user(monkeypatch):
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    before = dict(os.environ)
    with local_executor(1) as executor:
        workers = list(executor.map(os.getenv, VARIABLES))
        assert dict(os.environ) == before
    assert dict(os.environ) == before
    assert workers[:2] == ["1", "3"]
    assert sys.platform != "linux" or any(workers[2:])


def test_killed_worker_is_an_error():
    with pytest.raises(DvrkDrakeError, match=r"^a worker process ended unexpectedly, .* and try again$"):  # noqa: SIM117
        with local_executor(1) as executor:
            pid = executor.submit(os.getpid).result()
            os.kill(pid, signal.SIGKILL)
            executor.submit(signal.pause).result()
