"""Plausibility checks: detected faults, detection times, and plausible data without a fault."""

import dataclasses

import numpy as np
import pytest
from guard_bench import ARM, LIMIT, Bench, Heavy, Inert, N, Q, Weightless

from dvrk_drake.analysis.observations.true_time import true_time
from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.systems.guard.limits import GuardLimits
from dvrk_drake.systems.guard.plausibility import Plausibility
from dvrk_drake.systems.guard.settings import GuardSettings, PlausibilitySettings

PSM = load_arm("psm")
MS = 1e-3
SETTINGS = PlausibilitySettings()
COUNTS = np.abs(ARM.transmission.inverse.matrix) @ [ARM.effects.encoder.resolution[name] for name in ARM.joint_names]
TOLERANCE = SETTINGS.position_tolerance + 3 * COUNTS
JOINTS = range(N)


class Sensors:
    """Arm with a prescribed motion, and the checks of its measurements."""

    def __init__(self, arm=ARM, model=None):
        self.checks = Plausibility(arm, model or Weightless(), SETTINGS, GuardLimits(arm, GuardSettings()).speed)
        self.q = 0.5 * (arm.position_lower + arm.position_upper)
        self.v = np.zeros(arm.num_joints)
        self.effort, self.commanded = np.zeros(arm.num_joints), None
        self.measure()

    def measure(self, q=None, v=None, dt=MS):
        q, v = self.q if q is None else q, self.v if v is None else v
        return self.checks.check(dt, np.array(q), np.array(v), np.array(self.effort), self.commanded)

    def move(self, v, *, ticks=1, measured_q=None, measured_v=None):
        """Moves at v (n,). Returns the first fault and the number of ticks until it, or ("", ticks)."""
        self.v = np.array(v, float)
        for k in range(ticks):
            self.q = self.q + MS * self.v
            q = self.q if measured_q is None else measured_q(self.q)
            v_measured = self.v if measured_v is None else measured_v(self.v)
            if fault := self.measure(q, v_measured):
                return fault, k + 1
        return "", ticks


def unit(joint, size=1.0):
    return size * np.eye(N)[joint]


def test_earlier_speed_does_not_delay_the_detection_of_a_drift():
    times = []
    for speed in (0.0, 1.0):
        sensors = Sensors()
        assert sensors.move(unit(0, speed), ticks=100) == ("", 100)
        assert sensors.move(np.zeros(N), ticks=2000) == ("", 2000)
        fault, ticks = sensors.move(unit(0, 0.5), ticks=500, measured_v=np.zeros_like)
        assert fault == f"{ARM.joint_names[0]}: position and velocity disagree"
        times.append(ticks)
    assert times[0] == pytest.approx(times[1], abs=2)


@pytest.mark.parametrize("is_invalid", [False, True])
def test_invalid_effort_is_not_compared_with_the_motion(is_invalid):
    sensors, invalid = Sensors(), np.full(N, is_invalid)
    faults = [sensors.checks.check(MS, sensors.q, sensors.v, 3.0 * LIMIT * (k > 10), None, invalid) for k in range(100)]
    assert (faults[-1] == "") == is_invalid


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("side", [-1, 1])
def test_position_jump_beyond_tolerance_is_found(joint, side):
    for factor, found in ((0.99, False), (1.01, True)):
        sensors = Sensors()
        sensors.move(np.zeros(N), ticks=10)
        before = sensors.q.copy()
        sensors.q = sensors.q + unit(joint, side * factor * TOLERANCE[joint])
        fault = sensors.measure()
        assert (f"{ARM.joint_names[joint]}: the position jumps" == fault) == found
        np.testing.assert_array_equal(sensors.checks.invalid, unit(joint).astype(bool) & found)
        if found:
            np.testing.assert_array_equal(sensors.checks.last_valid, before * unit(joint))


@pytest.mark.parametrize("ticks", [5, 100, 107, 125, 133])
def test_last_valid_pose_precedes_the_fault(ticks):
    """The last valid pose is one to two detection times older than the fault, or it is the first pose."""
    sensors, v = Sensors(), unit(0, 0.5)
    first = sensors.q.copy()
    sensors.v = v
    sensors.checks.forget()
    sensors.measure()
    sensors.move(v, ticks=ticks)
    last = sensors.q.copy()
    sensors.q = sensors.q + unit(0, 0.3)
    assert "jumps" in sensors.measure()
    oldest, newest = (max(first[0], last[0] - 0.5 * t) for t in (0.064, 0.028))
    assert SETTINGS.detection_time == 0.03
    assert oldest - 1e-9 <= sensors.checks.last_valid[0] <= newest + 1e-9


