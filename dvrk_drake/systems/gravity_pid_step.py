"""One update of GravityPidController as one compiled function: the control law and nothing of Drake."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numba

#: No joint is there or that fast [rad, m, rad/s, m/s]; and products of such numbers with gains stay finite.
ABSURD = 1e6


@cache
def compile_step(torque_into: Callable[..., None]) -> Callable[..., None]:
    """One update of the controller as one compiled function without allocation.

    Arrays: state, desired (2n); constants: period, trust, effort limits
    (n each), theta, in one array as each argument costs; in place: effort (n), memory: kp,
    kd, ki (n each), mode, then integral, latched pose, last finite pose, gravity effort (n each), then three
    flags: a pose is latched, a finite pose was seen, fault.
    """

    def step(state, desired, has_desired, restart, constants, effort, memory):
        n = effort.size
        period, trust, limit, theta = (
            constants[0],
            constants[1 : n + 1],
            constants[n + 1 : 2 * n + 1],
            constants[2 * n + 1 :],
        )
        kp, kd, ki = memory[:n], memory[n : 2 * n], memory[2 * n : 3 * n]
        hold, damped = memory[3 * n] == 0.0, memory[3 * n] == 2.0
        rest = memory[3 * n + 1 :]
        integral, latched_q, last_q, gravity = (
            rest[:n],
            rest[n : 2 * n],
            rest[2 * n : 3 * n],
            rest[3 * n : 4 * n],
        )
        LATCHED, SEEN, FAULT = 7 * n + 1, 7 * n + 2, 7 * n + 3

        if restart:
            memory[LATCHED] = 0.0
            memory[SEEN] = 0.0
            integral[:] = 0.0
        fault = False
        for i in range(2 * n):
            fault |= not abs(state[i]) < ABSURD  # also true of NaN
        if not fault:
            last_q[:] = state[:n]
            memory[SEEN] = 1.0
        if hold and has_desired:
            for i in range(2 * n):
                fault |= not abs(desired[i]) < ABSURD
        memory[FAULT] = 1.0 if fault else 0.0

        if memory[SEEN] == 0.0:
            gravity[:] = 0.0
        else:
            torque_into(last_q, theta, gravity)
            for i in range(n):
                gravity[i] *= trust[i]
        if fault or not hold:
            memory[LATCHED] = 0.0
            for i in range(n):
                integral[i] = 0.0
                braking = kd[i] * state[n + i] if damped and not fault else 0.0
                effort[i] = min(max(gravity[i] - braking, -limit[i]), limit[i])
            return

        if memory[LATCHED] == 0.0:
            latched_q[:] = last_q
            memory[LATCHED] = 1.0
        for i in range(n):
            e = (desired[i] if has_desired else latched_q[i]) - state[i]
            de = (desired[n + i] if has_desired else 0.0) - state[n + i]
            without_integral = gravity[i] + kp[i] * e + kd[i] * de
            increment = 0.0 if restart else ki[i] * e * period
            if ki[i] == 0.0:
                integral[i] = 0.0
            command = without_integral + integral[i] + increment
            far = abs(kp[i] * e) > limit[i]
            winds_up = (command > limit[i] and increment > 0.0) or (command < -limit[i] and increment < 0.0)
            if not (far or winds_up):
                integral[i] += increment
            effort[i] = min(max(without_integral + integral[i], -limit[i]), limit[i])

    array = numba.float64[::1]
    view = numba.types.Array(numba.float64, 1, "C", readonly=True)  # what Drake gives of inputs
    flag = numba.boolean
    signature = numba.void(view, view, flag, flag, array, array, array)
    return numba.njit(signature)(step)


def entry_point(dispatcher: Callable[..., None]) -> Callable[..., None]:
    """The only signature of a compiled function, without the choice between signatures (4 us a call here).

    Its types are not checked any more: the arrays must be what the signature says. Drake's always are.
    """
    (overload,) = dispatcher.overloads.values()  # type: ignore[attr-defined]
    return overload.entry_point
