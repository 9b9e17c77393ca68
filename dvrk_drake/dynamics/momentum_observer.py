"""Estimates the joint efforts that act on an arm from outside, with an observer of the generalized momentum."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import EffectArrays, advance_effects, is_prismatic, joint_row
from dvrk_drake.dynamics.dynamic_model import DynamicModel, is_loaded
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError, ModelError
from dvrk_drake.models.effects_schema import EFFECT_KINDS

#: Time constant with which the bound of the friction grows while a joint rests [s]. A reversal of a motion takes less
#: time, and the presliding elements of the model describe it. `REST_TIME` of mode "guide" has the same length.
REST_TIME = 0.25
#: Smallest travel in `REST_TIME` that is a motion [rad], [m]. The presliding travel of gears is shorter, and less than
#: the noise of a measured velocity.
MIN_TRAVEL = 5e-4, 1e-4
#: Standard deviation of the effort of a presliding element after a reversal, as a share of its coefficient. A model has
#: elements on a grid of travels with a ratio of about 10/3. An element whose travel is between two of them differs from
#: their best combination by this share (RMS until both slide, over all travels).
REVERSAL_SHARE = 0.22


class DryFrictionBound:
    """Standard deviation of the dry friction along the coordinates of an arm's drive.

    While a coordinate slides, the model determines its dry friction. At rest, friction balances any effort between
    minus and plus the sum of its coefficients. At the start, the deflection of a presliding element is unknown, until
    the coordinate has moved over twice its presliding travel. The standard deviation is that of a uniform distribution
    in these bounds. After a reversal, it is `REVERSAL_SHARE` of the coefficient along the same distance.

    A state (4 c) has four numbers for each of c coordinates: how long it has rested, from 0 in motion to 1 after
    several times `REST_TIME`, then its smallest and its largest position since the start, and the distance since the
    last reversal, with the sign of the motion.

    Attributes:
        rows: Matrix (c, n) that maps joint positions to the positions of the coordinates with dry friction.
    """

    def __init__(self, dynamics: DynamicModel) -> None:
        """Reads the friction of a model.

        A coordinate rests if it travels less than its smallest presliding travel, or `MIN_TRAVEL`, in `REST_TIME`.
        Without presliding elements, it rests below the smallest speed at which the model has its full friction.
        """
        dry = [
            (effect, coefficient)
            for effect, coefficient in zip(dynamics.effects, dynamics.coefficients, strict=True)
            if EFFECT_KINDS[effect.kind].symmetric and coefficient
        ]
        names = list(dict.fromkeys(effect.coordinate for effect, _ in dry))
        n = dynamics.arm.num_joints
        self.rows = np.array([joint_row(dynamics.arm, name) for name in names]).reshape(-1, n)
        has_state = np.array([effect.kind == "presliding" for effect, _ in dry], bool)
        scales = np.array([effect.scale for effect, _ in dry])
        of_coordinate = np.array([[effect.coordinate == name for effect, _ in dry] for name in names], bool)
        travels = np.maximum(scales, [MIN_TRAVEL[is_prismatic(dynamics.arm, effect.coordinate)] for effect, _ in dry])
        self._speeds = np.array(
            [
                np.min(travels[own & has_state]) / REST_TIME if np.any(own & has_state) else np.min(scales[own])
                for own in of_coordinate
            ]
        )
        self._deviations = of_coordinate * np.array([c for _, c in dry]) / np.sqrt(3.0)
        self._wiped = 2.0 * scales * has_state

    def start(self) -> NDArray[np.float64]:
        """Returns the state (4 c) of an arm that may have rested for any time."""
        one = np.ones(len(self.rows))
        return np.concatenate([one, np.inf * one, -np.inf * one, 0.0 * one])

    def update(self, state: NDArray[np.float64], q: NDArray[np.float64], v: NDArray[np.float64], period: float) -> None:
        """Updates a state in place with the positions q and velocities v (n,) of the joints after a period [s]."""
        rest, low, high, distance = state.reshape(4, -1)  # views
        x, rate = self.rows @ q, self.rows @ v
        still = 1.0 - np.tanh(rate / self._speeds) ** 2
        rest[:] = np.minimum(still, rest + min(period / REST_TIME, 1.0) * (1.0 - rest))
        np.minimum(low, x, out=low)
        np.maximum(high, x, out=high)
        distance[:] = np.where(distance * rate < 0, 0.0, distance) + period * rate

    def covariance(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the covariances (..., n, n) of the joint efforts [(N m)^2, N^2] for states (..., 4 c)."""
        rest, low, high, distance = np.split(states, 4, axis=-1)
        turns = np.abs(distance)[..., None] < self._wiped
        share = np.maximum(rest[..., None], np.sqrt(3.0) * REVERSAL_SHARE * turns)
        share[(high - low)[..., None] < self._wiped] = 1.0
        deviation = np.sum(self._deviations * share, axis=-1)
        scaled = deviation[..., None] * self.rows
        return np.asarray(scaled.swapaxes(-1, -2) @ scaled)


#: Default bandwidth [rad/s], for which the errors were measured (benchmarks/external_force.py). The estimate is late by
#: 25 ms. The delay causes most of the error of a force that changes within 0.1 s.
BANDWIDTH = 40.0


