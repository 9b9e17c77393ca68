"""Compares the ROS 2 topics of the simulated arm with those of the dVRK console, and prints a Markdown table.

Run it in a network namespace with Cyclone DDS on the loopback interface (docs/ros.md, Network). It needs the dVRK
console in shared/peers/dvrk_console.

    python benchmarks/crtk_conformance.py [MTML|PSM1]
"""

import os
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/support"))

from crtk_conformance import observe, start
from ros_publisher import DOMAIN_FILE

from dvrk_drake.models.arm_files import load_arm


def main(arm):
    os.environ.setdefault("CYCLONEDDS_URI", DOMAIN_FILE)
    rows = {}
    for motion in (False, True) if arm != "PSM1" else (True,):
        for kind in ("console", "simulated"):
            with tempfile.TemporaryDirectory() as folder, start(kind, arm, folder, motion=motion) as subject:
                for check, text in observe(subject, load_arm(arm.rstrip("1").lower()), motion=motion).items():
                    rows.setdefault(check, {}).setdefault(kind, text)
    print(f"| {arm} | dVRK console 2.4.0 | simulated arm | equal |\n|---|---|---|---|")
    for check, texts in rows.items():
        console, simulated = texts.get("console", ""), texts.get("simulated", "")
        print(f"| {check} | {console} | {simulated} | {'yes' if console == simulated else 'no'} |")
    print(f"\n{sum(t.get('console') == t.get('simulated') for t in rows.values())} of {len(rows)} checks are equal.")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "MTML")
