"""Semantic versions of the files of this package."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from typing import Any

_METADATA = "file format"
_VERSION = re.compile(r"(?P<name>.+) (?P<major>\d{1,4})(\.(?P<minor>\d{1,4}))?")


@dataclass(frozen=True)
class FileFormat:
    """Format of one kind of file. Files state it under the key `format`, e.g. "dvrk_drake arm 1.0".

    The major version changes when a key is renamed or its meaning changes. The minor version changes when a key is
    added. A version without a minor version has the minor version 0.

    Attributes:
        name: Text before the version.
        major, minor: Version of the files that this package writes.
    """

    name: str
    major: int
    minor: int = 0

    @property
    def metadata(self) -> dict[str, FileFormat]:
        """Metadata of the field `format` of a schema. `typed_content` checks the format before it checks other keys."""
        return {_METADATA: self}

    @staticmethod
    def of(schema: Any) -> FileFormat | None:
        """Returns the format in the metadata of a schema, or None."""
        fields = dataclasses.fields(schema) if dataclasses.is_dataclass(schema) else ()
        return next((entry.metadata[_METADATA] for entry in fields if _METADATA in entry.metadata), None)

    def __str__(self) -> str:
        return f"{self.name} {self.major}.{self.minor}"

    def check(self, text: Any) -> None:
        """Raises ValueError if this package cannot read a file whose key `format` has the value `text`.

        The message states the accepted formats.
        """
        found = _VERSION.fullmatch(text) if isinstance(text, str) else None
        accepted = f'allowed: "{self.name} {self.major}.0"' + (f' to "{self}"' if self.minor else "")
        if found is None or found["name"] != self.name:
            raise ValueError(f"format is {str(text)[:60]!r}; {accepted}")
        major, minor = int(found["major"]), int(found["minor"] or 0)
        if (major, minor) > (self.major, self.minor):
            raise ValueError(f'format is "{text}"; {accepted}. Install a newer version of dvrk_drake to read this file')
        if major < self.major:
            raise ValueError(f'format is "{text}"; {accepted}. Older files cannot be converted')