def test_jump_is_found_at_any_measured_velocity():
    """A velocity computed from the positions does not make a jump plausible."""
    sensors = Sensors()
    v = unit(0, 0.3 / MS)
    assert "jumps" in sensors.move(v)[0]
    reach = (MS + SETTINGS.jitter) * 1.5 * GuardLimits(ARM, GuardSettings()).speed[0] + TOLERANCE[0]
    for factor, found in ((0.99, False), (1.01, True)):
        sensors = Sensors()
        sensors.v, sensors.q = v, sensors.q + unit(0, factor * reach)
        assert ("jumps" in sensors.measure()) == found


def test_late_measurement_may_differ_more():
    sensors = Sensors()
    v = unit(0, 3.0)
    sensors.move(0.5 * v, ticks=5)
    sensors.q, sensors.v = sensors.q + 0.015 * v, v
    assert sensors.measure(dt=0.010) == ""  # 5 ms of jitter


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("speed", [-1.0, 0.5, 2.0])
@pytest.mark.parametrize(("measured", "relative"), [("stuck", 1.0), ("inverted", 2.0), ("zero", 1.0), ("double", 1.0)])
def test_inconsistent_velocity_is_found(joint, speed, measured, relative):
    sensors = Sensors()
    v, q0 = unit(joint, speed), sensors.q.copy()
    q = (lambda q: q0) if measured == "stuck" else None
    factor = {"stuck": 1.0, "inverted": -1.0, "zero": 0.0, "double": 2.0}[measured]
    fault, ticks = sensors.move(v, ticks=1000, measured_q=q, measured_v=lambda v: factor * v)
    # The difference grows with `relative` times the speed and decays with the time constant T.
    seen = abs(factor * speed)
    T = SETTINGS.velocity_memory
    allowed = TOLERANCE[joint] + T * SETTINGS.velocity_counts * COUNTS[joint] + SETTINGS.velocity_delay * seen
    if measured != "stuck" and joint >= N - 3:  # a coarse encoder, whose position also changes
        scale = SETTINGS.velocity_delay + SETTINGS.velocity_scale * T
        allowed = min(allowed, TOLERANCE[joint] + 3 * COUNTS[joint] + scale * seen)
    if allowed > 0.99 * relative * abs(speed) * T:  # a coarse encoder at a low speed
        assert (fault, COUNTS[joint] > 1e-3) == ("", True)
        return
    assert fault == f"{ARM.joint_names[joint]}: position and velocity disagree"
    expected = -T * np.log(1 - allowed / (relative * abs(speed) * T))
    assert MS * ticks == pytest.approx(expected, abs=4 * MS)


@pytest.mark.parametrize(
    ("arm", "smallest"),
    [
        (ARM, [0.073, 0.073, 0.078, 0.100, 0.185, 0.185, 0.304]),
        (PSM, [0.068, 0.068, 0.0070, 0.103, 0.090, 0.115, 0.124]),
    ],
)
def test_smallest_detected_drift(arm, smallest):
    """Checks the table of docs/safety.md: drift of a position with zero measured velocity [rad/s, m/s]."""
    for joint, drift in enumerate(smallest):
        for share, found in ((0.95, False), (1.05, True)):
            rate = share * drift * np.eye(arm.num_joints)[joint]
            fault, _ = Sensors(arm).move(rate, ticks=1500, measured_v=np.zeros_like)
            assert bool(fault) == found, (arm.joint_names[joint], share)


