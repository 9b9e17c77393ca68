"""Tests that each number of each file and setting has a range. NaN, infinity and too large numbers are refused."""

import dataclasses
import math
import re
import types
from pathlib import Path
from typing import Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import yaml
from arm_copies import copy_arm
from command_output import assert_refused, refused
from schema_faults import schema_fault

from dvrk_drake.analysis.excitation.pose_file import PoseFile
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel, ModelFile
from dvrk_drake.errors import ArmError, ControllerError, ScenarioError
from dvrk_drake.experiments.scenario import Scenario, load_scenario
from dvrk_drake.experiments.study import Study
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import (
    ArmDescription,
    CoupledLimit,
    Gains,
    Instrument,
    Mechanism,
    load_gains,
)
from dvrk_drake.models.effects_schema import ArmEffects, FrictionEffect
from dvrk_drake.models.ranges import RANGE, Range, number_fault, within
from dvrk_drake.processes.collector import CollectionSettings
from dvrk_drake.systems.driver import CrtkDriver, DvrkDriver
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.hand import Grip
from dvrk_drake.systems.station import load_station_config

#: Schemas of files.
FILES = (ArmDescription, Mechanism, Instrument, Gains, DvrkDriver, CrtkDriver, Scenario, Study, PoseFile, ModelFile)
#: Dataclasses with arrays, created by Python code.
OBJECTS = (Arm, GravityCompensationFile, CollectionSettings, Grip)


def numbers_of(schema: type, path: tuple = ()):
    """Yields (path, field, type) of each field with numbers. In a path, 0 is a list element and "x" a mapping entry."""
    hints = get_type_hints(schema)
    for field in dataclasses.fields(schema):
        yield from numbers_in(hints[field.name], (*path, field.name), field)


def numbers_in(kind, path, field):
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        for argument in arguments:
            yield from numbers_in(argument, path, field)
    elif origin in (list, tuple):
        yield from numbers_in(arguments[0], (*path, 0), field)
    elif origin is dict:
        yield from numbers_in(arguments[1], (*path, "x"), field)
    elif "ndarray" in str(origin).lower():  # numpy's class, or its alias NDArray since numpy 2.5
        if "float64" in str(kind):
            yield path, field, np.ndarray
    elif dataclasses.is_dataclass(kind):
        yield from numbers_of(kind, path)
    elif kind in (int, float):
        yield path, field, kind


def key_of(path) -> str:
    key = "".join(f"[{part}]" if part == 0 else f".{part}" for part in path)
    return key.removeprefix(".")


def nested(path, value):
    """Returns the content of a file that contains only `value` at `path`."""
    for part in reversed(path):
        value = [value] if part == 0 else {part: value}
    return value


def outside(allowed: Range) -> float:
    """Returns the smallest number above the range."""
    return allowed.high + 1 if isinstance(allowed.high, int) else float(np.nextafter(allowed.high, np.inf))


IN_FILES = {f"{schema.__name__}.{key_of(p)}": (schema, p, f, k) for schema in FILES for p, f, k in numbers_of(schema)}
IN_OBJECTS = {f"{schema.__name__}.{key_of(p)}": (p, f) for schema in OBJECTS for p, f, _ in numbers_of(schema)}


def test_all_schemas_are_covered():
    assert len(IN_FILES) > 120
    assert len(IN_OBJECTS) > 50
    assert {"ModelFile.joints[0].feedforward_scale", "DvrkDriver.guard.expiry", "Mechanism.gains.kp[0]"} <= set(
        IN_FILES
    )
    assert {"Arm.effort_limits", "Arm.gains.kp[0]", "Arm.linkage.matrix"} <= set(IN_OBJECTS)


def test_each_number_has_a_range_that_is_finite():
    fields = {name: field for name, (_, _, field, _) in IN_FILES.items()}
    for name, field in (fields | {name: field for name, (_, field) in IN_OBJECTS.items()}).items():
        allowed = field.metadata.get(RANGE)
        assert allowed is not None, f"{name} needs a range: field(metadata=within(low, high, unit))"
        assert math.isfinite(allowed.low) and math.isfinite(allowed.high) and allowed.low < allowed.high, name
        assert 1e300 not in allowed and -1e300 not in allowed and allowed.fault("", math.nan) != "", name


def test_a_file_with_a_number_outside_its_range_is_refused():
    for name, (schema, path, field, kind) in IN_FILES.items():
        allowed, key = field.metadata[RANGE], key_of(path)
        wrong = [outside(allowed), 10**300 if kind is int else -1e300, math.nan]
        wrong += [number for number in (math.inf, -math.inf) if number not in allowed]
        for value in wrong:
            fault = schema_fault(schema, nested(path, value))
            assert fault.startswith(f"{key} is ") and "; allowed: " in fault, name
        for value in (allowed.low, allowed.high, *allowed.also):
            content = nested(path, kind(value) if math.isfinite(value) else value)
            assert schema_fault(schema, content) == "", name


