"""Page of an estimated payload."""

from __future__ import annotations

from collections.abc import Sequence

from dvrk_drake.analysis.payload import (
    CONFIDENCE,
    Payload,
    PayloadIdentification,
    better_links,
    contradicting_links,
    equally_good_links,
)
from dvrk_drake.models.locked_joints import locked_option
from dvrk_drake.reports.colours import FITTED
from dvrk_drake.reports.page import Block, Page, Plot, Section, Table, Text, warning_texts
from dvrk_drake.reports.plot import Bars, category_panel


def payload_page(result: PayloadIdentification, *, model_path: str | None = None, options: str = "") -> Page:
    """Returns the page of an estimated payload.

    Args:
        result: Result of `dvrk_drake.payload`.
        model_path: Path of the model, for the suggested next command. None if the model was identified from the
            reference recording.
        options: Further options of the command, beginning with a space, for the suggested next command.
    """
    payload, estimates = result.payload, result.estimates
    others = equally_good_links(estimates) if result.link is None else better_links(payload, estimates)
    names = [other.link for other in others if other is not payload]
    if not payload.found:
        answer = _none_found(payload, contradicting_links(payload, estimates))
    else:
        answer = f"Payload: {payload.body.mass:.4f} kg on {payload.link} (95 % interval {_mass_interval(payload)} kg)."
    if payload.found and names and result.link is None:
        answer += f" A payload on {' or '.join(names)} explains the recordings equally well. Give the link with --link."
    elif payload.found and names:
        answer += f" A payload on {names[0]} explains the change of the efforts better."
    clear = payload.found and not names
    arm = result.model.arm
    source = f"--arm {arm.source}{locked_option(arm)}" if model_path is None else f"--model {model_path}"
    files = "REFERENCE LOADED" if result.has_reference else "LOADED"
    estimate: list[Block] = [_estimate_table(payload)] if payload.found else []
    if not result.has_reference:
        estimate.append(
            Text(
                "The intervals contain the errors of the model. A recording of the same motion without the payload "
                "makes them narrower."
            )
        )
    estimate += warning_texts(result.warnings)
    return Page(
        f"Payload of {arm.name}",
        answer,
        [
            Section("Estimate", estimate),
            Section("Links", [_link_table(estimates)]),
            *([Section("Efforts", [_effort_plot(payload), _effort_table(payload)])] if payload.found else []),
        ],
        "good" if clear else "warning",
        f"dvrk-drake payload {files} {source}{options} " + ("--json FILE" if clear else "--link LINK"),
    )


def _interval(value: float, error: float, payload: Payload) -> str:
    """Returns the confidence interval of a value with its standard error."""
    reach = payload.quantile * error
    return f"{value - reach:.4f}..{value + reach:.4f}"


def _mass_interval(payload: Payload) -> str:
    return _interval(payload.body.mass, payload.mass_error, payload)


def _estimate_table(payload: Payload) -> Table:
    rows = [("mass [kg]", f"{payload.body.mass:.4f}", _mass_interval(payload), "")]
    position = zip(payload.body.position, payload.position_error, payload.position_in_base, strict=True)
    for axis, determined, (x, error, base) in zip("xyz", payload.body.determined, position, strict=True):
        numbers = (f"{x:.4f}", _interval(x, error, payload), f"{base:.4f}")
        rows.append((f"{axis} [m]", *(numbers if determined else ("not determined", "", ""))))
    header = ("", "estimate", f"{100 * CONFIDENCE:.0f} % interval", "base frame, q = 0")
    return Table(header, rows, f"Payload on {payload.link}, position in the frame of the link")


def _link_table(estimates: Sequence[Payload]) -> Table:
    """Returns the estimate for each link, best first."""
    good, rows = equally_good_links(estimates), []
    for payload in estimates:
        note, mass, interval = "none found", "-", "-"
        if payload.found:
            note = "" if payload not in good else "best" if payload is estimates[0] else "equally good"
            mass, interval = f"{payload.body.mass:.4f}", _mass_interval(payload)
        rows.append((payload.link, f"{100 * payload.relative_error:.1f} %", mass, interval, note))
    return Table(
        ("", "error*", "mass [kg]", f"{100 * CONFIDENCE:.0f} % interval [kg]", ""),
        rows,
        "Estimates by link, best first",
        "* whitened RMS error with payload / whitened RMS error without payload, cross-validated over the phase of the "
        "motion. Geometric mean over the actuators.",
        show="details",
    )


def _effort_table(payload: Payload) -> Table:
    rows = [
        (
            a.name,
            *(f"{x:.4f}" for x in (a.change, a.payload, a.left)),
            "-" if a.explained is None else f"{100 * a.explained:.1f} %",
        )
        for a in payload.actuators
    ]
    return Table(
        ("", "measured", "payload", "residual*", "explained"),
        rows,
        "RMS change of the efforts [N m; N]",
        "* after subtraction of the efforts of the payload and of the changes of offsets and friction. "
        "- the payload does not load the joint.",
        show="details",
    )


def _none_found(payload: Payload, elsewhere: Sequence[Payload]) -> str:
    """Returns a message with the upper limit of the mass, or with another link on which a payload is possible."""
    answer = f"No payload found on {payload.link}: the confidence interval of the payload mass includes 0. "
    if elsewhere:
        first = elsewhere[0]
        share = f"{100 * first.relative_error:.1f} %"
        return answer + f"A payload on {first.link} explains the change of the efforts (cross-validated error {share})."
    if payload.largest_at_com > payload.max_mass:
        return answer + "With this motion, a payload at the centre of mass of the link cannot be detected."
    largest = f"{1e3 * payload.largest_at_com:.3g} g ({100 * CONFIDENCE:.0f} %)"
    return answer + f"The mass of a payload at the centre of mass of the link is below {largest}."


def _effort_plot(payload: Payload) -> Plot:
    """Returns the share of the change of the efforts that the payload explains."""
    loaded = {a.name: a.explained for a in payload.actuators if a.explained is not None}
    bars = Bars("", list(loaded), [100 * max(share, 0.0) for share in loaded.values()], FITTED)
    panel = category_panel("", [bars], "explained share of the squared change [%]")
    return Plot("efforts", f"Change of the efforts that a payload on {payload.link} explains", [panel])
