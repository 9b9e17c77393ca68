"""Tuning procedure of the paper (Rutfield et al., WPI 2015, section III.J).

The procedure raises Kp until the joint oscillates, then Kv until the oscillation is damped, and then Ki until the
remaining position error (offset) is inside the settling band. Kv is the paper's name for kd. The paper does not state
the stopping criteria. Those used here are the constants of this module.

In this module, a release is a test with proportional control only. The joint starts at rest, at the distance `step`
from its desired position.
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
        swings: Number of swings. The first swing is not evaluated, since the presliding springs carry no
            force at its start.
        growth: Mean ratio of the amplitudes of consecutive swings; 0 for too few swings.
        period: Period of the oscillation, i.e. duration of two swings [s]; infinite for too few swings.
    """

    swings: int
    growth: float
    period: float

    @property
    def sustained(self) -> bool:
        """Returns whether the amplitude does not decay."""
        return self.growth >= 1.0


#: Maximum number of evaluated swings: enough to detect a growth of 1 %, but too few to reach the stops.
MAX_EVALUATED_SWINGS = 8
#: Minimum number of evaluated swings. A joint that sticks after fewer swings does not oscillate.
MIN_EVALUATED_SWINGS = 3


def evaluate_oscillation(t: NDArray[np.float64], x: NDArray[np.float64], threshold: float) -> Oscillation:
    """Evaluates the oscillation of positions x (m,) at times t (m,) in a release.

    Motions smaller than `threshold` [rad, m] are not counted as swings.
    """
    extrema = turning_points(x, threshold)[: MAX_EVALUATED_SWINGS + 2]
    swings = np.abs(np.diff(x[extrema]))
    evaluated = swings[1:]
    if len(evaluated) < MIN_EVALUATED_SWINGS:
        return Oscillation(len(swings), 0.0, np.inf)
    growth = (evaluated[-1] / evaluated[0]) ** (1.0 / (len(evaluated) - 1))
    half_period = np.diff(t[extrema[1:]]).mean()
    return Oscillation(len(swings), float(growth), float(2.0 * half_period))


def turning_points(x: NDArray[np.float64], threshold: float) -> NDArray[np.int_]:
    """Returns the indices of the first sample and of each extremum of x (m,) followed by a change above `threshold`."""
    found, extreme, direction = [0], 0, 0.0
    for i, value in enumerate(x):
        change = value - x[extreme]
        if direction == 0.0:
            if abs(change) > threshold:
                direction, extreme = float(np.sign(change)), i
        elif change * direction >= 0:
            extreme = i
        elif -change * direction > threshold:
            found.append(extreme)
            direction, extreme = -direction, i
    return np.array(found)


#: Maximum duration of a release, in s and in oscillation periods of the previous release; durations of the tests for Kv
#: and Ki [s].
RELEASE_DURATION, RELEASE_PERIODS, DAMPING_DURATION, OFFSET_DURATION = 1.5, 7.0, 1.0, 2.0
#: Factor by which Kp is raised until the joint oscillates; number of logarithmic bisections after that.
KP_FACTOR, NUM_BISECTIONS = 2.0, 5
#: Maximum overshoot of a damped step response, as a share of the step, without and with the integral term.
OVERSHOOT, OVERSHOOT_WITH_INTEGRAL = 0.05, 0.15
#: Factor by which Kv and Ki are raised; factor by which Kp is reduced if no Kv damps the joint.
KV_KI_FACTOR, KP_REDUCTION = 1.5, 0.7
#: Range of the damping ratio that determines Kv; range of Ki T / Kp, where T is the period of the oscillation
#: at the ultimate gain.
DAMPING_RATIOS, KI_SHARES = (0.05, 3.0), (0.02, 1.0)


