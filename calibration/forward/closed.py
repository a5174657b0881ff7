"""Closed-form forward model of homogeneous tests on incompressible materials, with derivatives.

A column whose stretch varies with height is the closed form of lubricated compression with self-weight.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.contract import InfeasibleError, StretchRange
from calibration.forward.motion import DIFFERENCES
from calibration.forward.simulation_cache import SimulationCache
from tissue_sim.closed_form.column import Column
from tissue_sim.closed_form.deformation import DEFORMATIONS
from tissue_sim.closed_form.histories import LARGEST_STEP, StrainHistory
from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import TestKind
from tissue_sim.laws import Law, find_law
from tissue_sim.laws.modes import STRETCH_MODES
from tissue_sim.material.material import Material
from tissue_sim.parameters import split_path_into_names_and_indices
from tissue_sim.specimen import Specimen


@dataclass(frozen=True, eq=False)
class ClosedFormParameters:
    """Parameter values for `ClosedFormTest.evaluate_force_and_derivatives`.

    Attributes:
        space: parameter space.
        law: strain energy.
        values: parameters of the law, SI, shape (m,).
        free: for each free parameter of the law its index in `values` and its index among the free parameters.
        named: name -> value of all parameters, SI.
        recording: name of the recording that has these values; None: all recordings.
        material: material with memory (relaxation, softening, ...); None: the stress has no history.
        bulk_modulus: K, Pa, if the closed form depends on it, otherwise 0.
        bulk_derivatives: derivatives of K with respect to the free parameters, shape (p,).
    """

    space: ParameterSpace
    law: Law
    values: np.ndarray
    free: list[tuple[int, int]]
    named: dict[str, float]
    recording: str | None
    material: Material | None
    bulk_modulus: float
    bulk_derivatives: np.ndarray


@dataclass(eq=False)
class ClosedFormTest:
    """Forward model in closed form: lubricated compression, tension or shear of an incompressible material.

    Attributes:
        name: name of the test.
        kind: kind of the test. The force of a plate that is not gripped is zero before contact.
        height: height of the specimen, m.
        area: cross-section, m2.
        measured: recordings of the test.
        largest_step: largest strain step of a history, see `StrainHistory`.
        specimen: specimen with self-weight; None in this class.
    """

    name: str
    kind: TestKind
    height: float
    area: float
    measured: tuple[MeasuredCurve, ...]
    largest_step: float = LARGEST_STEP
    specimen: Specimen | None = None
    _histories: dict[int, StrainHistory] = field(default_factory=dict, repr=False, init=False)

    is_homogeneous: ClassVar[bool] = True
    mesh_key: ClassVar[str] = ""

    @property
    def is_force_proportional_to_moduli(self) -> bool:
        """Whether the force is proportional to the moduli of the law; not if it depends on a bulk modulus."""
        return not self.closed_form.needs_bulk

    @property
    def has_reversals_or_holds(self) -> bool:
        """Whether any recording has several segments, such as a ramp and a hold; the material does not matter."""
        return any(curve.segment is not None and np.unique(curve.segment).size > 1 for curve in self.measured)

    @property
    def equivalent_radius(self) -> float:
        """Radius of the circle whose area is the cross-section of the specimen, m."""
        return float(np.sqrt(self.area / np.pi))

    @property
    def counterpart_without_self_weight(self) -> ClosedFormTest:
        """This test itself, since it has no self-weight."""
        return self

    @property
    def closed_form(self) -> ClosedForm:
        """Closed form (stress as a function of strain) of the kind of test."""
        return self.kind.require_closed_form()

    @property
    def largest_strain_or_none(self) -> float | None:
        """Largest I1 - 3 of the recordings in contact; see `ForwardTest.largest_strain_or_none`."""
        abscissa = np.concatenate([self._compute_abscissa(curve) for curve in self.measured])
        if not self.kind.has_gripped_ends:
            abscissa = abscissa[self.kind.convert_abscissa_to_nominal_strain(abscissa) >= 0.0]
        return float((self.closed_form.compute_first_invariant(abscissa) - 3.0).max(initial=0.0))

    def solve(self, space: ParameterSpace, theta: np.ndarray, solves: SimulationCache) -> list[ClosedFormParameters]:
        """Return the parameter values of each recording for `evaluate_force_and_derivatives`; computes no force yet."""
        values, solutions = space.get_values_by_name(theta), {}
        marks = [space.get_recording_if_it_has_own_values(self.name, curve.name) for curve in self.measured]
        for mark in marks:
            if mark not in solutions:
                solutions[mark] = self._build_parameter_values(space, values, mark)
        return [solutions[mark] for mark in marks]

    def _build_parameter_values(self, space: ParameterSpace, values: dict[str, float],
                                recording: str | None) -> ClosedFormParameters:
        """Return the parameter values of one recording, given by name.

        `recording` is None for all recordings that share the parameters of the test.
        """
        law = find_law(space.law)
        free = [(law.parameters.index(each.path), column) for column, each in enumerate(space.free_parameters)
                if each.is_law_parameter and each.applies_to_recording(self.name, recording)]
        material = None
        needs_material = self.closed_form.needs_bulk and not law.is_compressible
        if needs_material or set(space.names) != set(law.parameters):
            try:
                material = space.build_material(values, test=self.name, recording=recording)
            except InputError as error:
                raise InfeasibleError(f"{self.name}: {error}") from None
        numbers = values if material is None else material.parameters
        bulk_modulus, derivatives = 0.0, np.zeros(len(space.free))
        if needs_material and material is not None:
            bulk_modulus = material.bulk_modulus
            derivatives = self._differentiate_bulk_modulus(space, values, recording)
        return ClosedFormParameters(space, law, np.array([numbers[name] for name in law.parameters]), free, values,
                                    recording,
                                    material if material is not None and material.is_history_dependent else None,
                                    bulk_modulus, derivatives)

    def _differentiate_bulk_modulus(self, space: ParameterSpace, values: dict[str, float],
                                    recording: str | None) -> np.ndarray:
        """Return the derivatives of K with respect to the free parameters by central differences, shape (p,)."""
        steps = DIFFERENCES.relative * space.compute_typical_parameter_sizes(values)
        found = np.zeros(len(space.free))
        for k, (name, step) in enumerate(zip(space.free, steps, strict=True)):
            try:
                above, below = (space.build_material(values | {name: values[name] + change}, test=self.name,
                                                     recording=recording).bulk_modulus for change in (step, -step))
            except InputError as error:
                raise InfeasibleError(f"{self.name}: {error}") from None
            found[k] = (above - below) / (2.0 * step)
        return found

    def evaluate_force_and_derivatives(self, answers: list[ClosedFormParameters], recording: int, offset: float,
                                       contact: bool = True):
        """Return the force and its derivatives with respect to the free parameters and the contact offset.

        See `ForwardTest.evaluate_force_and_derivatives` for units and shapes.

        Args:
            answers: solutions of the recordings from `solve`.
            recording: index in `measured`.
            offset: contact offset, m.
            contact: whether the derivative with respect to the contact offset is computed; otherwise it is None. It is
                zero for a curve without a contact offset.
        """
        answer, measured = answers[recording], self.measured[recording]
        differentiates = contact and measured.has_contact_offset
        force, rates, rate = self._evaluate_elastic_force_and_derivatives(
            answer, measured.subtract_contact_offset(offset), differentiates) \
            if answer.material is None else self._evaluate_force_with_memory(answer, answer.material, recording, offset,
                                                                             differentiates)
        if contact and not differentiates:
            rate = np.zeros_like(force)
        if not (np.isfinite(force).all() and np.isfinite(rates).all()):
            raise InfeasibleError(f"{self.name}: {answer.law.name} gives no finite stress")
        return force, rates, rate

    def remove_memory(self, answers: list[ClosedFormParameters], recording: int, columns: np.ndarray) -> np.ndarray:
        """Return the elastic parts of changes of the force; see `ForwardTest.remove_memory`."""
        material = answers[recording].material
        series = None if material is None else material.make_prony_series(self.equivalent_radius)
        if series is None:
            return columns
        return series.solve_for_elastic_history(self.measured[recording].sample_times, columns)

    def list_finite_difference_parameters(self, answers: list[ClosedFormParameters]) -> frozenset[str]:
        """Return the names of the free parameters whose derivatives are finite differences, not exact ones."""
        names: set[str] = set()
        for i, answer in enumerate(answers):
            if answer.material is not None:
                exact = self._compute_prony_derivatives_or_empty(answer, answer.material, i, 0.0)
                names |= {name for name in answer.space.free if name not in exact or name.endswith(".tau")}
        return frozenset(names)

    def _evaluate_elastic_force_and_derivatives(self, answer: ClosedFormParameters, curve: MeasuredCurve,
                                                contact: bool):
        """Return force (n,), derivatives with respect to the free parameters (n, p) and the contact offset (n,).

        The material is elastic; the motion of `curve` is measured from contact. The last value is None if `contact` is
        false.
        """
        law, values, closed_form = answer.law, answer.values, self.closed_form
        strain = self._compute_abscissa(curve)
        # Trial values of the optimiser may overflow; the optimiser rejects forces that are not finite.
        with np.errstate(all="ignore"):
            stress = closed_form.stress(law, strain, values)
            derivatives = closed_form.stress_parameter_derivatives(law, strain, values)
            slope = -self.kind.sign * closed_form.slope(law, strain, values) / self.height if contact else None
        rates_of_bulk = np.zeros((stress.size, len(answer.space.free)))
        if closed_form.needs_bulk:
            stress = stress + answer.bulk_modulus * (strain - 1.0)
            rates_of_bulk = (strain - 1.0)[:, None] * answer.bulk_derivatives
            if slope is not None:
                slope = slope - self.kind.sign * answer.bulk_modulus / self.height
        if not self.kind.has_gripped_ends:
            separated = self.kind.convert_abscissa_to_nominal_strain(strain) < 0.0
            stress[separated], derivatives[separated], rates_of_bulk[separated] = 0.0, 0.0, 0.0
            if slope is not None:
                slope[separated] = 0.0
        force, rates, rate = self._convert_to_force(answer, stress, derivatives, slope)
        return force, rates + self.kind.sign * self.area * rates_of_bulk, rate

    def _convert_to_force(self, answer: ClosedFormParameters, stress: np.ndarray, derivatives: np.ndarray,
                          slope: np.ndarray | None):
        """Convert nominal stress and its derivatives to force and derivatives with respect to the free parameters.

        Args:
            answer: parameter values.
            stress: nominal stress, Pa, shape (n,).
            derivatives: derivatives of the stress with respect to the parameters of the law, shape (n, m).
            slope: derivative of the stress with respect to the contact offset, Pa/m, shape (n,), or None.
        """
        rates = np.zeros((stress.size, len(answer.space.free)))
        if answer.free:
            of_law, of_fit = zip(*answer.free, strict=True)
            rates[:, of_fit] = derivatives[:, of_law]
        factor = self.kind.sign * self.area
        return factor * stress, factor * rates, None if slope is None else factor * slope

    def _evaluate_force_with_memory(self, answer: ClosedFormParameters, material: Material, recording: int,
                                    offset: float, contact: bool):
        """Return the same quantities as `_evaluate_elastic_force_and_derivatives` for a material with memory."""
        try:
            force = self._compute_force_with_memory(material, recording, offset)
        except InputError as error:
            raise InfeasibleError(f"{self.name}: {error}") from None
        rates = np.full((force.size, len(answer.space.free)), np.nan)
        exact = self._compute_prony_derivatives_or_empty(answer, material, recording, offset)
        for k, name in enumerate(answer.space.free):
            rates[:, k] = exact[name] if name in exact else self._compute_force_difference_quotient(answer, recording,
                                                                                                    offset, k, force)
        if not contact:
            return force, rates, None
        step = DIFFERENCES.relative * self.height
        above, below = (self._compute_force_with_memory(material, recording, offset + change)
                        for change in (step, -step))
        return force, rates, (above - below) / (2 * step)

    def _compute_prony_derivatives_or_empty(self, answer: ClosedFormParameters, material: Material, recording: int,
                                            offset: float) -> dict[str, np.ndarray]:
        """Return derivatives of the force with respect to moduli, g_i and tau_i; empty unless a pure Prony material.

        The nominal stress P = (1 - sum g_i) P_elastic + sum g_i P_relaxing(tau_i) is linear in the moduli and in g_i,
        which gives exact derivatives. Derivatives by tau_i are central differences of P_relaxing. Derivatives by
        exponents are not included.

        Returns:
            Name of the parameter -> derivative, shape (n,).
        """
        prony = material.viscoelastic
        if prony is None or not self._supports_homogeneous_history or (
                not answer.space.has_only_shared_material_parameters) or (
                material.effects or material.softening is not None or material.poroelasticity is not None) or (
                material.instantaneous_over_law_modulus_ratio != 1.0):
            return {}
        law, history = answer.law, self.get_homogeneous_history(recording, offset)
        count, factor = prony.tau.size, self.kind.sign * self.area
        step = DIFFERENCES.relative * prony.tau
        rates = {}
        with np.errstate(all="ignore"):
            times = np.concatenate([prony.tau, prony.tau + step, prony.tau - step])
            elastic, relaxing = history.compute_elastic_and_relaxing_stress(law, answer.values, times)
            for unknown in answer.space.free_parameters:
                name, path = unknown.name, split_path_into_names_and_indices(unknown.path)
                if unknown.is_law_parameter and law.units[unknown.path] != "1":
                    alone = [float(other == unknown.path) if law.units[other] != "1" else value
                             for other, value in zip(law.parameters, answer.values.tolist(), strict=True)]
                    rates[name] = factor * history.nominal_stress(law, np.array(alone), prony)
                elif "terms" in path:
                    i = int(path[-2])
                    rates[name] = factor * (relaxing[:, i] - elastic) if path[-1] == "g" else \
                        factor * prony.g[i] * (relaxing[:, count + i] - relaxing[:, 2 * count + i]) / (2 * step[i])
        return rates

    def _compute_force_difference_quotient(self, answer: ClosedFormParameters, recording: int, offset: float,
                                           index: int, force: np.ndarray) -> np.ndarray:
        """Return the derivative of the force with respect to one free parameter by finite differences, shape (n,).

        The difference is one-sided if the material is invalid on one side, and NaN if it is invalid on both sides.
        """
        space, values, name = answer.space, answer.named, answer.space.free[index]
        size, ends = float(space.compute_typical_parameter_sizes(values)[index]), []
        for step in (DIFFERENCES.relative * size, -DIFFERENCES.relative * size):
            try:
                material = space.build_material(values | {name: values[name] + step}, test=self.name,
                                                recording=answer.recording)
                ends.append((self._compute_force_with_memory(material, recording, offset), step))
            except InputError:
                # The value is at a bound of the material: the difference is one-sided.
                ends.append((force, 0.0))
        (above, high), (below, low) = ends
        return (above - below) / (high - low) if high > low else np.full(force.size, np.nan)

    def _compute_force_with_memory(self, material: Material, recording: int, offset: float) -> np.ndarray:
        """Return the force of a material with memory at the samples of a recording, N, shape (n,)."""
        measured, factor = self.measured[recording], self.kind.sign * self.area
        with np.errstate(all="ignore"):
            if not self._supports_homogeneous_history or material.effects:
                strain = self._compute_abscissa(measured.subtract_contact_offset(offset))
                return factor * self.closed_form.stress_history(material, measured.sample_times, strain,
                                                                self.equivalent_radius)
            return factor * self.get_homogeneous_history(recording, offset).nominal_stress(
                material.energy_law, material.values, material.make_prony_series(self.equivalent_radius),
                material.softening, material.instantaneous_over_law_modulus_ratio)

    @property
    def _supports_homogeneous_history(self) -> bool:
        """Whether `StrainHistory` can compute the stress."""
        form = self.closed_form
        return (type(form) is ClosedForm or form.is_first_load_of_mode) and form.law_mode in DEFORMATIONS

    def get_homogeneous_history(self, recording: int, offset: float = 0.0) -> StrainHistory:
        """Return the deformation history of the specimen in a recording; cached if the contact offset is 0."""
        if offset == 0.0 and recording in self._histories:
            return self._histories[recording]
        measured = self.measured[recording]
        found = StrainHistory(self.closed_form.law_mode, measured.sample_times,
                              self._compute_abscissa(measured.subtract_contact_offset(offset)),
                              self.largest_step, self.kind.has_several_motions)
        if offset == 0.0:
            self._histories[recording] = found
        return found

    def _compute_abscissa(self, curve: MeasuredCurve) -> np.ndarray:
        """Return the stretch or shear strain at the samples, shape (n,); of several motions all, shape (n, k)."""
        if curve.motions is not None:
            return curve.motions
        return self.convert_displacement_to_stretch_or_shear(curve.displacement)

    def convert_displacement_to_stretch_or_shear(self, displacement: np.ndarray) -> np.ndarray:
        """Return the stretch (in shear: the shear strain) at displacements in m; same shape as the displacements."""
        return self.kind.convert_nominal_strain_to_stretch_or_shear_strain(displacement / self.height)

    def update_mesh_force_difference_and_get_ratio(self, space: ParameterSpace, theta: np.ndarray,
                                                   solves: SimulationCache) -> float:
        """Return 0 and change nothing: a closed form has no mesh error."""
        return 0.0

    def discard_mesh_correction(self) -> None:
        """Do nothing: a closed form has no mesh correction."""

    def compute_stretch_range(self, space: ParameterSpace, theta: np.ndarray) -> StretchRange:
        """Return the range of stretches; see `ForwardTest.compute_stretch_range`."""
        strain = np.concatenate([self._compute_abscissa(curve) for curve in self.measured])
        low, high, closed_form = float(strain.min()), float(strain.max()), self.closed_form
        if self.kind.has_several_motions:
            principal = STRETCH_MODES[closed_form.law_mode].compute_principal_stretches(strain)
            return StretchRange(None, low, high, (float(principal.min()), float(principal.max())))
        if not closed_form.rest:
            return StretchRange(closed_form.mode, *closed_form.find_extreme_stretches(low, high),
                                closed_form.find_extreme_stretches(low, high))
        low, high = min(low, 1.0), 1.0 if not self.kind.has_gripped_ends else max(high, 1.0)
        return StretchRange(closed_form.mode, low, high, closed_form.find_extreme_stretches(low, high))


@dataclass(eq=False)
class ColumnTest(ClosedFormTest):
    """Forward model of the lubricated compression of a column that has settled under its own weight.

    The displacement counts from the settled state; the height is the stated height.

    Attributes:
        specimen: specimen with density and gravity.
        reserve: displacement beyond the deepest sample up to which the curve is solved, m. It equals the largest
            contact offset, so that all recordings and offsets use the same curve.
    """

    specimen: Specimen = field(kw_only=True)
    reserve: float = 0.0

    @property
    def is_force_proportional_to_moduli(self) -> bool:
        """False, because the weight does not change with the moduli."""
        return False

    @property
    def counterpart_without_self_weight(self) -> ClosedFormTest:
        """Closed form of the same test without self-weight."""
        return ClosedFormTest(self.name, self.kind, self.height, self.area, self.measured)

    def _evaluate_elastic_force_and_derivatives(self, answer: ClosedFormParameters, curve: MeasuredCurve,
                                                contact: bool):
        """Return the same quantities as in `ClosedFormTest`, for a column that has settled under its weight."""
        column, law, values = Column(self.specimen), answer.law, answer.values
        deepest = max(float(curve.displacement.max()) for curve in self.measured) + self.reserve
        # With the deepest point appended, the column is solved at the same states for every offset.
        moved = np.append(curve.displacement, deepest)
        stress = column.nominal_stress(law, moved, values)[:-1]
        slope = -column.stress_displacement_slope(law, moved, values)[:-1] if contact else None
        derivatives = column.nominal_stress_parameter_derivatives(law, moved, values)[:-1]
        if not np.isfinite(stress).all():
            raise InfeasibleError(f"{self.name}: {law.name} has no equilibrium of the specimen under its weight at the "
                                  "largest displacement")
        return self._convert_to_force(answer, stress, derivatives, slope)

    def compute_stretch_range(self, space: ParameterSpace, theta: np.ndarray) -> StretchRange:
        """Return the range of stretches, from that of the base in the deepest state to 1 at the unloaded top."""
        law, values = find_law(space.law), space.select_law_parameter_values(space.get_values_by_name(theta), self.name)
        displacement = np.concatenate([curve.displacement for curve in self.measured])
        base = Column(self.specimen).base_stretch_at_displacement(law, displacement,
                                                                  law.convert_parameters_to_array(values))
        low = float(np.nanmin(base))
        return StretchRange(self.closed_form.mode, low, 1.0, self.closed_form.find_extreme_stretches(low, 1.0))
