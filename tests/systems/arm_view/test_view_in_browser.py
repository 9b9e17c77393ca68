"""Views of the arms in a real browser: each slider moves its joint, and the linkage stays closed."""

import numpy as np
import pytest
from meshcat_browser import CLOSED, drag, largest_gap, link_poses, open_controls, press
from waiting import wait_until

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import set_arm_positions, shared_plant
from dvrk_drake.systems.arm_view.arm_view import DEGREES, EFFORTS, FRAMES, HOME, RANDOM, ArmView
from dvrk_drake.systems.arm_view.page import home_position, start_meshcat


def open_view(open_page, name):
    """Returns an arm, its view with buttons and sliders, and the page with open controls."""
    arm = load_arm(name)
    view = ArmView(arm, start_meshcat(arm))
    view.add_view_buttons()
    view.add_sliders()
    page = open_page(view.meshcat.web_url())
    open_controls(page, 10)
    return arm, view, page


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_sliders_keep_the_loop_closed(open_page, name):
    arm, view, page = open_view(open_page, name)
    plant = shared_plant(arm)
    for joint, slider in zip(arm.joint_names, view._sliders.names, strict=True):
        link = plant.GetJointByName(joint).child_body().name()
        drawn = []
        for share in (0.3, 0.7):
            before = view.meshcat.GetSliderValue(slider)
            drag(page, slider, share)
            wait_until(lambda b=before, s=slider: view.meshcat.GetSliderValue(s) != b, f"slider {slider} at {share}")
            q = view.follow_controls()
            context = plant.CreateDefaultContext()
            set_arm_positions(plant, context, arm, q)
            expected = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(link)).GetAsMatrix4()
            wait_until(
                lambda e=expected, li=link: np.allclose(link_poses(page, arm, [li])[0], e, rtol=0, atol=1e-5),
                f"the browser draws {link}",
            )
            # The browser receives the links one after the other.
            wait_until(lambda: largest_gap(page, arm) < CLOSED, f"closed linkage after {slider} = {q}")
            drawn.append(expected)
        assert not np.allclose(drawn[0], drawn[1], rtol=0, atol=1e-3), f"{slider} does not move {link}"
    assert not page.errors
    assert not page.requests


@pytest.mark.slow
def test_buttons_change_the_view(open_page):
    arm, view, page = open_view(open_page, "psm")
    tree = f"viewer.scene_tree.find(['drake', '{arm.name.lower()}'])"

    def click(label):
        clicks = view.meshcat.GetButtonClicks(label)
        press(page, label)
        wait_until(lambda: view.meshcat.GetButtonClicks(label) > clicks, f"click on {label}")
        view.follow_controls()

    def turn(label, on):
        drag(page, label, 0.9 if on else 0.1)
        wait_until(lambda: view.meshcat.GetSliderValue(label) == on, f"{label} {on}")
        view.follow_controls()

    turn(FRAMES, True)
    page.wait_for(f"{tree}.children.frames")
    turn(EFFORTS, True)
    page.wait_for(f"{tree}.children.overlay.children.efforts.object.visible")
    click(RANDOM)
    assert not arm.limit_violations(view._q, tolerance=0.02)
    assert np.any(view._q != 0)
    wait_until(lambda: largest_gap(page, arm) < CLOSED, "closed linkage")
    turn(DEGREES, True)
    np.testing.assert_allclose(view.follow_controls(), view._q, rtol=0, atol=1e-12)
    elbow = view._sliders.names[1]
    assert view.meshcat.GetSliderValue(elbow) == pytest.approx(np.degrees(view._q[1]), abs=0.2)
    click(HOME)
    np.testing.assert_allclose(view._q, home_position(arm), rtol=0, atol=0.02)
    for preset in view.camera_presets[::-1]:
        click(preset)
        page.wait_for(f"viewer.camera.position.length() < {4 if preset == 'whole arm' else 1.5}")
    turn(FRAMES, False)
    page.wait_for(f"!{tree}.children.frames")
    assert not page.errors
