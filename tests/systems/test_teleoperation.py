"""Teleoperation of a PSM: control law, clutch, limits and faults."""

import numpy as np
import pytest
from command_output import assert_refused
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePose
from robot_file import write_robot

from dvrk_drake.errors import ControllerError
from dvrk_drake.experiments.teleoperation import SCALE, START_FOLLOWER, START_MASTER
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions
from dvrk_drake.systems.hand import PoseTrajectorySource
from dvrk_drake.systems.teleoperated_arms import TeleoperatedArms
from dvrk_drake.systems.teleoperation import MAX_LAG, MIN_DEPTH, Teleoperation

pytestmark = [pytest.mark.drake_api, pytest.mark.numeric]

MTM, PSM = load_arm("mtml"), load_arm("psm")
#: Maximum speeds of yaw, pitch, insertion, roll, wrist pitch, wrist yaw, jaw [rad/s, m/s] (Wang et al. 2019).
SPEED = np.array([1.7, 1.7, 0.35, 2.0, 2.0, 3.0, 3.0])
PERIOD = 1e-3
Q_M = np.array([0.1, 0.3, -0.1, 0.2, 1.0, 0.1, 0.3])
Q_F = np.array([0.2, -0.1, 0.13, 0.4, 0.2, -0.3, 0.5])


def pose(arm, frame, q):
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, q)
    return plant.GetFrameByName(frame).CalcPoseInWorld(context)


def handle(q):
    return pose(MTM, "dh_7", q)


def tip(q):
    return pose(PSM, "dh_6", q)


def angle(R):
    return abs(R.ToAngleAxis().angle())


class Loop:
    """`Teleoperation` with a follower that reaches each command immediately, unless specified otherwise."""

    def __init__(self, q_follower=Q_F, q_master=Q_M, arms=(MTM, PSM), **arguments):
        self.system, self.num_joints = Teleoperation(*arms, **arguments), arms[1].num_joints
        self.context = self.system.CreateDefaultContext()
        self.inputs = {"master_position": q_master, "follower_position": q_follower, "engaged": 0.0, "jaw_angle": 0.5}
        self.step()

    def step(self, follower=None, **inputs):
        """Runs one update; returns the desired positions (n,) and velocities (n,)."""
        self.inputs.update(inputs)
        if follower is not None:
            self.inputs["follower_position"] = follower
        for name, value in self.inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, np.atleast_1d(value))
        state = self.context.get_mutable_discrete_state()
        state.SetFrom(self.system.EvalUniquePeriodicDiscreteUpdate(self.context))
        desired = self.system.GetOutputPort("desired_state").Eval(self.context)
        if follower is None and np.all(np.isfinite(desired)):
            self.inputs["follower_position"] = desired[: self.num_joints].copy()
        return desired[: self.num_joints].copy(), desired[self.num_joints :].copy()

    def move(self, q_master, steps=400):
        """Moves the master to q_master (n,) in `steps` steps, then waits. Returns the desired positions (m, n)."""
        start = np.array(self.inputs["master_position"])
        positions = [self.step(master_position=start + s * (q_master - start))[0] for s in np.linspace(0, 1, steps)]
        return np.array(positions + [self.step()[0] for _ in range(steps)])

    def flag(self, name):
        return self.system.GetOutputPort(name).Eval(self.context)[0]


@pytest.mark.parametrize("seed", range(4))
def test_tip_follows_handle_scaled_and_rotated(seed):
    generator = np.random.default_rng(seed)
    R_FM = RotationMatrix(RollPitchYaw(generator.uniform(-1, 1, 3)))
    loop = Loop(scale=0.25, R_FM=R_FM)
    loop.step(engaged=1.0)
    q_M = Q_M + generator.uniform(-0.25, 0.25, 7)
    q_F = loop.move(q_M)[-1]
    way = tip(q_F).translation() - tip(Q_F).translation()
    assert np.linalg.norm(way) > 5e-3
    R = R_FM.matrix()
    np.testing.assert_allclose(way, 0.25 * R @ (handle(q_M).translation() - handle(Q_M).translation()), atol=1e-9)
    turned = (tip(q_F).rotation() @ tip(Q_F).rotation().inverse()).matrix()
    wanted = (handle(q_M).rotation() @ handle(Q_M).rotation().inverse()).matrix()
    assert angle(RotationMatrix(turned)) > 0.05
    np.testing.assert_allclose(turned, R @ wanted @ R.T, atol=1e-9)


