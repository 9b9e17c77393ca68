"""Gravity-compensation torque that the dVRK's controller computes for an MTM."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import NUM_JOINTS, NUM_PARAMETERS, GravityCompensationFile

#: Gravitational acceleration in the gravity columns of the controller's regressor [m/s^2].
CONTROLLER_GRAVITY = 9.81
#: Number of gravity columns of the controller's regressor.
NUM_GRAVITY = 10
#: Order of the polynomials in a joint position.
ORDER = 4
MTM_JOINTS = (
    "outer_yaw",
    "shoulder_pitch",
    "elbow_pitch",
    "wrist_platform",
    "wrist_pitch",
    "wrist_yaw",
    "wrist_roll",
)


def controller_regressor(q: ArrayLike) -> NDArray[np.float64]:
    """Returns the regressor R (m, 7, 40) at poses q (m, 7) [rad]. R times the parameters (40,) is the torque [N m].

    The formula is from the class robGravityCompensationMTM of sawIntuitiveResearchKit, the software of the dVRK.
    """
    q = np.atleast_2d(np.asarray(q, dtype=np.float64))
    s4, s5, s6 = np.sin(q[:, 3:6]).T
    c4, c5, c6 = np.cos(q[:, 3:6]).T
    S, C = np.sin(q[:, 1] + q[:, 2]), np.cos(q[:, 1] + q[:, 2])
    R = np.zeros((len(q), NUM_JOINTS, NUM_PARAMETERS))
    R[:, 1, 0], R[:, 1, 1] = np.sin(q[:, 1]), np.cos(q[:, 1])
    R[:, 1, 2:10] = np.stack(
        [
            C,
            -S,
            C * c4,
            -C * s4,
            -(S * c5 + C * c4 * s5),
            C * c4 * c5 - S * s5,
            C * s4 * s6 + S * c6 * s5 - C * c4 * c5 * c6,
            C * c6 * s4 - S * s5 * s6 + C * c4 * c5 * s6,
        ],
        axis=1,
    )
    R[:, 2, 2:10] = R[:, 1, 2:10]
    R[:, 3, 4:10] = np.stack(
        [-S * s4, -S * c4, S * s4 * s5, -S * c5 * s4, S * (c4 * s6 + c5 * c6 * s4), S * (c4 * c6 - c5 * s4 * s6)],
        axis=1,
    )
    R[:, 4, 6:10] = np.stack(
        [
            -(C * s5 + S * c4 * c5),
            C * c5 - S * c4 * s5,
            -C * c5 * c6 + S * c4 * c6 * s5,
            C * c5 * s6 - S * c4 * s5 * s6,
        ],
        axis=1,
    )
    R[:, 5, 8] = S * c6 * s4 + C * s5 * s6 + S * c4 * c5 * s6
    R[:, 5, 9] = C * c6 * s5 - S * s4 * s6 + S * c4 * c5 * c6
    R *= CONTROLLER_GRAVITY
    for joint in range(NUM_JOINTS - 1):
        R[:, joint, polynomial_columns(joint)] = q[:, joint, None] ** np.arange(ORDER + 1)
    return R


def polynomial_columns(joint: int) -> slice:
    """Returns the slice of the five regressor columns (powers 0 to 4 of the position) of a joint with index 0 to 5."""
    first = NUM_GRAVITY + (ORDER + 1) * joint
    return slice(first, first + ORDER + 1)


def unclipped_torque(file: GravityCompensationFile, q: ArrayLike, v: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns the torque (m, 7) that the controller computes from a file, before clipping to the torque limits [N m].

    Args:
        file: Content of the file.
        q: Poses (m, 7) [rad].
        v: Velocities (m, 7) [rad/s]. None: all velocities are zero.
    """
    R = controller_regressor(q)
    v = np.zeros(R.shape[:2]) if v is None else np.atleast_2d(np.asarray(v, dtype=np.float64))
    share = np.clip((np.abs(v) - file.dead_band) / (file.saturation - file.dead_band), 0.0, 1.0)
    alpha = 0.5 + 0.5 * file.friction_ratio * share * np.sign(v)
    return alpha * (R @ file.positive) + (1.0 - alpha) * (R @ file.negative)


def controller_torque(file: GravityCompensationFile, q: ArrayLike, v: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns the torque (m, 7) that the controller applies: `unclipped_torque`, clipped to the torque limits [N m]."""
    return np.clip(unclipped_torque(file, q, v), file.torque_lower, file.torque_upper)
