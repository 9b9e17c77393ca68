"""Views of the arms in a real browser: each slider moves its joint, and the linkage stays closed."""

import numpy as np
import pytest
from waiting import wait_until

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import set_arm_positions, shared_plant
from dvrk_drake.systems.arm_view.arm_view import DEGREES, EFFORTS, FRAMES, HOME, NAMES, RANDOM, ArmView
from dvrk_drake.systems.arm_view.page import start_meshcat, tracked_url

#: Gap of a closed loop [m]. The browser may round the transforms of the links to single precision.
CLOSED = 1e-6


def link_poses(page, arm, names):
    """Returns the poses (4, 4) of links in the world, as the browser draws them."""
    # In the browser, y is up, so that the world of Drake is rotated.
    script = """(paths) => [["drake"], ...paths].map((path) => {
      const object = viewer.scene_tree.find(path).object;
      object.updateWorldMatrix(true, false);
      return object.matrixWorld.elements;
    })"""
    plant = shared_plant(arm)
    model = plant.GetModelInstanceName(plant.GetBodyByName("base_link").model_instance())
    paths = [["drake", arm.name.lower(), "links", model, name] for name in names]
    world, *links = (np.reshape(elements, (4, 4)).T for elements in page.page.evaluate(script, paths))
    return [np.linalg.inv(world) @ link for link in links]


def largest_gap(page, arm):
    """Returns the largest distance of the two frames of a loop closure [m], as the browser draws them."""
    plant, gaps = shared_plant(arm), []
    for loop in arm.loop_closures:
        frames = [plant.GetFrameByName(name) for name in (loop.frame_a, loop.frame_b)]
        poses = link_poses(page, arm, [frame.body().name() for frame in frames])
        points = [
            X @ frame.GetFixedPoseInBodyFrame().GetAsMatrix4()[:, 3] for X, frame in zip(poses, frames, strict=True)
        ]
        gaps.append(np.linalg.norm(points[0] - points[1]))
    return max(gaps)


def press(page, label):
    page.page.locator(".dg .property-name", has_text=label).first.click()


def drag(page, name, share):
    """Clicks the slider `name` at a share of its width."""
    row = page.page.locator(".dg li.number", has_text=name).first
    box = row.locator(".slider").bounding_box()
    page.page.mouse.click(box["x"] + share * box["width"], box["y"] + box["height"] / 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mtml", "mtmr", "psm"])
def test_each_slider_moves_its_joint_and_keeps_the_loop_closed(open_page, name):
    arm = load_arm(name)
    view = ArmView(arm, start_meshcat(arm))
    view.add_view_buttons()
    view.add_sliders()
    page = open_page(tracked_url(view.meshcat))
    page.wait_for("typeof viewer !== 'undefined' && Object.keys(viewer.gui_controllers).length > 10")
    page.page.locator(".dg .close-button").last.click()
    plant = shared_plant(arm)
    for joint, slider in zip(arm.joint_names, view._sliders.names, strict=True):
        link = plant.GetJointByName(joint).child_body().name()
        drawn = []
        for share in (0.3, 0.5, 0.7):
            before = view.meshcat.GetSliderValue(slider)
            drag(page, slider, share)
            wait_until(lambda b=before, s=slider: view.meshcat.GetSliderValue(s) != b, f"slider {slider} at {share}")
            q = view.follow_controls()
            expected = plant_link_pose(plant, arm, q, link)
            wait_until(
                lambda e=expected, li=link: np.allclose(link_poses(page, arm, [li])[0], e, rtol=0, atol=1e-5),
                f"the browser draws {link}",
            )
            assert largest_gap(page, arm) < CLOSED
            drawn.append(expected)
        assert not np.allclose(drawn[0], drawn[2], rtol=0, atol=1e-3), f"{slider} does not move {link}"
    assert not page.errors
    assert not page.requests


def plant_link_pose(plant, arm, q, link):
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, q)
    return plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(link)).GetAsMatrix4()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_buttons_change_the_view(open_page, name):
    arm = load_arm(name)
    view = ArmView(arm, start_meshcat(arm))
    view.add_view_buttons()
    view.add_sliders()
    page = open_page(tracked_url(view.meshcat))
    page.wait_for("typeof viewer !== 'undefined' && Object.keys(viewer.gui_controllers).length > 10")
    page.page.locator(".dg .close-button").last.click()
    overlay = f"['drake', '{arm.name.lower()}', 'overlay'"
    visible = f"viewer.scene_tree.find({overlay}, '{{}}']).object.visible"

    def click(label):
        clicks = view.meshcat.GetButtonClicks(label)
        press(page, label)
        wait_until(lambda: view.meshcat.GetButtonClicks(label) > clicks, f"click on {label}")
        view.follow_controls()

    for label, path in ((FRAMES, "frames"), (NAMES, "names"), (EFFORTS, "efforts")):
        click(label)
        page.wait_for(visible.format(path))
    click(RANDOM)
    assert not arm.limit_violations(view._q, tolerance=0.02)
    assert np.any(view._q != 0)
    assert largest_gap(page, arm) < CLOSED
    click(DEGREES)
    np.testing.assert_allclose(view.follow_controls(), view._q, rtol=0, atol=1e-12)
    elbow = view._sliders.names[1]
    assert view.meshcat.GetSliderValue(elbow) == pytest.approx(np.degrees(view._q[1]), abs=0.2)
    click(HOME)
    np.testing.assert_allclose(view._q, np.clip(0, arm.position_lower, arm.position_upper), rtol=0, atol=0.02)
    for preset in view.overlay.camera_presets[::-1]:
        click(preset)
        page.wait_for(f"viewer.camera.position.length() < {4 if preset == 'whole arm' else 1.5}")
    click(FRAMES)
    page.wait_for("!" + visible.format("frames"))
    assert not page.errors
