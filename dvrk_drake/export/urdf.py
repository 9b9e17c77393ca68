"""Writes the URDF of an arm with identified inertial parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from dvrk_drake.dynamics.inertial_parameters import LinkInertia
from dvrk_drake.export.sdf import copy_meshes, redirect_meshes, to_text, with_inertias
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.urdf import to_urdf


def write_urdf(
    arm: Arm,
    links: Sequence[LinkInertia],
    path: str | Path,
    origin: str,
    rotor_inertias: Mapping[str, float] | None = None,
) -> None:
    """Writes the URDF atomically, and copies the meshes into the folder <name>_meshes beside the file.

    Dependent joints of the linkage become mimic joints, because URDF does not support closed loops. A capsule becomes a
    cylinder and two spheres, because URDF does not support capsules. Rotor inertias, gear ratios, named frames and
    collision filters are written in Drake's extensions of URDF. Other programs ignore these extensions.

    Args:
        arm, links, path, origin, rotor_inertias: Arguments of `write_sdf`.

    Raises:
        ModelError: An inertia is not physically consistent, or URDF does not support a part of the SDF.
        DvrkDrakeError: A file cannot be written.
    """
    target = Path(path)
    root = with_inertias(arm, links, rotor_inertias)
    copies = redirect_meshes(root, target)
    robot = to_urdf(root, arm)
    copy_meshes(copies)
    with atomic_write(target) as stream:
        stream.write(to_text(robot, f"{arm.name}, inertial parameters of {origin}. Written by dvrk-drake export."))
