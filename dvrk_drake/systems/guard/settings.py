"""What a command guard allows, as a schema for yaml_load_typed.

No postponed annotations here: yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass

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
        resume_automatically: whether commands may act again after the watchdog took over, without an operator's reset.
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
    resume_automatically: bool = False

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
