"""Tests of the public API: fast import, documented names with examples, and the example in the README."""

import ast
import dataclasses
import doctest
import re
import subprocess
import sys

import numpy as np
import pytest
from command_output import assert_refused
from pydrake.systems.framework import LeafSystem
from repository import ROOT

import dvrk_drake as dvrk
from dvrk_drake.errors import DvrkDrakeError, RecordingError
from dvrk_drake.models.sdf_model import MODELS_FOLDER

pytestmark = pytest.mark.drake_api

#: Packages with a slow import.
SLOW = {"pydrake", "numba", "numpy", "scipy", "sympy", "matplotlib", "rich", "yaml"}


def loaded_by(code: str) -> set[str]:
    """Returns the names of all modules that a new process has loaded after `code`."""
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; import sys; print(*sys.modules)"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


def test_import_loads_no_submodules():
    loaded = loaded_by("import dvrk_drake; assert 'identify' in dir(dvrk_drake)")
    assert "dvrk_drake" in loaded and not loaded & SLOW
    assert not {name for name in loaded if name.startswith("dvrk_drake.")}


def test_name_loads_only_required_packages():
    loaded = loaded_by("import dvrk_drake; dvrk_drake.Recording")
    assert "numba" not in loaded and "matplotlib" not in loaded


def test_type_checkers_see_the_run_time_names():
    tree = ast.parse((ROOT / "dvrk_drake/__init__.py").read_text())
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    modules = {alias.name: node.module for node in typed.body for alias in node.names}
    assert {name: f"dvrk_drake.{module}" for name, module in dvrk._MODULES.items()} == modules
    assert dvrk.__all__ == sorted(modules)
    packages = {path.stem for path in (ROOT / "dvrk_drake").iterdir()}
    assert not packages & set(modules), "a module would hide the function"


def test_unknown_name_is_in_the_error():
    with pytest.raises(AttributeError, match="'dvrk_drake' has no attribute 'identifi'"):
        dvrk.identifi  # noqa: B018


#: Names whose examples take seconds, and whose functions other tests call.
LONG = (
    *("payload", "design_poses", "design_excitation", "PeriodicMotion"),
    *("estimate_force", "ExternalForceEstimator"),
)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in dvrk.__all__])
def test_docstring_example_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    value = getattr(dvrk, name)
    tests = doctest.DocTestFinder(recurse=False).find(value, name, module=False)
    examples = [example for test in tests for example in test.examples]
    assert examples and examples[0].source.startswith("import dvrk_drake as dvrk")
    failures = []
    for test in tests:
        doctest.DocTestRunner().run(test, out=failures.append)
    assert not failures, "".join(failures)


@pytest.fixture
def poses(identified_poses):
    """Returns an arm, its nominal model, and a recording of 40 static poses with the holding torque of the model."""
    return identified_poses.arm, identified_poses.nominal, identified_poses.recording


def test_error_contains_the_findings(poses):
    arm, _, recording = poses
    opposite = dataclasses.replace(recording, tau=-recording.tau)
    with pytest.raises(dvrk.DvrkDrakeError, match=r"poses\.csv: refused") as refused:
        dvrk.identify(opposite, arm)
    assert refused.value.findings and refused.value.findings[0].severity == "refusal"
    assert str(refused.value.findings[0].what) in str(refused.value)


def test_warnings_are_from_recording_and_result(poses):
    arm, _, recording = poses
    tau = recording.tau.copy()
    tau[:, 6] = 0.0
    result = dvrk.identify(dataclasses.replace(recording, tau=tau), arm)
    assert ("no effort", "wrist_roll") in {(warning.kind, warning.where) for warning in result.warnings}
    errors = dvrk.validate(result.model, recording)
    assert [warning.kind for warning in errors.warnings] == ["same recording"]
    assert_refused(dvrk.DvrkDrakeError, "was identified from this recording", errors.save, "model.yaml")


def test_progress_reports_the_steps_in_order(identified_poses):
    steps = identified_poses.progress
    assert list(dict(steps)) == ["checking the recording", "identifying"]
    for name in dict(steps):
        shares = [share for step, share in steps if step == name]
        assert shares == sorted(shares) and shares[0] == 0.0 and 0.9 < shares[-1] <= 1.0


def test_result_replaces_a_file_only_on_request(identified_poses, tmp_path):
    model, result = identified_poses.nominal, identified_poses.result
    result.save(tmp_path / "model.yaml")
    with pytest.raises(dvrk.DvrkDrakeError, match=r"model.yaml already exists\. .* overwrite=True"):
        result.save(tmp_path / "model.yaml")
    result.save(tmp_path / "model.yaml", overwrite=True)
    dvrk.export_model(model, tmp_path / "arm.urdf")
    assert_refused(dvrk.DvrkDrakeError, r"arm.urdf already exists", dvrk.export_model, model, tmp_path / "arm.urdf")
    with pytest.raises(dvrk.DvrkDrakeError, match=r"arm.xml: the format is not given; give one of sdf, urdf"):
        dvrk.export_model(model, tmp_path / "arm.xml")


def test_verdicts_are_stored_and_not_replaced_by_default(poses, tmp_path):
    _, model, recording = poses
    dvrk.validate(model, recording).save(tmp_path / "model.yaml")
    stored = dvrk.IdentifiedModel.load(tmp_path / "model.yaml")
    assert stored.validation.verdicts == dvrk.validate(model, recording).verdicts
    with pytest.raises(dvrk.DvrkDrakeError, match=r"already has verdicts from poses\.csv"):
        dvrk.validate(stored, recording).save(tmp_path / "model.yaml")


