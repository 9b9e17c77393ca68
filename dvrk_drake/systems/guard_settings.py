"""What a command guard allows, as a schema for yaml_load_typed.

No postponed annotations here: yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass

from dvrk_drake.errors import StationError


@dataclass
class GuardSettings:
    """What a command guard allows.

    Attributes:
        expiry: age at which a command is not obeyed any more [s].
        start_time: how long commands must be good before they act [s].
        clock_tolerance: by how much a sender's clock and the arm's may differ between two commands [s].
        start_effort: how far from the present effort effort commands may start, as a fraction of the effort limit.
        margin: width of the soft wall before each position limit [rad], and how far from the present pose position
            commands may start; at most `margin_fraction` of the range, which counts on short or prismatic joints.
        margin_fraction: see margin.
        effort_rise_time: in which the commanded effort may grow from zero to its limit [s].
        traverse_time: in which a joint may cross its range [s]: the speed that it may have. Commanded positions go no
            faster, and while efforts act it is braked above.
    """

    expiry: float = 0.05
    start_time: float = 0.25
    clock_tolerance: float = 0.05
    start_effort: float = 0.1
    margin: float = 0.05
    margin_fraction: float = 0.05
    effort_rise_time: float = 0.02
    traverse_time: float = 0.5

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Refuses settings that switch the guard off.

        Raises:
            StationError: one is not positive, or commands would act for longer than a second without a sender.
        """
        for name, value in vars(self).items():
            if not 0 < value < 10:
                raise StationError(f"guard settings: {name} must be above 0 and below 10; got {value}")
        if self.expiry > 1.0:
            raise StationError(f"guard settings: expiry must be at most 1 s; got {self.expiry}")
