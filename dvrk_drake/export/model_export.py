"""Exports a model to a file format of another program."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import joint_row, position_along, sliding_effort
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.model_links import ModelBodies, model_bodies
from dvrk_drake.errors import ModelError
from dvrk_drake.export.dvrk_mtm_gravity_compensation import CompensationOptions, compensation_from_model, dry_friction
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import MTM_JOINTS, GravityCompensationFile
from dvrk_drake.export.dvrk_psm_gravity_compensation import (
    KinematicCompensation,
    configuration_beside,
    is_psm,
    kinematic_compensation,
)
from dvrk_drake.export.model_writer import MeshFormat, refuse_existing_meshes, write_model
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import refuse_existing
from dvrk_drake.models.mjcf import Drive

Format = Literal["sdf", "urdf", "mjcf", "dvrk-gc", "dvrk-kinematic-gc"]
#: Formats of a complete model.
MODEL_FORMATS = ("sdf", "urdf", "mjcf")


@dataclass(frozen=True, eq=False)
class ModelExport:
    """Content of an exported file.

    Attributes:
        model: Model that is exported.
        format: Format of the file.
        origin: Source of the model, written to the file.
        bodies: Inertias of links and rotors in an SDF, URDF or MJCF, and effects that this file omits. None for other
            formats.
        drives: Friction and springs in an MJCF, or in an SDF or URDF with friction, and what they omit. None if the
            file has no friction.
        compensation: Content of a file for the dVRK's controller. None for SDF, URDF and MJCF.
        meshes: Format of the meshes of an SDF or URDF.
        configuration: Configuration of the arm in the dVRK with which the file of a PSM was checked, or None.
    """

    model: IdentifiedModel
    format: Format
    origin: str
    bodies: ModelBodies | None = None
    drives: DriveApproximation | None = None
    compensation: GravityCompensationFile | KinematicCompensation | None = None
    meshes: MeshFormat = "gltf"
    configuration: str | Path | None = None

    @property
    def left_out(self) -> list[str]:
        """Descriptions of the terms of the model that the file omits."""
        if self.bodies is None:
            return []
        represented = {"gravity", "rotors"} if self.format == "mjcf" else set()
        represented |= {"drives"} if self.drives is not None else set()
        return [text for kind, text in self.bodies.left_out.items() if kind not in represented]

    def write(self, path: str | Path) -> None:
        """Writes the file atomically and replaces an existing file.

        Args:
            path: Path of the file. Meshes of an SDF or URDF are copied into a folder <name>_meshes beside the file.

        Raises:
            DvrkDrakeError: The file cannot be written.
            ModelError: URDF does not support a part of the arm's SDF.
        """
        arm = self.model.arm
        if self.bodies is not None:
            assert self.format in ("sdf", "urdf", "mjcf")
            rotors, drives = self.bodies.rotors, self.drives.drives if self.drives is not None else ()
            if self.format == "mjcf" and rotors:  # MJCF has rotors that are coupled to several joints
                rotors, drives = dict.fromkeys(rotors, 0.0), (*drives, *self._motors())
            write_model(arm, self.bodies.links, path, self.origin, rotors, self.meshes, self.format, drives)
        elif isinstance(self.compensation, GravityCompensationFile):
            self.compensation.save(path, arm.name, f"dvrk-drake export of {self.origin}")
        elif self.compensation is not None:
            self.compensation.save(path)

    def _motors(self) -> list[Drive]:
        """Returns the rotors that no link contains."""
        assert self.bodies is not None
        arm = self.model.arm
        rows = dict(zip(arm.joint_names, arm.transmission.matrix, strict=True))
        return [
            Drive(f"rotor.{name}", {j: float(r) for j, r in zip(rows, rows[name], strict=True) if r}, inertia=inertia)
            for name, inertia in self.bodies.motors.items()
        ]


def controller_format(arm: Arm) -> Format | None:
    """Returns the format of the dVRK controller's gravity-compensation file for an arm, None if there is none."""
    if arm.joint_names == MTM_JOINTS:
        return "dvrk-gc"
    return "dvrk-kinematic-gc" if is_psm(arm) else None


