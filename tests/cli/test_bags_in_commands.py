"""Commands give the same numbers from a ROS bag as from the CSV of the same data."""

import json
from dataclasses import replace

import numpy as np
import pytest
from bags import KINDS, joint_states, write_bag
from synthetic_motion import clean_motion

from dvrk_drake.analysis.validation import predict
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import load_arm
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.recording import Recording, write_recording

START = 1_700_000_000_000_000_000


def both(folder, name, arm, kind, recording, topic):
    """Writes a recording as a CSV and as a bag. Time stamps are rounded to ns in both."""
    stamps = START + np.round(1e9 * (recording.t - recording.t[0])).astype(int)
    csv = folder / f"{name}.csv"
    write_recording(Recording(recording.q, recording.tau, recording.qd, 1e-9 * (stamps - stamps[0])), csv)
    bag_folder = folder / name
    bag_folder.mkdir()
    rows = joint_states(stamps, arm.joint_names, recording.q, recording.qd, recording.tau)
    return str(csv), str(write_bag(bag_folder, kind, {topic: rows}))


def poses(arm, seed):
    generator = np.random.default_rng(seed)
    q = arm.sample_poses(30, generator, margin=0.1)
    tau = predict(IdentifiedModel.from_arm(arm), Recording(q, np.zeros_like(q))).tau
    tau += 0.01 * arm.effort_limits * generator.normal(size=tau.shape)
    return Recording(q, tau, np.zeros_like(q), np.arange(30.0))


def numbers(value):
    """Numbers in nested JSON, in order; None is NaN."""
    if isinstance(value, dict):
        value = [value[key] for key in sorted(value)]
    if isinstance(value, list):
        return [number for entry in value for number in numbers(entry)]
    return [] if isinstance(value, str) else [np.nan if value is None else float(value)]


def same_numbers(first, second):
    first, second = (json.loads(path.read_text()) for path in (first, second))
    np.testing.assert_allclose(numbers(first), numbers(second), rtol=1e-6, atol=1e-9)


def same_models(first, second):
    first, second = IdentifiedModel.load(first), IdentifiedModel.load(second)
    np.testing.assert_allclose(
        [p.value for p in first.base_parameters], [p.value for p in second.base_parameters], rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("kind", KINDS)
def test_static_poses_from_a_bag(tmp_path, kind, capsys):
    arm = load_arm("mtmr")
    csv, bag = both(tmp_path, "poses", arm, kind, poses(arm, 0), "/MTMR/measured_js")
    other = both(tmp_path, "other", arm, kind, poses(arm, 1), "/lab/MTMR/measured_js")
    for source, name in ((csv, "csv"), (bag, "bag")):
        assert main(["identify", source, "--arm", "mtmr", "--output", str(tmp_path / f"{name}.yaml")]) == 0
        assert main(["check", source, "--arm", "mtmr", "--json", str(tmp_path / f"check_{name}.json")]) == 0
    same_models(tmp_path / "csv.yaml", tmp_path / "bag.yaml")
    for source, name in zip(other, ("csv", "bag"), strict=True):
        result = str(tmp_path / f"validate_{name}.json")
        assert main(["validate", source, "--model", str(tmp_path / "csv.yaml"), "--json", result]) == 0
    for command in ("check", "validate"):
        same_numbers(tmp_path / f"{command}_csv.json", tmp_path / f"{command}_bag.json")


def test_convert_writes_the_csv_of_a_bag(tmp_path):
    arm = load_arm("mtmr")
    csv, bag = both(tmp_path, "poses", arm, "mcap", poses(arm, 0), "/MTMR/measured_js")
    out = tmp_path / "converted.csv"
    assert main(["convert", bag, "--arm", "mtmr", "--output", str(out)]) == 0
    first, second = read_recording(csv, arm), read_recording(out, arm)
    for name in ("t", "q", "qd", "tau"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), rtol=0, atol=1e-12)


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


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_motion_from_a_bag(tmp_path, kind):
    arm = load_arm("psm")
    motion = clean_motion()
    csv, bag = both(tmp_path, "motion", arm, kind, motion, "/PSM1/measured_js")
    generator = np.random.default_rng(3)
    changed = motion.tau + 0.02 * np.std(motion.tau, axis=0) * (
        np.sin(motion.q) + generator.normal(size=motion.q.shape)
    )
    loaded = both(tmp_path, "loaded", arm, kind, replace(motion, tau=changed), "/PSM1/measured_js")
    for source, with_payload, name in ((csv, loaded[0], "csv"), (bag, loaded[1], "bag")):
        model, again = tmp_path / f"{name}.yaml", tmp_path / f"{name}_again.yaml"
        result = str(tmp_path / f"payload_{name}.json")
        assert main(["identify", source, "--arm", "psm", "--output", str(model)]) == 0
        assert main(["recalibrate", source, "--model", str(model), "--output", str(again)]) == 0
        assert main(["payload", source, with_payload, "--model", str(tmp_path / "csv.yaml"), "--json", result]) == 0
    same_models(tmp_path / "csv.yaml", tmp_path / "bag.yaml")
    same_numbers(tmp_path / "payload_csv.json", tmp_path / "payload_bag.json")
