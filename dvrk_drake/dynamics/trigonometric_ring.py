"""Polynomials in sines and cosines of joint angles, which represent the poses of links."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import reduce
from operator import and_

import pydrake.symbolic as symbolic
import sympy

#: Coefficients with an absolute value up to this limit are rounding errors. Other coefficients are 1 or lengths [m].
ROUNDING = 1e-14
#: Monomial -> coefficient. A monomial is the sorted tuple of the indices of its variables. An index occurs n times for
#: the nth power of a variable.
Polynomial = dict[tuple[int, ...], float]
_Kind = symbolic.ExpressionKind


class TrigonometricRing:
    """Ring of polynomials in joint positions and in the sine and cosine of joint angles.

    Attributes:
        q: Joint positions as symbols q1, ..., qn [rad, m].
    """

    def __init__(self, q: Sequence[sympy.Symbol], sums: Sequence[tuple[sympy.Expr, sympy.Expr]]) -> None:
        """Creates the ring.

        Args:
            q: Joint positions as symbols q1, ..., qn [rad, m].
            sums: Pairs of angles that `shortest` combines into the sum of both angles. The pairs are processed in this
                order.
        """
        self.q = tuple(q)
        self._sums = sums
        self._symbols: list[sympy.Symbol] = []
        self._functions: dict[sympy.Symbol, sympy.Expr] = {}
        self._indices: dict[sympy.Expr, int] = {}
        self._variables: dict[str, tuple[float, int]] = {}
        self._memo: dict = {}

    def from_drake(self, expression: symbolic.Expression) -> Polynomial:
        """Converts an expression in Drake's variables q1, ..., qn and in sines and cosines of their sums."""
        polynomial: Polynomial = {}
        for term in _arguments(expression.Expand(), _Kind.Add):
            coefficient, monomial = 1.0, []
            for factor in _arguments(term, _Kind.Mul):
                if isinstance(factor, float) or factor.get_kind() == _Kind.Constant:
                    coefficient *= _number(factor)
                    continue
                base, power = factor, 1
                if factor.get_kind() == _Kind.Pow:
                    base, exponent = factor.Unapply()[1]
                    power = int(_number(exponent))
                sign, index = self._variable(base)
                coefficient *= sign**power
                monomial += [index] * power
            _add(polynomial, tuple(sorted(monomial)), coefficient)
        return _remove_rounding_errors(polynomial)

    def derivative(self, polynomial: Polynomial, q: sympy.Symbol) -> Polynomial:
        """Returns the derivative with respect to a joint position."""
        result: Polynomial = {}
        for monomial, coefficient in polynomial.items():
            for index, power in Counter(monomial).items():
                rest = list(monomial)
                rest.remove(index)
                inner, slope = self._slope(self._functions[self._symbols[index]], q)
                if slope:
                    _add(result, tuple(sorted([*rest, *inner])), coefficient * power * slope)
        return result

    def shortest(self, polynomial: Polynomial) -> Polynomial:
        """Returns an equal polynomial with the angles of parallel joints combined.

        For each pair (a, b) of `sums`, terms such as sin a cos b + cos a sin b become sin(a + b) if this shortens the
        polynomial. Squared cosines are eliminated, so that an identically zero polynomial becomes 0. Terms with
        coefficients up to `ROUNDING` are removed. sympy's trigsimp gives the same result, but its search takes seconds.
        """
        result, shortest = polynomial, self._replace_squared_cosines(polynomial)
        for a, b in self._sums:
            trial = self._combine_angles(result, a, b)
            shorter = self._replace_squared_cosines(trial)
            if _operations(shorter) <= _operations(shortest):
                result, shortest = trial, shorter
        return _remove_rounding_errors(shortest)

    def to_sympy(self, polynomial: Polynomial) -> sympy.Expr:
        """Converts a polynomial to an expression in `q`. Common factors of all terms are factored out."""
        common = reduce(and_, map(Counter, polynomial)) if len(polynomial) > 1 else Counter()
        sign = -1 if common and all(coefficient < 0 for coefficient in polynomial.values()) else 1
        terms = [
            exact_half(sign * coefficient) * self._product(Counter(m) - common) for m, coefficient in polynomial.items()
        ]
        return (sign * self._product(common) * sympy.Add(*terms)).xreplace(self._functions)

    def _product(self, powers: Counter[int]) -> sympy.Expr:
        return sympy.Mul(*(self._symbols[index] ** power for index, power in powers.items()))

    def _variable(self, expression: symbolic.Expression) -> tuple[float, int]:
        """Returns the sign and the variable index of an expression q, sin(angle) or cos(angle)."""
        key = expression.to_string()
        if key not in self._variables:
            function = symbolic.to_sympy(expression, memo=self._memo)
            function = function.xreplace({s: self.q[int(s.name[1:]) - 1] for s in function.free_symbols})
            function = function.xreplace({x: exact_half(float(x)) for x in function.atoms(sympy.Float)})
            sign = -1.0 if function.could_extract_minus_sign() else 1.0
            self._variables[key] = sign, self._index(int(sign) * function)
        return self._variables[key]

    def _index(self, function: sympy.Expr) -> int:
        if function not in self._indices:
            self._indices[function] = len(self._symbols)
            self._symbols.append(sympy.Symbol(f"x{len(self._symbols)}"))
            self._functions[self._symbols[-1]] = function
        return self._indices[function]

    def _slope(self, function: sympy.Expr, q: sympy.Symbol) -> tuple[list[int], float]:
        """Returns the derivative of a variable's function, as the indices of variables and a factor.

        The derivative is the product of these variables, multiplied by the factor.
        """
        if not function.args:
            return [], float(function == q)
        slope = float(function.args[0].coeff(q))
        if isinstance(function, sympy.sin):
            return [self._index(sympy.cos(function.args[0]))], slope
        return [self._index(sympy.sin(function.args[0]))], -slope

    def _combine_angles(self, p: Polynomial, a: sympy.Expr, b: sympy.Expr) -> Polynomial:
        """Replaces sin a cos b and cos a cos b in every monomial by terms with sin(a + b) and cos(a + b)."""
        (sign_a, sa, ca), (sign_b, sb, cb), (sign, S, C) = (self._sine_and_cosine(angle) for angle in (a, b, a + b))
        if sa == sb:
            return p
        p = _eliminate_product(p, (sa, cb), {(S,): sign_a * sign, (ca, sb): -sign_a * sign_b})
        return _eliminate_product(p, (ca, cb), {(C,): 1.0, (sa, sb): sign_a * sign_b})

    def _sine_and_cosine(self, angle: sympy.Expr) -> tuple[float, int, int]:
        """Returns the sign and the variable indices s and c, with sin(angle) = sign * s and cos(angle) = c.

        sympy writes sin(-x) as -sin(x), so the sign can be negative.
        """
        sine = sympy.sin(angle)
        sign = 1 if isinstance(sine, sympy.sin) else -1
        return float(sign), self._index(sign * sine), self._index(sympy.cos(angle))

    def _replace_squared_cosines(self, p: Polynomial) -> Polynomial:
        """Replaces every squared cosine by 1 - sine^2, so that equal polynomials have equal terms."""
        for c in {index for monomial in p for index in monomial}:
            function = self._functions[self._symbols[c]]
            if isinstance(function, sympy.cos):
                s = self._index(sympy.sin(function.args[0]))
                p = _eliminate_product(p, (c, c), {(): 1.0, (s, s): -1.0})
        return p


