"""Makes models/sdf/mtml.sdf and mtmr.sdf (left and right master) from mtm.sdf and arms/*.yaml."""

import xml.etree.ElementTree as ElementTree

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.sdf_model import MODELS_FOLDER, compose_sdf

MASTERS = ("mtml", "mtmr")


def master_sdf(arm: Arm) -> str:
    """Returns the text of the SDF of an arm, with the links of its side and its position limits."""
    root = compose_sdf(arm.sdf, arm.mirrored_links)
    name = arm.name.lower()
    model = root.find("model")
    assert model is not None
    model.set("name", name)
    joints = {joint.get("name"): joint for joint in model.iter("joint")}
    for joint, lower, upper in zip(arm.joint_names, arm.position_lower, arm.position_upper, strict=True):
        limit = joints[joint].find("axis/limit")
        assert limit is not None
        for tag, value in (("lower", lower), ("upper", upper)):
            element = limit.find(tag)
            assert element is not None
            element.text = f"{value:.10g}"
    ElementTree.indent(root)
    source = f"mtm.sdf and ../arms/{name}.yaml"
    comment = f"<!-- {arm.name}. Made by tools/make_master_sdfs.py from {source}; change those, not this file. -->"
    return f'<?xml version="1.0"?>\n{comment}\n{ElementTree.tostring(root, encoding="unicode")}\n'


def main() -> None:
    """Writes both files."""
    for name in MASTERS:
        path = MODELS_FOLDER / "sdf" / f"{name}.sdf"
        path.write_text(master_sdf(load_arm(name)))
        print(path.relative_to(MODELS_FOLDER))


if __name__ == "__main__":
    main()
