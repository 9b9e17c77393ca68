"""Physical consistency of the links: eigenvalues of the pseudo-inertia, mass, and centre of mass in a bounding box."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia
from dvrk_drake.dynamics.model_links import nearest_links
from dvrk_drake.dynamics.physical_consistency import (
    MASS_RANGE,
    BoundingBox,
    bounding_boxes,
    box_margins,
    reached_bounds,
)
from dvrk_drake.errors import ArmError, ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.sdf_model import compose_sdf
from dvrk_drake.reports.colours import SERIES
from dvrk_drake.reports.html.labels import NO_BREAK
from dvrk_drake.reports.html.page import Block, Cell, Plot, Table, Text, Verdict
from dvrk_drake.reports.html.plot_style import COLOURS

_AXES = {"x": ("circle", SERIES[0]), "y": ("square", SERIES[1]), "z": ("diamond", SERIES[2])}


def consistency_blocks(model: IdentifiedModel) -> list[Block]:
    """Returns the table of the links and the plot of their centres of mass."""
    blocks: list[Block] = []
    regressor = DynamicRegressor(model.arm)
    if model.dynamics is not None:
        links = model.dynamic_model.links
    else:
        # Poses do not determine the links, only combinations of their masses and centres of mass.
        try:
            links = nearest_links(model.arm, [p.value for p in model.base_parameters])
        except ModelError as error:
            return [Text(f"Not physically consistent: {error}", "bad")]
        blocks.append(
            Text(
                "Static poses determine only the base parameters of gravity. The table shows the physically consistent "
                "links that have these base parameters and are nearest to the SDF."
            )
        )
    try:
        boxes = bounding_boxes(model.arm)
    except ArmError as error:
        return [*blocks, Text(f"No bounding boxes: {error}", "warning"), link_table(links, regressor.links, {})]
    blocks.append(link_table(links, regressor.links, boxes))
    if names := [name for name in _links_without_shape(model.arm) if name in boxes]:
        blocks.append(
            Text(
                f"No shape in the SDF: {', '.join(names)}. The mechanism file states the bounding box of such a link. "
                "For a rotor with a gear, the box is larger than the rotor, because the mass is small compared with "
                "the reflected inertia."
            )
        )
    caption = (
        "Centre of mass of each link in its bounding box. 0 is the centre of the box, -1 and 1 are its sides. Open "
        "symbols: SDF."
    )
    return [*blocks, Plot(centres_of_mass(links, regressor.links, boxes), caption)]


def _links_without_shape(arm: Arm) -> list[str]:
    links = (link for url in arm.sdf for link in compose_sdf([url]).iterfind("model/link"))
    return [link.get("name", "") for link in links if link.find("visual") is None and link.find("collision") is None]


def link_table(links: Sequence[LinkInertia], nominal: Sequence[LinkInertia], boxes: dict[str, BoundingBox]) -> Table:
    """Returns a table with mass, eigenvalues, centre of mass and bounding box of each link.

    Args:
        links: Links of the model.
        nominal: The same links with the parameters of the SDF.
        boxes: Link -> bounding box. Empty if unknown.
    """
    rows: list[tuple[Cell, ...]] = []
    for link, sdf in zip(links, nominal, strict=True):
        eigenvalues = np.linalg.eigvalsh(link.pseudo_inertia())
        com = link.parameters[1:4] / link.parameters[0]
        box = boxes.get(link.link)
        rows.append(
            (
                link.link,
                f"{link.parameters[0]:.4g}",
                f"{sdf.parameters[0]:.4g}",
                ", ".join(f"{value:.2g}" for value in eigenvalues),
                ", ".join(f"{round(1e3 * x)}" for x in com),
                "" if box is None else _box(box),
                _result(link, sdf, box, float(eigenvalues[0])),
            )
        )
    return Table(
        (
            "link",
            "mass [kg]",
            "SDF [kg]",
            "eigenvalues of the pseudo-inertia",
            "centre of mass [mm]",
            "bounding box [mm]",
            "result",
        ),
        rows,
        caption="Mass, pseudo-inertia and centre of mass of each link, in the frame of the link",
        note="A link is physically consistent if all four eigenvalues of its pseudo-inertia [kg m², kg] are positive. "
        f"At its bound: the mass reaches {MASS_RANGE[0]:g} or {MASS_RANGE[1]:g} times the mass in the SDF, or its "
        "distribution fills the bounding box. The recording does not determine such a value.",
    )


def _result(link: LinkInertia, sdf: LinkInertia, box: BoundingBox | None, least: float) -> Verdict:
    if least <= 0:
        return Verdict("inconsistent", "bad", "an eigenvalue is not positive")
    if box is not None:
        if np.any(box_margins(link.parameters, box) < -1e-6):
            return Verdict("consistent", "warning", "outside the bounding box")
        if bounds := reached_bounds(link.parameters, sdf, box):
            return Verdict("at its bound", "warning", "; ".join(bounds))
    return Verdict("consistent", "good")


def centres_of_mass(
    links: Sequence[LinkInertia], nominal: Sequence[LinkInertia], boxes: dict[str, BoundingBox]
) -> go.Figure:
    """Returns a figure of the centres of mass in the bounding boxes. The arguments are those of `link_table`."""
    figure = go.Figure()
    for k, (axis, (symbol, colour)) in enumerate(_AXES.items()):
        for which, source, suffix in ((links, "model", ""), (nominal, "SDF", "-open")):
            places = [
                (link.parameters[1 + k] / link.parameters[0] - boxes[link.link].center[k])
                / boxes[link.link].half_width[k]
                for link in which
            ]
            figure.add_scatter(
                x=places,
                y=[link.link for link in which],
                mode="markers",
                name=f"{axis}, {source}",
                marker={"symbol": symbol + suffix, "size": 10, "color": colour, "line": {"width": 1.5}},
            )
    for side in (-1, 1):
        figure.add_vline(x=side, line={"color": COLOURS["limit"], "width": 2})
    figure.update_xaxes(title_text="position in the bounding box [1]", range=[-1.15, 1.15])
    figure.update_yaxes(autorange="reversed")
    figure.update_layout(height=130 + 32 * len(links))
    return figure


def _box(box: BoundingBox) -> str:
    ends = zip("xyz", 1e3 * box.lower, 1e3 * box.upper, strict=True)
    return ", ".join(f"{axis}{NO_BREAK}{low:.0f}..{high:.0f}" for axis, low, high in ends)
