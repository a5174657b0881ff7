"""Strain of homogeneous tests with a prescribed nominal stress: creep and cycles between forces.

The specimen is incompressible and deforms homogeneously, as in `tissue_sim.closed_form.histories`. The strain at each
time is the root of the nominal stress of the hereditary integral, whose internal stresses are advanced from time to
time: Q_i -> exp(-dt/tau_i) Q_i + gain_i (S_new - S_old), exact for S linear in time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tissue_sim.closed_form.deformation import DEFORMATIONS
from tissue_sim.closed_form.histories import (
    LARGEST_STEP,
    compute_softened_second_piola_stress,
    require_homogeneous_material,
)
from tissue_sim.errors import InputError
from tissue_sim.material.material import Material
from tissue_sim.material.viscoelasticity import compute_internal_stress_history_over_g


@dataclass(frozen=True)
class CreepSettings:
    """Settings of the strain under a prescribed stress.

    Attributes:
        divisions: number of equal time steps between two points in a material that relaxes. The error is proportional
            to the square of the time step.
        tolerance: absolute tolerance of log(stretch) or shear strain, 1.
        first_step: smallest first change of log(stretch) or shear strain in the search for a bracket, 1.
        largest_strain: largest log(stretch) or shear strain of the search, 1.
    """

    divisions: int = 4
    tolerance: float = 1e-13
    first_step: float = 1e-6
    largest_strain: float = 3.0


#: Settings of every history.
CREEP = CreepSettings()


class _StressState:
    """State of a material point of a homogeneous test: internal stresses and largest energy density.

    Args:
        mode: mode of `StrainHistory` with one abscissa.
        material: the material.
        contact_radius: m, for the time of drainage.
        bulk_modulus: K, Pa, of a deformation with J = stretch; 0: constant volume.
    """

    def __init__(self, mode: str, material: Material, contact_radius: float | None, bulk_modulus: float):
        prony = material.make_prony_series(contact_radius)
        self._deformation, self._material, self._bulk_modulus = DEFORMATIONS[mode], material, bulk_modulus
        self._tau: np.ndarray = np.zeros(0) if prony is None else prony.tau
        self._g: np.ndarray = np.zeros(0) if prony is None else prony.g
        self.relaxes = prony is not None
        # Logarithm of the stretch, or shear strain, and its last change.
        self.strain, self.change = 0.0, 0.0
        components = self._deformation.compute_nominal_stress_weights(np.full((1, 1), self._deformation.rest)).size
        self._stress, self._internal = np.zeros(components), np.zeros((components, self._tau.size))
        self._energy = 0.0

    def to_abscissa(self, strain: np.ndarray | float) -> np.ndarray:
        """Return the stretch of its logarithm; a shear strain does not change."""
        return np.exp(strain) if self._deformation.rest else np.asarray(strain, dtype=float)

    def compute_step(self, strain: float, dt: float) -> tuple[float, tuple]:
        """Return the nominal stress, Pa, after a motion to a strain in dt s, and the state there for `commit_step`."""
        parts = max(1, int(np.ceil(abs(strain - self.strain) / LARGEST_STEP)))
        start, end = self.to_abscissa(self.strain), self.to_abscissa(strain)
        path = (start + (end - start) * np.arange(1, parts + 1) / parts)[:, None]
        material = self._material
        stress, energy = compute_softened_second_piola_stress(
            self._deformation, material.energy_law, material.values, path,
            material.instantaneous_over_law_modulus_ratio, material.softening, self._energy)
        internal = self._internal * np.exp(-dt / self._tau) + compute_internal_stress_history_over_g(
            np.full(parts, dt / parts), stress - self._stress, self._tau)[-1]
        total = (1.0 - self._g.sum()) * stress[-1] + internal @ self._g
        weights = self._deformation.compute_nominal_stress_weights(path[-1:])[0, 0]
        volumetric = self._bulk_modulus * (float(path[-1, 0]) - self._deformation.rest)
        return float(weights @ total) + volumetric, (strain, stress[-1], internal, energy)

    def commit_step(self, state: tuple) -> None:
        """Store the state of `compute_step`."""
        self.change = state[0] - self.strain
        self.strain, self._stress, self._internal, self._energy = state


def stretch_history(material: Material, time, nominal_stress, contact_radius: float | None = None) -> np.ndarray:
    """Stretch of a uniaxial test (lubricated compression or tension) with a prescribed stress, shape (n,).

    This is the inverse of `tissue_sim.closed_form.histories.nominal_stress_history`.

    Args:
        material: law, Prony series, drainage and softening; the material is treated as incompressible.
        time: s, shape (n,), not decreasing; the specimen is at rest before the first point.
        nominal_stress: Pa, shape (n,), negative in compression, linear between the points. Two points at the same time
            are a sudden step, and so is a first point with a stress.
        contact_radius: radius of the specimen, m, for the time of drainage.

    Raises:
        InputError: different shapes, values that are not finite, decreasing time, a stress that the material does not
            reach; a material with layers, regions or effects at the points; a material that drains, without a contact
            radius.

    Source: hereditary integral of Holzapfel, Nonlinear Solid Mechanics, 2000, section 6.10.

    Examples:
        >>> from tissue_sim import Material, Prony, PronyTerm
        >>> gel = Material("neo_hooke", {"C10": 1000.0}, viscoelastic=Prony((PronyTerm(0.3, 2.0),)))
        >>> stretch_history(gel, [0.0, 0.01, 60.0], [0.0, -600.0, -600.0]).round(4)
        array([1.    , 0.9093, 0.8756])
    """
    return compute_strain_history("uniaxial", material, time, nominal_stress, contact_radius)


def shear_strain_history(material: Material, time, shear_stress, contact_radius: float | None = None) -> np.ndarray:
    """Shear strain of simple shear with a prescribed nominal shear stress, shape (n,); as `stretch_history`."""
    return compute_strain_history("simple_shear", material, time, shear_stress, contact_radius)


def compute_strain_history(mode: str, material: Material, time, nominal_stress,
                           contact_radius: float | None, bulk_modulus: float = 0.0) -> np.ndarray:
    """Compute stretch or shear strain of a mode of `StrainHistory` with one abscissa; see `stretch_history`.

    Args:
        mode: mode of `StrainHistory`.
        material: see `stretch_history`.
        time: see `stretch_history`.
        nominal_stress: see `stretch_history`.
        contact_radius: see `stretch_history`.
        bulk_modulus: K, Pa, if the volume changes by the stretch; 0: constant volume.
    """
    known = [name for name, each in DEFORMATIONS.items() if each.count == 1]
    if mode not in known:
        raise InputError(f"must be one of {', '.join(known)}; got {mode}. Use another test.", field="mode")
    time, stress = np.asarray(time, dtype=float), np.asarray(nominal_stress, dtype=float)
    if time.ndim != 1 or time.shape != stress.shape or not time.size:
        raise InputError(f"time {time.shape} and nominal stress {stress.shape} must be two lists of the same length",
                         field="time")
    for name, values in (("time", time), ("nominal stress", stress)):
        if not np.isfinite(values).all():
            raise InputError("must be finite.", field=name)
    if (np.diff(time) < 0).any():
        raise InputError("must not decrease; sort the samples", field="time")
    require_homogeneous_material(material)
    if material.energy_law.is_compressible:
        raise InputError(f"must prescribe the deformation with the law {material.law}; got a stress. Prescribe a "
                         "displacement, or use a law with a bulk response", field="protocol")
    state, strains = _StressState(mode, material, contact_radius, bulk_modulus), []
    now, acting = time[0], 0.0
    for later, aim in zip(time.tolist(), stress.tolist(), strict=True):
        parts = CREEP.divisions if state.relaxes and later > now else 1
        for part in range(1, parts + 1):
            _advance_to_stress(state, acting + (aim - acting) * part / parts, (later - now) / parts)
        now, acting = later, aim
        strains.append(state.strain)
    return state.to_abscissa(np.array(strains))


def _advance_to_stress(state: _StressState, stress: float, dt: float) -> None:
    """Move to the strain at which the nominal stress has a value, Pa, after dt s.

    Raises:
        InputError: no strain up to `CreepSettings.largest_strain` has this stress.
    """
    from scipy.optimize import brentq

    def residual(strain: float) -> float:
        return state.compute_step(strain, dt)[0] - stress

    low, high = _find_bracket(residual, state.strain, max(CREEP.first_step, abs(state.change)))
    if low is None or high is None:
        raise InputError(f"must be a stress that the material reaches at strains up to {CREEP.largest_strain:g}; got "
                         f"{stress:.6g} Pa. Use a smaller stress", field="nominal_stress")
    strain = low if low == high else brentq(residual, low, high, xtol=CREEP.tolerance, rtol=4.0 * np.finfo(float).eps)
    state.commit_step(state.compute_step(strain, dt)[1])


def _find_bracket(residual: Callable[[float], float], start: float,
                  step: float) -> tuple[float, float] | tuple[None, None]:
    """Return strains between which a residual changes its sign, from `start` on in steps that double from `step` on.

    At the limit of the domain of a law, where the residual is not finite, the step is halved.
    """
    at_start = residual(start)
    if at_start == 0.0:
        return start, start
    before, step, grows = start, -float(np.sign(at_start)) * step, True
    while abs(before) < CREEP.largest_strain and abs(step) > CREEP.tolerance:
        here = before + step
        found = residual(here)
        if not np.isfinite(found):
            step, grows = 0.5 * step, False
        elif found * at_start <= 0.0:
            return before, here
        else:
            before, step = here, 2.0 * step if grows else step
    return None, None
