"""Process that runs the dVRK console and offers more CRTK topics than its own script `run.py`.

    python dvrk_console_motion.py PEER MTML --events events.log [--rate 1000] [--gravity-compensation gc.json]

Additional topics: setpoint_js, measured_cp and measured_cv, the commands move_jp, servo_cp and move_cp, and the topics
of the jaw of a PSM. Unlike with `run.py`, the PSM has an instrument, and thus six joints and a jaw. The console's
component sawSocketStreamer exchanges JSON objects with this process over UDP. SIGINT and SIGTERM end the process.
"""

import argparse
import contextlib
import json
import os
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from dvrk_drake.systems.ros import messages as m
from dvrk_drake.systems.ros.domain import RosDomain

OUTPUTS = {
    "measured_js": ("prmStateJoint", m.JointState),
    "setpoint_js": ("prmStateJoint", m.JointState),
    "gravity_compensation/setpoint_js": ("prmStateJoint", m.JointState),
    "measured_cp": ("prmPositionCartesianGet", m.PoseStamped),
    "measured_cv": ("prmVelocityCartesianGet", m.TwistStamped),
}
MOTIONS = {
    "servo_jp": ("prmPositionJointSet", m.JointState),
    "move_jp": ("prmPositionJointSet", m.JointState),
    "servo_jf": ("prmForceTorqueJointSet", m.JointState),
    "servo_cp": ("prmPositionCartesianSet", m.PoseStamped),
    "move_cp": ("prmPositionCartesianSet", m.PoseStamped),
}
JAW_OUTPUTS = {name: OUTPUTS["measured_js"] for name in ("jaw/measured_js", "jaw/setpoint_js")}
JAW_MOTIONS = {f"jaw/{name}": MOTIONS[name] for name in ("servo_jp", "move_jp", "servo_jf")}
#: Commands without a motion, which the console receives as text.
TEXTS = {"hold": m.Empty, "free": m.Empty, "state_command": m.StringStamped, "use_gravity_compensation": m.Bool}
#: Period of the component that exchanges the JSON objects [s].
PERIOD = 0.001
#: Largest number of objects that are read before the next command is read.
MAX_OBJECTS = 100
#: Time between two requests of the operating state [s]. The JSON objects of its changes are lost before the component
#: has started, and may be lost while this process is busy.
STATE_PERIOD = 0.05


def output_message(kind, value):
    """Returns the message of one data object of the console. Invalid data has the time stamp 0."""
    header = m.Header.now() if value["Valid"] else m.Header()
    header.frame_id = value.get("ReferenceFrame", "")
    if kind is m.JointState:
        return kind(header, *(value[key] or [] for key in ("Name", "Position", "Velocity", "Effort")))
    if kind is m.TwistStamped:
        return kind(header, m.Twist(m.Vector3(*value["VelocityLinear"]), m.Vector3(*value["VelocityAngular"])))
    pose = value["Position"]
    # The console's rotations are orthonormal to 1e-10 only.
    w, x, y, z = RotationMatrix.ProjectToRotationMatrix(pose["Rotation"]).ToQuaternion().wxyz()
    return kind(header, m.Pose(m.Point(*pose["Translation"]), m.Quaternion(x, y, z, w)))


def motion_object(name, message):
    """Returns the JSON object of one motion command."""
    if name.endswith("servo_jf"):
        return {name: {"ForceTorque": list(message.effort)}}
    if isinstance(message, m.JointState):
        return {name: {"Goal": list(message.position)}}
    p, q = message.pose.position, message.pose.orientation
    rotation = RotationMatrix(Quaternion([q.w, q.x, q.y, q.z])).matrix().tolist()
    return {name: {"Goal": {"Rotation": rotation, "Translation": [p.x, p.y, p.z]}}}


def text_command(name, message):
    """Returns the text of one command without a motion."""
    if name == "use_gravity_compensation":
        return f"{name} {int(message.data)}"
    return f"{name} {message.string}" if name == "state_command" else name


def received_states(control):
    """Returns the operating states in the answers of the console, each (state, is_homed, is_busy)."""
    states = []
    with contextlib.suppress(BlockingIOError):
        while True:
            if found := re.fullmatch(r"(\w+) ([01]) ([01])", control.recv(512).decode().strip()):
                states.append((found[1], found[2] == "1", found[3] == "1"))
    return states


def udp_socket():
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind(("127.0.0.1", 0))
    opened.setblocking(False)
    return opened


