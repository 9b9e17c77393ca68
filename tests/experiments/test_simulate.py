"""Scenarios and `dvrk-drake simulate`: reproducible results and one-line errors."""

import numpy as np
import pytest
from command_output import assert_refused, refused
from pydrake.symbolic import Variable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import SymbolicVectorSystem
from repository import ROOT

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import SimulationError
from dvrk_drake.experiments.scenario import load_scenario
from dvrk_drake.experiments.simulation import advance, simulate
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions
from dvrk_drake.recordings.formats import read_recording

pytestmark = pytest.mark.drake_api

EXAMPLE = ROOT / "examples" / "psm_reach.yaml"
PSM = load_arm("psm")
ZERO = "[0,0,0.1,0,0,0,0]"


def test_reaches_targets_on_time_and_rests():
    targets = [{"time": 0.6, "pose": [0.1, -0.1, 0.09, 0.2, 0.1, -0.1, 0.2]}]
    targets += [{"time": 1.0, "pose": [0.1, -0.1, 0.1, 0.2, 0.1, -0.1, 0.0]}]
    scenario = load_scenario(str(EXAMPLE), ["effort_noise=0", "duration=2", f"targets={targets}"])
    simulation = simulate(scenario)
    recording = simulation.recording
    recording.check_fits(PSM)
    assert len(recording) == 201
    np.testing.assert_allclose(simulation.time, np.arange(201) * 0.01, atol=1e-12)
    np.testing.assert_allclose(recording.q[0], scenario.start, atol=1e-12)
    for target in scenario.targets:
        row = round(target.time / 0.01)
        np.testing.assert_allclose(simulation.desired[row], target.pose, atol=1e-9)
        assert np.all(np.abs(recording.q[row] - target.pose) < PSM.per_joint(5e-3, 1e-3))
    # One second after the last target: at rest; the integrator compensates the cable force on the insertion.
    goal = np.array(scenario.targets[-1].pose)
    assert np.all(np.abs(recording.q[-1] - goal) < PSM.per_joint(1e-3, 1e-4))
    assert np.abs(recording.qd[-1]).max() < 1e-3
    gravity = IdentifiedModel.from_arm(PSM).holding_torque(recording.q[-1])
    assert recording.tau[-1, 2] - gravity[2] == pytest.approx(0.8, abs=0.02)


@pytest.mark.slow
def test_handle_reaches_target_while_joint_4_sticks():
    """In examples/simulated_effects.yaml joint 4 sticks, and joints 6 and 7 move instead."""
    example = str(ROOT / "examples" / "simulated_effects.yaml")
    with_friction, without = (
        simulate(load_scenario(example, ["duration=3", *settings])).state_true[-1, :7]
        for settings in ([], ["simulated_effects=[cables, springs, stops, saturation, encoder, effort, delay]"])
    )
    arm = load_arm("mtml")
    target_pose = np.array(load_scenario(example, []).hand.path[-1].pose)
    assert abs(target_pose[3]) == 0.3 and abs(with_friction[3]) < 0.01
    # Without friction joint 4 moves, since the handle pose does not determine the seven joint positions.
    assert abs(without[3]) > 0.05
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    poses = []
    for q in (target_pose, with_friction):
        set_arm_positions(plant, context, arm, q)
        poses.append(plant.GetFrameByName("dh_7").CalcPoseInWorld(context))
    difference = poses[0].inverse() @ poses[1]
    assert np.linalg.norm(difference.translation()) < 2e-3 and difference.rotation().ToAngleAxis().angle() < 0.02
    # Joints 5 to 7 deviate from the target positions.
    assert np.abs(with_friction - target_pose)[4:].max() > 0.1


def test_scenario_is_deterministic_and_seed_changes_noise(tmp_path):
    files = []
    for i, seed in enumerate((1, 1, 2)):
        path = tmp_path / f"{i}.csv"
        settings = [f"seed={seed}", "duration=1", "targets=[]", "sample_period=0.002"]
        words = [word for setting in settings for word in ("--set", setting)]
        assert main(["simulate", str(EXAMPLE), *words, "--output", str(path)]) == 0
        files.append(path.read_bytes())
    assert files[0] == files[1] != files[2]
    first, other = (read_recording(tmp_path / name, PSM) for name in ("0.csv", "2.csv"))
    np.testing.assert_allclose(first.q, other.q, atol=1e-12)
    noise = (first.tau - other.tau) / PSM.effort_limits / np.sqrt(2)
    np.testing.assert_allclose(noise.std(axis=0), 0.01, rtol=0.15, atol=0)


@pytest.mark.parametrize("name", ["mtml", pytest.param("mtmr", marks=pytest.mark.slow), "psm"])
@pytest.mark.parametrize("mode", ["hold", "gravity"])
def test_every_arm_holds_its_start_pose(name, mode):
    simulation = simulate(load_scenario(name, ["duration=0.5", f"controller.mode={mode}"]))
    q = simulation.recording.q
    arm = load_arm(name)
    np.testing.assert_allclose(q[0], np.clip(0, arm.position_lower, arm.position_upper), atol=1e-12)
    assert np.abs(q - q[0]).max() < 1e-5
    assert (simulation.desired is None) == (mode == "gravity")


