"""`check` refuses exactly the recordings that `identify` refuses, with the same message."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from command_output import messages

from dvrk_drake.analysis.check.recording_check import check, check_recording
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torques
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import Recording

ARM = load_arm("mtmr")


def with_sign(recording, joint):
    """Returns the recording with one effort of the wrong sign."""
    return replace(recording, tau=recording.measured_effort() * np.where(np.arange(7) == joint, -1, 1))


def with_efforts(q, arm=ARM, **columns):
    """Returns a recording of poses (m, 7) with holding torques of the SDF model."""
    return Recording(q=q, tau=holding_torques(arm, q) + 1e-4 * np.random.default_rng(1).normal(size=q.shape), **columns)


def poses(count):
    return with_efforts(ARM.sample_poses(count, np.random.default_rng(0), 0.1))


def motion(seconds, rate, speed=1.0):
    """Returns a motion of all joints. They are at rest if `speed` is 0."""
    t = np.arange(round(seconds * rate)) / rate
    phase = speed * t[:, None] + np.arange(7)
    return with_efforts(0.1 + 0.1 * np.sin(phase), qd=0.1 * speed * np.cos(phase), t=t)


REFUSED = {
    "one row": (lambda: poses(1), "1 distinct pose found. Identification requires at least 8"),
    "few poses": (lambda: poses(7), "7 distinct poses found. Identification requires at least 8"),
    "still": (lambda: motion(6, 100, 0.0), "1 distinct pose found"),
    "short": (lambda: motion(1.5, 100), "1.5 s at 100 Hz. A dynamic model requires at least 2 s at 50 Hz or more."),
    "slow": (lambda: motion(10, 30), "10.0 s at 30 Hz. A dynamic model requires"),
    "few rows": (lambda: motion(0.5, 100), "the recording has 50 rows of a motion"),
    "no times": (lambda: replace(motion(6, 100), t=None), "Static identification requires poses at rest"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_check_refuses_what_identify_refuses(name, tmp_path, capsys):
    make, message = REFUSED[name]
    path, model = str(tmp_path / "r.csv"), tmp_path / "model.yaml"
    write_recording(make(), path)
    lines = []
    for arguments in (["check", path], ["identify", path, "--output", str(model)]):
        assert main([*arguments, "--arm", "mtmr"]) == 2
        lines.append(capsys.readouterr().err.splitlines()[-1])
    assert all(message in line for line in lines), lines
    assert lines[0].startswith(f"dvrk-drake: error: {path}: refused: ")
    assert not model.exists()


def test_check_accepts_what_identify_accepts(tmp_path, capsys):
    path = str(tmp_path / "r.csv")
    for recording in (poses(8), motion(6, 100)):
        write_recording(recording, path)
        assert main(["check", path, "--arm", "mtmr"]) == 0, capsys.readouterr().out
        assert not check(read_recording(path, ARM), ARM).refusals


def test_few_poses_are_not_refused_for_validation():
    assert [
        finding.kind for finding in check_recording(Observations(poses(3), ARM)).findings if finding.kind == "few poses"
    ]
    assert not check_recording(Observations(poses(3), ARM)).refusals


def test_static_poses_of_a_motion_are_checked_as_poses():
    """A wrong sign is detectable in the static poses of a motion with pauses."""
    pose = ARM.sample_poses(12, np.random.default_rng(2), 0.1)
    pose = np.vstack([pose, pose[:1]])  # a closed path, so that the work of gravity is 0
    paths = [np.linspace(a, b, 100, endpoint=False) for a, b in pairwise(pose)]
    q = np.vstack([np.vstack([np.repeat(a[:1], 60, 0), a]) for a in paths] + [np.repeat(pose[-1:], 60, 0)])
    recording = with_efforts(q, t=np.arange(len(q)) / 100)
    friction = 0.05 * ARM.effort_limits * np.tanh(np.gradient(q, 0.01, axis=0) / 0.05)
    recording = replace(recording, tau=recording.measured_effort() + friction)
    assert not check(recording, ARM).refusals
    (refusal,) = check(with_sign(recording, 2), ARM).refusals
    assert (refusal.kind, refusal.joints) == ("effort sign", (2,))


@pytest.mark.parametrize("coordinates", ["joint", "actuator"])
@pytest.mark.parametrize(
    ("name", "joint"),
    [
        ("mtmr", 1),
        ("psm", 1),
        pytest.param("mtmr", 2, marks=pytest.mark.slow),
        pytest.param("psm", 0, marks=pytest.mark.slow),
    ],
)
def test_refuses_one_wrong_sign_of_poses(name, joint, coordinates):
    """The efforts contain Coulomb friction of random sign, as real poses do."""
    arm, generator = load_arm(name), np.random.default_rng(5)
    recording = with_efforts(arm.sample_poses(20, generator, 0.1), arm)
    friction = 0.03 * arm.effort_limits * generator.choice([-1, 1], recording.q.shape)
    recording = replace(recording, tau=recording.measured_effort() + friction)
    if coordinates == "actuator":
        recording = recording.in_actuator_coordinates(arm)
    assert not check(recording, arm).refusals
    (refusal,) = check(with_sign(recording, joint), arm).refusals
    assert (refusal.kind, refusal.where, refusal.joints) == ("effort sign", arm.joint_names[joint], (joint,))


def test_accepts_opposite_efforts_of_offsets_or_cables():
    """Efforts may be opposite to gravity because of an offset, or because of cables at a light wrist."""
    recording = poses(20)
    tau = recording.measured_effort().copy()
    tau[:, 1] -= 3 * np.mean(tau[:, 1])
    tau[:, 5] *= -1
    assert not check(replace(recording, tau=tau), ARM).refusals


@pytest.mark.parametrize("name", ["mtm_2015_good72", "mtm_2015_apr18_all80", "mtmr_2017_sweep40"])
def test_refuses_a_wrong_sign_in_real_poses(name, shared_data):
    recording = read_recording(shared_data / "mtm_static" / f"{name}.csv", ARM)
    for joint in (1, 2):
        (refusal,) = check(with_sign(recording, joint), ARM).refusals
        assert refusal.joints == (joint,)


@pytest.mark.slow
def test_accepts_real_recordings(shared_data):
    checked = 0
    for path in [*(shared_data / "mtm_static").glob("mtm*.csv"), *(shared_data / "trajectories").glob("*_one*.csv")]:
        arm = load_arm("psm" if path.name.startswith("psm") else "mtmr")
        recording = read_recording(path, arm, "actuator" if path.parent.name == "trajectories" else "joint")
        if recording.tau is not None:
            assert not check(recording, arm).refusals, path.name
            checked += 1
    assert checked == 9


# Next step that `dvrk-drake check` suggests for a recording of another arm.


MTML = load_arm("mtml")


def next_step(capsys, folder, wrist, arm, *options):
    """Checks poses of an MTML, one of them with another position of wrist_platform, as a recording of `arm`.

    Returns the next step, and the message on stderr.
    """
    q, path = MTML.sample_poses(30, np.random.default_rng(5)), folder / "r.csv"
    q[:, [0, 3]] *= 0.4  # within the limits of both MTMs
    q[3, 3] = wrist
    write_recording(Recording(q=q, tau=IdentifiedModel.from_arm(MTML).holding_torque(q)), path)
    assert main(["check", str(path), "--arm", arm, *options]) == 2
    captured = capsys.readouterr()
    (step,) = (line for line in captured.out.splitlines() if line.startswith("Next: "))
    (error,) = messages(captured.err)
    return step.removeprefix("Next: dvrk-drake check ").replace(str(path), "r.csv"), error


def test_next_step_is_the_check_for_the_other_arm(tmp_path, capsys):
    # This position is within the limits of an MTML, and 1.8 rad outside those of an MTMR.
    step, error = next_step(capsys, tmp_path, -3.5, "mtmr", "--coordinates", "joint")
    assert (
        "Is the arm or the choice of coordinates wrong? Coordinates: joint, actuator, or wpi (recordings of WPI"
        in error
    )
    assert step == "r.csv --arm mtml --coordinates joint"


def test_next_step_names_no_arm_if_several_fit(tmp_path, capsys):
    assert next_step(capsys, tmp_path, 0.0, "psm")[0] == "r.csv --arm ARM"


def test_a_recording_of_no_arm_is_checked_again(tmp_path, capsys):
    """The cause is in the file, which the user corrects."""
    assert next_step(capsys, tmp_path, 6.0, "mtmr")[0] == "r.csv --arm mtmr"
