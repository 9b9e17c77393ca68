"""Writes a picture of an arm in Meshcat, or of a page that was written. Requires Playwright and Chromium.

The pictures in docs/images:

    python tools/screenshot.py docs/images/mtm.png --arm mtml --size 900 800 --pose 0 0.1 0 0.3 0.3 0.4 0 --zoom 3.6 \\
        --target 0 -0.14 0 --camera 1.6 0.75 0.45
    python tools/screenshot.py docs/images/psm.png --arm psm --size 900 700 --pose 0.2 -0.2 0.12 0.3 0.4 0.3 0.4 \\
        --zoom 4 --target 0 -0.27 0.16
    dvrk-drake simulate teleop --output teleoperation.html
    python tools/screenshot.py docs/images/teleoperation.png --page teleoperation.html --size 1200 750
    dvrk-drake samples samples
    dvrk-drake identify samples/psm_motion.csv --arm psm --output model.yaml --report report.html
    python tools/screenshot.py docs/images/report.png --page report.html --anchor section-2 --size 1280 1000
"""

import shutil
import tempfile
from argparse import ArgumentParser, Namespace
from pathlib import Path

from playwright.sync_api import sync_playwright
from pydrake.geometry import Meshcat, Role

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_view.arm_view import ArmView
from dvrk_drake.systems.arm_view.page import ZOOM, framing, geometry_corners, start_meshcat

FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu")
#: Time after loading in which meshes appear and plots are drawn [ms].
SETTLE = 8000
# Meshcat's page has a control panel that no option hides.
HIDE_PANEL = ".dg, #status-message, #stats-plot { display: none !important; }"


def write_picture(url: str, file: Path, width: int, height: int, chromium: str) -> None:
    """Draws the page at `url` with Chromium, and writes the picture to `file`."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))
        page = browser.new_page(viewport={"width": width, "height": height})
        page.goto(url)
        for frame in page.frames:
            frame.add_style_tag(content=HIDE_PANEL)
        page.wait_for_timeout(SETTLE)
        page.screenshot(path=file)
        browser.close()


def main() -> None:
    """Reads the options and writes the picture."""
    parser = ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path, help="PNG to write")
    parser.add_argument("--page", type=Path, help="page written by Meshcat, instead of an arm")
    parser.add_argument("--anchor", default="", help="part of the page that is at the top of the picture")
    parser.add_argument("--arm", default="mtml", help="name of the arm; default: mtml")
    parser.add_argument(
        "--pose",
        nargs="+",
        type=float,
        default=[0.0] * 7,
        metavar="q",
        help="positions of the independent joints [rad, m]",
    )
    parser.add_argument(
        "--camera",
        nargs=3,
        type=float,
        metavar="m",
        help="position of the camera [m]; default: the whole arm is visible",
    )
    parser.add_argument(
        "--target",
        nargs=3,
        type=float,
        metavar="m",
        help="point at the centre of the picture [m]; default: middle of the arm",
    )
    parser.add_argument(
        "--zoom", type=float, default=ZOOM, help="magnification relative to Meshcat's field of view of 75 degrees"
    )
    parser.add_argument("--collision", action="store_true", help="show the collision shapes instead")
    parser.add_argument(
        "--size", nargs=2, type=int, default=[1200, 900], metavar="pixels", help="width and height of the picture"
    )
    parser.add_argument("--chromium", default=shutil.which("chromium") or "chromium", help="program of the browser")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        page = options.page or Path(folder) / "scene.html"
        if not options.page:
            page.write_text(scene(options).StaticHtml())
        write_picture(f"{page.resolve().as_uri()}#{options.anchor}", options.file, *options.size, options.chromium)


def scene(options: Namespace) -> Meshcat:
    """Returns a Meshcat that shows the arm in the given pose."""
    role = Role.kProximity if options.collision else Role.kIllustration
    arm = load_arm(options.arm)
    camera, target = framing(geometry_corners(arm))
    meshcat = start_meshcat(camera=options.camera or camera, target=options.target or target, zoom=options.zoom)
    ArmView(arm, meshcat, role).show(options.pose)
    return meshcat


if __name__ == "__main__":
    main()
