"""Command that calibrates a connected arm: a sequence of other commands, each with named files in one folder."""

# This file has no postponed annotations, because load_typed_yaml reads the types at run time.
import ctypes
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dvrk_drake.cli.app import HARDWARE, Arm, Gravity, Key, LcmUrl, Realtime, Seconds, Seed, app, whole_number
from dvrk_drake.cli.support import mounted, print_written
from dvrk_drake.errors import CollectionError, DvrkDrakeError
from dvrk_drake.models.schema_fault import number_fault, within

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm as LoadedArm

#: Names of the files in the folder.
SETTINGS, NOMINAL, STATIC, DYNAMIC = "calibration.yaml", "nominal.yaml", "static.yaml", "model.yaml"
#: Number of the poses with which the static model is validated.
TEST_POSES = 10
#: Options of the motion with which the full dynamics is validated. It has other frequencies than the first motion.
TEST_MOTION = ("--duration", "20", "--period", "20", "--harmonics", "10", "--starts", "1")
#: Time after which a signal is sent to the running command, which may have received it from the terminal [s].
_FORWARD = 0.5
_SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP


@dataclass
class CalibrationSettings:
    """Schema of the settings file of a calibration.

    Attributes:
        format: Format of the file.
        arm: Name of the arm, or path of an arm file.
        poses: Number of static poses.
        duration: Duration of the motion [s].
        seed: Seed of the designs.
        gravity: Gravity vector in the base frame [m/s^2], or an empty list for the vector in the arm file.
        table: Height of a table in the base frame [m], or None.
    """

    format: str = "dvrk_drake calibration 1"
    arm: str = ""
    poses: int = field(default=40, metadata=within(8, 300))
    duration: float = field(default=30.0, metadata=within(15.0, 3600.0, "s"))
    seed: int = field(default=0, metadata=within(0, 1_000_000))
    gravity: list[float] = field(default_factory=list, metadata=within(-20.0, 20.0, "m/s^2"))
    table: float | None = field(default=None, metadata=within(-10.0, 10.0, "m"))

    def __post_init__(self) -> None:
        if fault := number_fault(self):
            raise CollectionError(f"settings of the calibration: {fault}")


@dataclass(frozen=True)
class Step:
    """Step of a calibration.

    Attributes:
        title: Description for the user.
        words: Command that runs in the folder of the calibration, without the name of the program.
        done: Function that returns whether the step is complete.
        moves: Whether the command moves the arm.
        is_required: Whether the calibration ends if the command fails.
    """

    title: str
    words: tuple[str, ...]
    done: Callable[[], bool]
    moves: bool = False
    is_required: bool = True


@app.command(group=HARDWARE)
def calibrate(
    *,
    arm: Arm,
    output: Annotated[str, Parameter(metavar="FOLDER")],
    poses: Annotated[int, Parameter(metavar="N", converter=whole_number)] = 40,
    duration: Seconds = 30.0,
    seed: Seed = 0,
    gravity: Gravity = None,
    table: Annotated[float | None, Parameter(metavar="Z")] = None,
    lcm_url: LcmUrl = "",
    key: Key = None,
    realtime: Realtime = False,
    reset: Annotated[bool, Parameter(show_default=False)] = False,
    yes: Annotated[bool, Parameter(show_default=False)] = False,
) -> None:
    """Calibrate a connected arm: design, collect, identify, validate and export, with one command.

    The command runs other commands of dvrk-drake and prints them. Ctrl-C ends the calibration, and the arm holds its
    pose. The same command continues the calibration. Enter pauses a motion.

    Args:
        output: Folder for all files. An existing calibration in this folder is continued.
        poses: Number of static poses, 8 to 300.
        duration: Duration of the motion, at least 15 s.
        table: Height of a table in the base frame [m].
        reset: Print and clear a fault of the arm before it moves. If the watchdog of the guard holds the arm, resume
            control.
        yes: Move the arm without a question on the terminal.
    """
    began = time.monotonic()
    folder = Path(output)
    settings = CalibrationSettings(
        arm=_absolute(arm),
        poses=poses,
        duration=duration,
        seed=seed,
        gravity=list(gravity or ()),
        table=table,
    )
    loaded = _prepare(folder, settings)
    connection = [f"--lcm-url={lcm_url}"] if lcm_url else []
    connection += ["--key", _absolute(key)] if key else []
    connection += ["--realtime"] if realtime else []
    count, moving = len(calibration_steps(folder, settings, loaded)), 0.0
    for number in range(count):
        # The commands depend on the files of the earlier steps.
        step = calibration_steps(folder, settings, loaded)[number]
        header = f"[{number + 1}/{count}] {step.title}"
        if step.done():
            print(f"{header}: done", flush=True)
            continue
        words = list(step.words)
        if step.moves:
            words += connection + (["--reset"] if reset else [])
            reset = False
        print(f"{header}: dvrk-drake {shlex.join(words)}", flush=True)
        if step.moves and not yes and sys.stdin is not None and sys.stdin.isatty():
            input(f"Clear the workspace of {loaded.name}. Enter starts the motion, Ctrl-C ends the command. ")
        started = time.monotonic()
        code = _run(words, folder)
        moving += step.moves * (time.monotonic() - started)
        if code == 130:
            raise KeyboardInterrupt
        if code and step.is_required:
            raise DvrkDrakeError(
                f"{step.title} failed; the line above states the reason. The same command continues the calibration"
            )
    _print_result(folder, loaded, settings.arm)
    minutes = (time.monotonic() - began) / 60
    print(f"{minutes:.1f} min in total, of which the arm was controlled for {moving / 60:.1f} min", flush=True)


