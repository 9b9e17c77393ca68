"""Control, reset and release of a guarded arm, with a simulated clock and without a network."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from command_output import assert_refused
from guard_bench import ARM, LIMIT, SESSION, N
from guarded_arm import GuardedArm, after

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.lcm_messages import MessageKey, describe_refusal, status_channel
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.arm_operator import reset_fault
from dvrk_drake.processes.arm_session import Dialog
from dvrk_drake.processes.connection import connect
from dvrk_drake.processes.control import LiveStatus, LiveStatusMaker, control, first_status
from dvrk_drake.systems.lcm.arm_link import LcmArmLink


@pytest.fixture(scope="module")
def controller():
    return ArmController(ARM, IdentifiedModel.from_arm(ARM), "hold", 1e-3)


def pause_controller(link, seconds):
    """Advances the clock as if the controller was stopped for `seconds`."""
    link.utime += round(1e6 * seconds)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("callback", ["on_status", "report", "stopped", "answer"])
def test_error_of_a_callback_releases_the_arm(controller, monkeypatch, callback, error):
    link = GuardedArm()

    def fail(*_):
        if link.guard.state == Status.STATE_EFFORT:
            raise error

    answer, callbacks = controller.answer, dict.fromkeys(("stopped", "report", "on_status"), lambda *_: None)
    if callback == "answer":
        monkeypatch.setattr(controller, "answer", lambda *a: (len(a) > 2 and fail(), answer(*a))[1])
    else:
        callbacks[callback] = fail
    with pytest.raises(type(error)) as raised:
        control(link, controller, *callbacks.values())
    assert raised.value is error
    # The arm holds at once, and no operator must resume.
    assert (link.guard.state, link.guard.hold_reason) == (Status.STATE_HOLD, "")
    assert link.commands[-1].control_mode == Command.HOLD and link.commands[-2].control_mode == Command.EFFORT


LOOK = r"Look at the arm, then start again, over LCM with --reset"


@pytest.mark.parametrize("seconds", [0.02, 0.05, 0.2, 1.0])
def test_stopped_controller_ends_and_operator_resumes(controller, seconds):
    link, output = GuardedArm(), []
    end = link.now() + 2.0
    link.before_step = after(500, lambda: pause_controller(link, seconds))
    if seconds < 0.05:
        control(link, controller, lambda: link.now() > end, lambda status: None)
        return
    reason = (
        rf"guard of MTML holds the arm: the last command expired: .* ms old by the arm's clock.*; .*too slow.*\. {LOOK}"
    )
    assert_refused(ControllerError, reason, control, link, controller, lambda: link.now() > end, lambda status: None)
    assert link.guard.state == Status.STATE_HOLD and link.now() < end
    sent = len(link.commands)
    assert_refused(ControllerError, rf"MTML holds the arm: the last command expired: .*\. {LOOK}", first_status, link)
    assert len(link.commands) == sent
    reset_fault(link, output.append)
    (line,) = output
    assert line.startswith("the guard of MTML held the arm, and the operator resumes now: the last command expired: ")
    first_status(link)
    assert link.guard.hold_reason == ""


def test_takeover_during_release_is_an_error(controller):
    link = GuardedArm()
    end = link.now() + 0.5
    link.before_step = lambda: link.now() > end and link.guard._take_over("its period is 20 ms")
    with pytest.raises(ControllerError, match=rf"the guard of MTML holds the arm: its period is 20 ms\. {LOOK}"):
        control(link, controller, lambda: link.now() > end, lambda status: None)


def test_rejects_constant_status():
    link = GuardedArm()
    status = link.next_status(1.0)
    link.next_status = lambda seconds: status
    assert_refused(ControllerError, "utime or sequence of its status does not increase", first_status, link)


@pytest.mark.parametrize(
    ("measured", "reported", "refused"), [(1, 1, False), (5, 5, False), (10, 10, True), (10, 1, True)]
)
def test_rejects_slow_measurements(measured, reported, refused):
    """Rejects a period above 5 ms. At the 100 Hz of a dVRK, `control --mode hold` oscillates with 0.9 rad."""
    link, count = GuardedArm(), itertools.count()
    good = link.next_status(1.0)

    def next_status(seconds):
        status, milliseconds = Status.decode(good.encode()), reported * next(count)
        status.sequence = good.sequence + milliseconds // reported
        status.utime = good.utime + 1000 * (milliseconds - milliseconds % measured)
        return status

    link.next_status = next_status
    if refused:
        assert_refused(ControllerError, "MTML is measured at 100 Hz; control needs at least 200 Hz", first_status, link)
    else:
        assert first_status(link)[1] == pytest.approx(1e-3 * reported)


@pytest.mark.parametrize("name", ["position", "velocity", "effort_measured"])
def test_rejects_measurements_that_are_not_finite(name):
    link = GuardedArm()
    status = link.next_status(1.0)
    setattr(status, name, [float("nan")] * N)
    link.next_status = lambda seconds: status
    assert_refused(ControllerError, "a measured position, velocity or effort is not finite", first_status, link)


def test_fault_during_release_ends_immediately(controller):
    link = GuardedArm()
    # The first status is that of the beginning.
    link.before_step = after(2, lambda: link.guard.report_fault("the amplifier is hot"))
    began = link.now()
    with pytest.raises(ControllerError, match="has a fault: the amplifier is hot"):
        control(link, controller, lambda: True, lambda status: None)
    assert link.now() - began < 0.01


def test_control_applies_efforts_reports_and_releases(controller):
    link, reports = GuardedArm(), []
    end = link.now() + 1.5
    control(link, controller, lambda: link.now() > end, reports.append)
    assert {status.state for status in reports} >= {"starting", "effort"}
    assert "round trip" in str(reports[-1])
    assert reports[-1].problem == "guard settings weaker than the defaults: tracking_error is 1 (default: 0.1)"
    assert link.guard.state == Status.STATE_HOLD and link.commands[-1].control_mode == Command.HOLD


def test_guide_warns_about_a_model_without_validation(monkeypatch):
    lines = []
    connection = connect(ARM, lcm_url="memq://", dialog=Dialog(report=lines.append))
    made = SimpleNamespace(period=1e-3, sender_id=7)
    monkeypatch.setattr(connection, "start", lambda mode, gains, friction: (made, None))
    monkeypatch.setattr(connection, "control", lambda *arguments, **options: None)
    connection.run("guide")
    assert "warning: the error of the model is unknown" in lines[0] and len(lines) == 2


def test_live_status_describes_new_refusals():
    first, status = Status(), Status()
    first.num_refused, status.num_refused, status.refusal_code = 3, 5, Status.REFUSAL_START_FAR
    status.num_ignored, status.ignored_code, status.num_expired = 1, Status.REFUSAL_NOT_AUTHENTIC, 1
    maker = LiveStatusMaker(7, first)
    live = maker.make(status, 0.2, 0)
    assert live.problem == (
        "refused: start too far from the present efforts or pose, "
        "the arm ignores messages: not signed with the arm's key (--key), "
        "the guard holds the arm because the last command expired"
    )
    assert str(live).endswith(live.problem)
    assert not maker.make(status, 0.4, 0).problem


@pytest.mark.parametrize("transport", ["lcm", "ros"])
def test_run_prints_each_change_once(transport, controller, monkeypatch, capsys):
    """Over ROS 2, the guard in this process prints the changes of its state."""

    def control(link, controller, stopped, report, on_status):
        for state, pace, problem in [
            ("hold", "1 Hz", ""),
            ("hold", "2 Hz", ""),
            ("hold", "3 Hz", "refused: stale"),
        ] * 2:
            report(LiveStatus(state, pace, problem))

    link = SimpleNamespace(close=lambda: None)
    monkeypatch.setattr("dvrk_drake.processes.arm_session.ArmSession.start", lambda *_: (controller, link))
    monkeypatch.setattr("dvrk_drake.processes.arm_session.control", control)
    monkeypatch.setattr("dvrk_drake.processes.simulated_arm.stop_on_signals", lambda: None)
    assert main(["control", "--arm", "mtml", "--transport", transport]) == 0
    output = capsys.readouterr()
    lines = ["hold; 1 Hz", "hold; 3 Hz; refused: stale"] * 2
    assert output.out.splitlines()[1:-1] == (lines if transport == "lcm" else lines[1:])
    assert not output.err


def test_friction_requires_an_identified_model(tmp_path, capsys):
    path = str(tmp_path / "model.yaml")
    IdentifiedModel.from_arm(ARM).save(path)
    assert main(["control", "--arm", "mtml", "--model", path, "--friction-ratio", "0.5"]) == 2
    said = capsys.readouterr().err
    assert "hysteresis ratio requires an identified model" in said and said.count("\n") == 1


def test_live_status_has_rate_and_round_trip():
    maker, status = LiveStatusMaker(7, Status()), Status()
    assert maker.make(status, 0.1, 0).pace == "0 Hz, no command accepted yet, 0 statuses lost"
    maker = LiveStatusMaker(7, Status())
    status.command_sender_id = 7
    for k in range(1, 201):
        status.command_utime = 1000 * (k - 2)
        maker.answer(status, 1e-3 * k)
    assert maker.make(status, 0.2, 4).pace == "1000 Hz, round trip 2.00 ms, 4 statuses lost"


def test_every_refusal_has_a_description():
    codes = [value for name, value in vars(Status).items() if name.startswith("REFUSAL_")]
    words = [describe_refusal(code) for code in codes]
    assert len(set(words)) == len(codes) == max(codes) + 1
    assert not [text for text in words if text.startswith("refusal ")]
    assert describe_refusal(99) == "refusal 99"
    assert np.all(np.diff(sorted(codes)) == 1)


def status_bytes(sequence, session=SESSION, **fields):
    """Returns an encoded status. The time advances by one millisecond per sequence number."""
    status = Status()
    status.arm_name, status.num_joints, status.sequence, status.session_id = ARM.name, N, sequence, session
    status.utime = 10**15 + 1000 * sequence
    for name in ("position", "velocity", "effort_measured", "position_commanded", "effort_commanded"):
        setattr(status, name, [0.0] * N)
    status.joint_flags = [0] * N
    for name, value in fields.items():
        setattr(status, name, value)
    return status.encode()


class Linked:
    """LcmArmLink on a network within this process, with a clock that the test sets."""

    def __init__(self, **arguments):
        self.time, self.link = 0.0, LcmArmLink(ARM, "memq://", **arguments)
        self.link.now = lambda: self.time

    def receive(self, *messages):
        """Returns the status that the link accepts from the messages, or None."""
        for message in messages:
            self.link._lcm.publish(status_channel(ARM), message)
        try:
            return self.link.next_status(0.05)
        except ControllerError as error:
            self.output = str(error)
            return None


@pytest.mark.parametrize("replays", [False, True])
def test_old_statuses_are_ignored(replays):
    """Regression: statuses played from a log on the arm's network made a compensated arm move by 8 rad."""
    linked = Linked(replays=replays)
    assert linked.receive(*map(status_bytes, (100, 3, 101, 4))).sequence == (4 if replays else 101)
    assert linked.link.lost == 0
    assert (linked.receive(status_bytes(4)) is not None) == replays
    assert (linked.receive(status_bytes(1, SESSION + 1)) is not None) == replays


