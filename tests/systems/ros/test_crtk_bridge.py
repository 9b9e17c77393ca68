"""Bridge to a dVRK with a substitute client, without DDS. The test sets the clocks."""

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs cyclonedds")

from crtk_bench import ARMS, MS, CrtkBench

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.lcm_messages import MessageKey, create_key_file
from dvrk_drake.systems.ros.discovery import END_OTHER_PROCESS

HOME = "/MTML: switched off the dVRK's own gravity compensation"


@pytest.fixture
def bench(monkeypatch):
    return CrtkBench(monkeypatch)


def allows_efforts(bench):
    return bool(bench.status.accepted_modes >> Command.EFFORT & 1)


def test_holds_the_first_pose_with_servo_jp(bench):
    bench.ready()
    assert bench.sent[0] == ("use_gravity_compensation", False)
    assert set(bench.names()[1:]) == {"servo_jp"}
    for _, position in bench.sent[1:]:
        np.testing.assert_array_equal(position, bench.q)
    assert bench.lines == [HOME, "hold: the rate of /MTML/measured_js is not known yet", "hold"]


def test_nothing_happens_before_the_first_measurement(bench):
    for _ in range(1000):
        bench.now += MS
        bench.bridge.update()
    assert bench.sent == bench.statuses == bench.lines == []
    bench.tick()
    assert bench.status.guard_state == Status.STATE_HOLD


def test_efforts_are_published_within_limits(bench):
    bench.started().clear()
    effort = 0.05 * ARMS["mtml"].effort_limits
    bench.run(100, effort=effort.tolist())
    assert set(bench.names()) == {"servo_jf"}
    np.testing.assert_allclose(bench.sent[-1][1], effort, rtol=0, atol=1e-12)
    np.testing.assert_allclose(bench.status.effort_commanded, effort, rtol=0, atol=1e-12)
    bench.run(5, effort=[1e9] * 7)
    assert all(np.all(np.abs(values) <= ARMS["mtml"].effort_limits) for _, values in bench.sent)


def test_positions_are_published_on_servo_jp(bench):
    bench.started(Command.POSITION).clear()
    goal = bench.q + 0.002
    bench.run(50, Command.POSITION, position=goal.tolist())
    assert set(bench.names()) == {"servo_jp"}
    np.testing.assert_allclose(bench.sent[-1][1], goal, rtol=0, atol=1e-12)


def test_silent_controller_leads_to_hold(bench):
    bench.started()
    bench.q = bench.q + 0.001
    bench.run(20).clear()
    bench.tick(60)
    assert bench.names()[0] == "servo_jf" and bench.names()[-1] == "servo_jp"
    # The last answer is at most 50 ms old.
    assert bench.names().count("servo_jf") <= 50
    np.testing.assert_array_equal(bench.sent[-1][1], bench.q)
    assert bench.status.fault_code == Status.FAULT_NONE


def test_answer_is_stepped_at_most_once_per_measurement(bench):
    bench.started().clear()
    num_statuses = len(bench.statuses)
    bench.tick()
    for _ in range(5):
        bench.now += MS // 20
        bench.bridge.put(bench.command())
        bench.bridge.update()
    assert bench.names() == ["servo_jf"]
    assert len(bench.statuses) == num_statuses + 1
    # The other answers were not lost.
    before = bench.status.num_accepted
    bench.tick(2)
    assert bench.status.num_accepted + bench.status.num_refused >= before + 4


def test_unanswered_efforts_are_published_one_period_later(bench):
    bench.started().clear()
    bench.tick()
    assert bench.names() == []
    bench.tick(3)
    assert bench.names() == ["servo_jf"] * 3


def test_hold_of_another_process_ends_efforts(bench):
    bench.started().clear()
    bench.client.other_hold = True
    bench.tick(2)
    assert bench.status.guard_state == Status.STATE_HOLD
    assert bench.status.fault_text.startswith("another process published hold")
    assert set(bench.names()) == {"servo_jp"}


def test_update_without_message_acts_after_five_ms(bench):
    bench.ready().clear()
    num_statuses = len(bench.statuses)
    for _ in range(4):
        bench.now += MS
        bench.bridge.update()
    assert not bench.sent and len(bench.statuses) == num_statuses
    utime, sequence = bench.status.utime, bench.status.sequence
    bench.now += MS
    bench.bridge.update()
    # The status repeats the measurement with its time.
    assert (bench.status.utime, bench.status.sequence) == (utime, sequence + 1)
    assert bench.names() == ["servo_jp"]


def test_missing_measurements_are_a_fault(bench):
    bench.started()
    for _ in range(400):
        bench.now += MS
        bench.bridge.update()
    assert bench.status.guard_state == Status.STATE_FAULT
    assert "s old; allowed: 0 to 0.02 s" in bench.status.fault_text
    assert not allows_efforts(bench)
    assert "servo_jf" not in bench.names()[-10:]


