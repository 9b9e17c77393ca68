"""Connects the bridge to an independent ROS 2 implementation, the Rust crate ros2-client.

    python benchmarks/ros2_client.py [--messages 10000]

The Rust program is the arm, see `benchmarks/ros2_client/src/main.rs`. It publishes `measured_js` at 1 kHz. A controller
answers each status of `dvrk-drake bridge` with an effort that contains the position of the last joint. The arm receives
these efforts on `servo_jf`. A subscription of Cyclone DDS receives the same efforts. The benchmark compares both, and
prints how many messages are lost, repeated, out of order or different. The processes use a network namespace of their
own. The benchmark requires `cargo`, which downloads the crate for the first run.
"""

import argparse
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import lcm
from effort_controller import effort_command
from ros_bridge import CommandMonitor, start_bridge

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import command_channel, status_channel
from dvrk_drake.systems.lcm.messages import draw_id, handle_message
from dvrk_drake.systems.ros.domain import RosDomain

FOLDER = Path(__file__).parent / "ros2_client"
ARM = load_arm("mtml")
DOMAIN = 11
#: Longest time until the efforts act, and longest mean time per effort [s].
START, PERIOD = 20.0, 0.005
INSIDE = "DVRK_DRAKE_OWN_NETWORK"
CONFIGURATION = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces>
</General></Domain></CycloneDDS>"""
NETWORK = "ip link set lo up; ip link set lo multicast on; ip route add 239.255.0.0/16 dev lo"


def build() -> Path:
    """Builds the Rust program and returns its path."""
    subprocess.run(["cargo", "build", "--release", "--quiet"], cwd=FOLDER, check=True)
    return Path(os.environ.get("CARGO_TARGET_DIR", FOLDER / "target")) / "release" / "ros2_client_arm"


def answer_statuses(arm: "subprocess.Popen[bytes]", monitor: CommandMonitor, seconds: float) -> list[int]:
    """Answers each status with an effort until the arm has ended. Returns the numbers of the measurements."""
    limit = time.monotonic() + seconds
    network, sender_id, numbers = lcm.LCM(), draw_id(), []

    def answer(channel: str, data: bytes) -> None:
        status = lcmt_dvrk_status.decode(data)
        numbers.append(round(1e6 * status.position[-1]))
        effort = [0.0] * (ARM.num_joints - 1) + [status.position[-1]]
        network.publish(command_channel(ARM), effort_command(status, effort, sender_id, len(numbers)).encode())

    network.subscribe(status_channel(ARM), answer).set_queue_capacity(1000)
    while arm.poll() is None:
        handle_message(network, 0.1)
        if len(numbers) % 100 == 0:
            monitor.receive()
        if time.monotonic() > limit:
            raise SystemExit(f"after {seconds:g} s, the arm has not received all efforts")
    return numbers


def exchange(program: Path, num_messages: int) -> None:
    """Runs the arm and the bridge, and prints the counts."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with open(folder / "arm.txt", "w") as output:
            arguments = [program, str(DOMAIN), str(num_messages), *ARM.joint_names]
            arm = subprocess.Popen(arguments, stdout=output)
        monitor = CommandMonitor(RosDomain(DOMAIN), "/MTML")
        bridge = start_bridge("mtml", folder, "--domain", DOMAIN)
        try:
            numbers = answer_statuses(arm, monitor, START + PERIOD * num_messages)
        finally:
            arm.kill()
            print(bridge.end(signal.SIGINT))
        *lines, counts = (folder / "arm.txt").read_text().splitlines()
    received = [(int(stamp), json.loads(values)) for stamp, _, values in (line.partition(" ") for line in lines)]
    stamps = [stamp for stamp, _ in received]
    sent = {m.header.nanoseconds: list(m.effort) for kind, _, m in monitor.receive() if kind == "servo_jf"}
    expected = {stamp for stamp in sent if min(stamps) <= stamp <= max(stamps)}
    steps = [(b - a) % 1000 for a, b in itertools.pairwise(numbers)]
    skipped = sum(step - 1 for step in steps if step)
    lost, repeated = len(expected - set(stamps)), len(stamps) - len(set(stamps))
    disordered = sum(b < a for a, b in itertools.pairwise(stamps))
    different = sum(sent.get(stamp) != values for stamp, values in received)
    print(f"the arm published {counts.replace(', ', ' and received ', 1)}")
    print(f"measured_js: {len(numbers) - steps.count(0)} reached the controller, {skipped} did not")
    print(
        f"servo_jf: received {len(stamps)}, lost {lost}, repeated {repeated}, out of order {disordered}, "
        f"different {different}"
    )


def main() -> None:
    """Builds the program, then exchanges messages in a network namespace."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--messages", type=int, default=10_000, help="number of efforts; default: 10000")
    options = parser.parse_args()
    program = build()
    if INSIDE in os.environ:
        exchange(program, options.messages)
        return
    os.environ.update({INSIDE: "1", "CYCLONEDDS_URI": CONFIGURATION})
    unshare = ["unshare", "-rn", "sh", "-c", f'{NETWORK}; exec "$@"', "sh"]
    sys.exit(subprocess.run([*unshare, sys.executable, *sys.argv], check=False).returncode)


if __name__ == "__main__":
    main()
