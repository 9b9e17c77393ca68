"""An identified arm's efforts in motion: its links, rotors and the effects in its drive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.actuator_effects import (
    EFFECT_KINDS,
    POSITION_KINDS,
    ActuatorEffect,
    effect_fault,
)
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.dynamic_section import DynamicSection
from dvrk_drake.dynamics.inertial_parameters import PARAMETER_NAMES, LinkInertia, pseudo_inertia
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.schema_fault import number_fault


def effect_shapes(
    regressor: DynamicRegressor, effects: Sequence[ActuatorEffect], q: ArrayLike, v: ArrayLike
) -> Iterator[NDArray[np.float64]]:
    """(m,) shape of each effect along its coordinate x = h a, from state 0.

    The load of a coordinate is the effort f along it that bears the arm's weight as the SDF states it: of the efforts
    tau of the actuators at rest the part h f, f = h tau / h h.

    Args:
        regressor: of the arm.
        effects: in its drives.
        q, v: (m, n) positions and velocities of the joints [rad, m], evenly sampled.
    """
    arm, q = regressor.arm, np.asarray(q, dtype=np.float64)
    a, a_dot = arm.transmission.position(q), arm.transmission.velocity(v)
    rows = arm.effect_coordinates
    weight = np.zeros_like(a)
    if any(EFFECT_KINDS[effect.kind].loaded for effect in effects):
        weight = nominal_weight(regressor, q)
    for effect in effects:
        h = rows[effect.coordinate]
        yield effect.column(a @ h, a_dot @ h, np.abs(weight @ h) / (h @ h))


def nominal_weight(regressor: DynamicRegressor, q: ArrayLike) -> NDArray[np.float64]:
    """(m, n) efforts of the actuators [N m, N] that bear the arm's weight at poses q (m, n), as the SDF states it."""
    rest = np.zeros_like(q, dtype=np.float64)
    return regressor.arm.transmission.inverse.pull_back_effort(regressor.torque(q, rest, rest, regressor.values))


#: An actuator that needs no more than this at so many poses bears no weight [N m, N].
MIN_WEIGHT, WEIGHING_POSES = 1e-9, 20


