"""Compares the ROS 2 topics of the simulated arm with those of the dVRK console, and prints a Markdown table.

Run it in a network namespace with Cyclone DDS on the loopback interface (docs/ros.md, Network). It needs the dVRK
console in shared/peers/dvrk_console.

    python benchmarks/crtk_conformance.py [MTML|MTMR|PSM1]
"""

import os
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/support"))

from crtk_conformance import compare
from ros_publisher import DOMAIN_FILE


def main(arm):
    os.environ.setdefault("CYCLONEDDS_URI", DOMAIN_FILE)
    with tempfile.TemporaryDirectory() as folder:
        rows = compare(arm, folder)
    print(f"| {arm} | dVRK console 2.4.0 | simulated arm | equal |\n|---|---|---|---|")
    for check, (console, simulated) in rows.items():
        print(f"| {check} | {console} | {simulated} | {'yes' if console == simulated else 'no'} |")
    print(f"\n{sum(console == simulated for console, simulated in rows.values())} of {len(rows)} checks are equal.")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "MTML")
