"""Control law compared with its equation, and behaviour with invalid inputs."""

import dataclasses

import numpy as np
import pytest
from command_output import assert_refused
from controlled_arm import ControlledArm
from pydrake.systems.analysis import Simulator

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError, ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions
from dvrk_drake.systems.closed_loop import EffortRamp
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

pytestmark = [pytest.mark.drake_api, pytest.mark.numeric]

ARM = load_arm("mtml")
MODEL = IdentifiedModel.from_arm(ARM)
N = ARM.num_joints
GAINS = Gains(kp=[1.0 + j for j in range(N)], kd=[0.5 + 0.1 * j for j in range(N)], ki=[0.2 * j for j in range(N)])
UNLIMITED = np.full(N, 1e6)
POSES = ARM.sample_poses(5, np.random.default_rng(0))


class Bench:
    """Controller alone. `step` is one update, as in the Simulator or a message loop."""

    def __init__(self, desired=None, **arguments):
        self.controller = GravityPidController(arguments.pop("model", MODEL), **arguments)
        self.context = self.controller.CreateDefaultContext()
        if desired is not None:
            self.controller.GetInputPort("desired_state").FixValue(self.context, desired)

    def set_state(self, q, v=None):
        value = np.concatenate([q, np.zeros(N) if v is None else v])
        self.controller.GetInputPort("state_estimated").FixValue(self.context, value)

    def initialize(self, q, v=None):
        self.set_state(q, v)
        self.controller.ExecuteInitializationEvents(self.context)
        return self.output("effort")

    def step(self, q, v=None):
        self.set_state(q, v)
        self.context.SetDiscreteState(self.controller.EvalUniquePeriodicDiscreteUpdate(self.context))
        return self.output("effort")

    def output(self, name):
        return self.controller.GetOutputPort(name).Eval(self.context)


@pytest.mark.parametrize("q", POSES)
def test_gravity_mode_equals_plant_gravity(q):
    plant = make_arm_plant(ARM)
    plant_context = plant.CreateDefaultContext()
    set_arm_positions(plant, plant_context, ARM, q)
    bench = Bench(mode="gravity", effort_limits=UNLIMITED)
    effort = bench.initialize(q, v=np.ones(N))
    np.testing.assert_allclose(effort, holding_torque(plant, plant_context, ARM), atol=1e-12)
    np.testing.assert_allclose(bench.output("gravity_effort"), effort, atol=1e-12)
    assert bench.output("fault") == [0.0]


def test_law_is_equation_11():
    rng = np.random.default_rng(1)
    q_d, v_d = POSES[0], rng.normal(size=N)
    bench = Bench(np.concatenate([q_d, v_d]), gains=GAINS, effort_limits=UNLIMITED, period=2e-3)
    bench.initialize(POSES[1])
    integral = np.zeros(N)
    for _ in range(20):
        q, v = POSES[1] + rng.normal(scale=0.1, size=N), rng.normal(size=N)
        integral += (q_d - q) * 2e-3
        expected = (
            MODEL.holding_torque(q)
            + np.multiply(GAINS.kp, q_d - q)
            + np.multiply(GAINS.kd, v_d - v)
            + np.multiply(GAINS.ki, integral)
        )
        np.testing.assert_allclose(bench.step(q, v), expected, rtol=1e-12, atol=1e-12)


def test_damped_mode_only_adds_damping():
    bench = Bench(gains=GAINS, effort_limits=UNLIMITED, mode="damped")
    bench.initialize(POSES[0])
    v = np.linspace(-1, 1, N)
    for q in POSES:  # at any distance from the start
        np.testing.assert_allclose(bench.step(q, v), MODEL.holding_torque(q) - np.multiply(GAINS.kd, v), atol=1e-12)
    np.testing.assert_allclose(bench.step(q, np.full(N, np.nan)), MODEL.holding_torque(q), atol=1e-12)


def test_effort_is_clamped_and_gravity_effort_is_not():
    limits = np.full(N, 0.01)
    q = POSES[0]
    bench = Bench(np.concatenate([q + 0.5, np.zeros(N)]), gains=GAINS, effort_limits=limits)
    np.testing.assert_array_equal(bench.initialize(q), limits)
    np.testing.assert_allclose(bench.output("gravity_effort"), MODEL.holding_torque(q), atol=1e-12)
    assert np.abs(bench.output("gravity_effort")).max() > 0.01


