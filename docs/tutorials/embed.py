"""Shows HTML files in the output of a notebook."""

from html import escape
from pathlib import Path

from IPython.display import HTML


def show_page(path: str, height: int = 480) -> HTML:
    """Returns the HTML file `path` as a frame of `height` pixels, for display in a notebook."""
    page = escape(Path(path).read_text(), quote=True)
    return HTML(f'<iframe srcdoc="{page}" width="100%" height="{height}" style="border: 0" loading="lazy"></iframe>')
