"""Closed-form response of homogeneous tests with history: viscoelasticity, drainage and softening.

The specimen is incompressible and deforms homogeneously; see `tissue_sim.closed_form.deformation`. The hereditary
integral acts on components of the isochoric second Piola-Kirchhoff stress S, which is first softened and then relaxed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tissue_sim.closed_form.deformation import DEFORMATIONS, HomogeneousDeformation
from tissue_sim.errors import InputError
from tissue_sim.laws import Law
from tissue_sim.material.effect import PointEffect
from tissue_sim.material.material import Material
from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import RelaxationSeries, compute_internal_stress_history_over_g

#: Largest change of log(stretch), or of the shear strain, in a step within which S is linear in time; longer steps are
#: divided. The error of the force is proportional to its square: 3e-6 of the largest force in a ramp, hold and return
#: to strain 0.14 with tau 2 s.
LARGEST_STEP = 0.002


def compute_softened_second_piola_stress(deformation: HomogeneousDeformation, law: Law, values, strain: np.ndarray,
                                         factor: float, softening: Softening | None,
                                         largest_energy: float = 0.0) -> tuple[np.ndarray, float]:
    """Compute the elastic stress S with softening, without relaxation, along a path.

    Args:
        deformation: homogeneous deformation.
        law: strain energy.
        values: parameters of the law.
        strain: stretches or shear strains in order of time, shape (points, abscissas).
        factor: instantaneous moduli over those of `values`.
        softening: Mullins effect.
        largest_energy: largest energy density before the path, J/m3.

    Returns:
        Components of S, Pa, shape (points, components); and the largest energy density after the path, J/m3.
    """
    energy, S = deformation.compute_energy_and_stress(law, values, strain)
    if softening is not None:
        energy = factor * energy
        largest = np.maximum(np.maximum.accumulate(energy), largest_energy)
        S, largest_energy = S * softening.factor(energy, largest)[:, None], float(largest[-1])
    return factor * S, largest_energy


@dataclass(frozen=True, eq=False)
class StrainHistory:
    """Deformation of a homogeneous test against time, from rest, linear between its points.

    Attributes:
        mode: name in `DEFORMATIONS`.
        time: s, shape (n,), not decreasing; two points at the same time are a sudden step, and so is a first point
            that is not at rest.
        strain: stretch, or shear strain gamma, shape (n,); both stretches of the mode ``biaxial``: shape (n, 2).
        largest_step: largest change of log(stretch) or shear strain in a step; longer steps are divided.
        has_first_load_only: whether only the stress along the first abscissa is computed, shape (n,).

    Raises:
        InputError: another mode, different shapes, values that are not finite, decreasing time, a stretch of 0 or less.
    """

    mode: str
    time: np.ndarray
    strain: np.ndarray
    largest_step: float = LARGEST_STEP
    has_first_load_only: bool = False

    def __post_init__(self):
        if self.mode not in DEFORMATIONS:
            raise InputError(f"must be one of {', '.join(DEFORMATIONS)}; got {self.mode}. Leave the history of the "
                             "material out, or use another test.", field="mode")
        form = self.deformation
        time, strain = (np.array(values, dtype=float) for values in (self.time, self.strain))
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "strain", strain)
        shape = time.shape if form.count == 1 else (*time.shape, form.count)
        if time.ndim != 1 or strain.shape != shape or not time.size:
            both = "two lists of the same length" if form.count == 1 else f"lists of n and n x {form.count} values"
            raise InputError(f"time {time.shape} and {form.quantity} {strain.shape} must be {both}", field="time")
        for name, values in (("time", time), (form.quantity, strain)):
            if not np.isfinite(values).all():
                raise InputError("must be finite.", field=name)
        if (np.diff(time) < 0).any():
            raise InputError("must not decrease; sort the samples", field="time")
        form.require_valid(strain)

    @property
    def deformation(self) -> HomogeneousDeformation:
        """Deformation of the mode."""
        return DEFORMATIONS[self.mode]

    @cached_property
    def _divided_steps_strains_and_samples(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Time steps, strains (points, abscissas) of the divided history, and indices of the samples in it."""
        form, count = self.deformation, self.deformation.count
        strain = np.concatenate([np.full((1, count), form.rest), self.strain.reshape(-1, count)])
        time = np.concatenate([self.time[:1], self.time])
        size = np.abs(np.diff(form.measure_strain(strain), axis=0)).max(axis=1)
        parts = np.maximum(np.ceil(size / self.largest_step), 1).astype(int)
        last = np.cumsum(parts)
        number = np.arange(1, last[-1] + 1) - np.repeat(last - parts, parts)
        fraction = number / np.repeat(parts, parts)
        fine = np.repeat(strain[:-1], parts, axis=0) + fraction[:, None] * np.repeat(np.diff(strain, axis=0), parts,
                                                                                    axis=0)
        fine[last - 1] = strain[1:]
        return np.repeat(np.diff(time) / parts, parts), fine, last - 1

    @cached_property
    def _sample_weights(self) -> np.ndarray:
        """d(nominal stresses)/d(components of S) at the samples, shape (n, loads, components)."""
        _, strain, samples = self._divided_steps_strains_and_samples
        weights = self.deformation.compute_nominal_stress_weights(strain[samples])
        return weights[:, :1] if self.has_first_load_only else weights

    @property
    def _stress_shape(self) -> tuple[int, ...]:
        """Shape of the stresses at the samples."""
        return self.time.shape if self.has_first_load_only else self.strain.shape

    def nominal_stress(self, law: Law, values, prony: RelaxationSeries | None = None,
                       softening: Softening | None = None, factor: float = 1.0) -> np.ndarray:
        """Compute the nominal stress at the samples, Pa, shape of `strain`; of the first load only, shape (n,).

        Args:
            law: strain energy.
            values: parameters of the law.
            prony: relaxation; its `moduli` are ignored, `factor` is used instead.
            softening: Mullins effect.
            factor: instantaneous moduli over those of `values`.
        """
        tau = np.zeros(0) if prony is None else prony.tau
        elastic, relaxing = self.compute_elastic_and_relaxing_stress(law, values, tau, softening, factor)
        return elastic if prony is None else (1.0 - prony.relaxing_fraction) * elastic + relaxing @ prony.g

    def compute_elastic_and_relaxing_stress(self, law: Law, values, tau: np.ndarray, softening: Softening | None = None,
                                            factor: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Compute the elastic and relaxing contributions to P = (1 - sum g_i) elastic + sum g_i relaxing_i.

        Args:
            law: strain energy.
            values: parameters of the law.
            tau: relaxation times, s, shape (terms,).
            softening: Mullins effect.
            factor: instantaneous moduli over those of `values`.

        Returns:
            `elastic`, shape of `strain`, and `relaxing`, with an additional last axis of the terms, both in Pa at the
            samples.
        """
        dt, strain, samples = self._divided_steps_strains_and_samples
        stress, _ = compute_softened_second_piola_stress(self.deformation, law, values, strain, factor, softening)
        weights = self._sample_weights
        relaxing = compute_internal_stress_history_over_g(dt, stress, tau)[samples]
        elastic = np.einsum("nac,nc->na", weights, stress[samples])
        return elastic.reshape(self._stress_shape), np.einsum("nac,nct->nat", weights, relaxing).reshape(
            *self._stress_shape, len(tau))


def nominal_stress_history(material: Material, time, stretch, contact_radius: float | None = None) -> np.ndarray:
    """Nominal stress of a uniaxial test (lubricated compression or tension), Pa, negative in compression, shape (n,).

    Args:
        material: law, Prony series, drainage and softening; the material is treated as incompressible unless its law is
            compressible.
        time: s, shape (n,), not decreasing; the specimen is at rest before the first point.
        stretch: shape (n,), 1 undeformed, linear between the points.
        contact_radius: radius of the specimen, m, for the time of drainage.

    Raises:
        InputError: see `StrainHistory`; a material with layers, regions or effects at the points; a material that
            drains, without a contact radius.

    Source: Holzapfel, Nonlinear Solid Mechanics, 2000, sections 6.5 and 6.10.

    Examples:
        >>> from tissue_sim import Material, Prony, PronyTerm
        >>> gel = Material("neo_hooke", {"C10": 1000.0}, viscoelastic=Prony((PronyTerm(0.3, 2.0),)))
        >>> nominal_stress_history(gel, [0.0, 0.01, 10.0], [1.0, 0.9, 0.9]).round(1)
        array([   0. , -668.7, -469.8])
    """
    return compute_stress_history("uniaxial", material, time, stretch, contact_radius)


def shear_stress_history(material: Material, time, shear, contact_radius: float | None = None) -> np.ndarray:
    """Nominal shear stress P12 of simple shear, Pa, shape (n,); arguments and errors as in `nominal_stress_history`.

    P12 is the force along the sheared face over its undeformed area; it does not depend on the pressure.

    Examples:
        >>> from tissue_sim import Material, Prony, PronyTerm
        >>> gel = Material("neo_hooke", {"C10": 1000.0}, viscoelastic=Prony((PronyTerm(0.3, 2.0),)))
        >>> shear_stress_history(gel, [0.0, 0.01, 10.0], [0.0, 0.1, 0.1]).round(1)
        array([  0. , 199.9, 140.4])
    """
    return compute_stress_history("simple_shear", material, time, shear, contact_radius)


def compute_stress_history(mode: str, material: Material, time, strain, contact_radius: float | None) -> np.ndarray:
    """Compute the nominal stress of a mode of `StrainHistory`; arguments as in `nominal_stress_history`."""
    history = StrainHistory(mode, time, strain)
    require_homogeneous_material(material)
    if material.energy_law.is_compressible:
        # A material with such a law is elastic.
        return material.energy_law.nominal_stress(history.strain, material.values, mode)
    prony = material.make_prony_series(contact_radius)
    return history.nominal_stress(material.energy_law, material.values, prony, material.softening,
                                  material.instantaneous_over_law_modulus_ratio)


def require_homogeneous_material(material: Material) -> None:
    """Refuse a material without a closed form.

    Raises:
        InputError: regions, layers or effects at material points.
    """
    if material.regions:
        raise InputError("a specimen with regions does not deform homogeneously; use the finite elements",
                         field="regions")
    if material.layers:
        raise InputError("a layered specimen does not deform homogeneously; use the finite elements", field="layers")
    if added := [name for name, effect in material.effects.items() if isinstance(effect, PointEffect)]:
        raise InputError("must not be given, because closed forms do not include effects at material points. Use the "
                         "finite elements",
                         field=f"effects.{added[0]}")