def test_nominal_model_has_the_dynamics_of_the_arm(tmp_path):
    """The model predicts the holding torques of the static model, and the efforts of a simulated motion."""
    arm = dvrk.load_arm("psm")
    model = dvrk.IdentifiedModel.from_arm(arm, dynamics=True)
    model.save(tmp_path / "psm.yaml")
    assert dvrk.IdentifiedModel.load(tmp_path / "psm.yaml") == model
    springs = dvrk.IdentifiedModel.from_arm(arm, arm.effects.cables + arm.effects.springs)
    q = arm.sample_poses(5, np.random.default_rng(0))
    np.testing.assert_allclose(model.holding_torque(q), springs.holding_torque(q), atol=1e-12)
    with pytest.raises(dvrk.DvrkDrakeError, match="either effects or dynamics"):
        dvrk.IdentifiedModel.from_arm(arm, arm.effects.springs, dynamics=True)
    reached = arm.sample_poses(6, np.random.default_rng(1), margin=0.2)
    targets = [(k + 1.0, pose) for k, pose in enumerate(reached)]
    run = dvrk.simulate(arm, effects=["friction"], duration=6.5, targets=targets, sample_period=0.005)
    assert np.abs(run.recording.q[600] - reached[2]).max() < 0.05
    heavy = dvrk.validate(model, run.recording).relative_errors
    assert max(heavy[name] for name in ("yaw", "pitch", "insertion")) < 0.15
    without = dataclasses.replace(run.recording, tau=None)
    predicted = dvrk.predict(model, without).tau
    assert np.corrcoef(predicted[200:-200, 1], run.recording.tau[200:-200, 1])[0, 1] > 0.99


def test_simulates_a_system_or_a_scenario(poses):
    arm, model, _ = poses
    controller = ZeroEffortController(arm.num_joints)
    falls = dvrk.simulate(arm, controller=controller, effects=False, duration=0.3)
    assert falls.desired is None and np.all(falls.recording.tau == 0) and np.abs(falls.recording.q[-1]).max() > 0.05
    controller = dvrk.GravityPidController(model)
    start = [0.2, 0.4, -0.25, 0.6, 0.9, 0.3, 0.5]
    held = dvrk.simulate(arm, controller=controller, effects=False, duration=0.3, start=start)
    np.testing.assert_allclose(held.recording.q[-1], start, atol=1e-3)
    with pytest.raises(dvrk.DvrkDrakeError, match="`duration` cannot be given with a scenario"):
        dvrk.simulate(dvrk.load_scenario("mtmr"), duration=1.0)


class ZeroEffortController(LeafSystem):
    """Controller that commands zero effort."""

    def __init__(self, n):
        super().__init__()
        self.DeclareVectorInputPort("state_estimated", 2 * n)
        self.DeclareVectorOutputPort("effort", n, lambda context, output: output.SetZero())


def readme_example() -> str:
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    return example


def test_readme_example_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    dvrk.write_samples("samples")
    exec(compile(readme_example(), "README.md", "exec"), {})
    assert (tmp_path / "model_python.yaml").is_file()
    assert capsys.readouterr().out.startswith("verdict usable")


@pytest.fixture(scope="module")
def exact():
    arm = dvrk.load_arm("mtmr")
    q = arm.sample_poses(40, np.random.default_rng(0))
    return arm, dvrk.Recording(q=q, tau=dvrk.IdentifiedModel.from_arm(arm).holding_torque(q), source="poses.csv")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tau": np.zeros((39, 7))}, r"poses.csv: tau has shape \(39, 7\), but q has \(40, 7\)"),
        ({"t": [0.0, 1.0]}, r"poses.csv: t has shape \(2,\), but q has \(40, 7\)"),
        ({"q": np.zeros(7)}, r"poses.csv: q has shape \(7,\); allowed: \(rows, joints\)"),
        ({"coordinates": "Joint"}, 'poses.csv: coordinates is "Joint"; allowed: joint, actuator'),
    ],
)
def test_recording_is_checked_on_creation(exact, change, message):
    assert_refused(RecordingError, message, dataclasses.replace, exact[1], **change)


@pytest.mark.parametrize("name", ["q", "tau"])
def test_nan_is_rejected_with_its_row(exact, name):
    arm, recording = exact
    values = getattr(recording, name).copy()
    values[3, 1] = np.nan
    with pytest.raises(RecordingError, match=rf"poses.csv, row 4: {name}2 = nan is not plausible"):
        dvrk.identify(dataclasses.replace(recording, **{name: values}), arm)


def test_rejects_an_unknown_method(exact):
    with pytest.raises(DvrkDrakeError, match='method is "pape"; allowed: robust, paper'):
        dvrk.identify(exact[1], exact[0], method="pape")


def test_rejects_invalid_simulation_arguments():
    arm = dvrk.load_arm("mtml")
    for controller, message in (
        ("m.yaml", "`controller` is a str; allowed: an IdentifiedModel"),
        (dvrk.IdentifiedModel.from_arm(dvrk.load_arm("mtmr")), "`controller` is a model of MTMR, but the simulated"),
    ):
        assert_refused(DvrkDrakeError, message, dvrk.simulate, arm, controller=controller)
    assert_refused(DvrkDrakeError, "`what` is a str; allowed: an Arm", dvrk.simulate, "mtml")
    assert_refused(DvrkDrakeError, "unknown effect frictions", dvrk.simulate, arm, effects="frictions")


def test_changed_arm_file_is_read_again(tmp_path):
    path = tmp_path / "own.yaml"
    text = (MODELS_FOLDER / "arms" / "mtmr.yaml").read_text()
    path.write_text(text)
    first = dvrk.load_arm(path)
    assert dvrk.load_arm(str(path)) is first
    path.write_text(text.replace("MTMR", "OTHER"))
    assert (first.name, dvrk.load_arm(path).name) == ("MTMR", "OTHER")
