"""Motions of simulated arms with known dynamics."""

from __future__ import annotations

import numpy as np

from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.dynamic_section import DynamicSection, LinkEstimate, RotorEstimate, SignalSettings
from dvrk_drake.dynamics.inertial_parameters import parameters_from_pseudo_inertia, rotor_links
from dvrk_drake.dynamics.physical_consistency import LinkScale, bounding_boxes, reached_bounds
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.recordings.recording import Recording


def fourier_motion(arm: Arm, generator: np.random.Generator, period: float, seconds: float, rate: float):
    """Returns t (m,) and q, v, vd (m, n) of a motion within the limits that repeats after `period` [s]."""
    t = np.arange(round(seconds * rate)) / rate
    center = arm.sample_poses(400, generator, margin=0.2).mean(axis=0)
    amplitude = 0.5 * (arm.position_upper - arm.position_lower)
    amplitude = np.minimum(amplitude, arm.per_joint(2.0, 0.1))
    harmonics = np.arange(1, 6)
    a, b = generator.normal(size=(2, arm.num_joints, len(harmonics))) / harmonics
    w = 2 * np.pi * harmonics / period
    sines, cosines = np.sin(w * t[:, None]), np.cos(w * t[:, None])
    shape = sines @ a.T + cosines @ b.T
    size = amplitude / np.abs(shape).max(axis=0)
    while any(arm.limit_violations(q) for q in (center + size * shape)[::20]):
        size *= 0.9
    v = (w * cosines) @ a.T - (w * sines) @ b.T
    return t, center + size * shape, size * v, size * (-(w**2 * sines) @ a.T - (w**2 * cosines) @ b.T)


def true_dynamics(
    arm: Arm, generator: np.random.Generator, effects: list[DriveEffect], spread: float = 0.05
) -> DynamicModel:
    """Returns a model whose links are sheared and shifted relative to the SDF by about `spread` times their size."""
    regressor, boxes = DynamicRegressor(arm), bounding_boxes(arm)
    links = []
    for link in regressor.links:
        size = np.array([*[LinkScale.of(link).length] * 3, 1.0])
        for share in spread * 0.95 ** np.arange(1000):
            T = np.eye(4) + share * generator.normal(size=(4, 4)) * np.outer(size, 1 / size)
            T[3, :3] = 0.0
            T[:3, 3] *= link.link not in rotor_links(arm)  # a rotor is balanced
            phi = parameters_from_pseudo_inertia(T @ link.pseudo_inertia() @ T.T)
            if not reached_bounds(phi, link, boxes[link.link]):
                break
        links.append(LinkEstimate(link.link, [float(x) for x in phi]))
    rotors = [
        RotorEstimate(name, float(rotor.value * generator.uniform(0.8, 1.2)))
        for name, rotor in zip(arm.joint_names, regressor.rotors, strict=False)
    ]
    n = arm.num_joints
    settings = SignalSettings(50.0, [20.0] * n, arm.identification.effort_cut_off, [0.0] * n)
    return DynamicModel(arm, DynamicSection([float(g) for g in arm.gravity], links, rotors, effects, [], settings))


def recorded(
    model: DynamicModel, motion, noise: float, generator: np.random.Generator, rate: float = 200.0
) -> Recording:
    """Returns a recording at `rate` [Hz] of a motion that is sampled at 1 kHz.

    `noise` is the standard deviation of the efforts, as a fraction of their RMS. The delay of the efforts is that of
    the arm file.
    """
    t, q, v, vd = motion
    J = model.arm.transmission
    delayed = zip(model.arm.identification.effort_delay, model.effort(q, v, vd).T, strict=True)
    tau = np.column_stack([np.interp(t - delay, t, effort) for delay, effort in delayed])
    tau = tau + noise * np.sqrt(np.mean(tau**2, axis=0)) * generator.normal(size=tau.shape)
    every = slice(None, None, round(1000 / rate))
    return Recording(q=q[every], qd=v[every], tau=J.pull_back_effort(tau)[every], t=t[every], source="simulated")


def friction_everywhere(arm: Arm, motion, share: float = 0.2) -> list[DriveEffect]:
    """Returns viscous, Coulomb and presliding friction at every actuator, each `share` times the RMS effort."""
    _, q, v, vd = motion
    without = true_dynamics(arm, np.random.default_rng(0), [])
    effort = np.sqrt(np.mean(without.effort(q, v, vd) ** 2, axis=0))
    speed, travel = arm.transmission.velocity(v).std(axis=0), arm.transmission.position(q).std(axis=0)
    effects = []
    for i, joint in enumerate(arm.joint_names):
        at, size = f"actuator.{joint}", float(share * effort[i])
        effects += [
            DriveEffect(at, "viscous", 0.0, float(size / speed[i])),
            DriveEffect(at, "coulomb", float(f"{0.1 * speed[i]:.3g}"), size),
            DriveEffect(at, "presliding", float(f"{0.08 * travel[i]:.3g}"), size),
        ]
    return effects
