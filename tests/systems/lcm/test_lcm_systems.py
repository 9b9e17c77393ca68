"""Both ends of an arm's LCM channels in one process, with a controller on the simulated driver."""

import numpy as np
import pytest
from lcm_arm import ARM, POSES, START, CommandSender, Controller, SimulatedArm, run
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator

from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.lcm_messages import create_key_file
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.states import State
from dvrk_drake.systems.lcm.arm_link import DrakeLcmArmLink
from dvrk_drake.systems.lcm.sim_dvrk_driver import DvrkArmServer

pytestmark = pytest.mark.drake_api


@pytest.mark.parametrize("name", ["mtml", pytest.param("psm", marks=pytest.mark.slow)])
def test_controller_starts_acts_and_hold_follows(name):
    lcm = DrakeLcm("memq://")
    arm, controller = SimulatedArm(lcm, name), Controller(lcm, name)
    run(lcm, 300, arm, controller)
    status = arm.statuses[-1]
    assert (status.guard_state, status.fault_text) == (Status.STATE_EFFORT, "")
    assert status.utime == START + 300_000
    assert [s.sequence for s in arm.statuses] == list(range(301))
    assert arm.drift() < 1e-4
    effort_before = np.array(status.effort_commanded)
    # The controller stops: the arm holds after 50 ms, without a jump of the effort or the pose.
    run(lcm, 60, arm)
    states = [s.guard_state for s in arm.statuses[-60:]]
    assert states == sorted(states, reverse=True)
    assert 49 <= states.count(Status.STATE_EFFORT) <= 51
    assert states[-1] == Status.STATE_HOLD
    accepted = arm.statuses[-1].num_accepted
    run(lcm, 500, arm)
    status = arm.statuses[-1]
    assert (status.num_expired, status.command_sender_id, status.num_accepted) == (1, 0, accepted)
    assert np.abs(np.array(status.effort_commanded) - effort_before).max() < 0.01 * arm.arm.effort_limits.max()
    assert arm.drift() < 1e-3
    # It restarts as another sender, but an operator did not resume.
    controller = Controller(lcm, name)
    run(lcm, 300, arm, controller)
    status = arm.statuses[-1]
    assert (status.guard_state, status.refusal_code) == (Status.STATE_HOLD, Status.REFUSAL_RESUME)
    assert status.fault_code == Status.FAULT_NONE and status.fault_text.startswith("the last command expired: ")
    run(lcm, 60, arm)
    operator = CommandSender(lcm, arm.arm)
    run(lcm, 5, arm, operator)
    operator.fix("reset_fault", [1.0])
    run(lcm, 5, arm, operator)
    run(lcm, 60, arm)
    assert not arm.statuses[-1].fault_text
    # It restarts again and passes STARTING first.
    controller = Controller(lcm, name)
    run(lcm, 200, arm, controller)
    assert arm.statuses[-1].guard_state == Status.STATE_STARTING
    run(lcm, 100, arm, controller)
    assert arm.statuses[-1].guard_state == Status.STATE_EFFORT
    assert (arm.statuses[-1].num_lost, arm.drift() < 1e-3) == (0, True)


