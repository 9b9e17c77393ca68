"""Write a picture of the MTM at a pose, as Meshcat shows it (needs a Chromium; no display)."""

import shutil
import subprocess
import tempfile
import xml.etree.ElementTree as ElementTree
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

from pydrake.geometry import Meshcat, MeshcatParams, MeshcatVisualizer, MeshcatVisualizerParams, Role
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

MODELS = Path(__file__).parents[1] / "dvrk_drake/models"
SDF = MODELS / "sdf/mtm.sdf"
DRIVEN = (
    "outer_yaw",
    "shoulder_pitch",
    "elbow_pitch",
    "wrist_platform",
    "wrist_pitch",
    "wrist_yaw",
    "wrist_roll",
)
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


def joint_angles(sdf: Path, pose: Sequence[float]) -> dict[str, float]:
    """Angles of all joints: the driven ones, and those that mimic them."""
    angles = dict(zip(DRIVEN, pose, strict=True))
    for joint in ElementTree.parse(sdf).getroot().iter("joint"):
        mimic = joint.find("{http://drake.mit.edu}mimic")
        if mimic is not None:
            leader, multiplier, offset = (mimic.get(name, "") for name in ("joint", "multiplier", "offset"))
            angles[joint.get("name", "")] = float(multiplier) * angles[leader] + float(offset)
    return angles


def scene(pose: Sequence[float], camera: Sequence[float], target: Sequence[float], zoom: float, role: Role) -> Meshcat:
    """Meshcat that shows the arm at a pose on a light ground."""
    meshcat = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(MODELS / "package.xml"))
    parser.AddModels(str(SDF))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link"))
    plant.Finalize()
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, MeshcatVisualizerParams(role=role))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    for name, angle in joint_angles(SDF, pose).items():
        plant.GetJointByName(name).set_angle(plant.GetMyMutableContextFromRoot(context), angle)
    diagram.ForcedPublish(context)
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Background", "top_color", [0.86, 0.89, 0.92])
    meshcat.SetProperty("/Background", "bottom_color", [0.97, 0.97, 0.97])
    meshcat.SetProperty("/Cameras/default/rotated/<object>", "zoom", zoom)
    meshcat.SetCameraPose(camera, target)
    return meshcat


def picture(meshcat: Meshcat, file: Path, width: int, height: int, chromium: str) -> None:
    """Let Chromium draw the scene, from a page that needs no server."""
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "scene.html"
        page.write_text(meshcat.StaticHtml().replace("</head>", HIDE_PANEL + "</head>", 1))
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
    parser.add_argument("--pose", nargs=7, type=float, default=[0.0] * 7, metavar="q", help="driven joints, rad")
    parser.add_argument("--camera", nargs=3, type=float, default=[1.1, 0.9, 0.35], metavar="m", help="its place")
    parser.add_argument("--target", nargs=3, type=float, default=[0, -0.09, 0.045], metavar="m", help="seen point")
    parser.add_argument("--zoom", type=float, default=2.8, help="magnification of Meshcat's 75 degree view")
    parser.add_argument("--collision", action="store_true", help="show the collision shapes instead")
    parser.add_argument("--size", nargs=2, type=int, default=[1200, 900], metavar="pixels", help="width, height")
    parser.add_argument("--chromium", default=shutil.which("chromium") or "chromium", help="the browser")
    options = parser.parse_args()
    role = Role.kProximity if options.collision else Role.kIllustration
    meshcat = scene(options.pose, options.camera, options.target, options.zoom, role)
    picture(meshcat, options.file, *options.size, options.chromium)


if __name__ == "__main__":
    main()
