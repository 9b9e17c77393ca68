"""Published force, and contact detection. tests/processes/test_control.py shows that an error lets the arm hold."""

import copy
import dataclasses

import numpy as np
import pytest
from pushed_arm import pushed_arm

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import MAX_DEVIATION, ArmFrame
from dvrk_drake.errors import ControllerError, ModelError
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.connection import connect
from dvrk_drake.processes.force_monitor import ForceMonitor

PSM = load_arm("psm")
FORCE = np.array([2.0, -3.0, 4.0])


def statuses(recording, start=0):
    """Returns the statuses of an arm at 1 kHz."""
    made = []
    for k, (q, v, tau) in enumerate(zip(recording.q, recording.qd, recording.tau, strict=True), start):
        status = Status()
        status.arm_name, status.utime, status.session_id = PSM.name, 1000 * (k + 1), 7
        status.position, status.velocity, status.effort_measured = q.tolist(), v.tolist(), tau.tolist()
        made.append(status)
    return made


def published(model, sent):
    """Returns copies of the published messages."""
    messages = []
    monitor = ForceMonitor(model, send=lambda message: messages.append(copy.deepcopy(message)))
    for status in sent:
        monitor.update(status)
    return messages


def test_force_is_published_in_the_axes_of_its_frame():
    model, recording = pushed_arm(seconds=1.5, force=FORCE)
    messages = published(model, statuses(recording))
    assert [message.utime for message in messages] == list(range(1000, 1_501_000, 10_000))
    assert [message.sequence for message in messages] == list(range(1, 151))
    last = messages[-1]
    assert (last.session_id, last.arm_name, last.frame_name) == (7, "PSM", PSM.frames.hand)
    covariance, force = np.array(last.force_covariance), np.array(last.force)
    R_BF = ArmFrame(PSM).pose(recording.q[(last.utime - 25_000) // 1000 - 1]).rotation()  # 25 ms: delay
    np.testing.assert_allclose(force, R_BF.inverse() @ FORCE, atol=0.1)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-9)


def test_force_is_nan_without_a_valid_measurement():
    model, recording = pushed_arm(seconds=0.2, force=FORCE)
    sent = statuses(recording)
    for status in sent[100:150]:
        status.position = [np.nan, *status.position[1:]]
    messages = published(model, sent)
    sizes = [np.nanmax(np.abs([*message.force, 0.0])) for message in messages]
    assert sizes[9] > 1 > sizes[15]
    for message in messages[10:15]:
        assert np.all(np.isnan(message.force)) and np.all(np.isnan(message.force_covariance))


def test_uncertain_component_is_nan():
    model, recording = pushed_arm(seconds=0.1)
    stated = [dataclasses.replace(a, rms_cross_validation=2.0 * a.rms_effort) for a in model.dynamics.actuators]
    model = dataclasses.replace(model, dynamics=dataclasses.replace(model.dynamics, actuators=stated))
    last = published(model, statuses(recording))[-1]
    hidden = np.diag(last.force_covariance) > MAX_DEVIATION**2
    assert np.any(hidden)
    np.testing.assert_array_equal(np.isnan(last.force), hidden)


def test_contact_ends_the_control_within_a_tenth_of_a_second():
    model, free = pushed_arm(seconds=0.2)
    _, pushed = pushed_arm(seconds=0.2, force=(5.0, 0.0, 0.0))
    monitor, count = ForceMonitor(model, stop_on_contact=0.1), 0
    with pytest.raises(ControllerError, match=r"PSM: contact: the external effort of \w+ is .* The arm holds\."):
        for status in [*statuses(free)[:100], *statuses(pushed)[100:]]:
            monitor.update(status)
            count += 1
    assert 100 <= count < 200


def test_repeated_measurement_is_ignored():
    model, free = pushed_arm(seconds=0.1)
    once, twice = statuses(free), [status for status in statuses(free) for _ in range(2)]
    assert [m.encode() for m in published(model, once)] == [m.encode() for m in published(model, twice)]


def test_unsuitable_model_is_refused_before_the_connection():
    for option in ({"stop_on_contact": 0.1}, {"publish_force": True}):
        with pytest.raises(ModelError, match="requires a model that was identified from a motion"):
            connect(PSM, model=IdentifiedModel.from_arm(PSM), **option)
    with pytest.raises(ControllerError, match="false alarms per hour must be"):
        connect(PSM, model=pushed_arm(seconds=0.1)[0], stop_on_contact=0.0)
