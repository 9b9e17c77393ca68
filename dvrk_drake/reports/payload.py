"""An estimated payload as tables in a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape

from dvrk_drake.analysis.payload.payload import CONFIDENCE, Payload, as_good, shown_elsewhere
from dvrk_drake.analysis.payload.point_mass import LARGEST_MASS
from dvrk_drake.reports.terminal_tables import make_table


def print_links(console: Console, estimates: Sequence[Payload]) -> None:
    """What each link would have to carry, the best first."""
    table = make_table("Where the payload may be, best first", "link", "left-out error*", "mass [kg]", "+- [kg]", "")
    good = as_good(estimates)
    for payload in estimates:
        note = "" if payload not in good else "best" if payload is estimates[0] else "cannot be told from it"
        mass, error = "none found", ""
        if payload.found:
            mass, error = f"{payload.body.mass:.4f}", f"{payload.mass_error:.4f}"
        table.add_row(payload.link, f"{100 * payload.left_out:.1f} %", mass, error, note if payload.found else "")
    console.print(table)
    console.print(
        "* phases of the motion predicted from the others: RMS error, whitened, as a share of that without payload, "
        "geometric mean over the actuators\n",
        style="dim",
    )
    if estimates[0].found and len(good) > 1:
        console.print(
            "These recordings cannot tell which of the best links it is: name the one that carries it with --link.\n",
            style="yellow",
            soft_wrap=True,
        )


def print_payload(console: Console, payload: Payload, estimates: Sequence[Payload] = ()) -> None:
    """Prints mass and place with their intervals and what is explained, or that no payload was found.

    Args:
        console: to print to.
        payload: to print.
        estimates: of all links; an upper bound of the mass is printed only where none of them shows a payload.
    """
    if not payload.found:
        console.print(_none_found(payload, shown_elsewhere(payload, estimates)), soft_wrap=True)
        return
    table = make_table(
        f"Payload on {payload.link}",
        "",
        "estimate",
        "standard error",
        f"{CONFIDENCE:.0%} interval",
        "base frame, q = 0",
    )
    rows = [("mass [kg]", payload.body.mass, payload.mass_error, "")]
    for axis, x, error, base in zip("xyz", payload.body.place, payload.place_error, payload.place_in_base, strict=True):
        rows.append((f"{axis} [m]", x, error, f"{base:+.4f}"))
    for k, (name, value, error, base) in enumerate(rows):
        if k and not payload.body.determined[k - 1]:
            table.add_row(escape(name), "fixed: not determined by this motion", "", "", "")
            continue
        reach = payload.quantile * error
        table.add_row(
            escape(name), f"{value:+.4f}", f"{error:.4f}", f"{value - reach:+.4f} .. {value + reach:+.4f}", base
        )
    console.print(table)
    table = make_table("RMS efforts [N m; N if prismatic]", "", "change", "payload", "left*", "explained")
    for actuator in payload.actuators:
        explained = "not loaded" if actuator.explained is None else f"{100 * actuator.explained:.1f} %"
        numbers = (f"{x:.4f}" for x in (actuator.change, actuator.payload, actuator.left))
        table.add_row(actuator.name, *numbers, explained)
    console.print(table)
    console.print("* by the payload and by what changed in the drives: offsets, friction\n", style="dim")


def _none_found(payload: Payload, elsewhere: Sequence[Payload]) -> str:
    """Returns one line with the largest mass that would not show, unless another link shows a payload."""
    said = f"No payload found on {payload.link}: the interval of its mass includes 0. "
    if elsewhere:
        first = elsewhere[0]
        return said + f"A payload on {first.link} explains the change (left-out error {first.left_out:.1%})."
    if payload.largest_at_com > LARGEST_MASS:
        return said + "A mass at the link's centre of mass would not show in this motion."
    return said + f"At the link's centre of mass it is below {1e3 * payload.largest_at_com:.3g} g ({CONFIDENCE:.0%})."
