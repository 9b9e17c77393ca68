"""Computes the efforts of an arm in motion from its identified links, rotors and drive effects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault, position_along
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.dynamic_section import DynamicSection
from dvrk_drake.dynamics.inertial_parameters import PARAMETER_NAMES, LinkInertia, pseudo_inertia
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS, POSITION_KINDS, half_width
from dvrk_drake.models.ranges import number_fault


def effect_shapes(
    regressor: DynamicRegressor,
    effects: Sequence[ActuatorEffect],
    q: ArrayLike,
    v: ArrayLike,
    transmitted: NDArray[np.float64] | None = None,
) -> Iterator[NDArray[np.float64]]:
    """Yields the shape (m,) of each effect, which is its effort along its coordinate for a coefficient of 1.

    Effects with a state start from state 0.

    The coordinate is x = h a for actuator positions a. The load of the coordinate is |h tau| / (h h) for efforts tau
    that the drives of the actuators transmit.

    Args:
        regressor: Regressor of the arm.
        effects: Effects in the drive.
        q, v: Positions [rad, m] and velocities (m, n) of the joints, evenly sampled.
        transmitted: Efforts (m, n) that the drives transmit [N m, N]. If None, the efforts that compensate gravity
            according to the SDF.
    """
    arm, q = regressor.arm, np.asarray(q, dtype=np.float64)
    a, a_dot = arm.transmission.position(q), arm.transmission.velocity(v)
    rows = arm.effect_coordinates
    if transmitted is None:
        transmitted = nominal_weight(regressor, q) if is_loaded(effects) else np.zeros_like(a)
    motion: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
    for effect in effects:
        h = rows[effect.coordinate]
        if effect.coordinate not in motion:
            # Effects of one coordinate follow each other, so only the motion of the last one is kept.
            motion = {effect.coordinate: (a @ h, a_dot @ h)}
        load = np.abs(transmitted @ h) / (h @ h) if is_loaded([effect]) else 0.0
        yield effect.column(*motion[effect.coordinate], load)


def is_loaded(effects: Iterable[ActuatorEffect]) -> bool:
    """Returns whether an effect depends on the load."""
    return any(EFFECT_KINDS[effect.kind].loaded for effect in effects)


def transmitted_effort(
    arm: Arm,
    rigid: NDArray[np.float64],
    effects: Sequence[ActuatorEffect],
    coefficients: NDArray[np.float64],
    q: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Returns the efforts (m, n) that the drives of the actuators transmit [N m, N].

    These are the efforts of the rigid bodies, cables and springs. Friction and offsets are excluded: an offset may be
    an error of the motor current.

    Args:
        arm: Arm of the effects.
        rigid: Efforts (m, n) of the rigid bodies at the actuators [N m, N].
        effects: Effects in the drive.
        coefficients: Coefficients (e,) of the effects.
        q: Positions (m, n) of the joints [rad, m].
    """
    tau = rigid
    for effect, coefficient in zip(effects, coefficients, strict=True):
        if EFFECT_KINDS[effect.kind].role == "position" and coefficient:
            x = position_along(arm, effect.coordinate, q)
            tau = tau + coefficient * effect.column(x, 0 * x)[:, None] * arm.effect_coordinates[effect.coordinate]
    return tau


def nominal_weight(regressor: DynamicRegressor, q: ArrayLike) -> NDArray[np.float64]:
    """Returns the actuator efforts (m, n) [N m, N] that compensate gravity at poses q (m, n), according to the SDF."""
    rest = np.zeros_like(q, dtype=np.float64)
    return regressor.arm.transmission.inverse.pull_back_effort(regressor.torque(q, rest, rest, regressor.values))


#: Largest effort that is a rounding error, e.g. of efforts that cancel [N m, N]. The largest gravity efforts of
#: the actuators of this package's arms are either above 7e-4 or below 1e-16.
ROUNDING_EFFORT = 1e-9
#: Number of random poses at which the gravity efforts are compared with `ROUNDING_EFFORT`. One pose would be
#: sufficient, unless an effort is 0 there by chance.
WEIGHING_POSES = 20


