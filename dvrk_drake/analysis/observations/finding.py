"""Finding about a recording, with its severity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Severity = Literal["note", "warning", "refusal"]


@dataclass(frozen=True)
class Finding:
    """Finding about a recording.

    Attributes:
        severity: "note" for information, "warning" if results will be less accurate, "refusal" if results would be
            wrong. `identify` rejects a recording with a refusal.
        kind: Short, stable name of the finding, e.g. "repeated rows".
        where: Affected joints, columns or rows, or source of the recording.
        what: Description of the problem with numbers, without a final period.
        advice: Sentences with the consequence and the recommended action, or "".
        joints: Indices of the affected joints, starting at 0.
        size: Numerical value of the finding in SI units, nan if the finding has no value.
    """

    severity: Severity
    kind: str
    where: str
    what: str
    advice: str
    joints: tuple[int, ...] = ()
    size: float = float("nan")

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}: {self.what}. {self.advice}".rstrip()

    def within(self, source: str) -> Finding:
        """Returns the finding with the name of its recording before `where`."""
        return replace(self, where=f"{source}: {self.where}")
