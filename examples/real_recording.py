"""Identify a real arm from a recording of poses at rest, as `dvrk-drake identify` does.

python real_recording.py FILE.csv [MODEL.yaml]: without MODEL.yaml nothing is written.
"""

import sys
from pathlib import Path

from dvrk_drake.analysis.static.static_identification import identify_static
from dvrk_drake.models.arm import load_arm
from dvrk_drake.recordings.recording import read_recording

if len(sys.argv) not in (2, 3):
    sys.exit("usage: python real_recording.py FILE.csv [MODEL.yaml]")
if len(sys.argv) == 3 and Path(sys.argv[2]).exists():
    sys.exit(f"{sys.argv[2]}: exists already; name another file")
recording = read_recording(sys.argv[1])
result = identify_static(recording, load_arm("mtmr"))
for doubt in result.doubts:
    print(f"doubted: {doubt.where}: {doubt.reason}")
for joint in result.model.joints:
    error, zero = joint.rms_leave_one_out_undoubted, joint.rms_zero_torque_undoubted
    print(f"{joint.name:15} left-out error {error:.4f} N m, zero torque {zero:.4f} N m")
if len(sys.argv) == 3:
    result.model.save(sys.argv[2])
