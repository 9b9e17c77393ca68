"""Dry friction as elements of Drake's solver: sticking, sliding and passivity."""

import numpy as np
import pytest
from simulated_effects import ARMS, STEP, Run, breakaway, middle, weightless

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, joint_row
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import ArmEffects, FrictionEffect
from dvrk_drake.models.plant import tree_selector
from dvrk_drake.systems.arm_effects.dry_friction import RELAXATION
from dvrk_drake.systems.arm_station import ArmStation

pytestmark = pytest.mark.numeric


@pytest.mark.slow
@pytest.mark.parametrize("name", ARMS)
def test_friction_sticks_below_its_limit_without_creep(name):
    arm = weightless(name)
    run = Run(arm, arm.effects.only(["friction"]))
    run.fix("effort_disturbance", arm.transmission.pull_back_effort(0.65 * breakaway(arm)))
    run.advance(15000)

    def mean_position():
        path = []
        for _ in range(100):
            run.advance(10)
            path.append(run.q)
        return np.mean(path, axis=0), np.ptp(path, axis=0).max()

    before, _ = mean_position()
    assert np.all(np.abs(before - middle(arm)) > 1e-6)  # it is loaded
    run.advance(9000)
    after, ripple = mean_position()
    # Over 10 s. The solver's tolerance causes noise of about 1e-9 rad on a loaded spring, without drift.
    assert np.abs(after - before).max() < 1e-9
    assert ripple < 5e-8


@pytest.mark.parametrize("name", ["mtml", pytest.param("psm", marks=pytest.mark.slow)])
def test_friction_slides_above_its_limit(name):
    arm = weightless(name)
    n = arm.num_joints
    for i in range(n):
        everything = sum(
            effect.coefficient * abs(joint_row(arm, effect.coordinate)[i])
            for effect in arm.effects.friction
            if effect.kind != "viscous"
        )
        run = Run(arm, arm.effects.only(["friction"]))
        run.fix("effort_disturbance", 1.3 * everything * np.eye(n)[i])
        fastest = 0.0
        for _ in range(100):
            run.advance(5)
            fastest = max(fastest, run.v[i])
        assert fastest > 0.01


def friction_of(arm, law):
    """Returns the sliding friction of each actuator by another law."""
    limits = zip(arm.joint_names, breakaway(arm), strict=True)
    return ArmEffects(friction=[FrictionEffect(f"actuator.{joint}", *law(limit)) for joint, limit in limits])


LAWS = {
    "smooth": lambda limit: ("coulomb", 0.05, limit),
    "falls with speed": lambda limit: ("presliding", 0.01, limit, 0.2),
    "forward": lambda limit: ("presliding forward", 0.01, limit),
    "backward": lambda limit: ("presliding forward", 0.01, -limit),
}


@pytest.mark.parametrize("law", ["the arm's", *LAWS])
@pytest.mark.parametrize("name", ["mtml", pytest.param("psm", marks=pytest.mark.slow)])
def test_friction_is_dissipative(name, law):
    """The work on the friction, from the efforts that Drake applies, is never negative for any motion."""
    arm = weightless(name)
    run = Run(arm, friction_of(arm, LAWS[law]) if law in LAWS else arm.effects.only(["friction"]))
    plant = run.station.plant
    plant_context = plant.GetMyContextFromRoot(run.context)
    instance = plant.GetModelInstanceByName(arm.sdf[0].split("/")[-1].removesuffix(".sdf"))
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)]
    friction = [k for k, actuator in enumerate(actuators) if actuator.name().startswith("friction")]
    columns = [actuators[k].joint().position_start() for k in friction]
    assert len(friction) >= arm.num_joints
    generator = np.random.default_rng(3)
    bound = 2.0 * breakaway(arm)
    taken, worst, most = 0.0, 0.0, 0.0
    for k in range(2000):
        if k % 40 == 0:
            run.fix("effort_disturbance", arm.transmission.pull_back_effort(generator.uniform(-bound, bound)))
        effort = plant.get_net_actuation_output_port(instance).Eval(plant_context)[friction].copy()
        before = plant.GetPositions(plant_context)[columns]
        run.advance()
        taken -= effort @ (plant.GetPositions(plant_context)[columns] - before)
        worst, most = min(worst, taken), max(most, taken)
    assert most > 1e-3
    # Solver tolerance. The springs are relaxed at the start, so they store no energy.
    assert worst > -1e-9


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_friction_equals_the_identified_element(name):
    """Effort and motion of the first presliding element obey `ActuatorEffect.column`."""
    arm = weightless(name)
    effect = next(e for e in arm.effects.friction if e.kind == "presliding")
    run = Run(arm, ArmEffects(friction=[effect]))
    plant = run.station.plant
    plant_context = plant.GetMyContextFromRoot(run.context)
    actuator = plant.GetJointActuatorByName("friction_0")
    i = actuator.joint().position_start()
    port = plant.get_net_actuation_output_port(actuator.model_instance())
    x, effort = [plant.GetPositions(plant_context)[i]], []
    for k in range(3000):
        run.fix("effort_disturbance", 1.5 * effect.coefficient * np.sin(k / 150) * np.eye(arm.num_joints)[0])
        effort.append(port.Eval(plant_context)[actuator.input_start()])
        run.advance()
        x.append(plant.GetPositions(plant_context)[i])
    x, effort = np.array(x), np.array(effort)
    law = ActuatorEffect(effect.coordinate, "presliding", effect.scale)
    expected = -effect.coefficient * law.column(x, np.zeros_like(x))[1:]
    assert np.ptp(expected) == pytest.approx(2 * effect.coefficient)
    # The damper, which is not in the law, adds the travel in its relaxation time and smooths the corners.
    rounding = effect.coefficient * np.minimum(RELAXATION * np.abs(np.diff(x)) / STEP / effect.scale, 2.0)
    assert np.all(np.abs(effort - expected) < rounding + 1e-6)
    assert np.mean(np.abs(effort - expected)) < 0.1 * effect.coefficient


