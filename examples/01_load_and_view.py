# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Loads an arm and shows it in a browser at the middle of its limits. `dvrk-drake view` adds sliders and buttons.

python 01_load_and_view.py [ARM]        ARM is mtml, mtmr, psm, or the path of a URDF, SDF, MJCF or arm file.
"""

import sys

import dvrk_drake as dvrk

arm = dvrk.load_arm(sys.argv[1] if len(sys.argv) > 1 else "psm")
for name, lower, upper, effort in zip(
    arm.joint_names, arm.position_lower, arm.position_upper, arm.effort_limits, strict=True
):
    print(f"{name:20} {lower:7.3f} to {upper:7.3f}, effort limit {effort:.3g}")

meshcat = dvrk.start_meshcat(arm)
station = dvrk.ArmStation(arm, meshcat=meshcat)
context = station.CreateDefaultContext()
station.SetPositions(context, 0.5 * (arm.position_lower + arm.position_upper))
station.ForcedPublish(context)
hand = station.plant.GetFrameByName(arm.frames.hand)
X_WH = hand.CalcPoseInWorld(station.plant.GetMyContextFromRoot(context))
print(f"position of {hand.name()} in the world [m]", X_WH.translation().round(4))
if sys.stdin.isatty():  # the page exists only while this script runs
    input(f"{meshcat.web_url()} shows the arm. Press Enter to end. ")
