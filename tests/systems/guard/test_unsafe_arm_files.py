"""Comparison of arm files with the arm of this package that has the same name."""

import dataclasses
import re

import pytest
from arm_copies import copy_arm

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.models.arm_schema import LinearMap
from dvrk_drake.models.sdf_model import MODELS_FOLDER
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.unsafe_arm import unsafe_difference

PSM = load_arm("psm")
YAW = "wrist_yaw: [-0.785398, 0.785398]"
MECHANISM = (MODELS_FOLDER / "mechanisms" / "mtm.yaml").read_text()
SDF = MODELS_FOLDER / "sdf" / "mtml.sdf"


def mtml(folder, *, arm=(), mechanism=(), sdf=(), name="MTML"):
    """Returns an MTML whose files contain replacements (old, new) of texts."""

    def replaced(text, replacements):
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new, 1)
        return text

    limits = f"position_limits: {{{YAW}}}\n"
    path = copy_arm(
        folder,
        "mtml",
        arm=lambda text: replaced(text + limits, arm).replace("name: MTML", f"name: {name}"),
        mechanism=lambda text: replaced(text, mechanism),
        sdf=lambda text: replaced(text, sdf),
    )
    return load_arm(path)


HINT = "as for the arm MTML of dvrk_drake; correct the file, or give the arm another name"
KP, KD = "kp: [60.0, 90.0, 40.0,", "kd: [8.0, 12.0,"
PLATFORM = "the coefficient of joint elbow_pitch in the transmission of wrist_platform is {}; allowed: 0.6697 +- 0.25, "
ELBOW = "  elbow_pitch: {{shoulder_pitch: {}, elbow_pitch: 1.0}}\n"
PARALLELOGRAM = MECHANISM[MECHANISM.index("coupled_limits:") : MECHANISM.index("console_gravity")]
#: Name: (changed texts of the mechanism file or the arm file, message).
DANGERS = {
    "gain": ([(KP, "kp: [600.0, 90.0, 40.0,")], "gain kp of outer_yaw is 600; allowed: 15..240, "),
    "no damping": ([(KD, "kd: [8.0, 0.0,")], "gain kd of shoulder_pitch is 0; allowed: 3..48, "),
    "integral gain": ([("ki: [70.0,", "ki: [7000.0,")], "gain ki of outer_yaw is 7000; allowed: 0..280, "),
    "inverted": ([("{elbow_pitch: 0.6697,", "{elbow_pitch: -0.6697,")], PLATFORM.format(-0.6697)),
    "large coupling": (
        [(ELBOW.format(1.0), ELBOW.format(1000.0))],
        "the coefficient of joint shoulder_pitch in the transmission of elbow_pitch is 1000; allowed: 1 +- 0.25, ",
    ),
    "deleted coupling": ([("  wrist_platform: {elbow_pitch: 0.6697, wrist_platform: 1.0}\n", "")], PLATFORM.format(0)),
    "wide limits": (
        [(YAW, "wrist_yaw: [-7.85398, 7.85398]")],
        "the position limits of wrist_yaw are -7.854..7.854; allowed: inside -1.178..1.178, ",
    ),
    "wide upper limit": (
        [(YAW, "wrist_yaw: [-0.785398, 7.85398]")],
        "the position limits of wrist_yaw are -0.7854..7.854; allowed: inside -1.178..1.178, ",
    ),
    "deleted coupled limit": (
        [(PARALLELOGRAM, "")],
        "the coupled limit parallelogram is missing; allowed: inside -0.5825..0.9325, ",
    ),
}


@pytest.mark.parametrize("danger", DANGERS)
def test_dangerous_arm_file_is_refused_by_the_guard(danger, tmp_path):
    changes, message = DANGERS[danger]
    message += HINT
    changes = {"arm" if changes[0][0] == YAW else "mechanism": changes}
    arm = mtml(tmp_path, **changes)
    assert unsafe_difference(arm) == message
    with pytest.raises(StationError) as error:
        CommandGuard(arm, 1, None)
    assert str(error.value) == f"{arm.source}: {message}"
    assert unsafe_difference(mtml(tmp_path, **changes, name="OURS")) == ""


def test_large_effort_limit_is_refused(tmp_path):
    changes = [("<effort>1.86083</effort>", "<effort>1860.83</effort>")]
    message = f"the effort limit of outer_yaw is 1860.83; allowed: up to 2.79124, {HINT}"
    assert unsafe_difference(mtml(tmp_path, sdf=changes)) == message


