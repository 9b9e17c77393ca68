"""Makes the visual meshes of the arms, models/sdf/meshes/<model>/<link>.gltf. Requires the extra `geometry`."""

from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path

import mtm_shapes
import needle_driver_shapes
import psm_shapes
from shapes import Body, write_gltf

SDF_FOLDER = Path(__file__).parents[1] / "dvrk_drake/models/sdf"

# Mesh folder -> name of the SDF with the lengths, and function that makes the bodies.
MODELS: dict[str, tuple[str, Callable[[Path], dict[str, Callable[[], Body]]]]] = {
    "mtm": ("mtmr", mtm_shapes.bodies),
    "psm": ("psm", psm_shapes.bodies),
    "large_needle_driver": ("large_needle_driver", needle_driver_shapes.bodies),
}


def main() -> None:
    """Writes one file per link."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument(
        "--folder", type=Path, default=SDF_FOLDER / "meshes", help="output folder; default: %(default)s"
    )
    parser.add_argument("--model", action="append", choices=list(MODELS), help="only this model (may be repeated)")
    parser.add_argument("--link", action="append", help="only this link (may be repeated)")
    options = parser.parse_args()
    for model in options.model or MODELS:
        folder = options.folder / model
        folder.mkdir(parents=True, exist_ok=True)
        sdf, bodies = MODELS[model]
        for link, body in bodies(SDF_FOLDER / f"{sdf}.sdf").items():
            if not options.link or link in options.link:
                path = folder / f"{link}.gltf"
                write_gltf(body(), path)
                print(f"{model}/{path.name:28} {path.stat().st_size / 1000:6.0f} kB")


if __name__ == "__main__":
    main()
