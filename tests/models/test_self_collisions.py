"""Within the position limits, no links of an arm collide. The SDF files therefore exclude all pairs of links."""

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

import dvrk_drake as dvrk
from dvrk_drake.models import plant as plants
from dvrk_drake.models.plant import add_arm, set_arm_positions

pytestmark = pytest.mark.drake_api

#: Pairs of links that touch in a real arm. The coupler of an MTM is pinned to forearm and platform. The retracted
#: instrument of a PSM is within the end of the carriage.
TOUCHING = {
    "mtml": {"coupler_link forearm_link", "coupler_link platform_link"},
    "mtmr": {"coupler_link forearm_link", "coupler_link platform_link"},
    "psm": {
        "end_link top_bar_link",
        *(f"end_link {link}_link" for link in ("roll", "wrist_pitch", "wrist_yaw", "finger_1", "finger_2")),
        "finger_1_link wrist_pitch_link",
        "finger_2_link wrist_pitch_link",
        "finger_2_link wrist_yaw_link",
    },
}


@pytest.mark.parametrize("name", TOUCHING)
def test_no_other_links_collide(name, monkeypatch):
    compose = plants.compose_sdf

    def without_filters(*arguments):
        model = compose(*arguments)
        filters = [(parent, child) for parent in model.iter() for child in parent if child.tag.endswith("filter_group")]
        assert filters
        for parent, child in filters:
            parent.remove(child)
        return model

    monkeypatch.setattr(plants, "compose_sdf", without_filters)
    arm, builder = dvrk.load_arm(name), DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
    add_arm(plant, arm)
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    inspector = scene_graph.model_inspector()
    found = set()
    for q in arm.sample_poses(400, np.random.default_rng(0)):
        set_arm_positions(plant, plant.GetMyMutableContextFromRoot(context), arm, q)
        query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
        for pair in query.ComputePointPairPenetration():
            bodies = [plant.GetBodyFromFrameId(inspector.GetFrameId(i)).name() for i in (pair.id_A, pair.id_B)]
            found.add(" ".join(sorted(bodies)))
    assert found <= TOUCHING[name]
    assert found  # the shapes are checked
