"""Starts the dVRK console, the dVRK's own controller in kinematic simulation, as a peer for tests and benchmarks.

    with start_console("MTML", tmp_path) as console:
        console.enable_and_home()
        console.command("servo_jp", JointState(position=[0.1] * 7))
        console.wait_for_position([0.1] * 7)

The peer is not part of the repository. Tests skip where it, its shared libraries, or cyclonedds are absent. Use it in a
network namespace, see `own_network`, or at least with Cyclone DDS on the loopback interface.
"""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from ros_publisher import DOMAIN_FILE
from waiting import TIMEOUT, wait_until

APT = "apt-get install -y libjsoncpp25 libpython3.11 libopengl0"
SUPPORT = Path(__file__).resolve().parent
#: Time after the start of the console before it can home an arm [s]. If `home` arrives in the first second, the state
#: remains HOMING, because the console has not yet measured the period of its control loop.
START = 2.0
#: Ended consoles. Cyclone DDS may crash if a subscription is deleted while its listener is called, so none is deleted.
_ENDED = []


def find_peer():
    """Returns the folder of the peer, `shared/peers/dvrk_console`. Skips the test if the peer cannot run.

    The default of `shared` is `<repository>/../shared`. The environment variable DVRK_DRAKE_SHARED replaces it.
    """
    pytest.importorskip("cyclonedds", reason="needs cyclonedds")
    shared = Path(os.environ.get("DVRK_DRAKE_SHARED", SUPPORT.parents[2] / "shared"))
    peer = shared / "peers/dvrk_console"
    if not (peer / "bin/dvrk_console").is_file():
        pytest.skip(f"needs the dVRK console in {peer} (DVRK_DRAKE_SHARED names the folder above)")
    environment = os.environ | {"LD_LIBRARY_PATH": str(peer / "lib")}
    libraries = subprocess.run(
        ["ldd", peer / "bin/dvrk_console"], env=environment, capture_output=True, text=True, check=False
    )
    missing = re.findall(r"(\S+) => not found", libraries.stdout)
    if missing or libraries.returncode:
        pytest.skip(f"the dVRK console needs {', '.join(missing) or 'Linux on x86-64'}: {APT}")
    return peer


