"""Short forms of polynomials in joint positions and in sines and cosines of sums of them, such as poses of links."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import sympy
from sympy.polys.domains import RR
from sympy.polys.orderings import lex
from sympy.polys.rings import PolyElement, PolyRing

#: Coefficients with an absolute value up to this limit are rounding errors. Other coefficients are 1 or lengths [m].
ROUNDING = 1e-14


def shortest_form(expression: sympy.Expr, sums: Sequence[tuple[sympy.Expr, sympy.Expr]]) -> sympy.Expr:
    """Returns an equal expression with the angles of parallel joints combined, and with its common factors in front.

    For each pair (a, b) of `sums`, terms such as sin a cos b + cos a sin b become sin(a + b) if this shortens the
    expression. Squared cosines are eliminated, so that an expression that is identically zero becomes 0. sympy's
    trigsimp gives the same result, but its search takes minutes.

    Args:
        expression: Polynomial in symbols and in sines and cosines of their sums.
        sums: Pairs of angles, in the order in which they are combined.
    """
    trial, shortest = expression, None
    for a, b in [(sympy.Integer(0), sympy.Integer(0)), *sums]:
        present = sorted(trial.atoms(sympy.sin, sympy.cos), key=str)
        if shortest is not None and not {sympy.cos(a), sympy.cos(b)} <= {sympy.cos(x.args[0]) for x in present}:
            continue
        angles = [a, b, a + b, *(x.args[0] for x in present)]
        # Division eliminates leading monomials. They are sin a cos b and cos a cos b, since cos b comes first.
        variables = [*map(sympy.cos, [b, *angles]), *map(sympy.sin, angles), *trial.free_symbols]
        ring = _Ring(variables)
        sine = sympy.sin(a) * sympy.cos(b) + sympy.cos(a) * sympy.sin(b) - sympy.sin(a + b)
        cosine = sympy.cos(a) * sympy.cos(b) - sympy.sin(a) * sympy.sin(b) - sympy.cos(a + b)
        combined = ring.remainder(ring.polynomial(trial), [sine, cosine])
        squares = [sympy.cos(angle) ** 2 + sympy.sin(angle) ** 2 - 1 for angle in angles]
        shorter = ring.remainder(combined, squares)
        if shortest is None or _operations(shorter) <= _operations(shortest):
            trial, shortest, result = combined.as_expr(*ring.variables), shorter, ring.factored(shorter)
    return result


class _Ring:
    """Ring of polynomials in symbols, sines and cosines, with lexicographic order.

    Attributes:
        variables: Symbols, sines and cosines, the first one in the order first.
    """

    def __init__(self, variables: Sequence[sympy.Expr]) -> None:
        # sympy writes cos(-x) as cos(x), sin(-x) as -sin(x), and numbers for constant angles.
        positive = [-x if x.could_extract_minus_sign() else x for x in variables]
        self.variables = list(dict.fromkeys(x for x in positive if not x.is_number))
        self._names = {x: sympy.Symbol(f"x{i}") for i, x in enumerate(self.variables)}
        self._ring = PolyRing(list(self._names.values()), RR, lex)

    def polynomial(self, expression: sympy.Expr) -> PolyElement:
        return self._ring.from_expr(expression.xreplace(self._names))

    def remainder(self, polynomial: PolyElement, divisors: Sequence[sympy.Expr]) -> PolyElement:
        """Returns the remainder without rounding errors."""
        result = polynomial.rem([p for p in map(self.polynomial, map(sympy.sympify, divisors)) if p])
        return self._ring.from_dict({powers: x for powers, x in result.items() if abs(x) > ROUNDING})

    def factored(self, polynomial: PolyElement) -> sympy.Expr:
        """Converts a polynomial to an expression with the common factors of all terms in front."""
        monomials = [powers for powers, _ in polynomial.terms()]
        common = (
            [min(column) for column in zip(*monomials, strict=True)]
            if len(monomials) > 1
            else [0] * len(self.variables)
        )
        sign = -1 if any(common) and all(x < 0 for x in polynomial.coeffs()) else 1
        terms = [
            exact_half(sign * float(x)) * self._product(p - c for p, c in zip(powers, common, strict=True))
            for powers, x in polynomial.terms()
        ]
        return sign * self._product(common) * sympy.Add(*terms)

    def _product(self, powers: Iterable[int]) -> sympy.Expr:
        return sympy.Mul(*(x**power for x, power in zip(self.variables, powers, strict=True)))


def exact_half(x: float) -> sympy.Expr:
    """Converts a multiple of 1/2 to an exact number, and any other x to a floating-point number."""
    return sympy.Rational(int(2 * x), 2) if float(2 * x).is_integer() else sympy.Float(x)


def _operations(polynomial: PolyElement) -> int:
    """Returns the number of additions, multiplications and powers. A leading minus sign counts as one operation."""
    count = max(len(polynomial) - 1, 0) + bool(polynomial and all(x < 0 for x in polynomial.coeffs()))
    for powers, x in polynomial.terms():
        factors = [power for power in powers if power]
        count += max(len(factors) + (abs(x) != 1) - 1, 0) + sum(power > 1 for power in factors)
    return count
