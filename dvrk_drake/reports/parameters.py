"""Tables of identified parameters with 95 % intervals, beside the parameters of the SDF."""

from __future__ import annotations

import numpy as np

from dvrk_drake.analysis.estimation.motion_estimates import MIN_IDENTIFIABILITY
from dvrk_drake.dynamics.actuator_effects import is_prismatic
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor, derive_base_parameters
from dvrk_drake.dynamics.dynamic_section import DynamicSection
from dvrk_drake.dynamics.gravity_parameters import gravity_parameters
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.model_links import nearest_links
from dvrk_drake.dynamics.symbolic_gravity import SymbolicGravity
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS, DriveEffect, half_width
from dvrk_drake.reports.page import Block, Cell, Page, Section, Table, Text

#: Largest absolute value that is considered a rounding error [kg, kg m, kg m^2].
_ROUNDING = 1e-13
_HEADER = ("estimate", "95 % interval", "SDF", "unit")
_NOTE = (
    "The intervals describe the scatter of the measurements. They do not include the selection of effects, and errors "
    "of the kinematics or of the effort calibration. On simulated arms, they contain less than 95 % of the true values "
    "(docs/benchmarks.md, coverage of the intervals)."
)


def parameter_blocks(model: IdentifiedModel) -> list[Block]:
    """Returns the tables of all parameters of a model, and a text on the physical consistency of its links."""
    if model.dynamics is None:
        return [_gravity_parameters(model), *_effects(model.arm, model.effects), _consistency(model)]
    section = model.dynamic_model.section
    arm = model.arm.with_gravity(section.gravity_expected or section.gravity)
    regressor = DynamicRegressor(arm)
    static = "offsets and springs of the holding torque only, from the static poses"
    return [
        _links(section, regressor),
        _consistency(model),
        *_effects(arm, section.effects),
        *_effects(arm, model.effects, static),
        *_rotors(section, regressor),
        *_base_parameters(section, regressor),
        *_correlations(section),
    ]


def estimate_cells(value: float, standard_error: float, degrees_of_freedom: float | None) -> tuple[str, str]:
    """Returns an estimate, rounded to the digits of its 95 % interval, and this interval."""
    half = half_width(standard_error, degrees_of_freedom)
    return (_rounded(value, half) if half > 0 else _number(value)), interval(value, half)


def interval(value: float, half: float) -> str:
    """Returns an interval with half of its width as text."""
    return "none" if half == 0 else f"{_rounded(value - half, half)}..{_rounded(value + half, half)}"


def _number(value: float) -> str:
    """Returns a value as text, "0" if it is a rounding error."""
    return f"{value:.4g}" if abs(value) > _ROUNDING else "0"


def _rounded(value: float, uncertainty: float) -> str:
    """Returns a value, rounded to the second significant digit of its uncertainty."""
    digits = max(0, 1 - int(np.floor(np.log10(uncertainty))))
    value = round(value, digits) + 0.0  # without the sign of -0.0
    if digits <= 6:
        return f"{value:.{digits}f}"
    return f"{value:.{digits + int(np.floor(np.log10(abs(value))))}e}" if value else "0"


def _table(header: tuple[str, ...], rows: list[tuple[Cell, ...]], caption: str, note: str = "") -> Table:
    return Table(header, rows, caption, note, show="details", folded=len(rows) > 12)


def _gravity_parameters(model: IdentifiedModel) -> Table:
    gravity = gravity_parameters(model.arm)
    rows: list[tuple[Cell, ...]] = [
        (
            p.name,
            *estimate_cells(p.value, p.standard_error, p.degrees_of_freedom),
            _number(nominal),
            _unit(unit),
            "" if p.distinguishable else "zero?",
        )
        for p, nominal, unit in zip(model.base_parameters, gravity.base_values, gravity.base.units, strict=True)
    ]
    provenance = model.provenance
    rank = f"{provenance.rank} of {len(model.base_parameters)}" if provenance.rank else "an unknown number of"
    return _table(
        ("base parameter", *_HEADER, ""),
        rows,
        "Base parameters of gravity",
        "Base parameters are the combinations of masses and centres of mass that holding torques determine. The poses "
        f"determine {rank} base parameters (method {provenance.method}, condition number "
        f"{provenance.condition_number:.3g}). zero?: the interval contains 0. {_NOTE}",
    )


