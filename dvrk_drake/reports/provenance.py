"""Provenance of a report: input files with their hashes, versions, command and date."""

from __future__ import annotations

import hashlib
import platform
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.files import open_input


@dataclass(frozen=True)
class Provenance:
    """Origin of a report.

    Attributes:
        inputs: Name and SHA-256 of each input file.
        versions: Name and version of each package that influences the numbers.
        command: Command line. "" for a report from Python.
        created: Date and time, UTC.
    """

    inputs: tuple[tuple[str, str], ...]
    versions: tuple[tuple[str, str], ...]
    command: str
    created: str

    @staticmethod
    def of(inputs: Iterable[str | Path] = (), command: Sequence[str] = ()) -> Provenance:
        """Returns the provenance of a report that is written now.

        Args:
            inputs: Input files. A path that is not a regular file, e.g. a folder with a bag, has no hash.
            command: Words of the command line without the name of the program, e.g. `sys.argv[1:]`. Empty: no command.
        """
        line = shlex.join(["dvrk-drake", *command]) if command else ""
        versions = tuple((name, _version(name)) for name in ("dvrk-drake", "drake", "numpy"))
        return Provenance(
            inputs=tuple((str(path), _sha256(path)) for path in inputs),
            versions=(*versions, ("Python", platform.python_version())),
            command=line,
            created=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        )

    @property
    def rows(self) -> list[tuple[str, str]]:
        """Rows of the provenance table."""
        rows = [(path, f"SHA-256 {digest}" if digest else "not a regular file") for path, digest in self.inputs]
        rows.append(("versions", ", ".join(f"{name} {number}" for name, number in self.versions)))
        return [*rows, ("command", self.command or "written from Python"), ("date", self.created)]


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def _sha256(path: str | Path) -> str:
    try:
        with open_input(path, DvrkDrakeError) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except DvrkDrakeError:
        return ""
