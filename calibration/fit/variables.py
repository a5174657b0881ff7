"""Transformations between the unknowns of a problem and the variables of the optimiser."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PronyVariableBoundSettings:
    """Default bounds of the variables of a law with Prony terms, used where the campaign states no bounds.

    Attributes:
        max_ratio: largest ratio r_i = g_i / (1 - sum g) of a relaxing to the long-term stiffness.
        max_exponent: largest absolute value of an exponent.
        time_margin: factor by which a relaxation time may be shorter than the sampling interval or longer than the
            longest recording. A larger value admits times on which the samples have no information.
    """

    max_ratio: float = 1e3
    max_exponent: float = 50.0
    time_margin: float = 10.0


_BOUNDS = PronyVariableBoundSettings()


@dataclass(frozen=True, eq=False)
class SizeScaledVariables:
    """Variables that are the unknowns divided by their sizes; all arrays have shape (k,).

    Attributes:
        sizes: scale of each unknown.
        bounds: lower and upper bounds of the variables.
    """

    sizes: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]

    def convert_from_unknowns(self, unknowns: np.ndarray) -> np.ndarray:
        """Convert unknowns (SI units) to variables of the optimiser; both have shape (k,)."""
        return unknowns / self.sizes

    def convert_to_unknowns(self, variables: np.ndarray) -> np.ndarray:
        """Convert variables of the optimiser to unknowns (SI units); both have shape (k,)."""
        return variables * self.sizes

    def convert_jacobian_to_variables(self, jacobian: np.ndarray, variables: np.ndarray) -> np.ndarray:
        """Return derivatives with respect to the variables, from those with respect to the unknowns (chain rule).

        Args:
            jacobian: derivatives with respect to the unknowns, shape (n, k).
            variables: variables at which the Jacobian was evaluated, shape (k,).
        """
        return jacobian * self.sizes


@dataclass(frozen=True, eq=False)
class LongTermPronyVariables:
    """Variables of a law with Prony terms: long-term moduli, ratios r_i = g_i / (1 - sum g), and ln tau_i.

    Every set of ratios r_i >= 0 gives fractions g_i with sum g < 1, so simple bounds suffice.

    Attributes:
        moduli: indices of the moduli among the unknowns.
        exponents: indices of the exponents.
        g: indices of the fractions g_i.
        tau: indices of the relaxation times.
        time_range: sampling interval and duration of the longest recording, s.
    """

    moduli: np.ndarray
    exponents: np.ndarray
    g: np.ndarray
    tau: np.ndarray
    time_range: tuple[float, float]

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the variables, shapes (k,)."""
        low = np.full(self.moduli.size + self.exponents.size + self.g.size + self.tau.size, -np.inf)
        high = -low
        low[self.exponents], high[self.exponents] = -_BOUNDS.max_exponent, _BOUNDS.max_exponent
        low[self.g], high[self.g] = 0.0, _BOUNDS.max_ratio
        shortest, longest = self.time_range
        low[self.tau], high[self.tau] = np.log([shortest / _BOUNDS.time_margin, longest * _BOUNDS.time_margin])
        return low, high

    def convert_from_unknowns(self, unknowns: np.ndarray) -> np.ndarray:
        """Convert unknowns (SI units) to variables of the optimiser; both have shape (k,)."""
        rest, variables = max(1.0 - unknowns[self.g].sum(), 1.0 / _BOUNDS.max_ratio), unknowns.copy()
        variables[self.moduli] *= rest
        variables[self.g] /= rest
        variables[self.tau] = np.log(unknowns[self.tau])
        return variables

    def convert_to_unknowns(self, variables: np.ndarray) -> np.ndarray:
        """Convert variables of the optimiser to unknowns (SI units); both have shape (k,)."""
        factor, unknowns = 1.0 + variables[self.g].sum(), variables.copy()
        unknowns[self.moduli] *= factor
        unknowns[self.g] /= factor
        unknowns[self.tau] = np.exp(variables[self.tau])
        return unknowns

    def convert_jacobian_to_variables(self, jacobian: np.ndarray, variables: np.ndarray) -> np.ndarray:
        """Return derivatives with respect to the variables; see `SizeScaledVariables.convert_jacobian_to_variables`."""
        factor, changed = 1.0 + variables[self.g].sum(), jacobian.copy()
        changed[:, self.moduli] *= factor
        changed[:, self.tau] *= np.exp(variables[self.tau])
        # Each r_i changes all instantaneous moduli and all fractions g_j.
        shared = jacobian[:, self.moduli] @ variables[self.moduli] - jacobian[:, self.g] @ variables[self.g] / factor**2
        changed[:, self.g] = jacobian[:, self.g] / factor + shared[:, None]
        return changed


Variables = SizeScaledVariables | LongTermPronyVariables
