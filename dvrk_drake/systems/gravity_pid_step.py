"""Update of GravityPidController as one compiled function, with its virtual friction, without any Drake types."""

from __future__ import annotations

import numba
import numpy as np

from dvrk_drake.dynamics.compiled import compiled, compiled_for, read_only
from dvrk_drake.dynamics.holding_torque import HOLDING, holding_torque_into
from dvrk_drake.models.arm_schema import IMPLAUSIBLE

#: Time constant [s] of the two low-pass filters in series that find the slow motion of a joint. They attenuate the
#: tremor of a hand (8 to 12 Hz) by a factor of 17 to 37. Their delay adds to `REST_TIME`.
FILTER_TIME = 0.08

#: Time [s] for which the slow motion must be at rest before a spring attaches. A hand that turns back does not rest
#: that long. A spring that attached behind the hand would pull the joint back after the release.
REST_TIME = 0.15

#: Ratio of the speed of a joint that a hand moves to the largest speed of a joint at rest, and smallest number of such
#: joints in an arm that a hand moves. All springs are detached while a hand moves the arm, because a joint whose speed
#: passes through zero is not at rest. One joint alone may also slide because of a large error of the model.
MOVING_RATIO, MIN_MOVING = 2.5, 2

#: Time constant [s] with which the strength of a detached spring decays. The effort has no step, and is gone before the
#: spring can attach again.
DECAY_TIME = 0.02

#: Time constant [s] with which the place of an attached spring follows a joint that slides slowly. A hand that rests
#: drifts by a few mrad/s and must not break the springs away.
PLACE_TIME = 1.0

#: Time constant [s] of the velocity for the damping, as that of the velocity that a dVRK measures (30 Hz).
RATE_TIME = 0.005

#: Time at rest [s] after which the play begins to widen, and time in which it reaches its full width. A play at the
#: release would add half an encoder count to the distance that a joint moves until its spring holds it. The spring
#: holds a released joint after less than 1 s.
PLAY_START, PLAY_TIME = 1.0, 1.0

#: Number of state variables per joint: effort of the spring, its strength (share of the slip effort), place at which it
#: attached (NaN: detached), the two filtered positions (NaN: unknown), time at rest, velocity, and position after the
#: play.
NUM_STATES = 8


