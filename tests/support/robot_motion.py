"""Recordings of the robots of `robot_file`."""

import numpy as np

from dvrk_drake.models.plant import inverse_dynamics
from dvrk_drake.recordings.recording import Recording

#: Rotor inertias [kg m^2, kg] that the model file does not state, and Coulomb friction [N m, N].
ROTORS, FRICTION = np.array([0.8, 5.0, 0.05]), np.array([1.5, 3.0, 0.4])
#: Middle and size of the motion of each joint [rad, m].
MIDDLE, SIZE = np.array([0.0, 0.15, 0.2]), np.array([0.25, 0.025, 0.18])


def robot_motion(
    arm,
    seed=0,
    seconds=15.0,
    middle=MIDDLE,
    size=SIZE,
    rotors=ROTORS,
    friction=FRICTION,
    noise=(0.3, 0.5, 0.05),
    inertias=None,
):
    """Recording of a motion at 100 Hz, with rotors, friction and noise, at the mounting of the arm."""
    generator = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.01)
    phases = generator.uniform(0, 2 * np.pi, (5, 3))
    w = 2 * np.pi * np.array([0.1, 0.2, 0.35, 0.5, 0.8])[:, None, None]
    angles = w * t[:, None] + phases[:, None, :]
    q = middle + size * np.sum(np.sin(angles), axis=0)
    v, vd = size * np.sum(w * np.cos(angles), axis=0), -size * np.sum(w**2 * np.sin(angles), axis=0)
    tau = inverse_dynamics(arm, q, v, vd, inertias) + rotors * vd + friction * np.tanh(v / 0.02)
    tau += generator.normal(size=tau.shape) * np.array(noise)
    return Recording(q=q, qd=v, tau=tau, t=t, source=f"motion_{seed}.csv")


def random_motion(arm, seed=0, inertias=None):
    """Recording of a motion of an arm of any size: friction is 2 % of the effort limits, noise 0.2 %, no rotors."""
    size = np.where(arm.prismatic, 0.05 * arm.position_upper, 0.18)
    share = arm.effort_limits
    return robot_motion(
        arm, seed, middle=0.0, size=size, rotors=0.0, friction=0.02 * share, noise=0.002 * share, inertias=inertias
    )