@pytest.mark.parametrize("value", [math.nan, math.inf, -1e300])
def test_an_arm_with_a_number_outside_its_range_is_refused(value):
    arm = load_arm("mtml")
    whole = dataclasses.replace(
        arm,
        friction_coordinates={"pulley": np.eye(7)[0]},
        locked_joints={"held": 0.0},
        position_offsets={"outer_yaw": 0.0},
    )
    for name, (path, _) in IN_OBJECTS.items():
        if name.startswith("Arm."):
            with pytest.raises(ArmError, match=r"allowed: |gravity \(") as refused:
                changed(whole, path, value)
            assert "\n" not in str(refused.value), name


def changed(owner, path, value):
    """Returns a copy of `owner` with `value` at `path`."""
    if not path:
        return np.full_like(owner, value) if isinstance(owner, np.ndarray) else value
    first, *rest = path
    if dataclasses.is_dataclass(owner):
        return dataclasses.replace(owner, **{first: changed(getattr(owner, first), rest, value)})
    if isinstance(owner, dict):
        key = next(iter(owner))
        return {**owner, key: changed(owner[key], rest, value)}
    return type(owner)([changed(owner[0], rest, value), *owner[1:]])


@pytest.mark.parametrize(
    ("gain", "value"),
    [(gain, value) for gain in ("kp", "kd", "ki") for value in (1e-9, 1e10, math.nan, math.inf, -1.0)],
)
def test_implausible_gains_are_refused_in_files_and_python(gain, value, tmp_path, capsys):
    arm = load_arm("psm")
    gains = {name: list(values) for name, values in vars(arm.gains).items()}
    gains[gain][2] = value
    with pytest.raises(ControllerError, match=rf"gains\.{gain}\[2\] is .*; allowed: "):
        GravityPidController(IdentifiedModel.from_arm(arm), gains=Gains(**gains))
    path = tmp_path / "gains.yaml"
    path.write_text(yaml.safe_dump(gains))
    assert_refused(ControllerError, rf"gains\.yaml: {gain}\[2\] is .*; allowed: ", load_gains, path)
    assert main(["control", "--arm", arm.source, "--mode", "hold", "--gains", str(path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"{gain}[2] is " in error


def test_gains_are_compared_with_the_effort_limit_and_the_range():
    arm = load_arm("mtml")
    width, least_error = arm.position_upper - arm.position_lower, 1e-4
    for share, ok in ((0.009, False), (0.011, True)):
        gains = dataclasses.replace(arm.gains, kp=(share * arm.effort_limits / width).tolist())
        assert (arm.gains_fault(gains) == "") == ok
    for share, ok in ((0.99, True), (1.01, False)):
        gains = dataclasses.replace(arm.gains, kp=(share * arm.effort_limits / least_error).tolist())
        assert (arm.gains_fault(gains) == "") == ok
    assert "for the position range and effort limit of outer_yaw" in arm.gains_fault(gains)
    with pytest.raises(ScenarioError, match=r"mtml: controller\.gains\.kp\[0\] is 1e\+06; allowed: .*outer_yaw"):
        load_scenario("mtml", [f"controller.gains={dataclasses.asdict(dataclasses.replace(gains, kp=[1e6] * 7))}"])


@pytest.fixture
def own_psm(tmp_path):
    """Returns a function that writes modified files of a PSM and returns the path of the arm file."""

    def write(changes=(), sdf=None):
        def with_values(kind):
            def change(text):
                content = yaml.safe_load(text)
                for file, keys, value in changes:
                    if file == kind:
                        put(content, keys, value)
                return yaml.safe_dump(content)

            return change

        def with_element(text):
            assert sdf is None or re.search(sdf[0], text, re.DOTALL)
            return text if sdf is None else re.sub(*sdf, text, count=1, flags=re.DOTALL)

        kinds = ("arm", "mechanism", "instrument")
        return copy_arm(tmp_path, "psm", **{kind: with_values(kind) for kind in kinds}, sdf=with_element)

    return write


def put(content, keys, value):
    *path, last = keys
    for key in path:
        content = content.setdefault(key, {})
    content[last] = value


SUM = {"name": "sum", "coefficients": {"yaw": 1.0, "pitch": 1.0}, "lower": -1.0, "upper": 1.0}
LIMITS, COUPLED = "position_limits", "coupled_limits"


@pytest.mark.parametrize(
    ("file", "keys", "value", "message"),
    [
        ("arm", (LIMITS, "yaw"), [-90, 90], r"position_limits\.yaw\[0\] is -90; allowed: .* rad; is it in degrees\?"),
        ("arm", (LIMITS, "insertion"), [0, 240], r"insertion\[1\] is 240; allowed: -30\.\.30 m; is it in mm\?"),
        ("arm", (LIMITS, "yaw"), [1.0, 1.0], r"position_limits\.yaw is \[1, 1\]; allowed: .* lower < upper"),
        ("arm", (LIMITS, "yaw"), [1.0, 1.001], r"yaw: upper - lower is 0\.001; allowed: 0\.01\.\.25\.2 rad"),
        ("arm", (LIMITS, "insertion"), [0.1, 0.1001], r"insertion: upper - lower is 0\.0001; allowed: 0\.001\.\.30 m"),
        ("mechanism", (COUPLED,), [{**SUM, "coefficients": {"yaw": 0.0}}], r"coupled_limits\.sum: all coefficients"),
        ("mechanism", (COUPLED,), [{**SUM, "coefficients": {"arm": 1.0}}], r'coupled_limits\.sum: unknown joint "arm"'),
        ("mechanism", (COUPLED,), [{**SUM, "coefficients": {"yaw": 1e9}}], r"coefficients\.yaw is 1e\+09; allowed: "),
        ("mechanism", (COUPLED,), [{**SUM, "lower": 1.0}], r"coupled_limits\.sum is \[1, 1\]; allowed: .* < upper"),
        ("mechanism", (COUPLED,), [{**SUM, "lower": 0.999}], r"coupled_limits\.sum: upper - lower is 0\.001; all"),
        (
            "mechanism",
            (COUPLED,),
            [{**SUM, "lower": 3.0, "upper": 4.0}],
            r"coupled_limits\.sum: no pose within position_limits meets 3\.\.4; allowed: .* -2\.513\.\.2\.513",
        ),
        (
            "mechanism",
            (COUPLED,),
            [{**SUM, "upper": -0.5}, {**SUM, "name": "same", "lower": 0.5}],
            "coupled_limits: no pose within position_limits meets all coupled limits",
        ),
        ("mechanism", ("transmission",), {"yaw": {"yaw": 0.0}}, r"transmission\.yaw: all coefficients are 0"),
        ("mechanism", ("transmission",), {"yaw": {"yaw": 1e9}}, r"transmission\.yaw\.yaw is 1e\+09; allowed: 0 or "),
        ("instrument", ("joint_from_actuator", "roll"), {"roll": 0.0}, r"joint_from_actuator\.roll: all coefficients"),
        ("instrument", ("friction_coordinates", "finger_1"), {"jaw": 0.0}, r"friction_coordinates\.finger_1: all c"),
        ("mechanism", ("motion", "effort_delay"), [5.0, 0, 0], r"effort_delay\[0\] is 5; .*0\.2 s; is it in ms\?"),
        ("mechanism", ("gains", "kp"), [1e-4, 99.0, 1320.0], r"gains\.kp\[0\] is 0\.0001; .* effort limit of yaw"),
        ("mechanism", ("gains", "kd"), [9.5, 1e5, 79.0], r"gains\.kd\[1\] is 100000; allowed: 0 or .* limit of pitch"),
        ("mechanism", ("gains", "ki"), [9.5, 9.5, 1e8], r"gains\.ki\[2\] is 1e\+08; .* effort limit of insertion"),
    ],
)
def test_implausible_numbers_in_arm_files_are_refused(file, keys, value, message, own_psm, capsys):
    path = own_psm([(file, keys, value)])
    with pytest.raises(ArmError, match=message) as caught:
        load_arm(str(path))
    assert "\n" not in str(caught.value) and str(path.parent) in str(caught.value)
    assert refused(capsys, "equations", "--arm", path)


@pytest.mark.parametrize(
    ("element", "value", "message"),
    [
        ("<effort>3[^<]*", "<effort>1e9", r"<effort> is 1e\+09; allowed: -1 or 0 or 0\.001\.\.1e\+06 N m or N"),
        ("<effort>3[^<]*", "<effort>0", r"joint yaw needs a positive effort limit"),
        ("<mass>[^<]*", "<mass>1470.5", r"<mass> is 1470\.5; allowed: 1e-06\.\.200 kg; is it in g\?"),
        ("<ixx>[^<]*", "<ixx>26605", r"<ixx> is 26605; allowed: 0\.\.50 kg m\^2"),
        ("<pose>[^<]*", "<pose>0 0 150 0 0 0", r"<pose> is 150; allowed: -5\.\.5 m; is it in mm\?"),
        ("<pose>[^<]*", "<pose>0 0 0 90 0 0", r"<pose> is 90; allowed: -12\.6\.\.12\.6 rad; is it in degrees\?"),
        ("<velocity>[^<]*", "<velocity>180", r"<velocity> is 180; .* rad/s or m/s; is it in degrees/s or mm/s\?"),
        ('multiplier="[^"]*', 'multiplier="1e9', r"multiplier is 1e\+09; allowed: 0 or 0\.001\.\.1000 of either sign"),
        ('offset="[^"]*', 'offset="90', r"offset is 90; allowed: .*; is it in degrees or mm\?"),
    ],
)
def test_implausible_numbers_in_an_sdf_are_refused(element, value, message, own_psm, capsys):
    path = own_psm(sdf=(element, value))
    assert_refused(ArmError, message, load_arm, str(path))
    assert refused(capsys, "equations", "--arm", path)


def test_pose_with_degrees_attribute_is_read(own_psm):
    path = own_psm(sdf=("<pose>[^<]*", '<pose degrees="true">0 0 0 90 0 0'))
    assert load_arm(str(path)).num_joints == 7


def test_invalid_numbers_of_an_arm_made_in_python_are_refused():
    arm = load_arm("mtml")
    never = CoupledLimit("never", {"outer_yaw": 0.0}, 0.0, 1.0)
    for changes, message in (
        ({"coupled_limits": (never,)}, r"coupled_limits\.never: all coefficients are 0"),
        ({"coupled_limits": (dataclasses.replace(never, coefficients={"outer_yaw": math.nan}),)}, "is nan; allowed"),
        ({"effort_limits": arm.effort_limits[:6]}, "effort_limits has 6 numbers; allowed: 7, one per joint"),
        ({"gains": Gains([1.0], [1.0], [1.0])}, r"gains\.kp has 1 number; allowed: 7, one per joint"),
        ({"effects": ArmEffects(friction=[FrictionEffect(coefficient=math.nan)])}, r"coefficient is nan; allowed: "),
        ({"friction_coordinates": {"nothing": np.zeros(7)}}, r"friction_coordinates\.nothing: all coefficients are 0"),
        ({"gravity": np.array([20.0, 20.0, 20.0])}, "must be a vector of three numbers with a norm up to 30"),
    ):
        assert_refused(ArmError, message, dataclasses.replace, arm, **changes)


def test_messages_of_ranges():
    assert str(Range(0.5, 2.0, "s")) == "0.5..2 s"
    assert str(Range(0.5, 2.0, also=(0.0,), either_sign=True)) == "0 or 0.5..2 of either sign"
    assert str(Range(0, 10**6)) == "0..1000000"
    assert -1.0 in Range(0.5, 2.0, either_sign=True) and -1.0 not in Range(0.5, 2.0)
    assert Range(0.0, 1.0, "rad or m").fault("a", 1.5) == "a is 1.5; allowed: 0..1 rad or m; is it in degrees or mm?"
    assert Range(0.0, 1.0, "rad").fault("a", 100.0) == "a is 100; allowed: 0..1 rad"
    assert Range(0.0, 1.0).fault("a", math.nan) == "a is nan; allowed: 0..1"


@dataclasses.dataclass
class Inner:
    table: dict[str, list[float]] = dataclasses.field(default_factory=dict, metadata=within(0.0, 1.0))


@dataclasses.dataclass
class Outer:
    inner: Inner
    array: np.ndarray
    free: float = 0.0


def test_first_refused_number_of_an_object_is_named():
    good = Outer(Inner({"a": [0.5]}), np.zeros((2, 2)))
    assert number_fault(good) == ""
    assert (
        number_fault(dataclasses.replace(good, inner=Inner({"a": [0.5, 2]}))) == "inner.table.a[1] is 2; allowed: 0..1"
    )
    array = np.array([[0.0, 1.0], [math.nan, 0.0]])
    assert number_fault(dataclasses.replace(good, array=array)) == "array[1][0] is nan; allowed: a finite number"
    assert number_fault(dataclasses.replace(good, free=-math.inf)) == "free is -inf; allowed: a finite number"


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[2] / "examples").glob("*.yaml")), ids=lambda p: p.name)
def test_the_examples_are_inside_the_ranges(path):
    content = yaml.safe_load(path.read_text())
    if "arms" in content:
        load_station_config(path)
    else:
        assert schema_fault(Study if "scenario" in content else Scenario, content) == ""
