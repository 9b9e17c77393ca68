"""Recordings of the first three joints of a simulated PSM, from the CSV to the model and its uses."""

import numpy as np
import pytest
from command_output import refusal
from motions import fourier_motion, true_dynamics

from dvrk_drake.analysis.check.recording_check import check
from dvrk_drake.analysis.motion_identification import identify_dynamic
from dvrk_drake.analysis.motion_validation import validate_motion
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.cli import main
from dvrk_drake.dynamics.gravity_parameters import gravity_parameters
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.export.dvrk_psm_gravity_compensation import kinematic_compensation
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.models.locked_joints import lock_joints
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import Recording

pytestmark = [pytest.mark.numeric, pytest.mark.slow]

WRIST = {"roll": 0.5, "wrist_pitch": -0.6, "wrist_yaw": 0.2, "jaw": 0.3}
OPTION = [f"{name}={position}" for name, position in WRIST.items()]
NOISE, RATE = 0.03, 1000.0
FRICTION = [
    DriveEffect("actuator.yaw", "coulomb", 0.1, 0.2),
    DriveEffect("actuator.pitch", "viscous", 0.0, 0.1),
    DriveEffect("actuator.pitch", "coulomb", 0.1, 0.25),
    DriveEffect("actuator.insertion", "coulomb", 0.01, 0.6),
]
PSM = load_arm("psm")
ARM = lock_joints(PSM, WRIST)
TRUTH = true_dynamics(PSM, np.random.default_rng(0), FRICTION)


def recorded(seed, noise=NOISE, truth=TRUTH):
    """Returns a recording of the first three joints of the full arm, whose wrist is held at `WRIST`."""
    generator = np.random.default_rng(seed)
    t, *motion = fourier_motion(ARM, generator, 10.0, 20.0, RATE)
    whole = np.zeros((3, len(t), 7))
    whole[:, :, :3] = motion
    whole[0, :, 3:] = list(WRIST.values())
    tau = truth.effort(*whole)[:, :3]
    delays = ARM.identification.effort_delay
    tau = np.column_stack([np.interp(t - d, t, x) for d, x in zip(delays, tau.T, strict=True)])
    tau += noise * np.sqrt(np.mean(tau**2, axis=0)) * generator.normal(size=tau.shape)
    q, v, _ = motion
    return Recording(q=q[::5], qd=v[::5], tau=tau[::5], t=t[::5], source="simulated")


