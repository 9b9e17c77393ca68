"""Commands give the same numbers from each format as from the CSV of the same data."""

import json
from dataclasses import replace

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
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.recordings.writing import write_recording

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


def numbers(value):
    """Numbers in nested JSON, in order; None is NaN."""
    if isinstance(value, dict):
        value = [value[key] for key in sorted(value)]
    if isinstance(value, list):
        return [number for entry in value for number in numbers(entry)]
    return [] if isinstance(value, str) else [np.nan if value is None else float(value)]


def same_numbers(first, second):
    first, second = (json.loads(path.read_text()) for path in (first, second))
    for result in (first, second):
        if "findings" in result:
            # The notes describe the file.
            result["findings"] = [entry for entry in result["findings"] if entry["severity"] != "note"]
    np.testing.assert_allclose(numbers(first), numbers(second), rtol=1e-6, atol=1e-9)


def same_models(first, second):
    first, second = IdentifiedModel.load(first), IdentifiedModel.load(second)
    np.testing.assert_allclose(
        [p.value for p in first.base_parameters], [p.value for p in second.base_parameters], rtol=1e-6, atol=1e-9
    )


def assert_same_recordings(first, second, arm):
    first, second = read_recording(first, arm), read_recording(second, arm)
    for name in ("t", "q", "qd", "tau"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_static_poses_are_those_of_the_csv(tmp_path, kind):
    arm = load_arm("mtmr")
    assert_same_recordings(*both(tmp_path, "poses", arm, kind, poses(arm, 0), "/MTMR/measured_js"), arm)
    assert_same_recordings(*both(tmp_path, "other", arm, kind, poses(arm, 1), "/lab/MTMR/measured_js"), arm)


@pytest.mark.parametrize("kind", [BAG_KINDS[0], *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS[1:])])
def test_commands_with_static_poses(tmp_path, kind, capsys):
    """All commands read all formats with `read_recording`, so the other formats repeat this test."""
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


@pytest.fixture(scope="module")
def motions():
    """Returns two motions of a PSM, the second with other efforts."""
    motion, generator = clean_motion(), np.random.default_rng(3)
    noise = np.sin(motion.q) + generator.normal(size=motion.q.shape)
    return motion, replace(motion, tau=motion.tau + 0.02 * np.std(motion.tau, axis=0) * noise)


def results(folder, first, second, model):
    """Runs identify, recalibrate and payload. Returns the identified model and the result of payload."""
    folder.mkdir()
    identified, again, payload = (str(folder / name) for name in ("model.yaml", "again.yaml", "payload.json"))
    model = model or identified
    assert main(["identify", first, "--arm", "psm", "--output", identified]) == 0
    assert main(["identify", "recalibrate", first, "--model", model, "--output", again]) == 0
    assert main(["payload", first, second, "--model", model, "--json", payload]) == 0
    return folder


@pytest.fixture(scope="module")
def results_from_csv(tmp_path_factory, motions):
    folder = tmp_path_factory.mktemp("csv")
    paths = [both(folder, f"motion{k}", load_arm("psm"), "npz", motion, "")[0] for k, motion in enumerate(motions)]
    return results(folder / "results", *paths, None)


@pytest.mark.parametrize("kind", (*BAG_KINDS, "v5"))
def test_motion(tmp_path, kind, motions):
    arm = load_arm("psm")
    assert_same_recordings(*both(tmp_path, "motion", arm, kind, motions[0], "/PSM1/measured_js"), arm)


@pytest.mark.slow
def test_commands_with_motions(tmp_path, motions, results_from_csv):
    arm, expected = load_arm("psm"), results_from_csv
    paths = [
        both(tmp_path, f"motion{k}", arm, "mcap", motion, "/PSM1/measured_js")[1] for k, motion in enumerate(motions)
    ]
    found = results(tmp_path / "results", *paths, str(expected / "model.yaml"))
    same_models(expected / "model.yaml", found / "model.yaml")
    same_models(expected / "again.yaml", found / "again.yaml")
    same_numbers(expected / "payload.json", found / "payload.json")