class DynamicModel:
    """Dynamic model of one arm: tau_actuator = J'^-1 Y(q, v, vd) phi + sum of effects.

    J is the matrix of `Arm.transmission`.

    Attributes:
        arm: Arm of the model, with the gravity vector of `section`.
        section: Section of the model file that contains the parameters.
        regressor: Regressor of the rigid-body dynamics.
        parameters: Parameters phi (p,) of `regressor`.
        effects: Effects in the order of `coefficients`.
        coefficients: Coefficients (e,) of the effects.
    """

    def __init__(self, arm: Arm, section: DynamicSection) -> None:
        """Creates the model from a section of a model file.

        Raises:
            ModelError: The section does not match the arm.
        """
        self.arm = arm.with_gravity(section.gravity)
        self.section = section
        self.regressor = DynamicRegressor(self.arm)
        check_section(self.regressor, section)
        phi = [x for link in section.links for x in link.parameters] + [rotor.value for rotor in section.rotors]
        # Parameters that couple two rotors are 0, because real motors have no such coupling (see `rotor_inertias`).
        self.parameters = np.concatenate([phi, np.zeros(len(self.regressor.values) - len(phi))])
        self.effects = tuple(map(ActuatorEffect.of, section.effects))
        self.coefficients = np.array([e.coefficient for e in section.effects])

    @cached_property
    def links(self) -> tuple[LinkInertia, ...]:
        """Identified links, for use in a plant or an SDF."""
        return tuple(LinkInertia(link.link, np.array(link.parameters)) for link in self.section.links)

    @cached_property
    def holding_effects(self) -> tuple[int, ...]:
        """Indices of the effects that have the same torque at rest and in motion.

        These are the position-dependent effects, except the offset of an actuator that is loaded by gravity. Such an
        offset can be caused by an error of the gravity model or by direction-dependent friction, so the offset may be
        wrong at rest. If the actuator also has the effect "cable cosine", the offset is part of the cable torque and is
        included.
        """
        arm = self.arm.with_gravity(self.section.gravity_expected or self.section.gravity)
        poses = arm.sample_poses(WEIGHING_POSES, np.random.default_rng(0))
        weight = np.abs(nominal_weight(DynamicRegressor(arm), poses)).max(axis=0)
        excluded = {f"actuator.{name}" for name, w in zip(arm.joint_names, weight, strict=True) if w > ROUNDING_EFFORT}
        excluded -= {e.coordinate for e in self.effects if e.kind == "cable cosine"}
        return tuple(
            i
            for i, e in enumerate(self.effects)
            if e.kind in POSITION_KINDS and (e.kind != "offset" or e.coordinate not in excluded)
        )

    @cached_property
    def half_width(self) -> NDArray[np.float64]:
        """Half widths (n,) of the 95 % prediction intervals of the actuator efforts after low-pass filtering [N m, N].

        They are 1.96 times the RMS error on held-out parts of the recording, and apply to similar motions of the same
        day. For a model of several recordings, the held-out parts are whole recordings, so the variance between their
        days is included. They are 0 for a model without this error.
        """
        return half_width(1.0, None) * self._statistics("rms_cross_validation")

    def _statistics(self, which: str) -> NDArray[np.float64]:
        """Returns a field (n,) of `ActuatorStatistics` for each actuator, 0 if it is unknown."""
        values = {a.name: getattr(a, which) for a in self.section.actuators}
        return np.array([values.get(name, 0.0) for name in self.arm.joint_names])

    def error_covariance(self, *, other_day: bool = False) -> NDArray[np.float64]:
        """Returns the covariance (n, n) of the errors of the actuator efforts, for motions as in `half_width`.

        Args:
            other_day: True for another day. The variance then contains the assumed variance between days
                (`ActuatorStatistics.rms_between_days`), which is independent for each actuator.

        Raises:
            ModelError: The model does not state the errors, e.g. because it was not identified.
        """
        if not np.all(self.half_width > 0):
            raise ModelError("the model does not state its errors on held-out motions; use a model from identify")
        return self._error_covariance(other_day)

    def _error_covariance(self, other_day: bool) -> NDArray[np.float64]:
        correlation = self.section.error_correlation
        deviation = self._statistics("rms_cross_validation")
        covariance = np.outer(deviation, deviation) * (np.eye(len(deviation)) if correlation is None else correlation)
        if other_day:
            covariance += np.diag(self._statistics("rms_between_days") ** 2)
        return np.asarray(covariance)

    def combined_half_width(self, combinations: NDArray[np.float64], *, other_day: bool = False) -> NDArray[np.float64]:
        """Returns the half widths (k,) of the prediction intervals of linear combinations of the actuator efforts.

        They are 0 if the half width of an actuator in the combination is unknown.

        Args:
            combinations: Coefficients (k, n), e.g. the transposed matrix of `Arm.transmission` for the joint efforts.
            other_day: True for the intervals on another day, see `error_covariance`.
        """
        squares = np.sum(combinations @ self._error_covariance(other_day) * combinations, axis=1)
        is_known = np.all((combinations == 0) | (self.half_width > 0), axis=1)
        return np.where(is_known, half_width(1.0, None) * np.sqrt(np.maximum(squares, 0.0)), 0.0)

    def rigid_body_effort(self, q: ArrayLike, v: ArrayLike, vd: ArrayLike) -> NDArray[np.float64]:
        """Returns the actuator efforts (m, n) [N m, N] without effects for a joint motion (m, n)."""
        tau = self.regressor.torque(q, v, vd, self.parameters)
        return self.arm.transmission.inverse.pull_back_effort(tau)

    def transmitted_effort(self, q: ArrayLike, v: ArrayLike, vd: ArrayLike) -> NDArray[np.float64]:
        """Returns the actuator efforts (m, n) [N m, N] that load the drives, see `transmitted_effort`."""
        rigid = self.rigid_body_effort(q, v, vd)
        return transmitted_effort(self.arm, rigid, self.effects, self.coefficients, np.asarray(q, dtype=np.float64))

    def effect_shapes(self, q: ArrayLike, v: ArrayLike, vd: ArrayLike) -> Iterator[NDArray[np.float64]]:
        """Yields the shape (m,) of each of `effects` for an evenly sampled joint motion, see `effect_shapes`."""
        transmitted = self.transmitted_effort(q, v, vd) if is_loaded(self.effects) else None
        return effect_shapes(self.regressor, self.effects, q, v, transmitted)

    def effect_effort(self, q: ArrayLike, v: ArrayLike, vd: ArrayLike) -> NDArray[np.float64]:
        """Returns the actuator efforts (m, n) [N m, N] due to effects for an evenly sampled joint motion."""
        rows = self.arm.effect_coordinates
        tau = np.zeros(np.shape(q))
        for effect, coefficient, shape in zip(
            self.effects, self.coefficients, self.effect_shapes(q, v, vd), strict=True
        ):
            tau += coefficient * shape[:, None] * rows[effect.coordinate]
        return tau

    def effort(self, q: ArrayLike, v: ArrayLike, vd: ArrayLike) -> NDArray[np.float64]:
        """Returns the actuator efforts (m, n) [N m, N] for an evenly sampled joint motion (m, n).

        Effects with a state start from state 0 at the first sample. Presliding effects with a small travel require a
        sampling rate of 400 Hz or more.
        """
        return self.rigid_body_effort(q, v, vd) + self.effect_effort(q, v, vd)

    def mass_matrix(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns the mass matrix M (m, n, n) of the joints, including rotors, at poses q (m, n)."""
        return self.regressor.mass_matrix(q, self.parameters)


def check_section(regressor: DynamicRegressor, section: DynamicSection) -> None:
    """Raises ModelError unless the section matches the arm and its links are physically consistent."""
    arm = regressor.arm
    if fault := number_fault(section):
        raise ModelError(f"dynamics.{fault}")
    if [link.link for link in section.links] != [link.link for link in regressor.links]:
        raise ModelError(
            f"dynamics.links must have these links in this order: {', '.join(link.link for link in regressor.links)}"
        )
    for link in section.links:
        if len(link.parameters) != len(PARAMETER_NAMES):
            raise ModelError(f"dynamics: {link.link} must have ten parameters: {', '.join(PARAMETER_NAMES)}")
        least = float(np.linalg.eigvalsh(pseudo_inertia(link.parameters))[0])
        if not least > 0:
            raise ModelError(
                f"dynamics: the inertia of {link.link} is not physically consistent: the smallest eigenvalue of its "
                f"pseudo-inertia is {least:.2g}, but must be positive"
            )
    if [rotor.actuator for rotor in section.rotors] != list(arm.joint_names):
        raise ModelError(f"dynamics.rotors must have these actuators in this order: {', '.join(arm.joint_names)}")
    n, correlation = arm.num_joints, section.error_correlation
    if correlation is not None and [len(row) for row in correlation] != [n] * n:
        raise ModelError(f"dynamics.error_correlation must have {n} rows of {n} numbers")
    _check_effects(arm, section)
    settings = section.signals
    for which, values in (
        ("acceleration_cut_off", settings.acceleration_cut_off),
        ("effort_delay", settings.effort_delay),
    ):
        if len(values) != arm.num_joints:
            raise ModelError(f"dynamics.signals: {which} must have {arm.num_joints} numbers")


def _check_effects(arm: Arm, section: DynamicSection) -> None:
    for i, effect in enumerate(section.effects):
        if fault := effect_fault(arm, ActuatorEffect.of(effect), coefficient=effect.coefficient):
            raise ModelError(f"dynamics.effects[{i}]: {fault}")
