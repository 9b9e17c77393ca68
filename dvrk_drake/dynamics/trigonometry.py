"""Trigonometric polynomials of joint angles in their shortest readable form."""

from __future__ import annotations

from collections.abc import Sequence

import sympy


def simplify_trigonometry(
    expression: sympy.Expr, q: Sequence[sympy.Symbol], parallel: Sequence[tuple[int, int]]
) -> sympy.Expr:
    """Writes a polynomial in sin and cos of q with the sums of parallel joints as one angle.

    For a pair (i, j) in `parallel`, products such as s_i c_j + c_i s_j become sin(q_i + q_j); cos^2 is eliminated, so
    that what is identically zero becomes 0. The result equals the expression at every q. sympy's own trigsimp does the
    same by search and takes seconds.
    """
    s = [sympy.Symbol(f"s{i}") for i in range(len(q))]
    c = [sympy.Symbol(f"c{i}") for i in range(len(q))]
    whole = {x: sympy.Integer(int(x)) for x in expression.atoms(sympy.Float) if float(x).is_integer()}
    result = expression.xreplace(whole)
    names = {sympy.sin(x): y for x, y in zip(q, s, strict=True)} | {sympy.cos(x): y for x, y in zip(q, c, strict=True)}
    plain = result = sympy.expand(result.xreplace(names))
    back: dict[sympy.Symbol, sympy.Expr] = dict(zip([*s, *c], [*map(sympy.sin, q), *map(sympy.cos, q)], strict=True))
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
    return _collect(result).xreplace(back)


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
