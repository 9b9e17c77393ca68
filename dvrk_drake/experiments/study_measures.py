"""Measures of a simulated run: numbers, e.g. the settling time, and boolean measures, e.g. `held`.

This file has no postponed annotations, because yaml_load_typed reads the types at run time.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import StudyError
from dvrk_drake.experiments.scenario import Scenario
from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.ranges import number_fault, within


@dataclass
class Measure:
    """Measure of a run in a study file.

    Attributes:
        kind: Kind of the measure, one of `KINDS`.
        name: Column in the results. Default: the kind.
        band: Tolerance band of revolute joints [rad]. Default: that of the kind.
        band_prismatic: Tolerance band of prismatic joints [m]. Default: that of the kind, in proportion to `band`.
        time: Duration of the evaluated interval [s]. Default: that of the kind.
        joints: Names of the evaluated joints. Default: all. A measure in rad or m requires joints of one type.
    """

    kind: str = ""
    name: str = ""
    band: float | None = field(default=None, metadata=within(1e-9, 12.6, "rad"))
    band_prismatic: float | None = field(default=None, metadata=within(1e-9, 2.0, "m"))
    time: float | None = field(default=None, metadata=within(1e-5, 3600.0, "s"))
    joints: list[str] = field(default_factory=list)

    @property
    def column(self) -> str:
        """Name of the column in the results."""
        return self.name or self.kind

    @property
    def title(self) -> str:
        """Name of the quantity with its band and time, for tables and figures."""
        joints = f", joints {', '.join(self.joints)}" if self.joints else ""
        name = f"{self.name.replace('_', ' ')}: " if self.name else ""
        revolute, prismatic = self._bands
        return name + KINDS[self.kind].title.format(rad=revolute, m=prismatic, time=self._time) + joints

    @property
    def is_boolean(self) -> bool:
        """True for a boolean measure."""
        return isinstance(self.worst, bool)

    @property
    def worst(self) -> float | bool:
        """Value for a failed run, i.e. a run that could not be simulated to its end."""
        return KINDS[self.kind].worst

    def unit(self, arm: Arm) -> str:
        """Returns the unit of the values for the joints of an arm; "" for shares and boolean measures."""
        unit = KINDS[self.kind].unit
        return unit.replace("rad", "m") if np.all(arm.prismatic[self._columns(arm)]) else unit

    def _columns(self, arm: Arm) -> list[int]:
        """Returns the indices of the evaluated joints."""
        return [arm.joint_names.index(name) for name in self.joints or arm.joint_names]

    def check(self, scenario: Scenario) -> None:
        """Checks that the measure is valid for a scenario.

        Raises:
            StudyError: A field is invalid. The message gives the field, its value, and the accepted values.
        """
        if self.kind not in KINDS:
            raise StudyError(f'kind is "{self.kind}"; allowed: {", ".join(KINDS)}')
        if fault := number_fault(self):
            raise StudyError(fault)
        kind = KINDS[self.kind]
        for name, default in (("band", kind.band), ("band_prismatic", kind.band), ("time", kind.time)):
            value = getattr(self, name)
            if value is not None and default is None:
                raise StudyError(f"{name} is not a setting of {self.kind}. Remove it.")
        if unknown := sorted(set(self.joints) - set(scenario.mounted_arm.joint_names)):
            raise StudyError(
                f"joints of {self.column}: unknown joint {', '.join(unknown)}; joints of {scenario.mounted_arm.name}: "
                f"{', '.join(scenario.mounted_arm.joint_names)}"
            )
        self._check_unit(scenario)
        rest = scenario.duration - _arrival(scenario)
        if kind.time is not None and not 2 * scenario.sample_period <= self._time <= rest + 1e-9:
            raise StudyError(
                f"time of {self.column} is {self._time:g} s; allowed: {2 * scenario.sample_period:g}..{rest:g} s. The "
                "minimum is two sample periods. The maximum is the duration after the last target or the release by "
                "the hand, whichever is later."
            )
        if self.kind == "overshoot" and not scenario.targets:
            raise StudyError("overshoot requires a scenario with targets")

    def _check_unit(self, scenario: Scenario) -> None:
        """Checks that a measure in rad or m evaluates joints of one type."""
        arm = scenario.mounted_arm
        if len(set(arm.prismatic[self._columns(arm)])) > 1 and KINDS[self.kind].unit.startswith("rad"):
            names = [[n for n, p in zip(arm.joint_names, arm.prismatic, strict=True) if p == kind] for kind in (0, 1)]
            raise StudyError(
                f"{self.column} is the largest value of all joints, but {arm.name} has joints in rad and in m. Give "
                f"joints of one type: [{', '.join(names[0])}] or [{', '.join(names[1])}]"
            )

    def __call__(self, scenario: Scenario, simulation: Simulation) -> float | bool:
        """Computes the measure of a run: the worst value over the evaluated joints."""
        arm = scenario.mounted_arm
        columns = self._columns(arm)
        times, poses = scenario.knots()
        arrival, desired = _arrival(scenario), simulation.desired
        evaluated = simulation.time >= (arrival - 1e-9 if desired is None else 0.0)
        q = simulation.state_true[evaluated, : arm.num_joints]
        reference = np.broadcast_to(q[0], q.shape) if desired is None else desired
        run = _Run(
            t=simulation.time[evaluated],
            q=q[:, columns],
            error=(q - reference)[:, columns],
            effort_share=(np.abs(simulation.recording.measured_effort()[evaluated]) / arm.effort_limits)[:, columns],
            departure=float(times[-2]) if len(times) > 1 else 0.0,
            arrival=arrival,
            displacement=(poses[-1] - poses[-2])[columns] if len(poses) > 1 else np.zeros(len(columns)),
            goal=reference[-1, columns],
        )
        return KINDS[self.kind].compute(run, arm.per_joint(*self._bands)[columns], self._time)

    @property
    def _bands(self) -> tuple[float, float]:
        """Tolerance bands of revolute and prismatic joints [rad], [m]."""
        revolute, prismatic = KINDS[self.kind].band or (1.0, 1.0)
        if self.band is not None:
            revolute, prismatic = self.band, prismatic * self.band / revolute
        return revolute, prismatic if self.band_prismatic is None else self.band_prismatic

    @property
    def _time(self) -> float:
        return KINDS[self.kind].time or 0.0 if self.time is None else self.time


class _Run(NamedTuple):
    """Data of a run for the k evaluated joints.

    Attributes:
        t: Times (m,) [s].
        q: True positions (m, k) [rad, m].
        error: Differences (m, k) between the true and the desired positions [rad, m].
        effort_share: Absolute measured efforts (m, k), divided by the effort limits.
        departure: Start time of the motion to the last target [s].
        arrival: Time of the last target, of the release, or of the release by the hand, whichever is later [s].
        displacement: Displacement (k,) of the motion to the last target [rad, m].
        goal: Final desired positions (k,) [rad, m].
    """

    t: NDArray[np.float64]
    q: NDArray[np.float64]
    error: NDArray[np.float64]
    effort_share: NDArray[np.float64]
    departure: float
    arrival: float
    displacement: NDArray[np.float64]
    goal: NDArray[np.float64]

    def last(self, time: float) -> NDArray[np.bool_]:
        """Returns the mask (m,) of the samples in the last `time` [s]."""
        return self.t >= self.t[-1] - time - 1e-9


def _arrival(scenario: Scenario) -> float:
    """Returns the time of the last target, of the release, or of the release by the hand, whichever is later [s]."""
    hand = (point.time for point in scenario.hand.path)
    return max(float(scenario.knots()[0][-1]), *hand, scenario.controller.release_time)


def _settling_time(run: _Run, band: NDArray[np.float64], time: float) -> float:
    outside = np.flatnonzero(np.any(np.abs(run.q - run.goal) > band, axis=1))
    if not len(outside):
        return 0.0
    if outside[-1] == len(run.t) - 1:
        return math.inf
    return max(0.0, float(run.t[outside[-1] + 1]) - run.arrival)


def _overshoot(run: _Run, band: NDArray[np.float64], time: float) -> float:
    q = run.q[run.t >= run.departure - 1e-9]
    return max(0.0, float(np.max(np.sign(run.displacement) * (q - run.goal))))


def _steady_error(run: _Run, band: NDArray[np.float64], time: float) -> float:
    return float(np.max(np.abs(run.error[run.last(time)].mean(axis=0))))


def _drift(run: _Run, band: NDArray[np.float64], time: float) -> float:
    q = run.q[run.last(time)]
    return float(np.max(np.abs(q - q[0])))


def _drift_rate(run: _Run, band: NDArray[np.float64], time: float) -> float:
    last = run.last(time)
    return float(np.max(np.abs(np.polyfit(run.t[last], run.q[last], 1)[0])))


def _effort_share(run: _Run, band: NDArray[np.float64], time: float) -> float:
    return float(np.max(run.effort_share))


def _stays_in_band(run: _Run, band: NDArray[np.float64], time: float) -> bool:
    interval = (run.t >= run.arrival - 1e-9) & (run.t <= run.arrival + time + 1e-9)
    return bool(np.all(np.abs(run.error[interval]) <= band))


def _leaves_band(run: _Run, band: NDArray[np.float64], time: float) -> bool:
    return bool(np.any(np.abs(run.error) > band))


class Kind(NamedTuple):
    """Kind of a measure.

    Attributes:
        compute: Function that computes the measure from a run, the bands (k,) of the joints and the time.
        unit: Unit of the value for revolute joints, "" for shares and boolean measures.
        band: Default tolerance bands of revolute and prismatic joints [rad], [m]; None if the kind has no band.
        time: Default duration of the evaluated interval [s]; None if the kind has no such interval.
        worst: Value for a failed run.
        title: Name of the quantity, with the fields {rad} and {m} for the bands, and {time}.
    """

    compute: Callable[[_Run, NDArray[np.float64], float], float | bool]
    unit: str
    band: tuple[float, float] | None
    time: float | None
    worst: float | bool
    title: str


#: Kinds of measures. They are computed from the true positions and the measured efforts of the evaluated joints at the
#: recorded times. In mode "hold" the desired pose is that of the controller. In other modes it is the pose at the start
#: or, with a release time or a hand, at the release. Samples before the release are excluded. The bands of prismatic
#: joints are 0.1 m times those of revolute joints, since 0.1 m is a typical distance of a tip from the axes that move
#: it.
#:
#: settling_time: Time from the last target until all joints stay within `band` of the final desired pose; infinite if
#: they do not settle.
#: overshoot: Maximum distance beyond the last target, in the direction of the motion to this target.
#: steady_error: Absolute value of the mean error over the last `time`.
#: drift: Maximum distance, in the last `time`, from the pose at the start of this interval.
#: drift_rate: Absolute slope of a line fitted to the positions in the last `time`.
#: effort_share: Maximum effort divided by the joint's limit.
#: held: Whether all joints stay within `band` of the desired pose for `time` after the last target or the release.
#: ran_away: Whether the distance of any joint from the desired pose ever exceeds `band`.
KINDS = {
    "settling_time": Kind(
        _settling_time, "s", (1e-3, 1e-4), None, math.inf, "settling time to a band of {rad:g} rad, {m:g} m"
    ),
    "overshoot": Kind(_overshoot, "rad", None, None, math.inf, "overshoot"),
    "steady_error": Kind(_steady_error, "rad", None, 1.0, math.inf, "steady-state error, mean of the last {time:g} s"),
    "drift": Kind(_drift, "rad", None, 5.0, math.inf, "drift in the last {time:g} s"),
    "drift_rate": Kind(_drift_rate, "rad/s", None, 5.0, math.inf, "drift rate in the last {time:g} s"),
    "effort_share": Kind(_effort_share, "", None, None, math.inf, "largest effort / effort limit"),
    "held": Kind(
        _stays_in_band, "", (0.015, 0.0015), 10.0, False, "runs that stay within {rad:g} rad, {m:g} m for {time:g} s"
    ),
    "ran_away": Kind(_leaves_band, "", (0.5, 0.05), None, True, "runs that leave a band of {rad:g} rad, {m:g} m"),
}
