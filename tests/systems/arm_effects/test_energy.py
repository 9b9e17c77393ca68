"""Passivity of a real arm with all effects and a hand."""

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from simulated_effects import STEP, middle, weightless

from dvrk_drake.dynamics.actuator_effects import joint_row
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.hand import Grip, Hand

pytestmark = pytest.mark.numeric

HANDLES = {"mtml": "dh_7", "psm": "dh_6"}
GRIPS = {
    "as a person": Grip(),
    "undamped": Grip(damping=1e-6, rotational_damping=1e-6),
    # Their limits are active until they have nearly arrived.
    "ten times as firm": Grip(6e3, 250.0, 20.0, 0.3),
    "a thousand times as firm": Grip(6e5, 2.5e4, 2e3, 30.0),
}
#: [J], of some 3 J.
ROUNDING = 1e-9


class HeldArm:
    """Unpowered, weightless arm with effects. A hand pulls its handle towards `wanted`."""

    def __init__(self, name, effects, grip):
        self.arm, self.grip, self.effects = weightless(name), grip, effects
        builder = DiagramBuilder()
        self.station = builder.AddSystem(ArmStation(self.arm, effects=effects))
        hand = builder.AddSystem(Hand(self.arm, HANDLES[name], grip=grip))
        builder.Connect(self.station.GetOutputPort(f"{name}.state_true"), hand.GetInputPort("state_estimated"))
        pull = self.station.GetInputPort(f"{name}.effort_disturbance")
        builder.Connect(hand.GetOutputPort("effort_disturbance"), pull)
        builder.ExportInput(hand.GetInputPort("X_BG_desired"), "wanted")
        diagram = builder.Build()
        self.simulator = Simulator(diagram)
        root = self.simulator.get_mutable_context()
        self.context = self.station.GetMyMutableContextFromRoot(root)
        self.station.SetPositions(self.context, middle(self.arm))
        self.frame = ArmFrame(self.arm, HANDLES[name])
        self.start = self.wanted = self.X_BG
        self.port = diagram.GetInputPort("wanted").FixValue(root, AbstractValue.Make(self.wanted))
        self.effort = hand.GetOutputPort("effort_disturbance"), hand.GetMyContextFromRoot(root)
        self.simulator.Initialize()
        self.tick = 0

    @property
    def q(self):
        return self.station.GetPositions(self.context)

    @property
    def X_BG(self):
        return self.frame.pose(self.q)

    def want(self, rpy, p):
        """Returns the pose of the handle relative to its initial pose."""
        R = RotationMatrix(RollPitchYaw(rpy)) @ self.start.rotation()
        self.wanted = RigidTransform(R, self.start.translation() + p)
        self.port.GetMutableData().set_value(self.wanted)

    def advance(self):
        """Advances one step and returns the work of the hand on the arm."""
        port, context = self.effort
        tau, q = port.Eval(context).copy(), self.q
        self.tick += 1
        self.simulator.AdvanceTo(self.tick * STEP)
        return tau @ (self.q - q)

    def in_hand(self):
        """Returns the energy of the hand's springs: quadratic up to their limits, linear beyond."""
        rotation = (self.wanted.rotation() @ self.X_BG.rotation().inverse()).ToAngleAxis().angle()
        way = np.linalg.norm(self.wanted.translation() - self.X_BG.translation())
        springs = (
            (self.grip.rotational_stiffness, rotation, self.grip.max_torque),
            (self.grip.stiffness, way, self.grip.max_force),
        )
        return sum(0.5 * k * x**2 if k * x <= most else most * x - 0.5 * most**2 / k for k, x, most in springs)

    def in_arm(self):
        """Returns the sum of the kinetic energy and the elastic energy of cables, springs and presliding friction."""
        plant = self.station.plant
        context = plant.GetMyContextFromRoot(self.simulator.get_context())
        energy = plant.CalcKineticEnergy(context)
        for law in [*self.effects.cables, *self.effects.springs]:
            x, s = joint_row(self.arm, law.coordinate) @ self.q, law.scale
            most = min(abs(x), s)
            potential = {
                "spring": abs(x) * most - 0.5 * most**2,
                "cable sine": -np.cos(s * x) / s,
                "cable cosine": np.sin(s * x) / s,
            }
            energy += law.coefficient * potential[law.kind]
        (instance,) = {plant.get_joint_actuator(i).model_instance() for i in plant.GetJointActuatorIndices()}
        for k, i in enumerate(plant.GetJointActuatorIndices(instance)):
            actuator = plant.get_joint_actuator(i)
            if actuator.name().startswith("friction"):
                anchors = plant.get_desired_state_input_port(instance).Eval(context)
                p = actuator.get_controller_gains().p
                force = p * (anchors[k] - actuator.joint().GetOnePosition(context))
                energy += 0.5 * min(abs(force), actuator.effort_limit()) ** 2 / p
        return energy


@pytest.mark.parametrize(
    ("name", "grip"),
    [
        ("mtml", "as a person"),
        ("mtml", "undamped"),
        ("mtml", "a thousand times as firm"),
        pytest.param("psm", "as a person", marks=pytest.mark.slow),
        pytest.param("psm", "ten times as firm", marks=pytest.mark.slow),
    ],
)
def test_arm_with_fixed_hand_never_gains_energy(name, grip):
    held = HeldArm(name, weightless(name).effects, GRIPS[grip])
    held.want([0.3, -0.2, 0.4], [0.1, -0.08, 0.1])
    path = []
    for _ in range(800):
        path.append((held.in_hand() + held.in_arm(), held.in_arm()))
        held.advance()
    total, arm = np.array(path).T
    assert np.diff(total).max() < ROUNDING
    # The energy was considerable: the arm moved fast, and friction and damper dissipated its energy.
    assert arm.max() > arm[0] + 0.2
    assert total[-1] < total[0] - 0.5


@pytest.mark.parametrize("grip", ["as a person", pytest.param("a thousand times as firm", marks=pytest.mark.slow)])
def test_hand_adds_no_energy_beyond_its_work(grip):
    """The desired pose jumps between steps, which adds energy to the springs. In the step they work on the arm."""
    held = HeldArm("mtml", weightless("mtml").effects, GRIPS[grip])
    generator = np.random.default_rng(1)
    rates, phases = generator.uniform(2.0, 20.0, 6), generator.uniform(0.0, 6.0, 6)
    given, taken, worst = 0.0, 0.0, np.inf
    for k in range(1500):
        before = held.in_hand()
        way = np.sin(rates * k * STEP + phases) - np.sin(phases)
        held.want(0.4 * way[:3], 0.05 * way[3:])
        given += held.in_hand() - before
        taken += held.advance()
        worst = min(worst, given - held.in_hand() - taken)
    # At first it does not measure what else pushes the arm: by some micrometres, until it pushes back.
    assert worst > -0.5 * held.grip.stiffness * 5e-6**2
    assert taken > 0.3
