"""Checks that every HTML report must pass in a browser."""

import subprocess

#: Boxes of a report that must not overlap: text, tables, plots, 3D views, and the text inside plots.
BOXES = "nav, h1, h2, p, figcaption, summary, table, iframe, .canvas, .player, .line"
PLOT_TEXT = ".canvas text"
_VISIBLE = "[...document.querySelectorAll('.canvas')].filter((plot) => plot.checkVisibility())"
#: Whether all visible plots have the width of their elements.
FITS = f"{_VISIBLE}.every((plot) => Math.abs(plot._fullLayout.width - plot.clientWidth) <= 1)"
#: Captions of the tables that are wider than the page.
CUT = """[...document.querySelectorAll(".scroll")].filter((one) => one.scrollWidth > one.clientWidth + 1)
  .map((one) => one.parentElement.textContent.slice(0, 60))"""


#: Widths [px] and colours at which a report is checked, and those at which the pages of all commands are.
VIEWS = ((1920, "light"), (800, "light"), (1280, "dark"))
ALL_VIEWS = tuple((width, colours) for width in (1920, 800, 1280) for colours in ("light", "dark"))


def check_report(open_page, path, views=VIEWS):
    """Opens a report in all views, checks it, and writes a picture of each view beside it.

    Checks errors, requests, overlaps, cut tables, the width of the page, the smallest text of the plots, the size of
    the file, and the headings of the printed page. All sections and tables are opened.

    Returns:
        The page, 1280 px wide.
    """
    for width, colours in views:
        opened = open_page(path, width=width, color_scheme=colours)
        opened.wait_for("document.documentElement.dataset.ready === 'yes'")
        opened.page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        opened.wait_for(FITS)
        assert not opened.errors and not opened.requests
        for selector in (BOXES, PLOT_TEXT):
            overlaps = opened.overlaps(selector)
            assert not overlaps, f"overlaps at {width} px: {overlaps[:5]}"
        assert not opened.page.evaluate(CUT), f"a table is cut at {width} px"
        assert opened.page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "must not scroll sideways"
        sizes = opened.page.evaluate(
            "[...document.querySelectorAll('.canvas text')].map((text) => parseFloat(getComputedStyle(text).fontSize))"
        )
        assert min(sizes, default=12) >= 12, "9 pt are 12 px"
        opened.page.screenshot(path=path.with_name(f"{path.stem}_{width}_{colours}.png"), full_page=True)
    assert path.stat().st_size < 10e6
    check_resized(opened)
    text = printed_text(opened, path.parent)
    if text is not None:
        words = " ".join(text.split())
        assert all(" ".join(title.split()) in words for title in opened.page.locator("h1, h2").all_inner_texts())
    return opened


def check_resized(opened):
    """Checks that visible plots keep their height when the window is resized, also in print and afterwards."""
    heights = f"""{_VISIBLE}.map(
      (plot) => [plot.clientHeight, plot.querySelector('.main-svg').clientHeight, plot._fullLayout.height])"""
    before = opened.page.evaluate(heights)
    assert all(len(set(plot)) == 1 for plot in before)
    opened.page.set_viewport_size({"width": 1400, "height": 800})
    opened.wait_for(FITS)
    assert opened.page.evaluate(heights) == before
    opened.page.evaluate("dispatchEvent(new Event('beforeprint'))")
    printed = opened.page.evaluate(heights)
    # Printing opens closed sections, so their plots may follow.
    assert len(printed) >= len(before) and all(len(set(plot)) == 1 and plot[0] <= 920 for plot in printed)
    opened.page.evaluate("dispatchEvent(new Event('afterprint'))")
    opened.page.set_viewport_size({"width": 1280, "height": 800})
    opened.wait_for(FITS)
    assert all(plot in opened.page.evaluate(heights) for plot in before)


def printed_text(opened, tmp_path):
    """Returns the text of the printed page, or None without pdftotext."""
    file = tmp_path / "report.pdf"
    opened.page.pdf(path=file, format="A4", print_background=True)
    try:
        done = subprocess.run(["pdftotext", "-layout", file, "-"], capture_output=True, text=True, check=True)
    except FileNotFoundError:
        return None
    return done.stdout
