"""Finds the collision shapes that a URDF omits, because programs other than Drake ignore collision filters."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import Counter
from functools import cache

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import base_body, package_map, set_arm_positions
from dvrk_drake.models.sdf_elements import DRAKE
from dvrk_drake.models.sdf_model import compose_sdf

#: Number of random poses at which collision shapes are tested.
_POSES = 500
#: Enlargement of each shape on all sides [m], because shapes are closer at other poses than at the random poses.
_MARGIN = 2.5e-3


@cache
def touching_shapes(arm: Arm) -> tuple[tuple[str, str], ...]:
    """Returns (link, collision shape) of the shapes that a URDF omits, so that no shapes of different links touch.

    The SDF excludes contact between the links of an arm with collision filters. Other programs ignore these filters.
    They exclude contact only between a moving link and the link that carries it. Pairs of enlarged shapes that touch at
    random poses within the limits of the arm are removed by omitting the shape with the most contacts first.
    """
    root = compose_sdf(arm.sdf)
    (model,) = root.findall("model")
    for group in model.findall(f"{DRAKE}collision_filter_group"):
        model.remove(group)
    for link in model.findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for element in link.iterfind("collision/geometry/*/*"):
            if element.tag in ("radius", "length", "size"):
                sides = 1 if element.tag == "radius" else 2
                sizes = (float(x) + sides * _MARGIN for x in (element.text or "").split())
                element.text = " ".join(map(str, sizes))
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
    plant.set_adjacent_bodies_collision_filters(False)
    parser = Parser(plant)
    parser.package_map().AddMap(package_map())
    parser.AddModelsFromString(ElementTree.tostring(root, encoding="unicode"), "sdf")
    plant.WeldFrames(plant.world_frame(), base_body(plant).body_frame())
    plant.Finalize()
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    carried = {frozenset((j.parent_body(), j.child_body())) for j in joints if not plant.IsAnchored(j.parent_body())}
    diagram, inspector = builder.Build(), scene_graph.model_inspector()
    context = diagram.CreateDefaultContext()
    shapes = {
        geometry: (plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)), inspector.GetName(geometry))
        for geometry in inspector.GetAllGeometryIds()
    }
    touching: set[frozenset] = set()
    for q in [
        np.clip(0.0, arm.position_lower, arm.position_upper),
        *arm.sample_poses(_POSES, np.random.default_rng(0)),
    ]:
        set_arm_positions(plant, plant.GetMyMutableContextFromRoot(context), arm, q)
        query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
        pairs = [(p.id_A, p.id_B) for p in query.ComputePointPairPenetration()]
        touching |= {
            frozenset(pair)
            for pair in pairs
            if frozenset(bodies := [shapes[geometry][0] for geometry in pair]) not in carried and bodies[0] != bodies[1]
        }
    omitted = []
    while touching:
        counts = Counter(geometry for pair in touching for geometry in pair)
        worst = max(counts, key=lambda geometry: (counts[geometry], shapes[geometry][1]))
        touching = {pair for pair in touching if worst not in pair}
        body, name = shapes[worst]
        omitted.append((body.name(), name.removeprefix(f"{model.get('name')}::")))
    return tuple(omitted)
