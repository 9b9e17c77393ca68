"""Exports the gravity torque and its regressor as LaTeX, Python or C."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

import numpy as np
import sympy

from dvrk_drake.dynamics import codegen
from dvrk_drake.dynamics.gravity_regressor import GRAVITY, SymbolicGravity


def to_latex(gravity: SymbolicGravity, frame_poses: Mapping[str, sympy.Matrix]) -> str:
    """Base parameters, potential energy, torque, regressor and frames as LaTeX (needs amsmath); s_{23} is sin(q2 + q3).

    Args:
        gravity: the derivation.
        frame_poses: X_0F of each link frame, from `SymbolicPlant.frame_poses`.
    """
    short = _short_angles(gravity, *frame_poses.values())
    Y = sympy.Matrix(gravity.regressor).xreplace(short)
    lines = [
        f"% {_what(gravity)}: torque that holds it against gravity, tau = Y(q) beta.",
        "% s_i = sin q_i, c_i = cos q_i, s_{ij} = sin(q_i + q_j), s_{i - j / 2} = sin(q_i - q_j / 2);",
        f"% m_i c_i in link frame i; {_lengths(gravity)}.",
        r"\begin{align*}",
        *(
            rf"\beta_{{{i + 1}}} &= {_latex_name(text)} = {value:.5g}\ {_latex_unit(unit)} \\"
            for i, (text, value, unit) in enumerate(
                zip(gravity.base.names, gravity.base_values, gravity.base.units, strict=True)
            )
        ),
        r"\end{align*}",
        r"\begin{align*}",
        rf"P &= {_linear_combination(sympy.Matrix(gravity.potential).xreplace(short))} + \text{{constant}} \\",
        r"\end{align*}",
        r"\begin{align*}",
    ]
    lines += [rf"\tau_{{{j + 1}}} &= {_linear_combination(Y[j, :])} \\" for j in range(Y.rows)]
    lines.append(r"\end{align*}")
    lines.append(r"\begin{align*}")
    for (row, column), entry in sorted(Y.todok().items()):
        lines.append(rf"Y_{{{row + 1},{column + 1}}} &= {sympy.latex(entry)} \\")
    lines.append(r"\end{align*}")
    lines.append(r"\begin{align*}")
    for label, X_0F in frame_poses.items():
        index = label if label.isdigit() else r"\mathrm{" + label.replace("_", r"\,") + "}"
        matrix = sympy.latex(sympy.Matrix(X_0F).xreplace(short), mat_str="pmatrix", mat_delim="")
        lines.append(rf"X_{{0,{index}}} &= {matrix} \\")
    return "\n".join([*lines, r"\end{align*}", ""])


def to_python(gravity: SymbolicGravity) -> str:
    """Returns a Python module with `gravity_torque(q, g, beta, out)` and `gravity_regressor(q, g, out)`.

    The module has no dependencies.
    """
    torque, regressor, arguments, beta_argument = _functions(gravity)
    names = "".join(f"    ({value!r}, {name!r}),\n" for name, value in _named_values(gravity))
    return (
        f'"""{_what(gravity)}: holding torque, tau = Y(q) beta [N m; N if prismatic].\n\n'
        "Made by dvrk-drake from its Drake model. q [rad; m if prismatic] in the dVRK's order and signs, g [m/s^2]\n"
        f"the size of gravity, beta the base parameters below; {_lengths(gravity)}. out is filled: out[j], or\n"
        'out[j, k] for the regressor (numpy).\n"""\n\nimport math\n\n'
        f"#: (nominal value, meaning) of each base parameter.\nBASE_PARAMETERS = [\n{names}]\n\n\n"
        + codegen.python_source("gravity_torque", [*arguments, beta_argument], torque, "Fills out (n) with Y(q) beta.")
        + "\n\n"
        + codegen.python_source("gravity_regressor", arguments, regressor, "Fills out (n, b) with Y(q).")
    )


def to_c(gravity: SymbolicGravity) -> str:
    """Returns C99 source of `<arm>_gravity_torque(q, g, beta, out)` and `<arm>_gravity_regressor(q, g, out)`.

    The output is row-major.
    """
    torque, regressor, arguments, beta_argument = _functions(gravity)
    prefix = gravity.arm.name.lower()
    table = "\n".join(f" *   beta[{i}] = {v!r}: {name}" for i, (name, v) in enumerate(_named_values(gravity)))
    header = (
        f"/* {_what(gravity)}: holding torque, tau = Y(q) beta [N m; N if prismatic].\n"
        " * Made by dvrk-drake from its Drake model. q [rad; m if prismatic] in the dVRK's order and signs, g [m/s^2]\n"
        f" * the size of gravity, beta the base parameters, nominal values below; {_lengths(gravity)}.\n{table}\n */\n"
    )
    body = c_source(f"{prefix}_gravity_torque", [*arguments, beta_argument], torque)
    body += "\n" + c_source(f"{prefix}_gravity_regressor", arguments, regressor).replace("#include <math.h>\n\n", "")
    return header + body


