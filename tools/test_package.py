"""Installs the wheel into an empty environment, then the source distribution instead, and runs commands with each.

python tools/test_package.py dist

The commands are the demo and an identification. The environment is outside the repository, so the commands find only
files that the packages contain. The dependencies of both packages are those of pyproject.toml, and are installed once.
"""

import os
import subprocess
import sys
import venv
from pathlib import Path
from tempfile import TemporaryDirectory

CONSTRAINTS = Path(__file__).resolve().parents[1] / "constraints.txt"
#: Commands to run with each package.
IDENTIFICATION = (
    "samples samples",
    "identify samples/mtm_poses.csv --arm mtmr --output model.yaml --report report.html",
    "validate samples/mtm_other_poses.csv --model model.yaml --require usable",
)


def run_from_package(programs: Path, package: Path, options: tuple[str, ...], commands: tuple[str, ...]) -> None:
    """Installs `package` with the pip of `programs`, and runs `dvrk-drake` with each of `commands` in a new folder."""
    # Modules of the repository must not be found.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    with TemporaryDirectory() as folder:
        install = [programs / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *options]
        subprocess.run([*install, "-c", CONSTRAINTS, package.resolve()], check=True, cwd=folder, env=environment)
        for command in commands:
            print(f"{package.name}: dvrk-drake {command}", flush=True)
            words = [programs / "dvrk-drake", *command.split()]
            subprocess.run(words, check=True, cwd=folder, env=environment, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    dist = Path(sys.argv[1])
    (wheel,), (source,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    with TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        programs = Path(folder) / "bin"
        run_from_package(programs, wheel, (), ("demo --folder demo", *IDENTIFICATION))
        # pip removes all files of the wheel first.
        run_from_package(programs, source, ("--force-reinstall", "--no-deps"), IDENTIFICATION)
