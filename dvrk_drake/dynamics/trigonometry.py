"""Trigonometric polynomials of joint angles in their shortest readable form."""

from __future__ import annotations

from collections.abc import Sequence

import sympy

#: Coefficients are 1 or lengths in metres: below this one is a difference of equals.
ROUNDING = 1e-14


def simplify_trigonometry(
    expression: sympy.Expr, q: Sequence[sympy.Symbol], parallel: Sequence[tuple[int, int]]
) -> sympy.Expr:
    """Writes a polynomial in sin and cos of q with the sums of parallel joints as one angle.

    For a pair (i, j) in `parallel`, products such as s_i c_j + c_i s_j become sin(q_i + q_j); cos^2 is eliminated, so
    that what is identically zero becomes 0. Coefficients of rounding's size are dropped, so the result equals the
    expression at every q to that. sympy's own trigsimp does the same by search and takes seconds.
    """
    halves = {x: sympy.Rational(int(2 * x), 2) for x in expression.atoms(sympy.Float) if float(2 * x).is_integer()}
    result = expression.xreplace(halves)
    # A gripper's finger turns by half of its joint: angles that are no joint's own are variables of their own.
    others = {function.args[0] for function in result.atoms(sympy.sin, sympy.cos)} - set(q)
    angles = [*q, *sorted(others, key=str)]
    s = [sympy.Symbol(f"s{i}") for i in range(len(angles))]
    c = [sympy.Symbol(f"c{i}") for i in range(len(angles))]
    back: dict[sympy.Symbol, sympy.Expr] = {
        **dict(zip(s, map(sympy.sin, angles), strict=True)),
        **dict(zip(c, map(sympy.cos, angles), strict=True)),
    }
    names = {function: symbol for symbol, function in back.items()}
    plain = result = _without_rounding(sympy.expand(result.xreplace(names)))
    for i, j in parallel:
        S, C = sympy.symbols(f"S{i} C{i}")
        # s_i c_j = S - c_i s_j and c_i c_j = C + s_i s_j, applied to every monomial that holds the left-hand side.
        result = _eliminate_product(result, s[i], c[j], S - c[i] * s[j])
        result = _eliminate_product(result, c[i], c[j], C + s[i] * s[j])
        back |= {S: sympy.sin(q[i] + q[j]), C: sympy.cos(q[i] + q[j])}
    result = _without_squared_cosines(result, s, c)
    if any(result.has(s[j]) or result.has(c[j]) for _, j in parallel):
        # The sum did not absorb the second angle: perhaps a link turns it back, as a coupler does, and it drops out.
        result = min(result, _without_squared_cosines(plain, s, c), key=sympy.count_ops)
    return _collect(_without_rounding(result)).xreplace(back)


def _without_rounding(e: sympy.Expr) -> sympy.Expr:
    """Leaves out the terms with a coefficient that is zero but for rounding, such as -0.4318 + 0.4162 + 0.0156."""
    return sympy.Add(*(term for term in sympy.Add.make_args(e) if abs(term.as_coeff_Mul()[0]) > ROUNDING))


def _without_squared_cosines(e: sympy.Expr, s: Sequence[sympy.Symbol], c: Sequence[sympy.Symbol]) -> sympy.Expr:
    """Writes 1 - s^2 for every c^2, so that equal polynomials look equal."""
    for si, ci in zip(s, c, strict=True):
        e = _eliminate_product(e, ci, ci, 1 - si**2)
    return e


def _eliminate_product(e: sympy.Expr, a: sympy.Symbol, b: sympy.Symbol, replacement: sympy.Expr) -> sympy.Expr:
    """Replaces the product a b (a**2 if a is b) in every monomial of e, until none is left."""
    for _ in range(8):
        changed = sympy.Integer(0)
        rest = sympy.Integer(0)
        for term in sympy.Add.make_args(e):
            powers = term.as_powers_dict()
            has = powers.get(a, 0) >= 2 if a is b else (powers.get(a, 0) >= 1 and powers.get(b, 0) >= 1)
            if has:
                changed += term / (a * b) * replacement
            else:
                rest += term
        if changed == 0:
            break
        e = sympy.expand(changed + rest)
    return e


def _collect(e: sympy.Expr) -> sympy.Expr:
    """Takes out what all terms have in common, e.g. S s4 s5 + S c4 c5 -> S (s4 s5 + c4 c5)."""
    return sympy.factor_terms(e) if e.is_Add else e
