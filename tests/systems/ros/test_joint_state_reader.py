"""Conversion of JointState messages to measurements, without DDS."""

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs cyclonedds")

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.ros.joint_state_reader import JointStateReader, shown
from dvrk_drake.systems.ros.messages import Header, JointState, Time

MTML, PSM = load_arm("mtml"), load_arm("psm")
STAMP = Header(Time(1_795_257_600, 1))
MS = 1_000_000
ROWS = np.arange(21.0).reshape(3, 7) / 10


def message(names=MTML.joint_names, rows=ROWS, header=STAMP):
    return JointState(header, list(names), *(list(map(float, row)) for row in rows))


def read(sent, arm=MTML):
    return JointStateReader(arm, "/A/measured_js").read(sent, 7)


def test_message_is_converted():
    found = read(message())
    np.testing.assert_array_equal([found.q, found.v, found.effort], ROWS)
    assert (found.stamp, found.arrival, found.problem) == (1_795_257_600 * 10**9 + 1, 7, "")


def test_joints_may_be_in_any_order_and_have_others_between():
    reader = JointStateReader(MTML, "/A/measured_js")
    for seed in range(5):
        names = np.random.default_rng(seed).permutation([*MTML.joint_names, "gripper"])
        values = {name: k for k, name in enumerate(MTML.joint_names)} | {"gripper": np.nan}
        rows = [[values[name] + 10 * row for name in names] for row in range(3)]
        found = reader.read(message(names, rows), 0)
        np.testing.assert_array_equal(found.q, range(7))
        np.testing.assert_array_equal(found.effort, range(20, 27))
        assert not found.problem


@pytest.mark.parametrize(
    ("sent", "problem"),
    [
        (message(header=Header()), "/A/measured_js: header stamp 0 marks invalid data. Home the arm"),
        (
            message(MTML.joint_names[1:], ROWS[:, 1:]),
            "/A/measured_js has the joints shoulder_pitch, elbow_pitch, wrist_platform, wrist_pitch, wrist_yaw, "
            "wrist_roll; MTML also needs outer_yaw",
        ),
        (
            message(rows=[ROWS[0], ROWS[1, :6], []]),
            "/A/measured_js has 7 positions, 6 velocities and 0 efforts; required: 7 each",
        ),
        (message([], [[], [], []]), "/A/measured_js has the joints none; MTML also needs outer_yaw, shoulder_pitch"),
        (message([]), "/A/measured_js has the joints none; MTML also needs outer_yaw, shoulder_pitch"),
        (message(["a\nb"] * 7), "/A/measured_js has the joints 'a\\nb', 'a\\nb', 'a\\nb'"),
        *(
            (message(rows=np.where(value == ROWS, bad, ROWS)), "/A/measured_js: a position or velocity is not finite")
            for bad in (np.nan, np.inf, -np.inf)
            for value in (0.3, 1.0)
        ),
    ],
)
def test_message_that_cannot_be_used_has_no_numbers(sent, problem):
    found = read(sent)
    assert found.problem.startswith(problem)
    assert "\n" not in found.problem and len(found.problem) < 500
    assert np.isnan([found.q, found.v, found.effort]).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_effort_that_is_not_finite_is_passed_on(bad):
    rows = np.where(ROWS == 2.0, bad, ROWS)
    found = read(message(rows=rows))
    np.testing.assert_array_equal([found.q, found.v, found.effort], rows)
    assert found.problem == ""


def jaw(header=STAMP, values=(0.1, 0.2, 0.3)):
    return JointState(header, ["jaw"], *([value] for value in values))


def psm_message():
    return message(PSM.joint_names[:6], ROWS[:, :6])


def test_jaw_has_messages_of_its_own():
    reader = JointStateReader(PSM, "/PSM1/measured_js")
    reader.read_jaw(jaw(), 100 * MS)
    found = reader.read(psm_message(), 101 * MS)
    np.testing.assert_allclose([found.q[6], found.v[6], found.effort[6]], [0.1, 0.2, 0.3], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.q[:6], ROWS[0, :6])
    # The age of the jaw does not change the time of arrival, from which the difference of the clocks is determined.
    assert (found.arrival, found.problem) == (101 * MS, "")


@pytest.mark.parametrize(
    ("sent", "arrival"),
    [
        (None, 0),
        (jaw(Header()), 100 * MS),
        (JointState(STAMP, ["jaw"], [0.1], [0.1], []), 100 * MS),
        (JointState(STAMP, ["jaw"], [0.1, 0.2], [0.1], [0.1]), 100 * MS),
    ],
)
def test_missing_or_invalid_jaw_is_a_problem(sent, arrival):
    reader = JointStateReader(PSM, "/PSM1/measured_js")
    if sent is not None:
        reader.read_jaw(jaw(), 99 * MS)
        reader.read_jaw(sent, arrival)
    found = reader.read(psm_message(), 100 * MS)
    assert found.problem == "no valid message on /PSM1/jaw/measured_js"
    assert np.isnan(found.q).all()


@pytest.mark.parametrize(("period", "accepted"), [(1, 20), (10, 2), (30, 2)])
def test_jaw_is_out_of_date_after_20_ms_and_2_measurements(period, accepted):
    """A dVRK may publish at 100 Hz with a delay of several periods, first the arm and then the jaw."""
    reader = JointStateReader(PSM, "/PSM1/measured_js")
    reader.read_jaw(jaw(), 100 * MS)
    found = [reader.read(psm_message(), (100 + k * period) * MS) for k in range(1, 30)]
    assert [not each.problem for each in found] == [k <= accepted for k in range(1, 30)]
    reader.read_jaw(jaw(), 2000 * MS)
    assert not reader.read(psm_message(), 2001 * MS).problem


def test_jaw_that_is_not_finite_is_a_problem():
    reader = JointStateReader(PSM, "/PSM1/measured_js")
    reader.read_jaw(jaw(values=(0.1, np.nan, 0.1)), 100 * MS)
    assert "not finite" in reader.read(psm_message(), 100 * MS).problem


def test_received_text_is_short_and_on_one_line():
    assert shown("ENABLED") == "ENABLED"
    assert shown("a\nb") == "'a\\nb'"
    assert len(shown("x" * 10**6)) < 50
