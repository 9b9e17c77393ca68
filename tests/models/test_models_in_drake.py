"""Compares models read by the parser of Drake with the arms of `load_arm`."""

import dataclasses
import re

import numpy as np
import pytest
from command_output import messages, refused
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, DiscreteContactApproximation, MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from repository import ROOT

from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.analysis.validation import validate_static
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError
from dvrk_drake.experiments.paper import PAPER
from dvrk_drake.export.dvrk_mtm_gravity_compensation import (
    CompensationOptions,
    compare_compensation,
    compensation_from_model,
)
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile, controller_torque
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.models.plant import holding_torque, make_arm_plant, package_map, set_arm_positions
from dvrk_drake.recordings.formats import read_recording

pytestmark = pytest.mark.drake_api

PSM = "package://dvrk_drake/directives/psm.dmd.yaml"
#: Arms with an SDF of all their parts. The instrument of the other one is made from the table of the dVRK.
ARMS = [name for name in known_arms() if name != "psm_si"]


def add_models(parser: Parser, name: str) -> None:
    """Adds an arm to the parser's plant as described in docs/models_in_drake.md."""
    parser.package_map().AddMap(package_map())
    if name == "psm":
        parser.AddModels(url=PSM)
    else:
        parser.AddModels(url=f"package://dvrk_drake/sdf/{name}.sdf")
        plant = parser.plant()
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link"))


def plain_plant(name: str) -> MultibodyPlant:
    plant = MultibodyPlant(1e-3)
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    parser = Parser(plant)
    parser.SetStrictParsing()
    add_models(parser, name)
    plant.Finalize()
    return plant


