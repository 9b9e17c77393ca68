"""Compares the dVRK's gravity-compensation file for an MTM with the model, by an independent evaluation."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from command_output import assert_refused, refused
from figure_rules import checked_figures

from dvrk_drake.cli import main
from dvrk_drake.dynamics.actuator_effects import joint_row
from dvrk_drake.dynamics.dynamic_section import DynamicSection
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError
from dvrk_drake.export.dvrk_mtm_gravity_compensation import (
    CompensationOptions,
    compare_compensation,
    compensation_from_model,
    compensation_loss,
    dry_friction,
)
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import (
    GravityCompensationFile,
    controller_torque,
)
from dvrk_drake.export.gravity_compensation_loss import LEAST_TOLERANCE, accepted_differences
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.reports.export import compensation_page
from dvrk_drake.reports.image_files import write_images

pytestmark = pytest.mark.slow

#: Gravity vector [m/s^2] of an arm whose base is tilted by 2.3 degrees.
TILTED = [0.01, -0.39, -9.80]


def dvrk_controller(path, q, qd):
    """Returns the torque (7,) that the dVRK computes from the file for one pose, without code of this package."""
    content = json.loads(Path(path).read_text())
    assert content["version"] == "2.0"
    gc = content["GC_controller"]
    g = 9.81
    s, c = [None] + [math.sin(x) for x in q], [None] + [math.cos(x) for x in q]
    S, C = math.sin(q[1] + q[2]), math.cos(q[1] + q[2])
    shoulder = [
        g * s[2],
        g * c[2],
        g * C,
        -g * S,
        g * C * c[4],
        -g * C * s[4],
        -g * (S * c[5] + C * c[4] * s[5]),
        g * (C * c[4] * c[5] - S * s[5]),
        g * (C * s[4] * s[6] + S * c[6] * s[5] - C * c[4] * c[5] * c[6]),
        g * (C * c[6] * s[4] - S * s[5] * s[6] + C * c[4] * c[5] * s[6]),
    ]
    rows = [
        [],
        shoulder,
        [0, 0, *shoulder[2:]],
        [
            *[0] * 4,
            -g * S * s[4],
            -g * S * c[4],
            g * S * s[4] * s[5],
            -g * S * c[5] * s[4],
            g * S * (c[4] * s[6] + c[5] * c[6] * s[4]),
            g * S * (c[4] * c[6] - c[5] * s[4] * s[6]),
        ],
        [
            *[0] * 6,
            -g * (C * s[5] + S * c[4] * c[5]),
            g * (C * c[5] - S * c[4] * s[5]),
            g * (-C * c[5] * c[6] + S * c[4] * c[6] * s[5]),
            g * (C * c[5] * s[6] - S * c[4] * s[5] * s[6]),
        ],
        [
            *[0] * 8,
            g * (S * c[6] * s[4] + C * s[5] * s[6] + S * c[4] * c[5] * s[6]),
            g * (C * c[6] * s[5] - S * s[4] * s[6] + S * c[4] * c[5] * c[6]),
        ],
        [],
    ]
    tau = []
    for i in range(7):
        ratio, db, sat = gc["fric_comp_ratio_vec"][i], gc["db_vel_vec"][i], gc["sat_vec_vec"][i]
        speed = abs(qd[i])
        blend = 0.0 if speed <= db else 1.0 if speed >= sat else (speed - db) / (sat - db)
        alpha = 0.5 + math.copysign(0.5 * ratio * blend, qd[i])
        both = []
        for key in ("gc_dynamic_params_pos", "gc_dynamic_params_neg"):
            p = gc[key]
            value = sum(a * b for a, b in zip(rows[i], p, strict=False))
            if i < 6:
                value += sum(p[10 + 5 * i + k] * q[i] ** k for k in range(5))
            both.append(value)
        value = alpha * both[0] + (1 - alpha) * both[1]
        tau.append(min(max(value, gc["safe_lower_torque_limit"][i]), gc["safe_upper_torque_limit"][i]))
    return tau


def balanced(name="mtml"):
    """Returns a model that the file can represent. The centre of mass of the last link is on its axis."""
    model = IdentifiedModel.from_arm(load_arm(name))
    generator = np.random.default_rng(3)
    for p in model.base_parameters:
        p.value = 0.0 if p.name.startswith("m7 c7") else p.value * (1 + 0.2 * generator.normal())
    return model


@pytest.mark.parametrize("name", ["mtml", "mtmr"])
def test_file_gives_the_torque_of_the_model(name, tmp_path):
    model = balanced(name)
    model.effects = [
        DriveEffect("joint.outer_yaw", "offset", 0.0, 0.03),
        DriveEffect("joint.shoulder_pitch", "cable sine", 1.0, -0.1),
        DriveEffect("joint.shoulder_pitch", "cable cosine", 1.0, 0.04),
        DriveEffect("actuator.wrist_platform", "offset", 0.0, -0.01),
        DriveEffect("joint.wrist_pitch", "spring", 4.0, 0.02),
    ]
    arm = model.arm
    path = tmp_path / "gc.json"
    compensation_from_model(model).save(path, arm.name, "test")
    q = arm.sample_poses(300, np.random.default_rng(11))
    expected = model.holding_torque(q)
    assert np.ptp(expected, axis=0)[1:6].min() > 0.01  # The torques are large enough for a comparison.
    actual = np.array([dvrk_controller(path, pose, np.zeros(7)) for pose in q])
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-10)


def test_friction_is_half_the_difference_of_the_directions(tmp_path):
    coulomb = (0.05, 0.06, 0.04, 0.02, 0.01, 0.005, 0.0)
    file = compensation_from_model(balanced(), CompensationOptions(coulomb=coulomb, friction_ratio=(1.0,) * 7))
    path = tmp_path / "gc.json"
    file.save(path, "MTML", "test")
    q = [0.1, 0.3, -0.1, 0.2, 0.5, 0.1, 0.4]
    up, rest, down = (np.array(dvrk_controller(path, q, [v] * 7)) for v in (1.0, 0.0, -1.0))
    np.testing.assert_allclose(up - rest, coulomb, atol=1e-12)
    np.testing.assert_allclose(rest - down, coulomb, atol=1e-12)


def test_friction_of_a_model_is_that_of_single_joints():
    model = balanced()
    assert_refused(ModelError, "no dynamics", dry_friction, model)
    model.dynamics = DynamicSection(
        effects=[
            DriveEffect("actuator.outer_yaw", "coulomb", 0.1, 0.05),
            DriveEffect("actuator.outer_yaw", "presliding", 0.01, 0.02),
            DriveEffect("actuator.outer_yaw", "viscous", 0.0, 9.0),
            DriveEffect("actuator.wrist_platform", "coulomb", 0.1, 0.01),  # Joints 3 and 4 move this actuator.
        ]
    )
    np.testing.assert_allclose(dry_friction(model), [0.07, 0, 0.006697, 0.01, 0, 0, 0], rtol=0, atol=1e-12)


def test_torque_limits_are_the_torque_range_plus_ten_percent():
    model = balanced()
    arm = model.arm
    file = compensation_from_model(model)
    tau = model.holding_torque(arm.sample_poses(100000, np.random.default_rng(12)))
    rounding = 1e-15  # the torque of the balanced roll is a sum of terms that cancel
    assert np.all((tau >= file.torque_lower - rounding) & (tau <= file.torque_upper + rounding))
    assert np.all(np.abs([file.torque_lower, file.torque_upper]) <= arm.effort_limits)
    # The margin is 10 % at both ends, and the ranges of the two samples differ by a few percent.
    assert np.all(np.ptp([file.torque_lower, file.torque_upper], axis=0) <= 1.25 * np.ptp(tau, axis=0) + 1e-9)
    for p in model.base_parameters:
        p.value *= 8  # The torque exceeds the effort limits.
    file = compensation_from_model(model)
    assert file.torque_upper[1] == arm.effort_limits[1]


def test_rejects_a_model_that_the_file_cannot_represent():
    eccentric = IdentifiedModel.from_arm(load_arm("mtml"))
    for p in eccentric.base_parameters:
        p.value *= 3 if p.name.startswith("m7 c7") else 1
    with pytest.raises(
        ModelError, match=r"wrist_yaw 0\.0066 N m \(6\.\d % of .*, allowed: 0\.0054 .*roll axis"
    ) as error:
        compensation_from_model(eccentric)
    assert not any(word in str(error.value) for word in ("shoulder_pitch", "wrist_roll", "tilt"))
    # The tolerance in the message is sufficient.
    tolerance = float(str(error.value).split("--gc-tolerance ")[1])
    compensation_from_model(eccentric, CompensationOptions(tolerance=tolerance))
    with pytest.raises(ModelError, match="repeat the command with"):
        compensation_from_model(eccentric, CompensationOptions(tolerance=0.95 * tolerance))
    spring = balanced()
    spring.effects = [DriveEffect("joint.wrist_pitch", "cable sine", 1.0, 0.05)]
    with pytest.raises(ModelError, match=r"wrist_pitch 0\.0\d+ N m \(.*cause: effect joint.wrist_pitch cable sine 1\)"):
        compensation_from_model(spring, CompensationOptions(tolerance=1e-6))
    # A polynomial of order 4 approximates 0.05 sin(q) over +-2.44 rad with an error of a few percent.
    compensation_from_model(spring, CompensationOptions(tolerance=0.05 * 0.08))
    for change, cause in (({"feedforward_scale": 0.5}, "feedforward scale"), ({"gravity": TILTED}, "tilt of 2.3 deg")):
        model = balanced()
        if "feedforward_scale" in change:
            model.joints[4].feedforward_scale = change["feedforward_scale"]
        else:
            model.arm = model.arm.with_gravity(change["gravity"])
            model.base_parameters = IdentifiedModel.from_arm(model.arm).base_parameters
        with pytest.raises(ModelError, match=f"cannot represent.*cause: .*{cause}"):
            compensation_from_model(model, CompensationOptions(tolerance=1e-3))
    assert_refused(ModelError, "is not an MTM", compensation_from_model, IdentifiedModel.from_arm(load_arm("psm")))
    with pytest.raises(ModelError, match="dead_band must be 7 numbers"):
        compensation_from_model(balanced(), CompensationOptions(dead_band=(0.1,)))
    with pytest.raises(ModelError, match=r"fric_comp_ratio_vec\[\d\] is .*; allowed: 0\.\.1"):
        compensation_from_model(balanced(), CompensationOptions(friction_ratio=(2.0,) * 7))


@pytest.mark.parametrize("name", ["mtml", "mtmr"])
def test_default_tolerance_is_the_dry_friction_of_each_joint(name):
    """The torque of the last link's eccentric mass has the amplitude m c g on this link's axis."""
    model = IdentifiedModel.from_arm(load_arm(name))
    loss = compensation_loss(compensation_from_model(model), model)
    eccentric = np.hypot(*(p.value for p in model.base_parameters if p.name.startswith("m7 c7")))
    assert loss.difference[-1] == pytest.approx(9.81 * eccentric, rel=1e-3)
    assert np.all(loss.difference <= model.arm.dry_friction()) and loss.joints[loss.worst] == "wrist_roll"
    assert set(loss.causes[1:]) == {"centre of mass of the last link off the roll axis"} and loss.causes[0] == ""
    # At the poses of the loss, the torques have the stated difference.
    off = controller_torque(compensation_from_model(model), loss.poses) - model.holding_torque(loss.poses)
    np.testing.assert_allclose(np.abs(off).diagonal(), loss.difference, rtol=0, atol=1e-12)
    accepted = accepted_differences(model.arm, None)
    np.testing.assert_allclose(accepted, model.arm.dry_friction(), rtol=0, atol=1e-12)
    assert accepted[-1] < 0.2 * model.arm.effort_limits[-1]
    frictionless = dataclasses.replace(model.arm, effects=dataclasses.replace(model.arm.effects, friction=[]))
    assert np.all(accepted_differences(frictionless, None) == LEAST_TOLERANCE)


def test_joint_without_feedforward_gets_no_torque():
    model = balanced()
    model.joints[5].feedforward_scale = 0.0
    file = compensation_from_model(model, CompensationOptions(coulomb=(0.01,) * 7, tolerance=1e-9))
    q = model.arm.sample_poses(300, np.random.default_rng(6))
    actual = controller_torque(file, q, np.full_like(q, 0.5))[:, 5]
    assert np.all(actual == 0.0) and np.abs(controller_torque(file, q)[:, 4]).max() > 0.01


def test_loss_names_each_effect():
    model = balanced()
    model.effects = [
        DriveEffect("joint.wrist_pitch", "cable sine", 2.0, 0.01),
        DriveEffect("joint.wrist_roll", "offset", 0.0, 0.002),
        DriveEffect("actuator.wrist_platform", "spring", 7.0, 0.05),
    ]
    loss = compensation_loss(compensation_from_model(model, CompensationOptions(tolerance=1.0)), model)
    assert loss.causes[4] == "effect joint.wrist_pitch cable sine 2"
    assert loss.causes[6] == "effect joint.wrist_roll offset" and loss.difference[6] == pytest.approx(0.002)
    # Two joints move the actuator of the platform. The polynomial of each joint omits the motion of the other joint.
    assert loss.causes[2] == loss.causes[3] == "effect actuator.wrist_platform spring 7"
    row = np.abs(joint_row(model.arm, "actuator.wrist_platform"))
    bounds = np.maximum(np.abs(model.arm.position_lower), np.abs(model.arm.position_upper))
    omitted = 0.05 * row[2] * row[3] * bounds[[3, 2]]
    assert omitted[1] < 0.3 * 0.05 * bounds[3]  # Without a polynomial, the whole torque of the spring is omitted.
    np.testing.assert_allclose(loss.difference[[2, 3]], omitted, rtol=0.1, atol=1e-9)


@pytest.mark.parametrize("tolerance", ["nan", "inf", "-1"])
@pytest.mark.parametrize(("arm", "option"), [("mtml", "--dvrk-gc"), ("psm", "--dvrk-kinematic-gc")])
def test_rejects_an_invalid_tolerance(arm, option, tolerance, tmp_path, capsys):
    path = tmp_path / "gc.json"
    assert main(["export", "--arm", arm, option, str(path), f"--gc-tolerance={tolerance}"]) == 2
    assert f"--gc-tolerance is {tolerance}; allowed: a finite number of 0 or more [N m, N]" in capsys.readouterr().err
    assert not path.exists()


def test_tilted_base_is_rejected_or_approximated(tmp_path, capsys):
    model = balanced()
    model.arm = model.arm.with_gravity(TILTED)
    model.base_parameters = IdentifiedModel.from_arm(model.arm).base_parameters
    given, out = tmp_path / "model.yaml", tmp_path / "gc.json"
    model.save(given)
    error = refused(capsys, "export", "--model", given, "--dvrk-gc", out, "--gc-tolerance", "0.001")
    assert "base tilt of 2.3 deg" in error and not out.exists()
    # With the option in the message, the error of the file is the error in the message.
    tolerance = error.split("--gc-tolerance ")[1]
    assert main(["export", "--model", str(given), "--dvrk-gc", str(out), "--gc-tolerance", tolerance]) == 0
    printed = capsys.readouterr().out
    q = model.arm.sample_poses(300, np.random.default_rng(5))
    controller = np.array([dvrk_controller(out, pose, np.zeros(7)) for pose in q])
    error_of_file = np.abs(controller - model.holding_torque(q)).max(axis=0)
    stated = compensation_loss(GravityCompensationFile.load(out), model).difference
    assert np.all(error_of_file <= 1.1 * stated + 1e-9) and error_of_file.max() < 1.1 * float(tolerance)
    assert all(f"{x:.2g}" in printed for x in stated if x > 1e-9)
    # The polynomial reduces the error of the outer yaw, whose gravity torque is due to the tilt only.
    assert stated[0] < 0.6 * np.abs(model.holding_torque(q)[:, 0]).max()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda gc: gc.pop("sat_vec_vec"), "keys missing in GC_controller: sat_vec_vec"),
        (lambda gc: gc["gc_dynamic_params_pos"].pop(), "gc_dynamic_params_pos must be 40 finite numbers"),
        (lambda gc: gc["db_vel_vec"].__setitem__(0, "x"), "db_vel_vec must be 7 finite numbers"),
        (lambda gc: gc["db_vel_vec"].__setitem__(0, 5.0), "db_vel_vec[0] (5) must be below sat_vec_vec[0]"),
        (lambda gc: gc["safe_lower_torque_limit"].__setitem__(1, 9.0), "torque_limit[1] (9) must not exceed"),
    ],
)
def test_invalid_file_is_rejected_in_one_line(change, message, tmp_path, capsys):
    path = tmp_path / "gc.json"
    compensation_from_model(balanced()).save(path, "MTML", "test")
    content = json.loads(path.read_text())
    change(content["GC_controller"])
    path.write_text(json.dumps(content))
    error = refused(capsys, "export", "compare", path, "--arm", "mtml")
    assert message in error and str(path) in error


def as_version_1(path, version, **changes):
    """Rewrites a gravity-compensation file in version 1, which has one speed per joint instead of the friction rule."""
    content = json.loads(path.read_text())
    controller = content["GC_controller"]
    for key in ("db_vel_vec", "sat_vec_vec", "fric_comp_ratio_vec"):
        del controller[key]
    content["GC_controller"] = {**controller, "beta_vel_amplitude": [2.0] * 7, **changes}
    path.write_text(json.dumps({**content, "version": version}))


@pytest.mark.parametrize("version", ["1.0", "1", 1.0])
def test_file_of_version_1_has_the_same_torque_at_rest(version, tmp_path):
    path, model = tmp_path / "gc.json", balanced()
    compensation_from_model(model, CompensationOptions(coulomb=(0.05,) * 7)).save(path, "MTML", "test")
    q = model.arm.sample_poses(5, np.random.default_rng(2))
    expected = controller_torque(GravityCompensationFile.load(path), q)
    as_version_1(path, version)
    np.testing.assert_allclose(controller_torque(GravityCompensationFile.load(path), q), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("version", "changes", "message"),
    [
        ("1.0", {"beta_vel_amplitude": [0.0] * 7}, r"beta_vel_amplitude must be 7 positive numbers \[rad/s\]"),
        ("1.0", {"safe_upper_torque_limit": [1.0]}, "safe_upper_torque_limit must be 7 finite numbers"),
        ("3.0", {}, """version is '3.0'; allowed: "1.0", "2.0\""""),
        ("new", {}, "version is 'new'; allowed: "),
        (None, {}, "version is None; allowed: "),
    ],
)
def test_invalid_file_of_version_1_is_refused(version, changes, message, tmp_path):
    path = tmp_path / "gc.json"
    compensation_from_model(balanced()).save(path, "MTML", "test")
    as_version_1(path, version, **changes)
    assert_refused(ModelError, message, GravityCompensationFile.load, path)


