"""Poses of links that a browser draws in Meshcat, and use of Meshcat's controls with the mouse."""

import numpy as np

from dvrk_drake.models.plant import shared_plant

#: Gap of a closed loop [m]. The browser may round the transforms of the links to single precision.
CLOSED = 1e-6


def open_controls(page, least):
    """Waits for more than `least` controls and opens the control panel."""
    page.wait_for(f"typeof viewer !== 'undefined' && Object.keys(viewer.gui_controllers).length > {least}")
    # `Locator.click` waits for steady frames, which a busy computer draws only every few seconds.
    page.page.locator(".dg .close-button").last.evaluate("button => button.click()")


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
    page.page.locator(".dg .property-name", has_text=label).first.evaluate("label => label.click()")


def drag(page, name, share):
    """Clicks the slider `name` at a share of its width."""
    row = page.page.locator(".dg li.number", has_text=name).first
    box = row.locator(".slider").bounding_box()
    page.page.mouse.click(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
