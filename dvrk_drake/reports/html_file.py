"""Writes a page as one HTML file with interactive plots and 3D views, which needs no network.

In a section with a 3D view, the view stays visible beside the other blocks of the section. All plots with `time` have a
cursor. Moving the cursor, or a click in such a plot, moves the animation to this time. A playing animation moves the
cursor. Plotly, plots and 3D views are compressed.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import platform
import re
import shlex
from base64 import b64encode
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.files import atomic_write, open_input
from dvrk_drake.reports.colours import DARK
from dvrk_drake.reports.page import Page, Plot, Scene, Table, Text, Verdict, cell_text
from dvrk_drake.reports.plotly_figures import plotly_figure


def write_html(page: Page, path: str | Path, inputs: Iterable[str | Path] = (), command: Sequence[str] = ()) -> None:
    """Writes a page atomically. Its provenance states inputs, versions, command and date.

    Args:
        page: Page.
        path: File to write.
        inputs: Input files. The page states their SHA-256. A folder, e.g. with a bag, has none.
        command: Words of the command line without the name of the program, e.g. `sys.argv[1:]`. Empty: no command.

    Raises:
        DvrkDrakeError: The file cannot be written.
    """
    text = render_html(page, inputs, command)
    with atomic_write(path) as stream:
        stream.write(text)


def render_html(page: Page, inputs: Iterable[str | Path] = (), command: Sequence[str] = ()) -> str:
    """Returns a page as HTML. It contains all scripts and styles. The arguments are those of `write_html`."""
    versions = [f"{name} {_version(name)}" for name in ("dvrk-drake", "drake", "numpy")]
    provenance = [
        *((str(path), _sha256(path)) for path in inputs),
        ("versions", ", ".join([*versions, f"Python {platform.python_version()}"])),
        ("command", shlex.join(["dvrk-drake", *command]) if command else "written from Python"),
        ("date", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")),
    ]
    return _environment().get_template("page.html").render(page=page, provenance=provenance)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def _sha256(path: str | Path) -> str:
    try:
        with open_input(path, DvrkDrakeError) as file:
            return f"SHA-256 {hashlib.file_digest(file, 'sha256').hexdigest()}"
    except DvrkDrakeError:
        return "not a regular file"


def _scene(block: Scene) -> tuple[str, str]:
    """Returns the page of a 3D view, or the reason why there is none."""
    try:
        return block.html(), ""
    except DvrkDrakeError as error:
        return "", str(error)


def _packed(text: str) -> str:
    """Returns text as Base64 of gzip, which page.js unpacks. Plotly's script shrinks from 4.8 MB to 2 MB."""
    return b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def _unbroken(text: str) -> str:
    """Returns a heading whose units in brackets are not broken into lines, nor numbers before a percent sign."""
    text = re.sub(r"\[[^]]*\]", lambda unit: unit[0].replace(" ", "\N{NO-BREAK SPACE}"), text)
    return re.sub(r"(?<=\d) %", "\N{NO-BREAK SPACE}%", text)


def _emphasis(text: str) -> Markup:
    """Escapes text and converts **emphasis** and `code` to HTML."""
    marked = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", str(escape(text)), flags=re.DOTALL)
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", marked))


def _template(name: str) -> str:
    return files("dvrk_drake.reports").joinpath("templates", name).read_text(encoding="utf-8")


@cache
def _plotly_script() -> str:
    return _packed(get_plotlyjs())


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FunctionLoader(_template),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {
        "file": lambda name: Markup(_template(name)),
        "plotly": _plotly_script,
        "dark_colours": Markup(json.dumps(DARK)),
        "scene": _scene,
    }
    environment.filters |= {
        "cell": lambda cell: _unbroken(cell_text(cell)),
        "heading": _unbroken,
        "emphasis": _emphasis,
        "packed": _packed,
        "figure": lambda plot: str(plotly_figure(plot).to_json()),
    }
    for kind in (Text, Table, Plot, Scene, Verdict):
        environment.tests[kind.__name__.lower()] = lambda block, kind=kind: isinstance(block, kind)
    return environment


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
        >>> from dvrk_drake.export.dvrk_mtm_gravity_compensation import compare_compensation
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
