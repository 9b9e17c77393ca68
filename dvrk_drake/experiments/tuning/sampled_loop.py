"""Linear sampled-data model of joints under PID control: stability, margins, and pole placement."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.models.arm_schema import Gains


@dataclass(frozen=True)
class Sampling:
    """Sampling and delay of the control loop.

    Attributes:
        period: Sample period of measurements and controller [s].
        ticks: Number of periods between a measurement and its effort.
        cut_off: Cut-off frequency of the low-pass filter of the velocity [Hz]; infinite for no filter.
    """

    period: float = 1e-3
    ticks: int = 2
    cut_off: float = 30.0

    @property
    def decay(self) -> float:
        """Weight of the previous value in the low-pass filter of the velocity."""
        return math.exp(-2.0 * math.pi * self.cut_off * self.period)

    @property
    def position_lag(self) -> float:
        """Mean delay between a position and its effort, including the zero-order hold [s]."""
        return (self.ticks + 0.5) * self.period

    @property
    def velocity_lag(self) -> float:
        """Mean delay between a velocity and its effort, including difference quotient and low-pass filter [s]."""
        return self.position_lag + (0.5 + self.decay / (1.0 - self.decay)) * self.period


@dataclass(frozen=True)
class Margins:
    """Stability margins of the control loop of one joint, opened at the motor.

    Attributes:
        phase: Smallest phase margin over all crossover frequencies [rad]; 0 for an unstable loop.
        crossover: Crossover frequency of the smallest phase margin [rad/s].
        gain: Gain margin: factor of the loop gain at which the loop becomes unstable.
    """

    phase: float
    crossover: float
    gain: float


class SampledLoop:
    """Linear closed loop of n joints with mass matrix M, viscous friction b and a PID controller.

    Between two samples M vd = u - b v. The effort is u = -Kp q - Kd v_e - Ki h sum(q) with the velocity estimate
    v_e and the sample period h, as in GravityPidController for the desired position 0. u is computed from the
    measurement `ticks` periods earlier, and is constant for one period. Gravity is compensated exactly. v_e is computed
    as in `systems.arm_effects.drive_step.DriveStep`.
    """

    def __init__(self, M: ArrayLike, sampling: Sampling, viscous: ArrayLike = 0.0) -> None:
        """Discretises the joints with mass matrix M (n, n) [kg m^2; kg] and `viscous` (n,) [N m s/rad; N s/m]."""
        from scipy.signal import cont2discrete  # takes 0.3 s

        self._M = np.atleast_2d(np.asarray(M, float))
        n = self._n = len(self._M)
        self._sampling = sampling
        M_inverse = np.linalg.inv(self._M)
        b = np.diag(np.broadcast_to(np.asarray(viscous, float), n))
        zero, eye = np.zeros((n, n)), np.eye(n)
        A = np.block([[zero, eye], [zero, -M_inverse @ b]])
        self._plant = cont2discrete((A, np.vstack([zero, M_inverse]), np.eye(2 * n), 0), sampling.period)[:2]

    def closed_loop(self, gains: Gains) -> NDArray[np.float64]:
        """Returns the matrix A of the closed loop, x[k+1] = A x[k].

        The state x (n (5 + 2 ticks),) consists of q and v, the last measured position and velocity estimate, the
        delayed measurements (oldest first), and the integral as an effort.
        """
        size = self._n * (5 + 2 * self._sampling.ticks)
        return np.column_stack([self._advance(x, gains) for x in np.eye(size)])

    def at_rest(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns the state of the loop for joints at rest at q (n,) [rad, m]."""
        still = np.concatenate([np.broadcast_to(np.asarray(q, float), self._n), np.zeros(self._n)])
        return np.concatenate([np.tile(still, 2 + self._sampling.ticks), np.zeros(self._n)])

    def _advance(self, x: NDArray[np.float64], gains: Gains) -> NDArray[np.float64]:
        n, h, decay = self._n, self._sampling.period, self._sampling.decay
        plant, memory, queue, integral = np.split(x, [2 * n, 4 * n, len(x) - n])
        reading = plant[:n]
        velocity = decay * memory[n:] + (1.0 - decay) * (reading - memory[:n]) / h
        measured = np.concatenate([reading, velocity])
        queue = np.concatenate([queue, measured])
        q, v = queue[:n], queue[n : 2 * n]
        integral = integral - h * np.asarray(gains.ki) * q
        effort = integral - np.asarray(gains.kp) * q - np.asarray(gains.kd) * v
        A, B = self._plant
        return np.concatenate([A @ plant + B @ effort, measured, queue[2 * n :], integral])

    def is_stable(self, gains: Gains) -> bool:
        """Returns whether the closed loop is asymptotically stable."""
        return bool(np.max(np.abs(np.linalg.eigvals(self.closed_loop(gains)))) < 1.0)

    def least_damped_mode(self, gains: Gains) -> tuple[float, NDArray[np.float64]]:
        """Returns the growth factor per period of the least damped mode, and each joint's share (n,) of its energy.

        The energy is the kinetic energy without the coupling terms of the mass matrix.
        """
        z, modes = np.linalg.eig(self.closed_loop(gains))
        worst = int(np.argmax(np.abs(z)))
        v = np.abs(modes[self._n : 2 * self._n, worst])
        energy = np.diag(self._M) * v**2
        return float(np.abs(z[worst])), energy / max(energy.sum(), np.finfo(float).tiny)

    def margins(self, gains: Gains) -> Margins:
        """Computes the stability margins. The loop must have one joint."""
        assert self._n == 1
        h, decay = self._sampling.period, self._sampling.decay
        w = np.geomspace(1e-2, np.pi / h, 4000)
        z = np.exp(1j * w * h)
        (A, B), eye = self._plant, np.eye(2)
        plant = np.linalg.solve(z[:, None, None] * eye - A, np.broadcast_to(B, (len(z), 2, 1)))[:, 0, 0]
        velocity = (1 - decay) / (1 - decay / z) * (1 - 1 / z) / h
        law = gains.kp[0] + gains.kd[0] * velocity + gains.ki[0] * h / (1 - 1 / z)
        loop = law * plant / z**self._sampling.ticks
        stable = self.is_stable(gains)
        size, phase = np.abs(loop), np.unwrap(np.angle(loop))
        crossings = np.flatnonzero((size[:-1] >= 1) & (size[1:] < 1))
        # At low frequency, the phase of a double integrator is -pi. With an integral term, it is -3 pi / 2.
        margins = [abs((phase[i] + 2 * np.pi) % (2 * np.pi) - np.pi) for i in crossings]
        turns = np.flatnonzero(np.diff(np.sign(np.imag(loop))) * (np.real(loop[:-1]) < 0))
        amplify = [1 / size[i] for i in turns if size[i] < 1]
        if not stable or not margins:
            return Margins(0.0, float(w[crossings[-1]]) if len(crossings) else 0.0, 1.0)
        least = int(np.argmin(margins))
        return Margins(float(margins[least]), float(w[crossings[least]]), float(min(amplify, default=np.inf)))