def test_arm_of_a_urdf_follows_its_twin(tmp_path):
    """The desired pose is reachable although the arm has three joints, because both arms have the same poses."""
    arm = load_arm(write_robot(tmp_path))
    q, goal = np.array([0.2, 0.1, 0.3]), np.array([0.4, 0.15, 0.1])
    loop = Loop(q, q, (arm, arm), scale=1.0)
    loop.step(engaged=1.0)
    np.testing.assert_allclose(loop.move(goal, steps=200)[-1], goal, atol=1e-9)


def test_commanded_velocity_is_the_derivative_of_position():
    loop = Loop()
    before, _ = loop.step(engaged=1.0)
    for s in np.linspace(0, 0.2, 50):
        q, v = loop.step(master_position=Q_M + s)
        np.testing.assert_allclose(q, before + PERIOD * v, atol=1e-12)
        before = q


def test_open_clutch_holds_the_command():
    loop = Loop()
    loop.step(engaged=1.0)
    held = loop.move(Q_M + 0.1)[-1]
    loop.step(engaged=0.0)
    for s in np.linspace(0, 1, 50):
        q, v = loop.step(master_position=Q_M + s * np.array([0.5, 0.3, -0.3, 1, 1, 0.3, 2]), jaw_angle=s)
        np.testing.assert_array_equal(q, held)
        np.testing.assert_array_equal(v, 0.0)


def test_engaging_again_does_not_move_the_tip():
    loop = Loop()
    loop.step(engaged=1.0)
    held = loop.move(Q_M + 0.1)[-1]
    loop.step(engaged=0.0)
    elsewhere = Q_M + np.array([-0.3, 0.2, 0.1, -0.5, 0.4, -0.3, 1.0])
    loop.step(master_position=elsewhere)
    q, v = loop.step(engaged=1.0)
    np.testing.assert_allclose(q, held, rtol=0, atol=1e-12)
    np.testing.assert_allclose(v, 0, atol=1e-9)
    q = loop.move(elsewhere + 0.05)[-1]
    np.testing.assert_allclose(
        tip(q).translation() - tip(held).translation(),
        0.3 * (handle(elsewhere + 0.05).translation() - handle(elsewhere).translation()),
        atol=1e-9,
    )


def test_commanded_velocity_is_limited():
    loop = Loop()
    before, _ = loop.step(engaged=1.0)
    generator = np.random.default_rng(0)
    fastest = np.zeros(7)
    for _ in range(300):
        q, v = loop.step(
            master_position=MTM.sample_poses(1, generator)[0],
            engaged=float(generator.uniform() > 0.1),
            jaw_angle=generator.uniform(-2, 2),
        )
        fastest = np.maximum(fastest, np.abs(q - before) / PERIOD)
        assert np.all(np.abs(v) <= SPEED * (1 + 1e-9))
        before = q
    assert np.all(fastest <= SPEED * (1 + 1e-9))
    np.testing.assert_allclose(fastest[[0, 2, 3, 6]], SPEED[[0, 2, 3, 6]], atol=1e-9)