FOREIGN = {
    "another session": (status_bytes(102, SESSION + 1), "1 of another session; MTML was restarted: look at it"),
    "sequence": (status_bytes(2**62, utime=10**15 + 102_000), "1 with a jump of sequence or time"),
    "future": (status_bytes(102, utime=2**62), "1 with a jump of sequence or time"),
    "past": (status_bytes(102, utime=0), "1 with a jump of sequence or time"),
    "negative": (status_bytes(-(2**62), utime=10**15), "1 not newer than the last one"),
    "cut": (status_bytes(102)[:-60], "1 unreadable or of another arm"),
    "other arm": (status_bytes(102, arm_name="PSM"), "1 unreadable or of another arm"),
    "garbage": (b"garbage", "1 not an lcmt_dvrk_status of version 1.0"),
    "empty": (b"", "1 not an lcmt_dvrk_status of version 1.0"),
}


@pytest.mark.parametrize("foreign", FOREIGN)
def test_foreign_statuses_are_reported_if_arm_is_silent(foreign):
    message, output = FOREIGN[foreign]
    linked = Linked()
    assert linked.receive(status_bytes(100), message, status_bytes(101)).sequence == 101
    assert linked.receive(message) is None
    assert "no status of MTML for 0.05 s on DVRK_STATUS_MTML; ignored: " + output in linked.output
    assert linked.receive(message, status_bytes(102)).sequence == 102
    assert linked.link.lost == 0
    assert linked.receive() is None and "DVRK_STATUS_MTML. Check that the process" in linked.output