@pytest.mark.parametrize(
    "reason", ["operating_state is DISABLED", "operating_state is FAULT", "operating_state is ENABLED, but ..."]
)
def test_arm_that_is_not_enabled_gets_no_command(bench, reason):
    bench.started().clear()
    bench.client.not_ready_reason = reason
    bench.run(50)
    # The state may be that of another process, so the last effort must not act on.
    assert bench.names() == ["hold"]
    bench.clear()
    assert (bench.status.guard_state, bench.status.fault_text) == (Status.STATE_FAULT, f"/MTML: {reason}")
    # The arm is enabled again, in another pose. Nothing is commanded until the reset.
    bench.client.not_ready_reason = ""
    bench.q = bench.q + 0.2
    bench.run(50)
    assert bench.names() == ["use_gravity_compensation"]
    assert bench.lines.count(HOME) == 2
    bench.reset().clear()
    bench.tick(10)
    assert set(bench.names()) == {"servo_jp"}
    np.testing.assert_array_equal(bench.sent[-1][1], bench.q)


def test_second_publisher_is_a_fault_as_long_as_it_exists(bench):
    bench.started().clear()
    bench.client.others, bench.client.domain.num_changes = ["/MTML/servo_jf", "/MTML/servo_jp"], 1
    # The check follows the answer, so the fault ends the efforts in the next period.
    bench.run(1)
    bench.clear()
    bench.run(10)
    assert set(bench.names()) == {"servo_jp"}
    assert bench.status.fault_text == "another process publishes /MTML/servo_jf, /MTML/servo_jp. " + END_OTHER_PROCESS
    bench.reset()
    assert bench.status.guard_state == Status.STATE_FAULT
    # The other process has moved the arm. After its end, the arm stays where it is.
    bench.q = bench.q + 0.3
    bench.client.others, bench.client.domain.num_changes = [], 2
    bench.clear()
    bench.run(50)
    assert set(bench.names()) == {"hold"} and bench.client.num_read_again == 1
    bench.reset().clear()
    assert bench.status.guard_state == Status.STATE_HOLD
    bench.tick(10)
    assert set(bench.names()) == {"servo_jp"}
    np.testing.assert_array_equal(bench.sent[-1][1], bench.q)


@pytest.mark.parametrize(
    ("rate", "accepted"), [(100.0, False), (450.0, False), (499.0, True), (500.0, True), (1000.0, True)]
)
def test_low_rate_refuses_efforts(monkeypatch, rate, accepted):
    bench = CrtkBench(monkeypatch, period=1e3 / rate).ready()
    assert allows_efforts(bench) == accepted
    text = (
        f"/MTML/measured_js arrives at {rate:.0f} Hz; commands need 500 Hz. Start the dVRK's console with a period of "
        "1 ms: dvrk_system -j FILE.json -p 0.001"
    )
    assert bench.status.fault_text == ("" if accepted else text)
    assert bench.status.guard_state == Status.STATE_HOLD
    assert set(bench.names()[1:]) == {"servo_jp"}


def test_rate_that_drops_ends_efforts(bench):
    bench.started()
    bench.period = 5.0
    bench.run(120)
    assert bench.status.guard_state == Status.STATE_HOLD
    assert bench.status.fault_text.startswith("/MTML/measured_js arrives at 196 Hz; commands need 500 Hz")
    lines = len(bench.lines)
    bench.run(200)
    assert len(bench.lines) == lines, "a text that changes with each measurement fills the terminal"


def test_reason_of_the_caller_refuses_and_ends_efforts(bench):
    bench.started().clear()
    bench.blocked = "the deadman process has ended. Restart the bridge"
    bench.run(5)
    assert set(bench.names()) == {"servo_jp"}
    assert bench.status.fault_text == bench.blocked


@pytest.mark.parametrize(
    ("effort", "text"),
    [
        (None, "no valid message on /MTML/gravity_compensation/setpoint_js, so the dVRK's own gravity compensation"),
        (0.1, "the dVRK's own gravity compensation is on: /MTML/gravity_compensation/setpoint_js is not zero"),
    ],
)
def test_unverified_gravity_compensation_ends_efforts(monkeypatch, effort, text):
    bench = CrtkBench(monkeypatch)
    bench.client.gravity_after_switch = effort
    bench.ready()
    assert not allows_efforts(bench)
    assert bench.status.fault_text.startswith(text)
    assert bench.status.gravity_compensation == (effort is not None)
    acting = CrtkBench(monkeypatch).started()
    acting.clear()
    acting.client.gravity_compensation = acting.client.gravity_after_switch = effort
    lines = len(acting.lines)
    for k in range(50):
        if effort is not None:
            acting.client.gravity_compensation = effort + 0.01 * k
        acting.run(1)
    assert set(acting.names()) == {"servo_jp"}
    assert len(acting.lines) == lines + 1


