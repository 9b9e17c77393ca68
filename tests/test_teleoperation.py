"""A master that leads a PSM: inverse kinematics, the law, the clutch, limits, faults; and both simulated arms."""

from functools import partial

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePose

from dvrk_drake.analysis.demo.teleoperation import (
    SCALE,
    START_FOLLOWER,
    START_MASTER,
    play_teleoperation,
    run_live_teleoperation,
    start_scene,
)
from dvrk_drake.cli import main
from dvrk_drake.dynamics.psm_inverse_kinematics import PsmInverseKinematics
from dvrk_drake.errors import ArmError, ControllerError
from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions
from dvrk_drake.systems.pose_trajectory_source import PoseTrajectorySource
from dvrk_drake.systems.teleoperated_arms import TeleoperatedArms
from dvrk_drake.systems.teleoperation import MAX_LAG, MIN_DEPTH, Teleoperation, _velocity_limits

MTM, PSM = load_arm("mtml"), load_arm("psm")
#: yaw, pitch, insertion, roll, wrist pitch, wrist yaw, jaw: Wang et al. 2019.
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
    """`Teleoperation` with a follower that is where it is commanded, unless told otherwise."""

    def __init__(self, q_follower=Q_F, **arguments):
        self.system = Teleoperation(MTM, PSM, **arguments)
        self.context = self.system.CreateDefaultContext()
        self.inputs = {"master_position": Q_M, "follower_position": q_follower, "engaged": 0.0, "jaw_angle": 0.5}
        self.step()

    def step(self, follower=None, **inputs):
        """One update; the desired positions (7,) and velocities (7,)."""
        self.inputs.update(inputs)
        if follower is not None:
            self.inputs["follower_position"] = follower
        for name, value in self.inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, np.atleast_1d(value))
        state = self.context.get_mutable_discrete_state()
        state.SetFrom(self.system.EvalUniquePeriodicDiscreteUpdate(self.context))
        desired = self.system.GetOutputPort("desired_state").Eval(self.context)
        if follower is None and np.all(np.isfinite(desired)):
            self.inputs["follower_position"] = desired[:7].copy()
        return desired[:7].copy(), desired[7:].copy()

    def move(self, q_master, steps=400):
        """Moves the master to q_master, step by step, then lets the follower arrive; all desired positions."""
        start = np.array(self.inputs["master_position"])
        way = [self.step(master_position=start + s * (q_master - start))[0] for s in np.linspace(0, 1, steps)]
        return np.array(way + [self.step()[0] for _ in range(steps)])

    def flag(self, name):
        return self.system.GetOutputPort(name).Eval(self.context)[0]


def test_inverse_kinematics_is_the_identity_after_forward_kinematics():
    inverse = PsmInverseKinematics(PSM)
    lower, upper = PSM.position_lower.copy(), PSM.position_upper
    assert inverse.depth_at_zero == pytest.approx(-0.0156)
    assert inverse.wrist_length == pytest.approx(0.0091)
    lower[2] = -inverse.depth_at_zero + 2e-3
    poses = np.random.default_rng(0).uniform(lower, upper, (300, 7))
    corners = np.array(np.meshgrid(*zip(lower[:6], upper[:6], strict=True))).reshape(6, -1).T
    plant = make_arm_plant(PSM)
    context = plant.CreateDefaultContext()
    for q in [*poses, *np.hstack([corners, np.zeros((len(corners), 1))])]:
        set_arm_positions(plant, context, PSM, q)
        X_FT = plant.GetFrameByName("dh_6").CalcPoseInWorld(context)
        np.testing.assert_allclose(inverse.solve(X_FT, q), q[:6], rtol=0, atol=1e-9)


def test_inverse_kinematics_takes_the_nearest_turn_of_the_roll():
    inverse = PsmInverseKinematics(PSM)
    q = Q_F.copy()
    for roll in (-4.0, -0.5, 4.0):
        q[3] = roll
        assert inverse.solve(tip(q), q)[3] == pytest.approx(roll, abs=1e-9)


def test_inverse_kinematics_has_no_solution_above_the_remote_centre():
    inverse = PsmInverseKinematics(PSM)
    X_FT = tip(Q_F)
    up = RigidTransform(X_FT.rotation(), [*X_FT.translation()[:2], 0.1])
    assert inverse.solve(up, Q_F) is None
    assert inverse.solve(RigidTransform(X_FT.rotation(), np.zeros(3)), Q_F) is None
    q = Q_F.copy()
    q[2] = 0.0156 + 0.019
    assert inverse.solve(tip(q), q) is not None
    assert PsmInverseKinematics(PSM, min_depth=0.02).solve(tip(q), q) is None