def write_configuration(folder, options, outputs, motions, port):
    """Copies the configuration of the console to a folder, and adds the component that exchanges JSON objects."""
    share = folder / "share"
    shutil.copytree(options.peer / "share", share, ignore=shutil.ignore_patterns("cisstLog*"))
    for path in [share, *share.rglob("*")]:
        path.chmod(path.stat().st_mode | 0o200)
    # The console searches for the file of the instrument in its working directory. Without it, no jaw is available.
    for path in (share / "tool").glob("*.json"):
        shutil.copy(path, share)
    streamer = {
        "ip": "127.0.0.1",
        "port": str(port),
        "read-commands": [{"name": name, "type": kind} for name, (kind, _) in outputs.items()],
        "write-commands": [{"name": name, "type": kind} for name, (kind, _) in motions.items()],
        "write-events": ["operating_state"],
    }
    (folder / "streamer.json").write_text(json.dumps(streamer))
    component = {
        "shared-library": "sawSocketStreamer",
        "class-name": "mtsSocketStreamer",
        "constructor-arg": {"Name": "streamer", "Period": PERIOD},
        "configure-parameter": str(folder / "streamer.json"),
    }
    connection = {
        "required": {"component": "streamer", "interface": "Required"},
        "provided": {"component": options.arm, "interface": "Arm"},
    }
    (folder / "manager.json").write_text(json.dumps({"components": [component], "connections": [connection]}))
    if options.gravity_compensation:
        shutil.copy(options.gravity_compensation, share / "arm" / "gravity_compensation.json")
        arm_file = share / "arm" / f"{options.arm}_KIN_SIMULATED.json"
        text = arm_file.read_text()
        arm_file.write_text(
            text.replace('"kinematic"', '"gravity_compensation": "gravity_compensation.json", "kinematic"')
        )
    return share


def exchange(console, stream, control, control_port, arm, rate, outputs, motions):
    """Forwards messages between the topics and the console until the console ends."""
    domain = RosDomain(0)
    publishers = {name: domain.advertise(f"/{arm}/{name}", kind) for name, (_, kind) in outputs.items()}
    state = domain.advertise(f"/{arm}/operating_state", m.OperatingState, latched=True)
    kinds = {name: kind for name, (_, kind) in motions.items()} | TEXTS
    inputs = {name: domain.subscribe(f"/{arm}/{name}", kind) for name, kind in kinds.items()}
    address, last_state, last_answer, due = None, None, None, dict.fromkeys(outputs, 0.0)
    next_request = 0.0

    def publish_state(published):
        nonlocal last_state
        if published != last_state:
            state.publish(m.OperatingState(m.Header.now(), *published))
            last_state = published

    while console.poll() is None:
        ready, _, _ = select.select([stream, domain], [], [], 0.1)
        if domain in ready:
            domain.clear()
            for name, subscription in inputs.items():
                for message, _ in subscription.take():
                    if name in TEXTS:
                        control.sendto(text_command(name, message).encode(), ("127.0.0.1", control_port))
                    elif address:
                        stream.sendto(json.dumps(motion_object(name, message)).encode(), address)
        for answer in received_states(control):
            # A state that has just changed may be newer than the objects that have arrived so far.
            if answer == last_answer:
                publish_state(answer)
            last_answer = answer
        if time.monotonic() >= next_request:
            control.sendto(b"operating_state", ("127.0.0.1", control_port))
            next_request = time.monotonic() + STATE_PERIOD
        # Objects that arrived while this process was busy are dropped, so that commands are not delayed.
        latest = {}
        with contextlib.suppress(BlockingIOError):
            for _ in range(MAX_OBJECTS):
                data, address = stream.recvfrom(65536)
                latest[data[2 : data.index(b'"', 2)].decode()] = data
        for name, data in latest.items():
            now = time.monotonic()
            if name == "operating_state":
                value = json.loads(data)[name]
                publish_state((value["State"], value["IsHomed"], value["IsBusy"]))
            elif now >= due[name]:
                due[name] = max(due[name] + 1 / rate, now - 1 / rate)
                publishers[name].publish(output_message(outputs[name][1], json.loads(data)[name]))


def interrupt(*_):
    raise KeyboardInterrupt


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peer", type=Path, help="folder dvrk_console")
    parser.add_argument("arm", choices=["MTML", "MTMR", "PSM1"])
    parser.add_argument("--rate", type=float, default=1000.0, help="of each topic [Hz]")
    parser.add_argument("--events", required=True, help="file for the output of the console")
    parser.add_argument("--gravity-compensation", type=Path, help="gravity compensation file of the dVRK (MTM)")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, interrupt)
    outputs, motions = OUTPUTS, MOTIONS
    if options.arm.startswith("PSM"):
        outputs, motions = OUTPUTS | JAW_OUTPUTS, MOTIONS | JAW_MOTIONS
    stream, control = udp_socket(), udp_socket()
    with udp_socket() as unused:
        control_port = unused.getsockname()[1]
    with tempfile.TemporaryDirectory(prefix="dvrk_console_") as name, open(options.events, "w") as events:
        folder = Path(name)
        share = write_configuration(folder, options, outputs, motions, stream.getsockname()[1])
        console = subprocess.Popen(
            [
                *(options.peer / "bin/dvrk_console", f"system/system-{options.arm}_Classic_KIN_SIMULATED.json"),
                *(options.arm, str(control_port), folder / "manager.json"),
            ],
            cwd=share,
            env=os.environ | {"LD_LIBRARY_PATH": str(options.peer / "lib")},
            stdout=events,
            stderr=events,
        )
        print(f"{options.arm}: console pid {console.pid}", flush=True)
        try:
            exchange(console, stream, control, control_port, options.arm, options.rate, outputs, motions)
        except KeyboardInterrupt:
            pass
        finally:
            # The console may crash if a signal ends it.
            control.sendto(b"quit", ("127.0.0.1", control_port))
            try:
                console.wait(3)
            except subprocess.TimeoutExpired:
                console.kill()
                console.wait()
    return 0


if __name__ == "__main__":
    sys.exit(main())
