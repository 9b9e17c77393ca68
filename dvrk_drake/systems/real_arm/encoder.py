"""What a computer knows of an arm's state: counts of encoders, some time ago."""

from __future__ import annotations

import math
from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteStateIndex, DiscreteValues, LeafSystem

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EncoderEffect, per_actuator
from dvrk_drake.systems.gravity_pid_step import entry_point


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

    The arm is taken to have rested before it starts: where `set_at_rest` says, or where it is at initialization. With a
    delay, what is out during initialization itself is the former.
    """

    def __init__(
        self, arm: Arm, encoder: EncoderEffect | None, delay: int, time_step: float, q_default: NDArray[np.float64]
    ) -> None:
        """Of `arm`, with `delay` >= 0 whole time steps of `time_step` [s]; it rested at `q_default` (n,) before."""
        super().__init__()
        n = arm.num_joints
        resolution = per_actuator(encoder.resolution if encoder else {}, arm.joint_names, 0.0)
        decay = math.exp(-2.0 * math.pi * encoder.velocity_cut_off * time_step) if encoder else -1.0
        self._constants = np.concatenate([resolution, [decay, time_step]])
        self._maps = np.array([arm.transmission.matrix, arm.transmission.inverse().matrix])
        self._measure_into = entry_point(_measure_into)
        self.DeclareVectorInputPort(name="state", size=2 * n)
        self._queue_length = max(delay - 1, 0)
        # What is out now; what is measured but not out yet, oldest first; last reading and velocity of the actuators.
        for value in self._at_rest(q_default):
            self.DeclareDiscreteState(value)
        if delay:
            self.DeclareStateOutputPort(name="state_estimated", state_index=DiscreteStateIndex(_OUT))
        else:
            needs = {self.all_input_ports_ticket(), self.all_state_ticket()}
            self.DeclareVectorOutputPort(
                name="state_estimated", size=2 * n, calc=self._calc, prerequisites_of_calc=needs
            )
        self.DeclareInitializationDiscreteUpdateEvent(update=self._start)
        update = self._make_update()
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec=time_step, offset_sec=0.0, update=update)

    def _make_update(self) -> Callable[[Context, DiscreteValues], None]:
        eval_vector_input, step = self.EvalVectorInput, self._measure_into
        maps, constants = self._maps, self._constants

        def update(context: Context, discrete_state: DiscreteValues) -> None:
            value = discrete_state.get_mutable_value
            state = eval_vector_input(context, 0).get_value()
            step(state, maps, constants, value(_MEMORY), value(_QUEUE), value(_OUT))

        return update

    def _calc(self, context: Context, output: BasicVector) -> None:
        """Without delay: what the update is about to compute."""
        memory = context.get_discrete_state(_MEMORY).get_value().copy()
        state = self.EvalVectorInput(context, 0).get_value()
        self._measure_into(state, self._maps, self._constants, memory, np.empty(0), output.get_mutable_value())

    def set_at_rest(self, context: Context, q: NDArray[np.float64]) -> None:
        """What has been measured of an arm that rested at q (n,) until now; in this system's context."""
        for group, value in enumerate(self._at_rest(q)):
            context.SetDiscreteState(group, value)

    def _start(self, context: Context, discrete_state: DiscreteValues) -> None:
        q = self.EvalVectorInput(context, 0).get_value()[: self._maps.shape[1]]
        for group, value in enumerate(self._at_rest(q)):
            discrete_state.set_value(group, value)

    def _at_rest(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        n = self._maps.shape[1]
        state, memory, out = np.concatenate([q, np.zeros(n)]), np.zeros(2 * n), np.zeros(2 * n)
        for _ in range(2):  # the second reading differs from the first by nothing
            memory[n:] = 0.0
            self._measure_into(state, self._maps, self._constants, memory, np.empty(0), out)
        return out, np.tile(out, self._queue_length), memory


_OUT, _QUEUE, _MEMORY = 0, 1, 2  # indices of the discrete state groups


@numba.njit(
    "void(float64[::1], float64[:, :, ::1], float64[::1], float64[::1], float64[::1], float64[::1])", cache=True
)
def _measure_into(state, maps, constants, memory, queue, out):
    """Measures `state`; the oldest measurement of `queue` goes out and this one in, or out at once if it is empty.

    `maps` (2, n, n) are J and its inverse, `constants` resolutions (n), decay of the low-pass, time step.
    """
    n = len(state) // 2
    decay, time_step = constants[n], constants[n + 1]
    late = len(queue)
    if late:
        out[:] = queue[: 2 * n]
        for i in range(late - 2 * n):
            queue[i] = queue[i + 2 * n]
    measured = queue[late - 2 * n :] if late else out
    if decay < 0.0:
        measured[:] = state
        return
    for i in range(n):
        a = 0.0
        for k in range(n):
            a += maps[0, i, k] * state[k]
        if constants[i] > 0.0:
            a = constants[i] * np.rint(a / constants[i])
        memory[n + i] = decay * memory[n + i] + (1.0 - decay) * (a - memory[i]) / time_step
        memory[i] = a
    for i in range(n):
        q, v = 0.0, 0.0
        for k in range(n):
            q += maps[1, i, k] * memory[k]
            v += maps[1, i, k] * memory[n + k]
        measured[i] = q
        measured[n + i] = v