def test_inverse_kinematics_refuses_an_arm_of_another_kind():
    with pytest.raises(ArmError, match="MTML has not the kinematics of a PSM"):
        PsmInverseKinematics(MTM)


@pytest.mark.parametrize("seed", range(4))
def test_tip_repeats_the_handle_scaled_and_turned_into_its_base(seed):
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


def test_commanded_velocity_is_the_rate_of_the_commanded_position():
    loop = Loop()
    before, _ = loop.step(engaged=1.0)
    for s in np.linspace(0, 0.2, 50):
        q, v = loop.step(master_position=Q_M + s)
        np.testing.assert_allclose(q, before + PERIOD * v, atol=1e-12)
        before = q


def test_open_clutch_holds_exactly():
    loop = Loop()
    loop.step(engaged=1.0)
    held = loop.move(Q_M + 0.1)[-1]
    loop.step(engaged=0.0)
    for s in np.linspace(0, 1, 50):
        q, v = loop.step(master_position=Q_M + s * np.array([0.5, 0.3, -0.3, 1, 1, 0.3, 2]), jaw_angle=s)
        np.testing.assert_array_equal(q, held)
        np.testing.assert_array_equal(v, 0.0)


def test_engaging_again_elsewhere_moves_nothing_and_goes_on_from_there():
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


def test_no_joint_is_commanded_faster_than_its_limit_whatever_the_master_does():
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
        assert np.all(np.abs(v) <= SPEED)
        before = q
    assert np.all(fastest <= SPEED * (1 + 1e-9))
    np.testing.assert_allclose(fastest[[0, 2, 3, 6]], SPEED[[0, 2, 3, 6]])


@pytest.mark.parametrize("turn", [np.array([0, 0, 0, 0, 0, 0, 6.0]), np.array([0.8, 0.5, -0.7, 0, 1.5, 0.6, 0])])
def test_limits_are_kept_and_the_tip_comes_back_with_the_master(turn):
    q_start = np.array([1.2, -0.7, 0.22, 3.0, 1.0, 1.0, 0.5])
    loop = Loop(q_start, scale=1.0)
    loop.step(engaged=1.0)
    away = loop.move(Q_M + turn, steps=3000)
    back = loop.move(Q_M, steps=3000)
    way = np.vstack([away, back])
    assert np.all(way >= PSM.position_lower - 1e-12)
    assert np.all(way <= PSM.position_upper + 1e-12)
    touched = np.isclose(away, PSM.position_upper) | np.isclose(away, PSM.position_lower)
    assert touched.any()
    # The pose of the tip: a roll may be another turn.
    np.testing.assert_allclose(tip(back[-1]).GetAsMatrix4(), tip(q_start).GetAsMatrix4(), atol=1e-9)


def test_tip_that_is_pulled_out_stops_below_the_remote_centre_and_comes_back():
    loop = Loop(np.array([0.0, 0, 0.05, 0, 0, 0, 0.5]), scale=1.0)
    loop.step(engaged=1.0)
    up = np.array([0.1, 1.0, -0.3, 0.2, 1.0, 0.1, 0.3])
    assert handle(up).translation()[2] - handle(Q_M).translation()[2] > 0.1
    away = loop.move(up, steps=2000)
    assert away[:, 2].min() == pytest.approx(0.0156 + MIN_DEPTH, abs=2e-3)
    assert away[:, 2].min() >= 0.0156 + MIN_DEPTH - 1e-12
    np.testing.assert_allclose(loop.move(Q_M, steps=2000)[-1], [0, 0, 0.05, 0, 0, 0, 0.5], atol=1e-9)


def test_instrument_in_its_cannula_does_not_follow():
    loop = Loop(np.zeros(7))
    for s in np.linspace(0, 0.2, 20):
        q, _ = loop.step(engaged=1.0, master_position=Q_M + s)
        np.testing.assert_array_equal(q, 0.0)
    assert loop.flag("following") == 0.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e7])
@pytest.mark.parametrize("port", ["master_position", "follower_position", "engaged", "jaw_angle"])
def test_unusable_input_is_held_through_and_then_engaged_anew(port, bad):
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


def test_nothing_is_commanded_before_the_follower_was_seen():
    loop = Loop(np.full(7, np.nan))
    for _ in range(3):
        q, _ = loop.step(follower=np.full(7, np.nan), engaged=1.0)
        assert np.all(np.isnan(q))
        assert loop.flag("fault") == 1.0
    q, _ = loop.step(follower=Q_F)
    np.testing.assert_allclose(q, Q_F, atol=1e-12)