def test_gravity_compensation_of_a_psm_is_not_required(monkeypatch):
    bench = CrtkBench(monkeypatch, "psm")
    bench.client.gravity_after_switch = None
    assert allows_efforts(bench.ready())


def test_jaw_is_commanded_on_change_only_and_before_the_arm(monkeypatch):
    bench = CrtkBench(monkeypatch, "psm").started()
    bench.run(100).clear()
    bench.run(300)
    assert set(bench.names()) == {"servo_jf"}
    limit = ARMS["psm"].effort_limits[6]
    for share in (0.02, 0.025, 0.2):
        bench.clear()
        bench.run(60, effort=[0.0] * 6 + [share * limit])
        jaws = [k for k, name in enumerate(bench.names()) if name == "separate/servo_jf"]
        if share == 0.025:
            assert not jaws, "the change is smaller than 1 % of the limit"
        else:
            assert all(bench.names()[k + 1] == "servo_jf" for k in jaws)
            assert abs(bench.sent[jaws[-1]][1] - share * limit) <= 0.01 * limit
            assert len(jaws) <= 40


def test_jaw_is_commanded_again_after_a_change_of_the_mode(monkeypatch):
    bench = CrtkBench(monkeypatch, "psm").ready()
    first = [name for name in bench.names() if name.startswith("separate")]
    assert first == ["separate/servo_jp"]
    assert bench.names().index("separate/servo_jp") < bench.names().index("servo_jp")
    bench.run(300)
    assert [name for name in bench.names() if name.startswith("separate")] == [*first, "separate/servo_jf"]
    bench.tick(60)
    assert bench.names().count("separate/servo_jp") == 2


def test_implausible_joints_lead_to_few_hold_messages(bench):
    bench.started()
    bench.problem = "/MTML/measured_js: a position or velocity is not finite"
    bench.run(30).clear()
    bench.run(1000)
    assert bench.status.guard_state == Status.STATE_FAULT
    assert set(bench.names()) == {"hold"}
    assert 9 <= len(bench.names()) <= 11
    assert bench.lines.count(bench.problem) == 1
    assert np.isnan(bench.status.position).all()


