"""Finite-strain viscoelasticity by Prony series.

The hereditary integral acts on the isochoric second Piola-Kirchhoff stress S of the law ("isochoric_second_piola" in
files): S_visc(t) = (1 - sum g) S(t) + sum Q_i(t), where each Q_i follows g_i S and relaxes with tau_i
(Holzapfel, Nonlinear Solid Mechanics, 2000, section 6.10; Simo, CMAME 60 (1987) 153).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter

#: A material has at most so many relaxing terms, drainage included: the finite elements keep one stress for each.
MOST_TERMS = 4
#: The stress that the hereditary integral acts on, by its name in files.
FORM: Final = "isochoric_second_piola"
MODULI = ("instantaneous", "long_term")


@dataclass(frozen=True)
class PronyTerm:
    """One term of a Prony series.

    Attributes:
        g: share of the instantaneous modulus that relaxes, above 0 and below 1.
        tau: relaxation time, s.
    """

    g: float = parameter("g", "1", key="g", bounds=(1e-6, 0.99), absent=0.0)
    tau: float = parameter("tau", "s", key="tau_s", bounds=(1e-4, 1e6))

    def __post_init__(self):
        if not 0 < self.g < 1:
            raise InputError(f"{self.g:g} is not between 0 and 1; give the share of the instantaneous modulus that "
                             "relaxes, or leave the term out", field="g")
        if not 0 < self.tau < np.inf:
            raise InputError(f"{self.tau:g} s is not a positive time; give a relaxation time in s", field="tau")


@dataclass(frozen=True)
class Prony:
    """A Prony series: relative relaxation modulus 1 - sum g_i (1 - exp(-t/tau_i)).

    Attributes:
        terms: 1 to 4 of them.
        moduli: what the parameters of the law stand for, ``"instantaneous"`` (very fast loading) or ``"long_term"``
            (very slow). The g_i are relative to the instantaneous modulus either way.

    Raises:
        InputError: no term or too many, shares that add up to 1 or more, unknown `moduli`.
    """

    terms: tuple[PronyTerm, ...]
    moduli: Literal["instantaneous", "long_term"] = "instantaneous"

    def __post_init__(self):
        object.__setattr__(self, "terms", tuple(self.terms))
        if not 1 <= len(self.terms) <= MOST_TERMS:
            raise InputError(f"{len(self.terms)} terms; give 1 to {MOST_TERMS}, or leave viscoelasticity out",
                             field="terms")
        if not self.relaxing < 1:
            raise InputError(f"the g of all terms add up to {self.relaxing:g}; they must stay below 1, or nothing "
                             "carries a constant load", field="terms")
        if self.moduli not in MODULI:
            raise InputError(f"unknown {self.moduli!r}; known: {', '.join(MODULI)}", field="moduli")

    @property
    def g(self) -> np.ndarray:
        """Shares, shape (terms,)."""
        return np.array([term.g for term in self.terms])

    @property
    def tau(self) -> np.ndarray:
        """Relaxation times, s, shape (terms,)."""
        return np.array([term.tau for term in self.terms])

    @property
    def relaxing(self) -> float:
        """Sum of the g."""
        return float(sum(term.g for term in self.terms))

    @property
    def instantaneous_factor(self) -> float:
        """Instantaneous moduli over the law's: 1, or 1 / (1 - sum g) where the law's parameters are long-term."""
        return 1.0 if self.moduli == "instantaneous" else 1.0 / (1.0 - self.relaxing)

    def modulus(self, time) -> np.ndarray:
        """Relaxation modulus over the instantaneous one, `time` s after a sudden step; shape of `time`."""
        relaxed = -np.expm1(-np.asarray(time, dtype=float)[..., None] / self.tau)
        return 1.0 - relaxed @ self.g

    def increment(self, dt) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Factors of the recursion Q_i^{n+1} = decay_i Q_i^n + gain_i (S^{n+1} - S^n), exact for S linear in time.

        Args:
            dt: length of the step, s, any shape; 0 (a sudden step) and infinity (fully relaxed) included.

        Returns:
            `instant` = 1 - sum g + sum gain, the share of a change of S that S_visc = (1 - sum g) S + sum Q_i follows
            within the step, shape of `dt`; `decay` and `gain`, shape (*dt.shape, terms).

        Source: decay_i = exp(-dt/tau_i), gain_i = g_i (1 - exp(-dt/tau_i)) tau_i/dt (Taylor, Pister and Goudreau,
        IJNME 2 (1970) 45).
        """
        decay, gain = _step(dt, self.tau)
        gain = self.g * gain
        return 1.0 - self.relaxing + gain.sum(axis=-1), decay, gain


def internal_stress(dt: np.ndarray, elastic: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Q_i / g_i of a history of the elastic stress S that starts from nothing, linear in time between its points.

    Args:
        dt: time from the point before, s, shape (n,); the first entry is that from rest.
        elastic: S, shape (n, components).
        tau: relaxation times, s, shape (terms,).

    Returns:
        Shape (n, components, terms).
    """
    decay, gain = _step(dt, tau)
    change = np.diff(elastic, axis=0, prepend=np.zeros_like(elastic[:1]))
    decay, Q = decay[:, None, :], gain[:, None, :] * change[:, :, None]
    # Q^{n+1} = decay Q^n + ... is a chain of affine maps: doubling the length of the links takes log2 n passes.
    shift = 1
    while shift < len(Q):
        Q = np.concatenate([Q[:shift], Q[shift:] + decay[shift:] * Q[:-shift]])
        decay = np.concatenate([decay[:shift], decay[shift:] * decay[:-shift]])
        shift *= 2
    return Q


def _step(dt, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decay, and gain over g, of steps of length dt; shape (*dt.shape, terms)."""
    x = np.asarray(dt, dtype=float)[..., None] / tau
    return np.exp(-x), np.where(x > 0, -np.expm1(-x) / np.where(x > 0, x, 1.0), 1.0)
