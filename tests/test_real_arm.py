"""The effects of a real arm in its simulation: physics that must hold whatever the values in the YAML files are."""

import dataclasses
import itertools
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from dvrk_drake.analysis.scenario import load_scenario
from dvrk_drake.analysis.simulation import simulate
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, joint_row
from dvrk_drake.errors import ArmError, ScenarioError, StationError
from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.effects_schema import (
    EFFECT_NAMES,
    ArmEffects,
    DelayEffect,
    DriveEffect,
    EffortEffect,
    EncoderEffect,
)
from dvrk_drake.models.plant import tree_selector
from dvrk_drake.models.sdf_model import MODELS_FOLDER
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.real_arm.dry_friction import RELAXATION

ARMS = ["mtml", "mtmr", "psm"]
STEP = 1e-3


def weightless(name):
    return load_arm(name).with_gravity([0.0, 0.0, 0.0])


def middle(arm):
    return 0.5 * (arm.position_lower + arm.position_upper)


class Run:
    """A station at rest at q that is advanced step by step."""

    def __init__(self, arm, effects, q=None, seed=0):
        self.arm, self.name = arm, arm.name.lower()
        self.station = ArmStation(arm, effects=effects, seed=seed)
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        self.station.set_positions(self.context, middle(arm) if q is None else q)
        self.simulator.Initialize()
        self.tick = 0

    def fix(self, port, value):
        self.station.GetInputPort(f"{self.name}.{port}").FixValue(self.context, value)

    def get(self, port):
        return self.station.GetOutputPort(f"{self.name}.{port}").Eval(self.context).copy()

    def advance(self, ticks=1):
        self.tick += ticks
        self.simulator.AdvanceTo(self.tick * STEP)

    @property
    def q(self):
        return self.station.get_positions(self.context)

    @property
    def v(self):
        return self.get("state_true")[self.arm.num_joints :]


def breakaway(arm):
    """(n,) effort on the actuators up to which friction along the actuators alone holds."""
    total = dict.fromkeys(arm.joint_names, 0.0)
    for effect in arm.effects.friction:
        owner, _, actuator = effect.coordinate.partition(".")
        if owner == "actuator" and effect.kind == "presliding":
            total[actuator] += effect.coefficient
    return np.array(list(total.values()))


@pytest.mark.parametrize("name", ARMS)
def test_friction_sticks_below_its_limit_and_does_not_creep(name):
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
    # Over 10 s. The solver's tolerance lets a loaded spring tremble by some 1e-9 rad, without a direction.
    assert np.abs(after - before).max() < 1e-9
    assert ripple < 5e-8


@pytest.mark.parametrize("name", ARMS)
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


def smooth_sign(arm):
    """Friction as "coulomb" effects alone: as much as what slides along the actuators."""
    limits = zip(arm.joint_names, breakaway(arm), strict=True)
    return ArmEffects(friction=[DriveEffect(f"actuator.{joint}", "coulomb", 0.05, limit) for joint, limit in limits])


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("name", ARMS)
def test_friction_only_takes_energy(name, smooth):
    """Work on the friction, by what Drake says that it applies: never less than nothing, whatever the motion."""
    arm = weightless(name)
    run = Run(arm, smooth_sign(arm) if smooth else arm.effects.only(["friction"]))
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
    # The solver's tolerance; springs are slack at the start, so nothing is there to be given back.
    assert worst > -1e-9


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_friction_is_the_element_that_is_identified(name):
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
    # Its damper, which the law has not, is worth what it travels in that time; it rounds the corners.
    rounding = effect.coefficient * np.minimum(RELAXATION * np.abs(np.diff(x)) / STEP / effect.scale, 2.0)
    assert np.all(np.abs(effort - expected) < rounding + 1e-6)
    assert np.mean(np.abs(effort - expected)) < 0.1 * effect.coefficient


@pytest.mark.parametrize("name", ARMS)
def test_friction_leaves_the_inertia_as_it_is(name):
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


@pytest.mark.parametrize("name", ARMS)
def test_joints_of_drive_coordinates_follow_the_arm(name):
    arm = load_arm(name)
    run = Run(arm, arm.effects.only(["friction", "stops"]))
    plant = run.station.plant
    plant_context = plant.GetMyContextFromRoot(run.context)
    added = run.station._plant_effects.drive._added
    assert len(added) == {"mtml": 2, "mtmr": 2, "psm": 4}[name]
    moved = run.q
    for _ in range(100):
        run.advance(10)
        for joint, row in added:
            # What near-rigid ties of light bodies give by under the friction's load.
            assert plant.GetPositions(plant_context)[joint.position_start()] == pytest.approx(row @ run.q, abs=3e-4)
    assert np.abs(run.q - moved).max() > 0.1  # the arm fell