def test_one_implausible_joint_gets_only_gravity_efforts_or_hold(bench):
    bench.started()
    bench.q = np.add(bench.q, [0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    bench.tick(5).clear()
    bench.tick(50)
    assert "elbow_pitch: the position jumps" in bench.status.fault_text
    assert set(bench.names()) == {"servo_jf"}
    assert all(np.all(np.abs(values) <= ARMS["mtml"].effort_limits) for _, values in bench.sent)
    # With the gravity compensation of the dVRK, efforts would act twice.
    bench.client.gravity_compensation = 0.3
    bench.clear()
    bench.tick(200)
    assert set(bench.names()) == {"hold"}
    assert len(bench.names()) <= 3


def test_jump_of_the_stamp_ends_efforts_with_one_line(bench):
    bench.started()
    bench.stamp_offset = 3600 * 10**9
    bench.run(2)
    assert bench.lines.count("/MTML/measured_js: the time stamp changed by 3600.001 s since the previous message") == 1
    assert bench.status.guard_state == Status.STATE_HOLD
    assert (
        bench.status.fault_text
        == ", ".join(ARMS["mtml"].joint_names) + ": the measured position or velocity is not a finite number"
    )
    bench.tick(150)
    bench.reset()
    assert allows_efforts(bench)


def test_problems_that_change_are_reported_once_per_second(bench):
    bench.ready()
    lines = len(bench.lines)
    for k in range(500):
        bench.problem = f"/MTML/measured_js has the joints x{k}"
        bench.tick()
    assert len([line for line in bench.lines[lines:] if "has the joints" in line]) == 1


def test_off_disables_the_arm(monkeypatch):
    bench = CrtkBench(monkeypatch, modes=("position", "effort", "off")).ready()
    bench.run(1, Command.HOLD).clear()
    bench.run(50, Command.OFF)
    assert bench.names()[0] == "servo_jp"
    assert bench.sent[1:] == [("state_command", "disable")]


def test_status_describes_the_measurement(bench):
    bench.ready()
    status = bench.status
    assert (status.arm_name, status.num_joints) == ("MTML", 7)
    np.testing.assert_array_equal(status.position, bench.q)
    np.testing.assert_array_equal(status.effort_measured, bench.effort)
    assert status.utime == (bench.time_ns()) // 1000
    assert np.all(np.diff([s.sequence for s in bench.statuses]) == 1)
    assert np.all(np.diff([s.utime for s in bench.statuses]) > 0)
    assert not status.gravity_compensation


def test_key_signs_statuses_and_verifies_commands(monkeypatch, tmp_path):
    key_file = tmp_path / "key"
    create_key_file(key_file)
    key = MessageKey.load(key_file)
    bench = CrtkBench(monkeypatch, key_file=key_file).ready()
    assert key.verify(bench.raw[-1])
    bench.run(10)
    assert (bench.status.num_accepted, bench.status.ignored_code) == (0, Status.REFUSAL_NOT_AUTHENTIC)
    for _ in range(10):
        bench.tick()
        bench.bridge.put(key.sign(bench.command()))
        bench.bridge.update()
    assert bench.tick().status.num_accepted == 10


@pytest.mark.parametrize("delay", [21, 35, 100])
def test_late_effort_ends_in_hold_of_arm_and_jaw(monkeypatch, delay):
    bench = CrtkBench(monkeypatch, "psm").started()
    servo_jf = bench.client.servo_jf

    def suspended(effort):
        bench.now += delay * MS
        servo_jf(effort)

    monkeypatch.setattr(bench.client, "servo_jf", suspended)
    bench.clear()
    bench.run(1)
    monkeypatch.setattr(bench.client, "servo_jf", servo_jf)
    bench.run(400)
    # `hold` ended the effort control of the arm and of its jaw, so efforts must not continue without an operator.
    assert bench.status.guard_state == Status.STATE_HOLD
    assert bench.status.fault_text == f"the bridge was suspended for {delay} ms while it published an effort"
    assert bench.names()[:4] == ["servo_jf", "hold", "separate/servo_jp", "servo_jp"]
    assert set(bench.names()[4:]) == {"servo_jp"}
    bench.clear()
    bench.reset().run(300)
    assert bench.status.guard_state == Status.STATE_EFFORT
    assert bench.names().count("separate/servo_jf") == 1


def test_jaw_is_commanded_again_after_hold_of_another_process(monkeypatch):
    bench = CrtkBench(monkeypatch, "psm").ready()
    bench.clear()
    bench.client.other_hold = True
    bench.tick(2)
    assert bench.names()[:2] == ["separate/servo_jp", "servo_jp"]


def test_jaw_is_commanded_again_after_hold_in_a_fault(monkeypatch):
    bench = CrtkBench(monkeypatch, "psm").started()
    bench.q = np.add(bench.q, [0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    bench.tick(5).clear()
    bench.blocked = "the deadman process has ended"
    bench.tick(2)
    assert bench.names() == ["hold"]
    bench.blocked = ""
    bench.clear()
    bench.tick(2)
    assert bench.names()[:2] == ["separate/servo_jf", "servo_jf"]


def test_close_publishes_hold_and_ends_the_deadman(bench):
    bench.started().clear()
    bench.bridge.close()
    assert bench.names() == ["hold"]
    assert bench.lines[-1] == "deadman ended"
    assert "PRESS" not in "".join(bench.lines)


def test_deadman_repeats_a_hold_that_is_not_confirmed(bench):
    bench.started().clear()
    bench.client.confirms = False
    bench.bridge.close()
    problem = "/MTML: the arm did not confirm hold. PRESS THE STOP BUTTON"
    assert bench.lines[-2:] == [problem, "deadman repeats hold"]


def test_deadman_repeats_a_hold_that_cannot_be_published(bench, monkeypatch):
    def fail():
        raise DvrkDrakeError("/MTML/hold: the message could not be sent")

    monkeypatch.setattr(bench.client, "hold", fail)
    with pytest.raises(DvrkDrakeError):
        bench.bridge.close()
    assert bench.lines[-1] == "deadman repeats hold"


def test_ten_thousand_random_messages_command_nothing(bench):
    bench.ready().clear()
    generator, pose = np.random.default_rng(3), bench.q.copy()
    for k in range(10_000):
        valid = bytearray(bench.command(int(generator.integers(-2, 8)), effort=[1.0] * 7))
        if k % 3 == 0:
            data = generator.bytes(int(generator.integers(0, 400)))
        else:
            # The byte of a field that every command needs, or a random byte, is changed.
            for _ in range(generator.integers(1, 6)):
                valid[generator.integers(len(valid))] = generator.integers(256)
            data = bytes(valid[: generator.integers(len(valid))] if k % 3 == 1 else valid)
        bench.bridge.put(data)
        bench.tick()
    assert set(bench.names()) == {"servo_jp"}
    assert all(np.array_equal(values, pose) for _, values in bench.sent)
