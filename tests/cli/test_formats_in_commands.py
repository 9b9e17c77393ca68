"""Each format gives the same recording as the CSV of the same data, and commands read it."""

import numpy as np
import pytest
from array_files import KINDS as ARRAY_KINDS
from array_files import write_arrays
from bags import KINDS as BAG_KINDS
from bags import joint_states, write_bag
from collector_files import joint_state, write_collection
from synthetic_motion import clean_motion

from dvrk_drake.analysis.validation import predict
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import Recording

START = 1_700_000_000_000_000_000


KINDS = (*BAG_KINDS, *ARRAY_KINDS, "collector")


def both(folder, name, arm, kind, recording, topic):
    """Writes a recording as a CSV and in another format. Time stamps are rounded to ns in both."""
    stamps = START + np.round(1e9 * (recording.t - recording.t[0])).astype(int)
    t, q, qd, tau = 1e-9 * (stamps - stamps[0]), recording.q, recording.qd, recording.tau
    csv, other = folder / f"{name}.csv", folder / name
    write_recording(Recording(q, tau, qd, t), csv)
    other.mkdir()
    if kind in BAG_KINDS:
        path = write_bag(other, kind, {topic: joint_states(stamps, arm.joint_names, q, qd, tau)})
    elif kind in ARRAY_KINDS:
        path = write_arrays(other, kind, {"q": q, "qd": qd, "tau": tau, "t": t})
    else:
        signal = joint_state("kin/measured_js", arm.joint_names, t, q, qd, tau)
        path = write_collection(other, f"StateDataCollection-{arm.name}-StateTable-2025-10-06", signal)
    return str(csv), str(path)


def poses(arm, seed):
    generator = np.random.default_rng(seed)
    q = arm.sample_poses(30, generator, margin=0.1)
    tau = predict(IdentifiedModel.from_arm(arm), Recording(q, np.zeros_like(q))).tau
    tau += 0.01 * arm.effort_limits * generator.normal(size=tau.shape)
    return Recording(q, tau, np.zeros_like(q), np.arange(30.0))


def assert_same_recordings(first, second, arm):
    first, second = read_recording(first, arm), read_recording(second, arm)
    for name in ("t", "q", "qd", "tau"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_static_poses_are_those_of_the_csv(tmp_path, kind):
    arm = load_arm("mtmr")
    assert_same_recordings(*both(tmp_path, "poses", arm, kind, poses(arm, 0), "/MTMR/measured_js"), arm)
    assert_same_recordings(*both(tmp_path, "other", arm, kind, poses(arm, 1), "/lab/MTMR/measured_js"), arm)


def test_convert_writes_the_csv_of_a_bag(tmp_path):
    arm = load_arm("mtmr")
    csv, bag = both(tmp_path, "poses", arm, "mcap", poses(arm, 0), "/MTMR/measured_js")
    out = tmp_path / "converted.csv"
    assert main(["convert", bag, "--arm", "mtmr", "--output", str(out)]) == 0
    assert_same_recordings(csv, out, arm)


@pytest.mark.parametrize(
    "options, text",
    [
        (["--topic", "/MTMR/setpoint_js"], "has no JointState topic /MTMR/setpoint_js"),
        (["--coordinates", "actuator"], "a ROS bag is in joint coordinates"),
    ],
)
def test_unsuitable_options_of_a_bag_give_one_line(tmp_path, options, text, capsys):
    arm = load_arm("mtmr")
    csv, bag = both(tmp_path, "poses", arm, "mcap", poses(arm, 0), "/MTMR/measured_js")
    assert main(["check", bag, "--arm", "mtmr", *options]) == 2
    assert text in capsys.readouterr().err.splitlines()[-1]
    assert main(["check", csv, "--arm", "mtmr", "--topic", "/MTMR"]) == 2
    assert "--topic does not apply" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("kind", (*BAG_KINDS, "v5"))
def test_motion_is_that_of_the_csv(tmp_path, kind):
    arm = load_arm("psm")
    assert_same_recordings(*both(tmp_path, "motion", arm, kind, clean_motion(), "/PSM1/measured_js"), arm)
