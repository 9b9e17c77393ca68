"""Prints an estimated payload to a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dvrk_drake.analysis.payload.payload import (
    CONFIDENCE,
    Payload,
    PayloadIdentification,
    better_links,
    contradicting_links,
    equally_good_links,
)
from dvrk_drake.models.locked_joints import locked_option
from dvrk_drake.reports.terminal_tables import make_table, print_answer, print_note


def print_payload(
    console: Console, result: PayloadIdentification, *, model_path: str | None = None, verbose: bool = False
) -> None:
    """Prints the mass and the link of the payload, then a table of mass and position with confidence intervals.

    Args:
        console: Console to print to.
        result: Result to print.
        model_path: Path of the model, for the suggested next command. None if the model was identified from the
            reference recording.
        verbose: Whether to print the estimate for each link, and the efforts that the payload explains.
    """
    payload, estimates = result.payload, result.estimates
    others = equally_good_links(estimates) if result.link is None else better_links(payload, estimates)
    names = [other.link for other in others if other is not payload]
    if not payload.found:
        answer = _none_found(payload, contradicting_links(payload, estimates))
    else:
        answer = f"Payload: {payload.body.mass:.4f} +- {payload.mass_error:.4f} kg on {payload.link}."
    if payload.found and names and result.link is None:
        answer += f" A payload on {' or '.join(names)} explains the recordings equally well. Give the link with --link."
    elif payload.found and names:
        answer += f" A payload on {names[0]} explains the change of the efforts better."
    clear = payload.found and not names
    command = (
        f"--arm {result.model.arm.source}{locked_option(result.model.arm)}"
        if model_path is None
        else f"--model {model_path}"
    )
    files = "REFERENCE LOADED" if result.has_reference else "LOADED"
    command = f"dvrk-drake payload {files} {command} " + ("--json FILE" if clear else "--link LINK")
    print_answer(console, answer, command, "green" if clear else "yellow")
    if payload.found:
        console.print(_estimate_table(payload))
    if not result.has_reference:
        print_note(
            console,
            "The intervals contain the errors of the model. A recording of the same motion without the payload makes "
            "them narrower.",
        )
    if verbose:
        console.print()
        _print_links(console, estimates)
        if payload.found:
            _print_efforts(console, payload)


def _estimate_table(payload: Payload) -> Table:
    columns = ("", "estimate", "standard error", f"{100 * CONFIDENCE:.0f} % interval", "base frame, q = 0")
    table = make_table(f"Payload on {payload.link}, position in the frame of the link", *columns)
    rows = [("mass [kg]", payload.body.mass, payload.mass_error, "")]
    for axis, x, error, base in zip(
        "xyz", payload.body.position, payload.position_error, payload.position_in_base, strict=True
    ):
        rows.append((f"{axis} [m]", x, error, f"{base:+.4f}"))
    for k, (name, value, error, base) in enumerate(rows):
        if k and not payload.body.determined[k - 1]:
            table.add_row(escape(name), "not determined", "", "", "")
            continue
        reach = payload.quantile * error
        table.add_row(
            escape(name), f"{value:+.4f}", f"{error:.4f}", f"{value - reach:+.4f}..{value + reach:+.4f}", base
        )
    return table


def _print_links(console: Console, estimates: Sequence[Payload]) -> None:
    """Prints the estimate for each link, best first."""
    table = make_table("Estimates by link, best first", "", "error*", "mass [kg]", "+- [kg]", "")
    table.columns[-1].justify = "left"
    good = equally_good_links(estimates)
    for payload in estimates:
        note = "" if payload not in good else "best" if payload is estimates[0] else "equally good"
        mass, error = "none found", ""
        if payload.found:
            mass, error = f"{payload.body.mass:.4f}", f"{payload.mass_error:.4f}"
        error_share = f"{100 * payload.relative_error:.1f} %"
        table.add_row(payload.link, error_share, mass, error, note if payload.found else "")
    console.print(table)
    print_note(
        console,
        "* whitened RMS error with payload / whitened RMS error without payload, cross-validated over the phase of the "
        "motion. Geometric mean over the actuators.",
    )


def _print_efforts(console: Console, payload: Payload) -> None:
    table = make_table("RMS change of the efforts [N m; N]", "", "measured", "payload", "residual*", "explained")
    for actuator in payload.actuators:
        explained = "not loaded" if actuator.explained is None else f"{100 * actuator.explained:.1f} %"
        numbers = (f"{x:.4f}" for x in (actuator.change, actuator.payload, actuator.left))
        table.add_row(actuator.name, *numbers, explained)
    console.print(table)
    print_note(console, "* after subtraction of the efforts of the payload and of the changes of offsets and friction")


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
