"""Measures the time and memory for reading a ROS bag.

    python benchmarks/ros_bag.py [--minutes 60] [--folder FOLDER]

The script writes an MCAP bag of an MTML at 1 kHz (1.4 GB per hour) into a temporary folder, reads it with
`read_recording` in a new process, and removes it. For comparison, it also deserializes all messages with the rosbags
library alone. The memory is the largest resident memory of the process, including the imported libraries.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

RATE = 1000
READ = """
import resource, sys, time
import dvrk_drake as dvrk
arm = dvrk.load_arm("mtml")
start = time.perf_counter()
rows = len(dvrk.read_recording(sys.argv[1], arm))
print(rows, time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
"""
DESERIALIZE = """
import resource, sys, time
from pathlib import Path
from rosbags.highlevel import AnyReader
start = time.perf_counter()
with AnyReader([Path(sys.argv[1])]) as reader:
    rows = sum(len(reader.deserialize(data, c.msgtype).name) == 7 for c, _, data in reader.messages())
print(rows, time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
"""


def write_bag(path: Path, rows: int) -> None:
    """Writes `rows` joint states of an MTML."""
    import numpy as np
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    import dvrk_drake as dvrk

    names = list(dvrk.load_arm("mtml").joint_names)
    store = get_typestore(Stores.ROS2_JAZZY)
    state, header, time = (
        store.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/MTML/measured_js", state.__msgtype__, typestore=store)
        for row in range(rows):
            stamp = 1_700_000_000_000_000_000 + row * (1_000_000_000 // RATE)
            phase = row / RATE
            message = state(
                header=header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=""),
                name=names,
                position=np.full(7, 0.1 * np.sin(phase)),
                velocity=np.full(7, 0.1 * np.cos(phase)),
                effort=np.full(7, 0.01),
            )
            writer.write(connection, stamp, store.serialize_cdr(message, state.__msgtype__))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="duration of the recording")
    parser.add_argument("--folder", help="folder for the temporary bag (default: the system's)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path = Path(folder) / "bag"
        write_bag(path, round(60 * options.minutes * RATE))
        file = next(path.glob("*.mcap"))
        print(f"{options.minutes:g} min at {RATE} Hz, {file.stat().st_size / 1e6:.0f} MB")
        print(f"{'':34} {'messages':>9} {'time [s]':>9} {'memory [GB]':>12}")
        for name, code in (("read_recording", READ), ("rosbags: deserialize all messages", DESERIALIZE)):
            done = subprocess.run([sys.executable, "-c", code, str(file)], capture_output=True, text=True, check=True)
            rows, seconds, memory = done.stdout.split()
            print(f"{name:34} {rows:>9} {float(seconds):>9.1f} {float(memory):>12.2f}")


if __name__ == "__main__":
    main()
