# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Identifies a model from a recording of static poses or of a motion, as `dvrk-drake identify` does.

dvrk-drake samples samples
python 03_identify.py samples/mtm_poses.csv mtmr [MODEL.yaml [REPORT.html]]

The script writes only the files that are given.
"""

import sys

import dvrk_drake as dvrk

if len(sys.argv) not in (3, 4, 5):
    sys.exit(__doc__)
try:
    arm = dvrk.load_arm(sys.argv[2])
    result = dvrk.identify(dvrk.read_recording(sys.argv[1], arm), arm)
    for warning in result.warnings:
        print(warning)
    print(f"identified from {len(result.recording.q)} rows of {sys.argv[1]}")
    print("torque that holds the arm at q = 0 [N m; N]", result.model.holding_torque([0] * arm.num_joints).round(4))
    if len(sys.argv) > 3:
        result.save(sys.argv[3])
    if len(sys.argv) > 4:
        result.report(sys.argv[4], inputs=[sys.argv[1]])
except dvrk.DvrkDrakeError as error:
    sys.exit(str(error))
