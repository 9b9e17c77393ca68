"""Fixed objects around an arm: another arm at known distances, and refused directives."""

import numpy as np
import pytest
from command_output import assert_refused, refused
from models_in_directives import OTHER_ARM
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

import dvrk_drake as dvrk
from dvrk_drake.analysis.excitation.motion_limits import CollisionDetector, first_collision, motion_violations
from dvrk_drake.analysis.excitation.periodic_motion import PeriodicMotion
from dvrk_drake.analysis.excitation.pose_file import load_poses, pose_environment, save_poses
from dvrk_drake.errors import ExcitationError
from dvrk_drake.models import plant as plants
from dvrk_drake.models.plant import add_arm, set_arm_positions

pytestmark = pytest.mark.drake_api


ARM = dvrk.load_arm("mtml")


def test_collision_with_another_arm_ends_at_a_distance():
    """Two equal arms at the same pose have a distance of 0 at no offset, and no collision beyond their width."""
    q = np.zeros((1, ARM.num_joints))
    assert first_collision(ARM, q) is None
    found = [first_collision(ARM, q, dvrk.Environment(directives=OTHER_ARM.format(x=x))) for x in (0.02, 0.1, 0.5, 2.0)]
    assert found[0] and found[0][1].startswith("collision of ") and " and other::" in found[0][1]
    assert found[-1] is None
    touches = [entry is not None for entry in found]
    assert touches == sorted(touches, reverse=True)


def test_objects_may_touch_each_other_and_the_base():
    """The base link of the other arm is at the same position as the own base."""
    detector = CollisionDetector(ARM, dvrk.Environment(table=0.0, directives=OTHER_ARM.format(x=0.0)))
    for pose in ARM.sample_poses(20, np.random.default_rng(0)):
        assert "collision of base_link and" not in detector.collision(pose)


@pytest.mark.slow
def test_motion_keeps_its_distance_from_another_arm(tmp_path):
    environment = dvrk.Environment(directives=OTHER_ARM.format(x=-0.27))
    limits = dvrk.MotionLimits(traverse_time=2.0, environment=environment)
    options = {"duration": 4.0, "period": 4.0, "harmonics": 2, "starts": 1}
    free = dvrk.design_excitation(ARM, **options).motion
    assert any(" and other::" in line for line in motion_violations(free, ARM, limits))
    motion = dvrk.design_excitation(ARM, limits=limits, **options).motion
    assert motion_violations(motion, ARM, limits) == []
    motion.save(tmp_path / "motion.yaml")
    assert PeriodicMotion.load(tmp_path / "motion.yaml", ARM).environment == environment


BOX = "<box><size>0.1 0.1 0.1</size></box>"


def object_in(folder, shape=BOX, p_WL=(2.0, 0.0, 0.0)):
    """Writes an SDF with one shape and returns directives that weld it to the world."""
    collision = f"<collision name='c'><geometry>{shape}</geometry></collision>" if shape else ""
    text = f"<sdf version='1.9'><model name='o'><link name='l'>{collision}</link></model></sdf>"
    (folder / "object.sdf").write_text(text)
    weld = f"- add_weld: {{parent: world, child: o::l, X_PC: {{translation: {[float(x) for x in p_WL]}}}}}\n"
    return f"directives:\n- add_model: {{name: o, file: 'file://{folder}/object.sdf'}}\n{weld}"


@pytest.mark.slow
def test_poses_keep_their_distance_from_another_arm(tmp_path):
    environment = dvrk.Environment(directives=OTHER_ARM.format(x=-0.27))
    design = dvrk.design_poses(ARM, 8, limits=dvrk.MotionLimits(margin=0.1, environment=environment))
    assert first_collision(ARM, design.poses, environment) is None
    path = tmp_path / "poses.yaml"
    design.save(path)
    assert pose_environment(path) == environment
    save_poses(load_poses(path, ARM)[:4], ARM, path)  # as collect teach, which adds poses
    assert pose_environment(path) == environment


def test_shapes_collide_where_the_box_is(tmp_path):
    """A box of 0.1 m around the tip."""
    arm = dvrk.load_arm("psm")
    q = arm.sample_poses(1, np.random.default_rng(0))
    p = CollisionDetector(arm).tip(q[0])
    inside = object_in(tmp_path, p_WL=p)
    assert " and o::l" in first_collision(arm, q, dvrk.Environment(directives=inside))[1]
    assert first_collision(arm, q, dvrk.Environment(directives=object_in(tmp_path))) is None
    assert first_collision(arm, q, dvrk.Environment(-2.0, object_in(tmp_path))) is None


@pytest.mark.parametrize(
    ("directives", "message"),
    [
        ("nonsense", "the file must have the key directives"),
        ("directives: 3", "the file must have the key directives"),
        ("directives:\n- add_directives: {file: 'file:///a.dmd.yaml'}\n", "allowed: add_model, add_weld, add_frame"),
        ("directives:\n- add_model: {name: a, file: a.sdf}\n", 'file is "a.sdf"; allowed: package://dvrk_drake/'),
        ("directives:\n- add_model: {name: a, file: package://none/a.sdf}\n", 'unknown package "none"; allowed'),
        ("directives:\n- add_model: {name: a, file: 'file:///none/a.sdf'}\n", "Drake cannot load the directives"),
        ("directives:\n- add_weld: {parent: world, child: a::b, X_PC: {rotation: !Uniform {}}}\n", "invalid YAML"),
        (OTHER_ARM.format(x=".nan"), "directive 2: X_PC.translation[0] is nan; allowed: a finite number"),
        (OTHER_ARM.format(x=0).split("- add_weld")[0], "is not welded to the world; use add_weld"),
        (
            OTHER_ARM.format(x=0).replace("  file", "  default_joint_positions: {outer_yaw: [9]}\n    file"),
            "outer_yaw is",
        ),
        ("directives:\n- add_frame: {name: f, X_PF: {base_frame: world}}\n", "has a collision shape"),
        (OTHER_ARM.format(x=1).replace("name: other", "name: mtml").replace("other::", "mtml::"), "named 'mtml'"),
        (OTHER_ARM.format(x=1).replace("other::base_link", "base_link"), "A Frame named 'base_link' appears in"),
        ("PLANE", "a plane is not supported; use a box, or --table"),
        ("NO SHAPE", "has a collision shape"),
        ("  \n", "the file is empty"),
    ],
)
def test_wrong_directives_are_refused(directives, message, tmp_path, capsys):
    if directives in ("PLANE", "NO SHAPE"):
        directives = object_in(tmp_path, "<plane><normal>0 0 1</normal></plane>" if directives == "PLANE" else "")
    path, output = tmp_path / "lab.dmd.yaml", tmp_path / "out"
    path.write_text(directives)
    for command in (["excite"], ["excite", "--static", "8"], ["calibrate", "--yes"]):
        line = refused(capsys, *command, "--arm", "mtml", "--environment", path, "--output", output)
        assert message in line and len(line) < 500
        assert not output.exists()


def test_wrong_arguments_are_refused():
    assert_refused(ExcitationError, r"must be the text of a file; Environment\.load", dvrk.Environment, directives=3)
    assert_refused(ExcitationError, "environment must be an Environment", dvrk.MotionLimits, environment=-0.2)
    assert_refused(ExcitationError, "table is nan", dvrk.Environment, table=float("nan"))


# Within the position limits, no links of an arm collide. The SDF files therefore exclude all pairs of links.


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
