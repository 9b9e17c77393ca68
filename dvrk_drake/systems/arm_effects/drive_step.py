"""Discrete update of the drive in each time step: anchors of the presliding springs, and encoders."""

from __future__ import annotations

import math
from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteStateIndex, DiscreteValues, LeafSystem

from dvrk_drake.dynamics.actuator_effects import effect_step
from dvrk_drake.dynamics.compiled import entry_point
from dvrk_drake.models.effects_schema import per_actuator
from dvrk_drake.systems.arm_effects.drive_force import round_to_step
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects


class DriveStep(LeafSystem):
    """Updates friction springs and encoders in one system, because each additional Python system costs time.

    .. pydrake_system::

        name: DriveStep
        input_ports:
        - plant_state
        output_ports:
        - desired_state
        - state_estimated

    - `plant_state`: state of the arm's model instance, which contains the friction elements from `add_friction`.
    - `desired_state`: desired positions, then desired velocities (zero), of all actuators of the arm's model instance.
      They are for the plant's port `desired_state`. The desired position of a `Slider` is the anchor of its spring.
    - `state_estimated` (2n): measured q, then v of the arm's joints [rad, rad/s; m, m/s on a prismatic joint], delayed
      by the measurement delay.

    **Friction.** The anchor of a friction spring is fixed while the deflection of the spring is below the slip limit.
    Beyond this limit, the anchor follows the joint at a constant distance; see `effect_step`. The plant evaluates the
    spring at the end of a step. The anchor is updated afterwards, and this update only reduces the deflection. A spring
    therefore never returns more energy than was stored in it, and friction adds no energy. At initialization, the
    deflection of all springs is zero.

    **Encoders.** A measured actuator position is a whole number of encoder counts. Joint positions follow from the
    transmission. The velocity is the difference of two readings over the time step h, after a first-order low-pass
    filter with cut-off frequency f: y[k] = a y[k-1] + (1 - a) (x[k] - x[k-1]) / h with a = exp(-2 pi f h). Without an
    encoder, position and velocity are exact.

    **Start.** Initialization sets the measurements to those of an arm that has been at rest at its present pose. With a
    delay, systems that read `state_estimated` during initialization still get the measurements at the pose of the last
    call of `SetAtRest`, or at the default pose of the plant.
    """

    def __init__(self, parts: PlantEffects, num_actuators: int) -> None:
        """Creates the system.

        Args:
            parts: Effects of the arm in the finalized plant. Only encoder and delay are used here.
            num_actuators: Number of actuators of the arm's model instance.
        """
        super().__init__()
        arm, effects = parts.arm, parts.effects
        n, time_step = arm.num_joints, parts.plant.time_step()
        encoder, delay = effects.encoder, effects.delay.measurement if effects.delay else 0
        resolution = per_actuator(encoder.resolution if encoder else {}, arm.joint_names, 0.0)
        decay = math.exp(-2.0 * math.pi * encoder.velocity_cut_off * time_step) if encoder else -1.0
        self._constants = np.concatenate([resolution, [decay, time_step]])
        self._J = arm.transmission.matrix
        to_joints = np.ascontiguousarray(np.linalg.inv(arm.transmission.matrix))
        exact = to_joints @ parts.to_actuators
        whole = np.rint(exact)  # used to remove rounding errors from entries that only select a joint
        self._maps = parts.to_actuators, to_joints, np.where(np.abs(exact - whole) < 1e-12, whole, exact)
        self._places = np.array([[s.code, s.actuator, s.position] for s in parts.sliders], dtype=int).reshape(-1, 3)
        self._laws = np.array([[s.travel, s.fall_speed, s.side] for s in parts.sliders]).reshape(-1, 3)
        self._measure_into = entry_point(_measure_into)
        self.DeclareVectorInputPort(name="plant_state", size=2 * exact.shape[1])
        self._queue_length = max(delay - 1, 0)
        anchors = self.DeclareDiscreteState(num_state_variables=2 * num_actuators)
        self.DeclareStateOutputPort(name="desired_state", state_index=anchors)
        out, memory = self._at_rest(parts.home)
        self.DeclareDiscreteState(out)
        self.DeclareDiscreteState(memory)
        if delay:
            self.DeclareStateOutputPort(name="state_estimated", state_index=DiscreteStateIndex(_OUT))
        else:
            needs = {self.all_input_ports_ticket(), self.all_state_ticket()}
            self.DeclareVectorOutputPort(
                name="state_estimated", size=2 * n, calc=self._calc, prerequisites_of_calc=needs
            )
        self.DeclareInitializationDiscreteUpdateEvent(update=self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec=time_step, offset_sec=0.0, update=self._make_update())

    def _make_update(self) -> Callable[[Context, DiscreteValues], None]:
        """Returns the handler of the update. The handler uses local names for speed; see GravityPidController."""
        eval_vector_input, measure_into = self.EvalVectorInput, self._measure_into
        move_anchors = entry_point(_move_anchors)
        places, laws, maps, constants = self._places, self._laws, self._maps, self._constants
        has_friction, time_step = len(places) > 0, self._constants[-1]

        def update(context: Context, discrete_state: DiscreteValues) -> None:
            state = eval_vector_input(context, 0).get_value()
            value = discrete_state.get_mutable_value
            if has_friction:
                move_anchors(state, places, laws, time_step, value(_ANCHORS))
            measure_into(state, *maps, constants, value(_MEMORY), value(_OUT))

        return update

    def _calc(self, context: Context, output: BasicVector) -> None:
        """Computes the output of an arm without measurement delay. It equals the result of the next update."""
        memory = context.get_discrete_state(_MEMORY).get_value().copy()
        state = self.EvalVectorInput(context, 0).get_value()
        self._measure_into(state, *self._maps, self._constants, memory, output.get_mutable_value())

    def SetAtRest(self, context: Context, q: NDArray[np.float64]) -> None:
        """Sets the measurements in the context of this system for an arm at rest at q (n,) [rad, m]."""
        for group, value in zip((_OUT, _MEMORY), self._at_rest(q), strict=True):
            context.SetDiscreteState(group, value)

    def _start(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = self.EvalVectorInput(context, 0).get_value()
        anchors = discrete_state.get_mutable_value(_ANCHORS)
        anchors[self._places[:, 1]] = state[self._places[:, 2]]
        exact = self._maps[2]
        for group, value in zip((_OUT, _MEMORY), self._at_rest(exact @ state[: exact.shape[1]]), strict=True):
            discrete_state.set_value(group, value)

    def _at_rest(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the discrete states `_OUT` and `_MEMORY` of an arm at rest at q (n,)."""
        n = len(q)
        a = self._J @ q
        if self._constants[n] >= 0.0:
            a = np.array([round_to_step(x, step) for x, step in zip(a, self._constants[:n], strict=True)])
            q = self._maps[1] @ a
        still = np.zeros(n)
        out = np.concatenate([q, still])
        return out, np.concatenate([a, still, *[out] * self._queue_length])


_ANCHORS, _OUT, _MEMORY = 0, 1, 2  # indices of the discrete state groups


@numba.njit("void(float64[::1], int64[:, ::1], float64[:, ::1], float64, float64[::1])", cache=True)
def _move_anchors(state, places, laws, time_step, anchors):
    """Updates the array `anchors` of the spring anchors in place. `places` and `laws` have one row per `Slider`."""
    num_positions = len(state) // 2
    for i in range(len(places)):
        code, actuator, column = places[i]
        travel, fall_speed, side = laws[i]
        position, velocity = state[column], state[num_positions + column]
        slip_travel = travel
        if fall_speed > 0.0:
            slip_travel *= max(math.exp(-((velocity / fall_speed) ** 2)), 1e-6)
        deflection = side * (position - anchors[actuator])
        # z is the deflection after limiting, divided by `slip_travel`.
        z, _ = effect_step(code, 0.0, deflection, 0.0, 0.0, slip_travel)
        if abs(deflection - z * slip_travel) < 1e-12 * travel:
            continue
        deflection = z * slip_travel
        if slip_travel < travel:
            # The joint also moves in this step and in the step that uses the new anchor. The deflection is reduced by
            # this motion in advance. With the full `travel`, the effort limit of the actuator has the same effect.
            deflection = math.copysign(max(abs(deflection) - 2.0 * time_step * abs(velocity), 0.0), deflection)
        anchors[actuator] = position - side * deflection


@numba.njit(
    "void(float64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1], float64[::1], float64[::1])",
    cache=True,
)
def _measure_into(state, to_actuators, to_joints, exact, constants, memory, out):
    """Measures `state` and writes the delayed measurement to `out`. Without a queue, there is no delay.

    `memory` contains the last readings and velocities of the actuators, then the queue of measurements. `constants`
    contains the resolutions (n,), the decay factor of the low-pass filter and the time step [s]. Without an encoder,
    the decay factor is negative.
    """
    n, num_positions = to_actuators.shape
    decay, time_step = constants[n], constants[n + 1]
    queue = memory[2 * n :]
    queue_size = len(queue)
    measured = out
    if queue_size:
        for i in range(2 * n):
            out[i] = queue[i]
        for i in range(queue_size - 2 * n):
            queue[i] = queue[i + 2 * n]
        measured = queue[queue_size - 2 * n :]
    if decay < 0.0:
        for i in range(n):
            q, v = 0.0, 0.0
            for k in range(num_positions):
                q += exact[i, k] * state[k]
                v += exact[i, k] * state[num_positions + k]
            measured[i], measured[n + i] = q, v
        return
    for i in range(n):
        a = 0.0
        for k in range(num_positions):
            a += to_actuators[i, k] * state[k]
        a = round_to_step(a, constants[i])
        memory[n + i] = decay * memory[n + i] + (1.0 - decay) * (a - memory[i]) / time_step
        memory[i] = a
    for i in range(n):
        q, v = 0.0, 0.0
        for k in range(n):
            q += to_joints[i, k] * memory[k]
            v += to_joints[i, k] * memory[n + k]
        measured[i], measured[n + i] = q, v
