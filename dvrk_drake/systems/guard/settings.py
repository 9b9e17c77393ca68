"""What a command guard allows, as a schema for yaml_load_typed.

No postponed annotations here: yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass, field

from dvrk_drake.errors import StationError
from dvrk_drake.models.schema_fault import number_fault, within


@dataclass
class PlausibilitySettings:
    """Tolerances of the plausibility checks of measurements, see `dvrk_drake.systems.guard.plausibility`.

    Attributes:
        position_tolerance: by which positions may step, and disagree with the velocities, beyond what follows
            [rad; a tenth of the number in m on a prismatic joint]; three encoder counts are added.
        jitter: by which the time between two measurements may be wrong [s].
        velocity_delay: largest delay of the velocity estimate [s].
        velocity_counts: rate of encoder counts by which a velocity may be wrong [1/s]: an estimate from the time
            between two counts keeps its last value for a while when none comes.
        velocity_memory: time constant with which positions and velocities are compared [s].
        frozen_effort: change of effort under which a position must change, as a fraction of the effort limit.
        frozen_time: for which a position may stay the same under that change [s].
        frozen_speed: at which a joint takes the time that it is given to move by an encoder count [rad/s, m/s].
        response: effort that the motion does not explain, as a fraction of the effort limit, beyond `hand_effort`.
        hand_effort: on a wrist, of a hand or a wrong model [N m; ten times the number in N on a prismatic joint].
        response_time: time constant of the filters of effort and acceleration [s].
        response_memory: time constant with which unexplained effort that lasts is taken as an error of the model [s].
        start_gravity: difference of measured effort and gravity effort at which efforts may start, as a fraction of the
            effort limit, beyond the arm's dry friction and `hand_effort`.
        silent_effort: commanded effort that must show in the measured one, as a fraction of the effort limit.
        silent_time: within which it must [s].
        detection_time: age of the pose that is taken as valid when a fault is found [s].
        bad_samples: number of measurements in a row that may be late or not finite while the arm holds.
    """

    position_tolerance: float = field(default=0.01, metadata=within(0.001, 0.1, "rad"))
    jitter: float = field(default=0.03, metadata=within(0.0, 0.1, "s"))
    velocity_delay: float = field(default=0.03, metadata=within(0.001, 0.1, "s"))
    velocity_counts: float = field(default=150.0, metadata=within(0.0, 2000.0, "1/s"))
    velocity_memory: float = field(default=0.15, metadata=within(0.05, 2.0, "s"))
    frozen_effort: float = field(default=0.45, metadata=within(0.05, 1.0))
    frozen_time: float = field(default=0.01, metadata=within(0.002, 1.0, "s"))
    frozen_speed: float = field(default=0.1, metadata=within(0.001, 10.0, "rad/s"))
    response: float = field(default=1.3, metadata=within(0.2, 5.0))
    hand_effort: float = field(default=0.06, metadata=within(0.0, 5.0, "N m"))
    response_time: float = field(default=0.03, metadata=within(0.005, 0.5, "s"))
    response_memory: float = field(default=0.2, metadata=within(0.02, 10.0, "s"))
    start_gravity: float = field(default=0.1, metadata=within(0.02, 2.0))
    silent_effort: float = field(default=0.3, metadata=within(0.05, 1.0))
    silent_time: float = field(default=0.02, metadata=within(0.002, 1.0, "s"))
    detection_time: float = field(default=0.03, metadata=within(0.005, 0.5, "s"))
    bad_samples: int = field(default=20, metadata=within(0, 100))


@dataclass
class GuardSettings:
    """What a command guard allows.

    The range of each setting stands beside it; outside, the guard would guard nothing, or nobody could command.

    Attributes:
        expiry: age at which a command is not obeyed any more, counted from the measurement that it answers [s]; and
            how long a sender must be silent before another may follow it.
        measurement_age: above this age a measurement is none [s].
        start_time: how long commands must be good before they act [s].
        clock_tolerance: by how much a sender's clock and the arm's may differ between two commands [s].
        sequence_jump: by how much the sequence of a sender's commands may grow from one to the next; 1000 is one second
            at 1 kHz. A command beyond it is refused.
        start_effort: how far from the present effort effort commands may start, as a fraction of the effort limit.
        margin: least width of the soft wall before each position limit [rad], how far from the present pose position
            commands may start, and twice how far beyond a limit is a fault while efforts act; at most
            `margin_fraction` of the range, which counts on short or prismatic joints.
        margin_fraction: see margin.
        effort_fraction: of each effort limit that effort commands may use; soft wall and brake always have all of it.
        effort_rise_time: in which the commanded effort may grow from zero to its limit [s].
        traverse_time: in which a joint may cross its range [s]: the speed that it may have. Commanded positions go no
            faster, and while efforts act it is braked above.
        following_error: how far from its commanded position a joint may be, as a fraction of its range.
        following_time: how late the arm's position controller may follow [s]; a PD controller: Kd/Kp.
        fault_effort: that held joints may use after a fault of a measurement, as a fraction of the effort limit; where
            gravity needs nearly as much or more, a third of it beyond the gravity effort.
        slow_period: largest median of the last 100 periods between two steps of the guard [s].
        longest_period: largest time between two steps of the guard [s].
        oscillation: alternating part of the commanded effort that counts as a reversal, as a fraction of the effort
            limit.
        oscillation_reversals: number of them, fading with `oscillation_time`, that is allowed.
        oscillation_time: see oscillation_reversals [s].
        resume_automatically: whether commands may act again after the watchdog took over, without an operator's reset.
        plausibility: tolerances of the checks of measurements.
    """

    expiry: float = field(default=0.05, metadata=within(0.002, 1.0, "s"))
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
        """Refuses settings that switch the guard off.

        Raises:
            StationError: one is outside its range.
        """
        if not isinstance(self.resume_automatically, bool):
            raise StationError(
                f"guard settings: resume_automatically must be true or false; got {self.resume_automatically}"
            )
        if fault := number_fault(self):
            raise StationError(f"guard settings: {fault}")
