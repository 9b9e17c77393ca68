"""Camera positions: the arm fills the view, and close-ups show only their links."""

import numpy as np
import pytest

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_view.camera import ASPECT, HALF_HEIGHT, close_up, framing, geometry_corners

pytestmark = pytest.mark.drake_api


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_camera_frames_the_whole_arm(name):
    arm = load_arm(name)
    camera, target = framing(arm)
    forward = (target - camera) / np.linalg.norm(target - camera)
    right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
    seen = geometry_corners(arm) - camera
    half_height = HALF_HEIGHT * (seen @ forward)
    share = np.maximum(np.abs(seen @ right) / ASPECT, np.abs(seen @ np.cross(right, forward))) / half_height
    assert (half_height > 0).all()
    assert 0.8 < share.max() < 1.0


def test_close_up_is_nearer_than_the_whole_arm():
    for name in ("mtmr", "psm"):
        arm = load_arm(name)
        camera, target = framing(arm)
        q = np.clip(np.zeros(7), arm.position_lower, arm.position_upper)
        for links in arm.view.close_ups.values():
            near, near_target = close_up(arm, q, tuple(links))
            assert np.linalg.norm(near - near_target) < 0.6 * np.linalg.norm(camera - target)