def test_integrator_does_not_wind_up():
    gains = Gains(kp=[1.0] * N, kd=[1.0] * N, ki=[100.0] * N)
    limits = np.full(N, 2.0)
    q = np.zeros(N)
    bench = Bench(np.concatenate([q + 0.5, np.zeros(N)]), gains=gains, effort_limits=limits)
    bench.initialize(q)
    for _ in range(1000):  # 100 / s * 0.5 rad * 1 s = 50 N m without the limit
        bench.step(q)
    # Beyond the goal the command reverses immediately, because at most the limit was stored.
    effort = bench.step(q + 0.5)
    gravity = MODEL.holding_torque(q + 0.5)
    assert np.all(effort - gravity <= 2.0 - 0.5 * 1.0 - MODEL.holding_torque(q) + 1e-9)
    # It decreases when the error changes sign.
    assert np.all(bench.step(q + 0.6) < effort - gravity + MODEL.holding_torque(q + 0.6))


def test_integrator_stops_while_error_is_large():
    gains = Gains(kp=[10.0] * N, kd=[0.0] * N, ki=[1.0] * N)
    q = np.zeros(N)
    bench = Bench(np.concatenate([q + 0.5, np.zeros(N)]), gains=gains, effort_limits=np.full(N, 2.0))
    bench.initialize(q)
    # Damping keeps the command inside the limit, but Kp e = 5 N m alone is beyond it.
    for _ in range(100):
        bench.step(q)
    np.testing.assert_allclose(bench.step(q + 0.5), MODEL.holding_torque(q + 0.5), atol=1e-12)


def test_unconnected_hold_latches_the_pose_at_initialization():
    bench = Bench(gains=GAINS, effort_limits=UNLIMITED)
    np.testing.assert_allclose(bench.initialize(POSES[0]), MODEL.holding_torque(POSES[0]), atol=1e-12)
    moved = POSES[0] + 0.01
    integral = np.multiply(GAINS.ki, -0.01 * 1e-3)
    expected = MODEL.holding_torque(moved) - 0.01 * np.array(GAINS.kp) + integral
    np.testing.assert_allclose(bench.step(moved), expected, atol=1e-12)


def test_switch_to_hold_latches_pose_without_jump():
    bench = Bench(gains=GAINS, effort_limits=UNLIMITED, mode="gravity")
    bench.initialize(POSES[0])
    assert bench.controller.GetMode(bench.context) == "gravity"
    bench.step(POSES[1])
    bench.controller.SetMode(bench.context, "hold")
    np.testing.assert_allclose(bench.step(POSES[2]), MODEL.holding_torque(POSES[2]), atol=1e-12)
    assert np.abs(bench.step(POSES[3]) - MODEL.holding_torque(POSES[3])).max() > 0.1
    bench.controller.SetMode(bench.context, "gravity")
    np.testing.assert_allclose(bench.step(POSES[3]), MODEL.holding_torque(POSES[3]), atol=1e-12)


def test_gains_belong_to_the_context():
    bench = Bench(gains=GAINS, effort_limits=UNLIMITED)
    other = bench.controller.CreateDefaultContext()
    weak = Gains(kp=[0.1] * N, kd=[0.0] * N, ki=[0.0] * N)
    bench.initialize(POSES[0])
    for _ in range(5):
        bench.step(POSES[1])
    bench.controller.SetGains(bench.context, weak)
    assert bench.controller.GetGains(bench.context) == weak
    assert bench.controller.GetGains(other) == GAINS
    # Ki = 0 resets the integrator: only gravity and Kp e remain.
    expected = MODEL.holding_torque(POSES[1]) + 0.1 * (POSES[0] - POSES[1])
    np.testing.assert_allclose(bench.step(POSES[1], np.ones(N)), expected, atol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308])
@pytest.mark.parametrize("where", ["position", "velocity", "desired"])
def test_fault_outputs_gravity_of_last_finite_pose(bad, where):
    desired = np.concatenate([POSES[0] + 0.1, np.zeros(N)])
    bench = Bench(desired, gains=GAINS, effort_limits=UNLIMITED)
    bench.initialize(POSES[0])
    for _ in range(10):
        bench.step(POSES[0])
    q, v = POSES[1].copy(), np.zeros(N)
    if where == "desired":
        last = q
        port = bench.controller.GetInputPort("desired_state")
        port.FixValue(bench.context, np.where(np.arange(2 * N) == 3, bad, desired))
    else:
        last = POSES[0]
        (q if where == "position" else v)[2] = bad
    np.testing.assert_allclose(bench.step(q, v), MODEL.holding_torque(last), atol=1e-12)
    np.testing.assert_allclose(bench.output("gravity_effort"), MODEL.holding_torque(last), atol=1e-12)
    assert bench.output("fault") == [1.0]
    # It resumes automatically with the integrator at zero.
    bench.controller.GetInputPort("desired_state").FixValue(bench.context, desired)
    e = 0.1
    expected = MODEL.holding_torque(POSES[0]) + e * np.array(GAINS.kp) + e * 1e-3 * np.array(GAINS.ki)
    np.testing.assert_allclose(bench.step(POSES[0]), expected, atol=1e-12)
    assert bench.output("fault") == [0.0]