@compiled
def virtual_friction(
    q, v, last_q, acts, period, kd, slip, stiffness, drift, rest, travel, jump, play, memory, effort
):  # pragma: no cover - compiled
    """Advances the virtual friction of n joints by one period and subtracts its effort from `effort`.

    The element of a joint is elasto-plastic, as dry friction: a spring that slides at its strength. The strength is the
    slip effort at rest, and decays to zero after the joint has moved away. The element is passive. Its spring stores
    only energy of the motion that deflects it. Sliding and a decaying strength only reduce the stored energy.

    The position of a joint at rest may alternate between two encoder counts. The spring would follow it, and the joint
    would oscillate. The spring therefore has a play after some time at rest. In a motion, the play acts as a negative
    dry friction of stiffness times play, which must be smaller than the dry friction of the joint.

    Args:
        q, v: Position and velocity (n,) of the joints.
        last_q: Positions (n,) one period ago; NaN if unknown.
        acts: False if all springs are detached. The rest of the joints is nevertheless observed.
        period: Period [s].
        kd: Damping (n,) of an attached joint, at most the slip effort.
        slip: Efforts (n,) at which the springs slide.
        stiffness: Stiffness (n,) of the springs.
        drift: Largest efforts (n,) of the damping of the free joints, while no hand moves the arm. It decays to zero
            at the speed of a joint that a hand moves, so that it also slows a joint which a large error of the model
            accelerates before the spring attaches.
        rest: Distances (n,) by which the slow motion of a joint at rest may differ from its second filter.
        travel: Distances (n,) from the place of the spring at which it breaks away.
        jump: Distances (n,) that no joint moves in one period.
        play: Half widths (n,) of the play: half an encoder count, or 0.
        memory: State (8 n,), see `NUM_STATES`.
        effort: Efforts (n,).
    """
    n = q.size
    spring, strength, place = memory[:n], memory[n : 2 * n], memory[2 * n : 3 * n]
    first, second, rested = memory[3 * n : 4 * n], memory[4 * n : 5 * n], memory[5 * n : 6 * n]
    rate, played, num_moving = memory[6 * n : 7 * n], memory[7 * n :], 0
    gain, rate_gain = period / (FILTER_TIME + period), period / (RATE_TIME + period)
    for i in range(n):
        last, unknown = last_q[i], np.isnan(first[i])
        if unknown or not abs(q[i] - last) <= jump[i] + 2.0 * period * abs(v[i]):  # also for NaN
            last = first[i] = second[i] = played[i] = q[i]
            place[i], rested[i], rate[i] = np.nan, 0.0, 0.0
            if unknown and abs(v[i]) * FILTER_TIME <= rest[i]:
                rested[i] = REST_TIME  # an arm that does not move at the start was at rest before
        width = play[i] * min(max(rested[i] - PLAY_START, 0.0) / PLAY_TIME, 1.0)
        before = min(max(played[i], last - width), last + width)  # a narrower play does not change the effort
        played[i] = min(max(before, q[i] - width), q[i] + width)
        step = played[i] - before
        spring[i] += stiffness[i] * step
        rate[i] += rate_gain * (step / period - rate[i])
        first[i] += gain * (q[i] - first[i])
        second[i] += gain * (first[i] - second[i])
        rested[i] = rested[i] + period if abs(first[i] - second[i]) <= rest[i] else 0.0
        num_moving += abs(first[i] - second[i]) > MOVING_RATIO * rest[i]
    for i in range(n):
        if np.isnan(place[i]) and rested[i] >= REST_TIME:
            place[i] = first[i]
        if abs(q[i] - place[i]) > travel[i] or num_moving >= MIN_MOVING:
            place[i], rested[i] = np.nan, 0.0
        if not acts:
            place[i] = np.nan
        most = 0.0
        if num_moving < MIN_MOVING:
            most = drift[i] * min(max(MOVING_RATIO - abs(rate[i]) * FILTER_TIME / rest[i], 0.0), 1.0)
        if np.isnan(place[i]):
            strength[i] *= 1.0 - min(period / DECAY_TIME, 1.0)
        else:
            place[i] += period / PLACE_TIME * (second[i] - place[i])
            strength[i], most = 1.0, slip[i]
        limit = strength[i] * slip[i]
        spring[i] = min(max(spring[i], -limit), limit)
        effort[i] -= spring[i]
        if acts:
            effort[i] -= min(max(kd[i] * rate[i], -most), most)


@compiled
def detach(period, memory, effort):  # pragma: no cover - compiled
    """Detaches all springs and subtracts their decaying efforts from `effort` (n,). See `virtual_friction`."""
    n = effort.size
    for i in range(n):
        memory[2 * n + i] = memory[3 * n + i] = np.nan
        for k in (i, n + i):
            memory[k] *= 1.0 - min(period / DECAY_TIME, 1.0)
        effort[i] -= memory[i]


@compiled
def attach(gravity, effort, slip, memory):  # pragma: no cover - compiled
    """Transfers the effort of a regulator to the springs, at the change from mode "hold" to "guide".

    The effort of the joint then has no step, and friction that the regulator held cannot push the joint away. The
    spring of a joint that moves faster than a joint at rest decays, see `virtual_friction`.

    Args:
        gravity, effort: Gravity effort and effort (n,) of the last period in mode "hold".
        slip: Efforts (n,) at which the springs slide.
        memory: State (8 n,), see `NUM_STATES`.
    """
    n = effort.size
    for i in range(n):
        memory[i] = min(max(gravity[i] - effort[i], -slip[i]), slip[i])
        memory[n + i] = 1.0
        memory[5 * n + i] = REST_TIME  # a regulated joint is not led by a hand


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