def test_filtered_velocity_is_plausible():
    """A first-order filter of 30 Hz, as in the arm files, at up to 0.4 of the speed limit in both directions."""
    sensors = Sensors()
    limit = GuardLimits(ARM, GuardSettings()).speed
    filtered = np.zeros(N)
    for k in range(600):
        v = 0.4 * limit * np.sin(2 * np.pi * k * MS / 0.3)
        sensors.q, filtered = sensors.q + MS * v, filtered + MS / 0.0053 * (v - filtered)
        assert sensors.measure(v=filtered) == ""


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("side", [-1, 1])
def test_constant_position_under_changing_effort_is_frozen(joint, side):
    time = SETTINGS.frozen_time + COUNTS[joint] / SETTINGS.frozen_speed
    share = min(SETTINGS.frozen_effort + COUNTS[joint] / SETTINGS.frozen_deflection, 0.45)
    for factor, found in ((0.99, False), (1.01, True)):
        sensors = Sensors()
        sensors.move(np.zeros(N), ticks=1000)  # the joint was at rest before
        sensors.effort = unit(joint, side * factor * share * LIMIT[joint])
        fault, ticks = sensors.move(np.zeros(N), ticks=500)
        assert ("does not change although" in fault) == found
        np.testing.assert_array_equal(sensors.checks.invalid, unit(joint).astype(bool) & found)
        if found:
            assert fault.startswith(ARM.joint_names[joint])
            assert MS * ticks == pytest.approx(time, abs=1.5 * MS)


def test_frozen_prismatic_joint_is_found():
    count = PSM.encoder_counts()[2]
    share = SETTINGS.frozen_effort + count / (0.1 * SETTINGS.frozen_deflection)
    for factor, found in ((0.999, False), (1.001, True)):
        sensors = Sensors(PSM)
        sensors.move(np.zeros(N), ticks=1000)
        sensors.effort = unit(2, factor * share * PSM.effort_limits[2])
        fault, _ = sensors.move(np.zeros(N), ticks=500)
        assert fault == found * f"{PSM.joint_names[2]}: the position does not change although the effort does"


def test_joint_moving_by_a_count_is_not_frozen():
    sensors = Sensors()
    start, share = sensors.q.copy(), np.minimum(SETTINGS.frozen_effort + COUNTS / SETTINGS.frozen_deflection, 0.45)
    for k in range(1000):
        effort = 0.9 * np.sin(0.005 * k)
        sensors.effort = effort * LIMIT
        sensors.q = start + COUNTS * np.round(1.1 * effort / share)
        assert sensors.measure() == ""


def test_gravity_of_moving_joints_freezes_no_other_joint():
    """The effort follows the gravity effort, which changes with the positions of the other joints."""
    sensors = Sensors(model=Heavy())
    v = np.where(np.arange(N) < 3, 0.0, 0.5)
    for _ in range(1000):
        sensors.q = sensors.q + MS * v
        sensors.effort = Heavy().gravity_effort(sensors.q)
        assert sensors.measure(v=v) == ""


class Light(Weightless):
    """Model whose joints accelerate by 300 rad/s^2 at their effort limits."""

    def mass_matrix(self, q):
        return np.diag(LIMIT / 300.0)


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize(("effort", "friction"), [(1.0, 0.0), (0.7, 0.1), (0.09, 0.0)])
def test_acceleration_against_the_effort_is_found(joint, effort, friction):
    """Inverted encoder. Friction reduces the acceleration."""
    for sign, found in ((1, False), (-1, effort > SETTINGS.opposed_effort)):
        sensors, fault, ticks = Sensors(model=Light()), "", 0
        sensors.effort = unit(joint, effort * LIMIT[joint])
        while not fault and ticks < 100:
            sensors.v = sensors.v + sign * MS * 300.0 * unit(joint, effort - friction)
            sensors.q, ticks = sensors.q + MS * sensors.v, ticks + 1
            fault = sensors.measure()
        assert fault == f"{ARM.joint_names[joint]}: the motion does not follow from the effort" * found
        assert sensors.checks.invalid[joint] == found
        assert not found or ticks < 60


@pytest.mark.parametrize("damping", [0.0, 0.4, 0.8])
def test_held_joint_may_be_shaken(damping):
    """A hand moves a joint at 4 Hz against a spring and a damper. The inertial effort is 0.6 of the limit."""
    sensors, omega = Sensors(model=Light()), 8 * np.pi
    for k in range(1000):
        phase = omega * MS * k
        sensors.v = 180.0 / omega * min(phase / 6, 1.0) * np.sin(phase) * np.ones(N)
        sensors.q = sensors.q + MS * sensors.v
        sensors.effort = LIMIT * (0.4 * np.cos(phase) - damping * np.sin(phase)) * min(phase / 6, 1.0)
        assert sensors.measure() == "", k