def _base_parameters(section: DynamicSection, regressor: DynamicRegressor) -> list[Block]:
    base = derive_base_parameters(regressor)
    B = base.combination
    nominal = dict(zip(base.base.names, B @ regressor.values[: B.shape[1]], strict=True))
    rows: list[tuple[Cell, ...]] = []
    for p in section.base_parameters:
        sdf = _number(nominal[p.name]) if p.name in nominal else ""
        numbers = estimate_cells(p.value, p.standard_error, section.degrees_of_freedom)
        rows.append((_breakable(p.name), *numbers, sdf, _unit(p.unit), f"{p.identifiability:.2f}"))
    count = sum(p.identifiability >= MIN_IDENTIFIABILITY for p in section.base_parameters)
    caption = f"{count} of {len(rows)} base parameters of the dynamics are identifiable from this motion"
    note = (
        "Share of the recording (identifiability): reduction of the variance relative to the prior, from 0 (value of "
        f"the SDF) to 1 (value of the recording). A parameter counts as identifiable from {MIN_IDENTIFIABILITY:g} on. "
        f"{_NOTE}"
    )
    header = ("base parameter", *_HEADER, "share of the recording")
    return [Table(header, rows, caption, note, show="details", folded=True)]


def _correlations(section: DynamicSection) -> list[Block]:
    rows: list[tuple[Cell, ...]] = [
        (
            f"{_breakable(p.first)}; {_breakable(p.second)}",
            f"{p.correlation:+.3f}",
            "difference" if p.correlation > 0 else "sum",
        )
        for p in section.correlations
    ]
    header = ("two parameters", "correlation", "identifiable: weighted")
    caption = "Parameters that are not identifiable separately"
    return [Table(header, rows, caption, show="details", folded=True)] if rows else []


def _links(section: DynamicSection, regressor: DynamicRegressor) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for link, nominal in zip(section.links, regressor.links, strict=True):
        mass, error = link.parameters[0], (link.standard_errors or [0.0])[0]
        identified = link.mass_identifiability >= MIN_IDENTIFIABILITY
        source = "bound" if link.bounds else "recording" if identified else "SDF"
        rows.append(
            (
                link.link,
                *estimate_cells(mass, error, section.degrees_of_freedom),
                f"{nominal.parameters[0]:.4g}",
                _position(np.array(link.parameters[1:4]) / mass),
                source,
            )
        )
    total, sdf = (sum(link.parameters[0] for link in links) for links in (section.links, regressor.links))
    rows.append(("all", f"{total:.4g}", "", f"{sdf:.4g}", "", ""))
    header = ("link", "mass [kg]", "95 % interval", "SDF [kg]", "centre of mass [mm]", "mass from")
    note = (
        "Centres of mass are in the frame of the link. A motion determines the base parameters; the parameters of one "
        "link also depend on the SDF. mass from bound: the estimate is at its bound, so the recording does not "
        "determine the value."
    )
    return Table(header, rows, "Mass and centre of mass of each link", note, show="details")


def _consistency(model: IdentifiedModel) -> Text:
    """Returns a text that states whether all links are physically consistent, or names those that are not."""
    links = model.dynamic_model.links if model.dynamics is not None else None
    if links is None:
        # Poses do not determine the links, only combinations of their masses and centres of mass.
        try:
            links = nearest_links(model.arm, [p.value for p in model.base_parameters])
        except ModelError as error:
            return Text(f"Not physically consistent: {error}", "bad", show="details")
    bad = [link.link for link in links if np.linalg.eigvalsh(link.pseudo_inertia())[0] <= 0]
    if bad:
        return Text(f"Not physically consistent: {', '.join(bad)}.", "bad", show="details")
    return Text("All links are physically consistent.", show="details")


