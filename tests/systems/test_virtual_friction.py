"""Virtual dry friction of mode "guide": it holds a joint at rest, breaks away, and never creates energy."""

import dataclasses
from statistics import NormalDist

import numpy as np
import pytest

from dvrk_drake.dynamics.dynamic_section import ActuatorStatistics
from dvrk_drake.dynamics.friction_compensation import MAX_SLIP_SHARE, is_cross_validated, slip_effort
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.gravity_pid_step import (
    DECAY_TIME,
    NUM_STATES,
    PLAY_START,
    PLAY_TIME,
    REST_TIME,
    virtual_friction,
)

pytestmark = pytest.mark.numeric

WITH_ENCODER = load_arm("mtml")
ARM = dataclasses.replace(WITH_ENCODER, effects=dataclasses.replace(WITH_ENCODER.effects, encoder=None))
MODEL = IdentifiedModel.from_arm(ARM)
N = ARM.num_joints
SLIP = 0.05 * ARM.effort_limits
KP, KD = SLIP / 0.004, np.full(N, 0.01)  # a spring slides at 4 mrad
PERIOD = 1e-3
Q = 0.5 * (ARM.position_lower + ARM.position_upper)


class Guided:
    """Controller in mode "guide" and the effort that it adds to gravity."""

    def __init__(self, model=MODEL, kd=KD, v=1.0, **arguments):
        gains = Gains(kp=KP.tolist(), kd=np.broadcast_to(kd, N).tolist(), ki=[0.0] * N)
        arguments = {"slip_efforts": SLIP, **arguments}
        self.controller = GravityPidController(model, mode="guide", gains=gains, **arguments)
        self.context = self.controller.CreateDefaultContext()
        self.added = np.zeros(N)
        self.measure(Q, v)
        self.controller.ExecuteInitializationEvents(self.context)

    def measure(self, q, v=0.0):
        self.measured = q
        state = np.concatenate([q, np.broadcast_to(v, N)])
        self.controller.GetInputPort("state_estimated").FixValue(self.context, state)

    def step(self, q, v=0.0):
        """Makes one update. Returns the effort (n,) in addition to gravity."""
        self.measure(q, v)
        self.context.SetDiscreteState(self.controller.EvalUniquePeriodicDiscreteUpdate(self.context))
        effort, gravity = (self.controller.GetOutputPort(p).Eval(self.context) for p in ("effort", "gravity_effort"))
        self.added = effort - gravity
        return self.added

    def move(self, q, seconds, start=Q):
        """Moves from `start` to q at constant speed."""
        for share in np.linspace(0.0, 1.0, round(seconds / PERIOD)):
            self.step(start + share * (q - start))
        return self

    def rest(self, q=Q, seconds=REST_TIME + 2 * PERIOD):
        for _ in range(round(seconds / PERIOD)):
            self.step(q)
        return self


def assert_no_effort(added):
    np.testing.assert_allclose(added, np.zeros(N), atol=1e-12)


def test_spring_attaches_after_a_rest_without_a_step():
    guided, moved = Guided(kd=0.0), 0.5 * SLIP / KP
    guided.rest(seconds=REST_TIME - 10 * PERIOD)
    assert_no_effort(guided.step(Q + 1e-3))  # not yet attached
    guided.rest(Q + 1e-3)
    assert_no_effort(guided.added)
    np.testing.assert_allclose(guided.step(Q + 1e-3 + moved), -0.5 * SLIP, atol=1e-12)
    np.testing.assert_allclose(guided.step(Q + 1e-3 - moved), 0.5 * SLIP, atol=1e-12)
    assert_no_effort(guided.step(Q + 1e-3))