def positions(plant: MultibodyPlant, arm: Arm, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the positions of the plant at pose q (n,), and the index of each tree joint in these positions."""
    index = np.array([plant.GetJointByName(joint).position_start() for joint in arm.tree_joint_names])
    q_plant = np.zeros(plant.num_positions())
    q_plant[index] = arm.linkage.position(q)
    return q_plant, index


@pytest.mark.parametrize("name", ARMS)
def test_drake_parser_and_load_arm_give_the_same_arm(name):
    arm = load_arm(name)
    composed, plain = make_arm_plant(arm), plain_plant(name)
    assert plain.num_positions() == composed.num_positions() == len(arm.tree_joint_names)
    composed_context, context = composed.CreateDefaultContext(), plain.CreateDefaultContext()
    for q in arm.sample_poses(10, np.random.default_rng(0)):
        set_arm_positions(composed, composed_context, arm, q)
        q_plant, index = positions(plain, arm, q)
        plain.SetPositions(context, q_plant)
        gravity = -arm.linkage.pull_back_effort(plain.CalcGravityGeneralizedForces(context)[index])
        np.testing.assert_allclose(gravity, holding_torque(composed, composed_context, arm), atol=1e-12)
        order = positions(composed, arm, q)[1]
        mass = plain.CalcMassMatrix(context)[np.ix_(index, index)]
        np.testing.assert_allclose(mass, composed.CalcMassMatrix(composed_context)[np.ix_(order, order)], atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_limits_are_those_of_the_arm(name):
    arm, plant = load_arm(name), plain_plant(name)
    for i, joint_name in enumerate(arm.joint_names):
        joint = plant.GetJointByName(joint_name)
        assert joint.position_lower_limits() == pytest.approx([arm.position_lower[i]], abs=1e-9)
        assert joint.position_upper_limits() == pytest.approx([arm.position_upper[i]], abs=1e-9)
        assert plant.GetJointActuatorByName(joint_name).effort_limit() == arm.effort_limits[i]
    assert plant.num_actuators() == arm.num_joints


@pytest.mark.parametrize("name", ARMS)
def test_simulated_links_do_not_collide_and_linkage_follows(name):
    arm = load_arm(name)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    add_models(Parser(plant), name)
    plant.Finalize()
    assert not scene_graph.model_inspector().GetCollisionCandidates()
    simulator = Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    start, index = positions(plant, arm, arm.sample_poses(1, np.random.default_rng(1))[0])
    plant.SetPositions(context, start)
    simulator.AdvanceTo(0.1)
    tree = plant.GetPositions(context)[index]
    assert np.abs(tree - start[index]).max() > 1e-3, "the arm falls"
    independent = [arm.tree_joint_names.index(joint) for joint in arm.joint_names]
    np.testing.assert_allclose(tree, arm.linkage.position(tree[independent]), atol=1e-4)


def test_code_of_the_page_about_drake_runs(capsys):
    page = (ROOT / "docs/models_in_drake.md").read_text()
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(code, {})
    assert "13 positions" in capsys.readouterr().out


# Tests mirrored wrists of left and right arms: equations, files of real arms, exported models.


#: Signs that mirror the joint angles and torques of an arm in the plane x = 0.
MIRROR = np.array([-1.0, 1.0, 1.0, -1.0, 1.0, -1.0, -1.0])


def torque(arm, q):
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, q)
    return holding_torque(plant, context, arm)


def test_left_and_right_are_mirror_images():
    left, right = load_arm("mtml"), load_arm("mtmr")
    for q in left.sample_poses(5, np.random.default_rng(0)):
        np.testing.assert_allclose(torque(left, q), MIRROR * torque(right, MIRROR * q), atol=1e-12)
        assert np.abs(torque(left, q) - torque(right, q)).max() > 0.01


@pytest.mark.slow
def test_the_papers_recording_is_of_a_right_arm(shared_data):
    """Checks that the model of a right arm predicts the recording better than the mirrored recording."""
    model = identify_static(
        read_recording(shared_data / "mtm_static/mtmr_2017_coupled12_may10.csv"), load_arm(PAPER.arm)
    ).model
    poses = read_recording(shared_data / "mtm_static/mtm_2015_good72.csv")
    mirrored = dataclasses.replace(poses, q=MIRROR * poses.q, tau=MIRROR * poses.measured_effort())
    right, left = (validate_static(model, recording).joints[1:4] for recording in (poses, mirrored))
    for as_it_is, as_mirrored in zip(right, left, strict=True):
        assert as_it_is.rms_error_included < 0.5 * as_mirrored.rms_error_included


def test_mirrored_file_of_a_right_arm_predicts_left_arms(shared_data):
    folder = shared_data / "gc_json"
    if not folder.is_dir():
        pytest.skip(f"needs {folder}")
    right = GravityCompensationFile.load(folder / "gc-MTMR-32336.json")
    for serial in ("MTML-22723", "MTML-34863"):
        left = GravityCompensationFile.load(folder / f"gc-{serial}.json")
        q = np.random.default_rng(0).uniform(*left.sweep, (2000, 7))
        q = q[np.abs(q[:, 1] + q[:, 2]) < 0.2]  # range of the parallelogram in the sweeps of both files
        tau = controller_torque(left, q)
        as_it_is = np.sqrt(np.mean((controller_torque(right, q) - tau) ** 2, axis=0))
        mirrored = np.sqrt(np.mean((MIRROR * controller_torque(right, MIRROR * q) - tau) ** 2, axis=0))
        assert np.all(mirrored[1:3] < 0.5 * as_it_is[1:3]) and mirrored[3] < as_it_is[3], (as_it_is, mirrored)


def stock(name):
    return IdentifiedModel.from_arm(load_arm(name))


def test_compare_gc_refuses_a_file_of_another_arm(tmp_path, capsys):
    path = tmp_path / "gc.json"
    file = compensation_from_model(stock("mtml"), CompensationOptions(tolerance=0.01))
    file.save(path, "MTML", "test")
    error = refused(capsys, "export", "compare", path, "--arm", "mtmr")
    assert error.startswith(f"dvrk-drake: error: {path}: the file belongs to MTML") and "model belongs to MTMR" in error
    # A file with a wrong arm name is compared. A warning shows that the name is wrong.
    file.save(path, "MTMR", "test")
    assert main(["export", "compare", str(path), "--arm", "mtmr"]) == 0
    (warning,) = messages(capsys.readouterr().err)
    assert "the mirror image of the model fits better" in warning
    file.save(path, "MTML", "test")
    assert main(["export", "compare", str(path), "--arm", "mtml"]) == 0
    assert not messages(capsys.readouterr().err)


def test_arm_is_taken_from_the_file_name_if_missing(tmp_path):
    file = compensation_from_model(stock("mtml"), CompensationOptions(tolerance=0.01))
    for name, arm in (("gc-MTML-12345.json", "MTML"), ("gc-mtmr.json", "MTMR"), ("gc.json", "")):
        file.save(tmp_path / name, "", "test")
        assert GravityCompensationFile.load(tmp_path / name).arm_name == arm
    with pytest.raises(ModelError, match="the file belongs to MTMR"):
        compare_compensation(GravityCompensationFile.load(tmp_path / "gc-mtmr.json"), stock("mtml"))


#: The last file is labelled MTMR, but is of a left arm: docs/identification.md, Left and right.
REAL_FILES = [("MTML-22723", "mtml"), ("MTML-34863", "mtml"), ("MTMR-32336", "mtmr"), ("MTMR-22403", "mtml")]


@pytest.mark.slow
@pytest.mark.parametrize(("serial", "side"), REAL_FILES)
def test_side_is_detected_from_the_parameters_of_a_real_file(shared_data, serial, side):
    path = shared_data / "gc_json" / f"gc-{serial}.json"
    if not path.is_file():
        pytest.skip(f"needs {path}")
    file = GravityCompensationFile.load(path)
    assert file.arm_name == serial.split("-")[0]
    for name in ("mtml", "mtmr"):
        comparison = compare_compensation(dataclasses.replace(file, arm_name=""), stock(name))
        assert comparison.other_side == (name != side)