def _rotors(section: DynamicSection, regressor: DynamicRegressor) -> list[Block]:
    arm = regressor.arm
    rows: list[tuple[Cell, ...]] = [
        (
            r.actuator,
            *estimate_cells(r.value, r.standard_error, section.degrees_of_freedom),
            f"{sdf.value:.3g}",
            _unit("kg" if slides else "kg m²"),
        )
        for r, sdf, slides in zip(section.rotors, regressor.rotors[: arm.num_joints], arm.prismatic, strict=True)
        if r.value > _ROUNDING or r.standard_error > 0
    ]
    header = ("actuator", *_HEADER)
    return [_table(header, rows, "Rotor inertia of each actuator, at the joint")] if rows else []


def _effects(
    arm: Arm,
    effects: list[DriveEffect],
    what: str = "friction, cable and spring effects of the drives",
) -> list[Block]:
    if not effects:
        return []
    rows: list[tuple[Cell, ...]] = []
    for e in sorted(effects, key=lambda e: (e.coordinate, e.kind, e.scale)):
        unit = EFFECT_KINDS[e.kind].unit
        if is_prismatic(arm, e.coordinate):
            unit = unit.replace("N m", "N").replace("rad", "m")
        numbers = estimate_cells(e.coefficient, e.standard_error, e.degrees_of_freedom)
        rows.append((f"{e.coordinate} {e.kind}", f"{e.scale:.3g}" if e.scale else "", *numbers, _unit(unit)))
    header = ("effect of a coordinate", "scale", "estimate", "95 % interval", "unit")
    scales: dict[str, list[str]] = {}
    for kind in sorted({e.kind for e in effects}):
        scales.setdefault(EFFECT_KINDS[kind].scale or "", []).append(kind)
    note = " ".join(f"{', '.join(kinds)}: the scale is the {text}." for text, kinds in scales.items() if text)
    return [_table(header, rows, f"{len(rows)} {what}", note)]


def _breakable(name: str) -> str:
    """Returns the name of a parameter with blanks, at which a narrow table can break it."""
    return name.replace("+", " + ").replace("  ", " ").strip()


def _unit(unit: str) -> str:
    return unit.replace("^2", "²")


def _position(p: np.ndarray) -> str:
    return ", ".join(f"{round(1e3 * float(x)) + 0}" for x in p)


def symbolic_model_page(gravity: SymbolicGravity, *, command: str = "") -> Page:
    """Returns the base parameters of gravity with their nominal values from the SDF, and the joint limits.

    Args:
        gravity: Symbolic gravity.
        command: Suggested next command. "": there is none.
    """
    arm, base = gravity.arm, gravity.base
    parameters = [
        (name, f"{value:+.5f}", unit)
        for name, value, unit in zip(base.names, gravity.base_values, base.units, strict=True)
    ]
    limits = [
        (
            f"q{i + 1} {name}",
            f"{arm.position_lower[i]:+.4f}..{arm.position_upper[i]:+.4f}",
            f"{arm.effort_limits[i]:.4g}",
        )
        for i, name in enumerate(arm.joint_names)
    ]
    for limit in arm.coupled_limits:
        terms = " + ".join(f"{c:g} {joint}" if c != 1 else joint for joint, c in limit.coefficients.items())
        limits.append((f"{limit.name}: {terms}", f"{limit.lower:+.4f}..{limit.upper:+.4f}", ""))
    header = ("base parameter", "nominal value (SDF)", "unit")
    caption = "Joint limits [rad, N m; m, N if prismatic]"
    return Page(
        f"Gravity of {arm.name}",
        f"The gravity torque of {arm.name} depends on {len(base.names)} base parameters.",
        [
            Section("Base parameters", [Table(header, parameters, f"{arm.name}: base parameters of gravity")]),
            Section("Joint limits", [Table(("", "position", "effort"), limits, caption, show="details")]),
        ],
        "good",
        command,
    )
