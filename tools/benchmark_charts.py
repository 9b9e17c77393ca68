"""Draws the charts of docs/benchmarks.md from the tables of this page: python tools/benchmark_charts.py

A comment before a table names the image in docs/images and the quantity:

    <!-- chart: benchmark_speed.svg, computing time / time of the peer -->

The last column of a table is that of this package, unless the table states statistics of one quantity.
"""

import re
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt

DOCS = Path(__file__).resolve().parents[1] / "docs"
CHART = re.compile(r"<!-- chart: (?P<image>\S+), (?P<quantity>.+?) -->\n\n(?P<table>(?:\|.*\n)+)")
OURS, OTHERS = "#1f5fa8", "#9aa3ad"
BAR = 0.32  # height of a bar [inches]; labels of 9 pt fit


def table_columns(table: str) -> tuple[list[str], dict[str, list[str]]]:
    """Returns the row names of a Markdown table, and its numbers by column, as they are printed."""
    header, _, *rows = [[cell.strip() for cell in line.strip("| \n").split("|")] for line in table.splitlines()]
    columns = {name: [row[number] for row in rows] for number, name in enumerate(header[1:], start=1)}
    return [row[0] for row in rows], columns


def draw(image: str, quantity: str, table: str) -> None:
    """Writes a chart of horizontal bars, one group per row of the table."""
    names, columns = table_columns(table)
    per_group = len(columns)
    height = BAR * (len(names) * (per_group + 0.6)) + 0.9
    figure, axes = plt.subplots(figsize=(7.5, height), layout="constrained")
    for number, (column, values) in enumerate(columns.items()):
        last = number == per_group - 1
        positions = [row * (per_group + 0.6) + number for row in range(len(names))]
        color = OURS if last else OTHERS
        bars = axes.barh(positions, [float(value) for value in values], height=0.9, color=color, label=column)
        axes.bar_label(bars, labels=values, padding=3, fontsize=9)
    axes.set_yticks([row * (per_group + 0.6) + (per_group - 1) / 2 for row in range(len(names))], names)
    axes.invert_yaxis()
    axes.set_xlabel(quantity)
    axes.margins(x=0.08)
    axes.spines[["top", "right"]].set_visible(False)
    if per_group > 1:
        figure.legend(loc="outside upper left", ncols=per_group, frameon=False)
    figure.savefig(DOCS / "images" / image, metadata={"Date": None})
    plt.close(figure)


def main() -> None:
    """Draws all charts of the page."""
    # Text stays text, and names within the file do not change from run to run.
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "benchmarks", "font.size": 10})
    for found in CHART.finditer((DOCS / "benchmarks.md").read_text()):
        draw(**found.groupdict())
        print(f"wrote docs/images/{found['image']}")


if __name__ == "__main__":
    main()
