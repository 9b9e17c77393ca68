"""What a command guard allows, as a schema for yaml_load_typed.

No postponed annotations here: yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass, field

from dvrk_drake.errors import StationError
from dvrk_drake.models.schema_fault import number_fault, within


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
    """

    expiry: float = field(default=0.05, metadata=within(0.002, 1.0, "s"))
    measurement_age: float = field(default=0.02, metadata=within(0.001, 0.1, "s"))
    start_time: float = field(default=0.25, metadata=within(0.05, 10.0, "s"))
    clock_tolerance: float = field(default=0.05, metadata=within(0.001, 1.0, "s"))
    start_effort: float = field(default=0.1, metadata=within(0.001, 0.25))
    margin: float = field(default=0.05, metadata=within(0.001, 0.3, "rad"))
    margin_fraction: float = field(default=0.05, metadata=within(0.001, 0.25))
    effort_fraction: float = field(default=1.0, metadata=within(0.01, 1.0))
    effort_rise_time: float = field(default=0.02, metadata=within(0.002, 10.0, "s"))
    traverse_time: float = field(default=0.5, metadata=within(0.1, 100.0, "s"))
    following_error: float = field(default=0.15, metadata=within(0.01, 0.5))
    following_time: float = field(default=0.2, metadata=within(0.01, 1.0, "s"))

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Refuses settings that switch the guard off.

        Raises:
            StationError: one is outside its range.
        """
        if fault := number_fault(self):
            raise StationError(f"guard settings: {fault}")
