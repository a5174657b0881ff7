"""Domain of a strain-energy formula: the deformations at which the formula is defined."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import sympy as sp

#: Largest argument of an exponential function in the finite elements, 1. Stress and tangent, which multiply the
#: exponential by powers of the strain, do not overflow there; the stress is above 1e130 times the shear modulus.
MAX_EXPONENT = 300.0


def list_domain_conditions(energy: sp.Expr, rest: Mapping[sp.Symbol, float], *,
                           includes_overflow: bool = False) -> tuple[sp.Expr, ...]:
    """Return expressions that are positive inside the domain of an energy; empty if the energy has no limit.

    The domain is the connected set around rest where the argument of every logarithm and the base of every power with
    a fractional exponent are positive, and where no denominator vanishes.

    Args:
        energy: symbolic energy.
        rest: variables of the deformation (invariants or a stretch), with their values at rest; other symbols are
            parameters.
        includes_overflow: whether the argument of every exponential function is also limited, to `MAX_EXPONENT`.
    """
    import sympy as sp

    def is_limited(expression: sp.Expr) -> bool:
        """Return whether an expression depends on the deformation and may be negative; it is not 0 at rest."""
        return bool(expression.has(*rest)) and not expression.is_positive and sp.simplify(expression.subs(rest)) != 0

    conditions = [logarithm.args[0] for logarithm in energy.atoms(sp.log) if is_limited(logarithm.args[0])]
    for power in energy.atoms(sp.Pow):
        if not is_limited(power.base) or (power.exp.is_nonnegative and power.exp.is_integer):
            continue
        conditions.append(power.base * power.base.subs(rest) if power.exp.is_integer else power.base)
    if includes_overflow:
        conditions += [1 - exponential.args[0] / MAX_EXPONENT for exponential in energy.atoms(sp.exp)
                       if exponential.has(*rest)]
    return tuple(sorted(set(conditions), key=sp.default_sort_key))
