"""What a command guard allows, as a schema for yaml_load_typed.

No postponed annotations here: yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass, field

from dvrk_drake.errors import StationError

#: Lowest and highest value of each: outside, the guard would guard nothing, or nobody could command.
_ALLOWED = {
    "expiry": (0.002, 1.0),
    "measurement_age": (0.001, 0.1),
    "start_time": (0.05, 10.0),
    "clock_tolerance": (0.001, 1.0),
    "start_effort": (0.001, 0.25),
    "margin": (0.001, 0.3),
    "margin_fraction": (0.001, 0.25),
    "effort_fraction": (0.01, 1.0),
    "effort_rise_time": (0.002, 10.0),
    "traverse_time": (0.1, 100.0),
    "following_error": (0.01, 0.5),
    "following_time": (0.01, 1.0),
}


@dataclass
class PlausibilitySettings:
    """Tolerances of the plausibility checks of measurements, see `dvrk_drake.systems.guard.plausibility`.

    Attributes:
        position_tolerance: by which positions may step, and disagree with the velocities, beyond what follows
            [rad; a tenth of the number in m on a prismatic joint]; three encoder counts are added.
        jitter: by which the time between two measurements may be wrong [s].
        velocity_delay: largest delay of the velocity estimate [s].
        velocity_memory: time constant with which positions and velocities are compared [s].
        frozen_effort: change of effort under which a position must change, as a fraction of the effort limit.
        frozen_time: for which a position may stay the same under that change [s].
        frozen_speed: at which a joint takes the time that it is given to move by an encoder count [rad/s, m/s].
        response: effort that the motion does not explain, as a fraction of the effort limit.
        response_time: time constant of the filters of effort and acceleration [s].
        response_memory: time constant with which unexplained effort that lasts is accepted as an error of the model [s].
        start_gravity: difference of measured effort and gravity effort at which efforts may start, as a fraction of the
            effort limit.
        silent_effort: commanded effort that must show in the measured one, as a fraction of the effort limit.
        silent_time: within which it must [s].
        detection_time: age of the pose that is taken as valid when a fault is found [s].
        bad_samples: number of measurements in a row that may be late or not finite while the arm holds.
    """

    position_tolerance: float = 0.01
    jitter: float = 0.02
    velocity_delay: float = 0.03
    velocity_memory: float = 0.3
    frozen_effort: float = 0.45
    frozen_time: float = 0.01
    frozen_speed: float = 0.1
    response: float = 1.5
    response_time: float = 0.03
    response_memory: float = 0.2
    start_gravity: float = 0.25
    silent_effort: float = 0.3
    silent_time: float = 0.02
    detection_time: float = 0.03
    bad_samples: int = 20


@dataclass
class GuardSettings:
    """What a command guard allows.

    Attributes:
        expiry: age at which a command is not obeyed any more, counted from the measurement that it answers [s]; and
            how long a sender must be silent before another may follow it.
        measurement_age: above this age a measurement is none [s].
        start_time: how long commands must be good before they act [s].
        clock_tolerance: by how much a sender's clock and the arm's may differ between two commands [s].
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
        oscillation: RMS of the alternating part of the commanded effort, as a fraction of the effort limit.
        oscillation_time: time constant of that RMS [s].
        resume_automatically: whether commands may act again after the watchdog took over, without an operator's reset.
        plausibility: tolerances of the checks of measurements.
    """

    expiry: float = 0.05
    measurement_age: float = 0.02
    start_time: float = 0.25
    clock_tolerance: float = 0.05
    start_effort: float = 0.1
    margin: float = 0.05
    margin_fraction: float = 0.05
    effort_fraction: float = 1.0
    effort_rise_time: float = 0.02
    traverse_time: float = 0.5
    following_error: float = 0.15
    following_time: float = 0.2
    fault_effort: float = 0.3
    slow_period: float = 0.005
    longest_period: float = 0.04
    oscillation: float = 0.45
    oscillation_time: float = 1.0
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
        for name, (lowest, highest) in _ALLOWED.items():
            if not lowest <= (value := getattr(self, name)) <= highest:
                raise StationError(f"guard settings: {name} must be {lowest:g} to {highest:g}; got {value}")
