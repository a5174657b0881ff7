"""Symbolic energies from which the kernels of the finite elements are compiled."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from tissue_sim.public_names import LazyModule

if TYPE_CHECKING:
    import sympy as sp
else:
    sp = LazyModule("sympy")


@dataclass(frozen=True)
class KernelEnergy:
    """Symbolic energy from which the kernels of the finite elements are compiled.

    Laws with the same `key` share one compiled kernel and differ in their coefficients only.

    Attributes:
        key: name of the compiled kernel.
        family: ``"invariants"`` (energy of I1, I2) or ``"stretches"`` (energy of one stretch, summed over three).
        variables: symbols of the family: (I1, I2) or (stretch,).
        coefficients: symbols of the coefficients.
        energy: the symbolic energy.
    """

    key: str
    family: str
    variables: tuple[sp.Symbol, ...]
    coefficients: tuple[sp.Symbol, ...]
    energy: sp.Expr

    @property
    def coefficient_count(self) -> int:
        """Number of coefficients of the energy."""
        return len(self.coefficients)

    @property
    def cache_key(self) -> tuple | None:
        """Key of derived functions in the cache, see `load_or_derive_function`; None: not cached."""
        return None


#: Exponents (i, j) of the monomials (I1-3)^i (I2-3)^j in the kernel that polynomial laws share.
POWERS = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))


def make_invariant_symbols() -> tuple[sp.Symbol, ...]:
    """Return the symbols I1 and I2."""
    return tuple(sp.symbols("I1 I2", positive=True))


class _PolynomialKernelEnergy(KernelEnergy):
    """Energy of the kernel that polynomial laws share; the symbols are made on demand, since sympy imports slowly."""

    def __init__(self):
        object.__setattr__(self, "key", "polynomial")
        object.__setattr__(self, "family", "invariants")

    def __eq__(self, other):
        return isinstance(other, _PolynomialKernelEnergy)

    def __hash__(self):
        return hash(self.key)

    @cached_property
    def variables(self) -> tuple[sp.Symbol, ...]:
        return make_invariant_symbols()

    @cached_property
    def coefficients(self) -> tuple[sp.Symbol, ...]:
        return tuple(sp.Symbol(f"C{i}{j}", real=True) for i, j in POWERS)

    @cached_property
    def energy(self) -> sp.Expr:
        I1, I2 = self.variables
        return sum(c * (I1 - 3)**i * (I2 - 3)**j for c, (i, j) in zip(self.coefficients, POWERS, strict=True))

    @property
    def coefficient_count(self) -> int:
        return len(POWERS)

    @property
    def cache_key(self) -> tuple | None:
        return (self.key,)


#: Energy of the kernel that polynomial laws share.
POLYNOMIAL_KERNEL_ENERGY = _PolynomialKernelEnergy()