def exact_half(x: float) -> sympy.Expr:
    """Converts a multiple of 1/2 to an exact number, and any other x to a floating-point number."""
    return sympy.Rational(int(2 * x), 2) if float(2 * x).is_integer() else sympy.Float(x)


def _arguments(expression: symbolic.Expression | float, kind: symbolic.ExpressionKind) -> list:
    """Returns the terms of a sum (kind Add) or the factors of a product (kind Mul). Constants are floats.

    For any other expression, the result contains only the expression.
    """
    if isinstance(expression, float) or expression.get_kind() not in (kind, _Kind.Constant):
        return [expression]
    return list(expression.Unapply()[1])


def _number(constant: symbolic.Expression | float) -> float:
    return constant if isinstance(constant, float) else float(constant.Evaluate())


def _add(polynomial: Polynomial, monomial: tuple[int, ...], coefficient: float) -> None:
    polynomial[monomial] = polynomial.get(monomial, 0.0) + coefficient


def _remove_rounding_errors(p: Polynomial) -> Polynomial:
    """Removes terms with coefficients that are 0 except for rounding errors, e.g. the sum -0.4318 + 0.4162 + 0.0156."""
    return {monomial: coefficient for monomial, coefficient in p.items() if abs(coefficient) > ROUNDING}


def _eliminate_product(p: Polynomial, product: tuple[int, int], replacement: Polynomial) -> Polynomial:
    """Replaces the product of two variables, or the square of one variable, in every monomial until none is left."""
    a, b = product
    while True:
        affected = [m for m in p if (m.count(a) >= 2 if a == b else a in m and b in m)]
        if not affected:
            return p
        p = dict(p)
        for monomial in affected:
            coefficient, rest = p.pop(monomial), list(monomial)
            rest.remove(a)
            rest.remove(b)
            for variables, factor in replacement.items():
                _add(p, tuple(sorted([*rest, *variables])), coefficient * factor)
        p = {monomial: coefficient for monomial, coefficient in p.items() if coefficient}


def _operations(p: Polynomial) -> int:
    """Returns the number of additions, multiplications and powers. A leading minus sign counts as one operation."""
    count = max(len(p) - 1, 0) + bool(p and all(coefficient < 0 for coefficient in p.values()))
    for monomial, coefficient in p.items():
        powers = Counter(monomial).values()
        count += max(len(powers) + (abs(coefficient) != 1.0) - 1, 0) + sum(power > 1 for power in powers)
    return count