def c_source(
    name: str, arguments: Sequence[tuple[str, Sequence[sympy.Symbol]]], terms: codegen.SharedTerms, comment: str = ""
) -> str:
    """A C99 function `void name(..., double *out)`; out is row-major. Arguments as in `codegen.python_source`."""
    parameters = [f"double {n}" if codegen.is_scalar(n, s) else f"const double {n}[{len(s)}]" for n, s in arguments]
    size = math.prod(terms.shape)
    lines = [f"/* {comment} */"] if comment else []
    lines += ["#include <math.h>", "", f"void {name}({', '.join(parameters)}, double out[{size}]) {{"]
    lines += codegen.unpacking(arguments, terms, "  const double {symbol} = {array}[{index}];")
    lines += [f"  const double {symbol} = {sympy.ccode(e)};" for symbol, e in terms.assignments]
    lines.append(f"  for (int i = 0; i < {size}; ++i) out[i] = 0.0;")
    for index, e in terms.entries:
        lines.append(f"  out[{np.ravel_multi_index(index, terms.shape)}] = {sympy.ccode(e)};")
    return "\n".join([*lines, "}", ""])


def _what(gravity: SymbolicGravity) -> str:
    """Returns a description of the arm, its mounting and the omitted terms."""
    x, y, z = gravity.arm.gravity
    labels = {p.label for p in gravity.standard_parameters}
    serial = "" if any(not label.isdigit() for label in labels) else ", without the links of its linkage"
    return f"{gravity.arm.name}{serial}, gravity ({x:g}, {y:g}, {z:g}) m/s^2 in its base frame"


def _functions(
    gravity: SymbolicGravity,
) -> tuple[codegen.SharedTerms, codegen.SharedTerms, list[tuple[str, Sequence]], tuple[str, Sequence]]:
    beta = _beta_symbols(gravity)
    torque = codegen.share_terms(sympy.Array(list(sympy.Matrix(gravity.regressor) * sympy.Matrix(beta))))
    regressor = codegen.share_terms(gravity.regressor)
    return torque, regressor, [("q", gravity.q), ("g", (GRAVITY,))], ("beta", beta)


def _named_values(gravity: SymbolicGravity) -> list[tuple[str, float]]:
    """Returns each base parameter with its unit and its value in the SDF."""
    base = gravity.base
    return [(f"{n} [{u}]", float(v)) for n, u, v in zip(base.names, base.units, gravity.base_values, strict=True)]


def _lengths(gravity: SymbolicGravity) -> str:
    return ", ".join(f"{name} = {length:g} m" for name, length in gravity.lengths.items())


def _beta_symbols(gravity: SymbolicGravity) -> tuple[sympy.Symbol, ...]:
    return tuple(sympy.Symbol(f"beta{i + 1}") for i in range(len(gravity.base.names)))


def _linear_combination(row: sympy.Matrix) -> str:
    """g (beta_1 row_1 + ...) of a row (1, b) that holds the factor g; 0 if it is zero."""
    terms = [rf"\beta_{{{k + 1}}} {_factor(entry / GRAVITY)}" for k, entry in enumerate(row) if entry != 0]
    return rf"g \left({' + '.join(terms)}\right)" if terms else "0"


def _short_angles(gravity: SymbolicGravity, *matrices: sympy.Matrix) -> dict[sympy.Expr, sympy.Symbol]:
    number = {q: str(i + 1) for i, q in enumerate(gravity.q)}
    short = {}
    found = set().union(*(m.atoms(sympy.sin, sympy.cos) for m in (gravity.regressor, gravity.potential, *matrices)))
    for function in found:
        letter = "s" if isinstance(function, sympy.sin) else "c"
        angle = function.args[0]
        if all(angle.coeff(q) == 1 for q in angle.free_symbols):
            indices = "".join(sorted(number[q] for q in angle.free_symbols))
        else:
            indices = sympy.latex(angle, symbol_names={q: number[q] for q in gravity.q}, fold_short_frac=True)
        short[function] = sympy.Symbol(f"{letter}_{{{indices}}}")
    return short


def _factor(e: sympy.Expr) -> str:
    """LaTeX of e as a factor: in brackets where it is a sum or begins with a minus."""
    text = sympy.latex(e)
    return rf"\left({text}\right)" if e.is_Add or text.startswith("-") else text


def _latex_unit(unit: str) -> str:
    return r"\mathrm{" + unit.replace(" ", r"\,") + "}"


def _latex_name(text: str) -> str:
    """`L2 (m2+...+m7) + m2 c2x` -> `L_{2} (m_{2}+\\dots+m_{7}) + m_{2} c_{2x}`."""
    words = []
    for word in re.sub(r"([-+()])", r" \1 ", text.replace("...", r"\dots")).split():
        if word[0] in "Lmc" and len(word) > 1:
            words.append(rf"{word[0]}_{{{word[1:].lstrip('_').replace('_', chr(92) + ',')}}}")
        else:
            words.append(word)
    return " ".join(words)
