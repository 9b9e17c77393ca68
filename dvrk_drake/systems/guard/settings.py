"""Settings of a command guard, as a schema for yaml_load_typed.

This file has no postponed annotations, because yaml_load_typed reads the types at run time.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.ranges import number_fault, within

#: Settings that protect an arm less if they are smaller. All other settings protect it less if they are larger.
_WEAKER_IF_SMALLER = frozenset(
    {
        "start_time",
        "margin",
        "margin_fraction",
        "effort_rise_time",
        "traverse_time",
        "oscillation_time",
        "frozen_speed",
        "frozen_deflection",
        "response_memory",
        "detection_time",
    }
)
#: Largest accepted `expiry` [s] with `resume_automatically`: `traverse_time`, in which a joint crosses its range at the
#: speed limit. With a larger value, an old command could move a joint to its limit again and again without an operator.
_MAX_EXPIRY_WITHOUT_OPERATOR = 0.5


@dataclass
class PlausibilitySettings:
    """Tolerances of the plausibility checks of measurements; see `dvrk_drake.systems.guard.plausibility`.

    Attributes:
        position_tolerance: Tolerance of position steps, and of the difference between the position and the integrated
            velocity [rad]. For a prismatic joint, the tolerance in m is 0.1 times this value. Three encoder counts are
            added to the tolerance.
        jitter: Largest error of the time between two measurements [s].
        velocity_delay: Largest delay of the velocity estimate [s].
        velocity_counts: Allowed error of the velocity, in encoder counts per second [1/s]. This error occurs if the
            velocity is estimated from the time between two counts, because the estimate is constant until the next
            count.
        velocity_memory: Time constant of the comparison of positions and velocities [s].
        velocity_scale: Allowed relative error of the velocity.
        frozen_effort: Change of effort that must cause a change of position, as a fraction of the effort limit. The
            effort for one encoder count is added.
        frozen_deflection: Deflection that the full effort limit causes at least if the joint is blocked [rad]. For a
            prismatic joint, the deflection in m is 0.1 times this value.
        frozen_time: Longest time for which a position may stay constant after such a change of effort [s]. It exceeds
            `zero_time`, so that an effort sensor that fails does not look like a stuck encoder.
        frozen_speed: Lowest expected speed of a moving joint [rad/s, m/s]. The time in which a joint moves by one
            encoder count at this speed is added to `frozen_time`.
        response: Allowed unexplained effort as a fraction of the effort limit, in addition to `hand_effort`. See
            `plausibility.Response`.
        opposed_effort: Allowed effort against which a joint accelerates, as a fraction of the effort limit. The public
            recordings of real arms have at most 0.06.
        hand_effort: Allowed effort of the operator's hand or of a model error on a joint [N m]. For a prismatic joint,
            the allowed effort in N is ten times this value.
        response_time: Time constant of the filters of effort and acceleration [s].
        response_memory: Time constant with which the slowly varying part of the unexplained effort is attributed to
            model errors [s].
        start_gravity: Allowed difference between the measured effort and the gravity effort when effort commands start,
            as a fraction of the effort limit. The arm's dry friction and `hand_effort` are added to the allowed
            difference.
        tracking_error: Allowed difference between measured and commanded effort, as a fraction of the effort limit.
        tracking_scale: Allowed difference as a fraction of the commanded effort, which is added.
        tracking_time: Time constant of the filter of this difference [s]. While the commanded effort changes by the
            effort limit, a measurement that is 10 ms old causes a difference of 10 ms / `tracking_time` of the limit.
        zero_time: Longest time for which a measured effort may be exactly zero, although an effort is commanded [s].
        detection_time: Longest expected time from an error to its detection [s]. Positions that were measured during
            this time before the detection are not used as last valid positions.
        bad_samples: Largest number of consecutive measurements that may be late or not finite while the arm holds.
    """

    position_tolerance: float = field(default=0.01, metadata=within(0.001, 0.1, "rad"))
    jitter: float = field(default=0.03, metadata=within(0.0, 0.1, "s"))
    velocity_delay: float = field(default=0.03, metadata=within(0.001, 0.1, "s"))
    velocity_counts: float = field(default=150.0, metadata=within(0.0, 2000.0, "1/s"))
    velocity_memory: float = field(default=0.15, metadata=within(0.05, 2.0, "s"))
    velocity_scale: float = field(default=0.15, metadata=within(0.0, 1.0))
    frozen_effort: float = field(default=0.15, metadata=within(0.02, 1.0))
    frozen_deflection: float = field(default=0.01, metadata=within(0.001, 1.0, "rad"))
    frozen_time: float = field(default=0.03, metadata=within(0.002, 1.0, "s"))
    frozen_speed: float = field(default=0.1, metadata=within(0.001, 10.0, "rad/s"))
    response: float = field(default=1.3, metadata=within(0.2, 5.0))
    hand_effort: float = field(default=0.06, metadata=within(0.0, 5.0, "N m"))
    opposed_effort: float = field(default=0.1, metadata=within(0.05, 5.0))
    response_time: float = field(default=0.03, metadata=within(0.005, 0.5, "s"))
    response_memory: float = field(default=0.2, metadata=within(0.02, 10.0, "s"))
    start_gravity: float = field(default=0.1, metadata=within(0.02, 2.0))
    tracking_error: float = field(default=0.1, metadata=within(0.01, 1.0))
    tracking_scale: float = field(default=0.25, metadata=within(0.0, 1.0))
    tracking_time: float = field(default=0.1, metadata=within(0.01, 1.0, "s"))
    zero_time: float = field(default=0.02, metadata=within(0.002, 1.0, "s"))
    detection_time: float = field(default=0.03, metadata=within(0.005, 0.5, "s"))
    bad_samples: int = field(default=20, metadata=within(0, 100))

    def hand_efforts(self, arm: Arm) -> NDArray[np.float64]:
        """Returns `hand_effort` for each joint (n,) of an arm [N m, N]."""
        # On a prismatic joint: the force that has this moment at a lever of 0.1 m.
        return arm.per_joint(self.hand_effort, 10 * self.hand_effort)


@dataclass
class GuardSettings:
    """Settings of a command guard.

    The accepted range of each setting is given next to its default value. With a value outside this range, the guard
    would not protect the arm or would refuse all commands.

    Attributes:
        expiry: Age at which a command expires [s]. The age of a command is the age of the measurement from which it was
            computed. Another sender is accepted after the same time without an accepted command.
        command_age: Largest allowed median of the ages of the last 20 commands at their arrival [s].
        measurement_age: Largest age of a valid measurement [s].
        start_time: Duration of the start check [s]. Commands act only if all commands were accepted during this time.
        clock_tolerance: Allowed difference between the times that elapse on the sender's clock and on the arm's clock
            from one command to the next [s].
        sequence_jump: Largest increment of the sequence from one command to the next. 1000 corresponds to one second at
            1 kHz.
        start_effort: Allowed difference between the first commanded efforts and the measured efforts, as a fraction of
            the effort limit.
        margin: Minimum width of the soft wall before each position limit [rad, m]; see `GuardLimits`. The margin is
            also the allowed difference between the first commanded positions and the measured pose. While efforts act,
            a pose that exceeds a limit by more than half of the margin is a fault.
        margin_fraction: Largest margin as a fraction of the range of the joint. It determines the margin of prismatic
            joints and of joints with a small range.
        effort_fraction: Fraction of each effort limit that effort commands may use. The soft wall and the braking at
            the speed limit can use the full effort limit.
        effort_rise_time: Shortest time in which the commanded effort grows from zero to its limit [s].
        traverse_time: Shortest time in which a joint may cross its range [s]. The speed limit is the range divided by
            this time. The target of position commands does not exceed the speed limit. While efforts act, a joint above
            the speed limit is braked.
        following_error: Allowed distance of a joint from its target, as a fraction of the range of the joint.
        following_time: Allowed delay with which the arm's position controller follows a moving target [s]. For a PD
            controller, the delay is Kd/Kp.
        fault_effort: Largest effort of the joints that are held after a measurement fault, as a fraction of the effort
            limit. If the gravity effort exceeds two thirds of this value, the largest effort is the gravity effort plus
            a third of this value.
        slow_period: Largest allowed median of the last 100 periods between two steps of the guard [s].
        longest_period: Largest allowed time between two steps of the guard [s].
        oscillation: Threshold of the alternating part of the commanded effort for a reversal, as a fraction of the
            effort limit. See `measurement.OscillationMonitor`.
        oscillation_reversals: Allowed number of reversals. The count decays exponentially.
        oscillation_time: Time constant with which the count of reversals decays [s].
        resume_automatically: If true, commands may act again after a watchdog hold without a resume by an operator.
        plausibility: Tolerances of the checks of measurements.
    """

    expiry: float = field(default=0.05, metadata=within(0.002, 1.0, "s"))
    command_age: float = field(default=0.015, metadata=within(0.002, 1.0, "s"))
    measurement_age: float = field(default=0.02, metadata=within(0.001, 0.1, "s"))
    start_time: float = field(default=0.25, metadata=within(0.05, 10.0, "s"))
    clock_tolerance: float = field(default=0.05, metadata=within(0.001, 1.0, "s"))
    sequence_jump: int = field(default=1000, metadata=within(1, 100_000))
    start_effort: float = field(default=0.1, metadata=within(0.001, 0.25))
    margin: float = field(default=0.05, metadata=within(0.001, 0.3, "rad"))
    margin_fraction: float = field(default=0.05, metadata=within(0.001, 0.25))
    effort_fraction: float = field(default=1.0, metadata=within(0.01, 1.0))
    effort_rise_time: float = field(default=0.02, metadata=within(0.002, 10.0, "s"))
    traverse_time: float = field(default=0.5, metadata=within(0.1, 100.0, "s"))
    following_error: float = field(default=0.15, metadata=within(0.01, 0.5))
    following_time: float = field(default=0.2, metadata=within(0.01, 1.0, "s"))
    fault_effort: float = field(default=0.3, metadata=within(0.05, 1.0))
    slow_period: float = field(default=0.005, metadata=within(0.001, 0.02, "s"))
    longest_period: float = field(default=0.04, metadata=within(0.005, 1.0, "s"))
    oscillation: float = field(default=0.4, metadata=within(0.05, 1.0))
    oscillation_reversals: float = field(default=4.0, metadata=within(1.0, 100.0))
    oscillation_time: float = field(default=2.0, metadata=within(0.1, 10.0, "s"))
    resume_automatically: bool = False
    plausibility: PlausibilitySettings = field(default_factory=PlausibilitySettings)

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Checks that all settings are inside their ranges.

        Raises:
            StationError: A setting is outside its range.
        """
        if not isinstance(self.resume_automatically, bool):
            raise StationError(
                f"guard settings: resume_automatically must be true or false; got {self.resume_automatically}"
            )
        if fault := number_fault(self):
            raise StationError(f"guard settings: {fault}")
        if self.resume_automatically and self.expiry > _MAX_EXPIRY_WITHOUT_OPERATOR:
            raise StationError(
                f"guard settings: expiry is {self.expiry:g}; allowed with resume_automatically: up to "
                f"{_MAX_EXPIRY_WITHOUT_OPERATOR:g} s"
            )

    def weaker_than_default(self) -> str:
        """Returns the settings that protect the arm less than their default values, with both values, or ""."""
        return ", ".join([*_weaker(self, GuardSettings()), *_weaker(self.plausibility, PlausibilitySettings())])


def _weaker(settings: Any, default: Any) -> Iterator[str]:
    for entry in fields(default):
        value, usual = getattr(settings, entry.name), getattr(default, entry.name)
        if isinstance(usual, bool):
            if value:
                yield f"{entry.name} is true (default: false)"
        elif isinstance(usual, int | float) and (value < usual if entry.name in _WEAKER_IF_SMALLER else value > usual):
            yield f"{entry.name} is {value:g} (default: {usual:g})"