@pytest.mark.parametrize("name", ARMS)
def test_friction_does_not_change_inertia(name):
    arm = load_arm(name)
    bare, rubbing = ArmStation(arm), ArmStation(arm, effects=arm.effects)
    matrices = []
    for station in (bare, rubbing):
        context = station.CreateDefaultContext()
        plant_context = station.GetMutableSubsystemContext(station.plant, context)
        tree = tree_selector(station.plant, arm)
        matrices.append(station.plant.CalcMassMatrix(plant_context)[np.ix_(tree, tree)])
    # The bodies that are added have 0.2 % of the inertia that they turn with; the roll, which carries those of the
    # fingers, is lighter than they are.
    size = np.sqrt(np.outer(np.diag(matrices[0]), np.diag(matrices[0])))
    assert np.all(np.abs(matrices[1] - matrices[0]) <= 2e-2 * size)


def roll_friction(*effects):
    """Returns these effects along the wrist roll. All other actuators are strongly damped."""
    arm = weightless("mtml")
    honey = [FrictionEffect(f"actuator.{joint}", "viscous", 0.0, 1.0) for joint in arm.joint_names[:-1]]
    along = [FrictionEffect("actuator.wrist_roll", *effect) for effect in effects]
    return Run(arm, ArmEffects(friction=[*honey, *along]))


@pytest.mark.parametrize("more", [-0.001, 0.001])
def test_one_sided_friction_holds_more_on_that_side(more):
    for direction in (-1.0, 1.0):
        limit = 0.002 + (0.001 if more * direction > 0 else 0.0)
        for share in (0.95, 1.05):
            run = roll_friction(("presliding", 0.01, 0.002), ("presliding forward", 0.01, more))
            run.fix("effort_disturbance", direction * share * limit * np.eye(7)[6])
            run.advance(300)
            assert (direction * run.v[6] > 0.05) == (share > 1)


def test_stribeck_friction_decreases_while_sliding():
    """Stribeck friction: the same effort does not move an arm at rest and keeps a sliding arm in motion."""
    at_rest, sliding, fall_speed, viscous = 0.002, 0.002, 2.0, 2e-4
    travel = 0.1
    effects = ("presliding", 0.01, sliding), ("presliding", travel, at_rest, fall_speed), ("viscous", 0.0, viscous)
    effort = 0.003
    run = roll_friction(*effects)
    run.fix("effort_disturbance", effort * np.eye(7)[6])
    run.advance(400)
    assert abs(run.v[6]) < 1e-6
    run.fix("effort_disturbance", 2.5 * effort * np.eye(7)[6])
    run.advance(60)
    run.fix("effort_disturbance", effort * np.eye(7)[6])
    run.advance(900)
    v = run.v[6]
    # In steady sliding, viscous and sliding friction and the lag of the anchor by two steps balance the effort.
    assert v == pytest.approx((effort - sliding) / (viscous + 2 * STEP * at_rest / travel), rel=0.02)
