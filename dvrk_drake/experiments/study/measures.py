"""What one number or one yes or no says of a simulated run: settling time, drift, whether a pose was held.

No postponed annotations here: yaml_load_typed reads the types at run time.
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
from dvrk_drake.models.schema_fault import number_fault, within


@dataclass
class Measure:
    """A measure of a run, as a study names it.

    Attributes:
        kind: one of `KINDS`.
        name: its column in the results; the kind if left out.
        band: [rad; m on a joint that slides]; the kind's own if left out.
        time: [s]; the kind's own if left out.
        joints: the joints that count, by name; all if left out.
    """

    kind: str = ""
    name: str = ""
    band: float | None = field(default=None, metadata=within(1e-9, 12.6, "rad or m"))
    time: float | None = field(default=None, metadata=within(1e-5, 3600.0, "s"))
    joints: list[str] = field(default_factory=list)

    @property
    def column(self) -> str:
        """What it is called in the results."""
        return self.name or self.kind

    @property
    def unit(self) -> str:
        """Of its numbers; "" of a share, and of a yes or no."""
        return KINDS[self.kind].unit

    @property
    def is_answer(self) -> bool:
        """Whether it is a yes or no, not a number."""
        return isinstance(self.worst, bool)

    @property
    def worst(self) -> float | bool:
        """What a run counts as that could not be simulated to its end."""
        return KINDS[self.kind].worst

    def check(self, scenario: Scenario) -> None:
        """Refuses what makes no sense for a scenario.

        Raises:
            StudyError: names the field, its value, and what is allowed.
        """
        if self.kind not in KINDS:
            raise StudyError(f'kind is "{self.kind}"; allowed: {", ".join(KINDS)}')
        if fault := number_fault(self):
            raise StudyError(fault)
        kind = KINDS[self.kind]
        for name, default in (("band", kind.band), ("time", kind.time)):
            value = getattr(self, name)
            if value is not None and default is None:
                raise StudyError(f"{self.kind} has no {name}")
        if unknown := sorted(set(self.joints) - set(scenario.mounted_arm.joint_names)):
            raise StudyError(
                f"joints of {self.column}: unknown {', '.join(unknown)}; {scenario.mounted_arm.name} has "
                f"{', '.join(scenario.mounted_arm.joint_names)}"
            )
        rest = scenario.duration - _arrival(scenario)
        if kind.time is not None and not 2 * scenario.sample_period <= self._time <= rest + 1e-9:
            raise StudyError(
                f"time of {self.column} is {self._time:g} s; allowed: {2 * scenario.sample_period:g}..{rest:g} s, from "
                "two samples to what is left of the scenario after start, last target and hand"
            )
        if self.kind == "overshoot" and not scenario.targets:
            raise StudyError("overshoot needs a scenario with targets")

    def __call__(self, scenario: Scenario, simulation: Simulation) -> float | bool:
        """Of a run: the worst of its joints."""
        arm = scenario.mounted_arm
        columns = [arm.joint_names.index(name) for name in self.joints or arm.joint_names]
        times, poses = scenario.knots()
        arrival, desired = _arrival(scenario), simulation.desired
        free = simulation.time >= (arrival - 1e-9 if desired is None else 0.0)
        q = simulation.state_true[free, : arm.num_joints]
        reference = np.broadcast_to(q[0], q.shape) if desired is None else desired
        run = _Run(
            t=simulation.time[free],
            q=q[:, columns],
            error=(q - reference)[:, columns],
            effort_share=(np.abs(simulation.recording.measured_effort()[free]) / arm.effort_limits)[:, columns],
            departure=float(times[-2]) if len(times) > 1 else 0.0,
            arrival=arrival,
            way=(poses[-1] - poses[-2])[columns] if len(poses) > 1 else np.zeros(len(columns)),
            goal=reference[-1, columns],
        )
        return KINDS[self.kind].of(run, self._band, self._time)

    @property
    def _band(self) -> float:
        return KINDS[self.kind].band or 0.0 if self.band is None else self.band

    @property
    def _time(self) -> float:
        return KINDS[self.kind].time or 0.0 if self.time is None else self.time


class _Run(NamedTuple):
    """Of the k joints that count: t (m,); q, error from the wanted pose, effort_share (m, k); way, goal (k,).

    `arrival` [s] is when the last target is to be reached, after `way` from the pose before, left at `departure`, and
    no hand holds the arm any more.
    """

    t: NDArray[np.float64]
    q: NDArray[np.float64]
    error: NDArray[np.float64]
    effort_share: NDArray[np.float64]
    departure: float
    arrival: float
    way: NDArray[np.float64]
    goal: NDArray[np.float64]

    def last(self, time: float) -> NDArray[np.bool_]:
        """(m,) the samples of the last `time` [s]."""
        return self.t >= self.t[-1] - time - 1e-9


def _arrival(scenario: Scenario) -> float:
    """When the last target is reached and no hand holds the arm any more [s]."""
    return max(float(scenario.knots()[0][-1]), *(point.time for point in scenario.hand.path), 0.0)


def _settling_time(run: _Run, band: float, time: float) -> float:
    outside = np.flatnonzero(np.any(np.abs(run.q - run.goal) > band, axis=1))
    if not len(outside):
        return 0.0
    if outside[-1] == len(run.t) - 1:
        return math.inf
    return max(0.0, float(run.t[outside[-1] + 1]) - run.arrival)


def _overshoot(run: _Run, band: float, time: float) -> float:
    q = run.q[run.t >= run.departure - 1e-9]
    return max(0.0, float(np.max(np.sign(run.way) * (q - run.goal))))


def _steady_error(run: _Run, band: float, time: float) -> float:
    return float(np.max(np.abs(run.error[run.last(time)].mean(axis=0))))


def _drift(run: _Run, band: float, time: float) -> float:
    q = run.q[run.last(time)]
    return float(np.max(np.abs(q - q[0])))


def _drift_rate(run: _Run, band: float, time: float) -> float:
    last = run.last(time)
    return float(np.max(np.abs(np.polyfit(run.t[last], run.q[last], 1)[0])))


def _effort_share(run: _Run, band: float, time: float) -> float:
    return float(np.max(run.effort_share))


def _held(run: _Run, band: float, time: float) -> bool:
    during = (run.t >= run.arrival - 1e-9) & (run.t <= run.arrival + time + 1e-9)
    return bool(np.all(np.abs(run.error[during]) <= band))


def _ran_away(run: _Run, band: float, time: float) -> bool:
    return bool(np.any(np.abs(run.error) > band))


class Kind(NamedTuple):
    """How a measure is computed: of a run, with band and time, whose defaults are None where there is no such thing."""

    of: Callable[[_Run, float, float], float | bool]
    unit: str
    band: float | None
    time: float | None
    worst: float | bool


#: The kinds of measures: of true positions at the recorded times, and of measured efforts, over the joints that count.
#: The wanted pose is where the controller leads the arm; in other modes than "hold" it is the pose at the release (the
#: start, or when the hand lets go), and nothing before counts.
#:
#: settling_time: from the last target's time until all joints stay within `band` of the end's wanted pose; infinite if
#: they do not.
#: overshoot: beyond the last target, in the direction of the way there.
#: steady_error: distance from the wanted pose, mean over the last `time`.
#: drift: largest distance, in the last `time`, from the pose at its beginning.
#: drift_rate: slope of the straight line through the last `time`.
#: effort_share: largest effort over the joint's limit.
#: held: within `band` of the wanted pose for `time` from the last target's time, or from the release.
#: ran_away: further than `band` from the wanted pose at any time.
KINDS = {
    "settling_time": Kind(_settling_time, "s", 1e-3, None, math.inf),
    "overshoot": Kind(_overshoot, "rad", None, None, math.inf),
    "steady_error": Kind(_steady_error, "rad", None, 1.0, math.inf),
    "drift": Kind(_drift, "rad", None, 5.0, math.inf),
    "drift_rate": Kind(_drift_rate, "rad/s", None, 5.0, math.inf),
    "effort_share": Kind(_effort_share, "", None, None, math.inf),
    "held": Kind(_held, "", 0.015, 10.0, False),
    "ran_away": Kind(_ran_away, "", 0.5, None, True),
}
