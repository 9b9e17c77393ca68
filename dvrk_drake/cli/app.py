"""Command-line application: groups of commands, and options that several commands share.

An option has the same name in all commands. Input files (recordings, scenarios, studies) are positional arguments.
All other arguments are options: --arm, --model, --output (a file), --folder, --plots (a folder), --json, --overwrite,
--verbose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, ArgumentCollection, Group, Parameter, Token

app = App(
    name="dvrk-drake",
    help="Model, identify, compensate and simulate da Vinci Research Kit arms with Drake.",
    version=lambda: version("dvrk-drake"),
    help_format="plaintext",
    group_parameters=Group("Options", sort_key=1),
    default_parameter=Parameter(negative=()),
)
MODEL, IDENTIFY, SIMULATE, HARDWARE, PAPER, OPTIONS = (
    Group.create_ordered(name) for name in ("Model", "Identify", "Simulate", "Hardware", "Paper", "Options")
)
app["--help"].group = app["--version"].group = OPTIONS
app.register_install_completion_command(
    name="--install-completion", group=OPTIONS, help="Install the completion of commands for this shell."
)


def _complete_arm(_: Any) -> list[str]:
    # Equivalent to `known_arms`, but without importing Drake, so that --help and shell completion stay fast.
    arms = Path(__file__).parents[1] / "models/arms"
    return sorted(path.stem for path in arms.glob("*.yaml"))


def _check_seconds(_: object, value: float | None) -> None:
    if value is not None and not (math.isfinite(value) and value > 0):
        raise ValueError("must be a number of seconds above 0")


def whole_number(_: object, tokens: Sequence[Token]) -> int:
    """Converts a string to an integer. The conversion of cyclopts would round 1.5."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f'must be a whole number, not "{tokens[0].value}"') from None


def _check_seed(_: object, value: int) -> None:
    if value < 0:
        raise ValueError("must be a whole number from 0")


def one_of(title: str, least: int = 1) -> Group:
    """Returns a group of mutually exclusive options, of which at least `least` (0 or 1) is given."""

    def check(arguments: ArgumentCollection) -> None:
        if not least <= sum(argument.has_tokens for argument in arguments) <= 1:
            names = ", ".join(argument.name for argument in arguments)
            raise ValueError(f"give {'one' if least else 'at most one'} of {names}")

    return Group(title, validator=check, sort_key=0)


Arm = Annotated[str, Parameter(metavar="ARM", completer=_complete_arm, help="mtml, mtmr, psm, or an arm's YAML file.")]
Model = Annotated[str, Parameter(metavar="MODEL.yaml", help="An identified model, from identify.")]
Coordinates = Annotated[Literal["joint", "actuator"], Parameter(help="Coordinates of q and tau in a CSV recording.")]
Gravity = Annotated[
    tuple[float, float, float] | None,
    Parameter(
        metavar="X Y Z",
        help="Gravity in the arm's base frame [m/s^2], for another mounting. Without it: 0 0 -9.81 or as in its file.",
    ),
]
Overwrite = Annotated[bool, Parameter(show_default=False, help="Replace files that exist. Without it they are kept.")]
Verbose = Annotated[bool, Parameter(alias="-v", show_default=False, help="Print all details, not only the summary.")]
Plots = Annotated[str | None, Parameter(metavar="FOLDER", help="Write figures into this folder, new or empty.")]
Json = Annotated[str | None, Parameter(metavar="FILE", help="Write the results as JSON.")]
Seed = Annotated[int, Parameter(converter=whole_number, validator=_check_seed, help="Seed of random numbers.")]
Seconds = Annotated[float, Parameter(metavar="S", validator=_check_seconds)]
Port = Annotated[int | None, Parameter(converter=whole_number, help="Port of the page. Without it: a free one.")]
LcmUrl = Annotated[
    str, Parameter(metavar="URL", show_default=False, help="LCM network. Without it: LCM_DEFAULT_URL, or LCM's own.")
]
Key = Annotated[
    str | None,
    Parameter(metavar="FILE", help="Key from dvrk-drake key that signs messages, the same on both sides."),
]
Realtime = Annotated[
    bool, Parameter(show_default=False, help="Ask for real-time scheduling; a warning where it is not permitted.")
]
Set = Annotated[
    list[str] | None, Parameter(metavar="KEY=VALUE", help="Change a value of the scenario; repeat for more.")
]