def test_fault_before_first_pose_outputs_zero():
    bench = Bench(gains=GAINS)
    np.testing.assert_array_equal(bench.initialize(np.full(N, np.nan)), np.zeros(N))
    assert bench.output("fault") == [1.0]
    np.testing.assert_allclose(bench.step(POSES[0]), MODEL.holding_torque(POSES[0]), atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"period": 0.0}, "period must be a positive number"),
        ({"period": float("nan")}, "period must be a positive number"),
        ({"mode": "float"}, 'unknown mode "float"; known modes: hold, gravity'),
        ({"effort_limits": [1.0] * 6}, "effort_limits must be 7 positive numbers"),
        ({"effort_limits": [np.nan] * 7}, "effort_limits must be 7 positive numbers"),
        ({"gains": Gains(kp=[1.0], kd=[1.0] * 7, ki=[1.0] * 7)}, r"gains\.kp has 1 number; allowed: 7, one per joint"),
        ({"gains": Gains(kp=[1.0] * 7, kd=[-1.0] * 7, ki=[1.0] * 7)}, r"gains\.kd\[0\] is -1; allowed: 0 or "),
    ],
)
def test_errors_state_allowed_values(arguments, message):
    assert_refused(ControllerError, message, GravityPidController, MODEL, **arguments)


def test_model_of_another_arm_is_refused():
    with pytest.raises(ModelError, match="base_parameters must have these names in this order"):
        GravityPidController(dataclasses.replace(MODEL, base_parameters=MODEL.base_parameters[1:]))


def test_unconnected_state_is_reported():
    controller = GravityPidController(MODEL)
    assert_refused(ControllerError, "input port state_estimated is not connected", Simulator(controller).Initialize)


# Ramp from the measured to the desired effort.


def test_ramp_starts_when_enabled_and_restarts():
    ramp = EffortRamp(2, duration=0.1)
    simulator = Simulator(ramp)
    context = simulator.get_mutable_context()
    measured, wanted = np.array([1.0, -1.0]), np.array([3.0, 5.0])
    ramp.GetInputPort("effort_measured").FixValue(context, measured)
    ramp.GetInputPort("effort_wanted").FixValue(context, wanted)
    enabled = ramp.GetInputPort("enabled")
    enabled.FixValue(context, [0.0])
    output = ramp.get_output_port()
    simulator.AdvanceTo(0.0505)
    np.testing.assert_array_equal(output.Eval(context), measured)
    enabled.FixValue(context, [1.0])
    simulator.AdvanceTo(0.1005)
    np.testing.assert_allclose(output.Eval(context), measured + 0.5 * (wanted - measured), atol=1e-9)
    # Later measurements have no effect.
    ramp.GetInputPort("effort_measured").FixValue(context, [7.0, 7.0])
    simulator.AdvanceTo(0.3005)
    np.testing.assert_allclose(output.Eval(context), wanted, atol=1e-9)
    enabled.FixValue(context, [0.0])
    simulator.AdvanceTo(0.3025)
    np.testing.assert_array_equal(output.Eval(context), [7.0, 7.0])


def test_a_forced_update_is_one_period():
    ramp = EffortRamp(1, period=0.01, duration=0.1)
    context = ramp.CreateDefaultContext()
    for name, value in {"effort_measured": [0.0], "effort_wanted": [1.0], "enabled": [1.0]}.items():
        ramp.GetInputPort(name).FixValue(context, value)
    for k in range(1, 15):
        state = ramp.AllocateDiscreteVariables()
        ramp.CalcForcedDiscreteVariableUpdate(context, state)
        context.SetDiscreteState(state)
        assert ramp.get_output_port().Eval(context)[0] == pytest.approx(min(1.0, 0.1 * k))


def test_invalid_ramp_is_refused():
    assert_refused(ControllerError, "must be positive", EffortRamp, 7, duration=0.0)


# Arms in other mountings: gravity has another direction in the base frame.


@pytest.mark.parametrize(
    ("name", "gravity"), [("mtml", (3.0, 2.0, -9.1)), ("mtml", (0.0, 0.0, 9.81)), ("psm", (0.0, -9.81, 0.0))]
)
def test_only_model_of_same_mounting_holds_the_arm(name, gravity):
    arm = load_arm(name)
    mounted = arm.with_gravity(gravity)
    q = (arm.position_lower + 2 * arm.position_upper) / 3
    q[2] -= 0.4 if name == "mtml" else 0.0  # inside the parallelogram's stops
    assert not arm.limit_violations(q)
    right, wrong = (
        ControlledArm(arm, q, IdentifiedModel.from_arm(modelled), plant_arm=mounted, closure="ball").drift(0.5).max()
        for modelled in (mounted, arm)
    )
    assert right < 1e-5
    assert wrong > 0.05