class Console:
    """Running dVRK console, with a participant that sends commands and receives its topics.

    Attributes:
        arm: Name of the arm, e.g. "MTML".
        process: Process that connects the console with DDS.
        pid: Process ID of the console, a child of `process`.
        domain: Participant of this process in the ROS domain.
        states: Operating states so far, each (state, is_homed, is_busy).
    """

    def __init__(self, arm, process, pid, events, domain):
        from dvrk_drake.systems.ros import messages as m

        self.arm, self.process, self.pid, self.domain, self.states = arm, process, pid, domain, []
        self._events, self._m, self._publishers, self._subscriptions = events, m, {}, {}
        self._state = domain.subscribe(f"/{arm}/operating_state", m.OperatingState, depth=100, latched=True)

    def events(self):
        """Returns the lines of the console so far, e.g. "event: MTML: control JOINT_SPACE/EFFORT_MODE"."""
        return self._events.read_text(errors="replace").splitlines()

    def modes(self):
        """Returns the control modes so far, e.g. ["JOINT_SPACE/POSITION_MODE"]. A mode is listed on each change."""
        found = (re.fullmatch(r"event: \w+: control (\w+/\w+)", line) for line in self.events())
        return [match[1] for match in found if match]

    def state(self):
        """Returns the last operating state (state, is_homed, is_busy), or None before the first one."""
        self.states += [(s.state, s.is_homed, s.is_busy) for s, _ in self._state.take()]
        return self.states[-1] if self.states else None

    def state_command(self, word):
        """Sends a state command, e.g. "enable"."""
        self.command("state_command", self._m.StringStamped(self._m.Header.now(), word))

    def enable_and_home(self):
        """Enables and homes the arm, and waits until it is homed."""
        self.state_command("enable")
        wait_until(lambda: self.state() == ("ENABLED", False, False), "enabled", self.process)
        self.state_command("home")
        wait_until(lambda: self.state() == ("ENABLED", True, False), "homed", self.process)
        if self._events == Path(os.devnull):  # a simulated arm
            return
        wait_until(lambda: "current state HOMED" in " ".join(self.events()), "homed", self.process)
        if self.arm.startswith("PSM"):
            # `run.py` has no instrument: the console asks for its type.
            ends = r"current state TOOL_ENGAGED.*current state HOMED|tool type requested from user"
            wait_until(lambda: re.search(ends, " ".join(self.events())), "instrument", self.process)

    def advertise(self, name, message_type):
        """Creates the publisher of a command topic, and waits until the console is subscribed to it."""
        if name not in self._publishers:
            publisher = self.domain.advertise(f"/{self.arm}/{name}", message_type)
            wait_until(publisher.num_subscribers, f"a subscription of {name}", self.process)
            self._publishers[name] = publisher

    def command(self, name, message):
        """Publishes one message on a command topic, e.g. "servo_jp", as soon as the console is subscribed to it."""
        self.advertise(name, type(message))
        self._publishers[name].publish(message)

    def latest(self, name="measured_js", message_type=None):
        """Returns a message of a topic that is published after this call. The default type is JointState."""
        if name not in self._subscriptions:
            topic = f"/{self.arm}/{name}"
            self._subscriptions[name] = self.domain.subscribe(topic, message_type or self._m.JointState)
        subscription, start, found = self._subscriptions[name], time.time_ns(), []
        wait_until(
            lambda: found.extend(s for s, sent in subscription.take() if sent > start) or found, name, self.process
        )
        return found[-1]

    def wait_for_position(self, position, tolerance=1e-6):
        """Waits until the measured joint positions [rad, m] are within a tolerance of a position."""

        def reached():
            # Before homing, messages have no positions.
            measured = self.latest().position
            return len(measured) == len(position) and np.allclose(measured, position, rtol=0, atol=tolerance)

        wait_until(reached, "position", self.process)

    def end(self):
        """Ends both processes. The console is also ended if the process that started it was killed."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(20)
            self.process.kill()
        self.process.wait(TIMEOUT)
        # After `kill -9` of its parent, the console continues.
        with contextlib.suppress(OSError):
            if b"dvrk_console" in Path(f"/proc/{self.pid}/cmdline").read_bytes():
                os.kill(self.pid, signal.SIGKILL)
        _ENDED.append(self)


def _start(command, environment, output, arm, events, domain):
    """Starts the console. Returns its process and the `Console`. The file `output` receives its output."""
    from dvrk_drake.systems.ros.open_domain import open_ros_domain

    # A pipe that nobody reads would stop the process when it is full.
    with output.open("w") as stream:
        process = subprocess.Popen(command, env=environment, stdout=stream, stderr=subprocess.STDOUT)

    def pid():
        return re.search(r"console pid (\d+)", output.read_text(errors="replace"))

    try:
        joined = open_ros_domain(domain)
        wait_until(pid, "start of the dVRK console", process)
    except BaseException as error:
        process.kill()
        if isinstance(error, AssertionError):
            raise AssertionError(f"{error}: {output.read_text(errors='replace')}") from None
        raise
    return process, Console(arm, process, int(pid()[1]), events, joined)


@contextlib.contextmanager
def start_console(arm, folder, *, rate=1000.0, motion=False, gravity_compensation=None, domain=None):
    """Context in which the dVRK console runs. It is in the state DISABLED.

    Args:
        arm: "MTML", "MTMR" or "PSM1".
        folder: Existing folder for the file of events.
        rate: Rate of the topics [Hz].
        motion: Whether the topics of `dvrk_console_motion` are available, e.g. move_jp. False: those of `run.py`.
        gravity_compensation: Gravity compensation file of the dVRK. Needs `motion` and an MTM.
        domain: Number of the ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0.
    """
    peer = find_peer()
    events = Path(folder) / f"{arm}_events.log"
    script = [SUPPORT / "dvrk_console_motion.py", peer] if motion else [peer / "run.py"]
    options = ["--rate", str(rate), "--events", events]
    if gravity_compensation is not None:
        options += ["--gravity-compensation", gravity_compensation]
    # Without this variable, the console for a PSM uses uninitialized memory and may crash when it starts.
    environment = os.environ | {"MALLOC_PERTURB_": "255"}
    environment.setdefault("CYCLONEDDS_URI", DOMAIN_FILE)
    paths = [str(SUPPORT.parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    if domain is not None:
        environment["ROS_DOMAIN_ID"] = str(domain)
    command = [sys.executable, *script, arm, *options]
    for attempt in range(3):
        process, console = _start(command, environment, Path(folder) / f"{arm}_process.log", arm, events, domain)
        try:
            wait_until(console.state, "operating state", process)
            break
        except AssertionError:
            console.end()
            # The console is a program of others, and may crash when it starts.
            if process.poll() is None or attempt == 2:
                raise
    try:
        wait_until(lambda: "ready" in console.events(), "start", process)
        ready = time.monotonic()
        wait_until(lambda: time.monotonic() > ready + START, "period of the control loop", process)
        yield console
    finally:
        console.end()