@pytest.mark.parametrize("damping", [0.1, 0.5])
def test_hand_may_let_go_of_a_pressed_joint(damping):
    """A hand slowly deflects a joint against its controller, up to 0.9 of the effort limit, and lets go."""
    sensors, stiffness, inertia = Sensors(model=Light()), 10.0 * LIMIT, LIMIT / 300.0
    start, kd = sensors.q, 2.0 * damping * np.sqrt(stiffness * inertia)
    for k in range(1500):
        sensors.effort = -stiffness * (sensors.q - start) - kd * sensors.v
        if k < 1000:
            sensors.v = np.full(N, 0.09 * np.pi / 2 * np.sin(np.pi * MS * k))
        else:
            sensors.v = sensors.v + MS * sensors.effort / inertia
        sensors.q = sensors.q + MS * sensors.v
        assert sensors.measure() == "", k


def test_slowly_growing_model_error_is_accepted():
    sensors = Sensors()
    v = COUNTS / MS  # one count per tick, so that the position is not frozen
    for k in range(2000):
        sensors.effort = 3 * LIMIT * min(k / 1000, 1.0)
        assert sensors.move(v, ticks=1)[0] == ""


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize(("commanded", "measured"), [(0.3, -0.5), (-0.4, 0.2), (0.4, 1.6), (0.4, 0.6), (0.1, -0.1)])
def test_wrong_measured_effort_is_found(joint, commanded, measured):
    sensors, difference = Sensors(), abs(commanded * (1 - measured))
    sensors.commanded = unit(joint, commanded * LIMIT[joint])
    sensors.effort = measured * sensors.commanded + 1e-9
    fault, ticks = sensors.move(COUNTS / MS, ticks=400)
    allowed = SETTINGS.tracking_error + SETTINGS.tracking_scale * abs(commanded)
    assert not sensors.checks.invalid.any()  # the position is valid
    if difference < allowed:
        assert fault == ""
        return
    assert fault == f"{ARM.joint_names[joint]}: the measured effort does not follow the commanded effort"
    assert MS * ticks == pytest.approx(-SETTINGS.tracking_time * np.log(1 - allowed / difference), abs=2 * MS)


@pytest.mark.parametrize("joint", JOINTS)
def test_effort_of_exactly_zero_is_found(joint):
    for commanded, found in ((0.019, False), (0.021, True), (-0.021, True)):
        sensors = Sensors()
        sensors.commanded = unit(joint, commanded * LIMIT[joint])
        fault, ticks = sensors.move(COUNTS / MS, ticks=100)
        assert ("does not follow the commanded" in fault) == found
        assert not found or MS * ticks == pytest.approx(SETTINGS.zero_time, abs=1.5 * MS)


@pytest.mark.parametrize("is_commanded", [False, True])
def test_failed_effort_sensor_keeps_the_position_valid(is_commanded):
    """A failed effort sensor looks like a change of effort without a change of position."""
    sensors = Sensors()
    sensors.effort = 0.4 * LIMIT
    sensors.checks.forget()
    sensors.commanded = sensors.effort if is_commanded else None
    assert sensors.move(np.zeros(N), ticks=400)[0] == ""
    sensors.effort = np.zeros(N)
    faults = [sensors.move(np.zeros(N))[0] for _ in range(400)]
    assert set(faults) <= {
        "",
        f"{', '.join(ARM.joint_names)}: the measured effort does not follow the commanded effort",
    }
    assert any(faults) == is_commanded
    assert not sensors.checks.invalid.any()


def test_effort_in_hold_is_not_compared():
    """In HOLD the guard commands no efforts, and the time restarts afterwards."""
    sensors = Sensors()
    for _ in range(10):
        sensors.commanded = unit(0, 0.9 * LIMIT[0])
        assert sensors.move(np.zeros(N), ticks=round(0.7 * SETTINGS.zero_time / MS))[0] == ""
        sensors.commanded = None
        assert sensors.move(np.zeros(N), ticks=1)[0] == ""


