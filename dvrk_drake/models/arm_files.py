"""Loads arms from their YAML and SDF files."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm, checked_gravity
from dvrk_drake.models.arm_schema import (
    ArmDescription,
    Frames,
    Gains,
    IdentificationSettings,
    Instrument,
    LinearMap,
    Mechanism,
    ViewSettings,
)
from dvrk_drake.models.dvrk_tool import dvrk_tools, tool_instrument
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.models.immutable import cached
from dvrk_drake.models.model_file import MODEL_SUFFIXES
from dvrk_drake.models.ranges import suggest_name
from dvrk_drake.models.sdf_model import MODELS_FOLDER, PACKAGE_URL, SdfFacts, compose_sdf, local_path, read_sdf_facts
from dvrk_drake.models.typed_yaml import load_typed_yaml

_ARMS = MODELS_FOLDER / "arms"
#: Largest number of independent joints. The identification of a serial arm with more joints was not tested.
MAX_JOINTS = 12

Part = TypeVar("Part", Mechanism, Instrument)


def known_arms() -> list[str]:
    """Returns the names of the arms of this package, which `load_arm` accepts."""
    return sorted(path.stem for path in _ARMS.glob("*.yaml"))


def load_arm(name: str | Path, instrument: str | Path = "") -> Arm:
    """Loads an arm. Repeated calls, also from other threads, return the same immutable object until the file changes.

    Changes of the other files of an arm file (mechanism, instrument, model) take effect only in a new process.

    A model file (URDF, SDF, MJCF or Drake's model directives) suffices. Joints that mimic no other joint are the
    independent joints, in the order of the model. The base is the link that no joint moves, or the world if links are
    fixed to it. Gravity acts along -z of the base. Gains result in a critically damped control of each joint. An arm
    file can state all of this otherwise, see `derived_arm_file`.

    Args:
        name: Name of an arm of this package, e.g. "mtml" (not case-sensitive). For any other arm, the path or package
            URL of its arm file (YAML) or of a model file. The `source` of an arm with another instrument is accepted
            too, e.g. "psm+PROGRASP_FORCEPS_400093".
        instrument: Instrument that replaces the one of the arm: the name of an instrument of the dVRK, or the path of
            an instrument file, of the dVRK (JSON) or of this package (YAML). "": that of the arm.

    Raises:
        ArmError: The arm does not exist, carries no instrument, or its files are invalid or inconsistent.

    Example:
        >>> import dvrk_drake as dvrk
        >>> arm = dvrk.load_arm("psm")
        >>> on_its_side = arm.with_gravity([0, -9.81, 0])  # [m/s^2] in the base frame
        >>> int(arm.prismatic.argmax()), arm.joint_names[2]
        (2, 'insertion')
        >>> dvrk.load_arm("psm_si", "PROGRASP_FORCEPS_420093").source
        'psm_si+PROGRASP_FORCEPS_420093'
    """
    name = os.fspath(name)
    if "\0" in name:
        raise ArmError(f"{name!r} is not a valid file name")
    own, plus, other = name.partition("+")
    if plus and own.lower() in known_arms():
        name, instrument = own, instrument or other
    if instrument:
        if name.lower() not in known_arms():
            raise ArmError(f"{name}: state the instrument in the arm file (instrument: {os.fspath(instrument)})")
        return _load_arm(f"{name.lower()}+{_instrument_name(instrument)}")
    if not name.lower().endswith((".yaml", ".yml", *MODEL_SUFFIXES)):
        if name.lower() not in known_arms() and os.path.isfile(name):
            raise ArmError(f"{name} is not the file of an arm; {_accepted()}")
        return _load_arm(name.lower())
    path = Path(os.path.realpath(local_path(name)))
    # The name and the path of an arm of this package give the same Arm object.
    if path.parent == _ARMS.resolve():
        return _load_arm(path.stem)
    with suppress(OSError):  # _load_arm reports a missing file
        status = path.stat()
        return _load_arm(str(path), (status.st_mtime_ns, status.st_size))
    return _load_arm(str(path))


def _instrument_name(instrument: str | Path) -> str:
    """Returns the name of an instrument as in the table of the dVRK, or the absolute path of its file."""
    name = os.fspath(instrument)
    if name.lower().endswith((".json", ".yaml", ".yml")):
        return os.path.realpath(local_path(name))
    known = [*dvrk_tools(), *_known_parts("instrument")]
    if not (found := [each for each in known if each.lower() == name.lower()]):
        near = suggest_name(name, known)
        raise ArmError(
            f'unknown instrument "{name}"; {near}allowed: an instrument of the dVRK, e.g. {known[0]}, or the '
            "path of its file (JSON or YAML)"
        )
    return found[0]


def _known_parts(kind: str) -> list[str]:
    return sorted(path.stem for path in (MODELS_FOLDER / f"{kind}s").glob("*.yaml"))


def derived_arm_file(model: str | Path, folder: str | Path) -> str:
    """Returns the text of an arm file that states what `load_arm` derives from a model file.

    Args:
        model: Path of a model file (URDF, SDF, MJCF or Drake's model directives).
        folder: Folder of the arm file, to which the path of the model is relative.

    Raises:
        ArmError: The model is not that of an arm.
    """
    arm = load_arm(model)
    if not is_from_model_file(arm):
        raise ArmError(f"{os.fspath(model)} is not a model file; allowed: {', '.join(MODEL_SUFFIXES)}")

    names = [_yaml_text(name) for name in arm.joint_names]

    def per_joint(values: NDArray[np.float64]) -> str:
        return "".join(f"\n  {name}: {np.round(x, 6).tolist()}" for name, x in zip(names, values, strict=True))

    limits = np.column_stack([arm.position_lower, arm.position_upper])
    first, last = names[0], names[-1]
    gains = "".join(f"\n  {name}: {[float(f'{x:.3g}') for x in values]}" for name, values in vars(arm.gains).items())
    return f"""\
# Derived from a model file. Change what differs for your robot; keys that you delete are derived again.
format: dvrk_drake arm 1.0
name: {_yaml_text(arm.name)}
sdf: {_yaml_text(os.path.relpath(os.path.realpath(model), os.path.realpath(folder)))}

# Independent joints, in the order of recordings and messages.
joints: [{", ".join(names)}]

# Limits of the positions [rad; m if prismatic] and of the efforts [N m; N].
position_limits:{per_joint(limits)}
effort_limits:{per_joint(arm.effort_limits)}

# Gravity in the frame of the base [m/s^2].
gravity: {arm.gravity.tolist()}

# Frame of a link, or of a part that is fixed to a link, at which a hand or a task holds the arm.
frames: {{hand: {_yaml_text(arm.frames.hand)}}}

# Positions in the model at the recorded positions 0 [rad; m], if the robot's controller has other zeros.
# position_offsets: {{{first}: 1.5708}}

# Rows of J in a = J q, for recordings in the coordinates of the actuators (a, with tau_joint = J' tau_actuator).
# transmission:
#   {last}: {{{first}: 0.0, {last}: 1.0}}

# Gains of the position control [N m/rad, N m s/rad, N m/(rad s)], critically damped for the inertias of the model.
gains:{gains}

# Cut-off frequencies of the low-pass filters of the accelerations and of the efforts [Hz].
motion: {{acceleration_cut_off: {list(arm.identification.acceleration_cut_off)}}}
effort_cut_off: {arm.identification.effort_cut_off}
"""


def _yaml_text(text: str) -> str:
    """Returns a text as YAML: with quotation marks if it could be read as something else, e.g. `on`."""
    is_plain = re.fullmatch(r"[\w./-]+", text, re.ASCII) and yaml.safe_load(text) == text
    return text if is_plain else json.dumps(text)


def is_from_model_file(arm: Arm) -> bool:
    """Returns whether an arm has no arm file, so that nobody stated more than its model file does."""
    return arm.source.lower().endswith(MODEL_SUFFIXES)


def has_converted_model(arm: Arm) -> bool:
    """Returns whether the links of an arm are those of a model file that was converted, e.g. of a URDF."""
    return is_from_model_file(arm) or not arm.sdf[0].lower().endswith(".sdf")


def is_package_arm(arm: Arm | str) -> bool:
    """Returns whether an arm, or its name, has the name of an arm of this package."""
    name = arm if isinstance(arm, str) else arm.name
    # The names of the files of this package begin with the name of the arm, e.g. psm_si with PSM. psm exists too.
    return name.upper() in map(str.upper, known_arms())


def package_arms(arm: Arm) -> list[Arm]:
    """Returns the arms of this package with the name of an arm, with its instrument if it is known.

    The name may end with a number, as PSM1.
    """
    name = "".join(filter(str.isalnum, arm.name)).rstrip("0123456789").upper()
    same = [known for known in map(load_arm, known_arms()) if known.name.upper() == name]
    if arm.instrument not in dvrk_tools():
        return same
    return [load_arm(known.source, arm.instrument) if known.instrument else known for known in same]


@cached
def _load_arm(name: str, state: tuple[int, int] = (0, 0)) -> Arm:
    """Loads an arm by name or absolute path. `state` (time of change, size) is the version of the YAML file."""
    file, _, other_instrument = name.partition("+") if not os.path.exists(name) else (name, "", "")
    path = Path(file)
    if not path.is_absolute():
        if file not in known_arms():
            near = suggest_name(file, known_arms())
            raise ArmError(f'unknown arm "{file}"; {near}{_accepted()}')
        path = _ARMS / f"{file}.yaml"
    if str(path).lower().endswith(MODEL_SUFFIXES):
        description = ArmDescription(sdf=str(path))
    else:
        description = load_typed_yaml(ArmDescription, path, ArmError, "an arm file")
    _resolve_sdf(description, path)
    mechanism: Mechanism = description
    if description.mechanism:
        mechanism = _load_part(Mechanism, path, "mechanism", description.mechanism)
        unstated = Mechanism()
        stated = {key: getattr(description, key) for key in vars(unstated) if key != "format"}
        stated = {key: value for key, value in stated.items() if value != getattr(unstated, key)}
        mechanism = dataclasses.replace(mechanism, **stated)
    instrument = Instrument()
    if other_instrument and not description.instrument:
        raise ArmError(f"{file}: the arm carries no instrument that can be exchanged")
    if other_instrument or description.instrument:
        instrument = _load_instrument(path, other_instrument or description.instrument)
    try:
        arm = _build_arm(name, path, description, mechanism, instrument)
        if path.parent.parent != MODELS_FOLDER:
            from dvrk_drake.models.plant import check_plant  # circular import

            check_plant(arm)
    except ArmError as error:
        raise error if str(error).startswith(str(path)) else ArmError(f"{path}: {error}") from error
    return arm


def _load_instrument(arm_path: Path, name: str) -> Instrument:
    if name in dvrk_tools():
        return tool_instrument(MODELS_FOLDER / f"instruments/{name}.json", f"{PACKAGE_URL}instruments/{name}.json")
    if name.lower().endswith(".json"):
        path = Path(os.path.realpath(arm_path.parent / name))
        return tool_instrument(path, str(path))
    return _load_part(Instrument, arm_path, "instrument", name)


def _load_part(schema: type[Part], arm_path: Path, kind: str, name: str) -> Part:
    what = f"{'an' if kind == 'instrument' else 'a'} {kind} file"
    if name.lower().endswith((".yaml", ".yml")):
        if "\0" in name:
            raise ArmError(f"{arm_path}: {kind} {name!r} is not a valid file name")
        path = Path(os.path.realpath(arm_path.parent / name))
        if not os.path.lexists(path):
            raise ArmError(f"{arm_path}: {kind} {path} does not exist")
        part = load_typed_yaml(schema, path, ArmError, what)
        _resolve_sdf(part, path)
        return part
    folder = MODELS_FOLDER / f"{kind}s"
    known = _known_parts(kind)
    if name not in known:
        raise ArmError(
            f'{arm_path}: unknown {kind} "{name}"; known {kind}s: {", ".join(known)}, or the path of a YAML file'
        )
    return load_typed_yaml(schema, folder / f"{name}.yaml", ArmError, what)


def _resolve_sdf(part: Mechanism | Instrument, path: Path) -> None:
    """Makes a path of a model file absolute, which is relative to the folder of the file at `path`."""
    if part.sdf and not part.sdf.startswith(PACKAGE_URL):
        part.sdf = str(path.parent / part.sdf)


def _accepted() -> str:
    """Returns the accepted arguments of `load_arm`, for messages."""
    return f"known arms: {', '.join(known_arms())}, or the path of a YAML, URDF, SDF or MJCF file"


def _build_arm(
    source: str, path: Path, description: ArmDescription, mechanism: Mechanism, instrument: Instrument
) -> Arm:
    if not mechanism.sdf:
        raise ArmError(f"{path}: sdf is missing; state the path of the model in the arm file or in the mechanism file")
    sdf = tuple(url for url in (mechanism.sdf, instrument.sdf) if url)
    facts = read_sdf_facts(compose_sdf(sdf))
    if not mechanism.joints:
        others = {*facts.mimics, *instrument.joints}
        mechanism.joints = [name for name in facts.joint_names if name not in others]
    joints = [*mechanism.joints, *instrument.joints]
    if not joints or len({*joints}) < len(joints):
        raise ArmError(f"{path}: the mechanism and instrument need at least one joint, and all joint names must differ")
    if len(joints) > MAX_JOINTS:
        raise ArmError(f"{path}: the model has {len(joints)} independent joints; allowed: 1 to {MAX_JOINTS}")
    position_limits = {**facts.position_limits, **instrument.position_limits, **description.position_limits}
    for key, stated in (
        ("position_limits", instrument.position_limits | description.position_limits),
        ("effort_limits", description.effort_limits),
        ("position_offsets", description.position_offsets),
    ):
        if unknown := sorted(set(stated) - set(joints)):
            raise ArmError(f'{path}: {key}: unknown joint "{unknown[0]}"; allowed: {", ".join(joints)}')
    if (separate := instrument.separate_joint) and separate not in instrument.joints:
        raise ArmError(f'{path}: separate_joint is "{separate}"; allowed: {", ".join(instrument.joints) or "none"}')
    if missing := set(joints) - set(facts.joint_names):
        raise ArmError(f"{path}: the SDF has no joint {', '.join(sorted(missing))}")
    if unlimited := [j for j in joints if j not in position_limits]:
        raise ArmError(
            f"{path}: joint {unlimited[0]} needs position limits [rad, m]: state them in the model, or under "
            "position_limits of an arm file"
        )
    if wrong := [j for j in joints if len(position_limits[j]) != 2]:
        raise ArmError(f"{path}: position_limits.{wrong[0]} is {position_limits[wrong[0]]}; allowed: [lower, upper]")
    limits = np.array([position_limits[j] for j in joints])
    for j in description.position_limits.keys() & description.position_offsets.keys():
        limits[joints.index(j)] += description.position_offsets[j]
    for limit in mechanism.coupled_limits:
        _row(path, f"coupled_limits.{limit.name}", limit.coefficients, mechanism.joints)
    effort_limits = _effort_limits(path, joints, facts.effort_limits | description.effort_limits)
    has_gains = not mechanism.joints or any(vars(mechanism.gains).values())
    joined = {k: getattr(mechanism.gains, k) + getattr(instrument.gains, k) for k in ("kp", "kd", "ki")}
    G = np.zeros((len(facts.joint_names), len(joints)))
    c = np.zeros(len(facts.joint_names))
    for row, name in enumerate(facts.joint_names):
        leader, multiplier, offset = facts.mimics.get(name, (name, 1.0, 0.0))
        if leader not in joints:
            raise ArmError(f"{path}: joint {name} of the SDF must be in the list joints, or mimic a joint of that list")
        G[row, joints.index(leader)], c[row] = multiplier, offset
    arm = Arm(
        name=description.name or _name_of(path),
        source=source,
        joint_names=tuple(joints),
        tree_joint_names=facts.joint_names,
        sdf=sdf,
        position_lower=limits[:, 0],
        position_upper=limits[:, 1],
        effort_limits=effort_limits,
        prismatic=np.array([j in facts.prismatic for j in joints]),
        coupled_limits=tuple(mechanism.coupled_limits),
        linkage=LinearMap(G, c),
        transmission=LinearMap(_transmission(path, joints, mechanism, instrument), np.zeros(len(joints))),
        loop_closures=tuple(mechanism.loop_closures),
        gravity=checked_gravity(description.gravity),
        gains=Gains(**joined) if has_gains else Gains(),
        friction_coordinates={
            name: _row(path, f"friction_coordinates.{name}", terms, joints)
            for name, terms in instrument.friction_coordinates.items()
        },
        identification=_identification_settings(path, mechanism, instrument),
        effects=_checked_effects(path, mechanism.effects.joined(instrument.effects), joints),
        separate_joint=instrument.separate_joint,
        console_gravity_compensation=mechanism.console_gravity_compensation,
        frames=_frames(path, mechanism, instrument, facts),
        view=_view_settings(path, mechanism.view, instrument.view, facts),
        published_gains=mechanism.published_gains,
    )
    arm = arm.with_position_offsets(description.position_offsets)
    if has_gains:
        return arm
    from dvrk_drake.models.plant import critically_damped_gains  # circular import

    return dataclasses.replace(arm, gains=critically_damped_gains(arm))


def _name_of(path: Path) -> str:
    """Returns the name of a file without its ending, with "_" for characters that ROS does not accept in a name."""
    return re.sub(r"\W", "_", path.name.partition(".")[0], flags=re.ASCII)


def _frames(path: Path, mechanism: Mechanism, instrument: Instrument, facts: SdfFacts) -> Frames:
    """Returns the frames of mechanism and instrument. The entries of the instrument take precedence."""
    frames = {key: getattr(instrument.frames, key) or frame for key, frame in vars(mechanism.frames).items()}
    # The joints of an instrument are the last ones.
    frames["hand"] = instrument.frames.hand or (not instrument.sdf and mechanism.frames.hand) or facts.last_link
    for key, frame in frames.items():
        if frame and frame not in facts.frame_names | facts.link_names:
            raise ArmError(f"{path}: frames.{key}: the SDF has no frame {frame}")
    return Frames(**frames)


def _view_settings(path: Path, mechanism: ViewSettings, instrument: ViewSettings, facts: SdfFacts) -> ViewSettings:
    """Returns the settings of mechanism and instrument. The entries of the instrument take precedence."""
    view = ViewSettings({**mechanism.close_ups, **instrument.close_ups})
    for name, links in view.close_ups.items():
        if unknown := sorted(set(links) - facts.link_names):
            raise ArmError(f"{path}: view.close_ups.{name}: the SDF has no link {', '.join(unknown)}")
    return view


def _identification_settings(path: Path, mechanism: Mechanism, instrument: Instrument) -> IdentificationSettings:
    """Returns the settings of mechanism and instrument. The default is a cut-off frequency of 20 Hz and no delay."""
    both: dict[str, list[float]] = {}
    for which, default in (("acceleration_cut_off", 20.0), ("effort_delay", 0.0), ("day_deviation", 0.0)):
        both[which] = []
        for part in (mechanism, instrument):
            values = getattr(part.motion, which)
            if values and len(values) != len(part.joints):
                raise ArmError(
                    f"{path}: motion.{which} has {len(values)} numbers; allowed: {len(part.joints)}, one per joint"
                )
            both[which] += values or [default] * len(part.joints)
    known = {**mechanism.motion.known_effects, **instrument.motion.known_effects}
    return IdentificationSettings(
        **{**vars(mechanism.motion), **both, "known_effects": known},
        effort_cut_off=mechanism.effort_cut_off,
        bounding_shapes=tuple(part.bounding_shapes for part in (mechanism, instrument) if part.sdf),
    )


def _checked_effects(path: Path, effects: ArmEffects, joints: list[str]) -> ArmEffects:
    try:
        effects.check(joints)
    except ArmError as error:
        raise ArmError(f"{path}: effects.{error}") from error
    return effects


def _effort_limits(path: Path, joints: list[str], stated: dict[str, float]) -> NDArray[np.float64]:
    if missing := [joint for joint in joints if not stated.get(joint, 0.0) > 0]:
        raise ArmError(
            f"{path}: joint {missing[0]} needs a positive effort limit [N m, N]: state it in the model, or under "
            "effort_limits of an arm file"
        )
    return np.array([stated[joint] for joint in joints])


def _transmission(path: Path, joints: list[str], mechanism: Mechanism, instrument: Instrument) -> NDArray[np.float64]:
    """Returns J of a = J q: the rows of the mechanism, and the inverse of the instrument's coupling for its joints."""
    J: NDArray[np.float64] = np.eye(len(joints))
    for joint, terms in instrument.joint_from_actuator.items():
        J[_index(path, "joint_from_actuator", joint, joints)] = _row(
            path, f"joint_from_actuator.{joint}", terms, joints
        )
    J = _inverted(path, "joint_from_actuator", J)
    for actuator, terms in mechanism.transmission.items():
        J[_index(path, "transmission", actuator, joints)] = _row(path, f"transmission.{actuator}", terms, joints)
    _inverted(path, "transmission", J)
    return J


def _index(path: Path, key: str, joint: str, joints: list[str]) -> int:
    if joint not in joints:
        raise ArmError(f'{path}: {key}: unknown joint "{joint}"; allowed: {", ".join(joints)}')
    return joints.index(joint)


def _row(path: Path, key: str, terms: dict[str, float], joints: list[str]) -> NDArray[np.float64]:
    row = np.zeros(len(joints))
    for joint, coefficient in terms.items():
        row[_index(path, key, joint, joints)] = coefficient
    if not np.any(row):
        raise ArmError(f"{path}: {key}: all coefficients are 0; at least one must be nonzero")
    return row


def _inverted(path: Path, key: str, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    if not np.linalg.cond(matrix) < 1e9:
        raise ArmError(f"{path}: {key}: the matrix is singular, because its rows are linearly dependent")
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
