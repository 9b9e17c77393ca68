"""Calibrates a connected arm: a sequence of commands, each with named files in one folder.

Each step is a command in a process of its own, and not a call of `ArmConnection` in this process, for these reasons:

- Real-time scheduling, locked memory and cores that stay awake end with the motion. In one process, a design or an
  identification of minutes would keep them, and could delay the process of the arm on the same computer.
- Ctrl-C ends a design at once. An exception can be lost there, because extension modules call Python code.
- Reports are written by commands, and this package must not import the reports.

A signal to this process is passed on to the command, and the end of this process ends the command. In both cases, the
arm holds its pose.
"""

# This file has no postponed annotations, because load_typed_yaml reads the types at run time.
import ctypes
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import yaml

from dvrk_drake.analysis.excitation.motion_limits import CollisionDetector
from dvrk_drake.analysis.excitation.periodic_motion import PeriodicMotion
from dvrk_drake.analysis.excitation.pose_file import CollectionFile, load_poses
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import CollectionError
from dvrk_drake.export.model_export import controller_format
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.models.environment import Environment
from dvrk_drake.models.files import atomic_write, read_text_input
from dvrk_drake.models.ranges import number_fault, within
from dvrk_drake.models.typed_yaml import load_typed_yaml
from dvrk_drake.processes import motion_parts

#: Names of the files in the folder.
SETTINGS, NOMINAL, STATIC, DYNAMIC = "calibration.yaml", "nominal.yaml", "static.yaml", "model.yaml"
ENVIRONMENT = "environment.dmd.yaml"
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
        environment: Fixed objects around the arm.
    """

    format: str = "dvrk_drake calibration 1"
    arm: str = ""
    poses: int = field(default=40, metadata=within(8, 300))
    duration: float = field(default=30.0, metadata=within(15.0, 3600.0, "s"))
    seed: int = field(default=0, metadata=within(0, 1_000_000))
    gravity: list[float] = field(default_factory=list, metadata=within(-20.0, 20.0, "m/s^2"))
    environment: Environment = field(default_factory=Environment)

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


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration. Its files are in the folder.

    Attributes:
        folder: Folder with the files.
        static: Model from static poses, with the verdicts of its validation at other poses.
        model: Model of the full dynamics, with the verdicts of its validation on another motion.
        duration: Duration of the call [s].
        moving: Time in which the arm was controlled [s].
    """

    folder: Path
    static: IdentifiedModel
    model: IdentifiedModel
    duration: float
    moving: float

    @property
    def is_usable(self) -> bool:
        """True if no joint of both models has the verdict "do not use"."""
        return not any("do not use" in _verdicts(model) for model in (self.static, self.model))

    def files(self) -> dict[Path, str]:
        """Returns the files for the user, each with a description."""
        descriptions = {
            "report.html": "errors and verdict of the full dynamics",
            "holding_report.html": "errors and verdict of its holding torques at other poses",
            "static_report.html": "errors and verdict of the static model",
            "model_report.html": "parameters of the full dynamics",
            "model.sdf": "full dynamics for Drake",
            "gravity.json": "gravity compensation of the dVRK",
        }
        return {self.folder / name: text for name, text in descriptions.items() if (self.folder / name).exists()}

    def summary(self) -> list[str]:
        """Returns the joints of each verdict, in one line per model."""
        lines = []
        for file, model, what in (
            (STATIC, self.static, "holding torques of other poses"),
            (DYNAMIC, self.model, "efforts of another motion"),
        ):
            verdicts = "; ".join(f"{verdict}: {', '.join(names)}" for verdict, names in _verdicts(model).items())
            lines.append(f"Verdicts on {file} for {what}: {verdicts}")
        return lines


