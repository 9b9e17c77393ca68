"""Compares models read by the parser of Drake with the arms of `load_arm`."""

import re

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, DiscreteContactApproximation, MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from repository import ROOT

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.models.plant import holding_torque, make_arm_plant, package_map, set_arm_positions

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
