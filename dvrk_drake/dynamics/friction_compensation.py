"""Limits of the compensation of friction by a controller, so that an arm at rest does not move, and of mode guide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog
from scipy.sparse.csgraph import connected_components

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault, is_prismatic, joint_row
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError, ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS, half_width

#: Largest travel before sliding [rad], [m] of the presliding effects that are assumed to hold the arm at rest. It is
#: the largest drift after a release that is accepted (figures 5, 6 and 8 in docs/benchmark_tables.md).
HOLDING_TRAVEL = 0.015, 0.0015
#: Largest `ActuatorEffect.scale` [rad/s], [m/s] of the Coulomb effects that are assumed to hold the arm at rest. The
#: widest effect of an identified model has 0.4 times the RMS speed of its recording, which is more for most joints of
#: the public motions. With a larger scale, the arm would creep visibly: at 0.1 rad/s if the load is 40 % of the
#: friction.
HOLDING_SPEED = 0.25, 0.025
#: Largest share of the friction that may be compensated. On another day, an arm may have a third less friction than
#: identified (docs/dynamics.md). The compensation must never exceed the actual friction.
MAX_RATIO = 0.6
#: Largest share of the hysteresis effects (see `Friction.springs_back`) that may be compensated. Overcompensation would
#: be a negative spring. The total compensation along a coordinate is limited by `MAX_RATIO` anyway.
MAX_HYSTERESIS_RATIO = 0.9
#: Assumed ratio of the largest error of the holding torque to the leave-one-out RMS error of a model. On simulated
#: arms, the actual ratio is rarely larger.
HOLDING_ERROR_FACTOR = 2.0


@dataclass(frozen=True)
class Friction:
    """Friction in the drive of an arm, as a sum of dissipative effects.

    Attributes:
        arm: Arm with this friction.
        effects: Dissipative effects, see `EFFECT_KINDS`.
        coefficients: Nonnegative coefficients (k,) of the effects, in the units of their kinds.
    """

    arm: Arm
    effects: tuple[ActuatorEffect, ...]
    coefficients: NDArray[np.float64]

    @classmethod
    def of(cls, arm: Arm, effects: Sequence[ActuatorEffect], coefficients: ArrayLike) -> Friction:
        """Selects the friction from the effects of an arm. Friction that depends on load or position is omitted.

        Args:
            arm: Arm of the effects.
            effects: Effects of any kind.
            coefficients: Coefficients (k,) of the effects, in the units of their kinds.

        Raises:
            ControllerError: An effect is not valid for the arm, or a friction coefficient is negative or not finite.
        """
        values = np.asarray(coefficients, float)
        if values.shape != (len(effects),):
            raise ControllerError(f"friction: coefficients have shape {values.shape}; allowed: ({len(effects)},)")
        varying = [name for name, kind in EFFECT_KINDS.items() if kind.loaded or kind.position_power]
        kept = [
            k
            for k, effect in enumerate(effects)
            if effect.kind not in EFFECT_KINDS or (effect.dissipative and effect.kind not in varying)
        ]
        for k in kept:
            if fault := effect_fault(arm, effects[k], coefficient=values[k]):
                raise ControllerError(f"friction of {effects[k].coordinate}: {fault}")
        kept = [k for k in kept if values[k] > 0]
        return cls(arm, tuple(effects[k] for k in kept), values[kept])

    @classmethod
    def of_arm(cls, arm: Arm) -> Friction:
        """Returns the friction that the arm's files define, without effects that decrease with speed.

        Compensation of such effects would accelerate a moving arm.

        Raises:
            ControllerError: The files contain no friction.
        """
        effects = [effect for effect in arm.effects.friction if not effect.fall_speed]
        if not effects:
            raise ControllerError(f"friction: the files of {arm.name} contain no friction that can be compensated")
        return cls.of(arm, list(map(ActuatorEffect.of, effects)), [e.coefficient for e in effects])

    @classmethod
    def of_model(cls, model: IdentifiedModel) -> Friction:
        """Returns the friction of a model that was identified from a motion.

        Raises:
            ModelError: The model was identified from poses.
        """
        if model.dynamics is None:
            raise ModelError(
                "friction: a model identified from static poses has no friction; use a model identified from a motion"
            )
        effects = model.dynamics.effects
        return cls.of(model.arm, list(map(ActuatorEffect.of, effects)), [e.coefficient for e in effects])

    @property
    def rows(self) -> NDArray[np.float64]:
        """Matrix (k, n) that maps joint velocities to the velocities of the effects' coordinates. See `joint_row`."""
        return np.array([joint_row(self.arm, e.coordinate) for e in self.effects]).reshape(-1, self.arm.num_joints)

    @property
    def holds(self) -> NDArray[np.bool_]:
        """Mask (k,), True for effects that hold the arm at rest within `HOLDING_TRAVEL`."""
        max_scale = {"coulomb": HOLDING_SPEED, "presliding": HOLDING_TRAVEL}
        return np.array([e.scale <= self._for(e, *max_scale.get(e.kind, (-1.0, -1.0))) for e in self.effects], bool)

    @property
    def springs_back(self) -> NDArray[np.bool_]:
        """Mask (k,), True for presliding effects that can move a released arm back by more than `HOLDING_TRAVEL`."""
        return np.array(
            [e.kind == "presliding" and e.scale > self._for(e, *HOLDING_TRAVEL) for e in self.effects], bool
        )

    def _for(self, effect: ActuatorEffect, revolute: float, prismatic: float) -> float:
        """Returns the value for the type of the effect's coordinate."""
        return prismatic if is_prismatic(self.arm, effect.coordinate) else revolute