def prepare_export(
    model: IdentifiedModel,
    format: Format,
    *,
    origin: str = "",
    friction: bool | Sequence[float] = False,
    meshes: MeshFormat = "gltf",
    configuration: str | Path | None = None,
    **options: Any,
) -> ModelExport:
    """Returns the content that `export_model` writes. See `export_model` for arguments and errors.

    `options` are attributes of `CompensationOptions`, None for their default values.
    """
    origin = origin or f"a model of {model.arm.name}"
    if format not in get_args(Format):
        raise ModelError(f'unknown format "{format}"; known formats: {", ".join(get_args(Format))}')
    if meshes not in get_args(MeshFormat):
        raise ModelError(f'unknown format of meshes "{meshes}"; allowed: {", ".join(get_args(MeshFormat))}')
    if format != "dvrk-kinematic-gc":  # this file contains only yaw, pitch and insertion of a PSM
        model.arm.refuse_locked_joints(f"the format {format}")
    if format in MODEL_FORMATS:
        drives = None
        if format == "mjcf" or friction:
            drives = approximate_drives(model, coupled=format == "mjcf")
        return ModelExport(model, format, origin, bodies=model_bodies(model), drives=drives, meshes=meshes)
    if format == "dvrk-kinematic-gc":
        file = kinematic_compensation(model, options.get("tolerance"), configuration)
        return ModelExport(model, format, origin, compensation=file, configuration=configuration)
    if friction is not False:
        options["coulomb"] = dry_friction(model) if friction is True else friction
    given = CompensationOptions(**{name: value for name, value in options.items() if value is not None})
    return ModelExport(model, format, origin, compensation=compensation_from_model(model, given))


def export_model(
    model: IdentifiedModel,
    path: str | Path,
    format: Format | None = None,
    *,
    origin: str = "",
    tolerance: float | None = None,
    friction: bool | Sequence[float] = False,
    friction_ratio: Sequence[float] | None = None,
    dead_band: Sequence[float] | None = None,
    saturation: Sequence[float] | None = None,
    meshes: MeshFormat = "gltf",
    configuration: str | Path | None = None,
    overwrite: bool = False,
) -> ModelExport:
    """Writes a model to a file for another program, as `dvrk-drake export` does.

    Args:
        model: Model from `identify`, `IdentifiedModel.load`, or `IdentifiedModel.from_arm`.
        path: Path of the file. Meshes of an SDF or URDF are copied into a folder <name>_meshes beside the file.
        format: "sdf", "urdf", "mjcf", "dvrk-gc" or "dvrk-kinematic-gc". The last two are the gravity-compensation
            files of the dVRK's controller for an MTM and for a PSM. None selects SDF or URDF by the file name
            extension. An MJCF contains friction, see `drives` of the result.
        origin: Source of the model, written to the file.
        tolerance: Largest accepted difference [N m, N] between the torques of the model and of a file for the dVRK's
            controller, on any joint. None: the dry friction of each joint, because this friction holds a joint at rest
            despite such a difference.
        friction: Coulomb friction (7,) [N m] to compensate, for "dvrk-gc". True uses the dry friction of the model's
            dynamics. False compensates no friction. For SDF and URDF, True adds the friction of the joints. Programs
            other than this package read it: Drake ignores dry friction, and `load_arm` refuses it.
        friction_ratio: Share of the friction to compensate on each joint (7,), 0 to 1, for "dvrk-gc". None uses
            typical values.
        dead_band: Speeds (7,) [rad/s] below which no friction is compensated, for "dvrk-gc". None uses typical values.
        saturation: Speeds (7,) [rad/s] above which the full share `friction_ratio` of the friction is compensated, for
            "dvrk-gc". None uses typical values.
        meshes: Format of the meshes of an SDF or URDF: "gltf" keeps the meshes of the arm. "obj" converts them for
            programs that do not read glTF, such as PyBullet and MuJoCo.
        configuration: Configuration of the arm in the dVRK (JSON), for "dvrk-kinematic-gc". The torques of the file are
            compared for its `mounting_pitch`. None: a JSON file beside `path` whose key `kinematic_gc` names `path`.
        overwrite: Whether to replace existing files.

    Returns:
        Content of the written file. `left_out` describes terms of the model that the file omits.

    Raises:
        ModelError: The format is unknown or cannot represent the model within the tolerance.
        DvrkDrakeError: The file exists or cannot be written.

    Example:
        >>> import dvrk_drake as dvrk
        >>> model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm("psm"))
        >>> exported = dvrk.export_model(model, "psm.json", "dvrk-kinematic-gc")
        >>> exported.compensation.mass.shape  # masses [kg] of the links of the controller's chain
        (7,)
    """
    if format is None:
        suffix = Path(path).suffix.lower()
        if suffix not in (".sdf", ".urdf"):
            raise ModelError(f"{path}: the format is not given; give one of {', '.join(get_args(Format))}")
        format = "sdf" if suffix == ".sdf" else "urdf"
    refuse_existing(path, overwrite)
    if format in MODEL_FORMATS:
        refuse_existing_meshes(path, overwrite)
    export = prepare_export(
        model,
        format,
        origin=origin,
        tolerance=tolerance,
        friction=friction,
        friction_ratio=friction_ratio,
        dead_band=dead_band,
        saturation=saturation,
        meshes=meshes,
        configuration=configuration or configuration_beside(path),
    )
    export.write(path)
    return export