def test_efforts_that_are_zero_now_and_then_are_plausible():
    """The time of the measured zeros restarts with each measured effort."""
    sensors = Sensors()
    sensors.commanded = 0.05 * LIMIT
    for _ in range(10):
        for effort, ticks in ((0.0, round(0.7 * SETTINGS.zero_time / MS)), (0.04, 1)):
            sensors.effort = effort * LIMIT
            assert sensors.move(COUNTS / MS, ticks=ticks)[0] == ""


def test_compensated_gravity_is_not_unexplained():
    model = Weightless()
    model.gravity_effort = lambda q: 3 * LIMIT * np.sin(10 * q)
    for sign, found in ((1.0, False), (-1.0, True)):
        sensors, fault = Sensors(model=model), ""
        sensors.effort = sign * model.gravity_effort(sensors.q)
        sensors.checks.forget()
        sensors.measure()
        for _ in range(300):
            sensors.effort = sign * model.gravity_effort(sensors.q + MS)
            fault = fault or sensors.move(np.ones(N), ticks=1)[0]
        assert ("does not follow" in fault) == found


def test_delayed_measured_effort_is_plausible():
    sensors = Sensors()
    for k in range(500):
        sensors.commanded = 0.9 * LIMIT * np.sin(0.02 * k)
        sensors.effort = 0.9 * LIMIT * np.sin(0.02 * (k - 5) * (k > 5))
        assert sensors.move(COUNTS / MS)[0] == ""


def test_prismatic_joints_use_a_tenth_of_the_tolerance():
    checks = Sensors(PSM)
    checks.q = checks.q + 0.0012 * np.eye(7)[2]
    assert checks.measure() == f"{PSM.joint_names[2]}: the position jumps"


# In the guard


@pytest.mark.parametrize("mode", [Command.HOLD, Command.POSITION, Command.EFFORT])
@pytest.mark.parametrize("joint", JOINTS)
def test_invalid_joint_gets_gravity_effort_others_are_held(mode, joint):
    bench = Bench(model=Inert(), checks=True).at_rest()
    bench.run(mode, 300)
    bench.q = Q + unit(joint, 0.3)
    output = bench.tick()
    assert bench.guard.fault_code == Status.FAULT_IMPLAUSIBLE
    assert (bench.guard.fault_text, output.control_mode) == (
        f"{ARM.joint_names[joint]}: the position jumps",
        Command.EFFORT,
    )
    np.testing.assert_array_equal(output.joint_flags & Status.FLAG_IMPLAUSIBLE != 0, unit(joint).astype(bool))
    gravity = Heavy().gravity_effort(Q)
    np.testing.assert_allclose(output.effort, gravity, rtol=0, atol=1e-12)
    # All other joints are regulated within 0.3 of their effort limits. The faulty joint has no feedback.
    stiffness, _ = bench.guard.limits.safe_gains(ARM, Inert())
    others = np.arange(N) != joint
    for away in (1e-3, -1e-3, 9e-3):
        bench.q = Q + unit(joint, 0.3) + away
        effort = bench.tick().effort
        assert effort[joint] == pytest.approx(gravity[joint], abs=1e-12)
        moved = Heavy().gravity_effort(np.where(others, bench.q, Q))
        expected = np.clip(moved - stiffness * away, -0.3 * LIMIT, 0.3 * LIMIT)
        np.testing.assert_allclose(effort[others], expected[others], rtol=0, atol=1e-9)


# On recordings of real arms


@pytest.mark.parametrize(
    ("name", "file"), [("mtml", "mtm_one.csv"), ("mtmr", "mtm_earlier_day.csv"), ("psm", "psm_one_205g_insertion.csv")]
)
def test_no_false_alarms_on_recordings_of_real_arms(shared_data, name, file):
    """No check finds a fault with the nominal model at 200 Hz, despite model errors and late rows."""
    arm = load_arm(name)
    recording = read_recording(shared_data / "trajectories" / file, arm).in_joint_coordinates(arm)
    model = ControlModel(IdentifiedModel.from_arm(arm, arm.effects.cables + arm.effects.springs))
    speed, true = GuardLimits(arm, GuardSettings()).speed, true_time(recording)
    # The rows as recorded, then without repeated rows and with the true times of the other rows.
    for rows, t in ((np.arange(len(recording)), recording.t), (true.rows, true.t)):
        checks = Plausibility(arm, model, SETTINGS, speed)
        for row, dt in zip(rows, np.diff(t, prepend=t[0]), strict=True):
            q, v, effort = (np.ascontiguousarray(x[row]) for x in (recording.q, recording.qd, recording.tau))
            assert checks.check(dt, q, v, effort, None) == "", recording.where(row)