def test_gravity_direction_requires_matching_model(tmp_path):
    model = tmp_path / "upright.yaml"
    IdentifiedModel.from_arm(PSM).save(model)
    settings = ["duration=0.5", "controller.mode=gravity", "gravity=[0,-9.81,0]", f"start={ZERO}"]
    moved = []
    for more in ([], [f"controller.model={model}"]):
        q = simulate(load_scenario("psm", [*settings, *more])).recording.q
        moved.append(np.abs(q[-1] - q[0]).max())
    assert moved[0] < 1e-5
    assert moved[1] > 0.05


def test_other_commands_read_the_recording(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")  # headings on one line
    model, recording, errors = (str(tmp_path / name) for name in ("model.yaml", "held.csv", "errors.json"))
    IdentifiedModel.from_arm(PSM).save(model)
    start = "start=[0.5,0.4,0.1,0.3,0.2,-0.3,0.4]"
    command = ["simulate", "--arm", "psm", "--set", start, "--set", "duration=1", "--output", recording]
    assert main([*command, "--plots", str(tmp_path / "plots")]) == 0
    assert (tmp_path / "plots/simulation.png").stat().st_size > 10_000
    assert "Largest tracking error" in capsys.readouterr().out
    assert main(["validate", recording, "--model", model, "--json", errors]) == 0
    held = read_recording(recording, PSM)
    np.testing.assert_allclose(held.tau, IdentifiedModel.load(model).holding_torque(held.q), atol=1e-3)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("durations=2", 'psm: key "durations" is unknown; did you mean "duration"? allowed in a scenario: arm,'),
        ("simulated_effects=[al]", "unknown effect al; allowed: all, friction"),
        ("closure=weld", 'closure is "weld"; allowed: mimic, ball'),
        ("controller.mode=float", 'controller.mode is "float"; allowed: hold, gravity'),
        ("controller.model=nothing.yaml", "nothing.yaml: no such file"),
        ("start=[0, 0, 0.1, 0, 0, 0]", "start has 6 numbers; PSM has 7 joints: yaw, pitch, insertion"),
        (
            "start=[0, 0, 100, 0, 0, 0, 0]",
            "insertion = 100 is outside 0..0.24 [rad, m] of PSM. Give insertion in m, not in mm.",
        ),
        ("start=[3, 0, 0.1, 0, 0, 0, 0]", "yaw = 3 is outside -1.588..1.588 [rad, m] of PSM"),
        ("targets=[{time: 1, pose: [0, 0]}]", "targets[0].pose has 2 numbers"),
        (f"targets=[{{time: 9, pose: {ZERO}}}]", "targets[0].time is 9 s; allowed: after 0 s, up to the duration of"),
        ("effects=[{coordinate: elbow, kind: offset}]", 'effects[0].coordinate is "elbow"; allowed: actuator.yaw'),
        ("arm=psm9", 'unknown arm "psm9"; did you mean "psm"? known arms: ecm, ecm_si, mtml, mtmr, psm, psm_si'),
        ("duration", "--set duration: a setting must be key=value"),
        ("start=[0,", "--set start=[0,: invalid YAML"),
    ],
)
def test_invalid_settings_give_one_line_error(setting, message, capsys, tmp_path):
    output = tmp_path / "out.csv"
    assert message in refused(capsys, "simulate", "--arm", "psm", "--set", setting, "--output", output)
    assert not output.exists()


class Failing(LeafSystem):
    """System whose output raises an error at 0.3 s."""

    def __init__(self, error):
        super().__init__()
        self._error = error
        self.DeclarePeriodicPublishEvent(0.1, 0.0, self._publish)

    def _publish(self, context):
        if context.get_time() > 0.25:
            raise self._error


def diverging():
    """Returns a simulation without a solution beyond 1 s: the state of xd = x^2 is 1 / (1 - t)."""
    x = Variable("x")
    simulator = Simulator(SymbolicVectorSystem(state=[x], dynamics=[x**2]))
    simulator.get_mutable_context().SetContinuousState([1.0])
    return simulator


def test_divergence_is_distinguished_from_programming_errors():
    times = np.arange(0.0, 2.0, 0.1)
    with pytest.raises(SimulationError, match=r"^the simulation failed at 1 s: .*step smaller than minimum"):
        advance(diverging(), times)
    for error in (np.linalg.LinAlgError("Singular matrix"), FloatingPointError("overflow")):
        with pytest.raises(SimulationError, match=r"^the simulation failed at 0.3 s: (Singular matrix|overflow)"):
            advance(Simulator(Failing(error)), times)
    for error in (ValueError("operands could not be broadcast"), RuntimeError("dictionary changed size")):
        assert_refused(type(error), str(error), advance, Simulator(Failing(error)), times)
