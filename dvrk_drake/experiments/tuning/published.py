"""The gains that the paper's team had in its simulation, to compare with.

"Gravity Compensation Control of da Vinci Robot" (Rutfield, Zia, Boos, Santoso, Sujumnong, WPI 2015); the numbers are in
the controller node that the team gave along with it.
"""

from __future__ import annotations

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains

#: Its controller ran at 100 Hz and summed errors sample by sample: 1 of its Ki is 100 N m/(rad s).
SAMPLES_PER_SECOND = 100.0
KP = (0.5, 0.8, 0.85, 3.7, 0.5, 0.02, 0.006)
KV = (1.95, 0.95, 1.75, 0.2, 0.1, 0.8, 0.08)
KI_PER_SAMPLE = (1e-5, 5e-5, 1e-4, 4e-4, 1e-6, 1e-7, 1e-8)
#: The arm that they are of.
JOINTS = ("outer_yaw", "shoulder_pitch", "elbow_pitch", "wrist_platform", "wrist_pitch", "wrist_yaw", "wrist_roll")


def published_gains(arm: Arm) -> Gains | None:
    """Of an arm with the joints of an MTM, per second; None of another one, for which none were published."""
    if arm.joint_names != JOINTS:
        return None
    return Gains(list(KP), list(KV), [SAMPLES_PER_SECOND * ki for ki in KI_PER_SAMPLE])
