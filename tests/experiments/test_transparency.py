"""Operator forces: known forces at rest, and the order of the forces with different compensations."""

import csv

import numpy as np
import pytest
from command_output import assert_refused, refused
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ScenarioError
from dvrk_drake.experiments.transparency import Compensation, random_path, recorded_path, simulate_operator
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording

ARM = load_arm("mtml")
MODEL = IdentifiedModel.from_arm(ARM)
REST = np.array([0.1, 0.3, -0.1, 0.4, 0.3, 0.1, 0.2])


def constant_pose(seconds):
    return PiecewisePolynomial.ZeroOrderHold([0.0, seconds], np.array([REST, REST]).T)


def test_no_hand_force_on_compensated_arm():
    forces = simulate_operator(ARM, constant_pose(1.5), Compensation("gravity", MODEL))
    assert forces.rms_force < 1e-6 and forces.measures["rms_torque"] < 1e-6
    assert forces.deviation.max() < 1e-6


def test_hand_force_equals_weight_of_unpowered_arm():
    """The force of the grip equals its stiffness times the deviation of the handle."""
    forces = simulate_operator(ARM, constant_pose(3.0), Compensation("nothing"))
    assert forces.rms_force > 1.0
    # At rest, the spring force of the grip balances the weight of the arm. 600 N/m is the stiffness of `Grip`.
    late = forces.time > 2.9
    np.testing.assert_allclose(
        np.linalg.norm(forces.force[late], axis=1), 600.0 * forces.deviation[late], rtol=0.02, atol=0
    )


@pytest.mark.slow
def test_each_compensation_reduces_operator_force():
    path = random_path(ARM, poses=3)
    friction = ARM.effects.only(["friction", "encoder", "delay"])
    listed = [Compensation("nothing"), Compensation("gravity", MODEL), Compensation("friction", MODEL, 0.6)]
    unpowered, gravity, both = (simulate_operator(ARM, path, one, effects=friction) for one in listed)
    assert unpowered.rms_force > 2 * gravity.rms_force
    assert gravity.rms_force > 1.3 * both.rms_force
    assert gravity.measures["rms_torque"] > both.measures["rms_torque"]


def test_recorded_path_respects_limits_and_speed():
    t = np.linspace(3.0, 5.0, 50)
    middle, half = (ARM.position_upper + ARM.position_lower) / 2, (ARM.position_upper - ARM.position_lower) / 2
    middle[1:3], half[1:3] = 0.1, 0.0  # inside the limits of the parallelogram
    q = middle + (half + 0.05) * np.sin(t)[:, None]
    path = recorded_path(ARM, Recording(q=q, t=t, tau=np.zeros_like(q)), speed=0.5)
    assert path.start_time() == 0 and path.end_time() == pytest.approx(4.0)
    values = np.array([path.value(x).ravel() for x in np.linspace(0, 4, 500)])
    assert np.all(values <= ARM.position_upper + 1e-12) and np.all(values >= ARM.position_lower - 1e-12)
    expected = np.clip(middle + (half + 0.05) * np.sin(4.0), ARM.position_lower, ARM.position_upper)
    np.testing.assert_allclose(path.value(2.0).ravel(), expected, atol=2e-3)
    with pytest.raises(ScenarioError, match="exceeds the limits of MTML"):
        recorded_path(ARM, Recording(q=middle + (half + 0.2) * np.sin(t)[:, None], t=t, tau=np.zeros_like(q)))
    assert_refused(ScenarioError, "speed is 0", recorded_path, ARM, Recording(q=q, t=t, tau=np.zeros_like(q)), speed=0)
    assert_refused(ScenarioError, "no times", recorded_path, ARM, Recording(q=q, tau=np.zeros_like(q)))
    assert_refused(ScenarioError, "takes 0.9 s", simulate_operator, ARM, constant_pose(0.9), Compensation("nothing"))
    assert_refused(ScenarioError, "has 2 different times", recorded_path, ARM, Recording(q=q[:2], t=t[:2]))
    with pytest.raises(ScenarioError, match="parallelogram exceeds the limits of MTML"):
        recorded_path(ARM, Recording(q=q + 0.6 * np.array([0, 1, 1, 0, 0, 0, 0]), t=t))
    moved = Recording(q=q, t=t).in_actuator_coordinates(ARM)
    np.testing.assert_allclose(recorded_path(ARM, moved, 0.5).value(2.0), path.value(2.0), atol=1e-12)


def test_hand_moves_psm_at_its_instrument():
    psm = load_arm("psm")
    pose = np.clip(0.1, psm.position_lower, psm.position_upper)
    path = PiecewisePolynomial.ZeroOrderHold([0.0, 1.1], np.array([pose, pose]).T)
    assert (
        simulate_operator(psm, path, Compensation("SDF", IdentifiedModel.from_arm(psm))).rms_force < 1e-4
    )  # the pins of the loops are slightly compliant
    assert simulate_operator(psm, path, Compensation("nothing")).rms_force > 0.5


def test_command_writes_table(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("dvrk_drake.experiments.transparency.random_path", lambda arm: constant_pose(1.2))
    model, table = tmp_path / "ours.yaml", tmp_path / "table.csv"
    MODEL.save(model)
    arguments = ["simulate", "transparency", "--arm", "mtml", "--model", str(model), "--simulated-effects", "friction"]
    assert main([*arguments, "--output", str(table), "--plots", str(tmp_path / "plots")]) == 0
    with open(table) as stream:
        rows = list(csv.DictReader(stream))
    assert [row["compensation"] for row in rows] == [
        "nothing",
        "ours",
        "ours, friction 0.5",
        "ours, friction 0.5, guide",
    ]
    assert float(rows[0]["rms_force"]) > 1.0 > float(rows[1]["rms_force"])
    assert (tmp_path / "plots/transparency.png").stat().st_size > 10_000
    assert "Smallest interaction force at the handle: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--friction-ratio", "1"], "between 0 and 0.6"),
        (["--model", "nothing.yaml"], "nothing.yaml: no such file"),
        (["--simulated-effects", "wings"], "unknown effect wings; allowed: all, friction"),
        (["--frame", "dh_9"], 'MTML: the SDF has no frame "dh_9"; available frames: dh_0, dh_1'),
        (["--speed", "2"], "--speed requires --path with a recorded motion"),
        (["--path", "nowhere.csv"], "nowhere.csv"),
    ],
)
def test_invalid_input_gives_one_line_and_exit_code_2(arguments, message, capsys):
    assert message in refused(capsys, "simulate", "transparency", "--arm", "mtml", *arguments)