def test_effort_of_the_position_controller_is_limited_in_rate():
    """Measurements that jump would reverse the efforts within one step."""
    model = ControlModel(IdentifiedModel.from_arm(ARM))
    receiver = DvrkArmServer(ARM, CommandGuard(ARM, 1, model))
    simulator = Simulator(receiver)
    context, limit = simulator.get_mutable_context(), ARM.effort_limits
    receiver.GetInputPort("state_estimated").FixValue(context, np.zeros(2 * ARM.num_joints))
    receiver.GetInputPort("effort_measured").FixValue(context, np.zeros(ARM.num_joints))
    control = receiver.GetInputPort("position_control_effort").FixValue(context, limit)
    efforts = []
    for k in range(60):
        control.GetMutableData().set_value((-1.0 if k >= 10 else 2.0) * limit)
        simulator.AdvanceTo(1e-3 * k)
        efforts.append(context.get_discrete_state(0).value() / limit)
    steps = np.diff(efforts, axis=0)
    # The effort changes by its limit within 4 ms.
    np.testing.assert_allclose(efforts[:10], 1.0, atol=1e-12)
    np.testing.assert_allclose(steps[10:16], -0.25, atol=1e-12)
    np.testing.assert_allclose(efforts[-1], -1.0, atol=1e-12)
    # The safe state of a fault starts from the measured effort, which may be late. Here it is 0.
    guard = context.get_mutable_abstract_state(0).get_mutable_value()
    guard.report_fault("the joint oscillates", Status.FAULT_OSCILLATION)
    efforts = []
    for k in range(60, 120):
        efforts.append(context.get_discrete_state(0).value() / limit)
        simulator.AdvanceTo(1e-3 * k)
    assert receiver.GetGuard(context).output.control_mode == Command.EFFORT
    assert np.abs(np.diff(efforts, axis=0)).max() <= 0.25 + 1e-12 and np.abs(efforts[-1]).max() < 0.6


def test_the_status_echoes_the_last_accepted_command():
    lcm = DrakeLcm("memq://")
    sent = []
    lcm.Subscribe("DVRK_COMMAND_MTML", lambda data: sent.append(Command.decode(data)))
    arm, controller = SimulatedArm(lcm), Controller(lcm)
    run(lcm, 20, arm, controller)
    arm.step()  # it uses the last command and reports it one period later
    arm.step()
    lcm.HandleSubscriptions(0)
    status, command = arm.statuses[-1], sent[-1]
    assert (status.command_sequence, status.command_utime) == (command.sequence, command.utime)
    assert status.command_sender_id == command.sender_id != 0
    assert command.session_id == status.session_id != 0


def test_second_gravity_compensation_is_refused_at_start():
    lcm = DrakeLcm("memq://")
    driver = DvrkDriver(gravity_compensation=True)
    arm, controller = SimulatedArm(lcm, driver=driver), Controller(lcm)
    run(lcm, 400, arm, controller)
    status = arm.statuses[-1]
    assert status.gravity_compensation
    assert (status.guard_state, status.refusal_code) == (Status.STATE_HOLD, Status.REFUSAL_START_FAR)


def test_own_gravity_compensation_with_zero_command():
    lcm = DrakeLcm("memq://")
    arm = SimulatedArm(lcm, driver=DvrkDriver(gravity_compensation=True))
    sender = CommandSender(lcm, effort_commanded=np.zeros(7))
    run(lcm, 1000, arm, sender)
    assert arm.statuses[-1].guard_state == Status.STATE_EFFORT
    assert arm.drift() < 1e-3
    assert np.abs(arm.statuses[-1].effort_commanded).max() > 0.3


def test_position_commands_move_the_arm():
    lcm = DrakeLcm("memq://")
    arm = SimulatedArm(lcm)
    sender = CommandSender(lcm, state_desired=np.concatenate([POSES["mtml"], np.zeros(7)]))
    run(lcm, 300, arm, sender)
    assert arm.statuses[-1].guard_state == Status.STATE_POSITION
    goal = np.array(POSES["mtml"]) + 0.1
    sender.fix("state_desired", np.concatenate([goal, np.zeros(7)]))
    run(lcm, 2500, arm, sender)
    assert np.abs(arm.statuses[-1].position - goal).max() < 5e-3
    assert np.abs(arm.statuses[-1].position_commanded - goal).max() < 1e-9


def test_arm_falls_in_off_if_driver_accepts_it():
    lcm = DrakeLcm("memq://")
    arm = SimulatedArm(lcm, driver=DvrkDriver(control_modes=["off"]))
    sender = CommandSender(lcm, control_mode=[float(Command.HOLD)])
    run(lcm, 10, arm, sender)
    sender.fix("control_mode", [float(Command.OFF)])
    run(lcm, 200, arm, sender)
    assert arm.statuses[-1].guard_state == Status.STATE_OFF
    assert not np.any(arm.statuses[-1].effort_measured)
    assert arm.drift() > 0.01


