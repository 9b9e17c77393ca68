"""Tables of identified parameters with 95 % intervals, beside the parameters of the SDF."""

from __future__ import annotations

import numpy as np

from dvrk_drake.analysis.dynamic.estimates import MIN_IDENTIFIABILITY
from dvrk_drake.dynamics.actuator_effects import is_prismatic
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor, derive_base_parameters
from dvrk_drake.dynamics.dynamic_section import DynamicSection
from dvrk_drake.dynamics.gravity_parameters import gravity_parameters
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import PARAMETER_NAMES
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effect_kinds import EFFECT_KINDS
from dvrk_drake.models.effects_schema import DriveEffect, half_width
from dvrk_drake.reports.html.labels import NO_BREAK
from dvrk_drake.reports.html.page import Block, Cell, Table

_UNITS = dict(zip(PARAMETER_NAMES, ("kg", *3 * ["kg m"], *6 * ["kg m²"]), strict=True))
#: Largest absolute value that is considered a rounding error [kg, kg m, kg m^2].
_ROUNDING = 1e-13
_HEADER = ("estimate", "95 % interval", "SDF")
_NOTE = (
    "The intervals describe the scatter of the measurements. They do not include the selection of effects, and errors "
    "of the kinematics or of the effort calibration. On simulated arms, they contain less than 95 % of the true values "
    "(docs/benchmark_tables.md, coverage of the intervals)."
)


def parameter_tables(model: IdentifiedModel) -> list[Block]:
    """Returns the tables of all parameters of a model."""
    if model.dynamics is None:
        return [_gravity_parameters(model), *_effects(model.arm, model.effects)]
    section = model.dynamic_model.section
    arm = model.arm.with_gravity(section.gravity_expected or section.gravity)
    regressor = DynamicRegressor(arm)
    return [
        *_base_parameters(section, regressor),
        *_correlations(section),
        _links(section, regressor),
        _rotors(section, regressor),
        *_effects(arm, section.effects),
        *_effects(arm, model.effects, "offsets and springs of the holding torque only, from the static poses"),
        _all_link_parameters(section, regressor),
    ]


def _estimate(value: float, standard_error: float, degrees_of_freedom: float | None) -> tuple[str, str]:
    """Returns an estimate, rounded to the digits of its 95 % interval, and this interval."""
    half = half_width(standard_error, degrees_of_freedom)
    return (_rounded(value, half) if half > 0 else _number(value)), interval(value, half)


def _number(value: float) -> str:
    """Returns a value as text, "0" if it is a rounding error."""
    return f"{value:.4g}" if abs(value) > _ROUNDING else "0"


def interval(value: float, half: float) -> str:
    """Returns an interval with half of its width as text."""
    if half == 0:
        return "none"
    return f"{_rounded(value - half, half)}{NO_BREAK}.. {_rounded(value + half, half)}"


def _rounded(value: float, uncertainty: float) -> str:
    """Returns a value, rounded to the second significant digit of its uncertainty."""
    digits = max(0, 1 - int(np.floor(np.log10(uncertainty))))
    value = round(value, digits) + 0.0  # without the sign of -0.0
    if digits <= 6:
        return f"{value:.{digits}f}"
    return f"{value:.{digits + int(np.floor(np.log10(abs(value))))}e}" if value else "0"


def _gravity_parameters(model: IdentifiedModel) -> Table:
    gravity = gravity_parameters(model.arm)
    rows = [
        (
            p.name,
            *_estimate(p.value, p.standard_error, p.degrees_of_freedom),
            _number(nominal),
            _unit(unit),
            "yes" if p.distinguishable else "no",
        )
        for p, nominal, unit in zip(model.base_parameters, gravity.base_values, gravity.base.units, strict=True)
    ]
    provenance = model.provenance
    rank = f"{provenance.rank} of {len(model.base_parameters)}" if provenance.rank else "unknown"
    return Table(
        ("base parameter", *_HEADER, "unit", "interval excludes 0"),
        rows,
        caption="Base parameters of gravity. They are the combinations of masses and centres of mass that holding "
        "torques determine.",
        note=f"Poses determine {rank} base parameters (condition number {provenance.condition_number:.3g}). {_NOTE}",
    )


def _base_parameters(section: DynamicSection, regressor: DynamicRegressor) -> list[Block]:
    base = derive_base_parameters(regressor, coupled_rotors=False)
    B = base.combination
    nominal = dict(zip(base.base.names, B @ regressor.values[: B.shape[1]], strict=True))
    identifiable: list[tuple[Cell, ...]] = []
    others: list[tuple[Cell, ...]] = []
    for p in section.base_parameters:
        sdf = _number(nominal[p.name]) if p.name in nominal else ""
        row = (
            p.name,
            *_estimate(p.value, p.standard_error, section.degrees_of_freedom),
            sdf,
            _unit(p.unit),
            f"{p.identifiability:.2f}",
        )
        (identifiable if p.identifiability >= MIN_IDENTIFIABILITY else others).append(row)
    header = ("base parameter", *_HEADER, "unit", "identifiability")
    count = f"{len(identifiable)} of {len(section.base_parameters)} base parameters of the dynamics"
    note = (
        "Identifiability: reduction of the variance relative to the prior, from 0 (value of the SDF) to 1 (value of "
        f"the recording). A parameter counts as identifiable from {MIN_IDENTIFIABILITY:g} on. {_NOTE}"
    )
    blocks: list[Block] = [Table(header, identifiable, caption=f"{count} are identifiable from this motion", note=note)]
    if others:
        caption = f"{len(others)} base parameters that are not identifiable. Their values depend mainly on the SDF."
        blocks.append(Table(header, others, caption=caption, collapsed=True))
    return blocks