def test_comparison_detects_runaway_clipping_and_wrong_sign(tmp_path, monkeypatch):
    model = balanced()
    file = compensation_from_model(model)
    clean = compare_compensation(file, model)
    assert not np.any(clean.clipped | clean.opposed | clean.runaway)
    np.testing.assert_allclose(clean.rms_difference(~clean.in_sweep), 0.0, atol=1e-12)
    assert clean.warnings == ()
    unlimited = dataclasses.replace(file, torque_lower=file.torque_lower - 2.0 * (np.arange(7) == 3))
    (warning,) = compare_compensation(unlimited, model).warnings
    assert "do not protect the arm: wrist_platform " in warning and "(effort limit 0.309 N m)" in warning

    altered = dataclasses.replace(file)
    for which in (altered.positive, altered.negative):
        which[10 + 5 + 4] = 20.0  # 20 q2^4 N m: 33 N m at the upper limit
    altered.torque_upper[2] = np.median(clean.model_torque[:, 2])
    found = compare_compensation(altered, model)
    assert found.runaway[:, 1].mean() > 0.3
    np.testing.assert_allclose(found.clipped[:, 2].mean(), 0.5, atol=0.01)
    limits = {"torque_lower": -file.torque_upper, "torque_upper": -file.torque_lower}
    mirrored = dataclasses.replace(file, positive=-file.positive, negative=-file.negative, **limits)
    opposed = compare_compensation(mirrored, model).opposed.mean(axis=0)
    assert opposed[1] > 0.8 and opposed[4] > 0.5
    with checked_figures(monkeypatch):
        (path,) = write_images(compensation_page(found), tmp_path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_export_and_compare_commands(tmp_path, capsys):
    model, out = tmp_path / "model.yaml", tmp_path / "gc.json"
    balanced().save(model)
    assert main(["export", "--model", str(model), "--dvrk-gc", str(out), "--coulomb", *["0.01"] * 7]) == 0
    assert "shoulder_pitch" in capsys.readouterr().out
    report = tmp_path / "report.json"
    assert main(["export", "compare", str(out), "--model", str(model), "--json", str(report)]) == 0
    joints = json.loads(report.read_text())["joints"]
    assert [j["clipped"] for j in joints] == [0.0] * 7 and joints[0]["rms_inside"] is None
    out.unlink()
    error = refused(capsys, "export", "--arm", "mtml", "--dvrk-gc", out, "--gc-tolerance", "0.001")
    assert not out.exists()
    # The command with the option in the message is accepted, and the command with the default tolerance.
    options = error.split("repeat the command with ")[1].split()
    assert main(["export", "--arm", "mtml", "--dvrk-gc", str(out), *options]) == 0 and out.exists()
    capsys.readouterr()
    out = tmp_path / "gc-MTML-12345.json"
    assert main(["export", "--arm", "mtml", "--dvrk-gc", str(out)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "at most 9.3 % of the effort limit (wrist_roll, 0.0021 N m)" in printed and "estimates" in printed
    assert 'enter "gravity_compensation": "gc-MTML-12345.json" in the JSON file of the arm' in printed
    assert "usual name" not in printed
    capsys.readouterr()
    assert main(["export", "--model", str(model)]) == 2
    assert "--dvrk-gc" in capsys.readouterr().err
    assert main(["export", "--model", str(model), "--dvrk-gc", str(model)]) == 2
    assert "is an input" in capsys.readouterr().err
