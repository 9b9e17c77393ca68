"""Friction compensation: same elements as the identified friction, passivity, no creep."""

import numpy as np
import pytest
from command_output import assert_refused
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.optimize import linprog

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.friction_compensation import (
    MAX_HYSTERESIS_RATIO,
    MAX_RATIO,
    Friction,
    holding_error,
    safe_ratios,
)
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]

ARM = load_arm("mtml")
EFFECTS = [
    *(ActuatorEffect(f"actuator.{name}", "presliding", d) for name in ARM.joint_names for d in (0.003, 0.02)),
    *(ActuatorEffect(f"actuator.{name}", "coulomb", 0.05) for name in ARM.joint_names),
    *(ActuatorEffect(f"actuator.{name}", "viscous") for name in ARM.joint_names),
    ActuatorEffect("joint.elbow_pitch", "presliding", 0.01),
]
SIZES = np.array([0.09, 0.12, 0.11, 0.06, 0.008, 0.005, 0.001])
COEFFICIENTS = np.concatenate([np.repeat(SIZES, 2) / 2, SIZES / 3, SIZES / 2, [0.03]])
FRICTION = Friction.of(ARM, EFFECTS, COEFFICIENTS)
NO_EFFORT = np.zeros(7)
ROUNDING = 1e-9  # of ratios from a linear program


def holding_friction(friction):
    """Returns the static friction (n,) of each joint if only this joint moves [N m, N]."""
    return np.abs(friction.rows[friction.holds]).T @ friction.coefficients[friction.holds]


def motion(seed, steps=6000, period=1e-3):
    """Returns a random motion of a hand: q and v (steps, 7), with small vibrations, where presliding dominates."""
    generator = np.random.default_rng(seed)
    t = period * np.arange(steps)
    q, v = np.zeros((steps, 7)), np.zeros((steps, 7))
    for frequency in (0.2, 0.7, 3.0, 11.0):
        amplitude = generator.uniform(0.0, 0.2, 7) / (1 + frequency**1.5)
        phase = generator.uniform(0, 2 * np.pi, 7)
        w = 2 * np.pi * frequency
        q += amplitude * np.sin(w * t[:, None] + phase)
        v += amplitude * w * np.cos(w * t[:, None] + phase)
    return q, v


def friction_of_arm(q, v):
    """Returns the efforts (m, n) of the arm's own friction from the columns of the identification."""
    rows = ARM.effect_coordinates
    a, a_dot = ARM.transmission.position(q), ARM.transmission.velocity(v)
    efforts = np.zeros(a.shape)
    for effect, coefficient in zip(EFFECTS, COEFFICIENTS, strict=True):
        h = rows[effect.coordinate]
        efforts += coefficient * effect.column(a @ h, a_dot @ h)[:, None] * h
    return ARM.transmission.pull_back_effort(efforts)


class Compensator:
    """The system alone, stepped manually."""

    def __init__(self, **options):
        self.system = FrictionCompensator(FRICTION, **{"holding_error": NO_EFFORT, **options})
        self.context = self.system.CreateDefaultContext()
        self.system.GetInputPort("effort_wanted").FixValue(self.context, NO_EFFORT)
        self.new = self.system.AllocateDiscreteVariables()

    def step(self, q, v, port="friction_effort"):
        self.system.GetInputPort("state_estimated").FixValue(self.context, np.concatenate([q, v]))
        self.system.CalcForcedDiscreteVariableUpdate(self.context, self.new)
        self.context.get_mutable_discrete_state().SetFrom(self.new)
        return self.system.GetOutputPort(port).Eval(self.context).copy()

    def run(self, q, v):
        return np.array([self.step(*row) for row in zip(q, v, strict=True)])


