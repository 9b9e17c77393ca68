"""Configuration of the documentation site (Sphinx, MyST-NB). `make docs` builds it."""

import os
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

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
# The site loads nothing from the network.
nb_ipywidgets_js: dict[str, dict[str, str]] = {}

autosummary_generate = True
autodoc_default_options = {"members": True, "show-inheritance": False, "member-order": "bysource"}
autodoc_typehints_format = "short"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"dvrk_drake {release}"
templates_path = ["_templates"]
html_theme_options = {"source_repository": "", "navigation_with_keys": True}
copybutton_prompt_text = "$ "
copybutton_exclude = ".linenos, .gp, .go"
