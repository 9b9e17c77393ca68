"""Installs the wheel and the source distribution into empty environments, and runs the demo and an identification.

python tools/test_package.py dist

The environments are outside the repository, so the commands find only files that the packages contain.
"""

import os
import subprocess
import sys
import venv
from pathlib import Path
from tempfile import TemporaryDirectory

CONSTRAINTS = Path(__file__).resolve().parents[1] / "constraints.txt"
#: Commands to run in each environment.
IDENTIFICATION = (
    "samples samples",
    "identify samples/mtm_poses.csv --arm mtmr --output model.yaml --report report.html",
    "validate samples/mtm_other_poses.csv --model model.yaml --require usable",
)


def run_from_package(package: Path, commands: tuple[str, ...]) -> None:
    """Installs `package` into a new environment, and runs `dvrk-drake` with each of `commands`."""
    # Modules of the repository must not be found.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    with TemporaryDirectory() as folder:
        venv.create(Path(folder) / "venv", with_pip=True)
        programs = Path(folder) / "venv" / "bin"
        install = [programs / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*install, "-c", CONSTRAINTS, package.resolve()], check=True, cwd=folder, env=environment)
        for command in commands:
            print(f"{package.name}: dvrk-drake {command}", flush=True)
            words = [programs / "dvrk-drake", *command.split()]
            subprocess.run(words, check=True, cwd=folder, env=environment, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    dist = Path(sys.argv[1])
    (wheel,), (source,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    run_from_package(wheel, ("demo --folder demo", *IDENTIFICATION))
    run_from_package(source, IDENTIFICATION)
