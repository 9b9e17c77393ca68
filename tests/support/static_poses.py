"""Simulated motion between static poses with known torques."""

import itertools

import numpy as np

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.recordings.recording import Recording

RATE = 200.0


def motion_with_pauses(arm, poses, generator, travel=2.0, rest=0.4, rate=RATE):
    """Returns a motion with a pause at each pose. The torques are gravity plus viscous friction."""
    t_travel, t_rest = np.arange(0, travel, 1 / rate), np.arange(0, rest, 1 / rate)
    s = t_travel / travel
    blend = 10 * s**3 - 15 * s**4 + 6 * s**5
    q = [np.tile(poses[0], (len(t_rest), 1))]
    for a, b in itertools.pairwise(poses):
        q += [a + blend[:, None] * (b - a), np.tile(b, (len(t_rest), 1))]
    q = np.vstack(q)
    qd = np.gradient(q, 1 / rate, axis=0)
    tau = IdentifiedModel.from_arm(arm).holding_torque(q) + 0.05 * arm.effort_limits * qd
    tau += 1e-3 * arm.effort_limits * generator.normal(size=tau.shape)
    return Recording(q=q, qd=qd, tau=tau, t=np.arange(len(q)) / rate)