def calibrate(
    arm: str,
    folder: str | Path,
    *,
    poses: int = 40,
    duration: float = 30.0,
    seed: int = 0,
    gravity: Sequence[float] | None = None,
    environment: Environment | None = None,
    transport: Literal["lcm", "ros"] = "lcm",
    lcm_url: str = "",
    key: str | None = None,
    topic: str | None = None,
    domain: int | None = None,
    realtime: bool = False,
    reset: bool = False,
    confirm: Callable[[str], None],
    report: Callable[[str], None] = print,
) -> Calibration:
    """Calibrates an arm: designs, collects, identifies, validates and exports, and continues earlier work.

    Each step is a command of dvrk-drake in a process of its own, in the folder. Complete steps are not repeated. A
    signal ends the running command first, and the arm holds its pose.

    Args:
        arm: Name of the arm, or path of an arm file.
        folder: Folder for all files. An existing calibration in this folder is continued.
        poses: Number of static poses, 8 to 300.
        duration: Duration of the motion, 15 to 3600 s.
        seed: Seed of the designs, 0 or larger.
        gravity: Gravity vector in the base frame [m/s^2]. None: the vector in the arm file.
        environment: Fixed objects around the arm. None: there are none.
        transport: "lcm" for the messages of this package, "ros" for the topics of a dVRK on ROS 2.
        lcm_url, key, topic, domain: See `connect`.
        realtime: Whether to request real-time scheduling while this computer controls the arm.
        reset: Whether to clear a fault over LCM before the first motion, and to resume after a watchdog hold.
        confirm: Function that is called with the name of the arm before each motion. It returns if the arm may move.
        report: Function that is called with each line of text.

    Raises:
        DvrkDrakeError: A setting is not valid, the folder cannot be used, or a step failed.
        KeyboardInterrupt: A signal ended the calibration.

    Examples:
        >>> import dvrk_drake as dvrk
        >>> ask = lambda name: input(f"Clear the workspace of {name}, then press Enter. ")
        >>> result = dvrk.calibrate("mtml", "calibration", confirm=ask)  # doctest: +SKIP
        >>> result.is_usable  # doctest: +SKIP
        True
    """
    began, moving, folder = time.monotonic(), 0.0, Path(folder)
    settings = CalibrationSettings(
        arm=arm.lower() if arm.lower() in known_arms() else _absolute(arm),
        poses=poses,
        duration=duration,
        seed=seed,
        gravity=list(gravity or ()),
        environment=environment or Environment(),
    )
    loaded = prepare_folder(folder, settings)
    connection = [f"--lcm-url={lcm_url}"] if lcm_url else []
    connection += ["--key", _absolute(key)] if key else []
    connection += ["--transport", "ros"] if transport == "ros" else []
    connection += [f"--topic={topic}"] if topic else []
    connection += [] if domain is None else [f"--domain={domain}"]
    count = len(calibration_steps(folder, settings, loaded))
    for number in range(count):
        # The commands depend on the files of the earlier steps.
        step = calibration_steps(folder, settings, loaded)[number]
        header = f"[{number + 1}/{count}] {step.title}"
        if step.done():
            report(f"{header}: done")
            continue
        words = list(step.words)
        if step.moves:
            words += connection + ["--realtime"] * realtime + ["--reset"] * reset
            if transport == "ros" and "poses" in words:
                words += ["--yes"]  # the dVRK moves the arm, after the question of this calibration
            reset = False
        report(f"{header}: dvrk-drake {shlex.join(words)}")
        if step.moves:
            confirm(loaded.name)
        started = time.monotonic()
        code = _run(words, folder)
        moving += step.moves * (time.monotonic() - started)
        if code == 130:
            raise KeyboardInterrupt
        failure = f"{step.title} failed; the line above states the reason"
        if code and step.is_required:
            # A validation that fails has written its report, so the step is complete.
            accepts = "accepts this result and continues. To improve it, use a new folder and more --poses"
            raise CollectionError(f"{failure}. The same command {accepts if step.done() else 'repeats this step'}")
        if code:
            report(f"{failure}. The calibration continues")
    static, model = (IdentifiedModel.load(folder / file) for file in (STATIC, DYNAMIC))
    return Calibration(folder, static, model, time.monotonic() - began, moving)


def calibration_steps(folder: Path, settings: CalibrationSettings, arm: Arm) -> list[Step]:
    """Returns the steps of a calibration, in order. Their commands run in the folder."""
    common = ["--arm", settings.arm]
    gravity = ["--gravity", *map(repr, settings.gravity)] if settings.gravity else []
    around = settings.environment
    environment = [] if around.table is None else ["--table", repr(around.table)]
    environment += ["--environment", ENVIRONMENT] if around.directives else []

    def creates(title: str, output: str, *words: str, is_required: bool = True) -> Step:
        return Step(title, (*words, output), (folder / output).exists, is_required=is_required)

    def poses(title: str, output: str, count: int, seed: int) -> Step:
        words = ("excite", *common, *gravity, *environment, "--static", str(count), "--seed", str(seed), "--output")
        return creates(title, output, *words)

    def collect_poses(title: str, name: str, model: str) -> Step:
        def done() -> bool:
            measured = CollectionFile(folder / f"{name}.csv", arm, both_sides=True)
            return bool(measured.finished(load_poses(folder / f"{name}.yaml", arm)).all())

        words = ("collect", "poses", f"{name}.yaml", *common, "--output", f"{name}.csv", "--model", model)
        return Step(title, words, done, moves=True)

    def motion(title: str, output: str, seed: int, *options: str) -> Step:
        words = ("excite", *common, *environment, "--model", STATIC, *options, "--seed", str(seed), "--output")
        return creates(title, output, *words)

    def rehearse(title: str, name: str) -> Step:
        def done() -> bool:
            path = folder / f"{name}.yaml"
            return motion_parts.is_rehearsed(path, arm, PeriodicMotion.load(path, arm))

        words = ("collect", "motion", f"{name}.yaml", *common, "--rehearse", "--model", STATIC)
        return Step(title, words, done, moves=True)

    def record(title: str, name: str) -> Step:
        def done() -> bool:
            loaded = PeriodicMotion.load(folder / f"{name}.yaml", arm)
            parts = motion_parts.recorded_parts(folder / f"{name}.csv", arm, loaded)
            return motion_parts.begin_of_rest(parts, loaded.duration) is None

        words = ("collect", "motion", f"{name}.yaml", *common, "--output", f"{name}.csv", "--model", STATIC)
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

        # The operator decides whether the arm follows a motion with a model that failed the validation.
        required = ("--require", "usable") if model == STATIC else ()
        words = ("validate", recording, "--model", model, "--save", "--overwrite", "--report", report, *required)
        return Step(title, words, done)

    format = controller_format(arm)
    export_gravity = creates(
        "Export the gravity compensation",
        "gravity.json",
        *("export", "--model", DYNAMIC, f"--{format}"),
        is_required=False,
    )
    first, second = settings.seed, settings.seed + 1
    recorded = (*parts("motion"), "poses.csv")
    identified = ("identify", *recorded, *common, *gravity, "--report", "model_report.html", "--overwrite")
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
        creates(
            "Validate the holding torques of the full dynamics",
            "holding_report.html",
            *("validate", "test_poses.csv", "--model", DYNAMIC, "--require", "usable", "--report"),
        ),
        creates("Export the full dynamics", "model.sdf", "export", "--model", DYNAMIC, "--sdf"),
        *([export_gravity] if format is not None else []),
    ]


