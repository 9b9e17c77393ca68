"""Rules for all figures, checked on the Matplotlib objects at the moment when a figure is saved."""

from contextlib import contextmanager

from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text

from dvrk_drake.reports.image_files import DPI, SMALLEST_TEXT, WIDTH


def figure_faults(figure):
    """Returns the violated rules of a figure that was drawn or saved, one text each."""
    faults = []
    if figure.get_figwidth() > WIDTH + 1e-9:
        faults.append(f"width {figure.get_figwidth()} inch")
    if not figure.get_suptitle():
        faults.append("no title")
    renderer = figure.canvas.get_renderer()
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and text.get_fontsize() < SMALLEST_TEXT:
            faults.append(f'"{text.get_text()}" has {text.get_fontsize()} pt')
    width, height = figure.canvas.get_width_height()
    for ax in figure.axes:
        name = ax.get_title() or ax.get_title("left")
        if not ax.has_data():
            faults.append(f'panel "{name}" is empty')
        if ax.get_legend() is not None:
            faults.append(f'panel "{name}" has a legend over the data')
        for axis in (ax.xaxis, ax.yaxis):
            label = axis.get_label_text()
            if label and not (label.endswith("]") or "[" in label or label == "pose"):
                faults.append(f'axis label "{label}" has no unit')
    boxes = [ax.get_window_extent(renderer) for ax in figure.axes]
    for legend in figure.legends:
        box = legend.get_window_extent(renderer)
        if any(box.overlaps(other) for other in boxes):
            faults.append("a legend is over the data")
    for artist in [*figure.legends, *figure.texts]:
        box = artist.get_window_extent(renderer)
        if box.x0 < -1 or box.y0 < -1 or box.x1 > width + 1 or box.y1 > height + 1:
            faults.append(f"{artist} is outside the figure")
    return faults


@contextmanager
def checked_figures(monkeypatch):
    """Context manager that checks each figure that is saved in the block, and fails at the end.

    Yields:
        List of the saved figures. Their artists can be inspected after they are closed.
    """
    figures, faults = [], []
    save = Figure.savefig

    def checked(figure, *arguments, dpi, **options):
        save(figure, *arguments, dpi=dpi, **options)
        assert dpi == DPI
        faults.extend(figure_faults(figure))
        figures.append(figure)

    with monkeypatch.context() as patch:
        patch.setattr(Figure, "savefig", checked)
        yield figures
    assert not faults, "\n".join(faults)


def colours_of(figure):
    """Returns the mapping from the labels in the legends of a figure to the colours of lines and markers."""
    return {
        text.get_text(): to_hex(handle.get_color())
        for legend in figure.legends
        for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True)
        if hasattr(handle, "get_color")
    }
