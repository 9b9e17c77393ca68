"""Processes of the package in a network namespace, forked from a process that has imported the package."""

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import lcm_controller
from own_network import join_network
from waiting import TIMEOUT

from dvrk_drake import cli
from dvrk_drake.processes import recorder

POSES = {"mtml": [0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5], "psm": [0.2, -0.3, 0.1, 0.5, 0.2, -0.3, 0.3]}

#: Driver configurations at 500 Hz: with default timeouts, and with long ones, suitable for a busy computer.
HALF_RATE_DRIVER = Path(__file__).with_name("half_rate_driver.yaml")
LONG_TIMEOUT_DRIVER = Path(__file__).with_name("long_timeout_driver.yaml")
#: Time for which `impatient_dvrk_drake record` waits for the first status [s], instead of 10 s.
PATIENCE = 2

# The fork server imports the modules from this path.
os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]).rstrip(":")
FORKSERVER = multiprocessing.get_context("forkserver")
FORKSERVER.set_forkserver_preload(["lcm_preloaded"])


class Forked:
    """Forked process of a program of the package, with its output in a file."""

    def __init__(self, main, *arguments):
        descriptor, self.path = tempfile.mkstemp()
        os.close(descriptor)
        details = (main, arguments, self.path, os.getpid(), dict(os.environ))
        self.process = FORKSERVER.Process(target=run_program, args=details, daemon=True)
        self.process.start()

    @property
    def pid(self):
        return self.process.pid

    def send_signal(self, number):
        os.kill(self.pid, number)

    def wait(self):
        """Returns the exit code."""
        self.process.join(TIMEOUT)
        assert self.poll() is not None, f"does not end: {self.output()}"
        return self.poll()

    def poll(self):
        """Returns the exit code, or None while the process is running."""
        return self.process.exitcode

    def output(self):
        return Path(self.path).read_text()

    def end(self, number=signal.SIGKILL):
        """Ends the process and returns its output."""
        if self.poll() is None:
            self.send_signal(number)
        self.wait()
        return self.output()


class CommandLine(Forked):
    """Process of `dvrk-drake`, started on the command line."""

    def __init__(self, *arguments):
        descriptor, self.path = tempfile.mkstemp()
        command = [sys.executable, "-m", "dvrk_drake.cli", *map(str, arguments)]
        self.process = subprocess.Popen(command, stdout=descriptor, stderr=descriptor)
        os.close(descriptor)

    def wait(self):
        return self.process.wait(TIMEOUT)

    def poll(self):
        return self.process.poll()

    def send_signal(self, number):
        self.process.send_signal(number)


def run_program(main, arguments, path, parent, environment):
    """Runs a program with the network and the environment of the process of the test."""
    join_network(parent)
    os.environ.update(environment)
    with open(path, "w") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    sys.exit(main(list(arguments)))


def dvrk_drake(*arguments):
    """Starts a command of the command line with its options."""
    return Forked(cli.main, *map(str, arguments))


def impatient_dvrk_drake(*arguments):
    """Starts a command whose recorder waits only `PATIENCE` for the first status."""
    return Forked(impatient_main, *map(str, arguments))


def impatient_main(arguments):
    """Runs a command. The process was forked, so the change of the module remains in it."""
    recorder.FIRST_STATUS = PATIENCE
    return cli.main(arguments)


def start_arm(name, *options):
    """Starts an arm at its pose of `POSES`. The default driver is `HALF_RATE_DRIVER`."""
    if "--driver" not in options:
        options += "--driver", HALF_RATE_DRIVER
    return dvrk_drake("sim-arm", "--arm", name, "--realtime", *options, "--pose", *POSES[name])


def start_run(name, *options):
    return dvrk_drake("control", "--arm", name, *options)


def start_controller(name, *options):
    return Forked(lcm_controller.main, name, *options)
