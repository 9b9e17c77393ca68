"""Settings of the tutorials: shows HTML files in the output of a notebook, and hides the progress of commands."""

import logging
import subprocess
import sys
from dataclasses import dataclass
from html import escape
from pathlib import Path

from IPython.core.getipython import get_ipython


@dataclass(frozen=True)
class Frame:
    """HTML element that Jupyter shows as the output of a cell. `IPython.display.HTML` would warn about `<iframe>`."""

    html: str

    def _repr_html_(self) -> str:
        return self.html


def show_page(path: str, height: int = 480) -> Frame:
    """Returns the HTML file `path` as a frame of `height` pixels, for display in a notebook."""
    page = escape(Path(path).read_text(), quote=True)
    return Frame(f'<iframe srcdoc="{page}" width="100%" height="{height}" style="border: 0" loading="lazy"></iframe>')


def hide_progress() -> None:
    """Hides progress bars of `!` commands and log lines of Drake in this notebook.

    A command that fails shows its message and raises an error, so that the build of the documentation fails.
    """
    import pydrake.common  # noqa: F401  (sets the log level that the next line changes)

    logging.getLogger("drake").setLevel(logging.WARNING)
    shell = get_ipython()

    def run(command: str) -> None:
        command = shell.var_expand(command, depth=1)
        done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
        print(done.stdout, end="")
        if done.returncode:
            print(done.stderr, end="", file=sys.stderr)
            raise RuntimeError(f"exit code {done.returncode}: {command}")

    shell.system = run
