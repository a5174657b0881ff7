"""Finite-strain viscoelasticity by a Prony series, and drainage of pore fluid as one relaxing term.

The hereditary integral acts on the isochoric second Piola-Kirchhoff stress S of the law ("isochoric_second_piola" in
files): S_visc(t) = (1 - sum g_i) S(t) + sum Q_i(t) with dQ_i/dt + Q_i/tau_i = g_i dS/dt (Holzapfel, Nonlinear Solid
Mechanics, 2000, section 6.10; Simo, CMAME 60 (1987) 153).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter
from tissue_sim.public_names import OldName, with_old_names

#: Largest number of relaxing terms, drainage included; the finite elements store one stress for each.
MOST_TERMS = 13
#: Name, in files, of the stress that the hereditary integral acts on.
FORM: Final = "isochoric_second_piola"
#: Meanings of the parameters of a law.
MODULI = ("instantaneous", "long_term")


@dataclass(frozen=True)
class PronyTerm:
    """One term of a Prony series.

    Attributes:
        g: fraction of the instantaneous modulus that relaxes, above 0 and below 1.
        tau: relaxation time, s.
    """

    g: float = parameter("g", "1", key="g", bounds=(1e-6, 0.99), absent=0.0)
    tau: float = parameter("tau", "s", key="tau_s", bounds=(1e-4, 1e6))

    def __post_init__(self):
        if not 0 < self.g < 1:
            raise InputError(f"must be a fraction of the instantaneous modulus between 0 and 1; got {self.g:g}. Leave "
                             "the term out if nothing relaxes", field="g")
        if not 0 < self.tau < np.inf:
            raise InputError(f"must be a positive relaxation time; got {self.tau:g} s.", field="tau")


class RelaxationSeries:
    """Relaxation by exponentials: relative relaxation modulus 1 - sum g_i (1 - exp(-t/tau_i)).

    Attributes:
        terms: terms of the series.
        moduli: meaning of the law's parameters, see `Prony`.
    """

    terms: tuple[PronyTerm, ...]
    moduli: Literal["instantaneous", "long_term"]

    def _require_known_moduli(self) -> None:
        """Raise an error if `moduli` is unknown."""
        if self.moduli not in MODULI:
            raise InputError(f"unknown {self.moduli!r}; known: {', '.join(MODULI)}", field="moduli")

    @property
    def g(self) -> np.ndarray:
        """Relaxing fractions g_i, shape (terms,)."""
        return np.array([term.g for term in self.terms])

    @property
    def tau(self) -> np.ndarray:
        """Relaxation times, s, shape (terms,)."""
        return np.array([term.tau for term in self.terms])

    @property
    def relaxing_fraction(self) -> float:
        """Sum of the relaxing fractions g_i, 1."""
        return float(sum(term.g for term in self.terms))

    @property
    def instantaneous_over_law_modulus_ratio(self) -> float:
        """Ratio of the instantaneous modulus to the law's: 1, or 1 / (1 - sum g_i) for long-term parameters."""
        return 1.0 if self.moduli == "instantaneous" else 1.0 / (1.0 - self.relaxing_fraction)

    def compute_relative_relaxation_modulus(self, time) -> np.ndarray:
        """Return relaxation modulus over instantaneous modulus, `time` s after a strain step, shape of `time`."""
        relaxed = -np.expm1(-np.asarray(time, dtype=float)[..., None] / self.tau)
        return 1.0 - relaxed @ self.g

    def compute_relative_complex_modulus(self, frequency) -> np.ndarray:
        """Return complex modulus over instantaneous modulus at `frequency` Hz, complex, shape of `frequency`.

        The value is 1 - sum g_i / (1 + i omega tau_i) with omega = 2 pi frequency.
        """
        omega = 2.0 * np.pi * np.asarray(frequency, dtype=float)[..., None]
        return 1.0 - (1.0 / (1.0 + 1j * omega * self.tau)) @ self.g

    def require_represented_frequencies(self, frequency: np.ndarray) -> None:
        """Raise an `InputError` for frequencies, Hz, at which the terms do not represent the relaxation; none here."""

    def compute_recursion_coefficients(self, dt) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the coefficients of Q_i^{n+1} = decay_i Q_i^n + gain_i (S^{n+1} - S^n), exact for S linear in time.

        Args:
            dt: length of the step, s, any shape; 0 for a sudden step, infinity for full relaxation.

        Returns:
            `instant` = 1 - sum g_i + sum gain_i, the fraction of a change of S that acts within the step, shape of
            `dt`; `decay` and `gain`, shape (*dt.shape, terms).

        Source: decay_i = exp(-dt/tau_i), gain_i = g_i (1 - exp(-dt/tau_i)) tau_i/dt (Taylor, Pister and Goudreau,
        IJNME 2 (1970) 45).
        """
        decay, gain = _compute_decay_and_gain_over_g(dt, self.tau)
        gain = self.g * gain
        return 1.0 - self.relaxing_fraction + gain.sum(axis=-1), decay, gain

    def solve_for_elastic_history(self, time: np.ndarray, response: np.ndarray) -> np.ndarray:
        """Solve the hereditary integral response = (1 - sum g_i) S + sum Q_i for S, linear between the points.

        Args:
            time: s, not decreasing, shape (n,); S is zero before the first point.
            response: values of the integral, one column for each right-hand side, shape (n, k).

        Returns:
            S, in the unit of `response`, shape (n, k).
        """
        instant, decay, gain = self.compute_recursion_coefficients(np.diff(time, prepend=time[:1]))
        elastic, now = np.empty_like(response), np.zeros(response.shape[1])
        internal = np.zeros((self.tau.size, response.shape[1]))
        for i, value in enumerate(response):
            internal *= decay[i][:, None]
            change = (value - (1.0 - self.relaxing_fraction) * now - internal.sum(axis=0)) / instant[i]
            internal += gain[i][:, None] * change
            now = now + change
            elastic[i] = now
        return elastic


@with_old_names(modulus="compute_relative_relaxation_modulus")
@dataclass(frozen=True)
class Prony(RelaxationSeries):
    """A Prony series with stated terms.

    Attributes:
        terms: 1 to 13 terms.
        moduli: meaning of the law's parameters: ``"instantaneous"`` (very fast loading) or ``"long_term"`` (very slow).
            The g_i are relative to the instantaneous modulus in both cases.

    Raises:
        InputError: no term or too many, g_i whose sum is 1 or more, unknown `moduli`.
    """

    terms: tuple[PronyTerm, ...]
    moduli: Literal["instantaneous", "long_term"] = "instantaneous"
    #: Old names.
    instantaneous_factor = OldName("instantaneous_over_law_modulus_ratio")
    relaxing = OldName("relaxing_fraction")
    increment = OldName("compute_recursion_coefficients")

    def __post_init__(self):
        object.__setattr__(self, "terms", tuple(self.terms))
        if not 1 <= len(self.terms) <= MOST_TERMS:
            raise InputError(f"must have 1 to {MOST_TERMS} terms; got {len(self.terms)}. Use fewer terms, or leave "
                             "viscoelasticity out",
                             field="terms")
        if not self.relaxing_fraction < 1:
            raise InputError(f"the sum of all g must be below 1, or no stress remains under constant strain; got "
                             f"{self.relaxing_fraction:g}.", field="terms")
        self._require_known_moduli()


def compute_internal_stress_history_over_g(dt: np.ndarray, elastic: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return Q_i / g_i at all points of a history of the elastic stress S, which is linear between the points.

    The stress is zero before the first point.

    Args:
        dt: time between each point and the previous point, s, shape (n,); the first entry is the time since rest.
        elastic: S, Pa, shape (n, components).
        tau: relaxation times, s, shape (terms,).

    Returns:
        Pa, shape (n, components, terms).
    """
    decay, gain = _compute_decay_and_gain_over_g(dt, tau)
    change = np.diff(elastic, axis=0, prepend=np.zeros_like(elastic[:1]))
    decay, Q = decay[:, None, :], gain[:, None, :] * change[:, :, None]
    # The recursion is a composition of affine maps; doubling the length of the compositions takes log2 n passes.
    shift = 1
    while shift < len(Q):
        Q = np.concatenate([Q[:shift], Q[shift:] + decay[shift:] * Q[:-shift]])
        decay = np.concatenate([decay[:shift], decay[shift:] * decay[:-shift]])
        shift *= 2
    return Q


