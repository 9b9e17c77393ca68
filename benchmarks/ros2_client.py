"""Exchanges messages with an independent ROS 2 implementation, the Rust crate ros2-client.

    python benchmarks/ros2_client.py [--messages 10000]

The Rust program is the arm, see `benchmarks/ros2_client/src/main.rs`. The two processes use a network namespace of
their own. This program publishes efforts at 1 kHz and receives the measurements of the arm. It prints the number of
messages that are lost, out of order or wrong, and the endpoints of the arm that it discovers. The benchmark requires
`cargo`, which downloads the crate for the first run.
"""

import argparse
import itertools
import os
import subprocess
import sys
from pathlib import Path

from dvrk_drake.processes.pace import Pace
from dvrk_drake.systems.ros.domain import RosDomain
from dvrk_drake.systems.ros.messages import Header, JointState, OperatingState, Time

FOLDER = Path(__file__).parent / "ros2_client"
DOMAIN = 11
EFFORTS = [0.1, -0.2, 0.3, -0.04, 0.05, -0.06, 0.007]
#: Time limit of discovery [s].
DISCOVERY = 20.0
INSIDE = "DVRK_DRAKE_OWN_NETWORK"
CONFIGURATION = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""


def build() -> Path:
    """Builds the Rust program and returns its path."""
    subprocess.run(["cargo", "build", "--release", "--quiet"], cwd=FOLDER, check=True)
    return Path(os.environ.get("CARGO_TARGET_DIR", FOLDER / "target")) / "release" / "ros2_client_arm"


def command(number: int) -> JointState:
    """Returns command `number`, as the arm expects it."""
    efforts = [1e-3 * (number % 1000) + k for k in range(len(EFFORTS))]
    return JointState(Header(Time(*divmod(number, 10**9))), effort=efforts)


def exchange(program: Path, num_messages: int) -> None:
    """Runs the arm, exchanges messages with it, and prints the counts."""
    arm = subprocess.Popen([program, str(DOMAIN), str(num_messages), *map(str, EFFORTS)], stdout=subprocess.PIPE)
    domain = RosDomain(DOMAIN)
    states = domain.subscribe("/MTML/operating_state", OperatingState, latched=True)
    measured = domain.subscribe("/MTML/measured_js", JointState, depth=1000)
    malformed = domain.subscribe("/MTML/malformed", JointState, latched=True)
    commands = domain.advertise("/MTML/servo_jf", JointState, depth=100)
    everything = (states.num_publishers, measured.num_publishers, malformed.num_publishers, commands.num_subscribers)
    if not domain.wait_until(lambda: all(count() for count in everything), DISCOVERY):
        raise SystemExit("The arm was not discovered.")
    received: list[JointState] = []
    pace = Pace(1e-3, sleep=domain.wait)
    for number in range(1, num_messages + 1):
        pace.wait()
        commands.publish(command(number))
        received += [message for message, _ in measured.take()]
    confirmed = commands.wait_until_received(10.0)
    domain.wait_until(lambda: received.extend(m for m, _ in measured.take()) or len(received) >= num_messages, 10.0)
    for endpoint in domain.publishers() + domain.subscribers():
        if not endpoint.is_own and endpoint.topic.startswith("/MTML"):
            print(endpoint)
    print("latched states:", [message for message, _ in states.take()])
    numbers = [message.header.nanoseconds for message in received]
    right = [list(m.effort) == EFFORTS and list(m.position) == [0.1 * k for k in range(7)] for m in received]
    print(
        f"measured_js: received {len(received)}, lost {num_messages - len(set(numbers))}, "
        f"out of order {sum(b <= a for a, b in itertools.pairwise(numbers))}, "
        f"wrong content {right.count(False)}"
    )
    print(f"malformed: received {len(malformed.take())}; all commands confirmed: {confirmed}")
    print(arm.communicate(timeout=60)[0].decode(), end="")


def main() -> None:
    """Builds the program, then exchanges messages in a network namespace."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--messages", type=int, default=10_000, help="messages in each direction; default: 10000")
    options = parser.parse_args()
    program = build()
    if INSIDE in os.environ:
        exchange(program, options.messages)
        return
    os.environ.update({INSIDE: "1", "CYCLONEDDS_URI": CONFIGURATION})
    unshare = ["unshare", "-rn", "sh", "-c", 'ip link set lo up; exec "$@"', "sh"]
    sys.exit(subprocess.run([*unshare, sys.executable, *sys.argv], check=False).returncode)


if __name__ == "__main__":
    main()
