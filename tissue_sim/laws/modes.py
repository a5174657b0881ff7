"""Modes: homogeneous deformations of an incompressible solid along its principal axes."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np


@dataclass(frozen=True)
class StretchMode:
    """Principal stretches as products of powers of one or two prescribed stretches, whose volume is constant.

    Attributes:
        name: name of the mode.
        exponents: exponents of the prescribed stretches in each of the three principal stretches.
        directions: for each prescribed stretch the number of principal directions that it loads equally.
    """

    name: str
    exponents: tuple[tuple[Fraction, ...], ...]
    directions: tuple[int, ...] = (1,)

    @property
    def stretch_count(self) -> int:
        """Number of prescribed stretches, 1 or 2."""
        return len(self.directions)

    @property
    def exponent_matrix(self) -> np.ndarray:
        """Exponents as numbers, shape (3, stretches)."""
        return np.array(self.exponents, dtype=float)

    def compute_principal_stretches(self, stretch) -> np.ndarray:
        """Return the three principal stretches.

        Args:
            stretch: prescribed stretch, shape (...); two of them: shape (..., 2).

        Returns:
            Shape (..., 3), product 1.
        """
        stretch = np.asarray(stretch, dtype=float)
        prescribed = stretch[..., None] if self.stretch_count == 1 else stretch
        return np.prod(prescribed[..., None, :] ** self.exponent_matrix, axis=-1)


_HALF = Fraction(1, 2)
#: Uniaxial loading, free sides.
UNIAXIAL = StretchMode("uniaxial", ((Fraction(1),), (-_HALF,), (-_HALF,)))
#: Loading in one direction, constant width: pure shear.
PLANAR = StretchMode("planar", ((Fraction(1),), (Fraction(0),), (Fraction(-1),)))
#: Equal loading in two directions.
EQUIBIAXIAL = StretchMode("equibiaxial", ((Fraction(1),), (Fraction(1),), (Fraction(-2),)), (2,))
#: Loading in two directions by different stretches.
BIAXIAL = StretchMode("biaxial", ((Fraction(1), Fraction(0)), (Fraction(0), Fraction(1)),
                                  (Fraction(-1), Fraction(-1))), (1, 1))
#: Name -> mode.
STRETCH_MODES = {mode.name: mode for mode in (UNIAXIAL, PLANAR, EQUIBIAXIAL, BIAXIAL)}
#: Names of the modes with one prescribed stretch.
MODES = tuple(name for name, mode in STRETCH_MODES.items() if mode.stretch_count == 1)
