"""Round trip of `dvrk-drake run` over LCM at 1 kHz, status out to command back, beside a raw Python echo's.

    python benchmarks/lcm_round_trip.py [--seconds 60] [--realtime]

This process plays the arm by constant statuses, so that only the controller is measured. It needs a multicast route:

    unshare -rn sh -c 'ip link set lo up; ip link set lo multicast on; ip route add 239.255.0.0/16 dev lo;
                       exec python benchmarks/lcm_round_trip.py'
"""

import argparse
import signal
import subprocess
import sys
import time

import lcm
import numpy as np

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.processes.pace import Pace, make_realtime, settle_memory
from dvrk_drake.systems.dvrk_command_sender import draw_id

ARM = load_arm("mtml")
STATUS, COMMAND = "DVRK_STATUS_MTML", "DVRK_COMMAND_MTML"


def echo() -> None:
    """The peer: decodes a status, encodes a command, nothing else."""
    network = lcm.LCM()

    def answer(channel, data):
        status, command = lcmt_dvrk_status.decode(data), lcmt_dvrk_command()
        command.status_utime, command.arm_name, command.num_joints = status.utime, status.arm_name, status.num_joints
        command.sender_id, command.sequence = 1, status.sequence
        command.position, command.velocity, command.effort = status.position, status.velocity, status.effort_measured
        network.publish(COMMAND, command.encode())

    network.subscribe(STATUS, answer)
    while True:
        network.handle()


def measure(arguments: list[str], seconds: float) -> np.ndarray:
    """Round trips [s] of the process that is started with `arguments`, NaN where no command came within the period."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL)
    network, came, sender = lcm.LCM(), {}, [0]

    def hear(channel, data):
        command = lcmt_dvrk_command.decode(data)
        came[command.status_utime], sender[0] = time.monotonic(), command.sender_id

    network.subscribe(COMMAND, hear)
    status = lcmt_dvrk_status()
    status.arm_name, status.num_joints, status.session_id = ARM.name, ARM.num_joints, draw_id()
    status.guard_state, status.accepted_modes = lcmt_dvrk_status.STATE_EFFORT, 0b1111
    status.position, status.velocity = [0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5], [0.0] * 7
    status.effort_measured = status.effort_commanded = (
        IdentifiedModel.from_arm(ARM).holding_torque(status.position).tolist()
    )
    status.position_commanded, status.joint_flags = status.position, [0] * 7
    sent: dict[int, float] = {}
    pace, begun = Pace(1e-3), None
    try:
        while begun is None or time.monotonic() < begun + seconds:
            pace.wait()
            status.utime, status.sequence = time.monotonic_ns() // 1000, status.sequence + 1
            status.command_sender_id = sender[0]
            data = status.encode()
            if came and begun is None:
                begun = time.monotonic() + 1.0  # the first second does not count
            if begun is not None and time.monotonic() > begun:
                sent[status.utime] = time.monotonic()
            network.publish(STATUS, data)
            end = time.monotonic() + 0.0009
            while status.utime not in came and (left := end - time.monotonic()) > 0:
                network.handle_timeout(max(1, int(1e3 * left)))
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    return np.array([came.get(utime, np.nan) - begun for utime, begun in sent.items()])


def report(name: str, trips: np.ndarray) -> float:
    """Prints the percentiles [us]; returns the median."""
    fresh = trips[trips < 1e-3]
    p50, p99, p999 = 1e6 * np.nanpercentile(trips, [50, 99, 99.9])
    print(
        f"{name:24} p50 {p50:6.0f} us  p99 {p99:6.0f}  p99.9 {p999:6.0f}  ticks without a fresh command "
        f"{len(trips) - len(fresh)} of {len(trips)}"
    )
    return float(p50)


def main() -> None:
    """Both in turn, and the ratio of their medians."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--realtime", action="store_true")
    parser.add_argument("--echo", action="store_true", help="be the peer")
    options = parser.parse_args()
    if options.realtime and (warning := make_realtime()):
        print(f"warning: {warning}")
    if options.echo:
        echo()
    realtime = ["--realtime"] if options.realtime else []
    settle_memory()
    raw = report("raw Python echo", measure([__file__, "--echo", *realtime], options.seconds))
    run = ["-m", "dvrk_drake.cli", "run", "--arm", "mtml", "--mode", "hold", *realtime]
    ours = report("dvrk-drake run", measure(run, options.seconds))
    print(f"ratio of the medians: {ours / raw:.2f}")


if __name__ == "__main__":
    main()
