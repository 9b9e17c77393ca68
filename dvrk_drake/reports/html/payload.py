"""HTML report of an estimated payload."""

from __future__ import annotations

from collections.abc import Sequence

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from dvrk_drake.analysis.payload.payload import CONFIDENCE, Payload, PayloadIdentification
from dvrk_drake.reports.figures.colours import FITTED, HELD_OUT, REFERENCE
from dvrk_drake.reports.html.page import Page, Plot, Section, Text
from dvrk_drake.reports.html.provenance import Provenance
from dvrk_drake.reports.html.terminal import printed_by
from dvrk_drake.reports.payload import print_payload


def payload_page(result: PayloadIdentification, provenance: Provenance, model_path: str | None = None) -> Page:
    """Returns the report of an estimated payload.

    Args:
        result: Result of `dvrk_drake.payload`.
        provenance: Origin of the report.
        model_path: Path of the model. None if the model was identified from the reference recording.
    """
    printed = printed_by(print_payload, result, model_path=model_path, verbose=True)
    tables = printed.blocks if result.payload.found else [Text("No payload was found on this link."), *printed.blocks]
    warnings = [Text(str(warning).removeprefix("warning: "), "warning") for warning in result.warnings]
    estimate, links, *efforts = tables
    sections = [
        Section("Estimate", [estimate, *warnings]),
        Section("Links", [_link_plot(result.estimates, result.payload), links]),
        Section("Efforts", [_effort_plot(result.payload), *efforts]),
    ]
    return Page(
        f"Payload of {result.model.arm.name}",
        printed.answer,
        sections,
        provenance,
        printed.level,
        closing=printed.next_section,
    )


def _link_plot(estimates: Sequence[Payload], chosen: Payload) -> Plot:
    """Returns the cross-validated error and the mass with its interval for a payload on each link."""
    figure = make_subplots(rows=1, cols=2, shared_yaxes=True, horizontal_spacing=0.06)
    for name, colour, symbol, shown in (
        (chosen.link, FITTED, "diamond", [chosen]),
        ("other links", REFERENCE, "circle", [payload for payload in estimates if payload is not chosen]),
    ):
        found = [payload for payload in shown if payload.found]
        style = {"mode": "markers", "marker": {"size": 10, "color": colour, "symbol": symbol}, "name": name}
        errors, masses = [100 * payload.relative_error for payload in shown], [payload.body.mass for payload in found]
        reach = {"array": [p.quantile * p.mass_error for p in found], "thickness": 2, "width": 6}
        figure.add_scatter(x=errors, y=[payload.link for payload in shown], **style, row=1, col=1)
        links = [payload.link for payload in found]
        figure.add_scatter(x=masses, y=links, error_x=reach, **style, showlegend=False, row=1, col=2)
    figure.update_xaxes(title="cross-validated error / error without payload [%]", row=1, col=1)
    figure.update_xaxes(title=f"mass with {100 * CONFIDENCE:.0f} % interval [kg]", rangemode="tozero", row=1, col=2)
    order = [payload.link for payload in estimates]
    figure.update_yaxes(autorange="reversed", type="category", categoryorder="array", categoryarray=order)
    figure.update_layout(height=150 + 32 * len(estimates))
    return Plot(figure, "Error and mass for a payload on each link, best link first; no mass: no payload found")


def _effort_plot(payload: Payload) -> Plot:
    """Returns the RMS change of the efforts, the effort of the payload and the residual, as shares of the change."""
    names = [actuator.name for actuator in payload.actuators]
    figure = go.Figure()
    for name, colour, symbol, values in (
        ("payload", FITTED, "circle", [actuator.payload for actuator in payload.actuators]),
        ("residual", HELD_OUT, "diamond", [actuator.left for actuator in payload.actuators]),
    ):
        shares = [100 * v / a.change if a.change else None for v, a in zip(values, payload.actuators, strict=True)]
        figure.add_scatter(
            x=shares,
            y=names,
            mode="markers",
            name=name,
            marker={"size": 10, "color": colour, "symbol": symbol},
            customdata=[[v, a.change] for v, a in zip(values, payload.actuators, strict=True)],
            hovertemplate="%{x:.1f} %: %{customdata[0]:.4g} of %{customdata[1]:.4g} N m (N if prismatic)",
        )
    figure.update_xaxes(title="RMS effort / RMS change of the effort [%]", rangemode="tozero")
    figure.update_yaxes(autorange="reversed", type="category")
    figure.update_layout(height=130 + 32 * len(names))
    return Plot(figure, f"Share of the change that a payload on {payload.link} explains, for each actuator")