def test_sender_commands_hold_without_finite_numbers():
    lcm, sent = DrakeLcm("memq://"), []
    lcm.Subscribe("DVRK_COMMAND_MTML", lambda data: sent.append(Command.decode(data)))
    effort, q_v = np.arange(7.0), np.arange(14.0)
    cases = [
        ({}, Command.HOLD),
        ({"effort_commanded": effort}, Command.EFFORT),
        ({"state_desired": q_v}, Command.POSITION),
        ({"effort_commanded": effort, "state_desired": q_v}, Command.EFFORT),
        ({"effort_commanded": effort, "state_desired": q_v, "control_mode": [2.0]}, Command.POSITION),
        ({"effort_commanded": effort, "control_mode": [2.0]}, Command.HOLD),
        ({"effort_commanded": effort, "control_mode": [np.nan]}, Command.HOLD),
        ({"effort_commanded": effort, "control_mode": [0.0]}, Command.HOLD),
        ({"effort_commanded": effort, "control_mode": [4.0]}, Command.OFF),
        ({"effort_commanded": effort * np.nan}, Command.HOLD),
        ({"effort_commanded": effort + 1e7}, Command.HOLD),
        ({"effort_commanded": effort, "reset_fault": [1.0]}, Command.HOLD),
    ]
    for inputs, mode in cases:
        sender = CommandSender(lcm, **inputs)
        lcm.Publish("DVRK_STATUS_MTML", full_status().encode())
        run(lcm, 2, sender)
        command = sent.pop()
        assert not sent and command.sender_id == sender.station.sender_id
        assert command.control_mode == mode
        np.testing.assert_array_equal(command.effort, effort if mode == Command.EFFORT else np.zeros(7))
        expected = q_v if mode == Command.POSITION else np.zeros(14)
        np.testing.assert_array_equal([*command.position, *command.velocity], expected)
        assert command.reset_fault == ("reset_fault" in inputs)


def full_status(arm_name="MTML", n=7, utime=1):
    status = Status()
    status.arm_name, status.num_joints, status.utime = arm_name, n, utime
    for k, name in enumerate(("position", "velocity", "effort_measured", "position_commanded", "effort_commanded")):
        setattr(status, name, list(np.arange(n) + 10.0 * k))
    status.joint_flags = [0] * n
    return status


def test_outputs_are_nan_without_valid_status():
    lcm = DrakeLcm("memq://")
    station = CommandSender(lcm)
    names = ("position_measured", "velocity_estimated", "state_estimated", "effort_measured")

    def after(data):
        lcm.Publish("DVRK_STATUS_MTML", data)
        lcm.HandleSubscriptions(0)
        station.step()
        return {name: station.value(name).tolist() for name in names}

    numbers = ("guard_state", "fault_code", "acting_mode", "in_control", "measurement_age", "sequence_gaps")
    assert all(np.all(np.isnan(station.value(name))) for name in (*names, *numbers))
    good = after(full_status().encode())
    assert (
        good["state_estimated"] == [*range(7), *range(10, 17)] == good["position_measured"] + good["velocity_estimated"]
    )
    assert good["effort_measured"] == list(range(20, 27))
    for bad in (b"", b"garbage", full_status("MTMR").encode(), full_status(n=6).encode(), full_status().encode()[:-30]):
        assert after(bad) == good
    # The time advances by 1 ms per step. The first status was read at the begin of a step.
    np.testing.assert_allclose(station.value("measurement_age"), 6e-3, atol=1e-9)
    later = full_status(utime=4000)
    later.sequence = 4
    after(later.encode())
    assert station.value("sequence_gaps") == [3.0]


def test_polled_link_continues_after_lost_statuses():
    """As in a station that polls after its Diagram was built for seconds, in which the queue became full."""
    network, now = DrakeLcm("memq://"), 0.0
    link = DrakeLcmArmLink(ARM, network)
    link.now = lambda: now
    sequences, status = [], full_status()
    for now in np.arange(0.0, 1.0, 1e-3):
        status.sequence = round(1e3 * now) + (1000 if now else 0)
        status.utime = 1 + 1000 * status.sequence
        network.Publish("DVRK_STATUS_MTML", status.encode())
        network.HandleSubscriptions(0)
        if (received := link.poll()) is not None:
            sequences.append(received.sequence)
    # The arm sends 1000 statuses per second, and the filter permits 2000 per second and 100 at once.
    assert sequences == [0, *range(1900, 2000)]


