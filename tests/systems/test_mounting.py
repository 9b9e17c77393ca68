"""Arms in other mountings: gravity has another direction in the base frame."""

import pytest
from controlled_arm import ControlledArm

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]


@pytest.mark.parametrize(
    ("name", "gravity"), [("mtml", (3.0, 2.0, -9.1)), ("mtml", (0.0, 0.0, 9.81)), ("psm", (0.0, -9.81, 0.0))]
)
def test_only_model_of_same_mounting_holds_the_arm(name, gravity):
    arm = load_arm(name)
    mounted = arm.with_gravity(gravity)
    q = (arm.position_lower + 2 * arm.position_upper) / 3
    q[2] -= 0.4 if name == "mtml" else 0.0  # inside the parallelogram's stops
    assert not arm.limit_violations(q)
    right, wrong = (
        ControlledArm(arm, q, IdentifiedModel.from_arm(modelled), plant_arm=mounted, closure="ball").drift(0.5).max()
        for modelled in (mounted, arm)
    )
    assert right < 1e-5
    assert wrong > 0.05