def check_ratios(ratio: float, hysteresis_ratio: float = 0.0) -> None:
    """Checks the requested compensation ratios.

    Raises:
        ControllerError: A ratio is below 0 or above its limit, `MAX_RATIO` or `MAX_HYSTERESIS_RATIO`.
    """
    for name, share, largest in (
        ("friction ratio", ratio, MAX_RATIO),
        ("hysteresis ratio", hysteresis_ratio, MAX_HYSTERESIS_RATIO),
    ):
        if not 0 <= share <= largest:
            raise ControllerError(f"{name} must be between 0 and {largest:g}; got {share:g}")


def safe_ratios(
    friction: Friction, ratio: float, holding_error: ArrayLike, hysteresis_ratio: float = 0.0
) -> NDArray[np.float64]:
    """Returns the largest compensation ratios of the effects with which the remaining friction holds the arm.

    The remaining friction must hold the arm at rest for every torque error e with |e_i| <= holding_error_i. This means
    that there are forces f_k along the coordinates with sum row_k' f_k = e and |f_k| <= (1 - ratio_k) coefficient_k.
    The set of errors is a box, so it is sufficient to check the corners of this box. A linear program computes the
    largest ratios for each group of joints that share coordinates. If the friction of a group cannot balance the errors
    even without compensation, the ratios of this group are 0.

    Args:
        friction: Friction of the arm.
        ratio: Requested ratio, 0 to `MAX_RATIO`.
        holding_error: Largest error (n,) of the gravity compensation [N m, N].
        hysteresis_ratio: Requested ratio of effects with `Friction.springs_back`, 0 to `MAX_HYSTERESIS_RATIO`. A value
            of at most `ratio` is ignored. Effects with `springs_back` do not hold a released arm at its pose, so
            compensating them does not reduce the holding friction. The total compensation along a coordinate is at most
            `MAX_RATIO` times the friction along this coordinate, excluding viscous friction. Hysteresis is compensated
            before other friction.

    Returns:
        Ratios (k,) of the effects.

    Raises:
        ControllerError: A ratio is out of range, or `holding_error` is negative, not finite or has a wrong length.
    """
    error = np.asarray(holding_error, float)
    arm = friction.arm
    check_ratios(ratio, hysteresis_ratio)
    if error.shape != (arm.num_joints,) or not np.all((error >= 0) & np.isfinite(error)):
        raise ControllerError(f"holding_error must be {arm.num_joints} numbers of 0 or more; got {error.tolist()}")
    names = list(dict.fromkeys(effect.coordinate for effect in friction.effects))
    rows = np.array([joint_row(arm, name) for name in names]).reshape(-1, arm.num_joints)
    index = np.array([names.index(effect.coordinate) for effect in friction.effects], np.intp)
    holding = np.bincount(index, friction.coefficients * friction.holds, len(names)).astype(float)
    ratios = np.zeros(len(names))
    _, group_of = connected_components(np.abs(rows).T @ np.abs(rows))
    for group in range(group_of.max() + 1):
        joints = group_of == group
        along = np.any(rows[:, joints] != 0, axis=1)
        if not np.any(along):  # No friction acts on these joints.
            continue
        ratios[along] = _largest_ratios(rows[np.ix_(along, joints)], holding[along], error[joints], ratio)
    if hysteresis_ratio <= ratio:
        return ratios[index]
    is_dry = np.array([EFFECT_KINDS[effect.kind].role == "dry" for effect in friction.effects], bool)
    hysteresis = np.bincount(index, friction.coefficients * friction.springs_back, len(names))
    max_compensated = MAX_RATIO * np.bincount(index, friction.coefficients * is_dry, len(names))
    hysteresis_ratios = np.minimum(hysteresis_ratio, max_compensated / np.maximum(hysteresis, 1e-12))
    remaining_ratios = (max_compensated - hysteresis_ratios * hysteresis) / np.maximum(
        max_compensated / MAX_RATIO - hysteresis, 1e-12
    )
    other_ratios = np.where(hysteresis > 0, np.minimum(ratios, np.maximum(remaining_ratios, 0.0)), ratios)
    return np.where(friction.springs_back, hysteresis_ratios[index], other_ratios[index])


