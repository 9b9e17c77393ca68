"""Torques at a joint beside the rigid body's: each a named model, linear in one coefficient."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import sympy

#: kind -> torque per unit of coefficient as a function of the joint's own position. Bounded on purpose: a polynomial
#: that fits a narrow sweep runs away outside of it.
EFFECT_KINDS: dict[str, Callable[[sympy.Symbol], sympy.Expr]] = {
    "offset": lambda q: sympy.Integer(1),  # constant: cable preload, current offset [N m]
    "spring": sympy.sin,  # spring or cable hooked on off the axis, slack at zero [N m]
}
#: Kinds that only a joint that turns can have.
REVOLUTE_KINDS = {"spring"}


def kinds_of(prismatic: bool) -> list[str]:
    """The kinds of effect that a joint can have."""
    return [kind for kind in EFFECT_KINDS if not (prismatic and kind in REVOLUTE_KINDS)]


@dataclass(frozen=True)
class JointEffect:
    """One effect at one joint; its torque is coefficient * `expression`.

    Attributes:
        joint: name of the joint.
        kind: a key of `EFFECT_KINDS`.
    """

    joint: str
    kind: str

    def expression(self, q: sympy.Symbol) -> sympy.Expr:
        """Torque per unit of coefficient at joint position q [rad or m]."""
        return EFFECT_KINDS[self.kind](q)

    def __str__(self) -> str:
        return f"{self.joint} {self.kind}"