class MomentumObserver:
    """Observer of the generalized momentum of an arm (De Luca and Mattone, ICRA 2003).

    With the momentum p = M(q) v, the estimate r of the external joint efforts obeys

        dr/dt = w (tau_model(q, v, dv/dt) - tau_measured - r).

    r is therefore the first-order low-pass of the efforts that the model does not explain. w is the bandwidth. The
    change of the momentum in a period replaces the acceleration, so no acceleration is measured. The model contains the
    links, rotors, gravity, cables, springs and friction. Elements of friction with a state start without deflection.

    The pose is low-pass filtered with the same bandwidth, because the estimate belongs to this earlier pose.

    Attributes:
        model: Model of the arm.
        bandwidth: Bandwidth w [rad/s].
        size: Number of elements of the state.
    """

    def __init__(self, model: IdentifiedModel, *, bandwidth: float = BANDWIDTH, period: float = 1e-3) -> None:
        """Reads the model.

        Args:
            model: Model that was identified from a motion, or a nominal model with dynamics.
            bandwidth: Bandwidth w [rad/s].
            period: Time between two updates [s].

        Raises:
            ModelError: The model was identified from static poses.
            ControllerError: Bandwidth or period is out of range.
        """
        if model.dynamics is None:
            raise ModelError(
                "the external effort of a moving arm requires a model that was identified from a motion; this model "
                "has no inertia and no friction"
            )
        if not (0 < period < 1 and 0 < bandwidth * period < 1):
            raise ControllerError(
                f"period must be larger than 0 and smaller than 1 s, and bandwidth between 0 and 1 / period; got "
                f"{period:g} s and {bandwidth:g} rad/s"
            )
        self.model, self.bandwidth, self._period = model, float(bandwidth), float(period)
        dynamics = model.dynamic_model
        arm = model.arm
        self._dynamics, self._n = dynamics, arm.num_joints
        self._effects = EffectArrays.of(arm, dynamics.effects, dynamics.coefficients)
        self._is_loaded = is_loaded(dynamics.effects)
        self._bound = DryFrictionBound(dynamics)
        J = arm.transmission.matrix
        self._model_covariance = J.T @ dynamics.error_covariance() @ J
        self._other_day = J.T @ dynamics.error_covariance(other_day=True) @ J
        sizes = [self._n, len(self._bound.start()), self._n, self._n, self._effects.size]
        ends = np.cumsum(sizes)
        self._r, self._dry, self._q, self._v, self._memory = map(slice, [0, *ends[:-1]], ends)
        self.size = int(ends[-1])

    def start(self) -> NDArray[np.float64]:
        """Returns the state (size,) before the first measurement: no external effort, and friction as at rest."""
        state = np.zeros(self.size)
        state[self._dry] = self._bound.start()
        state[self._v] = np.nan
        return state

    def update(
        self,
        state: NDArray[np.float64],
        q: NDArray[np.float64],
        v: NDArray[np.float64],
        tau: NDArray[np.float64],
        period: float | None = None,
    ) -> None:
        """Updates the state in place with a measurement.

        Args:
            state: State (size,).
            q, v: Positions [rad, m] and velocities (n,) of the joints.
            tau: Efforts (n,) of the motors at the joints [N m, N].
            period: Time since the previous measurement [s]. None: the period of the observer.
        """
        if np.isnan(state[self._v][0]):
            state[self._q], state[self._v] = q, v
        period = period or self._period
        vd = (v - state[self._v]) / period
        regressor = self._dynamics.regressor
        rigid = regressor.torque(q[None], v[None], vd[None], self._dynamics.parameters)[0]
        loads = self._loads(q, v, vd) if self._is_loaded else self._effects.no_loads
        friction = np.empty(self._n)
        advance_effects(np.concatenate([q, v]), self._effects.constants, loads, state[self._memory], friction)
        share = 1.0 - math.exp(-self.bandwidth * period)
        state[self._r] += share * (rigid + friction - tau - state[self._r])
        self._bound.update(state[self._dry], q, v, period)
        state[self._q] += share * (q - state[self._q])
        state[self._v] = v

    def effort(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the external joint efforts (n,) [N m, N]."""
        return state[self._r].copy()

    def pose(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the joint positions (n,) to which the effort belongs [rad, m]."""
        return state[self._q].copy()

    def covariance(self, state: NDArray[np.float64], *, other_day: bool = True) -> NDArray[np.float64]:
        """Returns the covariance (n, n) of the external joint efforts.

        It contains the errors of the model on held-out motions, and the dry friction that the model does not determine
        (`DryFrictionBound`).

        Args:
            state: State (size,).
            other_day: True to include the assumed change of the efforts between days.
        """
        errors = self._other_day if other_day else self._model_covariance
        return errors + self._bound.covariance(state[self._dry])

    def significance(self, state: NDArray[np.float64], *, other_day: bool = True) -> float:
        """Returns r' C^-1 r for the external effort r with the covariance C, see `threshold`."""
        r = state[self._r]
        return float(r @ np.linalg.solve(self.covariance(state, other_day=other_day), r))

    def threshold(self, false_alarms_per_hour: float) -> float:
        """Returns the `significance` that an arm without contact exceeds at the given rate.

        It is a quantile of the chi-squared distribution with n degrees of freedom. The low-pass makes w / 2 values per
        second independent. The errors of a model are not normal, so the rate is exceeded by far with the covariance of
        the same day, and must not be used with it (benchmarks/external_force.py).

        Args:
            false_alarms_per_hour: Expected number of false alarms per hour, from 1e-6 to 1000.

        Raises:
            ControllerError: The rate is out of range.
        """
        if not 1e-6 <= false_alarms_per_hour <= 1000:
            raise ControllerError(f"false alarms per hour must be from 1e-6 to 1000; got {false_alarms_per_hour:g}")
        from scipy.special import chdtri  # takes 0.1 s, and most programs detect no contacts

        return float(chdtri(self._n, false_alarms_per_hour / (1800.0 * self.bandwidth)))

    def _loads(self, q: NDArray[np.float64], v: NDArray[np.float64], vd: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._effects.loads(self._dynamics.transmitted_effort(q[None], v[None], vd[None])[0])
