"""What a computer knows of an arm's state: counts of encoders, some time ago."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EncoderEffect, per_actuator


class Encoder(LeafSystem):
    """Positions in counts of the actuators' encoders, velocities estimated from them, both late.

    .. pydrake_system::

        name: Encoder
        input_ports:
        - state
        output_ports:
        - state_estimated

    - `state` (2n): q, then v of the arm's joints, exact [rad, rad/s; m, m/s on a prismatic joint].
    - `state_estimated` (2n): the same as measured, `delay` time steps ago.

    A position of an actuator is a whole number of counts; joints follow by the transmission. The velocity is the
    difference of two readings over the time step h, low-passed to first order: with a = exp(-2 pi f h),
    y[k] = a y[k-1] + (1 - a) (x[k] - x[k-1]) / h. Without an `encoder` position and velocity are exact.

    At initialization the arm is taken to have rested where it is.
    """

    def __init__(self, arm: Arm, encoder: EncoderEffect | None, delay: int, time_step: float) -> None:
        """Of `arm`, with `delay` >= 0 whole time steps of `time_step` [s]."""
        super().__init__()
        n = arm.num_joints
        self._num_joints, self._delay = n, delay
        resolution = per_actuator(encoder.resolution if encoder else {}, arm.joint_names, 0.0)
        cut_off = encoder.velocity_cut_off if encoder else 0.0
        decay = math.exp(-2.0 * math.pi * cut_off * time_step) if encoder else -1.0
        self._constants = np.concatenate([resolution, [decay, time_step]])
        self._J = np.ascontiguousarray(arm.transmission.matrix)
        self._J_inverse = np.ascontiguousarray(arm.transmission.inverse().matrix)
        self.DeclareVectorInputPort(name="state", size=2 * n)
        # The last reading (n) and the last velocity (n) of the actuators, then what is known but not out yet.
        self.DeclareDiscreteState(num_state_variables=2 * n + 2 * n * delay)
        late = {self.all_state_ticket()}
        self.DeclareVectorOutputPort(
            name="state_estimated",
            size=2 * n,
            calc=self._calc,
            prerequisites_of_calc=late if delay else late | {self.all_input_ports_ticket()},
        )
        self.DeclareInitializationDiscreteUpdateEvent(update=self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec=time_step, offset_sec=0.0, update=self._update)

    def _measure(self, context: Context, memory: NDArray[np.float64]) -> NDArray[np.float64]:
        """The state (2n,) as measured now; puts the reading into `memory`."""
        state = self.EvalVectorInput(context, 0).get_value()
        measured = np.empty(2 * self._num_joints)
        _measure_into(state, self._J, self._J_inverse, self._constants, memory, measured)
        return measured

    def _calc(self, context: Context, output: BasicVector) -> None:
        memory = context.get_discrete_state_vector().get_value()
        n = self._num_joints
        if self._delay:
            output.SetFromVector(memory[2 * n : 4 * n])
        else:
            output.SetFromVector(self._measure(context, memory[: 2 * n].copy()))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        memory, n = discrete_state.get_mutable_value(), self._num_joints
        measured = self._measure(context, memory[: 2 * n])
        if self._delay:
            queue = memory[2 * n :]
            queue[: -2 * n] = queue[2 * n :].copy()
            queue[-2 * n :] = measured

    def _start(self, context: Context, discrete_state: DiscreteValues) -> None:
        memory, n = discrete_state.get_mutable_value(), self._num_joints
        self._measure(context, memory[: 2 * n])
        memory[n : 2 * n] = 0.0
        queue = memory[2 * n :]
        if self._delay:
            queue[:] = np.tile(self._measure(context, memory[: 2 * n]), self._delay)


@numba.njit(cache=True)
def _measure_into(
    state: NDArray[np.float64],
    J: NDArray[np.float64],
    J_inverse: NDArray[np.float64],
    constants: NDArray[np.float64],
    memory: NDArray[np.float64],
    measured: NDArray[np.float64],
) -> None:
    n = len(J)
    decay, time_step = constants[n], constants[n + 1]
    if decay < 0.0:
        measured[:] = state
        return
    for i in range(n):
        a = 0.0
        for k in range(n):
            a += J[i, k] * state[k]
        if constants[i] > 0.0:
            a = constants[i] * np.rint(a / constants[i])
        memory[n + i] = decay * memory[n + i] + (1.0 - decay) * (a - memory[i]) / time_step
        memory[i] = a
    for i in range(n):
        q, v = 0.0, 0.0
        for k in range(n):
            q += J_inverse[i, k] * memory[k]
            v += J_inverse[i, k] * memory[n + k]
        measured[i] = q
        measured[n + i] = v