@pytest.mark.parametrize(
    "turn",
    [
        pytest.param(np.array([0, 0, 0, 0, 0, 0, 6.0]), marks=pytest.mark.slow),
        np.array([0.8, 0.5, -0.7, 0, 1.5, 0.6, 0]),
    ],
)
def test_tip_returns_from_limits_with_the_master(turn):
    q_start = np.array([1.2, -0.7, 0.22, 3.0, 1.0, 1.0, 0.5])
    loop = Loop(q_start, scale=1.0)
    loop.step(engaged=1.0)
    away = loop.move(Q_M + turn, steps=1500)
    back = loop.move(Q_M, steps=1500)
    way = np.vstack([away, back])
    assert np.all(way >= PSM.position_lower - 1e-12)
    assert np.all(way <= PSM.position_upper + 1e-12)
    touched = np.isclose(away, PSM.position_upper, atol=1e-9) | np.isclose(away, PSM.position_lower, atol=1e-9)
    assert touched.any()
    # The pose of the tip is compared, since a roll may differ by a full rotation.
    np.testing.assert_allclose(tip(back[-1]).GetAsMatrix4(), tip(q_start).GetAsMatrix4(), atol=1e-9)


def test_tip_stops_below_remote_centre_and_returns():
    loop = Loop(np.array([0.0, 0, 0.05, 0, 0, 0, 0.5]), scale=1.0)
    loop.step(engaged=1.0)
    up = np.array([0.1, 1.0, -0.3, 0.2, 1.0, 0.1, 0.3])
    assert handle(up).translation()[2] - handle(Q_M).translation()[2] > 0.1
    away = loop.move(up, steps=1000)
    assert away[:, 2].min() == pytest.approx(0.0156 + MIN_DEPTH, abs=2e-3)
    assert away[:, 2].min() >= 0.0156 + MIN_DEPTH - 1e-12
    np.testing.assert_allclose(loop.move(Q_M, steps=1000)[-1], [0, 0, 0.05, 0, 0, 0, 0.5], atol=1e-9)


def test_instrument_in_its_cannula_does_not_follow():
    loop = Loop(np.zeros(7))
    for s in np.linspace(0, 0.2, 20):
        q, _ = loop.step(engaged=1.0, master_position=Q_M + s)
        np.testing.assert_array_equal(q, 0.0)
    assert loop.flag("following") == 0.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e7])
@pytest.mark.parametrize("port", ["master_position", "follower_position", "engaged", "jaw_angle"])
def test_unusable_input_holds_then_engages_again(port, bad):
    loop = Loop()
    loop.step(engaged=1.0)
    held = loop.move(Q_M + 0.05)[-1]
    good = np.atleast_1d(loop.inputs[port]).astype(float)
    for _ in range(3):
        value = good.copy()
        value[-1] = bad
        value[0] = bad
        q, v = loop.step(follower=value) if port == "follower_position" else loop.step(**{port: value})
        np.testing.assert_array_equal(q, held)
        np.testing.assert_array_equal(v, 0.0)
        assert (loop.flag("following"), loop.flag("fault")) == (0.0, 1.0)
    loop.step(follower=held, master_position=Q_M - 0.1)
    q, _ = loop.step(master_position=Q_M - 0.1, engaged=1.0, jaw_angle=0.5)
    np.testing.assert_allclose(q, held, atol=1e-9)
    assert (loop.flag("following"), loop.flag("fault")) == (1.0, 0.0)


def test_no_command_before_first_follower_position():
    loop = Loop(np.full(7, np.nan))
    for _ in range(3):
        q, _ = loop.step(follower=np.full(7, np.nan), engaged=1.0)
        assert np.all(np.isnan(q))
        assert loop.flag("fault") == 1.0
    q, _ = loop.step(follower=Q_F)
    np.testing.assert_allclose(q, Q_F, atol=1e-12)


def test_blocked_follower_is_held():
    loop = Loop()
    loop.step(engaged=1.0)
    for s in np.linspace(0, 1, 1000):
        q, _ = loop.step(follower=Q_F, master_position=Q_M + s * np.array([0.6, 0, 0, 0, 0, 0, 0]))
    assert loop.flag("fault") == 1.0
    assert 0 < np.max(np.abs(q - Q_F) / SPEED) < MAX_LAG + 2 * PERIOD
    # Opening the clutch sets the command to the measured position, so no effort remains.
    q, _ = loop.step(follower=Q_F, engaged=0.0)
    np.testing.assert_array_equal(q, Q_F)
    assert loop.flag("fault") == 0.0


