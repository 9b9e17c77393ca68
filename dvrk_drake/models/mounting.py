"""Direction of gravity in the frame of a base that is tilted."""

from __future__ import annotations

import math

#: Acceleration of gravity [m/s^2], as in the controller of the dVRK.
GRAVITY = 9.81


def mount_gravity(roll: float, pitch: float = 0.0, yaw: float = 0.0) -> tuple[float, float, float]:
    """Returns the gravity vector (3,) in the frame of a base with an orientation in the world [m/s^2].

    Args:
        roll: Angle about the x axis [rad]. `mounting_pitch` in the configuration of an arm of the dVRK is this angle.
        pitch: Angle about the y axis [rad].
        yaw: Angle about the z axis of the world [rad], which has no effect.
    """
    # The negative third row of the rotation matrix Rz(yaw) Ry(pitch) Rx(roll).
    horizontal = math.cos(pitch)
    return (
        GRAVITY * math.sin(pitch),
        -GRAVITY * horizontal * math.sin(roll),
        -GRAVITY * horizontal * math.cos(roll),
    )