class JointUnderTest(Protocol):
    """Interface to one joint of an arm. The other joints are regulated."""

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
        growth: Mean ratio of the amplitudes of consecutive swings at this gain.
        sustained: False if the joint oscillated at none of the tested gains.
    """

    gain: float
    period: float
    growth: float
    sustained: bool


@dataclass(frozen=True)
class JointProcedure:
    """Result of the procedure for one joint.

    Attributes:
        kp, kd, ki: Gains [N m/rad, N m s/rad, N m/(rad s)], with N/m instead of N m/rad for a prismatic joint.
        ultimate: Ultimate gain of the joint.
        kp_ratio: Ratio of the final Kp to the ultimate gain; 1 if Kp was not reduced.
        damped: False if no Kv damped the joint.
        offset: Remaining position error at the end of a step [rad, m].
    """

    kp: float
    kd: float
    ki: float
    ultimate: Ultimate
    kp_ratio: float
    damped: bool
    offset: float


def tune_joint(joint: JointUnderTest) -> JointProcedure:
    """Tunes one joint by the procedure of the paper."""
    ultimate = find_ultimate_gain(joint)
    kp, kd, damped = _damp(joint, ultimate)
    ki, offset = _remove_offset(joint, kp, kd, ultimate.period)
    return JointProcedure(kp, kd, ki, ultimate, kp / ultimate.gain, damped, offset)


def find_ultimate_gain(joint: JointUnderTest) -> Ultimate:
    """Raises Kp until the oscillation in a release is sustained, then refines Kp by bisection.

    With dry friction F, the joint moves only if Kp `joint.step` > F. Near the ultimate gain of such a joint, small
    oscillations decay and large ones grow. Therefore the result is valid only for the initial distance `joint.step`. At
    the largest tested Kp, the motor saturates at a position error of a twentieth of this distance. A higher Kp would
    have almost no effect.
    """

    duration = RELEASE_DURATION

    def release(kp: float) -> Oscillation:
        nonlocal duration
        t, error = joint.respond(kp, 0.0, 0.0, duration)
        found = evaluate_oscillation(t, error, max(2.0 * joint.count, 0.02 * joint.step))
        # The period decreases with the gain, and a bisection reduces the gain only slightly.
        duration = min(RELEASE_DURATION, RELEASE_PERIODS * found.period)
        return found

    largest = 20.0 * joint.effort_limit / joint.step
    low, high = largest / 1024.0, largest / 1024.0
    found = release(high)
    while not found.sustained and high < largest:
        low, high = high, min(KP_FACTOR * high, largest)
        found = release(high)
    if not found.sustained:
        return Ultimate(high, found.period, found.growth, False)
    return _bisect(release, low, high, found)


def _bisect(release: Callable[[float], Oscillation], low: float, high: float, found: Oscillation) -> Ultimate:
    for _ in range(NUM_BISECTIONS):
        middle = float(np.sqrt(low * high))
        oscillation = release(middle)
        if oscillation.sustained:
            high, found = middle, oscillation
        else:
            low = middle
    return Ultimate(high, found.period, found.growth, True)


def _damp(joint: JointUnderTest, ultimate: Ultimate) -> tuple[float, float, bool]:
    """Returns Kp, the smallest Kv that damps the joint, and whether such a Kv exists. Reduces Kp if necessary."""
    period = ultimate.period if np.isfinite(ultimate.period) else 0.1
    kp = ultimate.gain
    while kp > 0.003 * ultimate.gain:
        # The frequency is proportional to the square root of Kp.
        w = 2.0 * np.pi / period * np.sqrt(kp / ultimate.gain)
        for ratio in _geometric_series(DAMPING_RATIOS):
            kd = 2.0 * ratio * kp / w
            if _try_step(joint, (kp, kd, 0.0), DAMPING_DURATION, OVERSHOOT).damped:
                return kp, float(kd), True
        kp *= KP_REDUCTION
    return kp, float(kd), False


def _remove_offset(joint: JointUnderTest, kp: float, kd: float, period: float) -> tuple[float, float]:
    """Returns the smallest Ki with which the joint settles, or else the Ki with the smallest offset, and the offset."""
    best, smallest_offset = 0.0, _try_step(joint, (kp, kd, 0.0), OFFSET_DURATION, OVERSHOOT_WITH_INTEGRAL).offset
    for share in _geometric_series(KI_SHARES):
        if smallest_offset <= joint.band:
            break
        ki = share * kp / (period if np.isfinite(period) else 0.1)
        step = _try_step(joint, (kp, kd, ki), OFFSET_DURATION, OVERSHOOT_WITH_INTEGRAL)
        if not step.damped:
            break
        if step.offset < smallest_offset:
            best, smallest_offset = ki, step.offset
    return best, smallest_offset


def _geometric_series(ends: tuple[float, float]) -> list[float]:
    steps = int(np.ceil(np.log(ends[1] / ends[0]) / np.log(KV_KI_FACTOR)))
    return [ends[0] * KV_KI_FACTOR**i for i in range(steps + 1)]


class _Step(NamedTuple):
    damped: bool
    offset: float


def _try_step(joint: JointUnderTest, gains: tuple[float, float, float], duration: float, overshoot: float) -> _Step:
    """Returns whether a step settles with at most this overshoot, and its remaining position error [rad, m]."""
    t, error = joint.respond(*gains, duration)
    last = error[t > 0.8 * duration]
    at_rest = np.ptp(last) <= max(2.0 * joint.count, joint.band)
    damped = at_rest and -np.min(error) <= overshoot * joint.step + joint.count
    return _Step(bool(damped), float(np.abs(last).mean()))
