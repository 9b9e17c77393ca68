# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Estimates the force at the tip of an instrument from the motor efforts of a recording, with its 95 % interval.

dvrk-drake samples samples
dvrk-drake identify samples/psm_motion.csv --arm psm --output psm.yaml
python 07_force_at_the_tip.py psm.yaml samples/psm_motion.csv       # nothing touches the arm, so the force is about 0
"""

import sys

import numpy as np

import dvrk_drake as dvrk

if len(sys.argv) != 3:
    sys.exit(__doc__)
try:
    model = dvrk.IdentifiedModel.load(sys.argv[1])
    result = dvrk.estimate_force(dvrk.read_recording(sys.argv[2], model.arm), model)
except dvrk.DvrkDrakeError as error:
    sys.exit(str(error))
for warning in result.warnings:
    print(warning)
print(f"RMS force on {result.frame} along the axes of the base [N]", np.sqrt(np.mean(result.force**2, axis=0)).round(2))
print("half width of the 95 % interval, median [N]            ", np.median(result.half_width, axis=0).round(2))
inside = np.mean(np.abs(result.force) < result.half_width, axis=0)
print("share of the time in which 0 is in the interval        ", inside.round(2))
