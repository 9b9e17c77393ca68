"""Fuzz tests: readers and commands accept a damaged file or reject it with one error line."""

from __future__ import annotations

import functools
import importlib
import io
import itertools
import json
import os
import shutil
import signal
import xml.etree.ElementTree as ElementTree
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from file_mutations import damaged, fixed_damages
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from motions import true_dynamics
from public_files import team_array, wpi_rows
from status_logs import log_bytes, statuses

from dvrk_drake.analysis.excitation.pose_file import CollectionFile, load_poses, save_poses
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.experiments.paper import PaperRecordings
from dvrk_drake.experiments.scenario import load_scenario
from dvrk_drake.experiments.study import load_study
from dvrk_drake.experiments.study_run import Row, StudyTable
from dvrk_drake.export.dvrk_mtm_gravity_compensation import CompensationOptions, compensation_from_model
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
from dvrk_drake.export.dvrk_psm_gravity_compensation import kinematic_compensation
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import load_gains
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.models.sdf_model import MODELS_FOLDER, PACKAGE_URL
from dvrk_drake.processes.simulated_arm import load_driver
from dvrk_drake.recordings.formats import convert, read_recording, write_recording
from dvrk_drake.recordings.recording import Recording

#: Factor of the number of examples. With a factor above 1, each run draws new examples.
EXAMPLE_FACTOR = int(os.environ.get("DVRK_DRAKE_FUZZ", "1"))
#: Maximum CPU time for one file [s].
MAX_CPU_TIME = 20


@contextmanager
def time_limit():
    """Raises TimeoutError if the block needs more than MAX_CPU_TIME, or ten times as much wall-clock time."""

    def stop(*_):
        raise TimeoutError(f"took longer than {MAX_CPU_TIME} s")

    before = [signal.signal(number, stop) for number in (signal.SIGPROF, signal.SIGALRM)]
    signal.setitimer(signal.ITIMER_PROF, MAX_CPU_TIME)
    signal.setitimer(signal.ITIMER_REAL, 10 * MAX_CPU_TIME)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in zip((signal.SIGPROF, signal.SIGALRM), before, strict=True):
            signal.signal(number, handler)


def write_arm(folder: Path) -> None:
    """Writes the PSM as user files: arm.yaml, mechanism.yaml, instrument.yaml, mechanism.sdf, instrument.sdf."""
    arm = (MODELS_FOLDER / "arms/psm.yaml").read_text()
    arm = arm.replace("mechanism: psm", "mechanism: mechanism.yaml")
    (folder / "arm.yaml").write_text(arm.replace("instrument: large_needle_driver", "instrument: instrument.yaml"))
    for part, source, sdf in (
        ("mechanism", "mechanisms/psm.yaml", "psm.sdf"),
        ("instrument", "instruments/large_needle_driver.yaml", "large_needle_driver.sdf"),
    ):
        text = (MODELS_FOLDER / source).read_text()
        assert f"{PACKAGE_URL}sdf/{sdf}" in text
        (folder / f"{part}.yaml").write_text(text.replace(f"{PACKAGE_URL}sdf/{sdf}", f"{part}.sdf"))
        (folder / f"{part}.sdf").write_text((MODELS_FOLDER / "sdf" / sdf).read_text())


def dynamic_model() -> IdentifiedModel:
    """Returns a PSM model with dynamics, friction and position-dependent effects."""
    arm = load_arm("psm")
    kinds = [("viscous", 0.0), ("coulomb", 0.1), ("presliding", 0.02), ("cable sine", 1.0), ("spring", 0.4)]
    effects = [DriveEffect(f"actuator.{arm.joint_names[0]}", kind, scale, 0.1) for kind, scale in kinds]
    section = true_dynamics(arm, np.random.default_rng(0), effects).section
    return replace(IdentifiedModel.from_arm(arm), dynamics=section)


SCENARIO = """arm: psm
duration: 1.0
gravity: [0, 0, -9.81]
controller: {mode: hold, parameter_error: 0.05, gains: gains.yaml}
start: [0, 0, 0.1, 0, 0, 0, 0]
targets: [{time: 0.5, pose: [0.1, 0.1, 0.12, 0, 0, 0, 0]}]
hand: {path: []}
effects: [{coordinate: joint.yaw, kind: offset, coefficient: 0.1}]
simulated_effects: [friction]
seed: 3
"""
STUDY = """scenario: psm
set: [duration=1]
random_poses: {count: 3, seed: 1, margin: 0.1}
seeds: [0, 1]
variations: [{name: a, set: []}, {name: b, set: [controller.mode=gravity]}]
measures:
- {kind: drift, time: 0.5, joints: [insertion]}
- {kind: held, name: stays, band: 0.1, time: 0.5, joints: [yaw]}
"""
DRIVER = """status_period: 0.001
control_modes: [position, effort]
gravity_compensation: false
guard: {expiry: 0.05, margin: 0.05, traverse_time: 0.5}
"""
GAINS = "kp: [1, 2, 3, 4, 5, 6, 7]\nkd: [1, 1, 1, 1, 1, 1, 1]\nki: [0, 0, 0, 0, 0, 0, 0]\n"