@pytest.mark.parametrize("side", [-1, 1])
def test_spring_slides_at_the_slip_effort_and_breaks_away(side):
    guided = Guided(kd=0.0).rest()
    guided.move(Q + side * 0.006, 0.03)
    np.testing.assert_allclose(guided.added, -side * SLIP, atol=1e-12)
    np.testing.assert_allclose(guided.step(Q + side * 0.004), -0.5 * side * SLIP, atol=1e-12)  # 2 mrad back
    end = Q + side * 0.02
    guided.move(end, 0.05, start=Q + side * 0.004).rest(end, seconds=5 * DECAY_TIME)
    assert np.all(np.abs(guided.added) < 0.02 * SLIP)  # free
    guided.rest(end, seconds=1.0)
    np.testing.assert_allclose(guided.step(end + side * 0.001), -0.25 * side * SLIP, atol=0.02 * SLIP.max())


def test_two_moving_joints_free_the_arm():
    for joints, others_hold in (([2], True), ([0, 2], False)):
        guided, moved = Guided(kd=0.0).rest(), 0.5 * SLIP / KP
        guided.move(Q + moved, 0.01)
        far = Q + moved
        far[joints] += 0.1
        guided.move(far, 0.4, start=Q + moved)
        others = np.setdiff1d(np.arange(N), joints)
        expected = -0.5 * SLIP if others_hold else 0.0 * SLIP
        np.testing.assert_allclose(guided.added[others], expected[others], atol=0.01 * SLIP.max())
        assert np.all(np.abs(guided.added[joints]) < 0.01 * SLIP.max())


def test_spring_does_not_attach_to_a_slow_hand():
    guided, end = Guided(kd=0.0), Q + 0.05
    assert_no_effort(guided.move(end, 1.0).added)
    guided.rest(end, seconds=1.0)
    np.testing.assert_allclose(guided.step(end + 0.1 * SLIP / KP), -0.1 * SLIP, atol=1e-12)  # at the end of the motion


def test_spring_attaches_to_a_trembling_hand():
    for tremor, speed in ((0.002, 0.003), (0.0, 0.015)):
        guided = Guided(kd=0.0)
        for k in range(600):
            q = Q + speed * k * PERIOD + tremor * np.sin(2 * np.pi * 10.0 * k * PERIOD)
            guided.step(q)
        before = guided.added
        np.testing.assert_allclose(guided.step(q - 1e-4) - before, 1e-4 * KP, atol=1e-12)


def test_one_encoder_count_moves_no_joint():
    guided = Guided(IdentifiedModel.from_arm(WITH_ENCODER), slip_efforts=None)
    guided.controller.SetGains(guided.context, WITH_ENCODER.gains)
    guided.rest()
    coarse = np.arange(N) == 6
    for k in range(40):
        added = guided.step(Q + coarse * WITH_ENCODER.encoder_counts() * (k % 2))
        assert np.all(np.abs(added) <= 0.8 * ARM.dry_friction())  # the spring and the damping


def test_a_joint_at_rest_may_alternate_between_counts():
    guided, counts = Guided(IdentifiedModel.from_arm(WITH_ENCODER), kd=0.0), WITH_ENCODER.encoder_counts()
    guided.rest(seconds=PLAY_START + PLAY_TIME + REST_TIME)
    first = guided.step(Q + counts)
    assert np.any(first != 0)
    for k in range(40):
        np.testing.assert_allclose(guided.step(Q + counts * (k % 2)), first, atol=1e-12)


def largest_step(guided, q, steps=100):
    """Returns the largest change of the added effort per period and slip effort during `steps` updates at q."""
    last, changes = guided.added, []
    for _ in range(steps):
        added = guided.step(q)
        changes.append(np.abs(added - last).max(where=np.isfinite(q), initial=0.0) / SLIP.max())
        last = added
    assert np.all(np.abs(last) < 0.01 * SLIP)
    return max(changes)


