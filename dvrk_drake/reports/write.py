"""Writes the HTML report of a result."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.reports.html_file import write_html

#: Mapping from the name of a result's class to the module of its page and the function in it that returns the page:
#: `function(result) -> Page`. Modules are imported when they are needed.
_MAKERS = {
    "ExcitationDesign": ("excitation", "motion_page"),
    "StaticPoseDesign": ("excitation", "poses_page"),
    "CompensationComparison": ("export", "compensation_page"),
    "ExternalForce": ("external_force", "force_page"),
    "PayloadIdentification": ("payload", "payload_page"),
    "Tuning": ("tuning", "tuning_page"),
    "DynamicIdentification": ("identification", "identification_page"),
    "DynamicValidation": ("identification", "identification_page"),
    "StaticIdentification": ("identification", "identification_page"),
    "StaticValidation": ("identification", "identification_page"),
}


def write_report(
    result: Any, path: str | Path, *, inputs: Iterable[str | Path] = (), command: Sequence[str] = ()
) -> None:
    """Writes the HTML report of a result, one self-contained file.

    The results that have a report also have a method for it: `result.report(path, inputs=...)`.

    Args:
        result: Result of a function of this package, e.g. `identify`.
        path: File to write, e.g. "report.html". An existing file is replaced.
        inputs: Input files. The report states their names and SHA-256.
        command: Words of the command line that computed the result, without the name of the program.

    Raises:
        DvrkDrakeError: There is no report for this type, or the file cannot be written.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from dvrk_drake.export.dvrk_mtm_gravity_compensation_comparison import compare_compensation
        >>> from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
        >>> model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm("mtml"))
        >>> exported = dvrk.export_model(model, "gc-MTML.json", "dvrk-gc", tolerance=1.0)
        >>> comparison = compare_compensation(GravityCompensationFile.load("gc-MTML.json"), model)
        >>> dvrk.write_report(comparison, "report.html", inputs=["gc-MTML.json"])
        >>> comparison.report("report.html", inputs=["gc-MTML.json"])  # the same report
    """
    name = type(result).__name__
    if name not in _MAKERS:
        raise DvrkDrakeError(f"there is no report for {name}; allowed: {', '.join(sorted(_MAKERS))}")
    module, function = _MAKERS[name]
    page = getattr(import_module(f"dvrk_drake.reports.{module}"), function)(result)
    write_html(page, path, inputs, command)
