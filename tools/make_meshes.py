"""Makes the visual meshes of the arms, models/sdf/meshes/<model>/<link>.gltf. Requires the extra `geometry`."""

from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path

import mtm_shapes
import needle_driver_shapes
import psm_shapes
from shapes import Body, write_gltf

SDF_FOLDER = Path(__file__).parents[1] / "dvrk_drake/models/sdf"

# Functions that make the bodies of a model, by the name of the model. Its SDF and its mesh folder have the same name.
MODELS: dict[str, Callable[[Path], dict[str, Callable[[], Body]]]] = {
    "mtm": mtm_shapes.bodies,
    "psm": psm_shapes.bodies,
    "large_needle_driver": needle_driver_shapes.bodies,
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
        for link, body in MODELS[model](SDF_FOLDER / f"{model}.sdf").items():
            if not options.link or link in options.link:
                path = folder / f"{link}.gltf"
                write_gltf(body(), path)
                print(f"{model}/{path.name:28} {path.stat().st_size / 1000:6.0f} kB")


if __name__ == "__main__":
    main()