@pytest.mark.parametrize("cause", ["lost measurement", "jump", "mode"])
def test_springs_detach_without_a_step(cause):
    guided = Guided(kd=0.0).rest()
    deflected = Q + 0.8 * SLIP / KP
    guided.step(deflected)
    if cause == "mode":
        guided.controller.SetMode(guided.context, "gravity")
    after = {"lost measurement": np.full(N, np.nan), "jump": deflected + 0.03}.get(cause, deflected)
    assert largest_step(guided, after) <= 0.8 * PERIOD / DECAY_TIME + 1e-9


def test_springs_attach_anew_after_a_fault():
    guided = Guided(kd=0.0).rest()
    guided.step(Q * np.nan)
    guided.rest(Q + 1e-3)
    assert_no_effort(guided.step(Q + 1e-3))


def test_springs_attach_at_once_after_a_rest_in_another_mode():
    guided = Guided(kd=0.0)
    guided.controller.SetMode(guided.context, "gravity")
    guided.rest()
    assert_no_effort(guided.step(Q + 1e-3))
    guided.controller.SetMode(guided.context, "guide")
    assert_no_effort(guided.step(Q + 1e-3))
    np.testing.assert_allclose(guided.step(Q + 1e-3 + 0.1 * SLIP / KP), -0.1 * SLIP, atol=1e-12)


def test_weak_spring_is_stiffened():
    guided = Guided(kd=0.0)
    weak = Gains(kp=(KP / 10).tolist(), kd=[0.0] * N, ki=[0.0] * N)
    guided.controller.SetGains(guided.context, weak)
    guided.rest()
    np.testing.assert_allclose(guided.step(Q + 0.001), -0.001 * 0.4 * KP, atol=1e-12)


def test_damping_of_a_free_joint_covers_the_model_error():
    error = 0.05 * ARM.effort_limits
    for speed in (-0.002, 0.004, 0.01, 0.03):
        guided = Guided(slip_efforts=ARM.dry_friction() + error).move(Q + 0.1 * speed, 0.1)
        damping = -np.sign(speed) * guided.added
        assert np.all(damping > 0) and np.all(damping <= np.minimum(2.1 * KD * abs(speed), error))
    assert_no_effort(Guided(slip_efforts=ARM.dry_friction() + error).move(Q + 0.1, 0.1).added)


def test_spring_attaches_at_the_start_of_an_arm_at_rest():
    guided, moved = Guided(kd=0.0, v=0.0), 0.5 * SLIP / KP
    guided.step(Q)
    np.testing.assert_allclose(guided.step(Q + moved), -0.5 * SLIP, atol=1e-12)


def test_springs_take_over_the_effort_of_the_regulator():
    guided = Guided(kd=0.0)
    guided.controller.SetMode(guided.context, "hold")
    guided.rest()
    guided.move(Q + np.where(np.arange(N) % 2, 0.5, -1.5) * SLIP / KP, 0.01).rest(guided.measured, 0.25)
    regulated = guided.added
    guided.controller.SetMode(guided.context, "guide")
    taken = np.clip(regulated, -SLIP, SLIP)
    np.testing.assert_allclose(guided.step(guided.measured), taken, atol=1e-9)
    np.testing.assert_allclose(guided.rest(guided.measured).added, taken, atol=0.05 * SLIP.max())


