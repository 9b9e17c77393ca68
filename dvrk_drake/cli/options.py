"""Command-line application: groups of commands, and options that several commands share.

An option has the same name in all commands. Input files (recordings, scenarios, studies), the file of `record` and the
folder of `samples` are positional arguments. All other arguments are options, e.g. --arm, --model, --output (a file),
--folder, --plots (a folder), --json, --overwrite and --verbose.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from cyclopts import App, ArgumentCollection, Group, Parameter, Token, validators

import dvrk_drake as dvrk
from dvrk_drake.errors import DvrkDrakeError, RecordingError

if TYPE_CHECKING:
    from dvrk_drake.progress import Progress

Value = TypeVar("Value")

app = App(
    name="dvrk-drake",
    help="Model, identify, compensate and simulate da Vinci Research Kit arms with Drake.",
    version=lambda: version("dvrk-drake"),
    help_format="plaintext",
    group_parameters=Group("Options", sort_key=1),
    default_parameter=Parameter(negative=()),
)
MODEL, IDENTIFY, SIMULATE, HARDWARE, OPTIONS = (
    Group.create_ordered(name) for name in ("Model", "Identify", "Simulate", "Hardware", "Options")
)
simulate = App(name="simulate", group=SIMULATE)
export = App(name="export", group=MODEL)
identify = App(name="identify", group=IDENTIFY)
bridge = App(name="bridge", group=HARDWARE)
collect = App(name="collect", group=HARDWARE, help="Measure an arm: teach poses, collect static poses or a motion.")
for _group in (simulate, export, identify, bridge, collect):
    app.command(_group)
app["--help"].group = app["--version"].group = OPTIONS
app.register_install_completion_command(
    name="--install-completion", group=OPTIONS, help="Install command completion for the current shell."
)


def _complete_arm(_: Any) -> list[str]:
    # Equivalent to `known_arms`, but without importing Drake, so that --help and shell completion stay fast.
    arms = Path(__file__).parents[1] / "models/arms"
    return sorted(path.stem for path in arms.glob("*.yaml"))


def _check_seconds(_: object, value: float | None) -> None:
    if value is not None and not (math.isfinite(value) and value > 0):
        raise ValueError("must be a number of seconds greater than 0")


def whole_number(_: object, tokens: Sequence[Token]) -> int:
    """Converts a string to an integer. The default conversion of cyclopts would round 1.5 instead of rejecting it."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f'must be a whole number, not "{tokens[0].value}"') from None


def one_of(title: str) -> Group:
    """Returns a group of options of which exactly one is required."""

    def check(arguments: ArgumentCollection) -> None:
        if sum(argument.has_tokens for argument in arguments) != 1:
            names = ", ".join(argument.name for argument in arguments)
            raise ValueError(f"give exactly one of {names}")

    return Group(title, validator=check, sort_key=0)


Arm = Annotated[
    str,
    Parameter(
        metavar="ARM",
        completer=_complete_arm,
        help="ecm, ecm_si, mtml, mtmr, psm, psm_si, or the path of a YAML, URDF, SDF or MJCF file.",
    ),
]
Instrument = Annotated[
    str,
    Parameter(
        metavar="NAME",
        show_default=False,
        help="Instrument of the dVRK, e.g. PROGRASP_FORCEPS_420093, or the path of its file. Default: that of the arm.",
    ),
]


def with_instrument(arm: str, instrument: str) -> str:
    """Returns the argument of `load_arm` for an arm with the instrument given with --instrument."""
    return f"{arm}+{instrument}" if instrument else arm


Model = Annotated[str, Parameter(metavar="MODEL.yaml", help="Model file, written by identify.")]