def _compute_decay_and_gain_over_g(dt, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return decay_i and gain_i / g_i of steps of length dt, s; shapes (*dt.shape, terms)."""
    x = np.asarray(dt, dtype=float)[..., None] / tau
    return np.exp(-x), np.where(x > 0, -np.expm1(-x) / np.where(x > 0, x, 1.0), 1.0)


@with_old_names(term="make_prony_term")
@dataclass(frozen=True)
class Poroelasticity:
    """Drainage of pore fluid in reduced form: one relaxing term whose time grows with the size of the contact.

    Fluid leaves the loaded region by diffusion, with the time tau = a^2 / D and the contact radius a of each test: the
    radius of the specimen under a plate, the radius of a flat tool, and approximately the radius of the contact at the
    largest depth of a pointed tool. The pressure of the fluid is not computed.

    Attributes:
        phi: fraction of the instantaneous stiffness that is lost by drainage; 0 is absent.
        diffusivity: D, m^2/s.

    Source: scaling of Hu, Zhao, Vlassak and Suo, Appl. Phys. Lett. 96 (2010) 121904.
    """

    phi: float = parameter("phi", "1", key="phi", bounds=(1e-6, 0.99), absent=0.0)
    diffusivity: float = parameter("D", "m2/s", key="diffusivity_mm2_per_s", factor=1e-6, bounds=(1e-12, 1.0))

    def __post_init__(self):
        if not 0 <= self.phi < 1:
            raise InputError(f"must be a fraction of the stiffness from 0 to below 1; got {self.phi:g}.", field="phi")
        if not 0 < self.diffusivity < np.inf:
            raise InputError(f"must be positive and finite; got {self.diffusivity:g} m^2/s.", field="diffusivity")

    def make_prony_term(self, contact_radius: float | None) -> PronyTerm:
        """Return the relaxing term of a test with a contact radius, m; phi must be above 0.

        Raises:
            InputError: the radius is None, not positive or not finite.
        """
        if contact_radius is None:
            raise InputError("must be given, in m, for a material that drains.", field="contact_radius")
        if not 0 < contact_radius < np.inf:
            raise InputError(f"must be positive and finite; got {contact_radius:g} m.", field="contact_radius")
        return PronyTerm(self.phi, contact_radius**2 / self.diffusivity)
