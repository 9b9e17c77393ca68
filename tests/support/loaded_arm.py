"""Recordings of a simulated arm on two days, with a known payload on the second day."""

from __future__ import annotations

import dataclasses

import numpy as np
from motions import fourier_motion, recorded, true_dynamics

from dvrk_drake.analysis.estimation.point_mass import point_mass_parameters
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.dynamic_section import DynamicSection
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.recordings.recording import Recording

RATE = 1000.0
#: White noise of the efforts, as a fraction of their RMS.
NOISE = 0.02
#: Dry and viscous friction, each as a fraction of the RMS effort without friction. On the second day both differ by
#: FRICTION_CHANGE (RMS).
FRICTION, FRICTION_CHANGE = 0.15, 0.2
#: Additional offset, spring and cable torque on the second day, each as a fraction of the RMS effort.
DRIVE_CHANGE = 0.03


def friction(model: DynamicModel, q, v, vd) -> list[DriveEffect]:
    """Returns viscous, Coulomb and presliding friction at every actuator."""
    arm = model.arm
    effort = np.sqrt(np.mean(model.effort(q, v, vd) ** 2, axis=0))
    speed, travel = arm.transmission.velocity(v).std(axis=0), arm.transmission.position(q).std(axis=0)
    effects = []
    for i, joint in enumerate(arm.joint_names):
        at, size = f"actuator.{joint}", float(FRICTION * effort[i])
        effects += [
            DriveEffect(at, "viscous", 0.0, size / float(speed[i])),
            DriveEffect(at, "coulomb", float(f"{0.05 * speed[i]:.3g}"), size / 2),
            DriveEffect(at, "presliding", float(f"{0.05 * travel[i]:.3g}"), size / 2),
        ]
    return effects


def other_day(model: DynamicModel, q, v, vd, generator: np.random.Generator) -> DynamicSection:
    """Returns the dynamics with scaled friction and additional offsets, springs and cable torques."""
    effort = np.sqrt(np.mean(model.effort(q, v, vd) ** 2, axis=0))
    effects = []
    for joint in model.arm.joint_names:
        scale = {part: float(np.exp(FRICTION_CHANGE * generator.normal())) for part in ("dry", "viscous")}
        for effect in model.section.effects:
            if effect.coordinate == f"actuator.{joint}":
                part = "viscous" if effect.kind == "viscous" else "dry"
                effects.append(dataclasses.replace(effect, coefficient=effect.coefficient * scale[part]))
    a = model.arm.transmission.position(q)
    for i, joint in enumerate(model.arm.joint_names):
        offset, spring = DRIVE_CHANGE * effort[i] * generator.normal(size=2)
        spring /= np.std(a[:, i])
        effects.append(DriveEffect(f"actuator.{joint}", "spring", float(2 * np.max(np.abs(a[:, i]))), float(spring)))
        effects.append(DriveEffect(f"actuator.{joint}", "offset", 0.0, float(offset - spring * np.mean(a[:, i]))))
        if not model.arm.prismatic[i]:
            cable = DRIVE_CHANGE * effort[i] * generator.normal()
            effects.append(DriveEffect(f"actuator.{joint}", "cable sine", 2.0, float(cable)))
    return dataclasses.replace(model.section, effects=effects)


def with_payload(section: DynamicSection, link: str, mass: float, place) -> DynamicSection:
    """Returns the dynamics with an additional point mass on a link."""
    added = point_mass_parameters(mass, np.asarray(place, dtype=float))
    links = [
        dataclasses.replace(own, parameters=[float(x) for x in np.array(own.parameters) + added])
        if own.link == link
        else own
        for own in section.links
    ]
    return dataclasses.replace(section, links=links)


def two_days(
    name: str, link: str, mass: float, place, seed: int, *, noise: float = NOISE
) -> tuple[DynamicModel, Recording, Recording]:
    """Returns the model and the recording of the first day, and the recording of the second day with a payload.

    The motions differ slightly, because the payload causes a control error.
    """
    arm, generator = load_arm(name), np.random.default_rng(seed)
    t, q, v, vd = fourier_motion(arm, np.random.default_rng(1000), 6.5, 26.0, RATE)
    bare = true_dynamics(arm, np.random.default_rng(seed), [])
    first = DynamicModel(arm, dataclasses.replace(bare.section, effects=friction(bare, q, v, vd)))
    second = DynamicModel(arm, with_payload(other_day(first, q, v, vd, generator), link, mass, place))
    deviation = 1 + 0.02 * generator.normal(size=arm.num_joints)
    center = np.mean(q, axis=0)
    other = (t, center + deviation * (q - center), deviation * v, deviation * vd)
    return first, recorded(first, (t, q, v, vd), noise, generator), recorded(second, other, noise, generator)
