"""The paper's way to tune: Kp up until the joint oscillates, then Kv until it does not, then Ki against the offset.

Section III.J of the paper. It does not say how far each step was taken; what is decided here stands at the constants.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Oscillation:
    """Swings go from one turning point to the next.

    Attributes:
        swings: their number; the first is not judged, it begins with slack cables and an integral at zero.
        growth: the size of a swing over that of the one before, on average; 0 if there are too few to tell.
        period: of two swings [s]; infinite if there are too few to tell.
    """

    swings: int
    growth: float
    period: float

    @property
    def sustained(self) -> bool:
        """Whether it does not die away."""
        return self.growth >= 1.0


#: Swings that are judged after the first: enough for 1 % of growth to show, few enough not to reach the stops.
JUDGED = 8
#: With fewer nothing is said: a joint that sticks after three swings does not oscillate.
MIN_TURNING_POINTS = 3


def judge_oscillation(t: NDArray[np.float64], x: NDArray[np.float64], threshold: float) -> Oscillation:
    """Of a position x (m,) at times t (m,) after a release at rest; what is below `threshold` [rad, m] is no swing."""
    turns = turning_points(x, threshold)[: JUDGED + 2]
    swings = np.abs(np.diff(x[turns]))
    judged = swings[1:]
    if len(judged) < MIN_TURNING_POINTS:
        return Oscillation(len(swings), 0.0, np.inf)
    growth = (judged[-1] / judged[0]) ** (1.0 / (len(judged) - 1))
    half = np.diff(t[turns[1:]]).mean()
    return Oscillation(len(swings), float(growth), float(2.0 * half))


def turning_points(x: NDArray[np.float64], threshold: float) -> NDArray[np.int_]:
    """Indices of the first sample and of each extremum from which x (m,) comes back by more than `threshold`."""
    found, extreme, direction = [0], 0, 0.0
    for i, value in enumerate(x):
        way = value - x[extreme]
        if direction == 0.0:
            if abs(way) > threshold:
                direction, extreme = float(np.sign(way)), i
        elif way * direction >= 0:
            extreme = i
        elif -way * direction > threshold:
            found.append(extreme)
            direction, extreme = -direction, i
    return np.array(found)


#: A release is watched for this long [s], or for so many periods of the last one; steps for this long [s].
RELEASE, PERIODS, DAMPING_STEP, OFFSET_STEP = 1.5, 7.0, 1.0, 2.0
#: Kp goes up by this factor until the joint oscillates, then the last factor is halved (in the logarithm) so often.
RAISE, BISECTIONS = 2.0, 5
#: Damped: a step overshoots by no more than this share, and nothing swings in the last fifth.
OVERSHOOT, OVERSHOOT_WITH_INTEGRAL = 0.05, 0.15
#: Kv and Ki go up by this factor, Kp comes down by this one if no Kv damps the joint.
FINER, LESS = 1.5, 0.7
#: Kv begins at this damping ratio and ends at that one; Ki begins at this share of Kp a period, and ends at that one.
RATIOS, SHARES = (0.05, 3.0), (0.02, 1.0)


class JointUnderTest(Protocol):
    """One joint of an arm that holds still otherwise."""

    step: float
    """How far it is moved away before it is let go, or stepped [rad, m]."""
    count: float
    """What its position is known to [rad, m]."""
    band: float
    """How near is near enough [rad, m]."""
    effort_limit: float
    """[N m, N]."""

    def respond(self, kp: float, kd: float, ki: float, duration: float) -> tuple[NDArray, NDArray]:
        """Times (m,) and what is measured of the way to go (m,), from `step` at time 0."""
        ...


@dataclass(frozen=True)
class Ultimate:
    """Where a joint under Kp alone begins to oscillate.

    Attributes:
        gain: the least Kp with which swings do not die away [N m/rad; N/m]; the largest that was tried if none does.
        period: of the oscillation there [s].
        growth: of a swing over the one before, there.
        sustained: False if no Kp made the joint oscillate.
    """

    gain: float
    period: float
    growth: float
    sustained: bool


@dataclass(frozen=True)
class JointProcedure:
    """What the procedure found for one joint, and how.

    Attributes:
        kp, kd, ki: the gains.
        ultimate: where it began.
        kp_lowered: by what Kp had to come down before a Kv could damp it; 1 if at once.
        damped: False if no Kv did.
        offset: what is left of a step at its end [rad, m].
    """

    kp: float
    kd: float
    ki: float
    ultimate: Ultimate
    kp_lowered: float
    damped: bool
    offset: float


def tune_joint(joint: JointUnderTest) -> JointProcedure:
    """Tunes one joint."""
    ultimate = find_ultimate_gain(joint)
    kp, kd, damped = _damp(joint, ultimate)
    ki, offset = _remove_offset(joint, kp, kd, ultimate.period)
    return JointProcedure(kp, kd, ki, ultimate, kp / ultimate.gain, damped, offset)


def find_ultimate_gain(joint: JointUnderTest) -> Ultimate:
    """Raises Kp until the swings after a release from `joint.step` do not die away, then bisects.

    With dry friction F the joint moves at all only if Kp step > F: that is where Kp begins. Near the ultimate gain of
    such a joint small swings die away and large ones grow, so the gain found belongs to the step. Kp ends where the
    motor is at its limit within a twentieth of the step, and more Kp changes nothing.
    """

    watched = RELEASE

    def swing(kp: float) -> Oscillation:
        nonlocal watched
        t, error = joint.respond(kp, 0.0, 0.0, watched)
        found = judge_oscillation(t, error, max(2.0 * joint.count, 0.02 * joint.step))
        # More gain swings faster, and a bisection does not go back far.
        watched = min(RELEASE, PERIODS * found.period)
        return found

    largest = 20.0 * joint.effort_limit / joint.step
    low, high = largest / 1024.0, largest / 1024.0
    found = swing(high)
    while not found.sustained and high < largest:
        low, high = high, min(RAISE * high, largest)
        found = swing(high)
    if not found.sustained:
        return Ultimate(high, found.period, found.growth, False)
    return _bisect(swing, low, high, found)


def _bisect(swing: Callable[[float], Oscillation], low: float, high: float, found: Oscillation) -> Ultimate:
    for _ in range(BISECTIONS):
        middle = float(np.sqrt(low * high))
        tried = swing(middle)
        if tried.sustained:
            high, found = middle, tried
        else:
            low = middle
    return Ultimate(high, found.period, found.growth, True)


def _damp(joint: JointUnderTest, ultimate: Ultimate) -> tuple[float, float, bool]:
    """Kp, the least Kv that damps it, and whether there was one. Kp comes down until there is."""
    period = ultimate.period if np.isfinite(ultimate.period) else 0.1
    kp = ultimate.gain
    while kp > 0.003 * ultimate.gain:
        # The frequency goes with the root of Kp.
        w = 2.0 * np.pi / period * np.sqrt(kp / ultimate.gain)
        for ratio in _raised(RATIOS):
            kd = 2.0 * ratio * kp / w
            if _try_step(joint, (kp, kd, 0.0), DAMPING_STEP, OVERSHOOT).damped:
                return kp, float(kd), True
        kp *= LESS
    return kp, float(kd), False


def _remove_offset(joint: JointUnderTest, kp: float, kd: float, period: float) -> tuple[float, float]:
    """The least Ki with which the joint ends inside its band; without one that with which it ends nearest."""
    best, nearest = 0.0, _try_step(joint, (kp, kd, 0.0), OFFSET_STEP, OVERSHOOT_WITH_INTEGRAL).offset
    for share in _raised(SHARES):
        if nearest <= joint.band:
            break
        ki = share * kp / (period if np.isfinite(period) else 0.1)
        tried = _try_step(joint, (kp, kd, ki), OFFSET_STEP, OVERSHOOT_WITH_INTEGRAL)
        if not tried.damped:
            break
        if tried.offset < nearest:
            best, nearest = ki, tried.offset
    return best, nearest


def _raised(ends: tuple[float, float]) -> list[float]:
    steps = int(np.ceil(np.log(ends[1] / ends[0]) / np.log(FINER)))
    return [ends[0] * FINER**i for i in range(steps + 1)]


class _Step(NamedTuple):
    damped: bool
    offset: float


def _try_step(joint: JointUnderTest, gains: tuple[float, float, float], duration: float, overshoot: float) -> _Step:
    """Whether a step overshoots by no more than that share and then rests, and how far from the goal it does."""
    t, error = joint.respond(*gains, duration)
    last = error[t > 0.8 * duration]
    rests = np.ptp(last) <= max(2.0 * joint.count, joint.band)
    damped = rests and -np.min(error) <= overshoot * joint.step + joint.count
    return _Step(bool(damped), float(np.abs(last).mean()))