def test_follower_that_is_blocked_is_not_driven_on():
    loop = Loop()
    loop.step(engaged=1.0)
    for s in np.linspace(0, 1, 1000):
        q, _ = loop.step(follower=Q_F, master_position=Q_M + s * np.array([0.6, 0, 0, 0, 0, 0, 0]))
    assert loop.flag("fault") == 1.0
    assert 0 < np.max(np.abs(q - Q_F) / SPEED) < MAX_LAG + 2 * PERIOD
    # Letting the clutch go takes it where it is: nothing pushes any more.
    q, _ = loop.step(follower=Q_F, engaged=0.0)
    np.testing.assert_array_equal(q, Q_F)
    assert loop.flag("fault") == 0.0


def test_jaw_may_press_on_something():
    loop = Loop()
    loop.step(engaged=1.0)
    for _ in range(1000):
        q, _ = loop.step(follower=np.array([*Q_F[:6], 0.4]), jaw_angle=-2.0)
    assert loop.flag("fault") == 0.0
    assert q[6] == PSM.position_lower[6]


def test_scale_changes_without_a_jump():
    loop = Loop(scale=0.2)
    loop.step(engaged=1.0)
    held = loop.move(Q_M + 0.1)[-1]
    loop.system.SetScale(loop.context, 0.6)
    q, _ = loop.step()
    np.testing.assert_allclose(q, held, atol=1e-12)
    q = loop.move(Q_M + 0.12)[-1]
    np.testing.assert_allclose(
        tip(q).translation() - tip(held).translation(),
        0.6 * (handle(Q_M + 0.12).translation() - handle(Q_M + 0.1).translation()),
        atol=1e-9,
    )


@pytest.mark.parametrize("scale", [0.0, -0.3, 1.1, np.nan])
def test_scale_out_of_range_is_refused(scale):
    with pytest.raises(ControllerError, match="scale must be above 0 and at most 1"):
        Teleoperation(MTM, PSM, scale=scale)
    loop = Loop()
    with pytest.raises(ControllerError, match="scale must be above 0 and at most 1"):
        loop.system.SetScale(loop.context, scale)


def test_other_arguments_that_are_refused():
    with pytest.raises(ControllerError, match="period must be a positive number"):
        Teleoperation(MTM, PSM, period=0.0)
    with pytest.raises(ArmError, match="MTML has not the kinematics of a PSM"):
        Teleoperation(MTM, MTM)
    with pytest.raises(ArmError, match='PSM: its SDF has no frame "dh_7"; it has dh_0'):
        Teleoperation(PSM, PSM)
    system = Teleoperation(MTM, PSM)
    with pytest.raises(ControllerError, match="input port master_position is not connected"):
        Simulator(system).Initialize()


@pytest.fixture(scope="module")
def arms():
    return TeleoperatedArms(MTM, PSM, scale=SCALE)


def run(arms, duration=2.5):
    """The handle is pulled and turned by a person, then held; the state of all at the end, and the poses."""
    simulator = Simulator(arms)
    context = simulator.get_mutable_context()
    arms.set_positions(context, START_MASTER, START_FOLLOWER)
    X_MG0, X_FT0 = arms.X_MG(context), arms.X_FT(context)
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
    return np.concatenate(state), (X_MG0, arms.X_MG(context)), (X_FT0, arms.X_FT(context)), target


def test_simulated_follower_arrives_where_a_hand_leads_it(arms):
    _, (G0, G), (T0, T), target = run(arms)
    # The hand gets the gravity-compensated master to where it wants it, so it carries no weight.
    assert np.linalg.norm(G.translation() - target.translation()) < 1e-4
    way = SCALE * (G.translation() - G0.translation())
    assert np.linalg.norm(way) > 0.02
    assert np.linalg.norm(T.translation() - T0.translation() - way) < 5e-4
    wanted = G.rotation() @ G0.rotation().inverse()
    assert angle(wanted) > 0.3
    assert angle(T.rotation() @ T0.rotation().inverse() @ wanted.inverse()) < 5e-3


def test_simulation_is_repeatable(arms):
    np.testing.assert_array_equal(run(arms, 0.5)[0], run(arms, 0.5)[0])


def test_master_that_nobody_touches_stays_and_so_does_the_follower(arms):
    simulator = Simulator(arms)
    context = simulator.get_mutable_context()
    arms.set_positions(context, START_MASTER, START_FOLLOWER)
    arms.GetInputPort("engaged").FixValue(context, [1.0])
    simulator.AdvanceTo(1.0)
    q_M = arms.GetOutputPort("mtml.state_estimated").Eval(context)[:7]
    q_F = arms.GetOutputPort("psm.state_estimated").Eval(context)[:7]
    np.testing.assert_allclose(q_M, START_MASTER, atol=1e-4)
    np.testing.assert_allclose(q_F, START_FOLLOWER, atol=1e-4)


