"""Force feedback: passive for any motion and force, limited, off after a loss, stable at a stiff wall with delay."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator

from dvrk_drake.dynamics.kinematics import Contact
from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.force_feedback import MAX_SHARE, START_ENERGY, ForceFeedback
from dvrk_drake.systems.teleoperated_arms import TeleoperatedArms, Wall, exact_model

pytestmark = pytest.mark.drake_api

MASTER, FOLLOWER = load_arm("mtml"), load_arm("psm")
Q = np.array([0.0, 0.25, -0.1, 0.0, 1.2, 0.0, 0.0])
Q_FOLLOWER = np.array([0.0, 0.0, 0.13, 0.0, 0.0, 0.0, 0.5])
PERIOD = 1e-3


class Bench:
    """ForceFeedback whose efforts act from the next update on, as in a Diagram. Counts the energy of the operator."""

    def __init__(self, **arguments):
        self.system = ForceFeedback(MASTER, **arguments)
        self.context = self.system.CreateDefaultContext()
        self.inputs = {"force": [0, 0, 0], "measurable": [1, 1, 1], "fault": 0, "engaged": 0, "following": 0}
        self.q, self.acting, self.energy = Q.copy(), np.zeros(7), 0.0
        self.step()

    def step(self, v=0.0, **inputs):
        """Moves the master with the velocity v (7,) under the acting effort, then updates. Returns the new effort."""
        v = np.broadcast_to(v, 7)
        self.energy -= PERIOD * self.acting @ v
        self.acting = self.output("effort")
        self.q = self.q + PERIOD * v
        self.inputs |= {"master_state": np.concatenate([self.q, v]), **inputs}
        for name, value in self.inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, np.atleast_1d(np.asarray(value, float)))
        self.system.ExecuteForcedEvents(self.context)
        return self.output("effort")

    def output(self, name):
        return self.system.GetOutputPort(name).Eval(self.context).copy()

    def handle_force(self):
        """Returns the force (3,) at the handle that causes the effort."""
        return np.linalg.lstsq(Contact(MASTER).jacobian(self.q).T, self.output("effort"), rcond=None)[0]


def test_force_is_rotated_scaled_and_limited():
    R_FM = RotationMatrix.MakeZRotation(0.5)
    bench = Bench(gain=0.5, R_FM=R_FM, dead_zone=0.5, max_force=2.0)
    direction = np.array([1.0, -2.0, 2.0]) / 3
    for size, expected in ((0.4, 0.0), (2.5, 1.0), (30.0, 2.0)):
        for _ in range(60):
            bench.step(force=size * direction, engaged=1, following=1)
        assert bench.output("active") == 1
        np.testing.assert_allclose(bench.handle_force(), expected * (R_FM.inverse() @ direction), atol=1e-9)
    for _ in range(100):
        bench.step(force=[3.0, 3.0, 3.0], measurable=[0, 1, 0])
    np.testing.assert_allclose(R_FM @ bench.handle_force(), [0.0, 1.25, 0.0], atol=1e-9)
    strong = Bench(gain=5.0, max_force=10.0)
    for _ in range(60):
        strong.step(force=[0.0, 0.0, 10.0], engaged=1, following=1)
    np.testing.assert_allclose(np.max(np.abs(strong.output("effort")) / MASTER.effort_limits), MAX_SHARE, atol=1e-9)


def test_operator_never_receives_more_energy_than_was_stored():
    generator, bench = np.random.default_rng(0), Bench()
    speed, least, scale = np.zeros(7), 0.0, [0.1, 0.1, 0.1, 1, 1, 1, 1]
    bench.step(engaged=1, following=1)
    for k in range(400):
        if k < 150:
            speed = 0.9 * speed + generator.normal(size=7) * scale
            bench.step(speed, force=generator.normal(size=3) * 5.0)
        else:  # the worst case: the force always acts along the motion
            speed = 2.0 * np.sign(speed) * scale
            push = Contact(MASTER).jacobian(bench.q) @ speed
            bench.step(speed, force=20.0 * push / np.linalg.norm(push))
        least = min(least, bench.energy)
    assert -START_ENERGY <= least < 0.0
    assert 0.0 <= bench.output("energy")[0] < 0.5 * START_ENERGY
    assert bench.output("active") == 1


@pytest.mark.parametrize(
    "loss",
    [
        {"force": [np.nan, 0, 0]},
        {"fault": 1},
        {"following": 0},
        {"measurement_age": 0.2},
        {"v": np.array([0, 9.0, 0, 0, 0, 0, 0])},
    ],
    ids=lambda loss: next(iter(loss)),
)
def test_feedback_is_off_after_a_loss_until_the_clutch_opens(loss):
    bench, fine = Bench(), {"force": [3.0, 0, 0], "fault": 0, "following": 1, "measurement_age": 0.0}
    for _ in range(5):
        bench.step(engaged=1, **fine)
    assert np.any(bench.output("effort"))
    np.testing.assert_array_equal(bench.step(**loss), 0.0)
    for _ in range(5):
        np.testing.assert_array_equal(bench.step(**fine), 0.0)
    bench.step(engaged=0)
    for _ in range(5):
        bench.step(engaged=1, **fine)
    assert np.any(bench.output("effort"))


def test_numbers_out_of_range_are_refused():
    for arguments in ({"gain": 0.0}, {"max_force": 20.0}, {"dead_zone": -1.0}, {"period": np.nan}):
        with pytest.raises(ControllerError, match=f"{next(iter(arguments))} must be"):
            ForceFeedback(MASTER, **arguments)


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "delay"), [(1.0, 0.0), (1.0, 0.05), (1.2, 0.05)])
def test_contact_with_a_stiff_wall_is_passive_and_stable(factor, delay):
    """A hand moves the goal of the tip 10 mm into a wall of 2000 N/m (at a scale of 0.4), and withdraws."""
    model = exact_model(FOLLOWER)
    links = [replace(link, parameters=[factor * p for p in link.parameters]) for link in model.dynamics.links]
    model = replace(model, dynamics=replace(model.dynamics, links=links))
    p_tip = Contact(FOLLOWER).point(Q_FOLLOWER)
    wall = Wall(FOLLOWER, p_tip - [0.0, 0.0, 0.008], [0.0, 0.0, 1.0])
    arms = TeleoperatedArms(MASTER, FOLLOWER, scale=0.4, force_model=model, wall=wall, delay=delay)
    simulator = Simulator(arms)
    context = simulator.get_mutable_context()
    arms.SetPositions(context, Q, Q_FOLLOWER)
    X_MG0 = arms.CalcX_MG(context)
    wall_context = wall.GetMyContextFromRoot(context)
    q, p_T = Q, p_tip
    taken, given, heights, forces = [0.0], [0.0], [], []
    for k in range(2300):
        t = k * PERIOD
        arms.GetInputPort("engaged").FixValue(context, [float(k >= 200)])
        z = -0.045 * (np.clip((t - 0.3) / 0.5, 0, 1) - np.clip((t - 1.3) / 0.4, 0, 1))
        target = AbstractValue.Make(RigidTransform([0.0, 0.0, z]) @ X_MG0)
        arms.GetInputPort("X_MG_desired").FixValue(context, target)
        force = wall.GetOutputPort("force").Eval(wall_context)
        # The plant reads the effort before the feedback is updated at the same time.
        acting, q_before, p_before = arms.GetOutputPort("feedback_effort").Eval(context).copy(), q, p_T
        simulator.AdvanceTo(t + PERIOD)
        q = arms.GetOutputPort("mtml.state_estimated").Eval(context)[:7].copy()
        p_T = arms.CalcX_FT(context).translation()
        # Two-port between handle and wall: energy from the operator, and energy into the wall.
        taken.append(taken[-1] - acting @ (q - q_before))
        given.append(given[-1] - force @ (p_T - p_before))
        heights.append((arms.CalcX_MG(context).translation() - X_MG0.translation())[2])
        forces.append(force[2])
    assert arms.GetOutputPort("feedback_active").Eval(context)[0] == 1
    assert max(forces) > 5.0 and forces[-1] == 0.0
    assert min(taken) >= -START_ENERGY
    # The wall returns its energy, except for what its damper dissipates. This is all that the follower has added.
    assert 0.0 <= given[-1] < 0.2 * max(given)
    assert np.min(np.subtract(taken, given)) >= -START_ENERGY - given[-1]
    # Feedback of 3 N moves a hand of 600 N/m by 5 mm. There is no oscillation, neither at the wall nor afterwards.
    np.testing.assert_allclose(heights[1250], -0.040, atol=2e-3)
    assert np.ptp(heights[1150:1300]) < 1e-3 and np.ptp(heights[2200:]) < 1e-3
