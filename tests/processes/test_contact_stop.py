"""Contact detection during control. tests/processes/test_control.py shows that an error lets the arm hold its pose."""

import numpy as np
import pytest
from pushed_arm import pushed_arm

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError, ModelError
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.connection import connect
from dvrk_drake.processes.contact_stop import ContactStop

PSM = load_arm("psm")


def statuses(recording):
    """Returns the statuses of an arm at 1 kHz."""
    made = []
    for k, (q, v, tau) in enumerate(zip(recording.q, recording.qd, recording.tau, strict=True)):
        status = Status()
        status.arm_name, status.utime = PSM.name, 1000 * (k + 1)
        status.position, status.velocity, status.effort_measured = q.tolist(), v.tolist(), tau.tolist()
        made.append(status)
    return made


def test_contact_ends_the_control_within_a_tenth_of_a_second():
    model, free = pushed_arm(seconds=0.2)
    _, pushed = pushed_arm(seconds=0.2, force=(5.0, 0.0, 0.0))
    answers = []
    stop = ContactStop(model, 0.1, lambda status, time: answers.append(status))
    sent = [*statuses(free)[:100], *statuses(pushed)[100:]]
    with pytest.raises(ControllerError, match=r"PSM: contact: the external effort of \w+ is .* The arm holds\."):
        for status in sent:
            assert stop(status, 0.0) is None
    assert 100 <= len(answers) < 200


def test_repeated_measurement_is_ignored():
    model, free = pushed_arm(seconds=0.1)
    once, twice = (ContactStop(model, 0.1) for _ in range(2))
    for status in statuses(free):
        once(status, 0.0)
        twice(status, 0.0)
        twice(status, 0.0)
    np.testing.assert_array_equal(once._state, twice._state)


def test_unsuitable_model_is_refused_before_the_connection():
    with pytest.raises(ModelError, match="requires a model that was identified from a motion"):
        connect(PSM, model=IdentifiedModel.from_arm(PSM), stop_on_contact=0.1)
    with pytest.raises(ControllerError, match="false alarms per hour must be"):
        connect(PSM, model=pushed_arm(seconds=0.1)[0], stop_on_contact=0.0)