def gravity_vector(_: object, tokens: Sequence[Token]) -> tuple[float, float, float]:
    """Converts the words after --gravity (a vector) or --mount (the orientation of the base) to a gravity vector."""
    words, keywords = [token.value for token in tokens], {token.keyword or "" for token in tokens}
    if len(keywords) > 1:
        raise ValueError("--gravity and --mount exclude each other; give one of them")
    is_mount, is_file = keywords == {"--mount"}, len(words) == 1 and words[0].lower().endswith(".json")
    try:
        if is_mount and is_file:
            from dvrk_drake.export.dvrk_psm_gravity_compensation import configured_pitch

            numbers = [configured_pitch(words[0])]
        elif is_mount and len(words) == 1 and words[0].startswith("/"):
            from dvrk_drake.systems.ros.discovery import topic_gravity

            return topic_gravity(words[0])
        else:
            numbers = [float(word) for word in words]
    except DvrkDrakeError as error:
        raise ValueError(str(error)) from None
    except ValueError:
        raise ValueError(f"{min(keywords)}: {' '.join(words)!r} are not numbers") from None
    if is_mount:
        from dvrk_drake.models.arm import mount_gravity

        if len(numbers) not in (1, 3) or not all(abs(x) <= 2 * math.pi for x in numbers):
            raise ValueError("--mount needs roll, pitch and yaw, or mounting_pitch, up to 6.28 rad, a file, or a topic")
        return mount_gravity(*numbers)
    if len(numbers) != 3:
        raise ValueError("--gravity needs three numbers [m/s^2]")
    return numbers[0], numbers[1], numbers[2]


GRAVITY_HELP = (
    "Gravity vector in the base frame of the arm [m/s^2], for a tilted base. With --mount instead: roll, pitch and yaw "
    "of the base [rad], mounting_pitch of the dVRK [rad], the configuration of the arm in the dVRK (JSON), or a ROS 2 "
    "topic of its setup joints, e.g. /SUJ/PSM1/local/measured_cp."
)
Gravity = Annotated[
    tuple[float, float, float] | None,
    Parameter(
        metavar="X Y Z",
        alias="--mount",
        converter=gravity_vector,
        n_tokens=-1,
        consume_multiple=True,
        help=f"{GRAVITY_HELP} Default: the vector in the arm file.",
    ),
]
Table = Annotated[
    float | None, Parameter(metavar="Z", help="Height of a table in the base frame [m]. The arm must not touch it.")
]
EnvironmentFile = Annotated[
    str | None,
    Parameter(
        metavar="FILE.dmd.yaml",
        help="Drake model directives of fixed objects in the base frame that the arm must not touch, e.g. another arm.",
    ),
]
Locked = Annotated[
    list[str] | None,
    Parameter(
        metavar="NAME=POSITION ..",
        consume_multiple=True,
        help="Joints that were held and are not in the recording, with their positions [rad; m if prismatic], e.g. "
        "roll=0. In a CSV, q1, q2, ... are the other joints.",
    ),
]
Overwrite = Annotated[
    bool, Parameter(show_default=False, help="Replace existing files, and write into folders that are not empty.")
]
Verbose = Annotated[bool, Parameter(alias="-v", show_default=False, help="Print all details.")]
Seed = Annotated[
    int,
    Parameter(
        converter=whole_number,
        validator=validators.Number(gte=0),
        help="Seed of the random number generator, 0 or larger.",
    ),
]
Seconds = Annotated[float, Parameter(metavar="S", validator=_check_seconds)]
Port = Annotated[int | None, Parameter(converter=whole_number, help="TCP port of the web page. Default: a free port.")]
LcmUrl = Annotated[
    str,
    Parameter(
        metavar="URL",
        show_default=False,
        help="URL of the LCM network. Default: $LCM_DEFAULT_URL, or else the default URL of LCM.",
    ),
]
Key = Annotated[
    str | None,
    Parameter(
        metavar="FILE",
        help="File with the key to sign and verify messages. dvrk-drake keygen creates this file. "
        "The arm and the controller need the same key.",
    ),
]
Set = Annotated[
    list[str] | None,
    Parameter(metavar="KEY=VALUE", help="Change a value of the scenario. Repeat the option to change several values."),
]


Recording = Annotated[
    str, Parameter(help="CSV, ROS bag (.bag, sqlite3, MCAP), MATLAB file, NumPy archive, cisst collector or LCM log.")
]
RosTopic = Annotated[
    str | None,
    Parameter(metavar="TOPIC", help="ROS 2 topic measured_js of the arm, or its namespace. Default: /<ARM>."),
]
RosDomain = Annotated[
    int | None,
    Parameter(metavar="N", converter=whole_number, help="ROS domain. Default: $ROS_DOMAIN_ID, or else 0."),
]
Realtime = Annotated[
    bool,
    Parameter(show_default=False, help="Request real-time scheduling. Print a warning if it is not permitted."),
]

