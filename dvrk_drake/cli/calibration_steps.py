"""Settings, folder and steps of the command calibrate."""

# This file has no postponed annotations, because load_typed_yaml reads the types at run time.
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import yaml

from dvrk_drake.analysis.excitation.collisions import CollisionDetector
from dvrk_drake.cli.support import mounted
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import CollectionError
from dvrk_drake.export.model_export import controller_format
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.environment import Environment
from dvrk_drake.models.files import atomic_write, read_text_input
from dvrk_drake.models.schema_fault import number_fault, within
from dvrk_drake.models.typed_yaml import load_typed_yaml
from dvrk_drake.recordings import motion_parts
from dvrk_drake.recordings.periodic_motion import PeriodicMotion
from dvrk_drake.recordings.pose_file import CollectionFile, load_poses

#: Names of the files in the folder.
SETTINGS, NOMINAL, STATIC, DYNAMIC = "calibration.yaml", "nominal.yaml", "static.yaml", "model.yaml"
ENVIRONMENT = "environment.dmd.yaml"
#: Number of the poses with which the static model is validated.
TEST_POSES = 10
#: Options of the motion with which the full dynamics is validated. It has other frequencies than the first motion.
TEST_MOTION = ("--duration", "20", "--period", "20", "--harmonics", "10", "--starts", "1")


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
    arm = mounted(load_arm(settings.arm), (gravity[0], gravity[1], gravity[2]) if gravity else None)
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
