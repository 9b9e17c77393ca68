"""Compensation of a share of an arm's friction, to reduce the interaction force of an operator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from dvrk_drake.dynamics.actuator_effects import EffectArrays, advance_effects
from dvrk_drake.dynamics.friction_compensation import Friction, check_ratios, safe_ratios
from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm_schema import IMPLAUSIBLE


class FrictionCompensator(LeafSystem):
    """Adds a share of the identified friction to a controller's effort. The compensation cannot start a motion.

    .. pydrake_system::

        name: FrictionCompensator
        input_ports:
        - state_estimated
        - effort_wanted
        output_ports:
        - effort
        - friction_effort

    Ports, for n joints in the arm's order [rad, rad/s, N m; m, m/s, N on a prismatic joint]:

    - `state_estimated` (2n): q, then v.
    - `effort_wanted` (n): effort of a controller, e.g. GravityPidController.
    - `effort` (n): effort_wanted + friction_effort, inside the effort limits.
    - `friction_effort` (n): sum of ratio_k coefficient_k shape_k row_k' over the elements k of the identified friction.
      shape_k is the effort of the element for a coefficient of 1. The element acts along the coordinate row_k q; see
      `dvrk_drake.dynamics.actuator_effects`. Dry friction is compensated as a hysteresis that depends on the travel of
      the joint. The sign of the velocity is not used, because noise determines it near zero velocity.

    **Passivity.** An elasto-plastic friction element with coefficient c slips after a travel d, and then dissipates the
    energy c |slip|. The compensating element slips after `widening` >= 1 times this travel, so it never slips more than
    the arm's element. Therefore it supplies at most the share `ratio` of the energy that the arm's friction dissipates,
    plus its stored energy of ratio c d widening / 2. The compensating viscous and smoothed Coulomb terms are at most
    `ratio` times those of the arm at every speed. A delay shifts the phase of such a term, but the arm's own term
    remains larger. The remaining friction prevents any cycle from gaining energy. The remaining friction also holds the
    arm against errors of the gravity compensation; see `safe_ratios`.

    **Time.** The state consists of the deflections of the elements and the last positions of their coordinates. It is
    updated every `period` seconds, at initialization and by a forced update. The initial deflections are zero. While
    `state_estimated` is not finite, `friction_effort` is zero. Afterwards, the deflections start from zero again.
    """

    def __init__(
        self,
        friction: Friction,
        *,
        ratio: float = 0.5,
        hysteresis_ratio: float = 0.0,
        holding_error: ArrayLike | None = None,
        widening: float = 1.5,
        period: float = 1e-3,
    ) -> None:
        """Creates the compensator for an arm's friction.

        Args:
            friction: Identified friction of the arm.
            ratio: Compensated share of the friction, 0..`MAX_RATIO`.
            hysteresis_ratio: Minimum compensated share, 0..`MAX_HYSTERESIS_RATIO`, of the wide hysteresis that moves a
                released arm back towards its earlier position; see `safe_ratios`.
            holding_error: Error (n,) [N m, N] of the gravity compensation. A large error reduces the compensated
                shares; see `safe_ratios`. `holding_error` returns the error of a model. None: only with a `ratio` of 0.
            widening: Ratio of the scales of the compensating elements to the identified scales, 1..10.
            period: Period of the update [s].

        Raises:
            ControllerError: A number is out of range, or `holding_error` is missing.
        """
        super().__init__()
        friction.arm.refuse_locked_joints("a friction compensator")
        check_ratios(ratio, hysteresis_ratio)
        if not (1 <= widening <= 10 and 0 < period < 1):
            raise ControllerError(
                f"widening must be 1..10 and period must be larger than 0 and smaller than 1 s; got {widening:g} and "
                f"{period:g} s"
            )
        if ratio and holding_error is None:
            raise ControllerError("a friction ratio above 0 requires holding_error, the error of the gravity model")
        n = friction.arm.num_joints
        error = np.zeros(n) if holding_error is None else holding_error
        self._ratios = safe_ratios(friction, ratio, error, hysteresis_ratio)
        self._limits = friction.arm.effort_limits
        wider = [replace(effect, scale=widening * effect.scale) for effect in friction.effects]
        self._effects = EffectArrays.of(friction.arm, wider, self._ratios * friction.coefficients)
        self._state_port = self.DeclareVectorInputPort("state_estimated", 2 * n)
        self._wanted_port = self.DeclareVectorInputPort("effort_wanted", n)
        # The memory of the elements and the friction effort.
        self._memory = self.DeclareDiscreteState(self._effects.size + n)
        ticket = self.discrete_state_ticket(self._memory)
        self.DeclareVectorOutputPort("effort", n, self._calc_effort, {ticket, self._wanted_port.ticket()})
        self.DeclareVectorOutputPort("friction_effort", n, self._calc_friction_effort, {ticket})
        self.DeclareInitializationDiscreteUpdateEvent(self._restart)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareForcedDiscreteUpdateEvent(self._update)

    @property
    def ratios(self) -> NDArray[np.float64]:
        """Compensated share of each element of the identified friction, one number per element."""
        return self._ratios.copy()

    def _restart(self, context: Context, state: DiscreteValues) -> None:
        state.get_mutable_value(int(self._memory))[:] = 0.0
        self._update(context, state)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        measured, value = self._state_port.Eval(context), state.get_mutable_value(int(self._memory))
        size = self._effects.size
        if np.all(np.abs(measured) < IMPLAUSIBLE):  # false for NaN
            advance_effects(measured, self._effects.constants, self._effects.no_loads, value[:size], value[size:])
        else:
            value[:] = 0.0

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        effort = self._wanted_port.Eval(context) + self._friction_effort(context)
        output.SetFromVector(np.clip(effort, -self._limits, self._limits))

    def _calc_friction_effort(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._friction_effort(context))

    def _friction_effort(self, context: Context) -> NDArray[np.float64]:
        return np.asarray(context.get_discrete_state(int(self._memory)).get_value()[self._effects.size :])
