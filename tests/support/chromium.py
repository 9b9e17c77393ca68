"""Headless Chromium for tests of web pages, controlled with Playwright.

The fixture `open_page` opens a file or a URL:

    def test_slider(open_page):
        page = open_page(meshcat.web_url())
        page.frame.locator("text=Play").click()
        assert not page.errors

Tests with this fixture are skipped if Playwright or Chromium is not installed.
"""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

PROGRAMS = "chromium", "chromium-browser", "google-chrome"
FLAGS = (
    *("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu", "--disable-quic"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
#: Time limit of each step [ms]. Chromium draws 3D views in software, which takes seconds on a busy computer.
TIME_LIMIT = 120_000

#: Pairs of visible boxes that overlap by more than 2 px, without a box and its own content.
_OVERLAPS = """(selector) => {
  const shown = [...document.querySelectorAll(selector)].map((element) => [element, element.getBoundingClientRect()])
    .filter(([element, box]) => box.width > 0 && box.height > 0 && element.checkVisibility({visibilityProperty: true}));
  const name = (element) => (element.textContent || element.className || element.tagName).trim().slice(0, 60);
  const pairs = [];
  shown.forEach(([a, p], i) => shown.slice(i + 1).forEach(([b, q]) => {
    if (a.contains(b) || b.contains(a)) return;
    const width = Math.min(p.right, q.right) - Math.max(p.left, q.left);
    const height = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
    if (width > 2 && height > 2) pairs.push(name(a) + " | " + name(b));
  }));
  return pairs;
}"""


@dataclass
class OpenedPage:
    """Page in Chromium.

    Attributes:
        page: Page of Playwright.
        errors: Errors in the console and exceptions of scripts.
        requests: URLs of requests to other computers.
    """

    page: Any
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def wait_for(self, condition: str, frame: Any = None) -> None:
        """Waits until a JavaScript expression is true in the page or in one of its frames."""
        (frame or self.page).wait_for_function(condition, timeout=TIME_LIMIT)

    def overlaps(self, selector: str) -> list[str]:
        """Returns the pairs of visible elements that overlap, of all elements that match a CSS selector."""
        return self.page.evaluate(_OVERLAPS, selector)

    def translation(self, body: str, frame: Any = None) -> np.ndarray:
        """Returns the position (3,) [m] of a Meshcat object in the world frame, e.g. "/drake/visualizer/MTML/dh_7"."""
        script = """(path) => {
          const object = viewer.scene_tree.find(path.split("/").filter(Boolean)).object;
          object.updateWorldMatrix(true, false);
          return object.matrixWorld.elements.slice(12, 15);
        }"""
        return np.array((frame or self.page).evaluate(script, body))


@pytest.fixture(scope="module")
def chromium_browser() -> Iterator[Any]:
    """Headless Chromium. One per test file, because the event loop of Playwright must not be active in other files."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs Playwright (pip install playwright)")
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        pytest.skip("needs Chromium (apt-get install chromium)")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        yield browser
        browser.close()


@pytest.fixture
def open_page(chromium_browser: Any) -> Iterator[Callable[..., OpenedPage]]:
    """Function that opens a file or URL in a window of a given size [px], and returns an `OpenedPage`."""
    contexts = []

    def open_in_window(
        location: Path | str, width: int = 1280, height: int = 800, color_scheme: str = "light"
    ) -> OpenedPage:
        context = chromium_browser.new_context(viewport={"width": width, "height": height}, color_scheme=color_scheme)
        contexts.append(context)
        opened = OpenedPage(context.new_page())
        opened.page.set_default_timeout(TIME_LIMIT)
        opened.page.on("console", lambda m: opened.errors.append(m.text) if m.type == "error" else None)
        opened.page.on("pageerror", lambda error: opened.errors.append(str(error)))
        opened.page.on("request", lambda request: opened.requests.append(request.url) if is_remote(request.url) else 0)
        opened.page.goto(location.resolve().as_uri() if isinstance(location, Path) else location)
        return opened

    yield open_in_window
    for context in contexts:
        context.close()


def is_remote(url: str) -> bool:
    """Tells whether a URL needs the network."""
    parts = urlsplit(url)
    return parts.scheme in ("http", "https", "ws", "wss") and parts.hostname not in ("localhost", "127.0.0.1")
