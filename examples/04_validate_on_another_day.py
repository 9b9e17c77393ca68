# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Evaluates a model on a recording of another day, and prints the verdict and the error of each joint.

python 04_validate_on_another_day.py MODEL.yaml RECORDING
"""

import sys

import dvrk_drake as dvrk

if len(sys.argv) != 3:
    sys.exit(__doc__)
try:
    model = dvrk.IdentifiedModel.load(sys.argv[1])
    result = dvrk.validate(model, dvrk.read_recording(sys.argv[2], model.arm))
except dvrk.DvrkDrakeError as error:
    sys.exit(str(error))
for warning in result.warnings:
    print(warning)
for name, verdict in result.verdicts.items():
    print(f"{name:20} {verdict:12} error {result.relative_errors[name]:6.1%} of the RMS effort")
sys.exit(result.verdict not in ("good", "usable"))
