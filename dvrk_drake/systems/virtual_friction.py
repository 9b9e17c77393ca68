"""Virtual dry friction of each joint as compiled functions: a spring that attaches at rest and breaks away."""

from __future__ import annotations

import numpy as np

from dvrk_drake.dynamics.compiled import compiled

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
