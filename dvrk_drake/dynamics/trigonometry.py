"""Trigonometric polynomials of joint angles in their shortest readable form."""

from __future__ import annotations

from collections.abc import Sequence

import sympy

#: Coefficients are 1 or lengths in metres: below this one is a difference of equals.
ROUNDING = 1e-14


def simplify_trigonometry(expression: sympy.Expr, sums: Sequence[tuple[sympy.Expr, sympy.Expr]]) -> sympy.Expr:
    """Writes a polynomial in sin and cos of angles with the angles of parallel joints added up.

    For a pair (a, b) in `sums`, in that order, products such as sin a cos b + cos a sin b become sin(a + b) where that
    is shorter; cos^2 is eliminated, so that what is identically zero becomes 0. Coefficients of rounding's size are
    dropped, so the result equals the expression at every pose to that. sympy's own trigsimp does the same by search and
    takes seconds.
    """
    result = expression.xreplace({x: exact_half(x) for x in expression.atoms(sympy.Float) if float(2 * x).is_integer()})
    angles = _Angles()
    names = {function: angles.name(function) for function in result.atoms(sympy.sin, sympy.cos)}
    result = _without_rounding(sympy.expand(result.xreplace(names)))
    shortest = angles.without_squared_cosines(result)
    for a, b in sums:
        trial = angles.add_up(result, a, b)
        shorter = angles.without_squared_cosines(trial)
        if sympy.count_ops(shorter) <= sympy.count_ops(shortest):
            result, shortest = trial, shorter
    shortest = _without_rounding(shortest)
    # What all terms have in common is taken out, e.g. S s4 s5 + S c4 c5 -> S (s4 s5 + c4 c5).
    return (sympy.factor_terms(shortest) if shortest.is_Add else shortest).xreplace(angles.functions)


def exact_half(x: float) -> sympy.Expr:
    """x as an exact number if it is a multiple of one half."""
    return sympy.Rational(int(2 * x), 2) if float(2 * x).is_integer() else sympy.Float(x)


class _Angles:
    """Symbols for the sine and cosine of each angle; `functions` maps them back."""

    def __init__(self) -> None:
        self._symbols: dict[sympy.Expr, tuple[sympy.Symbol, sympy.Symbol]] = {}
        self.functions: dict[sympy.Symbol, sympy.Expr] = {}

    def name(self, function: sympy.Expr) -> sympy.Symbol:
        """The symbol of sin(angle) or cos(angle)."""
        angle = function.args[0]
        if angle not in self._symbols:
            s, c = sympy.symbols(f"s{len(self._symbols)} c{len(self._symbols)}")
            self._symbols[angle] = s, c
            self.functions |= {s: sympy.sin(angle), c: sympy.cos(angle)}
        s, c = self._symbols[angle]
        return s if isinstance(function, sympy.sin) else c

    def add_up(self, e: sympy.Expr, a: sympy.Expr, b: sympy.Expr) -> sympy.Expr:
        """Puts sin(a + b) and cos(a + b) in for sin a cos b and cos a cos b in every monomial."""
        (sign_a, angle_a), (sign_b, angle_b), (sign, angle) = map(_sign_and_angle, (a, b, a + b))
        if angle_a not in self._symbols or angle_b not in self._symbols or angle_a == angle_b:
            return e
        (sa, ca), (sb, cb) = self._symbols[angle_a], self._symbols[angle_b]
        S, C = self.name(sympy.sin(angle)), self.name(sympy.cos(angle))
        e = _eliminate_product(e, sa, cb, sign_a * (sign * S - sign_b * ca * sb))
        return _eliminate_product(e, ca, cb, C + sign_a * sign_b * sa * sb)

    def without_squared_cosines(self, e: sympy.Expr) -> sympy.Expr:
        """Writes 1 - s^2 for every c^2, so that equal polynomials look equal."""
        for s, c in self._symbols.values():
            e = _eliminate_product(e, c, c, 1 - s**2)
        return e


def _sign_and_angle(angle: sympy.Expr) -> tuple[int, sympy.Expr]:
    """Such that sin(angle) = sign sin(result), the way sympy writes it."""
    function = sympy.sin(angle)
    return (1, function.args[0]) if isinstance(function, sympy.sin) else (-1, -angle)


def _without_rounding(e: sympy.Expr) -> sympy.Expr:
    """Leaves out the terms with a coefficient that is zero but for rounding, such as -0.4318 + 0.4162 + 0.0156."""
    return sympy.Add(*(term for term in sympy.Add.make_args(e) if abs(term.as_coeff_Mul()[0]) > ROUNDING))


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
