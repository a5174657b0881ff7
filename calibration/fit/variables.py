"""What the optimiser varies instead of the unknowns themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Each g over what never relaxes is at most this.
LARGEST_SHARE = 1e3
#: Largest size of an exponent, and how far a relaxation time may run beyond the shortest step and the longest record.
_EXPONENT, TIME_MARGIN = 50.0, 10.0


@dataclass(frozen=True, eq=False)
class Scaled:
    """Unknowns in units of their sizes; all of shape (k,).

    Attributes:
        sizes: of the unknowns. bounds: of the variables, low and high.
    """

    sizes: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]

    def of(self, unknowns: np.ndarray) -> np.ndarray:
        """Variables of these unknowns, shape (k,)."""
        return unknowns / self.sizes

    def unknowns(self, variables: np.ndarray) -> np.ndarray:
        """Unknowns of these variables, shape (k,)."""
        return variables * self.sizes

    def times(self, jacobian: np.ndarray, variables: np.ndarray) -> np.ndarray:
        """A Jacobian with the unknowns, shape (n, k), as one with the variables."""
        return jacobian * self.sizes


@dataclass(frozen=True, eq=False)
class LongTerm:
    """As `Scaled`: long-term moduli, r_i = g_i / (1 - sum g), and logarithms of times: no share is out of bounds.

    Attributes:
        moduli, exponents, g, tau: places of these among the unknowns.
        time_range: the usual step and the length of the longest record, s.
    """

    moduli: np.ndarray
    exponents: np.ndarray
    g: np.ndarray
    tau: np.ndarray
    time_range: tuple[float, float]

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the variables, low and high."""
        low = np.full(self.moduli.size + self.exponents.size + self.g.size + self.tau.size, -np.inf)
        high = -low
        low[self.exponents], high[self.exponents] = -_EXPONENT, _EXPONENT
        low[self.g], high[self.g] = 0.0, LARGEST_SHARE
        low[self.tau], high[self.tau] = np.log([self.time_range[0] / TIME_MARGIN, self.time_range[1] * TIME_MARGIN])
        return low, high

    def of(self, unknowns: np.ndarray) -> np.ndarray:
        rest, variables = max(1.0 - unknowns[self.g].sum(), 1.0 / LARGEST_SHARE), unknowns.copy()
        variables[self.moduli] *= rest
        variables[self.g] /= rest
        variables[self.tau] = np.log(unknowns[self.tau])
        return variables

    def unknowns(self, variables: np.ndarray) -> np.ndarray:
        factor, unknowns = 1.0 + variables[self.g].sum(), variables.copy()
        unknowns[self.moduli] *= factor
        unknowns[self.g] /= factor
        unknowns[self.tau] = np.exp(variables[self.tau])
        return unknowns

    def times(self, jacobian: np.ndarray, variables: np.ndarray) -> np.ndarray:
        factor, changed = 1.0 + variables[self.g].sum(), jacobian.copy()
        changed[:, self.moduli] *= factor
        changed[:, self.tau] *= np.exp(variables[self.tau])
        # Every r takes from all the moduli and all the shares.
        shared = jacobian[:, self.moduli] @ variables[self.moduli] - jacobian[:, self.g] @ variables[self.g] / factor**2
        changed[:, self.g] = jacobian[:, self.g] / factor + shared[:, None]
        return changed


Variables = Scaled | LongTerm
