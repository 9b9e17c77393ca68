"""Identifies a right master arm from a recording, as `dvrk-drake identify` does.

dvrk-drake samples samples
python real_recording.py samples/mtm_poses.csv [MODEL.yaml]

The script writes the model only if MODEL.yaml is given.
"""

import sys

import dvrk_drake as dvrk

if len(sys.argv) not in (2, 3):
    sys.exit("usage: python real_recording.py FILE.csv [MODEL.yaml]")
arm = dvrk.load_arm("mtmr")
try:
    result = dvrk.identify(dvrk.read_recording(sys.argv[1], arm), arm)
    for warning in result.warnings:
        print(warning)
    for joint in result.model.joints:
        error, zero = joint.rms_leave_one_out_included, joint.rms_zero_torque_included
        print(f"{joint.name:15} leave-one-out error {error:.4f} N m, without model {zero:.4f} N m")
    if len(sys.argv) == 3:
        result.save(sys.argv[2])
except dvrk.DvrkDrakeError as error:
    sys.exit(str(error))