#: Number of random poses and velocities at which the effects are approximated.
_SAMPLES = 400
#: Largest speeds of the samples [rad/s, m/s], about those of an excitation of a dVRK.
_SPEEDS = (1.0, 0.1)


@dataclass(frozen=True, eq=False)
class DriveApproximation:
    """Friction and springs of the drives in a form that simulators have, and what this form omits.

    Attributes:
        drives: Dry friction, viscous friction and linear spring along each coordinate.
        effort: RMS effort (n,) of all effects on each joint while the arm moves [N m, N].
        difference: RMS difference (n,) between this effort and that of `drives` on each joint [N m, N].
    """

    drives: tuple[Drive, ...]
    effort: NDArray[np.float64]
    difference: NDArray[np.float64]


def approximate_drives(model: IdentifiedModel, *, coupled: bool = True) -> DriveApproximation:
    """Returns the least-squares approximation of the effects of a model, or of its arm if the model has no dynamics.

    Each coordinate has the effort F sign(v) + D v + K x with F, D and K of 0 or more. Presliding friction is
    approximated by its friction after the travel. Loads are the efforts that compensate gravity.

    Args:
        model: Model of an arm.
        coupled: Whether the format has friction along combinations of joints. Otherwise, the dry friction of a
            coordinate acts on each of its joints, viscous friction only on the diagonal, and springs are omitted.
    """
    from scipy.optimize import nnls

    arm, known = model.arm, model.arm.effects
    effects = list(model.dynamics.effects) if model.dynamics else [*known.friction, *known.cables, *known.springs]
    generator = np.random.default_rng(0)
    q = arm.sample_poses(_SAMPLES, generator)
    v = arm.per_joint(*_SPEEDS) * generator.uniform(-1.0, 1.0, q.shape)
    weight = arm.transmission.inverse.pull_back_effort(model.holding_torque(q))
    total, drives = np.zeros_like(q), []
    for name in dict.fromkeys(effect.coordinate for effect in effects):
        row = joint_row(arm, name)
        own = [effect for effect in effects if effect.coordinate == name]
        load = np.abs(weight @ arm.effect_coordinates[name]) / np.sum(arm.effect_coordinates[name] ** 2)
        effort = sliding_effort(own, position_along(arm, name, q), v @ row, load)
        (dry, viscous, stiffness), _ = nnls(np.column_stack([np.sign(v @ row), v @ row, q @ row]), effort)
        moved = {joint: float(r) for joint, r in zip(arm.joint_names, row, strict=True) if abs(r) > 1e-12}
        drives.append(Drive(name, moved, float(dry), float(viscous), float(stiffness)))
        total += effort[:, None] * row
    if not coupled:
        drives = _of_single_joints(arm, drives)
    difference = total - sum((_on_joints(arm, drive, q, v) for drive in drives), np.zeros_like(q))
    rms = [np.sqrt(np.mean(x**2, axis=0)) for x in (total, difference)]
    return DriveApproximation(tuple(drives), *rms)


def _of_single_joints(arm: Arm, drives: Sequence[Drive]) -> list[Drive]:
    singles = []
    for joint in arm.joint_names:
        own = [(drive, drive.row[joint]) for drive in drives if joint in drive.row]
        dry, viscous = sum(abs(r) * d.dry for d, r in own), sum(r**2 * d.viscous for d, r in own)
        singles.append(Drive(joint, {joint: 1.0}, dry, viscous))
    return singles


def _on_joints(arm: Arm, drive: Drive, q: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    row = np.array([drive.row.get(joint, 0.0) for joint in arm.joint_names])
    effort = drive.dry * np.sign(v @ row) + drive.viscous * (v @ row) + drive.stiffness * (q @ row)
    return effort[:, None] * row