def _correlations(section: DynamicSection) -> list[Block]:
    if not section.correlations:
        return []
    rows = [
        (
            pair.first,
            pair.second,
            f"{pair.correlation:+.3f}",
            f"weighted {'difference' if pair.correlation > 0 else 'sum'}",
        )
        for pair in section.correlations
    ]
    header = ("first", "second", "correlation", "identifiable combination")
    return [Table(header, rows, caption="Parameters that are not identifiable separately", collapsed=len(rows) > 6)]


def _links(section: DynamicSection, regressor: DynamicRegressor) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for link, nominal in zip(section.links, regressor.links, strict=True):
        mass, error = link.parameters[0], (link.standard_errors or [0.0])[0]
        source = "; ".join(link.bounds) or ("recording" if link.mass_identifiability >= MIN_IDENTIFIABILITY else "SDF")
        com = np.array(link.parameters[1:4]) / mass
        of_sdf = nominal.parameters[1:4] / nominal.parameters[0]
        rows.append(
            (
                link.link,
                *_estimate(mass, error, section.degrees_of_freedom),
                f"{nominal.parameters[0]:.4g}",
                _position(com),
                _position(of_sdf),
                source,
            )
        )
    header = ("link", "mass [kg]", "95 % interval", "SDF", "centre of mass [m]", "SDF [m]", "mass determined by")
    return Table(
        header,
        rows,
        caption="Mass and centre of mass of each link, in the frame of the link",
        note="A motion determines the base parameters. The parameters of one link also depend on the SDF.",
    )


def _rotors(section: DynamicSection, regressor: DynamicRegressor) -> Table:
    arm = regressor.arm
    rows = [
        (
            r.actuator,
            *_estimate(r.value, r.standard_error, section.degrees_of_freedom),
            f"{sdf.value:.3g}",
            _unit("kg" if slides else "kg m²"),
        )
        for r, sdf, slides in zip(section.rotors, regressor.rotors[: arm.num_joints], arm.prismatic, strict=True)
    ]
    return Table(("actuator", *_HEADER, "unit"), rows, caption="Rotor inertia of each actuator, at the joint")


def _effects(
    arm: Arm,
    effects: list[DriveEffect],
    what: str = "friction, cable and spring effects of the drives, drawn in Friction and cable curves",
) -> list[Block]:
    if not effects:
        return []
    rows = []
    for e in sorted(effects, key=lambda e: (e.coordinate, e.kind, e.scale)):
        unit = EFFECT_KINDS[e.kind].unit
        if is_prismatic(arm, e.coordinate):
            unit = unit.replace("N m", "N").replace("rad", "m")
        scale = f"{e.scale:.3g}" if e.scale else ""
        rows.append(
            (
                e.coordinate,
                e.kind,
                scale,
                *_estimate(e.coefficient, e.standard_error, e.degrees_of_freedom),
                _unit(unit),
            )
        )
    header = ("coordinate", "effect", "scale", "estimate", "95 % interval", "unit")
    caption = f"{len(rows)} {what}"
    scales = {e.kind: EFFECT_KINDS[e.kind].scale for e in effects}
    note = "".join(f"{kind}: the scale is the {text}. " for kind, text in sorted(scales.items()) if text)
    return [Table(header, rows, caption=caption, note=note, collapsed=len(rows) > 12)]


def _all_link_parameters(section: DynamicSection, regressor: DynamicRegressor) -> Table:
    rows = [
        (link.link, name, *_estimate(value, error, section.degrees_of_freedom), _number(sdf), _unit(_UNITS[name]))
        for link, nominal in zip(section.links, regressor.links, strict=True)
        for name, value, error, sdf in zip(
            PARAMETER_NAMES, link.parameters, link.standard_errors or 10 * [0.0], nominal.parameters, strict=True
        )
    ]
    caption = "All inertial parameters of the links, about the origin of the link frame"
    return Table(("link", "parameter", *_HEADER, "unit"), rows, caption=caption, collapsed=True)


def _unit(unit: str) -> str:
    return unit.replace(" ", NO_BREAK).replace("^2", "²")


def _position(p: np.ndarray) -> str:
    return ", ".join(f"{round(float(x), 3) + 0.0:.3f}" for x in p)