def test_motion_during_a_gap_is_accepted():
    for gap, fault in ((50, Status.FAULT_IMPLAUSIBLE), (150, Status.FAULT_NONE)):
        bench = Bench(checks=True)
        bench.tick(10)
        bench.utime += 1000 * gap
        bench.q = Q + 0.05
        bench.tick()
        assert bench.guard.fault_code == fault


def test_reset_marks_position_as_valid():
    bench = Bench(model=Heavy(), checks=True).at_rest()
    bench.q = Q + unit(3, 0.3)
    assert bench.tick().control_mode == Command.EFFORT
    bench.run(Command.HOLD, 1)
    output = bench.run(Command.HOLD, 1, reset_fault=True)
    assert (output.control_mode, bench.guard.fault_code) == (Command.HOLD, Status.FAULT_NONE)
    np.testing.assert_array_equal(output.position, bench.q)
    assert not np.any(bench.tick(100).joint_flags)
    # Another joint fails later. The first joint is then held again.
    bench.q = bench.q + unit(0, 0.3)
    np.testing.assert_array_equal(bench.tick().joint_flags & Status.FLAG_IMPLAUSIBLE != 0, unit(0).astype(bool))


def test_second_invalid_joint_gets_no_feedback():
    bench = Bench(model=Heavy(), checks=True).at_rest()
    for joint, flags in ((2, [2]), (5, [2, 5])):
        bench.q = bench.q + unit(joint, 0.3)
        output = bench.tick()
        assert np.flatnonzero(output.joint_flags & Status.FLAG_IMPLAUSIBLE).tolist() == flags
        # The gravity effort uses the last valid positions of both joints.
        np.testing.assert_allclose(output.effort, Heavy().gravity_effort(Q), rtol=0, atol=1e-12)
        bench.tick(50)


def test_arm_without_power_is_not_checked():
    bench = Bench(checks=True, modes=(Command.OFF,))
    bench.run(Command.HOLD, 1)
    bench.run(Command.OFF, 1)
    for _ in range(10):
        bench.q = bench.q - unit(4, 0.1)  # the arm falls and is held
        assert bench.tick().control_mode == Command.OFF
    assert bench.guard.fault_code == Status.FAULT_NONE
    bench.run(Command.HOLD, 100)
    assert bench.guard.fault_code == Status.FAULT_NONE


def test_saturated_coupled_actuators_are_plausible():
    """The full elbow effort also loads the shoulder's actuator, which saturates: tau_2 = 1.464 - 1.753."""
    sensors = Sensors()
    sensors.commanded = np.array([0.0, 0.35, -1.0, 0.0, 0.0, 0.0, 0.0]) * LIMIT
    sensors.effort = np.array([0.0, 1.464 - 1.753, -1.753, 0.0, 0.0, 0.0, 0.0])
    assert sensors.move(COUNTS / MS, ticks=200)[0] == ""
    # A measured effort of zero is still detected if the actuators can apply the effort.
    sensors.commanded = 0.4 * LIMIT * unit(1)
    sensors.effort = np.zeros(N)
    assert "does not follow the commanded effort" in sensors.move(COUNTS / MS, ticks=200)[0]


def test_arm_without_encoder_counts_uses_tolerance_only():
    exact = dataclasses.replace(ARM, effects=ARM.effects.without("encoder"))
    for factor, found in ((0.99, False), (1.01, True)):
        sensors = Sensors(exact)
        sensors.q = sensors.q + unit(6, factor * SETTINGS.position_tolerance)
        assert ("jumps" in sensors.measure()) == found


def test_effort_after_power_on_is_plausible():
    sensors = Sensors()
    sensors.move(np.zeros(N), ticks=100)
    sensors.effort = 0.9 * LIMIT
    assert sensors.move(np.zeros(N), ticks=1000)[0] == ""
