"""Complex modulus of small oscillations about a pre-strain: the hereditary form of `histories`, linearised.

The nominal stress is P = w(l) S_visc, with the weights w of the deformation and the second Piola-Kirchhoff stress S.
In equilibrium at the pre-strain l, S_visc = (1 - sum g_i) S(l). A small oscillation of the stretch or shear strain with
the amplitude e changes the nominal stress by the amplitude E* e with

    E* = (1 - sum g_i) S dw/dl + (1 - sum g_i / (1 + i omega tau_i)) w dS/dl.

The real part is the storage modulus, the imaginary part the loss modulus. Both are amplitudes of the nominal stress
(force over undeformed area) over amplitudes of the nominal strain (change of length over undeformed length), also in
compression.

Source: Ferry, Viscoelastic Properties of Polymers, 3rd ed. 1980, chapter 3; oscillations about a pre-strain: Morman and
Nagtegaal, IJNME 19 (1983) 1079.
"""

from __future__ import annotations

import numpy as np

from tissue_sim.closed_form.deformation import DEFORMATIONS
from tissue_sim.closed_form.histories import require_homogeneous_material
from tissue_sim.errors import InputError
from tissue_sim.material.material import Material
from tissue_sim.material.softening import Softening

#: Step of the central differences of fourth order, stretch or shear strain. The error is about its fourth power.
DIFFERENCE_STEP = 5e-4
#: Difference from the largest energy at which the slope of the softening is evaluated, over the largest energy.
_ENERGY_STEP = 1e-6
#: Offsets of the central differences of fourth order in steps, and their weights.
_DIFFERENCES = np.array([[-2.0, -1.0, 0.0, 1.0, 2.0], [1.0 / 12.0, -8.0 / 12.0, 0.0, 8.0 / 12.0, -1.0 / 12.0]])


def complex_modulus(material: Material, frequency, mode: str = "uniaxial", abscissa: float | None = None,
                    contact_radius: float | None = None) -> np.ndarray:
    """Return storage modulus + i loss modulus of small oscillations about a pre-strain, Pa, complex, shape (n,).

    A material with a fractional Zener model is represented by its Prony series, as in simulations. With softening the
    modulus is that after the first cycle, whose largest strain the others do not exceed.

    Args:
        material: law, relaxation, drainage and softening; the material is treated as incompressible unless its law is
            compressible. Such a material is elastic, and its modulus is the slope of the nominal stress.
        frequency: Hz, shape (n,) or a number.
        mode: ``"uniaxial"`` (E' and E''), ``"simple_shear"`` (G' and G''), ``"planar"``, ``"equibiaxial"`` or
            ``"confined"``, without the bulk modulus unless it is that of the law. For a kind of test use
            `tissue_sim.closed_form.homogeneous.ClosedForm.complex_modulus`.
        abscissa: stretch, or shear strain, about which the specimen oscillates, fully relaxed; None: undeformed.
        contact_radius: radius of the specimen, m, for the time of drainage.

    Raises:
        InputError: an unknown mode or a mode with two stretches, a frequency that is not positive, an invalid
            pre-strain, a frequency outside of the window of a fractional Zener model, a material without closed form.

    Examples:
        >>> from tissue_sim import Material, Prony, PronyTerm
        >>> gel = Material("neo_hooke", {"C10": 1000.0}, viscoelastic=Prony((PronyTerm(0.3, 1.0),)))
        >>> modulus = complex_modulus(gel, [0.01, 1.0, 100.0], "simple_shear")
        >>> modulus.real.round(1), modulus.imag.round(1)  # from 1400 to 2000 Pa
        (array([1402.4, 1985.2, 2000. ]), array([37.6, 93.1,  1. ]))
    """
    form = DEFORMATIONS.get(mode)
    if form is None or form.count > 1:
        known = ", ".join(name for name, each in DEFORMATIONS.items() if each.count == 1)
        raise InputError(f"must be one of {known}; got {mode}.", field="mode")
    frequency = np.array(frequency, dtype=float, ndmin=1)
    if frequency.ndim != 1 or not ((frequency > 0.0) & np.isfinite(frequency)).all():
        raise InputError("must be positive and finite, one list in Hz.", field="frequency")
    rest = form.rest if abscissa is None else float(abscissa)
    if not np.isfinite(rest):
        raise InputError(f"must be finite; got {rest}.", field="abscissa")
    strain = rest + DIFFERENCE_STEP * _DIFFERENCES[0][:, None]
    form.require_valid(strain)
    require_homogeneous_material(material)
    if material.viscoelastic is not None:
        material.viscoelastic.require_represented_frequencies(frequency)
    law = material.energy_law
    if law.is_compressible:
        slope = float(law.nominal_stress_slope(rest, material.values, mode))
        return np.full(frequency.size, _require_inside_domain(slope, rest), dtype=complex)
    energy, stress = form.compute_energy_and_stress(law, material.values, strain)
    weights = form.compute_nominal_stress_weights(strain)[:, 0, :]
    rates = _DIFFERENCES[1] / DIFFERENCE_STEP
    stress_rate, factor = rates @ stress, material.instantaneous_over_law_modulus_ratio
    if material.softening is not None and rest != form.rest:
        slope = _compute_softening_slope(material.softening, factor * float(energy[2]))
        stress_rate = stress_rate + stress[2] * slope * factor * (rates @ energy)
    geometric, tangent = factor * float((rates @ weights) @ stress[2]), factor * float(weights[2] @ stress_rate)
    _require_inside_domain(geometric + tangent, rest)
    prony = material.make_prony_series(contact_radius)
    if prony is None:
        return np.full(frequency.size, geometric + tangent, dtype=complex)
    relative = prony.compute_relative_complex_modulus(frequency)
    return (1.0 - prony.relaxing_fraction) * geometric + tangent * relative


def _require_inside_domain(modulus: float, abscissa: float) -> float:
    """Return a modulus, Pa; raise an `InputError` if it is not finite, as outside of the domain of the law."""
    if not np.isfinite(modulus):
        raise InputError(f"must be inside the domain of the law; got {abscissa:g}.", field="abscissa")
    return modulus


def _compute_softening_slope(softening: Softening, energy: float) -> float:
    """Return the derivative of the softening factor with respect to the energy at its largest value, 1/(J/m3)."""
    step = _ENERGY_STEP * energy
    return float((1.0 - softening.factor(np.array([energy - step]), np.array([energy]))[0]) / step)