@pytest.mark.parametrize("which", [0, 1])
def test_the_coupled_stop_stops(which):
    arm = weightless("mtml")
    limit = arm.coupled_limits[0]
    push = (-3.0, 3.0)[which] * np.array([limit.coefficients.get(j, 0.0) for j in arm.joint_names]) / 2
    q = middle(arm)
    q[1:3] = 0.2, 0.0
    ends = []
    for effects in (ArmEffects(), arm.effects.only(["stops"])):
        run = Run(arm, effects, q)
        run.fix("effort_disturbance", push)
        sums = []
        for _ in range(600):
            run.advance()
            sums.append(run.q[1] + run.q[2])
        ends.append(np.array(sums))
    free, stopped = ends
    outside = {0: lambda s: limit.lower - s.min(), 1: lambda s: s.max() - limit.upper}[which]
    assert outside(free) > 0.05
    assert outside(stopped) < 2e-3
    assert np.abs(np.diff(stopped[-50:])).max() < 1e-5  # it rests there


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_the_coupled_stop_gives_no_energy(direction):
    arm = weightless("mtml")
    energy = {}
    for parts in ([], ["stops"]):
        run = Run(arm, arm.effects.only(parts), [0.0, 0.2, 0.0, *middle(arm)[3:]])
        plant = run.station.plant
        plant_context = plant.GetMyContextFromRoot(run.context)
        run.fix("effort_disturbance", direction * np.array([0.0, 1.5, 1.5, 0.0, 0.0, 0.0, 0.0]))
        run.advance(120)
        run.fix("effort_disturbance", np.zeros(7))
        path = []
        for _ in range(500):
            run.advance()
            path.append(plant.CalcKineticEnergy(plant_context))
        energy[len(parts)] = np.array(path)
    # Flying free, steps of 1 ms change it by 2e-4; the stop takes it, and never gives any.
    assert np.all(energy[1] <= energy[1][0] * (1 + 1e-3))
    assert energy[1][-1] < 0.8 * energy[1][0] < energy[0][100]


@pytest.mark.parametrize("ticks", [0, 1, 2, 5])
def test_measurement_is_late_by_exactly_its_ticks(ticks):
    arm = load_arm("mtml")
    run = Run(arm, ArmEffects(delay=DelayEffect(measurement=ticks)))
    true, measured = [run.get("state_true")], [run.get("state_estimated")]
    for _ in range(40):
        run.advance()
        true.append(run.get("state_true"))
        measured.append(run.get("state_estimated"))
    for k in range(41):
        np.testing.assert_array_equal(measured[k], true[max(k - ticks, 0)])
    assert np.ptp(true, axis=0).max() > 1e-4


@pytest.mark.parametrize("ticks", [1, 2, 5])
def test_command_is_late_by_exactly_its_ticks(ticks):
    arm = weightless("psm")
    q = {}
    for n in (0, ticks):
        run = Run(arm, ArmEffects(delay=DelayEffect(command=n)))
        run.fix("effort_commanded", 0.5 * arm.effort_limits)
        path = [run.q]
        for _ in range(30):
            run.advance()
            path.append(run.q)
        q[n] = np.array(path)
    np.testing.assert_allclose(q[ticks][ticks:], q[0][: 31 - ticks], atol=1e-13)
    assert np.abs(q[0] - q[0][0]).max() > 1e-4


@pytest.mark.parametrize("name", ARMS)
def test_positions_are_counts_of_the_encoders(name):
    arm = load_arm(name)
    run = Run(arm, arm.effects.only(["encoder"]))
    n = arm.num_joints
    resolution = np.array([arm.effects.encoder.resolution[joint] for joint in arm.joint_names])
    for _ in range(300):
        run.advance()
        counts = arm.transmission.position(run.get("position_measured")) / resolution
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
        error = arm.transmission.position(run.get("position_measured") - run.q)
        assert np.all(np.abs(error) <= 0.5 * resolution * (1 + 1e-9))
        np.testing.assert_array_equal(run.get("state_estimated")[:n], run.get("position_measured"))
        np.testing.assert_array_equal(run.get("state_estimated")[n:], run.get("velocity_estimated"))
    assert np.abs(run.v).max() > 0.1