def test_ports_tell_the_state_and_a_reset_resumes():
    lcm = DrakeLcm("memq://")
    arm, station = SimulatedArm(lcm), CommandSender(lcm, effort_commanded=np.zeros(7))
    model = ControlModel(IdentifiedModel.from_arm(ARM))
    ports = ("guard_state", "fault_code", "acting_mode", "in_control", "sequence_gaps")

    def state():
        return [float(station.value(name)[0]) for name in ports]

    station.fix("effort_commanded", model.gravity_effort(np.array(POSES["mtml"])))
    run(lcm, 10, arm, station)
    assert state() == [Status.STATE_STARTING, 0, Command.HOLD, 0, 0]
    run(lcm, 300, arm, station)
    assert state() == [Status.STATE_EFFORT, 0, Command.EFFORT, 1, 0]
    run(lcm, 100, arm)  # this process is suspended, and the arm holds
    run(lcm, 5, arm, station)
    assert state() == [Status.STATE_HOLD, 0, Command.HOLD, 0, 0]
    assert arm.statuses[-1].fault_text.startswith("the last command expired")
    station.fix("reset_fault", [1.0])
    run(lcm, 60, arm, station)
    assert state()[0] == Status.STATE_HOLD and not arm.statuses[-1].fault_text
    station.fix("reset_fault", [0.0])
    run(lcm, 350, arm, station)
    assert state()[:4] == [Status.STATE_EFFORT, 0, Command.EFFORT, 1]
    arm.guard.report_fault("the amplifier is hot")
    run(lcm, 5, arm, station)
    assert state()[:4] == [Status.STATE_FAULT, Status.FAULT_DRIVER, Command.HOLD, 0]


def test_messages_require_the_same_key(tmp_path):
    create_key_file(tmp_path / "a.key")
    lcm, driver = DrakeLcm("memq://"), DvrkDriver(key_file=str(tmp_path / "a.key"))
    arm, stranger = SimulatedArm(lcm, driver=driver), Controller(lcm)
    run(lcm, 300, arm, stranger)
    last = arm.statuses[-1]
    assert (last.guard_state, last.num_accepted, last.ignored_code) == (
        Status.STATE_HOLD,
        0,
        Status.REFUSAL_NOT_AUTHENTIC,
    )
    owner = Controller(lcm, driver=driver)
    run(lcm, 300, arm, stranger, owner)
    assert arm.statuses[-1].guard_state == Status.STATE_EFFORT
    # The station with the key ignores an unsigned status.
    spoofed = full_status(utime=arm.statuses[-1].utime + 1000)
    spoofed.sequence, spoofed.session_id = arm.statuses[-1].sequence + 1, arm.statuses[-1].session_id
    station = owner.simulator.get_system().GetSubsystemByName("mtml_station")
    port, context = station.GetOutputPort("mtml.position_measured"), owner.simulator.get_context()
    for _ in range(20):
        lcm.Publish("DVRK_STATUS_MTML", spoofed.encode())
        lcm.HandleSubscriptions(0)
        owner.step()
        np.testing.assert_allclose(port.Eval(station.GetMyContextFromRoot(context)), POSES["mtml"], atol=1e-3)
    assert arm.drift() < 1e-3


def test_person_at_the_process_of_the_arm_allows_a_reset():
    arm = SimulatedArm(DrakeLcm("memq://"))
    for _ in range(3):
        arm.guard.report_fault("oscillates", Status.FAULT_OSCILLATION)
        arm.guard._state = State.FAULT if arm.guard.needs_person else State.HOLD
    arm.step()
    assert arm.guard.needs_person
    arm.driver.AllowReset()
    arm.step()
    arm.step()
    assert not arm.guard.needs_person
