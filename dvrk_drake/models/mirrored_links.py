"""Links that one side's arm has as the mirror image of the other side's: in the plane x = 0 of their own frames."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

from dvrk_drake.errors import ArmError


def mirror_links(root: ElementTree.Element, links: Sequence[str], source: str) -> None:
    """Mirrors the inertia and the shapes of some links of an SDF model; joints and frames stay, as joint angles do.

    With M = diag(-1, 1, 1), a pose (R, p) becomes (M R M, M p), an inertia I becomes M I M.

    Args:
        root: the SDF.
        links: names.
        source: where the SDF is from, for messages.

    Raises:
        ArmError: there is no such link, or a pose of one that is not six plain numbers.
    """
    by_name = {link.get("name", ""): link for link in root.iterfind("model/link")}
    for name in links:
        if name not in by_name:
            raise ArmError(f'{source}: has no link "{name}" to mirror; its links: {", ".join(by_name)}')
        link = by_name[name]
        for pose in link.iterfind("*/pose"):
            _mirror_pose(f"{source}: link {name}", pose)
        for product in ("ixy", "ixz"):
            for element in link.iterfind(f"inertial/inertia/{product}"):
                element.text = repr(-float(element.text or 0) + 0.0)
        for mesh in link.iterfind("*/geometry/mesh"):
            scale = mesh.find("scale")
            if scale is None:
                scale = ElementTree.SubElement(mesh, "scale")
                scale.text = "1 1 1"
            x, *yz = (scale.text or "").split()
            scale.text = " ".join([f"{-float(x):g}", *yz])


def _mirror_pose(where: str, pose: ElementTree.Element) -> None:
    numbers = (pose.text or "").split()
    if len(numbers) != 6 or pose.get("relative_to") or pose.get("rotation_format", "euler_rpy") != "euler_rpy":
        raise ArmError(f"{where}: to be mirrored, a <pose> must be x y z roll pitch yaw in the link's frame")
    x, y, z, roll, pitch, yaw = map(float, numbers)
    # R = Rz(yaw) Ry(pitch) Rx(roll), and M Rx M = Rx, M Ry M = Ry', M Rz M = Rz'.
    pose.text = " ".join(f"{value + 0.0:.10g}" for value in (-x, y, z, roll, -pitch, -yaw))
