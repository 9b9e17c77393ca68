"""Creates recordings without faults of a motion with known efforts: inverse dynamics and friction."""

from __future__ import annotations

from functools import cache

import numpy as np

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import inverse_dynamics
from dvrk_drake.recordings.recording import Recording

RATE, PERIOD, PASSES = 200.0, 6.0, 4
#: White noise of the efforts, as a fraction of their RMS.
EFFORT_NOISE = 0.01
#: Approximate Coulomb and viscous friction of each actuator, each as a fraction of the RMS of the rigid-body effort.
FRICTION = 0.2


def trajectory(arm: Arm, t: np.ndarray, period: float = PERIOD, seed: int = 1) -> tuple[np.ndarray, ...]:
    """Returns q, v, vd (m, n): a Fourier series of five harmonics per joint, over 60 % of each range."""
    generator = np.random.default_rng(seed)
    n = arm.num_joints
    amplitude = generator.uniform(0.3, 1.0, (5, n)) / np.arange(1, 6)[:, None]
    phase = generator.uniform(0, 2 * np.pi, (5, n))
    w = 2 * np.pi * np.arange(1, 6)[:, None, None] / period
    angle = w * t[:, None] + phase[:, None, :]
    q = np.sum(amplitude[:, None] * np.sin(angle), axis=0)
    v = np.sum(amplitude[:, None] * w * np.cos(angle), axis=0)
    vd = -np.sum(amplitude[:, None] * w**2 * np.sin(angle), axis=0)
    middle, half = (arm.position_upper + arm.position_lower) / 2, (arm.position_upper - arm.position_lower) / 2
    scale = 0.6 * np.minimum(half, 2.0) / np.max(np.abs(q), axis=0)
    return middle + scale * q, scale * v, scale * vd


@cache
def efforts(name: str, period: float = PERIOD) -> tuple[np.ndarray, ...]:
    """Returns t, q, v, tau (joint coordinates) for PASSES * PERIOD seconds, sampled at 5 RATE."""
    arm = load_arm(name)
    t = np.arange(0, PASSES * PERIOD, 0.2 / RATE)
    coarse = t[::5]
    q, v, vd = trajectory(arm, coarse, period)
    rigid = inverse_dynamics(arm, q, v, vd)
    a_rigid = arm.transmission.inverse.pull_back_effort(rigid)
    fine = np.column_stack([np.interp(t, coarse, x) for x in a_rigid.T])
    q, v, _ = trajectory(arm, t, period)
    v_act = arm.transmission.velocity(v)
    speed = np.sqrt(np.mean(v_act**2, axis=0))
    size = np.maximum(np.sqrt(np.mean(a_rigid**2, axis=0)), 1e-3)
    friction = FRICTION * size * (np.tanh(v_act / (0.02 * speed)) + v_act / speed)
    return t, q, v, arm.transmission.pull_back_effort(fine + friction)


def clean_motion(name: str = "psm", **options) -> Recording:
    """Returns a recording at 200 Hz. Its efforts have white noise."""
    t, q, v, tau = (x[::5] for x in efforts(name, **options))
    noise = np.random.default_rng(2).normal(size=tau.shape) * EFFORT_NOISE * np.sqrt(np.mean(tau**2, axis=0))
    return Recording(q, tau + noise, v, t, source="motion.csv")