def test_displaced_link_is_refused(tmp_path):
    text = SDF.read_text()
    begin = text.index('<link name="wrist_yaw_link"')
    start, end = text.index("<pose", begin), text.index("</pose>", begin)
    head, _, numbers = text[start:end].partition(">")
    x, *others = numbers.split()
    moved = f"{head}>{float(x) - 2.79} {' '.join(others)}"
    message = unsafe_difference(mtml(tmp_path, sdf=[(text[begin:end], text[begin:start] + moved)]))
    assert "is displaced by 2.79 m at the pose (" in message and "); allowed: up to 0.02 m from the arm MTML" in message


MECHANICS = {
    "coupled limit": (
        "mechanism",
        ("{shoulder_pitch: 1.0, elbow_pitch: 1.0}\n    lower", "{shoulder_pitch: 0.1, elbow_pitch: 1.0}\n    lower"),
        "the coefficient of joint shoulder_pitch in the coupled limit parallelogram is 0.1; allowed: 1 +- 0.25, as for",
    ),
    "missing coefficient": (
        "mechanism",
        ("{shoulder_pitch: 1.0, elbow_pitch: 1.0}\n    lower", "{elbow_pitch: 1.0}\n    lower"),
        "the coefficient of joint shoulder_pitch in the coupled limit parallelogram is 0; allowed: 1 +- 0.25, as for",
    ),
    "additional coefficient": (
        "mechanism",
        ("elbow_pitch: 1.0}\n    lower", "elbow_pitch: 1.0, outer_yaw: 0.3}\n    lower"),
        "the coefficient of joint outer_yaw in the coupled limit parallelogram is 0.3; allowed: 0 +- 0.25, as for",
    ),
    "inverted axis": ("sdf", ("<xyz>-1 0 0</xyz>", "<xyz>1 0 0</xyz>"), "link upper_arm_link is rotated by "),
    "linkage": ("sdf", ('joint="elbow_pitch" multiplier="1"', 'joint="elbow_pitch" multiplier="1.4"'), "link "),
    "gear ratio": ("sdf", (">63.41<", ">6341<"), "the inertia at outer_yaw is "),
}


@pytest.mark.parametrize("danger", MECHANICS)
def test_different_mechanics_are_refused(danger, tmp_path):
    part, change, message = MECHANICS[danger]
    difference = unsafe_difference(mtml(tmp_path, **{part: [change]}))
    assert difference.startswith(message) and difference.endswith(HINT.partition("as for ")[2])


def test_heavy_links_are_refused(tmp_path):
    """With this mass of the forearm, the guard would compensate another gravity effort."""
    begin = SDF.read_text().index('<link name="forearm_link"')
    start = SDF.read_text().index("<mass>", begin)
    text = SDF.read_text()[begin : start + 6]
    arm = mtml(tmp_path, sdf=[(text, text + "1")])
    found = []
    for mounted in (arm, arm.with_gravity((-arm.gravity).tolist())):
        difference = unsafe_difference(mounted)
        assert difference.startswith("the gravity effort of ") and "; allowed: up to " in difference
        joint, value = re.match(r"the gravity effort of (\w+) differs by (\S+)", difference).groups()
        found.append((joint, float(value)))
    assert found[0] == (found[1][0], -found[1][1])


def test_small_changes_of_a_negative_coefficient_are_accepted():
    matrix = PSM.transmission.matrix.copy()
    row = matrix[3]
    assert row.max() <= 0 and row.min() < -0.6
    for factor, differs in ((1.2, False), (1.3, True)):
        matrix[3] = factor * row
        changed = dataclasses.replace(PSM, transmission=LinearMap(matrix, PSM.transmission.offset))
        assert bool(unsafe_difference(changed)) == differs


@pytest.mark.parametrize("name", ["'MTML '", "MTML2", "mtml"])
def test_arms_with_a_similar_name_are_compared(name, tmp_path):
    changes, message = DANGERS["gain"]
    assert unsafe_difference(mtml(tmp_path, mechanism=changes, name=name)).startswith(message)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"mechanism": [(KP, "kp: [200.0, 90.0, 40.0,"), ("ki: [70.0,", "ki: [0.0,")]},
        {"arm": [(YAW, "wrist_yaw: [-1.0, 1.1]")]},
        # An identified model, which `export --sdf` writes, has other masses.
        {"sdf": [("<mass>1.9<", "<mass>2.5<"), ("<mass>0.1<", "<mass>0.3<"), (">63.41<", ">90.0<")]},
        {"mechanism": [("{elbow_pitch: 0.6697,", "{elbow_pitch: 0.70,"), ("upper: 0.68", "upper: 0.8")]},
    ],
)
def test_usual_differences_are_accepted(changes, tmp_path):
    assert unsafe_difference(mtml(tmp_path, **changes)) == ""


@pytest.mark.parametrize("name", [*known_arms(), "psm+PROGRASP_FORCEPS_400093", "psm_si+NEEDLE_DRIVER_420117"])
def test_arms_of_the_package_are_accepted(name):
    assert unsafe_difference(load_arm(name)) == ""
