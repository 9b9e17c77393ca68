"""Update of GravityPidController as one compiled function, without any Drake types."""

from __future__ import annotations

import numba
import numpy as np

from dvrk_drake.dynamics.compiled import compiled_for, read_only
from dvrk_drake.dynamics.holding_torque import HOLDING, holding_torque_into
from dvrk_drake.models.arm_schema import IMPLAUSIBLE
from dvrk_drake.systems.virtual_friction import attach, detach, virtual_friction

#: Values of `mode`: indices into `gravity_pid_controller.Mode`.
HOLD, GRAVITY, DAMPED, GUIDE = 0, 1, 2, 3


_array = numba.float64[::1]
_memory = (_array,) * 7
_flag = numba.boolean


@compiled_for(
    read_only(1), read_only(1), _flag, _flag, numba.float64, numba.int64, numba.float64[:, ::1], HOLDING, *_memory
)
def controller_step(
    state,
    desired,
    has_desired,
    restart,
    period,
    mode,
    per_joint,
    model,
    effort,
    gravity,
    fault,
    integral,
    latched_q,
    last_q,
    springs,
):  # pragma: no cover - compiled
    """Performs one update of the controller. Vectors have n numbers unless another size is stated.

    Args:
        state, desired: Input values (2n).
        has_desired: False if there is no desired state.
        restart: True for the update at initialization.
        period: Period of the update [s].
        mode: Index into `Mode`.
        per_joint: Rows (13, n): kp, kd, ki, slip effort, feedforward scale and effort limits, then rest, jump,
            stiffness, travel, damping, drift and play of `virtual_friction`.
        model: Model of the holding torque.
        effort, gravity, fault, integral: Results, which the function writes into these arrays. `fault` has one number.
        latched_q: Pose that is regulated if `has_desired` is False; NaN before the first pose.
        last_q: Last valid pose; NaN before the first pose.
        springs: State (8n) of the virtual friction.
    """
    n = effort.size
    kp, kd, ki, slip, feedforward_scale = per_joint[0], per_joint[1], per_joint[2], per_joint[3], per_joint[4]
    limit, rest, jump, stiffness, travel = per_joint[5], per_joint[6], per_joint[7], per_joint[8], per_joint[9]
    damping, drift, play = per_joint[10], per_joint[11], per_joint[12]
    hold, damped = mode == HOLD, mode == DAMPED

    if restart:
        for i in range(n):
            latched_q[i], last_q[i], integral[i] = np.nan, np.nan, 0.0
        springs[:] = 0.0
        springs[3 * n : 4 * n] = np.nan  # the filtered positions are unknown
    faulty = False
    for i in range(2 * n):
        faulty |= not abs(state[i]) < IMPLAUSIBLE  # also true for NaN
    held = not np.isnan(latched_q[0])
    if mode == GUIDE and held and not (restart or faulty):
        attach(gravity, effort, slip, springs)
    effort[:] = 0.0
    if faulty:
        detach(period, springs, effort)
    else:
        q, v, guide = state[:n], state[n:], mode == GUIDE
        settings = period, damping, slip, stiffness, drift, rest, travel, jump, play
        virtual_friction(q, v, last_q, guide, *settings, springs, effort)
        for i in range(n):
            last_q[i] = state[i]
    if hold and has_desired:
        for i in range(2 * n):
            faulty |= not abs(desired[i]) < IMPLAUSIBLE
    fault[0] = 1.0 if faulty else 0.0

    if np.isnan(last_q[0]):
        gravity[:] = 0.0
    else:
        holding_torque_into(last_q, model, gravity)
        for i in range(n):
            gravity[i] *= feedforward_scale[i]
    if faulty or not hold:
        for i in range(n):
            latched_q[i], integral[i] = np.nan, 0.0
            braking = kd[i] * state[n + i] if damped and not faulty else 0.0
            effort[i] = min(max(gravity[i] - braking + effort[i], -limit[i]), limit[i])
        return

    if np.isnan(latched_q[0]):
        for i in range(n):
            latched_q[i] = last_q[i]
    for i in range(n):
        e = (desired[i] if has_desired else latched_q[i]) - state[i]
        de = (desired[n + i] if has_desired else 0.0) - state[n + i]
        without_integral = gravity[i] + kp[i] * e + kd[i] * de + effort[i]
        increment = 0.0 if restart else ki[i] * e * period
        if ki[i] == 0.0:
            integral[i] = 0.0
        command = without_integral + integral[i] + increment
        far = abs(kp[i] * e) > limit[i]
        winds_up = (command > limit[i] and increment > 0.0) or (command < -limit[i] and increment < 0.0)
        if not (far or winds_up):
            integral[i] += increment
        effort[i] = min(max(without_integral + integral[i], -limit[i]), limit[i])
