"""Live teleoperation in a real browser: sliders, clutch, state and place of the controls."""

import re
import subprocess
import sys

import numpy as np
import pytest
from meshcat_browser import CLOSED, drag, largest_gap, link_poses, open_controls
from waiting import wait_until

from dvrk_drake.models.arm_files import load_arm

#: Links of the handle and of the tip.
HANDLE, TIP = "wrist_roll_link", "wrist_yaw_link"
#: Points in the window [px] of the corners of the boxes around the meshes of both arms.
_CORNERS = """() => {
  const points = [];
  for (const arm of ["mtml", "psm"]) {
    viewer.scene_tree.find(["drake", arm, "links"]).object.traverse((object) => {
      if (!object.isMesh) return;
      object.updateWorldMatrix(true, false);
      object.geometry.computeBoundingBox();
      const {min, max} = object.geometry.boundingBox;
      for (const x of [min.x, max.x]) for (const y of [min.y, max.y]) for (const z of [min.z, max.z]) {
        const p = min.clone().set(x, y, z).applyMatrix4(object.matrixWorld).project(viewer.camera);
        points.push([(p.x + 1) / 2 * innerWidth, (1 - p.y) / 2 * innerHeight]);
      }
    });
  }
  return points;
}"""


@pytest.fixture
def teleop():
    """Process of the command `simulate teleop`, and the address of its page."""
    command = [sys.executable, "-m", "dvrk_drake.cli", "simulate", "teleop"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process, re.search(r"http://\S+?(?=;)", process.stdout.readline())[0]
        finally:
            process.terminate()


@pytest.mark.slow
def test_live_teleoperation_in_a_browser(open_page, teleop):
    process, url = teleop
    master, follower = load_arm("mtml"), load_arm("psm")
    page = open_page(url)
    page.wait_for("typeof viewer !== 'undefined'")
    # Without drawing, the test needs seconds instead of minutes on a busy computer.
    page.page.evaluate("viewer.animate = () => viewer.animator.update()")
    open_controls(page, 8)
    wait_until(lambda: len(page.page.evaluate(_CORNERS)) > 100, "drawn arms")
    panel = page.page.locator(".dg.main").last.bounding_box()
    points = np.array(page.page.evaluate(_CORNERS))
    behind = (points[:, 0] > panel["x"]) & (points[:, 1] < panel["y"] + panel["height"])
    assert not behind.any()  # the controls do not cover the arms
    assert points[:, 0].min() > 0

    def moved(arm, link, before, distance):
        return np.abs(link_poses(page, arm, [link])[0] - before).max() > distance

    page.page.keyboard.press("Space")  # closes the clutch
    for name in ("hand_x", "hand_y", "hand_z", "hand_roll", "hand_pitch", "hand_yaw"):
        handle, tip = (link_poses(page, arm, [link])[0] for arm, link in ((master, HANDLE), (follower, TIP)))
        drag(page, name, 0.7)
        wait_until(lambda: moved(master, HANDLE, handle, 0.01), f"{name} moves the handle", process)  # noqa: B023
        wait_until(lambda: moved(follower, TIP, tip, 0.005), f"{name} moves the tip", process)  # noqa: B023
        for arm in (master, follower):
            wait_until(lambda a=arm: largest_gap(page, a) < CLOSED, f"closed linkage of {arm.name}", process)
    (finger,) = link_poses(page, follower, ["finger_1_link"])
    drag(page, "jaw", 0.9)
    wait_until(lambda: moved(follower, "finger_1_link", finger, 0.1), "open jaw", process)
    drag(page, "scale", 0.8)
    page.wait_for("viewer.gui_controllers.scale.getValue() > 0.5")
    page.wait_for("Object.keys(viewer.gui_controllers).some((name) => name.startsWith('clutch closed, error'))")
    assert not page.errors
    page.page.keyboard.press("Escape")
    assert process.wait(60) == 0
