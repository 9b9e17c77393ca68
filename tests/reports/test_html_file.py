"""HTML of a page, in a browser: plots, time cursor with the animation, layout, printing."""

import hashlib

import numpy as np
import pytest
from pydrake.geometry import Box, MeshcatAnimation
from pydrake.math import RigidTransform
from report_checks import check_report, printed_text

from dvrk_drake.reports.colours import LIMIT, MEASURED, SERIES
from dvrk_drake.reports.html_file import write_html
from dvrk_drake.reports.page import Page, Plot, Scene, Section, Table, Text, Verdict
from dvrk_drake.reports.plot import Bars, Curve, Guide, Panel, category_panel
from dvrk_drake.reports.plotly_figures import plotly_figure
from dvrk_drake.systems.arm_view.page import start_meshcat

#: Duration of the animation [s]. The box moves along x with 0.1 m/s.
DURATION, SPEED = 4.0, 0.1


@pytest.fixture(scope="module")
def scene():
    """HTML page of Meshcat with a moving box."""
    meshcat = start_meshcat()
    meshcat.SetObject("box", Box(0.1, 0.1, 0.1))
    animation = MeshcatAnimation(frames_per_second=20)
    for frame in range(int(20 * DURATION) + 1):
        animation.SetTransform(frame, "box", RigidTransform([SPEED * frame / 20, 0.0, 0.0]))
    meshcat.SetAnimation(animation)
    return meshcat.StaticHtml()


def effort_plot():
    """Returns a plot with two panels over time."""
    t = np.linspace(0.0, DURATION, 401)
    panels = [
        Panel(name, [Curve("measured", t, np.sin(k * t), MEASURED)], "t [s]", "effort [N m]")
        for k, name in ((1, "shoulder"), (2, "elbow"))
    ]
    return Plot("efforts", "Efforts over time", panels, time=True, shared_x=True)