def test_only_the_checked_session_is_used():
    first = Status.decode(status_bytes(1))
    linked = Linked(before=first)
    assert linked.receive(status_bytes(1, SESSION + 1)) is None and "MTML was restarted" in linked.output
    assert linked.receive(status_bytes(2)).sequence == 2


def test_pause_of_controller_is_no_status_jump():
    linked = Linked()
    linked.receive(status_bytes(100))
    # Two seconds later, some statuses are in the queue and all others were lost.
    linked.time += 2.0
    waited = [status_bytes(sequence) for sequence in (*range(101, 180), 2099, 2100)]
    assert linked.receive(*waited).sequence == 2100
    assert linked.link.lost == 2098 - 179
    # A status that the arm cannot have sent yet is a jump.
    assert linked.receive(status_bytes(2100 + 101)) is None
    assert linked.receive(status_bytes(2100 + 100)).sequence == 2200


def test_key_verifies_statuses_and_signs_commands():
    key, sent = MessageKey(bytes(32)), []
    linked = Linked(key=key)
    signed = key.sign(status_bytes(100))
    corrupted = [signed[:k] + bytes([signed[k] ^ 1]) + signed[k + 1 :] for k in range(32, len(signed))]
    for message in (status_bytes(100), MessageKey(bytes([1] * 32)).sign(status_bytes(100)), *corrupted):
        assert linked.link._filter.accept(message, 0.0) is None
    assert linked.receive(status_bytes(101)) is None
    assert linked.output.endswith("the arm and this process need the same key (--key)")
    assert linked.receive(signed).sequence == 100
    linked.link._lcm.subscribe("DVRK_COMMAND_MTML", lambda channel, data: sent.append(data))
    linked.link.send(Command())
    linked.receive()
    assert key.verify(sent[0]) and sent[0][:-17] == Command().encode()[:-1]
    # A link without a key accepts signed messages.
    assert Linked().receive(signed).sequence == 100


def test_control_ends_if_no_command_is_applied(controller, monkeypatch):
    monkeypatch.setattr("dvrk_drake.processes.control._TIMEOUT", 0.3)
    link = GuardedArm()
    link.status.effort_measured = list(2 * LIMIT)  # more than commands may use
    with pytest.raises(ControllerError, match=r"applied no command for 0.3 s: last refused command: "):
        control(link, controller, lambda: False, lambda status: None)


def test_rejects_arm_with_own_gravity_compensation(controller):
    link = GuardedArm()
    link.status.gravity_compensation = True
    assert_refused(ControllerError, r"adds its own gravity compensation.*Switch it off", first_status, link)
    with pytest.raises(ControllerError, match=r"adds its own gravity compensation.*Switch it off"):
        control(link, controller, lambda: False, lambda status: None)
    assert link.commands == []
