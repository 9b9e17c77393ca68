"""Writes docs/images/demo.gif: the animation of `dvrk-drake demo` as a looping GIF. Requires Playwright and Chromium.

dvrk-drake demo --folder demo_output
python tools/make_demo_gif.py demo_output/arm.html docs/images/demo.gif
"""

import io
import shutil
from argparse import ArgumentParser
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import sync_playwright

from dvrk_drake.experiments.demo import RELEASE_TIME

FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu")
#: Hides the control panel of Meshcat, and the captions, which are too small for a GIF. `label` writes larger ones.
HIDE_PANEL = ".dg, #captions, #status-message, #stats-plot { display: none !important; }"
#: Texts on the pictures, with their colours: the arm, and the ghost while it is visible.
ARM, GHOST = ("blue: identified model, mode guide", "#1f4e9c"), ("green: model of the SDF, mode gravity", "#1b6b40")
#: Size of the texts, and height of the bar above the view that shows them [px].
TEXT_SIZE, BAR = 20, 58
#: Moves the paused animation to a time [s] and draws it.
SHOW = """(time) => {
  viewer.animator.pause();
  viewer.animator.seek(time);
  viewer.render();
  return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
}"""


def frames(page_file: Path, times: np.ndarray, size: tuple[int, int], chromium: str) -> list[Image.Image]:
    """Returns pictures of the animation of a Meshcat page at the given times [s]."""
    pictures = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))
        page = browser.new_page(viewport={"width": size[0], "height": size[1] - BAR})
        page.set_default_timeout(300_000)
        page.goto(page_file.resolve().as_uri())
        page.add_style_tag(content=HIDE_PANEL)
        page.wait_for_function("viewer.animator.duration > 0")
        page.wait_for_timeout(3000)  # meshes are loaded in the background
        for time in times:
            page.evaluate(SHOW, float(time))
            pictures.append(label(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), time))
        browser.close()
    return pictures


def label(view: Image.Image, time: float) -> Image.Image:
    """Returns a picture with the captions of the animation at `time` [s] above the view."""
    picture = Image.new("RGB", (view.width, view.height + BAR), "#f4f6f8")
    picture.paste(view, (0, BAR))
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(TEXT_SIZE)
    phase = "released" if time >= RELEASE_TIME else "held"
    outcomes = (": stays", ": falls") if phase == "released" else ("", "")
    lines = [(text + outcome, colour) for (text, colour), outcome in zip((ARM, GHOST), outcomes, strict=True)]
    for i, (text, colour) in enumerate(lines):
        draw.text((12, 6 + 1.3 * TEXT_SIZE * i), text, fill=colour, font=font)
    draw.text((picture.width - 12, 6), phase.upper(), fill="#1f1f1f", font=font, anchor="ra")
    return picture


def write_gif(pictures: list[Image.Image], file: Path, period: float, colours: int) -> None:
    """Writes an endless GIF with one palette; `period` is the time between two pictures [s]."""
    samples = pictures[:: len(pictures) // 6]
    strip = Image.new("RGB", (samples[0].width, samples[0].height * len(samples)))
    for i, sample in enumerate(samples):
        strip.paste(sample, (0, i * sample.height))
    # k-means keeps the green of the ghost, which covers a small area, apart from the colours of the ground.
    palette = strip.quantize(colours, method=Image.Quantize.MEDIANCUT, kmeans=3)
    first, *rest = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(file, save_all=True, append_images=rest, duration=round(1000 * period), loop=0, optimize=True)


def main() -> None:
    """Reads the options and writes the GIF."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path, help="arm.html of the demo")
    parser.add_argument("file", type=Path, help="GIF to write")
    parser.add_argument("--period", type=float, default=0.1, help="time between two pictures [s]")
    parser.add_argument("--end", type=float, default=5.0, help="time of the last picture [s]")
    parser.add_argument("--size", nargs=2, type=int, default=[560, 460], metavar="pixels", help="width and height")
    parser.add_argument("--colours", type=int, default=255, help="number of colours")
    parser.add_argument("--chromium", default=shutil.which("chromium") or "chromium", help="program of the browser")
    options = parser.parse_args()
    times = np.arange(0.0, options.end, options.period)
    pictures = frames(options.page, times, tuple(options.size), options.chromium)
    write_gif(pictures, options.file, options.period, options.colours)
    print(f"wrote {options.file}: {options.file.stat().st_size / 1e3:.0f} kB, {len(pictures)} pictures")


if __name__ == "__main__":
    main()