class DynamicModel:
    """tau_actuator = J'^-1 Y(q, v, vd) phi + sum of effects, of one arm.

    Attributes:
        arm: whose model it is, mounted as the section says.
        section: the numbers.
        regressor: of the rigid bodies.
        parameters: (p,) phi, for `regressor`.
        effects: in the order of `coefficients`.
        coefficients: (e,).
    """

    def __init__(self, arm: Arm, section: DynamicSection) -> None:
        """Puts the numbers together.

        Raises:
            ModelError: they are not of this arm.
        """
        self.arm = arm.with_gravity(section.gravity)
        self.section = section
        self.regressor = DynamicRegressor(self.arm)
        check_section(self.regressor, section)
        phi = [x for link in section.links for x in link.parameters] + [rotor.value for rotor in section.rotors]
        # Columns that couple two rotors belong to no motor, see `rotor_inertias`.
        self.parameters = np.concatenate([phi, np.zeros(len(self.regressor.values) - len(phi))])
        self.effects = tuple(map(ActuatorEffect.of, section.effects))
        self.coefficients = np.array([e.coefficient for e in section.effects])

    @cached_property
    def links(self) -> tuple[LinkInertia, ...]:
        """The identified links, to be written into a plant or an SDF."""
        return tuple(LinkInertia(link.link, np.array(link.parameters)) for link in self.section.links)

    @cached_property
    def holding_effects(self) -> tuple[int, ...]:
        """Which effects act at rest as they do in motion.

        Those of position alone, but for the offset of an actuator that bears weight: weight that is not modelled quite
        right looks like one, and so does friction that differs by direction (the -0.22 N m at the shoulder of the
        public MTM are not there at rest; the -0.07 N m at its outer yaw are). Where the coordinate has a cable's
        cosine, the offset is part of that curve, and stays.
        """
        arm = self.arm.with_gravity(self.section.gravity_expected or self.section.gravity)
        poses = arm.sample_poses(WEIGHING_POSES, np.random.default_rng(0))
        weight = np.abs(nominal_weight(DynamicRegressor(arm), poses)).max(axis=0)
        left_out = {f"actuator.{name}" for name, w in zip(arm.joint_names, weight, strict=True) if w > MIN_WEIGHT}
        left_out -= {e.coordinate for e in self.effects if e.kind == "cable cosine"}
        return tuple(
            i
            for i, e in enumerate(self.effects)
            if e.kind in POSITION_KINDS and (e.kind != "offset" or e.coordinate not in left_out)
        )

    def rigid_body_effort(self, q: ArrayLike, v: ArrayLike, vd: ArrayLike) -> NDArray[np.float64]:
        """(m, n) efforts of the actuators [N m, N] without effects, from motions (m, n) of the joints."""
        tau = self.regressor.torque(q, v, vd, self.parameters)
        return self.arm.transmission.inverse.pull_back_effort(tau)

    def effect_effort(self, q: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
        """(m, n) efforts of the actuators [N m, N] against the effects, over an evenly sampled motion of the joints."""
        rows = self.arm.effect_coordinates
        tau = np.zeros(np.shape(q))
        shapes = effect_shapes(self.regressor, self.effects, q, v)
        for effect, coefficient, shape in zip(self.effects, self.coefficients, shapes, strict=True):
            tau += coefficient * shape[:, None] * rows[effect.coordinate]
        return tau

    def effort(self, q: ArrayLike, v: ArrayLike, vd: ArrayLike) -> NDArray[np.float64]:
        """(m, n) efforts of the actuators [N m, N] over an evenly sampled motion of the joints (m, n).

        Effects with memory start at rest with the first sample; sample at 400 Hz or more, or fine ones are missed.
        """
        return self.rigid_body_effort(q, v, vd) + self.effect_effort(q, v)

    def mass_matrix(self, q: ArrayLike) -> NDArray[np.float64]:
        """M (m, n, n) of the joints, rotors included, at poses q (m, n)."""
        return self.regressor.mass_matrix(q, self.parameters)


def check_section(regressor: DynamicRegressor, section: DynamicSection) -> None:
    """Raises ModelError unless the section fits the arm, has bodies that can exist, and settings for every actuator."""
    arm = regressor.arm
    if fault := number_fault(section):
        raise ModelError(f"dynamics.{fault}")
    if [link.link for link in section.links] != [link.link for link in regressor.links]:
        raise ModelError(f"dynamics.links must be, in this order: {', '.join(link.link for link in regressor.links)}")
    for link in section.links:
        if len(link.parameters) != len(PARAMETER_NAMES):
            raise ModelError(f"dynamics: {link.link} must have ten numbers: {', '.join(PARAMETER_NAMES)}")
        least = float(np.linalg.eigvalsh(pseudo_inertia(link.parameters))[0])
        if not least > 0:
            raise ModelError(
                f"dynamics: no body has the inertia of {link.link}: least eigenvalue {least:.2g} of its pseudo-inertia"
            )
    if [rotor.actuator for rotor in section.rotors] != list(arm.joint_names):
        raise ModelError(f"dynamics.rotors must be, in this order: {', '.join(arm.joint_names)}")
    _check_effects(arm, section)
    settings = section.signals
    for which, values in (("acceleration_cut_off", settings.acceleration_cut_off), ("delay", settings.effort_delay)):
        if len(values) != arm.num_joints:
            raise ModelError(f"dynamics.signals: {which} must have {arm.num_joints} numbers")


def _check_effects(arm: Arm, section: DynamicSection) -> None:
    for i, effect in enumerate(section.effects):
        where, law = f"dynamics.effects[{i}]", ActuatorEffect.of(effect)
        if fault := effect_fault(arm, law):
            raise ModelError(f"{where}: {fault}")
        if law.dissipative and effect.coefficient < 0:
            raise ModelError(f"{where}: coefficient is {effect.coefficient:g}; of friction 0 or more")
