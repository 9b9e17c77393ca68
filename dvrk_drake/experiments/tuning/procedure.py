"""Tuning procedure of the paper (section III.J).

Kp is raised until the joint oscillates. Then Kv is raised until the oscillation is damped, and Ki until the offset
vanishes. The paper does not give the stopping criteria. The criteria used here are the constants of this module.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Oscillation:
    """Oscillation of a joint. A swing is the motion from one turning point to the next.

    Attributes:
        swings: Number of swings. The first is not evaluated, since it starts with slack cables and a zero integral.
        growth: Mean ratio of the sizes of consecutive swings; 0 for too few swings.
        period: Duration of two swings [s]; infinite for too few swings.
    """

    swings: int
    growth: float
    period: float

    @property
    def sustained(self) -> bool:
        """Returns whether the amplitude does not decay."""
        return self.growth >= 1.0


#: Number of evaluated swings: enough to detect 1 % of growth, but too few to reach the stops.
JUDGED = 8
#: Minimum number of evaluated swings. A joint that sticks after three swings does not oscillate.
MIN_TURNING_POINTS = 3


def judge_oscillation(t: NDArray[np.float64], x: NDArray[np.float64], threshold: float) -> Oscillation:
    """Evaluates the oscillation of positions x (m,) at times t (m,) after a release at rest.

    Motions smaller than `threshold` [rad, m] are not counted as swings.
    """
    turns = turning_points(x, threshold)[: JUDGED + 2]
    swings = np.abs(np.diff(x[turns]))
    judged = swings[1:]
    if len(judged) < MIN_TURNING_POINTS:
        return Oscillation(len(swings), 0.0, np.inf)
    growth = (judged[-1] / judged[0]) ** (1.0 / (len(judged) - 1))
    half = np.diff(t[turns[1:]]).mean()
    return Oscillation(len(swings), float(growth), float(2.0 * half))


def turning_points(x: NDArray[np.float64], threshold: float) -> NDArray[np.int_]:
    """Returns the indices of the first sample and of each extremum of x (m,) with a reversal above `threshold`."""
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


#: Maximum duration of a release [s] and in periods of the last release; durations of the step tests [s].
RELEASE, PERIODS, DAMPING_STEP, OFFSET_STEP = 1.5, 7.0, 1.0, 2.0
#: Factor by which Kp is raised until the joint oscillates, and number of logarithmic bisections after that.
RAISE, BISECTIONS = 2.0, 5
#: Maximum overshoot of a damped step, as a share of the step, without and with the integral term.
OVERSHOOT, OVERSHOOT_WITH_INTEGRAL = 0.05, 0.15
#: Factor by which Kv and Ki are raised; factor by which Kp is lowered if no Kv damps the joint.
FINER, LESS = 1.5, 0.7
#: Range of the damping ratio for Kv; range of Ki as a share of Kp per period.
RATIOS, SHARES = (0.05, 3.0), (0.02, 1.0)


class JointUnderTest(Protocol):
    """Interface to one joint of an arm whose other joints are held."""

    step: float
    """Initial distance from the desired position in releases and steps [rad, m]."""
    count: float
    """Resolution of the measured position [rad, m]."""
    band: float
    """Settling band [rad, m]."""
    effort_limit: float
    """Maximum effort [N m, N]."""

    def respond(self, kp: float, kd: float, ki: float, duration: float) -> tuple[NDArray, NDArray]:
        """Returns times (m,) and measured distances (m,) from the desired position, starting with `step` at time 0."""
        ...


@dataclass(frozen=True)
class Ultimate:
    """Ultimate gain of a joint: the proportional gain at which it begins to oscillate.

    Attributes:
        gain: Smallest Kp with a sustained oscillation [N m/rad; N/m], or the largest tested Kp if there is none.
        period: Period of the oscillation at this gain [s].
        growth: Ratio of consecutive swings at this gain.
        sustained: False if the joint oscillated with none of the tested gains.
    """

    gain: float
    period: float
    growth: float
    sustained: bool


@dataclass(frozen=True)
class JointProcedure:
    """Result of the procedure for one joint.

    Attributes:
        kp, kd, ki: Gains.
        ultimate: Ultimate gain, with which the procedure starts.
        kp_lowered: Ratio of the final Kp to the ultimate gain; 1 if Kp did not have to be lowered.
        damped: False if no Kv damped the joint.
        offset: Remaining distance at the end of a step [rad, m].
    """

    kp: float
    kd: float
    ki: float
    ultimate: Ultimate
    kp_lowered: float
    damped: bool
    offset: float


def tune_joint(joint: JointUnderTest) -> JointProcedure:
    """Tunes one joint by the procedure of the paper."""
    ultimate = find_ultimate_gain(joint)
    kp, kd, damped = _damp(joint, ultimate)
    ki, offset = _remove_offset(joint, kp, kd, ultimate.period)
    return JointProcedure(kp, kd, ki, ultimate, kp / ultimate.gain, damped, offset)


def find_ultimate_gain(joint: JointUnderTest) -> Ultimate:
    """Raises Kp until the oscillation after a release from `joint.step` is sustained, then bisects.

    With dry friction F the joint moves only if Kp step > F. Near the ultimate gain of such a joint small swings decay
    and large ones grow. The result is therefore valid for the given step. Kp is raised until the motor reaches its
    limit within a twentieth of the step; a higher Kp has no effect.
    """

    watched = RELEASE

    def swing(kp: float) -> Oscillation:
        nonlocal watched
        t, error = joint.respond(kp, 0.0, 0.0, watched)
        found = judge_oscillation(t, error, max(2.0 * joint.count, 0.02 * joint.step))
        # The period decreases with the gain, and a bisection lowers the gain only slightly.
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
    """Returns Kp, the smallest Kv that damps the joint, and whether one exists. Kp is lowered until one exists."""
    period = ultimate.period if np.isfinite(ultimate.period) else 0.1
    kp = ultimate.gain
    while kp > 0.003 * ultimate.gain:
        # The frequency is proportional to the square root of Kp.
        w = 2.0 * np.pi / period * np.sqrt(kp / ultimate.gain)
        for ratio in _raised(RATIOS):
            kd = 2.0 * ratio * kp / w
            if _try_step(joint, (kp, kd, 0.0), DAMPING_STEP, OVERSHOOT).damped:
                return kp, float(kd), True
        kp *= LESS
    return kp, float(kd), False


def _remove_offset(joint: JointUnderTest, kp: float, kd: float, period: float) -> tuple[float, float]:
    """Returns the smallest Ki with which the joint settles, or the Ki with the smallest offset, and this offset."""
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
    """Returns whether a step has at most this overshoot and comes to rest, and the remaining distance."""
    t, error = joint.respond(*gains, duration)
    last = error[t > 0.8 * duration]
    rests = np.ptp(last) <= max(2.0 * joint.count, joint.band)
    damped = rests and -np.min(error) <= overshoot * joint.step + joint.count
    return _Step(bool(damped), float(np.abs(last).mean()))