def calibration_steps(folder: Path, settings: CalibrationSettings, arm: "LoadedArm") -> list[Step]:
    """Returns the steps of a calibration, in order. Their commands run in the folder."""
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.recordings import motion_parts
    from dvrk_drake.recordings.periodic_motion import PeriodicMotion
    from dvrk_drake.recordings.pose_file import CollectionFile, load_poses

    common = ["--arm", settings.arm]
    gravity = ["--gravity", *map(repr, settings.gravity)] if settings.gravity else []
    table = [] if settings.table is None else ["--table", repr(settings.table)]

    def creates(title: str, output: str, *words: str, is_required: bool = True) -> Step:
        return Step(title, (*words, output), (folder / output).exists, is_required=is_required)

    def poses(title: str, output: str, count: int, seed: int) -> Step:
        words = ("excite", *common, *gravity, *table, "--static", str(count), "--seed", str(seed), "--output")
        return creates(title, output, *words)

    def collect_poses(title: str, name: str, model: str) -> Step:
        def done() -> bool:
            measured = CollectionFile(folder / f"{name}.csv", arm, both_sides=True)
            return bool(measured.finished(load_poses(folder / f"{name}.yaml", arm)).all())

        words = ("collect", *common, "--poses", f"{name}.yaml", "--output", f"{name}.csv", "--model", model)
        return Step(title, words, done, moves=True)

    def motion(title: str, output: str, seed: int, *options: str) -> Step:
        words = ("excite", *common, *table, "--model", STATIC, *options, "--seed", str(seed), "--output")
        return creates(title, output, *words)

    def rehearse(title: str, name: str) -> Step:
        def done() -> bool:
            path = folder / f"{name}.yaml"
            return motion_parts.is_rehearsed(path, arm, PeriodicMotion.load(path, arm))

        words = ("collect", *common, "--motion", f"{name}.yaml", "--rehearse", "--model", STATIC)
        return Step(title, words, done, moves=True)

    def record(title: str, name: str) -> Step:
        def done() -> bool:
            loaded = PeriodicMotion.load(folder / f"{name}.yaml", arm)
            parts = motion_parts.recorded_parts(folder / f"{name}.csv", arm, loaded)
            return motion_parts.begin_of_rest(parts, loaded.duration) is None

        words = ("collect", *common, "--motion", f"{name}.yaml", "--output", f"{name}.csv", "--model", STATIC)
        return Step(title, words, done, moves=True)

    def parts(name: str) -> list[str]:
        """Returns the files with a recorded motion, beginning with the longest part."""
        if not (folder / f"{name}.yaml").exists():
            return [f"{name}.csv"]
        loaded = PeriodicMotion.load(folder / f"{name}.yaml", arm)
        recorded = motion_parts.recorded_parts(folder / f"{name}.csv", arm, loaded)
        useful = sorted(motion_parts.useful(recorded, loaded.duration), key=lambda part: part.begin - part.end)
        return [part.path.name for part in useful] or [f"{name}.csv"]

    def validate(title: str, recording: str, model: str, report: str) -> Step:
        def done() -> bool:
            return (folder / report).exists() and IdentifiedModel.load(folder / model).validation is not None

        words = ("validate", recording, "--model", model, "--save", "--overwrite", "--report", report)
        return Step(title, words, done)

    gravity_file = "--dvrk-gc" if arm.name.startswith("MTM") else "--dvrk-kinematic-gc"
    first, second = settings.seed, settings.seed + 1
    identified = ("identify", *parts("motion"), *common, *gravity, "--report", "model_report.html", "--overwrite")
    return [
        poses("Choose static poses", "poses.yaml", settings.poses, first),
        collect_poses("Collect the static poses", "poses", NOMINAL),
        creates("Identify a static model", STATIC, "identify", "poses.csv", *common, *gravity, "--output"),
        poses("Choose other poses", "test_poses.yaml", TEST_POSES, second),
        collect_poses("Collect the other poses", "test_poses", STATIC),
        validate("Validate the static model", "test_poses.csv", STATIC, "static_report.html"),
        motion("Design a motion", "motion.yaml", first, "--duration", repr(settings.duration)),
        rehearse("Rehearse the motion", "motion"),
        record("Record the motion", "motion"),
        creates("Identify the full dynamics", DYNAMIC, *identified, "--output"),
        motion("Design another motion", "test_motion.yaml", second, *TEST_MOTION),
        rehearse("Rehearse the other motion", "test_motion"),
        record("Record the other motion", "test_motion"),
        validate("Validate the full dynamics", parts("test_motion")[0], DYNAMIC, "report.html"),
        creates("Export the full dynamics", "model.sdf", "export", "--model", DYNAMIC, "--sdf"),
        creates(
            "Export the gravity compensation",
            "gravity.json",
            *("export", "--model", STATIC, gravity_file),
            is_required=False,
        ),
    ]