def test_velocity_is_what_the_low_pass_makes_of_the_counts():
    arm = load_arm("mtml")
    h, cut_off = STEP, 30.0
    run = Run(arm, ArmEffects(encoder=EncoderEffect(arm.effects.encoder.resolution, cut_off)))
    a = np.exp(-2 * np.pi * cut_off * h)
    q, v = run.get("position_measured"), np.zeros(7)
    for _ in range(300):
        run.advance()
        new = run.get("position_measured")
        v = a * v + (1 - a) * (new - q) / h
        q = new
        np.testing.assert_allclose(run.get("velocity_estimated"), v, atol=1e-9)
    assert np.abs(v[:3] - run.v[:3]).max() < 0.3 * np.abs(run.v[:3]).max()


def test_an_arm_at_rest_measures_no_velocity_from_the_start():
    arm = weightless("mtml")
    for delay in (None, DelayEffect(measurement=3)):
        run = Run(arm, ArmEffects(encoder=arm.effects.encoder, delay=delay), q=np.full(7, 0.2))
        for _ in range(10):
            assert np.abs(run.get("position_measured") - 0.2).max() < 6e-3
            np.testing.assert_array_equal(run.get("velocity_estimated"), 0.0)
            run.advance()


@pytest.mark.parametrize("name", ARMS)
def test_motors_saturate_each_at_its_own_limit(name):
    arm = load_arm(name)
    limit = np.array([arm.effects.saturation[joint] for joint in arm.joint_names])
    run = Run(arm, arm.effects.only(["saturation"]))
    inverse = np.linalg.inv(arm.transmission.matrix)
    for signs in itertools.islice(itertools.product([-1.0, 1.0], repeat=arm.num_joints), 0, 128, 5):
        run.fix("effort_commanded", 10 * np.array(signs) * arm.effort_limits)
        assert np.all(np.abs(inverse.T @ run.get("effort_measured")) <= limit * (1 + 1e-12))
    run.fix("effort_commanded", 0.1 * arm.transmission.pull_back_effort(limit))
    np.testing.assert_allclose(run.get("effort_measured"), 0.1 * arm.transmission.pull_back_effort(limit))


def test_efforts_have_steps_and_noise():
    arm = load_arm("mtml")
    effort = arm.effects.effort
    inverse = np.linalg.inv(arm.transmission.matrix)
    steps = np.array([effort.measured_resolution[joint] for joint in arm.joint_names])
    deviation = np.array([effort.noise[joint] for joint in arm.joint_names])
    run = Run(arm, arm.effects.only(["effort"]))
    command = arm.transmission.pull_back_effort(10.3 * steps)
    run.fix("effort_commanded", command)
    seen = []
    for _ in range(1000):
        seen.append(inverse.T @ run.get("effort_measured"))
        run.advance()
    counts = np.array(seen) / steps
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    # 1000 samples: standard errors are 3 % of a deviation and 2 % of its size; five of them.
    assert np.all(np.abs(counts.mean(axis=0) - 10.0) < 5 * 0.033 * deviation / steps)
    np.testing.assert_allclose(counts.std(axis=0), np.hypot(deviation / steps, 12**-0.5), rtol=0.12)
    quiet = Run(arm, ArmEffects(effort=EffortEffect(command_resolution=effort.command_resolution)))
    quiet.fix("effort_commanded", command)
    np.testing.assert_allclose(inverse.T @ quiet.get("effort_measured"), 10 * steps, rtol=1e-9)


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_cables_and_springs_give_back_what_they_take(name):
    """Round a closed path of the joints their work is nothing."""
    arm = weightless(name)
    run = Run(arm, arm.effects.only(["cables", "springs"]))
    torque = run.station.GetSubsystemByName("position_torque")
    context = torque.CreateDefaultContext()
    phase = np.linspace(0, 2 * np.pi, 4001)
    ranges = 0.4 * (arm.position_upper - arm.position_lower)
    q = middle(arm) + ranges * np.sin(np.outer(phase, np.arange(1, arm.num_joints + 1)) + 0.3)
    forces = []
    for pose in q:
        torque.get_input_port().FixValue(context, np.concatenate([pose, np.zeros(arm.num_joints)]))
        forces.append(torque.get_output_port().Eval(context).copy())
    f = np.array(forces)
    work = np.sum(0.5 * (f[1:] + f[:-1]) * np.diff(q, axis=0), axis=1)
    assert abs(work.sum()) < 1e-4 * np.abs(work).sum()
    assert np.abs(f).max() > 1e-3


