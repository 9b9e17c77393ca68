"""Exports a model to a file format of another program."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.model_links import ModelBodies, model_bodies
from dvrk_drake.errors import ModelError
from dvrk_drake.export.drive_approximation import DriveApproximation, approximate_drives
from dvrk_drake.export.dvrk_mtm_controller import MTM_JOINTS
from dvrk_drake.export.dvrk_mtm_gravity_compensation import CompensationOptions, compensation_from_model, dry_friction
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
from dvrk_drake.export.dvrk_psm_gravity_compensation import (
    KinematicCompensation,
    configuration_beside,
    is_psm,
    kinematic_compensation,
)
from dvrk_drake.export.model_writer import MeshFormat, refuse_existing_meshes, write_model
from dvrk_drake.export.touching_shapes import touching_shapes
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

    @property
    def omitted_shapes(self) -> tuple[tuple[str, str], ...]:
        """Links and names of the collision shapes that the file omits, see `touching_shapes`."""
        return touching_shapes(self.model.arm) if self.format == "urdf" else ()

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
    tolerance: float | None = None,
    friction: bool | Sequence[float] = False,
    friction_ratio: Sequence[float] | None = None,
    dead_band: Sequence[float] | None = None,
    saturation: Sequence[float] | None = None,
    meshes: MeshFormat = "gltf",
    configuration: str | Path | None = None,
) -> ModelExport:
    """Returns the content that `export_model` writes. See `export_model` for arguments and errors."""
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
        file = kinematic_compensation(model, tolerance, configuration)
        return ModelExport(model, format, origin, compensation=file, configuration=configuration)
    coulomb = None if friction is False else dry_friction(model) if friction is True else friction
    given = {
        "tolerance": tolerance,
        "coulomb": coulomb,
        "friction_ratio": friction_ratio,
        "dead_band": dead_band,
        "saturation": saturation,
    }
    options = CompensationOptions(**{k: v for k, v in given.items() if v is not None})  # type: ignore[arg-type]
    return ModelExport(model, format, origin, compensation=compensation_from_model(model, options))


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
