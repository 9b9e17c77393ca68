"""Writes a page as one HTML file with interactive plots and 3D views, which needs no network.

In a section with a 3D view, the view stays visible beside the other blocks of the section. All plots with `time` have a
cursor. Moving the cursor, or a click in such a plot, moves the animation to this time. A playing animation moves the
cursor. Plotly, plots and 3D views are compressed.
"""

from __future__ import annotations

import gzip
import json
import re
from base64 import b64encode
from functools import cache
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports.colours import DARK
from dvrk_drake.reports.page import Command, Page, Plot, Scene, Section, Table, Text, Verdict, cell_text
from dvrk_drake.reports.plotly_figures import plotly_figure
from dvrk_drake.reports.provenance import Provenance


def write_html(page: Page, path: str | Path, provenance: Provenance) -> None:
    """Writes a page atomically.

    Args:
        page: Page.
        path: File to write.
        provenance: Files, versions and command of the page.

    Raises:
        DvrkDrakeError: The file cannot be written.
    """
    text = render_html(page, provenance)
    with atomic_write(path) as stream:
        stream.write(text)


def render_html(page: Page, provenance: Provenance) -> str:
    """Returns a page as HTML. It contains all scripts and styles. The arguments are those of `write_html`."""
    sections = list(page.sections)
    if page.next_step:
        is_command = page.next_step.startswith("dvrk-drake ")
        block = Command(page.next_step, page.next_purpose) if is_command else Text(page.next_step)
        sections.append(Section("Next step", [block]))
    return _environment().get_template("page.html").render(page=page, sections=sections, provenance=provenance)


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
    for kind in (Text, Table, Plot, Scene, Command, Verdict):
        environment.tests[kind.__name__.lower()] = lambda block, kind=kind: isinstance(block, kind)
    return environment