def write_valid_files(folder: Path) -> None:
    """Writes one small valid file of each kind."""
    psm, mtml = load_arm("psm"), load_arm("mtml")
    write_arm(folder)
    model = IdentifiedModel.from_arm(mtml)
    model.save(folder / "mtml.yaml")
    dynamic_model().save(folder / "psm.yaml")
    compensation_from_model(model, CompensationOptions(tolerance=0.1)).save(folder / "gc.json", "MTML", "a test")
    kinematic_compensation(IdentifiedModel.from_arm(psm)).save(folder / "kinematic.json")
    for name, text in (("scenario", SCENARIO), ("study", STUDY), ("driver", DRIVER), ("gains", GAINS)):
        (folder / f"{name}.yaml").write_text(text)
    poses = psm.sample_poses(4, np.random.default_rng(0), margin=0.2)
    save_poses(poses, psm, folder / "poses.yaml")
    generator = np.random.default_rng(1)
    q = mtml.sample_poses(16, generator, margin=0.1)
    tau = model.holding_torque(q) + 1e-3 * generator.normal(size=q.shape)
    write_recording(Recording(q=q, tau=tau), folder / "poses.csv")
    shutil.copy(folder / "poses.csv", folder / "mtm_2015_good72.csv")
    t = np.arange(60) / 200
    q = poses[0] + 0.01 * np.sin(9 * t[:, None])
    qd = 0.09 * np.tile(np.cos(9 * t[:, None]), 7)
    write_recording(Recording(q=q, qd=qd, tau=0.1 * psm.effort_limits * qd, t=t), folder / "motion.csv", psm)
    scipy.io.savemat(folder / "team.mat", {"poses": team_array(6), "note": "text", "other": np.eye(3)})
    rows = 1e-3 * wpi_rows(8)
    (folder / "wpi.csv").write_text("".join(",".join(map(repr, row)) + "\n" for row in rows.tolist()))
    (folder / "status.log").write_bytes(log_bytes(statuses(12)))
    collection = CollectionFile(folder / "collection.csv", psm, both_sides=True)
    for pose in poses[:2]:
        collection.append(pose, pose, pose, pose)
    collection.close()
    study = load_study(folder / "study.yaml")
    with StudyTable(folder / "results.csv", study) as table:
        for case in study.cases[:3]:
            table.append(case, Row({"drift": 0.1, "stays": True}))


def read_collection(path: Path) -> None:
    psm = load_arm("psm")
    CollectionFile(path, psm, both_sides=True).finished(psm.sample_poses(4, np.random.default_rng(0), margin=0.2))


def read_results(path: Path) -> None:
    with StudyTable(path, load_study(path.parent / "study.yaml")):
        pass


#: Mapping from a damaged file to its kind, the number of damages, and the function that reads it.
READERS = {
    "mtml.yaml": ("yaml", 60, IdentifiedModel.load),
    "psm.yaml": ("yaml", 50, IdentifiedModel.load),
    "arm.yaml": ("yaml", 40, lambda path: load_arm(str(path))),
    "mechanism.yaml": ("yaml", 50, lambda path: load_arm(str(path.parent / "arm.yaml"))),
    "instrument.yaml": ("yaml", 40, lambda path: load_arm(str(path.parent / "arm.yaml"))),
    "mechanism.sdf": ("xml", 50, lambda path: load_arm(str(path.parent / "arm.yaml"))),
    "instrument.sdf": ("xml", 30, lambda path: load_arm(str(path.parent / "arm.yaml"))),
    "gains.yaml": ("yaml", 20, load_gains),
    "driver.yaml": ("yaml", 20, load_driver),
    "scenario.yaml": ("yaml", 40, lambda path: load_scenario(str(path))),
    "study.yaml": ("yaml", 30, load_study),
    "poses.yaml": ("yaml", 20, lambda path: load_poses(path, load_arm("psm"))),
    "gc.json": ("json", 30, GravityCompensationFile.load),
    "kinematic.json": ("json", 20, GravityCompensationFile.load),
    "motion.csv": ("csv", 20, lambda path: read_recording(path, load_arm("psm"))),
    "mtm_2015_good72.csv": ("csv", 20, lambda path: PaperRecordings(path.parent).poses),
    "poses.csv": ("csv", 30, lambda path: read_recording(path, load_arm("mtml")).check_fits(load_arm("mtml"))),
    "team.mat": ("binary", 30, lambda path: convert(path, path.parent / "out.csv")),
    "wpi.csv": ("csv", 20, lambda path: read_recording(path, load_arm("psm"), skip_invalid=True)),
    "status.log": ("binary", 30, lambda path: read_recording(path, load_arm("mtml"))),
    "collection.csv": ("csv", 20, read_collection),
    "results.csv": ("csv", 20, read_results),
}


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    folder = tmp_path_factory.mktemp("valid")
    before = Path.cwd()
    os.chdir(folder)
    write_valid_files(folder)
    yield folder
    os.chdir(before)