PublishForce = Annotated[
    bool,
    Parameter(
        show_default=False,
        help="Publish the external force at the tip with its covariance (docs/external_force.md). It requires a "
        "--model that was identified from a motion.",
    ),
]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ConnectedArm:
    """Options of all commands for an arm over LCM or ROS 2."""

    arm: Arm
    instrument: Instrument = ""
    transport: Annotated[
        Literal["lcm", "ros"], Parameter(help="lcm: messages of dvrk_drake. ros: topics of a dVRK on ROS 2.")
    ] = "lcm"
    lcm_url: LcmUrl = ""
    key: Key = None
    topic: RosTopic = None
    domain: RosDomain = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "arm", with_instrument(self.arm, self.instrument))

    @property
    def is_ros(self) -> bool:
        """True if the arm is on ROS 2."""
        return self.transport == "ros"

    def check(self, *, lcm: Mapping[str, object] | None = None, ros: Mapping[str, object] | None = None) -> None:
        """Rejects options of the other transport.

        Args:
            lcm: Values of more options for LCM, by name. None, "" or False: the option was not given.
            ros: Values of more options for ROS 2.

        Raises:
            DvrkDrakeError: An option of the other transport was given.
        """
        if self.is_ros:
            values, own = {"lcm_url": self.lcm_url, "key": self.key, **(lcm or {})}, "lcm"
        else:
            values, own = {"topic": self.topic, "domain": self.domain, **(ros or {})}, "ros"
        if given := [f"--{name.replace('_', '-')}" for name, value in values.items() if is_given(value)]:
            raise DvrkDrakeError(f"{' and '.join(given)}: only with --transport {own}")

    def as_text(self) -> str:
        """Returns the options that select the arm and its model, for another command line."""
        names = ("arm", "transport", "lcm_url", "key", "topic", "domain", "model")
        values = {name: getattr(self, name, None) for name in names}
        return options_text(values | {"transport": "ros" if self.is_ros else None})

    def connect(self, dialog: dvrk.Dialog, **settings: Any) -> dvrk.ArmConnection:
        """Returns the connection to the arm. See `dvrk_drake.connect` for `settings`."""
        connection = dvrk.connect(
            dvrk.load_arm(self.arm),
            self.transport,
            lcm_url=self.lcm_url,
            key=self.key,
            topic=self.topic,
            domain=self.domain,
            dialog=dialog,
            **settings,
        )
        connection.options = self.as_text()
        return connection


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ControlledArm(ConnectedArm):
    """Options of the commands that control an arm over LCM or ROS 2."""

    model: Annotated[
        Model | None, Parameter(help="Model file, written by identify. Default: the nominal model from the SDF.")
    ] = None
    realtime: Realtime = False
    reset: Annotated[
        bool,
        Parameter(
            show_default=False,
            help="Print and clear a fault of the arm. If the watchdog of the guard holds the arm, resume control.",
        ),
    ] = False


def is_given(value: object) -> bool:
    """Returns whether the value of an option differs from that of an absent option: None, "" or False."""
    return value is not False and value not in (None, "")


def options_text(values: Mapping[str, object]) -> str:
    """Returns options for a command line, by the names of their parameters. Options that are not given are omitted."""
    words = []
    for name, value in values.items():
        if is_given(value):
            texts = value if isinstance(value, list) else [] if value is True else [f"{value}"]
            words += [f"--{name.replace('_', '-')}", *map(shlex.quote, texts)]
    return " ".join(words)


#: Accepted words of --arrays.
_ARRAYS = "NAME=VALUE, e.g. q=position; names: q, qd, tau, t, poses"
_FILE = Group("Options for the file (docs/recordings.md)", sort_key=2)