def test_damping_of_an_attached_joint_is_at_most_the_slip_effort():
    np.testing.assert_allclose(Guided(kd=ARM.effort_limits).rest().step(Q + 1e-3), -SLIP - 1e-3 * KP, atol=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_energy_is_never_created(share):
    # 10,000 random motions of one joint each, with pauses in which springs attach. The stored energy of a spring is
    # S^2 / (2 kp). It may grow only by the work of the motion against the spring. The bound of a sampled effort is
    # kp dq^2 / 8 per period in which the spring passes through zero. A play, which begins after 1 s at rest,
    # creates at most kp times its half width along the path; the dry friction of a joint dissipates more.
    n, period = 10_000, 8e-3
    random = np.random.default_rng(0)
    kp, slip = random.uniform(0.1, 100.0, n), random.uniform(0.01, 1.0, n)
    amplitude = slip / kp * random.uniform(0.2, 5.0, n)
    frequency, pauses = random.uniform(0.5, 8.0, (2, n)), random.integers(0, 180, n)
    memory, effort = np.zeros(NUM_STATES * n), np.zeros(n)
    travel, endless, zeros = slip / kp * random.uniform(0.2, 2.0, n), np.full(n, np.inf), np.zeros(n)
    play = share * slip / kp
    if share:
        travel = endless  # a spring with a play remains attached
    settings = period, zeros, slip, kp, zeros, endless, travel, endless, play
    last, q, time, stored, attached = np.full(n, np.nan), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n, bool)
    last_effort = np.zeros(n)
    for k in range(250):
        effort[:] = 0.0
        virtual_friction(q, zeros, last, True, *settings, memory, effort)
        energy = effort**2 / (2 * kp) - effort * (q - memory[7 * n :])
        if k:
            step = q - last
            work = -0.5 * (effort + last_effort) * step
            assert np.all(energy - stored <= work + kp * (step**2 / 8 + play * np.abs(step)) + 1e-12 * slip**2 / kp)
        last_effort, stored, last = effort.copy(), energy, q
        attached |= ~np.isnan(memory[2 * n : 3 * n])
        time = time + period * ((k < pauses) | (k > pauses + 50))
        q = amplitude * (np.sin(2 * np.pi * frequency[0] * time) + np.sin(2 * np.pi * frequency[1] * time))
    assert attached.mean() > 0.9


def test_default_slip_effort_covers_the_error_and_the_friction():
    dry, error = ARM.dry_friction(), 0.01 * ARM.effort_limits
    np.testing.assert_allclose(slip_effort(MODEL), dry, atol=1e-12)
    assert not is_cross_validated(MODEL)
    statistics = zip(MODEL.joints, error, strict=True)
    joints = [dataclasses.replace(joint, rms_cross_validation_included=e) for joint, e in statistics]
    model = dataclasses.replace(MODEL, joints=joints)
    assert is_cross_validated(model)
    np.testing.assert_allclose(slip_effort(model), dry + NormalDist().inv_cdf(0.975) * error, atol=1e-9)
    joints[0] = dataclasses.replace(joints[0], rms_cross_validation_included=10.0)
    assert slip_effort(dataclasses.replace(MODEL, joints=joints))[0] == MAX_SLIP_SHARE * ARM.effort_limits[0]


def test_slip_effort_of_a_model_of_motions_covers_its_error():
    error, J = 0.01 * ARM.effort_limits, ARM.transmission.matrix
    model = IdentifiedModel.from_arm(ARM, dynamics=True)
    actuators = [
        ActuatorStatistics(name, rms_cross_validation=e) for name, e in zip(ARM.joint_names, error, strict=True)
    ]
    offset = DriveEffect(f"actuator.{ARM.joint_names[1]}", "offset", coefficient=0.1)  # of a joint that carries weight
    dynamics = dataclasses.replace(model.dynamics, actuators=actuators, effects=[*model.dynamics.effects, offset])
    model = dataclasses.replace(model, dynamics=dynamics)
    assert is_cross_validated(model)
    expected = NormalDist().inv_cdf(0.975) * np.sqrt((J.T**2) @ error**2) + np.abs(0.1 * J[1])
    np.testing.assert_allclose(slip_effort(model) - ARM.dry_friction(), expected, atol=1e-9)


@pytest.mark.parametrize("slip", [-1.0, np.nan, 0.5 * ARM.effort_limits[0]])
def test_slip_effort_out_of_range_is_refused(slip):
    with pytest.raises(ControllerError, match=r"slip_efforts must be 7 numbers; allowed: 0 to 0\.4 times"):
        GravityPidController(MODEL, slip_efforts=np.r_[slip, SLIP[1:]])