def scenario(arm, *settings):
    parts = ["duration=0.3", "real_arm=[all]", "sample_period=0.001"]
    return load_scenario(arm, [*parts, *settings])


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_a_seed_gives_the_same_bits(name):
    one, two, other = (simulate(scenario(name, f"seed={seed}")).recording for seed in (5, 5, 6))
    for field in ("q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(one, field), getattr(two, field))
    assert np.any(one.tau != other.tau)


@pytest.mark.parametrize("name", ARMS)
def test_a_controller_that_knows_only_gravity_holds_the_real_arm(name):
    arm = load_arm(name)
    path = simulate(load_scenario(name, ["duration=2", "real_arm=[all]"])).recording.q
    # Cables and springs, which it does not know, pull it by their torque over its gain until its integral has grown.
    assert np.abs(path - path[0]).max() < 0.1
    rest = [part for part in EFFECT_NAMES if part not in ("cables", "springs")]
    recording = simulate(load_scenario(name, ["duration=2", f"real_arm={rest}"])).recording
    resolution = np.array([arm.effects.encoder.resolution[joint] for joint in arm.joint_names])
    counts = arm.transmission.position(recording.q - recording.q[0]) / resolution
    # Presliding alone is some counts of the fine encoders: 3 mrad under its load.
    assert np.all(np.abs(counts * resolution) < np.maximum(2 * resolution, 0.003))
    assert np.all(np.abs(recording.tau) <= 1.1 * arm.effort_limits)


def test_every_part_can_be_switched():
    arm = load_arm("mtml")
    for name in EFFECT_NAMES:
        assert getattr(arm.effects, name)
        alone, rest = arm.effects.only([name]), arm.effects.without(name)
        for other in EFFECT_NAMES:
            kept, dropped = (alone, rest) if other == name else (rest, alone)
            assert getattr(kept, other) == getattr(arm.effects, other)
            assert getattr(dropped, other) == getattr(ArmEffects(), other)
    with pytest.raises(ArmError, match="unknown effect frction; allowed: all, friction"):
        arm.effects.only(["frction"])


def test_a_typo_is_an_error(tmp_path):
    with pytest.raises(ScenarioError, match="real_arm: unknown effect frction"):
        load_scenario("mtml", ["real_arm=[frction]"])
    text = (MODELS_FOLDER / "mechanisms" / "mtm.yaml").read_text()
    arm_text = (MODELS_FOLDER / "arms" / "mtml.yaml").read_text().replace("mechanism: mtm", "mechanism: m.yaml")
    (tmp_path / "a.yaml").write_text(arm_text)
    for old, new, message in (
        ("stops: true", "stopps: true", "stopps"),
        ("outer_yaw: 1.861", "outer_jaw: 1.861", "effects.saturation: unknown actuator outer_jaw"),
        ("outer_yaw: 1.861", "outer_yaw: -1.861", "effects.saturation.outer_yaw = -1.861 must be"),
        ("measurement: 1", "measurement: -1", "effects.delay.measurement = -1"),
        ("presliding, scale: 0.015", "stiction, scale: 0.015", 'effects.friction: kind "stiction"; allowed'),
        ("scale: 0.015", "scale: 0.0", "has scale 0"),
        ("coefficient: 0.0019", "coefficient: -0.0019", "has coefficient -0.0019"),
    ):
        assert old in text
        (tmp_path / "m.yaml").write_text(text.replace(old, new))
        load_arm.__globals__["_load_arm"].cache_clear()
        with pytest.raises(ArmError, match=message):
            load_arm(str(tmp_path / "a.yaml"))


def test_a_coordinate_that_is_none_is_refused():
    arm = load_arm("mtml")
    nowhere = ArmEffects(friction=[DriveEffect("actuator.elbow", "presliding", 0.01, 0.1)])
    with pytest.raises(StationError, match=r'coordinate is "actuator\.elbow"; allowed: actuator\.outer_yaw'):
        ArmStation(arm, effects=nowhere)
    with pytest.raises(StationError, match="effects are of a simulation"):
        ArmStation(arm, hardware=True, effects=arm.effects)


def test_no_sdf_has_friction_tags():
    """Drake drops them without a word: friction is stated in the YAML files."""
    for path in (MODELS_FOLDER / "sdf").glob("*.sdf"):
        assert not list(ElementTree.parse(path).iter("friction")), path
    assert dataclasses.is_dataclass(ArmEffects)