def test_without_widening_it_is_a_share_of_friction():
    q, v = motion(1, 1000)
    np.testing.assert_allclose(
        Compensator(ratio=MAX_RATIO, widening=1.0).run(q, v), MAX_RATIO * friction_of_arm(q, v), atol=1e-12
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("delay", [0, 2])
def test_compensated_friction_is_passive(seed, delay):
    """Friction plus compensation is passive in any motion, also with delay, quantization and noise."""
    q, v = motion(seed)
    generator = np.random.default_rng(seed)
    seen_q = 5e-6 * np.round(q / 5e-6)
    seen_v = v + 1e-3 * generator.standard_normal(v.shape)
    late = np.concatenate([np.repeat(seen_q[:1], delay, 0), seen_q])[: len(q)]
    late_v = np.concatenate([np.repeat(seen_v[:1], delay, 0), seen_v])[: len(q)]
    given = Compensator(ratio=MAX_RATIO, hysteresis_ratio=MAX_HYSTERESIS_RATIO).run(late, late_v)
    dq = np.diff(q, axis=0)
    taken = friction_of_arm(q, v)
    energy = np.cumsum(np.einsum("mi,mi->m", (taken - given)[1:], dq))
    # Energy that the compensation's elements can store and return once: ratio c d / 2 with a widening of 1.5.
    stored = sum(
        MAX_HYSTERESIS_RATIO * c * 1.5 * e.scale / 2
        for e, c in zip(EFFECTS, COEFFICIENTS, strict=True)
        if e.kind == "presliding"
    )
    assert energy.min() > -stored
    assert energy[-1] > 0.05 * np.sum(taken[1:] * dq) > 0


def test_compensation_reduces_hand_force():
    q, v = motion(5)
    given = Compensator(ratio=0.6).run(q, v)
    taken = friction_of_arm(q, v)
    work, left = (np.abs(np.sum(f[1:] * np.diff(q, axis=0))) for f in (taken, taken - given))
    assert 0.35 * work < left < 0.6 * work


@pytest.mark.parametrize("ratio", [0.3, MAX_RATIO])
def test_remaining_friction_holds_gravity_errors(ratio):
    error = np.array([0.02, 0.03, 0.02, 0.01, 0.003, 0.002, 0.0004])
    ratios = safe_ratios(FRICTION, ratio, error)
    assert np.all((ratios >= -ROUNDING) & (ratios <= ratio + ROUNDING)) and np.any(ratios > 0.29)
    left = ((1 - ratios) * COEFFICIENTS)[FRICTION.holds]
    rows = FRICTION.rows[FRICTION.holds]
    generator = np.random.default_rng(3)
    for _ in range(50):
        corner = error * generator.choice([-1.0, 1.0], 7)
        holds = linprog(np.zeros(len(left)), A_eq=rows.T, b_eq=corner, bounds=[(-f, f) for f in left * (1 + 1e-9)])
        assert holds.success


def test_creeping_joints_keep_all_friction():
    error = np.zeros(7)
    error[5] = 0.02  # more than its friction
    ratios = safe_ratios(FRICTION, 0.6, error)
    touches = FRICTION.rows[:, 5] != 0
    np.testing.assert_allclose(ratios, np.where(touches, 0.0, 0.6), atol=ROUNDING)
    error[5], error[1], error[2] = 0.0, 0.1, 0.1  # each one could be held alone, but not both with opposite signs
    assert np.all(holding_friction(FRICTION) > error)
    ratios = safe_ratios(FRICTION, 0.6, error)
    touches = np.any(FRICTION.rows[:, 1:4] != 0, axis=1)
    np.testing.assert_allclose(ratios, np.where(touches, 0.0, 0.6), atol=ROUNDING)


def test_wide_hysteresis_is_compensated_first():
    wide = FRICTION.springs_back
    assert np.any(wide) and not np.any(wide & FRICTION.holds)
    without = safe_ratios(FRICTION, 0.0, NO_EFFORT)
    ratios = safe_ratios(FRICTION, 0.0, NO_EFFORT, hysteresis_ratio=0.8)
    np.testing.assert_allclose(ratios, np.where(wide, 0.8, without), atol=ROUNDING)
    both = safe_ratios(FRICTION, MAX_RATIO, NO_EFFORT, hysteresis_ratio=MAX_HYSTERESIS_RATIO)
    dry = np.array([effect.kind != "viscous" for effect in FRICTION.effects])
    np.testing.assert_allclose(both[wide], MAX_HYSTERESIS_RATIO, atol=ROUNDING)
    assert np.all(both[dry & ~wide] <= MAX_RATIO + ROUNDING)
    for name in {effect.coordinate for effect in FRICTION.effects}:
        here = dry & [effect.coordinate == name for effect in FRICTION.effects]
        assert np.sum((both * COEFFICIENTS)[here]) == pytest.approx(MAX_RATIO * np.sum(COEFFICIENTS[here]))
    alone = Friction.of(ARM, [ActuatorEffect("joint.elbow_pitch", "presliding", 0.2)], [0.03])
    assert safe_ratios(alone, 0.0, NO_EFFORT, hysteresis_ratio=0.9) == pytest.approx(MAX_RATIO)


def test_no_compensation_without_excess_friction():
    np.testing.assert_allclose(safe_ratios(FRICTION, 0.6, holding_friction(FRICTION)), 0, atol=ROUNDING)
    assert np.all(safe_ratios(FRICTION, 0.6, 0.999 * holding_friction(FRICTION)) < 0.5)


def test_friction_effort_is_zero_initially_and_after_nan():
    compensator = Compensator(ratio=MAX_RATIO)
    q = np.full(7, 0.2)
    still = np.zeros(7)
    assert np.all(compensator.step(q, still) == 0)
    assert np.all(np.abs(compensator.step(q + 0.1, still)) > 0)
    assert np.all(compensator.step(np.full(7, np.nan), still) == 0)
    assert np.all(compensator.step(q - 0.3, still) == 0)


def test_sum_is_clamped_to_effort_limits():
    compensator = Compensator(ratio=MAX_RATIO)
    compensator.system.GetInputPort("effort_wanted").FixValue(compensator.context, 0.999 * ARM.effort_limits)
    compensator.step(np.zeros(7), np.zeros(7))
    effort = compensator.step(np.full(7, 0.1), np.full(7, 1.0), "effort")
    assert np.all(effort <= ARM.effort_limits) and np.any(effort == ARM.effort_limits)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"ratio": 0.61}, "ratio must be between 0 and 0.6"),
        ({"ratio": np.nan}, "ratio must be"),
        ({"hysteresis_ratio": 0.91}, "hysteresis ratio must be between 0 and 0.9"),
        ({"widening": 0.9}, "widening must be 1..10"),
        ({"holding_error": [0.1]}, "must be 7 numbers of 0 or more"),
    ],
)
def test_invalid_numbers_are_refused(options, what):
    assert_refused(ControllerError, what, FrictionCompensator, FRICTION, **{"holding_error": NO_EFFORT, **options})


