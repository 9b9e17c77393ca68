"""Tests YAML files. At any nesting depth, errors name the key, its value and the accepted values."""

from dataclasses import dataclass, field

import pytest
from arm_copies import copy_arm
from command_output import assert_refused
from pydrake.common.yaml import yaml_load_typed
from schema_faults import schema_fault

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.sdf_model import MODELS_FOLDER
from dvrk_drake.models.typed_yaml import load_typed_yaml, parse_yaml, typed_content

pytestmark = pytest.mark.drake_api


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("arm", ("name:", "nam:"), 'key "nam" is unknown; did you mean "name"? allowed in an arm file: format, sdf,'),
        ("arm", ("name: PSM", "name: [PSM]"), "name is ['PSM']; allowed: a string"),
        ("arm", ("name: PSM", "name: PSM\ngravity: 9.81"), "gravity is 9.81; allowed: a list of numbers, e.g. [9.81]"),
        ("arm", ("yaw: [", "yaw: [low, "), 'position_limits.yaw[0] is "low"; allowed: a number'),
        ("mechanism", ("joints:", "jonts:"), 'key "jonts" is unknown; did you mean "joints"? allowed in a mechanism'),
        ("mechanism", ("\n  kp:", "\n  Kp:"), 'gains: key "Kp" is unknown; did you mean "kp"? allowed in gains: kp,'),
        ("mechanism", ("{frame_a:", "{frame_c:"), 'loop_closures[0]: key "frame_c" is unknown; allowed in'),
        ("arm", ("position_limits:", "position_limits: 3\neffort_limits:"), "position_limits is 3; allowed: a"),
        ("instrument", ("sdf:", "sdf: [\n"), "instrument.yaml:"),
    ],
)
def test_error_names_file_and_accepted_values(file, change, message, tmp_path):
    arm, path = copy_arm(tmp_path, "psm"), tmp_path / f"{file}.yaml"
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change, 1))
    with pytest.raises(ArmError) as refusal:
        load_arm(str(arm))
    assert str(refusal.value).startswith(f"{path}:")
    assert message in str(refusal.value)


@dataclass
class Inner:
    number: float = 0.0


@dataclass
class Outer:
    count: int = 0
    size: float = 0.0
    good: bool = False
    name: str = ""
    sizes: list[float] = field(default_factory=list)
    inner: Inner = field(default_factory=Inner)
    perhaps: Inner | None = None
    table: dict[str, list[int]] = field(default_factory=dict)


@pytest.mark.parametrize(
    "line",
    [
        *("count: 3", "count: 3.0", "count: 3.5", "count: '3'", "count: three", "count: true", "count:"),
        *("size: 3", "size: 1e-3", "size: .nan", "size: x", "size: false", "size: [1]", "size: {a: 1}"),
        *("good: true", "good: 'true'", "good: 1", "good: maybe", "name: x", "name: 3", "name: true", "name:"),
        *("sizes: []", "sizes: [1, 2.5]", "sizes: [a]", "sizes: 3", "inner: {}", "inner: {number: 2}", "inner: 3"),
        *("perhaps:", "perhaps: {number: 1}", "perhaps: {numbr: 1}", "perhaps: 3", "other: 3", "size: 2026-01-01"),
        *("table: {a: [1]}", "table: {a: [b]}", "table: [1]", "table:", "inner: {number: x}", "inner:"),
    ],
)
def test_accepts_the_same_content_as_drake(line):
    """Checks that the schema accepts the same content as Drake, except for numbers that are not finite."""
    try:
        expected = yaml_load_typed(schema=Outer, data=line)
    except Exception:
        expected = None
    content = parse_yaml(line, "here", ArmError)
    if expected is None or ".nan" in line:
        assert schema_fault(Outer, content)
    else:
        assert typed_content(Outer, content, "here", ArmError, "a test") == expected


def test_text_in_place_of_a_list_is_refused():
    assert yaml_load_typed(schema=Outer, data="sizes: '12'").sizes == [1.0, 2.0]
    assert schema_fault(Outer, {"sizes": "12"}) == 'sizes is "12"; allowed: a list of numbers, e.g. [12]'


def test_duplicate_key_is_refused():
    for text, line in (("a: 1\nb: 2\na: 3\n", 3), ("b:\n  c: {d: 1, d: 2}\n", 2)):
        with pytest.raises(ArmError, match=rf'own.yaml: invalid YAML: line {line}: duplicate key "[ad]"'):
            parse_yaml(text, "own.yaml", ArmError)
    assert parse_yaml("a: &x {c: 1}\nb: {<<: *x, c: 2}\n", "own.yaml", ArmError)["b"] == {"c": 2}


def test_missing_and_binary_files_are_refused(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"name: \xff")
    for where, message in (
        (path, "is not a UTF-8 text file"),
        (tmp_path, "is not a file but a folder"),
        (tmp_path / "x", "no such file"),
    ):
        assert_refused(ArmError, f"{where}:? {message}", load_typed_yaml, Outer, where, ArmError, "a test")


@pytest.mark.parametrize("version", ["dvrk_drake arm 2.0", "dvrk_drake model 1.0", 1.0, None, ["dvrk_drake arm 1.0"]])
def test_arm_of_another_format_is_refused_before_its_keys(version, tmp_path):
    text = (MODELS_FOLDER / "arms" / "psm.yaml").read_text()
    path = tmp_path / "arm.yaml"
    # The format may be omitted.
    path.write_text("\n".join(line for line in text.splitlines() if not line.startswith("format:")))
    assert load_arm(path).name == "PSM"
    path.write_text(text.replace("format: dvrk_drake arm 1.0", f"format: {version}\nnew_key: 1"))
    assert_refused(ArmError, r'arm\.yaml: format is .*; allowed: "dvrk_drake arm 1\.0"$', load_arm, path)


def test_files_of_this_package_state_their_format():
    paths = [path for folder in ("arms", "mechanisms", "instruments") for path in (MODELS_FOLDER / folder).iterdir()]
    for path in paths:
        assert f"\nformat: dvrk_drake {path.parent.name.removesuffix('s')} 1.0\n" in path.read_text(), path