def _prepare(folder: Path, settings: CalibrationSettings) -> "LoadedArm":
    """Creates the folder with the settings and the nominal model, or checks an existing folder. Returns the arm.

    Raises:
        DvrkDrakeError: The folder cannot be used, or contains a calibration with other settings.
    """
    import yaml

    import dvrk_drake as dvrk
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.models.typed_yaml import load_typed_yaml

    gravity = settings.gravity
    arm = mounted(dvrk.load_arm(settings.arm), (gravity[0], gravity[1], gravity[2]) if gravity else None)
    path = folder / SETTINGS
    if path.exists():
        found = load_typed_yaml(CalibrationSettings, path, CollectionError, "settings of a calibration")
        for name, value in asdict(settings).items():
            if value != (earlier := getattr(found, name)):
                raise CollectionError(
                    f"{path}: {name} is {earlier}, but {value} was given; give the same options, or another folder"
                )
        return arm
    try:
        folder.mkdir(parents=True, exist_ok=True)
        is_used = any(folder.iterdir())
    except OSError as error:
        raise CollectionError(f"{folder}: the folder cannot be created: {error.strerror}") from error
    if is_used:
        raise CollectionError(f"{folder}: the folder is not empty and has no calibration; give a new folder")
    springs = arm.effects.cables + arm.effects.springs
    dvrk.IdentifiedModel.from_arm(arm, springs).save(folder / NOMINAL)
    with atomic_write(path) as stream:
        yaml.safe_dump(asdict(settings), stream, sort_keys=False)
    return arm


def _absolute(path: str) -> str:
    """Returns the absolute path of a file, because the commands run in another folder. Other names are unchanged."""
    return str(Path(path).resolve()) if Path(path).exists() else path


def _run(words: list[str], folder: Path) -> int:
    """Runs a command in the folder and returns its exit code. Signals to this process end the command first."""
    command = [sys.executable, "-m", "dvrk_drake.cli", *words]
    process = subprocess.Popen(command, cwd=folder, preexec_fn=_end_with_parent)  # noqa: PLW1509  no other thread runs
    received: list[int] = []
    handlers = {number: signal.signal(number, lambda n, _: received.append(n)) for number in _SIGNALS}
    try:
        while True:
            try:
                code = process.wait(_FORWARD)
                break
            except subprocess.TimeoutExpired:
                # A terminal sends Ctrl-C to both processes. Other senders may have sent it only to this one.
                while received:
                    process.send_signal(received.pop())
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return 130 if received or code in (130, *(-number for number in _SIGNALS)) else code


def _end_with_parent() -> None:
    """Requests SIGTERM for this process when its parent ends, so that no motion continues without the calibration."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _print_result(folder: Path, arm: "LoadedArm", name: str) -> None:
    """Prints the verdicts of both models, and the commands that use them."""
    from dvrk_drake.dynamics.identified_model import IdentifiedModel

    for file, what in ((STATIC, "holding torques of other poses"), (DYNAMIC, "efforts of another motion")):
        validation = IdentifiedModel.load(folder / file).validation
        assert validation is not None
        joints: dict[str, list[str]] = {}
        for joint in arm.joint_names:
            joints.setdefault(validation.verdicts[joint], []).append(joint)
        verdicts = "; ".join(f"{verdict}: {', '.join(names)}" for verdict, names in joints.items())
        print(f"Verdicts for {what}: {verdicts}", flush=True)
    for file, what in (
        ("report.html", "errors and verdict of the full dynamics"),
        ("static_report.html", "errors and verdict of the static model"),
        ("model_report.html", "parameters of the full dynamics"),
        ("model.sdf", "full dynamics for Drake"),
        ("gravity.json", "gravity compensation of the dVRK"),
    ):
        if (folder / file).exists():
            print_written(folder / file, what)
    print(
        f"Next: dvrk-drake run --arm {name} --model {folder / STATIC} --friction-model {folder / DYNAMIC} "
        f"--friction-ratio 0.3\nIn the driver's configuration of the arm: model: {(folder / STATIC).resolve()}",
        flush=True,
    )
