"""Virtual dry friction of each joint as compiled functions: a spring that attaches at rest and breaks away."""

from __future__ import annotations

import numpy as np

from dvrk_drake.dynamics.compiled import compiled

#: Time [s] for which a joint must rest before its spring attaches. A hand that moves a joint slowly or turns back does
#: not rest that long. A spring that attached behind the hand would pull the joint back after the release.
REST_TIME = 0.25

#: Time constant [s] with which the effort of a detached spring decays. The effort has no step, and is gone before the
#: spring can attach again.
DECAY_TIME = 0.02

#: Ratio of the speed at which the damping of a free joint ends to the largest speed of a joint at rest. The damping
#: stops a joint that begins to drift because of an error of the model. At larger speeds, a hand would feel it.
FADE_RATIO = 3.0

#: Number of state variables per joint: position at which the spring is attached (NaN: detached), effort of the spring,
#: reference position of the rest (NaN: unknown), and time since the joint left it.
NUM_STATES = 4


@compiled
def virtual_friction(
    q, v, last_q, acts, period, kp, kd, slip, drift, tolerance, jump, memory, effort
):  # pragma: no cover - compiled
    """Advances the virtual friction of n joints by one period and subtracts its effort from `effort`.

    The element of a joint is passive. Its spring stores energy only while the motion deflects it. A spring that breaks
    away or detaches dissipates its energy: it decays, and the way back of the joint shortens it in addition.

    Args:
        q, v: Position and velocity (n,) of the joints.
        last_q: Positions (n,) one period ago; NaN if unknown.
        acts: False if all springs are detached. The rest of the joints is nevertheless observed.
        period: Period [s].
        kp, kd: Stiffness and damping (n,) of the springs.
        slip: Efforts (n,) at which the springs break away. They also limit the damping of the attached joints.
        drift: Largest efforts (n,) of the damping of the free joints.
        tolerance: Distances (n,) within which a joint is at rest.
        jump: Distances (n,) that no joint moves in one period.
        memory: State (4 n,), see `NUM_STATES`.
        effort: Efforts (n,).
    """
    n = q.size
    for i in range(n):
        step = q[i] - last_q[i]
        if not abs(step) <= jump[i] + 2.0 * period * abs(v[i]):  # also for NaN
            memory[i] = memory[2 * n + i] = np.nan
        if not abs(q[i] - memory[2 * n + i]) <= tolerance[i]:
            memory[2 * n + i], memory[3 * n + i] = q[i], 0.0
        else:
            memory[3 * n + i] += period
        if not acts:
            memory[i] = np.nan
        deflected = kp[i] * (q[i] - memory[i])
        if abs(deflected) <= slip[i]:
            memory[n + i] = deflected
        else:  # also if the spring is detached
            if not np.isnan(memory[i]):
                memory[i], memory[2 * n + i], memory[3 * n + i] = np.nan, q[i], 0.0
            _decay(i, n, period, kp[i] * step, memory)
            if acts and memory[3 * n + i] >= REST_TIME and kp[i] > 0.0:
                memory[i] = q[i] - memory[n + i] / kp[i]
        effort[i] -= memory[n + i]
        if acts:
            most = slip[i]
            if np.isnan(memory[i]):
                most = drift[i] * max(1.0 - abs(v[i]) * REST_TIME / (FADE_RATIO * tolerance[i]), 0.0)
            effort[i] -= min(max(kd[i] * v[i], -most), most)


@compiled
def detach(period, memory, effort):  # pragma: no cover - compiled
    """Detaches all springs and subtracts their decaying efforts from `effort` (n,). See `virtual_friction`."""
    n = effort.size
    for i in range(n):
        memory[i], memory[2 * n + i], memory[3 * n + i] = np.nan, np.nan, 0.0
        _decay(i, n, period, 0.0, memory)
        effort[i] -= memory[n + i]


@compiled
def _decay(i, n, period, change, memory):  # pragma: no cover - compiled
    """Reduces the effort of detached spring i, also by a `change` of its deflection effort towards zero."""
    spring = memory[n + i] * (1.0 - min(period / DECAY_TIME, 1.0))
    if spring * change < 0.0:
        spring = np.sign(spring) * max(abs(spring) - abs(change), 0.0)
    memory[n + i] = spring