def test_compensation_needs_an_error_bound_of_gravity():
    assert_refused(ControllerError, "a friction ratio above 0 requires holding_error", FrictionCompensator, FRICTION)
    FrictionCompensator(FRICTION, ratio=0.0, hysteresis_ratio=0.5)
    model = IdentifiedModel.from_arm(ARM, dynamics=True)
    with pytest.raises(ControllerError, match="this model has no error bound at rest, so the arm could creep"):
        holding_error(model)
    for joint in model.joints[1:]:
        joint.rms_leave_one_out_included = 0.1
    assert_refused(ControllerError, f"no error bound at rest for {ARM.joint_names[0]}, so", holding_error, model)
    model.joints[0].rms_leave_one_out_included = 0.1
    np.testing.assert_allclose(holding_error(model), np.full(7, 0.2), rtol=0, atol=1e-12)


def test_active_friction_is_refused():
    assert_refused(ControllerError, r"allowed for kind .*: 0 or more", Friction.of, ARM, EFFECTS, -COEFFICIENTS)
    with pytest.raises(ControllerError, match=r"allowed: actuator\.outer_yaw"):
        Friction.of(ARM, [ActuatorEffect("actuator.nose", "viscous")], [1.0])


def released(ratio, error, holding_error, seconds=1.5):
    """Returns the motion (7,) of each joint with friction, encoders and delays under compensation [rad]."""
    station = ArmStation(ARM, effects=ARM.effects.without("cables").without("springs"))
    friction = FrictionCompensator(Friction.of_arm(ARM), ratio=ratio, holding_error=holding_error)
    builder = DiagramBuilder()
    controller = GravityPidController(IdentifiedModel.from_arm(ARM), mode="gravity")
    add_closed_loop(builder, station, controller, friction=friction)
    simulator = Simulator(builder.Build())
    context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    start = [0.1, 0.3, -0.1, 0.5, 0.4, 0.1, 0.3]
    station.SetPositions(context, start)
    station.GetInputPort("mtml.effort_disturbance").FixValue(context, error)
    simulator.AdvanceTo(seconds)
    return np.abs(station.GetOutputPort("mtml.state_true").Eval(context)[:7] - start)


@pytest.mark.slow
def test_released_arm_stays_with_gravity_error():
    error = np.array([0.01, 0.015, -0.015, 0.01, 0.003, 0.002, 0.0004])
    assert np.all(released(MAX_RATIO, error, np.abs(error)) < 0.015)
    more = np.array([1, 2, 2, 2, 1, 1, 1]) * error
    assert np.any(released(MAX_RATIO, more, np.zeros(7)) > 0.1)
    assert np.all(
        released(MAX_RATIO, more, np.abs(more)) < 0.04
    )  # as without compensation: the fine friction cannot hold as much