def test_played_hand_lets_go_and_is_followed_within_half_a_millimetre():
    shares = []
    meshcat = start_scene()
    result = play_teleoperation(meshcat, progress=shares.append)
    assert shares[-1] == 1.0
    assert result.handle_path > 0.5
    assert result.max_position_error < 5e-4
    assert result.max_rotation_error < 5e-3
    assert result.max_motion_held < 5e-5
    assert meshcat.HasPath("/drake/mtml/links")
    assert meshcat.HasPath("/drake/mtml/path/1")
    assert meshcat.HasPath("/drake/psm/path/1")
    assert "path" in meshcat.StaticHtml()


def pressed(name):
    """What the browser sends when a button is pressed: msgpack of {type: button, name: name}."""
    text = [bytes([0xA0 + len(word)]) + word.encode() for word in ("type", "button", "name", name)]
    return b"\x82" + b"".join(text)


def test_live_scene_obeys_its_sliders_and_buttons(monkeypatch):
    meshcat = start_scene()
    plan = {  # time [s]: what the user does
        0.1: lambda: meshcat.SetSliderValue("hand_z", 0.05),
        1.1: lambda: meshcat._InjectWebsocketMessage(pressed("Clutch")),
        1.3: lambda: meshcat.SetSliderValue("hand_z", 0.0),
        2.1: lambda: meshcat.SetSliderValue("scale", 0.9),
        2.2: lambda: meshcat.SetSliderValue("hand_x", 0.05),
        3.4: lambda: meshcat._InjectWebsocketMessage(pressed("Clutch")),
        3.5: lambda: meshcat.SetSliderValue("hand_x", 0.0),
        4.0: lambda: meshcat._InjectWebsocketMessage(pressed("Stop")),
    }
    tips = {}

    class Watched(Simulator):
        def AdvanceTo(self, time):
            arms = self.get_system()
            self.set_target_realtime_rate(0.0)
            for due in [due for due in plan if due <= time]:
                tips[due] = arms.X_FT(self.get_context()).translation()
                plan.pop(due)()
            super().AdvanceTo(time)

    monkeypatch.setattr("dvrk_drake.analysis.demo.teleoperation.Simulator", Watched)
    run_live_teleoperation(meshcat, duration=10.0)
    assert not plan
    np.testing.assert_allclose(tips[1.3], tips[0.1], atol=1e-5)  # open, then closed at rest
    np.testing.assert_allclose(tips[2.1] - tips[1.3], [0, 0, -SCALE * 0.05], atol=3e-4)
    np.testing.assert_allclose(tips[3.4] - tips[2.2], [0.9 * 0.05, 0, 0], atol=3e-4)
    np.testing.assert_allclose(tips[4.0], tips[3.5], atol=3e-4)


def test_cli_writes_the_recording_and_the_errors(tmp_path, monkeypatch, capsys):
    short = partial(play_teleoperation, duration=0.6)
    monkeypatch.setattr("dvrk_drake.analysis.demo.teleoperation.play_teleoperation", short)
    page = tmp_path / "teleop.html"
    assert main(["teleop", "--html", str(page)]) == 0
    assert "<html" in page.read_text()
    assert "position [mm]" in capsys.readouterr().out


def test_pose_stays_at_the_ends_of_its_trajectory():
    ends = [RigidTransform([0.0, 0, 0]), RigidTransform([2.0, 0, 0])]
    source = PoseTrajectorySource(PiecewisePose.MakeLinear([1.0, 2.0], ends))
    context = source.CreateDefaultContext()
    for time, x in ((0.0, 0.0), (1.5, 1.0), (9.0, 2.0)):
        context.SetTime(time)
        assert source.get_output_port().Eval(context).translation()[0] == pytest.approx(x)


def test_cli_refuses_a_place_that_cannot_be_written(tmp_path, capsys):
    assert main(["teleop", "--html", str(tmp_path / "nowhere" / "x.html")]) == 2
    assert "its folder does not exist" in capsys.readouterr().err


def test_cli_refuses_a_port_that_is_none(capsys):
    assert main(["teleop", "--port", "80"]) == 2
    assert "port 80 cannot be opened" in capsys.readouterr().err


def test_velocity_limits_come_from_the_sdf():
    assert np.array_equal(Loop().system._speed, SPEED)
    with pytest.raises(ControllerError, match="no <velocity> limit"):
        _velocity_limits(MTM)