@pytest.fixture(scope="module")
def report(scene, tmp_path_factory):
    """Path of a page with all kinds of blocks."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "poses.csv").write_text("q1,tau1\n0,1\n")
    rows = [("shoulder", Verdict("good", "good"), 0.0361), ("elbow", Verdict("do not use", "bad"), 1.25)]
    bars = category_panel("", [Bars("friction", ["a", "b"], [1, 2], SERIES[0])], "error [%]")
    page = Page(
        title="MTML & <friends>",
        answer="1 of 2 joints is usable.",
        level="warning",
        sections=[
            Section("Verdict per joint", [Table(("joint", "verdict", "error [N m]"), rows, "Error")]),
            Section("Efforts", [Scene(lambda: scene, "Box"), effort_plot()]),
            Section("Errors", [Plot("errors", "Errors", [bars]), Text("Note", "warning")], folded=True),
        ],
        next_step="dvrk-drake validate model.yaml",
        next_purpose="Validates the model.",
    )
    write_html(page, folder / "report.html", [folder / "poses.csv"], ["identify", "my poses.csv"])
    return folder / "report.html"


@pytest.fixture
def opened(open_page, report):
    """The page and the frame of the 3D view, after the animation was loaded."""
    opened = open_page(report)
    opened.wait_for("!document.querySelector('.player').hidden")
    return opened, opened.page.frames[1]


def test_page_has_no_errors_requests_or_overlaps(open_page, report):
    check_report(open_page, report)


def box_at(opened, frame):
    """Returns the time [s] of the animation, from the position of the box."""
    return opened.translation("/drake/box", frame)[0] / SPEED


def click_at(opened, t):
    """Clicks in the plot with the cursor at time t [s]."""
    x, y = opened.page.evaluate(
        """(t) => {
          const plot = document.querySelector("[data-time]"), axis = plot._fullLayout.xaxis;
          plot.scrollIntoView({block: "center", behavior: "instant"});
          const box = plot.getBoundingClientRect();
          return [box.left + axis._offset + axis.l2p(t), box.top + plot._fullLayout._size.t + 20];
        }""",
        t,
    )
    opened.page.mouse.click(x, y)


def test_click_in_a_time_plot_moves_the_animation(opened):
    opened, frame = opened
    assert box_at(opened, frame) == pytest.approx(0.0, abs=0.02)
    for t in (3.0, 1.0):
        click_at(opened, t)
        # One pixel of the plot is about 0.01 s.
        assert box_at(opened, frame) == pytest.approx(t, abs=0.05)
        assert opened.page.locator(".time").text_content().startswith(f"{t:.1f}"[:2])


def test_dragging_the_cursor_moves_the_animation(opened):
    opened, frame = opened
    click_at(opened, 1.0)
    box = opened.page.locator(".cursor:visible").first.bounding_box()
    opened.page.mouse.move(box["x"] + 5, box["y"] + 40)
    opened.page.mouse.down()
    opened.page.mouse.move(box["x"] + 105, box["y"] + 40, steps=4)
    opened.page.mouse.up()
    length = opened.page.evaluate("document.querySelector('[data-time]')._fullLayout.xaxis._length")
    assert box_at(opened, frame) == pytest.approx(1.0 + 100 * DURATION / length, abs=0.05)


def test_playing_animation_moves_the_cursor(opened):
    opened, frame = opened
    left = "document.querySelector('.cursor').getBoundingClientRect().left"
    start = opened.page.evaluate(left)
    opened.page.locator(".play").click()
    opened.wait_for(f"{left} > {start + 20}")
    assert box_at(opened, frame) > 0.05
    opened.page.locator(".play").click()
    stopped = opened.page.locator(".time").text_content()
    opened.page.wait_for_timeout(300)
    assert opened.page.locator(".time").text_content() == stopped


def test_copy_button_copies_the_command(opened):
    opened, _ = opened
    opened.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    opened.page.locator(".copy:visible").click()
    assert opened.page.evaluate("navigator.clipboard.readText()") == "dvrk-drake validate model.yaml"


def test_printed_page_has_text_tables_and_plots(opened, tmp_path):
    opened, _ = opened
    text = printed_text(opened, tmp_path)
    if text is None:
        pytest.skip("needs pdftotext (apt-get install poppler-utils)")
    for part in ("MTML & <friends>", "do not use", "shoulder", "effort [N m]", "SHA-256", "validate"):
        assert part in text
    # The plots have their former size again.
    opened.wait_for(
        "[...document.querySelectorAll('.canvas')].every((c) => Math.abs(c._fullLayout.width - c.clientWidth) < 2)"
    )
    heights = (
        "[...document.querySelectorAll('[data-time]')].map((plot) => [plot._fullLayout.height, plot.clientHeight])"
    )
    assert all(height == shown > 400 for height, shown in opened.page.evaluate(heights))
    # The frame of the 3D view does not print, so its picture does.
    assert opened.page.evaluate(
        """() => {
          const printed = document.querySelector("canvas.printed");
          const pixels = printed.getContext("2d").getImageData(0, 0, printed.width, printed.height).data;
          return new Set(pixels).size > 10;
        }"""
    )


def test_page_states_hash_and_command(report):
    html = report.read_text()
    assert hashlib.sha256(b"q1,tau1\n0,1\n").hexdigest() in html
    assert "dvrk-drake identify &#39;my poses.csv&#39;" in html
    assert "MTML &amp; &lt;friends&gt;" in html and "<friends>" not in html


def test_dark_page_has_light_text_and_curves(open_page, report):
    opened = open_page(report, color_scheme="dark")
    opened.wait_for("document.documentElement.dataset.ready === 'yes'")
    light = """(selector) => {
      const element = document.querySelector(selector), style = getComputedStyle(element);
      const colour = element.closest("svg") ? style.fill : style.color;
      return colour.match(/\\d+/g).slice(0, 3).reduce((sum, part) => sum + Number(part), 0) / 765;
    }"""
    for selector in ("h1", "td", ".canvas .xtick text", ".canvas .legendtext"):
        assert opened.page.evaluate(light, selector) > 0.6, selector


def test_columns_of_numbers_are_aligned_right():
    table = Table(("a", "b", "c", "d"), [("joint", 1.5, "-0.2", "3..5 %"), ("1 mm", 2, "12", ""), ("yaw", 3, "", "-")])
    assert table.aligned_right == [False, True, True, True]
    assert Table(("a", "b"), [("x", "inf"), ("", "none"), ("", "-")]).aligned_right == [False, True]
    with pytest.raises(ValueError, match="a row has 1 cells, the header has 2"):
        Table(("a", "b"), [("1",)])


def test_guide_is_drawn_in_all_panels():
    """Plotly's default draws no guide in axes whose curves follow."""
    marks = [Guide("y", 0.5, None, LIMIT), Curve("x", [0, 1], [0, 1], MEASURED)]
    plot = Plot("limits", "Limits", [Panel(name, marks) for name in "abc"], columns=2)
    assert len(plotly_figure(plot).layout.shapes) == 3