@Parameter(name="*", group=_FILE)
@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """Options for facts that the file of a recording may not state, for all commands that read recordings."""

    coordinates: Annotated[
        Literal["joint", "actuator", "wpi"] | None,
        Parameter(
            help="Coordinates of q, qd and tau. wpi: actuator, except for the roll of a PSM. Default: as stated by "
            "the file, wpi for a CSV of an arm of this package with 21 columns and no header, or else joint."
        ),
    ] = None
    topic: Annotated[
        str | None,
        Parameter(
            metavar="TOPIC",
            help="ROS bag: JointState topic or its namespace. Collector: signal. Default: measured_js of the arm.",
        ),
    ] = None
    joints: Annotated[
        list[str] | None,
        Parameter(
            metavar="NAME=NAME_IN_FILE ..",
            consume_multiple=True,
            help="Names of joints in the file, e.g. yaw=outer_yaw. CSV with a header: yaw=2 selects q2, qd2 and tau2. "
            "Default: the names of the arm, or 1, 2, ...",
        ),
    ] = None
    arrays: Annotated[
        list[str] | None,
        Parameter(
            metavar="NAME=ARRAY ..",
            consume_multiple=True,
            help="MATLAB file, NumPy archive: names of arrays, e.g. q=log.position tau=log.effort. Default: recognised "
            "names.",
        ),
    ] = None
    rate: Annotated[
        float | None,
        Parameter(
            metavar="HZ",
            help="Sampling rate of a motion without times. Default: 200 for a CSV with 21 columns and no header; other "
            "files without times contain static poses.",
        ),
    ] = None
    effort_scale: Annotated[
        list[str] | None,
        Parameter(
            metavar="FACTOR | NAME=FACTOR ..",
            consume_multiple=True,
            help="Factors of the recorded efforts, e.g. torque constant times gear ratio for currents: one for all "
            "joints, or factors of some joints, e.g. elbow=11.8.",
        ),
    ] = None
    skip_invalid: Annotated[
        bool, Parameter(show_default=False, help="Omit rows with an empty cell, NaN or an infinite value.")
    ] = False

    def read(self, path: str, arm: dvrk.Arm | None, progress: Progress) -> dvrk.Recording:
        """Reads a recording with these options. Raises RecordingError as `read_recording`."""
        return dvrk.read_recording(path, arm, progress=progress, **self.as_arguments())

    def as_arguments(self) -> dict[str, Any]:
        """Returns the keyword arguments of `read_recording`."""
        return vars(self) | {
            "joints": self.joints and named("joints", self.joints, "NAME=VALUE, e.g. yaw=outer_yaw", str),
            "arrays": self.arrays and named("arrays", self.arrays, _ARRAYS, str),
            "effort_scale": _factors(self.effort_scale),
        }

    def as_text(self) -> str:
        """Returns the options for a command line, beginning with a space, or ""."""
        text = options_text(vars(self))
        return text and f" {text}"


def _factors(texts: Sequence[str] | None) -> dict[str, float] | float | None:
    """Returns the factor or the factors of --effort-scale."""
    if texts is None:
        return None
    if len(texts) == 1 and "=" not in texts[0]:
        return named("effort-scale", [f"all={texts[0]}"], "one number, or NAME=NUMBER, e.g. elbow=11.8", float)["all"]
    return named("effort-scale", texts, "one number, or NAME=NUMBER, e.g. elbow=11.8", float)


def named(option: str, texts: Sequence[str], form: str, convert: Callable[[str], Value]) -> dict[str, Value]:
    """Returns the mapping of an option with words NAME=VALUE.

    Args:
        option: Name of the option.
        texts: Words of the option.
        form: Description of the accepted words, with an example.
        convert: Function that converts a value, and raises ValueError if it is not valid.

    Raises:
        RecordingError: A word is not valid, or a name is given twice.
    """
    values: dict[str, Value] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            if not (name and value):
                raise ValueError
            converted = convert(value)
        except ValueError:
            raise RecordingError(f"--{option} {text}: allowed: {form}") from None
        if name in values:
            raise RecordingError(f"--{option}: {name} is given twice; give it once")
        values[name] = converted
    return values


def given(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the values that are not None, i.e. the options that are given."""
    return {name: value for name, value in values.items() if value is not None}