def place(
    inertia: float, frequency: float, damping_ratio: float, sampling: Sampling, viscous: float = 0.0
) -> tuple[float, float]:
    """Computes kp and kd for a given natural frequency and damping ratio of one joint, including the delays.

    To second order in s, a lag T of the position reduces the damping by Kp T, and a lag T_v of the velocity reduces
    the inertia by Kd T_v: (M - Kd T_v + Kp T^2 / 2) s^2 + (b + Kd - Kp T) s + Kp = 0. The left side equals
    m (s^2 + 2 z w s + w^2) if m (1 + (2 z w + w^2 T) T_v - w^2 T^2 / 2) = M + b T_v, Kp = m w^2, and
    Kd = 2 z w m + Kp T - b. A negative kd is replaced by zero.

    Args:
        inertia: Inertia M [kg m^2; kg].
        frequency: Natural frequency w [rad/s]. The result is accurate if w is far below the inverse of the lags.
        damping_ratio: Damping ratio z.
        sampling: Sampling that determines the lags.
        viscous: Viscous friction b of the joint [N m s/rad; N s/m].

    Returns:
        kp and kd.
    """
    w, z, T, T_v = frequency, damping_ratio, sampling.position_lag, sampling.velocity_lag
    m = (inertia + viscous * T_v) / (1.0 + (2.0 * z * w + w**2 * T) * T_v - 0.5 * (w * T) ** 2)
    kp = m * w**2
    return kp, max(2.0 * z * w * m + kp * T - viscous, 0.0)