def test_jaw_may_press_on_an_object():
    loop = Loop()
    loop.step(engaged=1.0)
    for _ in range(1000):
        q, _ = loop.step(follower=np.array([*Q_F[:6], 0.4]), jaw_angle=-2.0)
    assert loop.flag("fault") == 0.0
    assert q[6] == PSM.position_lower[6]


@pytest.mark.parametrize("scale", [0.0, -0.3, 1.1, np.nan])
def test_scale_out_of_range_is_refused(scale):
    assert_refused(ControllerError, "scale must be above 0 and at most 1", Teleoperation, MTM, PSM, scale=scale)
    loop = Loop()
    assert_refused(ControllerError, "scale must be above 0 and at most 1", loop.system.SetScale, loop.context, scale)


def test_other_invalid_arguments_are_refused():
    assert_refused(ControllerError, "period must be a positive number", Teleoperation, MTM, PSM, period=0.0)
    assert_refused(ControllerError, "MTML: a joint has no velocity limit", Teleoperation, MTM, MTM)
    system = Teleoperation(MTM, PSM)
    assert_refused(ControllerError, "input port master_position is not connected", Simulator(system).Initialize)


# Simulated teleoperation of a PSM by a master.


@pytest.fixture(scope="module")
def arms():
    return TeleoperatedArms(MTM, PSM, scale=SCALE)


def run(arms, duration=2.5):
    """Returns the final states and poses after a hand moves, rotates and then holds the handle."""
    simulator = Simulator(arms)
    context = simulator.get_mutable_context()
    arms.SetPositions(context, START_MASTER, START_FOLLOWER)
    X_MG0, X_FT0 = arms.CalcX_MG(context), arms.CalcX_FT(context)
    arms.GetInputPort("engaged").FixValue(context, [1.0])
    for t in np.arange(0, duration, 0.01):
        s = np.clip((t - 0.1) / 1.0, 0, 1)
        target = RigidTransform(
            RotationMatrix(RollPitchYaw(0.3 * s, -0.2 * s, 0.25 * s)) @ X_MG0.rotation(),
            X_MG0.translation() + s * np.array([0.04, -0.03, 0.05]),
        )
        arms.GetInputPort("X_MG_desired").FixValue(context, AbstractValue.Make(target))
        simulator.AdvanceTo(t + 0.01)
    state = [arms.GetOutputPort(f"{name}.state_estimated").Eval(context) for name in ("mtml", "psm")]
    return np.concatenate(state), (X_MG0, arms.CalcX_MG(context)), (X_FT0, arms.CalcX_FT(context)), target


def test_simulated_follower_follows_the_hand(arms):
    _, (G0, G), (T0, T), target = run(arms)
    # The hand moves the gravity-compensated master to the desired pose without its weight.
    assert np.linalg.norm(G.translation() - target.translation()) < 1e-4
    way = SCALE * (G.translation() - G0.translation())
    assert np.linalg.norm(way) > 0.02
    assert np.linalg.norm(T.translation() - T0.translation() - way) < 5e-4
    wanted = G.rotation() @ G0.rotation().inverse()
    assert angle(wanted) > 0.3
    assert angle(T.rotation() @ T0.rotation().inverse() @ wanted.inverse()) < 5e-3


def test_pose_is_constant_outside_the_trajectory():
    ends = [RigidTransform([0.0, 0, 0]), RigidTransform([2.0, 0, 0])]
    source = PoseTrajectorySource(PiecewisePose.MakeLinear([1.0, 2.0], ends))
    context = source.CreateDefaultContext()
    for time, x in ((0.0, 0.0), (1.5, 1.0), (9.0, 2.0)):
        context.SetTime(time)
        assert source.get_output_port().Eval(context).translation()[0] == pytest.approx(x)
