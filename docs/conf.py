"""Configuration of the documentation site (Sphinx, MyST-NB). `make docs` builds it."""

import os
import re
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.util.inspect import TypeAliasForwardRef

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS))  # for the extension `pydrake_system`
# The notebooks call `dvrk-drake`, and import the helper `embed`.
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
os.environ["PYTHONPATH"] = os.pathsep.join([str(DOCS / "tutorials"), *filter(None, [os.environ.get("PYTHONPATH")])])
# Width of the tables that commands print. Wider lines do not fit into the page.
os.environ["COLUMNS"] = "88"

default_role = "literal"
project = "dvrk_drake"
author = "the dvrk_drake authors"
copyright = "2026, the dvrk_drake authors"
version = release = installed_version("dvrk-drake")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx-mathjax-offline",
    "cyclopts.ext.sphinx",
    "pydrake_system",
]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]

myst_enable_extensions = ["dollarmath", "attrs_inline", "colon_fence"]
myst_heading_anchors = 4
# Pages link to examples and tools of the repository as GitHub does. Sphinx offers these files as downloads.
nb_execution_mode = "cache"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True
# Pygments cannot parse a command of several lines in an IPython cell. It is shown nevertheless.
suppress_warnings = ["misc.highlighting_failure"]
# The site loads nothing from the network.
nb_ipywidgets_js: dict[str, dict[str, str]] = {}

autosummary_generate = True
autodoc_default_options = {"members": True, "member-order": "bysource"}
# Signatures contain names and defaults. The types are in the lists of the parameters.
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "NDArray": "NDArray"}
napoleon_attr_annotations = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"dvrk_drake {release}"
templates_path = ["_templates"]
html_theme_options = {"source_repository": "", "navigation_with_keys": True}
copybutton_prompt_text = "$ "
copybutton_exclude = ".linenos, .gp, .go"


def array_alias(alias: TypeAliasForwardRef, _item: object) -> TypeAliasForwardRef:
    """Returns the alias of an array, without the type of its elements. Sphinx cannot subscript aliases itself."""
    return alias


def split_attributes(_app: Sphinx, _what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
    """Replaces each entry "a, b: text" of an attribute list by one entry per name, as Napoleon requires."""
    text = "\n".join(lines)
    start, heading, attributes = text.partition("Attributes:\n")
    entry = re.compile(r"^( {4})(\w+(?:, \w+)+)(:(?:.*\n?)(?: {5,}.*\n?)*)", re.MULTILINE)
    split = entry.sub(lambda m: "".join(f"{m[1]}{n}{m[3].rstrip()}\n" for n in m[2].split(", ")), attributes)
    lines[:] = (start + heading + split).split("\n")


def setup(app: Sphinx) -> None:
    """Registers the handler, which runs before that of Napoleon (priority 500)."""
    TypeAliasForwardRef.__getitem__ = array_alias
    TypeAliasForwardRef.__repr__ = lambda alias: alias.name  # for unions
    app.connect("autodoc-process-docstring", split_attributes, priority=400)