def _largest_ratios(
    rows: NDArray[np.float64], holding: NDArray[np.float64], error: NDArray[np.float64], most: float
) -> NDArray[np.float64]:
    """Returns the largest ratios (c,) of the coordinates with which the remaining friction balances all errors.

    Args:
        rows: Matrix (c, j) that maps joint velocities to the velocities of the coordinates.
        holding: Friction (c,) that holds the arm at rest, along each coordinate.
        error: Largest errors (j,) of the gravity compensation [N m, N].
        most: Upper bound of the ratios.
    """
    # Opposite corners are equivalent, so only one of each pair is included.
    corners = [np.array([1.0, *signs]) * error for signs in product((1.0, -1.0), repeat=len(error) - 1)]
    m, c = len(corners), len(rows)
    # The unknowns are the ratios, then the forces along the coordinates at each corner.
    identity, limits = np.eye(m * c), np.tile(np.diag(holding), (m, 1))
    result = linprog(
        np.concatenate([-np.ones(c), np.zeros(m * c)]),
        A_ub=np.block([[limits, identity], [limits, -identity]]),
        b_ub=np.tile(holding, 2 * m),
        A_eq=np.hstack([np.zeros((m * len(error), c)), np.kron(np.eye(m), rows.T)]),
        b_eq=np.concatenate(corners),
        bounds=[*[(0.0, most)] * c, *[(None, None)] * (m * c)],
    )
    return result.x[:c] if result.success else np.zeros(c)


def holding_error(model: IdentifiedModel) -> NDArray[np.float64]:
    """Returns the assumed error (n,) of the model's gravity torque [N m, N].

    The assumed error is `HOLDING_ERROR_FACTOR` times the leave-one-out RMS error of the static poses.

    Raises:
        ControllerError: The model has no such error for a joint, e.g. because it was identified from a motion alone. If
            friction was compensated, the arm could creep.
    """
    error = HOLDING_ERROR_FACTOR * np.array([joint.rms_leave_one_out_included for joint in model.joints])
    if unknown := [joint.name for joint, e in zip(model.joints, error, strict=True) if not e > 0]:
        which = "at rest" if len(unknown) == len(error) else f"at rest for {', '.join(unknown)}"
        raise ControllerError(
            f"friction compensation requires a model identified from static poses; this model has no error bound "
            f"{which}, so the arm could creep"
        )
    return error


#: Largest slip effort as a share of the effort limit. The hand of an operator overcomes it easily, and enough effort
#: remains for gravity and for the soft walls of the guard.
MAX_SLIP_SHARE = 0.4


def slip_effort(model: IdentifiedModel) -> NDArray[np.float64]:
    """Returns the default slip effort (n,) [N m, N] of each joint.

    It is the 95 % quantile of the cross-validated error, plus the dry friction of the joint. A hand that leads a joint
    loads its friction, and after the release the friction relaxes and pulls the joint back. The error is that of the
    holding torque, if the model was identified from static poses. A model of motions only states the error of efforts
    in motion. Offsets that may act only in motion are added to it, because the holding torque omits them (see
    `DynamicModel.holding_effects`). The slip effort is at most `MAX_SLIP_SHARE` times the effort limit. If
    `is_cross_validated` is false, it is the dry friction alone.
    """
    arm = model.arm
    return np.minimum(_error(model) + arm.dry_friction(), MAX_SLIP_SHARE * arm.effort_limits)


def is_cross_validated(model: IdentifiedModel) -> bool:
    """Returns whether the cross-validated error is known for all joints, from static poses or from motions."""
    return bool(np.all(_error(model) > 0))


def _error(model: IdentifiedModel) -> NDArray[np.float64]:
    at_rest = np.array([half_width(joint.rms_cross_validation_included, None) for joint in model.joints])
    if model.dynamics is None or np.all(at_rest > 0):
        return at_rest
    J, motion, rows = model.arm.transmission.matrix, model.dynamic_model, model.arm.effect_coordinates
    in_motion = motion.combined_half_width(J.T)
    omitted = np.zeros(model.arm.num_joints)
    for i, (effect, coefficient) in enumerate(zip(motion.effects, motion.coefficients, strict=True)):
        if effect.kind == "offset" and i not in motion.holding_effects:
            omitted += np.abs(coefficient * rows[effect.coordinate] @ J)
    return np.where(in_motion > 0, in_motion + omitted, 0.0)
