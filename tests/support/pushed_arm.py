"""Motion of a simulated arm with an exact model, and with a known force at its tip."""

from __future__ import annotations

import dataclasses

import numpy as np
from motions import fourier_motion, friction_everywhere, true_dynamics

from dvrk_drake.dynamics.dynamic_section import ActuatorStatistics
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import Contact
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording

#: Stated error of the model, as a share of the effort limits.
ERROR = 0.002


def pushed_arm(
    name: str = "psm", *, seconds: float = 12.0, force=(0.0, 0.0, 0.0), at_rest: bool = False
) -> tuple[IdentifiedModel, Recording]:
    """Returns an exact model with friction, and a recording at 1 kHz in joint coordinates.

    Args:
        name: Name of the arm.
        seconds: Duration [s].
        force: Force (3,) at the hand frame, in the base frame [N].
        at_rest: Whether the arm stays at one pose, with its friction at 0.
    """
    arm = load_arm(name)
    motion = fourier_motion(arm, np.random.default_rng(1000), 6.5, seconds, 1000.0)
    dynamics = true_dynamics(arm, np.random.default_rng(0), friction_everywhere(arm, motion))
    t, q, v, vd = motion
    if at_rest:
        q, v, vd = np.tile(q[0], (len(t), 1)), 0 * v, 0 * vd
    statistics = [
        ActuatorStatistics(joint, 1.0, ERROR * limit, ERROR * limit)
        for joint, limit in zip(arm.joint_names, arm.effort_limits.tolist(), strict=True)
    ]
    section = dataclasses.replace(dynamics.section, actuators=statistics)
    model = dataclasses.replace(IdentifiedModel.from_arm(arm), dynamics=section)
    of_tip = Contact(arm)
    tau = arm.transmission.pull_back_effort(dynamics.effort(q, v, vd))
    tau -= np.array([np.asarray(force) @ of_tip.jacobian(pose) for pose in q])
    return model, Recording(q=q, qd=v, tau=tau, t=t, source="pushed.csv")