def fuzz(count: int, strategy: st.SearchStrategy[bytes], test) -> None:
    """Runs `test` with `count` different examples. They are the same in each run unless EXAMPLE_FACTOR is above 1."""
    tested: set[int] = set()

    def test_if_new(content: bytes) -> None:
        # Hypothesis repeats failed examples, so these are not in `tested`.
        if hash(content) in tested or len(tested) == count * EXAMPLE_FACTOR:
            return
        test(content)
        tested.add(hash(content))

    run = given(strategy)(test_if_new)
    options = settings(
        max_examples=2 * count * EXAMPLE_FACTOR,
        deadline=None,
        database=None,
        derandomize=EXAMPLE_FACTOR == 1,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink),
    )
    options(run)()


_numbers = itertools.count()


@contextmanager
def damaged_copy(valid: Path, name: str, content: bytes):
    """Yields the path of a damaged file in a temporary folder that contains all other valid files."""
    folder = valid.parent / f"{valid.name}-{os.getpid()}-{next(_numbers)}"
    folder.mkdir()
    for path in valid.iterdir():
        if path.name != name:
            os.link(path, folder / path.name)
    (folder / name).write_bytes(content)
    os.chdir(folder)
    try:
        yield folder / name
    finally:
        os.chdir(valid)
        for path in sorted(folder.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        folder.rmdir()


def check_reader(valid: Path, name: str, content: bytes) -> None:
    """Fails unless the reader accepts the content or raises a DvrkDrakeError within the time limit."""
    with damaged_copy(valid, name, content) as path, time_limit():
        try:
            READERS[name][2](path)
        except DvrkDrakeError as error:
            assert str(error)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_damaged_file_is_read_or_rejected(name, valid):
    kind, count, read = READERS[name]
    content = (valid / name).read_bytes()
    with damaged_copy(valid, name, content) as path:
        if name != "kinematic.json":
            read(path)  # undamaged
    for damage in fixed_damages(content).values():
        check_reader(valid, name, damage)
    fuzz(count, damaged(kind, content), lambda damage: check_reader(valid, name, damage))


#: Functions that take long or require an arm. Commands call them after reading their files.
WORK = (
    "dvrk_drake.systems.lcm.messages.usable_lcm_url",
    "dvrk_drake.experiments.tuning.tune_arm",
    "dvrk_drake.experiments.study_run.run_study_locally",
    "dvrk_drake.experiments.transparency.simulate_operator",
    "dvrk_drake.analysis.identification.identify_dynamic",
    "dvrk_drake.analysis.payload.estimate_payload",
)
#: Mapping from a command to the files that are damaged one after the other. Output names begin with "out".
COMMANDS = {
    "equations --arm arm.yaml --format python --output out.py": (
        "arm.yaml",
        "mechanism.yaml",
        "mechanism.sdf",
        "instrument.sdf",
    ),
    "check poses.csv --arm mtml --json out.json": ("poses.csv",),
    "check status.log --arm mtml --json out.json": ("status.log",),
    "check motion.csv --arm arm.yaml": ("motion.csv", "arm.yaml", "instrument.yaml"),
    "identify poses.csv --arm mtml --method paper --output out.yaml --verbose": ("poses.csv",),
    "identify motion.csv --arm psm --output out.yaml": ("motion.csv",),
    "validate poses.csv --model mtml.yaml --json out.json": ("mtml.yaml", "poses.csv"),
    "validate motion.csv --model psm.yaml --json out.json": ("psm.yaml", "motion.csv"),
    "predict poses.csv --model mtml.yaml --output out.csv": ("mtml.yaml", "poses.csv"),
    "convert team.mat --output out.csv": ("team.mat",),
    "convert wpi.csv --output out.csv --arm psm": ("wpi.csv",),
    "convert status.log --output out.csv --arm mtml": ("status.log",),
    "payload motion.csv motion.csv --model psm.yaml --json out.json": ("psm.yaml", "motion.csv"),
    "identify recalibrate motion.csv --model psm.yaml --output out.yaml": ("psm.yaml", "motion.csv"),
    "export --model psm.yaml --sdf out.sdf": ("psm.yaml",),
    "export --arm arm.yaml --urdf out.urdf": ("arm.yaml", "mechanism.sdf"),
    "export --model mtml.yaml --dvrk-gc out.json --gc-tolerance 0.1": ("mtml.yaml",),
    "export --arm arm.yaml --dvrk-kinematic-gc out.json": ("instrument.sdf",),
    "export compare gc.json --model mtml.yaml --json out.json": ("gc.json", "mtml.yaml"),
    "export compare kinematic.json --arm mtml --json out.json": ("kinematic.json",),
    "simulate scenario.yaml --output out.csv": ("scenario.yaml", "gains.yaml"),
    "simulate --arm arm.yaml --output out.csv": ("arm.yaml", "mechanism.yaml", "mechanism.sdf"),
    "simulate --arm psm --set controller.model=psm.yaml --output out.csv": ("psm.yaml",),
    "simulate study study.yaml --output results.csv": ("study.yaml", "results.csv"),
    "simulate tune --arm arm.yaml --output out.yaml": ("arm.yaml",),
    "simulate transparency --arm psm --path motion.csv --model psm.yaml": ("motion.csv", "psm.yaml"),
    "sim-arm --arm arm.yaml --driver driver.yaml": ("driver.yaml",),
    "control --arm mtml --model mtml.yaml --mode hold --gains gains.yaml": ("mtml.yaml", "gains.yaml"),
    "collect poses poses.yaml --arm psm --output collection.csv": ("poses.yaml", "collection.csv"),
    "record out.csv --arm arm.yaml": ("arm.yaml",),
    "reproduce fig4 --data . --folder out": ("mtm_2015_good72.csv",),
}


@pytest.fixture(scope="module")
def short_work():
    """Makes commands stop before their long work, and shortens simulations to 20 ms."""

    def skip(*_, **__):
        raise DvrkDrakeError("the work is skipped in this test")

    with pytest.MonkeyPatch.context() as patch:
        for name in WORK:
            patch.setattr(name, skip)
        simulation = importlib.import_module("dvrk_drake.experiments.simulation")
        simulate = simulation.simulate

        def simulate_briefly(scenario, **rest):
            brief = replace(scenario, duration=0.02, sample_period=0.01, targets=[])
            brief.check()
            return simulate(brief, **rest)

        patch.setattr(simulation, "simulate", simulate_briefly)
        yield


def check_whole(path: Path) -> None:
    """Fails unless an output file is complete."""
    text = path.read_text()
    if path.suffix == ".json":
        json.loads(text)
    elif path.suffix == ".yaml":
        IdentifiedModel.load(path)
    elif path.suffix in (".sdf", ".urdf"):
        ElementTree.fromstring(text)
    elif path.suffix == ".csv":
        widths = {line.count(",") for line in text.splitlines()}
        assert len(widths) == 1 and text.endswith("\n")
    elif path.suffix == ".py":
        compile(text, path.name, "exec")
    else:
        assert text.endswith("\n")


def check_command(valid: Path, command: str, name: str, content: bytes) -> None:
    """Fails unless a command with a damaged file exits cleanly within the time limit, with complete output files."""
    with damaged_copy(valid, name, content) as path, time_limit(), redirect_stdout(io.StringIO()):
        folder, errors = path.parent, io.StringIO()
        with redirect_stderr(errors):
            code = main(command.split())
        assert code in (0, 2), code
        last = errors.getvalue().splitlines()[-1:]
        assert code == 0 or (last and last[0].startswith("dvrk-drake: error: ")), errors.getvalue()
        new = {path.name for path in folder.iterdir()} - {path.name for path in valid.iterdir()}
        assert all(name.startswith("out") for name in new), new
        for output in new - {"out_meshes"}:
            # `check` also writes its findings for a recording that it rejects.
            assert code == 0 or command.startswith("check"), f"{output} was written although the command failed"
            check_whole(folder / output)
        for untouched in valid.iterdir():
            if untouched.name not in (name, "results.csv", "poses.yaml"):
                assert (folder / untouched.name).samefile(untouched)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_command_exits_cleanly_with_a_damaged_file(command, valid, short_work):
    for name in COMMANDS[command]:
        content = (valid / name).read_bytes()
        kind = READERS[name][0]
        test = functools.partial(check_command, valid, command, name)
        # The equations of a user-defined arm are derived anew in each run.
        is_quick = not any(word.startswith("arm.yaml") for word in command.replace("=", " ").split())
        if is_quick:
            test(content)
            for damage in ("empty", "UTF-16", "nested lists", "zeros"):
                test(fixed_damages(content)[damage])
        fuzz(4 if is_quick else 2, damaged(kind, content), lambda damage, test=test: test(damage))