def prepare_folder(folder: Path, settings: CalibrationSettings) -> Arm:
    """Creates the folder with the settings and the nominal model, or checks an existing folder. Returns the arm.

    Raises:
        DvrkDrakeError: The folder cannot be used, or contains a calibration with other settings.
    """
    gravity = settings.gravity
    arm = load_arm(settings.arm)
    arm = arm.with_gravity(gravity) if gravity else arm
    CollisionDetector(arm, settings.environment)  # rejects objects that cannot be added to the arm
    path = folder / SETTINGS
    if path.exists():
        found = load_typed_yaml(CalibrationSettings, path, CollectionError, "settings of a calibration")
        if settings.environment.directives != found.environment.directives:
            raise CollectionError(f"{path}: the calibration began with another --environment; give the same file")
        before = {**asdict(found), **asdict(found.environment)}
        for name, value in {**asdict(settings), **asdict(settings.environment)}.items():
            if name != "environment" and value != (earlier := before[name]):
                raise CollectionError(
                    f"{path}: {name} is {earlier}, but {value} was given; give the same options, or another folder"
                )
    else:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            is_used = any(folder.iterdir())
        except OSError as error:
            raise CollectionError(f"{folder}: the folder cannot be created: {error.strerror}") from error
        if is_used:
            raise CollectionError(f"{folder}: the folder is not empty and has no calibration; give a new folder")
        with atomic_write(path) as stream:
            yaml.safe_dump(asdict(settings), stream, sort_keys=False)
    if directives := settings.environment.directives:
        if not (folder / ENVIRONMENT).exists():
            with atomic_write(folder / ENVIRONMENT) as stream:
                stream.write(directives)
        elif read_text_input(folder / ENVIRONMENT, CollectionError) != directives:
            raise CollectionError(f"{folder / ENVIRONMENT}: the file was changed; delete it to restore it")
    if not (folder / NOMINAL).exists():
        IdentifiedModel.from_arm(arm, arm.effects.position_dependent).save(folder / NOMINAL)
    return arm


def _absolute(path: str) -> str:
    """Returns the absolute path of a file, because the commands run in another folder. Other names are unchanged."""
    return str(Path(path).resolve()) if Path(path).is_file() else path


def _run(words: Sequence[str], folder: Path) -> int:
    """Runs a command in the folder and returns its exit code. Signals to this process end the command first."""
    command = [sys.executable, "-m", "dvrk_drake.cli", *words]
    received: list[int] = []
    num_sent = 0
    # Before the start of the process, so that no signal ends this process while the command runs.
    handlers = {number: signal.signal(number, lambda n, _: received.append(n)) for number in _SIGNALS}
    try:
        process = subprocess.Popen(command, cwd=folder, preexec_fn=_end_with_parent)  # noqa: PLW1509  one thread
        while True:
            try:
                code = process.wait(_FORWARD)
                break
            except subprocess.TimeoutExpired:
                # A terminal sends Ctrl-C to both processes. Other senders may have sent it only to this one.
                for number in received[num_sent:]:
                    process.send_signal(number)
                num_sent = len(received)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return 130 if received or code in (130, *(-number for number in _SIGNALS)) else code


def _end_with_parent() -> None:
    """Requests SIGTERM for this process when its parent ends, so that no motion continues without the calibration."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _verdicts(model: IdentifiedModel) -> dict[str, list[str]]:
    """Returns the joints of each verdict of the stored validation."""
    assert model.validation is not None
    joints: dict[str, list[str]] = {}
    for joint in model.joints:
        joints.setdefault(model.validation.verdicts[joint.name], []).append(joint.name)
    return joints