@pytest.fixture(scope="module")
def result():
    return identify_dynamic([Observations(recorded(1), ARM)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Returns a folder with two recordings and a model identified with the command."""
    folder = tmp_path_factory.mktemp("three_joints")
    for seed, name in ((1, "one"), (2, "two")):
        write_recording(recorded(seed), folder / f"{name}.csv")
    command = ["identify", f"{folder}/one.csv", "--arm", "psm", "--locked", *OPTION]
    assert main([*command, "--output", f"{folder}/model.yaml"]) == 0
    return folder


def test_other_individual_arm_is_named(result):
    other = true_dynamics(PSM, np.random.default_rng(1), FRICTION)
    for truth, expected in ((TRUTH, []), (other, ["other robot"])):
        kinds = [finding.kind for finding in check(recorded(2, truth=truth), result.model).warnings]
        assert [kind for kind in kinds if kind == "other robot"] == expected


def test_check_with_a_model_continues_with_validate(folder, capsys):
    assert main(["check", f"{folder}/two.csv", "--model", f"{folder}/model.yaml"]) == 0
    assert f"Next: dvrk-drake validate {folder}/two.csv --model {folder}/model.yaml" in capsys.readouterr().out
    assert main(["check", f"{folder}/two.csv", "--model", f"{folder}/model.yaml", "--locked", *OPTION]) == 2
    assert "--locked requires --arm; with --model" in refusal(capsys.readouterr().err)


def test_another_motion_is_predicted_below_the_noise(result):
    validation = validate_motion(result.model, Observations.for_model(recorded(2, noise=0.0), result.model))
    assert all(a.relative_error < NOISE for a in validation.actuators)


def test_true_gravity_lies_in_the_intervals(result):
    B = gravity_parameters(ARM).combination_of([link.link for link in TRUTH.regressor.links])
    beta = B @ TRUTH.parameters[: B.shape[1]]
    z = [(p.value - b) / p.standard_error for p, b in zip(result.model.base_parameters, beta, strict=True)]
    assert np.max(np.abs(z)) < 4


def test_commands_end_to_end(folder, capsys):
    assert main(["check", f"{folder}/one.csv", "--arm", "psm", "--locked", *OPTION, "--verbose"]) == 0
    out = capsys.readouterr().out
    assert "note: roll, wrist_pitch, wrist_yaw, jaw: the recording does not contain these joints" in out
    assert f"--locked {' '.join(OPTION)} --output MODEL.yaml" in out
    assert main(["validate", f"{folder}/two.csv", "--model", f"{folder}/model.yaml", "--require", "good"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "Not in the recording: roll, wrist_pitch, wrist_yaw, jaw." in out
    assert "valid only for roll = 0.5, wrist_pitch = -0.6, wrist_yaw = 0.2, jaw = 0.3" in out
    prediction = folder / "tau.csv"
    assert main(["predict", f"{folder}/two.csv", "--model", f"{folder}/model.yaml", "--output", str(prediction)]) == 0
    units = ("1 [N m]", "2 [N m]", "3 [N]")
    intervals = ("lower", "upper", "lower_other_day", "upper_other_day")
    efforts = [f"{name}{unit}" for name in ("tau", *intervals) for unit in units]
    assert prediction.read_text().splitlines()[0].split(",") == ["t [s]", *efforts, "coordinates", "arm"]


def test_controller_file_contains_the_held_instrument(folder):
    """The chain has a straight instrument, but its last link can represent any rigid instrument."""
    model = IdentifiedModel.from_arm(ARM)
    assert kinematic_compensation(model).loss.difference.max() < 1e-6
    identified = IdentifiedModel.load(folder / "model.yaml")
    assert kinematic_compensation(identified, tolerance=10.0).mass[-1] > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["control", "--arm", "psm", "--model", "MODEL"], "valid only with locked joints (roll = 0.5"),
        (["export", "--model", "MODEL", "--sdf", "OUT.sdf"], "but the format sdf requires all joints"),
        (["validate", "SEVEN", "--model", "MODEL"], "unexpected column q4"),
        (["check", "ONE", "--arm", "psm"], "--locked roll=0 wrist_pitch=0 wrist_yaw=0 jaw=0"),
        (["check", "ONE", "--arm", "psm", "--locked", "roll"], "--locked roll: allowed: NAME=POSITION [rad, m]"),
        (["check", "ONE", "--arm", "psm", "--locked", "roll=0", "roll=1"], "roll is given twice"),
        (["check", "ONE", "--arm", "psm", "--locked", "elbow=0"], 'PSM has no joint "elbow" to lock; allowed: yaw'),
        (["payload", "ONE", "ONE", "--model", "MODEL", "--locked", "roll=0"], "--locked requires --arm"),
    ],
)
def test_refusals(folder, capsys, arguments, message):
    seven = folder / "seven.csv"
    seven.write_text(",".join(f"q{i}" for i in range(1, 8)) + "," + ",".join(f"tau{i}" for i in range(1, 8)) + "\n")
    names = {"MODEL": "model.yaml", "ONE": "one.csv", "SEVEN": "seven.csv", "OUT.sdf": "o.sdf", "OUT.urdf": "o.urdf"}
    assert main([f"{folder}/{names[word]}" if word in names else word for word in arguments]) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert message in refusal(errors[-1] + "\n")
    assert not (folder / "o.sdf").exists() and not (folder / "o.urdf").exists()


def test_real_recordings_of_two_arms(shared_data):
    """A model of one motion predicts another motion of the same arm."""
    data = shared_data / "psm_three_joints"
    if not data.is_dir():
        pytest.skip(f"needs the recordings {data}")
    arm = lock_joints(load_arm("psm"), dict.fromkeys(WRIST, 0.0))
    for fitted, other, worst in (("psm1_2", "psm1_3", 0.15), ("psm2_1", "psm2_2", 0.15)):
        model = identify_dynamic([Observations(read_recording(data / f"{fitted}.csv", arm), arm)]).model
        assert (
            validate_motion(
                model, Observations.for_model(read_recording(data / f"{other}.csv", arm), model)
            ).mean_relative_error
            < worst
        )
