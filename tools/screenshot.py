"""Write a picture of an arm at a pose, as Meshcat shows it (needs a Chromium; no display)."""

import shutil
import subprocess
import tempfile
from argparse import ArgumentParser, Namespace
from pathlib import Path

from pydrake.geometry import Meshcat, Role

from dvrk_drake.models.arm import load_arm
from dvrk_drake.systems.arm_view import ZOOM, ArmView, framing, start_meshcat

CHROMIUM_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--virtual-time-budget=8000",
)
# Drake's page shows a control panel, which has no setting of its own.
HIDE_PANEL = "<style>.dg, #status-message, #stats-plot { display: none !important; }</style>"


def picture(html: str, file: Path, width: int, height: int, chromium: str) -> None:
    """Let Chromium draw a page that Meshcat has written, one that needs no server."""
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "scene.html"
        page.write_text(html.replace("</head>", HIDE_PANEL + "</head>", 1))
        command = [
            chromium,
            *CHROMIUM_FLAGS,
            f"--user-data-dir={folder}/profile",
            f"--window-size={width},{height}",
            f"--screenshot={file.resolve()}",
            page.as_uri(),
        ]
        file.unlink(missing_ok=True)
        subprocess.run(command, check=True, capture_output=True, timeout=120)
    if not file.exists():
        raise RuntimeError(f"{chromium} wrote no picture")


def main() -> None:
    """Read the options and write the picture."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, help="PNG to write")
    parser.add_argument("--page", type=Path, help="a page that Meshcat has written, instead of an arm")
    parser.add_argument("--arm", default="mtml", help="which arm")
    parser.add_argument(
        "--pose", nargs="+", type=float, default=[0.0] * 7, metavar="q", help="independent joints, rad or m"
    )
    parser.add_argument("--camera", nargs=3, type=float, metavar="m", help="its place; default: frames the arm")
    parser.add_argument("--target", nargs=3, type=float, metavar="m", help="seen point; default: the arm's middle")
    parser.add_argument("--zoom", type=float, default=ZOOM, help="magnification of Meshcat's 75 degree view")
    parser.add_argument("--collision", action="store_true", help="show the collision shapes instead")
    parser.add_argument("--size", nargs=2, type=int, default=[1200, 900], metavar="pixels", help="width, height")
    parser.add_argument("--chromium", default=shutil.which("chromium") or "chromium", help="the browser")
    options = parser.parse_args()
    html = options.page.read_text() if options.page else scene(options).StaticHtml()
    picture(html, options.file, *options.size, options.chromium)


def scene(options: Namespace) -> Meshcat:
    """The arm at its pose."""
    role = Role.kProximity if options.collision else Role.kIllustration
    arm = load_arm(options.arm)
    camera, target = framing(arm)
    meshcat = start_meshcat(camera=options.camera or camera, target=options.target or target, zoom=options.zoom)
    ArmView(arm, meshcat, role).show(options.pose)
    return meshcat


if __name__ == "__main__":
    main()
