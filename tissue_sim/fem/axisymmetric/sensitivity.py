"""Exact derivatives of the force with respect to material, friction and sizes, by direct differentiation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.axisymmetric import newton
from tissue_sim.fem.axisymmetric.array_layouts import RATE_ARRAYS, SensitivityControlIndex, StoredPointRecordOffset
from tissue_sim.fem.axisymmetric.contact import ContactLinearisationColumn
from tissue_sim.fem.axisymmetric.contact_kernels import HELD, TOUCHED
from tissue_sim.fem.axisymmetric.equations import EquilibriumEquations
from tissue_sim.fem.axisymmetric.sensitivity_kernel import make_force_and_state_sensitivity_kernels
from tissue_sim.fem.axisymmetric.shape_sensitivity import ShapeDerivative, add_shape_derivatives
from tissue_sim.fem.history import (
    RelaxationSofteningCoefficient,
    get_softening_coefficients,
    shift_points_from_softening_kink,
)
from tissue_sim.fem.solver import ExperimentDerivatives, Neighbours
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.origins import allocate_array, copy_to_addressable_array
from tissue_sim.fem.taichi.runtime import LANES


@dataclass(frozen=True)
class SensitivityReuseSettings:
    """Settings of the sensitivities: when the factorisation of the step is reused, and how much is stored.

    Attributes:
        max_refined: maximum number of parameters for which iterative refinement with the factorisation of the step is
            cheaper than a factorisation of the exact tangent.
        max_refined_slip: the same with slip, where the matrix is unsymmetric and a factorisation costs twice as much.
        stored_step_lengths: maximum number of step lengths for which the derivatives of the relaxation are stored. A
            larger number takes more memory and computes the derivatives less often.
    """

    max_refined: int = 2
    max_refined_slip: int = 4
    stored_step_lengths: int = 64


#: Settings of all derivatives.
SETTINGS = SensitivityReuseSettings()


class MaterialSensitivity:
    """Derivatives of a solver's state and force with respect to parameters of material, friction and geometry.

    In each step, R_y dy = -(R_theta + R_h dh) is solved with the exact tangent R_y; see `sensitivity_kernel`.

    Args:
        equations: equations of a solver before its first step.
        neighbours: pairs of materials around each parameter and their difference. The derivatives of coefficients,
            bulk modulus, relaxation, softening and layers are central differences of these formulas, exact to about
            ten digits.
        experiments: derivatives of the inputs from the experiment with respect to each parameter; None: zero.

    Attributes:
        force: dF/dtheta at the last committed step, N per unit of the parameter, shape (parameters,).
    """

    def __init__(self, equations: EquilibriumEquations, neighbours: Neighbours,
                 experiments: Sequence[ExperimentDerivatives] | None = None):
        self._equations = equations
        m, memory, surface = len(neighbours), equations.memory, equations.surface
        terms = len(memory.internal)
        experiments = experiments or [ExperimentDerivatives()] * m
        sides = [(equations, equations) if each.neighbour_solvers is None else
                 tuple(solver.equations for solver in each.neighbour_solvers) for each in experiments]
        #: Index of a parameter of the geometry -> derivative of the equations.
        self._shapes = {k: ShapeDerivative(equations, sides[k], neighbours[k][2])
                        for k, each in enumerate(experiments) if each.neighbour_solvers is not None}
        # Drainage depends on the contact radius.
        self._relaxations = [(more.get_prony_series_for_contact_radius(up),
                              less.get_prony_series_for_contact_radius(down), width)
                             for (more, less), (up, down, width) in zip(sides, neighbours, strict=True)]
        self._past_rates = allocate_array((m, len(RelaxationSofteningCoefficient)))
        self._failures = self._pause = 0
        self._stored: dict[float, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        self._decay, self._gain = (allocate_array((terms,)) for _ in range(2))
        self._decay_rates, self._gain_rates = (allocate_array((m, terms)) for _ in range(2))
        shape = (m, *surface.springs.shape, 2)
        (self._multiplier_rates, self._anchor_rates, self._point_rates, self._fixed_force_rates,
         self._constraint_rates) = (allocate_array(shape) for _ in range(5))
        for k, derivative in self._shapes.items():
            self._anchor_rates[k] = derivative.first_anchor_rates
        frictions = np.array([each[:3] for each in experiments])
        face, shaft, base = frictions.reshape(m, 3, 1).swapaxes(0, 1)
        #: Derivatives of the friction of each point on the face and on the shaft of its body, shape (m, points).
        self._face_friction_rates, self._shaft_friction_rates = (np.where(surface.moves, at_tool, base)
                                                                 for at_tool in (face, shaft))
        self.force, self._changed = allocate_array((m,)), False
        self._contact = np.zeros((3, *surface.springs.shape))
        self._which = np.zeros(len(SensitivityControlIndex), np.int32)
        kernels = make_force_and_state_sensitivity_kernels(equations.mesh.element.name,
                                                           equations.material.energy_law.kernel_energy,
                                                           memory.works, surface.has_coulomb_friction_points)
        self._arrays = arrays = {
            **self._differentiate_material_inputs(neighbours), **self._allocate_point_derivatives_by_name(m, terms),
            "past_rates": self._past_rates, "decay": self._decay, "gain": self._gain,
            "decay_rates": self._decay_rates, "gain_rates": self._gain_rates,
            "multiplier_rates": self._multiplier_rates, "anchor_rates": self._anchor_rates,
            "point_rates": self._point_rates, "force_rates": self.force,
            "fixed_force_rates": self._fixed_force_rates, "constraint_rates": self._constraint_rates,
            "motion": allocate_array((equations.equation.size + equations.residual.size,)),
            "forces": allocate_array((m, equations.residual.size)), "dx": allocate_array((m, equations.equation.size))}
        arguments = {"which": self._which, "rate_table": RATE_ARRAYS.make_offset_table(arrays),
                     **equations.collect_shared_kernel_arrays_by_name()}
        self._factorise_and_differentiate_forces, self._differentiate_state = (
            BoundKernel.bind_by_name(kernel, arguments) for kernel in kernels)

    def _differentiate_material_inputs(self, neighbours: Neighbours) -> dict[str, np.ndarray]:
        """Return the derivatives of law, bulk modulus, layers and memory with the parameters, by kernel names."""
        equations, m = self._equations, len(neighbours)
        inputs = equations.compute_law_coefficients_and_moduli(equations.material)
        rates = [np.zeros((m, *np.shape(array))) for array in inputs]
        for k, (up, down, width) in enumerate(neighbours):
            above, below = equations.compute_law_coefficients_and_moduli(
                up), equations.compute_law_coefficients_and_moduli(down)
            for rate, more, less in zip(rates, above, below, strict=True):
                rate[k] = (np.asarray(more) - np.asarray(less)) / width
            self._past_rates[k, RelaxationSofteningCoefficient.LOSS:] = (
                get_softening_coefficients(up.softening) - get_softening_coefficients(down.softening)) / width
        coefficient_rates, kappa_rates, self._past_rates[:, RelaxationSofteningCoefficient.FACTOR], moduli_rates = rates
        self._which[SensitivityControlIndex.LAYERED] = moduli_rates.any()
        self._which[SensitivityControlIndex.SOFTENS] = (equations.memory.past[RelaxationSofteningCoefficient.LOSS] != 0
                                                        or self._past_rates[:,
                                                                            RelaxationSofteningCoefficient.LOSS:].any())
        self._which[[SensitivityControlIndex.TERMS, SensitivityControlIndex.PASSES]] = self._decay.size, 1
        relaxes = [up is not None and down is not None and up != down for up, down, _ in self._relaxations]
        self._which[SensitivityControlIndex.RELAXES] = any(relaxes)
        found = {"directions": np.concatenate([np.tile(inputs[0], (m, 1)), coefficient_rates], axis=1),
                 "acts": np.array(coefficient_rates.any(axis=1), np.int32), "relaxes": np.array(relaxes, np.int32),
                 "kappa_rates": kappa_rates,
                 "moduli_rates": moduli_rates[:, equations.batches.elements].reshape(-1, LANES)}
        return {name: copy_to_addressable_array(array) for name, array in found.items()}

    def _allocate_point_derivatives_by_name(self, m: int, terms: int) -> dict[str, np.ndarray]:
        """Allocate the derivatives at the quadrature points, by kernel names.

        Rows of lanes are numbered by batch, point, parameter, term and component, the last fastest.
        """
        batches, q = self._equations.batches.batches, self._equations.reference.weights.shape[1]
        modes = self._equations.mesh.element.pressure_modes
        rows = {"centre_r": m, "centre_z": m, "way_r": 1, "way_z": 1, "law": StoredPointRecordOffset.SIZE * q,
                "pressure_rates": modes,
                "swelling": modes}
        of_memory = {"largest_rates": m * q, "energy_rates": m * q, "stress_rates": 4 * m * q,
                     "before_rates": 4 * m * q, "internal_rates": 4 * m * terms * q}
        rows |= of_memory if self._equations.memory.works else dict.fromkeys(of_memory, 0)
        return {"recent": allocate_array((4 * terms * q, LANES)),
                **{name: allocate_array((count * batches, LANES)) for name, count in rows.items()}}

    def pop_contact_changed_flag(self) -> bool:
        """Return whether a contact point touched, separated, stuck or slipped since the last call; reset the flag.

        The force then has a kink as a function of the parameters nearby.
        """
        changed, self._changed = self._changed, False
        return changed

    def update_at_equilibrium(self) -> None:
        """Compute the derivatives of a step that has converged and is not yet committed; updates `force`."""
        memory = self._equations.memory
        self._differentiate_friction_forces_by_coefficients()
        if self._decay.size:
            self._decay[:], self._gain[:] = memory.step
            (self._past_rates[:, RelaxationSofteningCoefficient.INSTANT], self._decay_rates[:],
             self._gain_rates[:]) = self._differentiate_relaxation_increment(memory.dt)
        if self._shapes:
            with shift_points_from_softening_kink(memory):
                self._equations.launch_on_exact_equilibrium_tangent(self._differentiate_with_factorisation)
        elif self._pause or not self._can_refine_iteratively():
            self._pause = max(self._pause - 1, 0)
            self._equations.launch_on_exact_equilibrium_tangent(self._differentiate_with_factorisation)
        elif not self._refine_iteratively():
            # The contact has changed, or the factorisation is too far; the next steps are likely to fail, too.
            self._failures += 1
            self._pause = 4**self._failures
            self._equations.launch_on_exact_equilibrium_tangent(self._differentiate_with_factorisation)
        self._update_contact_derivatives()

    def _differentiate_friction_forces_by_coefficients(self) -> None:
        """Set the derivatives of the friction forces along the surface at fixed displacements and normal forces, N.

        The friction force of a slipping point is the coefficient times the normal force, in the direction of the slip.
        """
        surface = self._equations.surface
        column = ContactLinearisationColumn
        normals = surface.rates[:, [column.NORMAL_R, column.NORMAL_Z]]
        slips = (surface.rates[:, column.FRICTION] > 0.0) & (surface.initial[:, 0] == TOUCHED)
        limit_per_friction = np.maximum(-np.einsum("ni,ni->n", surface.forces, normals), 0.0)
        along = np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
        rates = np.where(surface.rates[:, column.ON_SHAFT] > 0.0, self._shaft_friction_rates, self._face_friction_rates)
        self._fixed_force_rates[:] = (rates * (slips * surface.slip_signs * limit_per_friction))[..., None] * along

    def _can_refine_iteratively(self) -> bool:
        """Whether iterative refinement with the step's factorisation is possible and cheaper than a new one."""
        counts, settings = self._equations.counts, self._equations.settings
        few = SETTINGS.max_refined_slip if counts[newton.StepIntegerIndex.UNSYMMETRIC] else SETTINGS.max_refined
        return (not self._equations.memory.works and self.force.size <= few
                and settings[newton.StepSettingIndex.INERTIA] == 0 and counts[newton.StepIntegerIndex.FACTORISED] == 1
                and counts[newton.StepIntegerIndex.BENDING] == 1)

    def _refine_iteratively(self) -> bool:
        """Differentiate by iterative refinement with the step's factorisation; return whether it converged."""
        before = self._multiplier_rates.copy()
        self._which[[SensitivityControlIndex.FACTORISES, SensitivityControlIndex.REFINES]] = 1
        self._equations.launch_on_exact_equilibrium_tangent(self._run_kernels, assembles=False)
        self._which[SensitivityControlIndex.REFINES] = 0
        if self._which[SensitivityControlIndex.FACTORISES]:
            self._multiplier_rates[:] = before
        return not self._which[SensitivityControlIndex.FACTORISES]

    def _differentiate_relaxation_increment(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the derivatives of instantaneous factor, decay and gain of each term in a step of duration dt, s."""
        if dt not in self._stored:
            if len(self._stored) >= SETTINGS.stored_step_lengths:
                self._stored.clear()
            rates = np.zeros(len(self._relaxations)), np.zeros_like(self._decay_rates), np.zeros_like(self._gain_rates)
            for k, (up, down, width) in enumerate(self._relaxations):
                if up != down and up is not None and down is not None:
                    for rate, more, less in zip(rates, up.compute_recursion_coefficients(dt),
                                                down.compute_recursion_coefficients(dt), strict=True):
                        rate[k] = (np.asarray(more) - np.asarray(less)) / width
            self._stored[dt] = rates
        return self._stored[dt]

    def _run_kernels(self) -> None:
        """Run both kernels: force derivatives at fixed displacements, then derivatives of the state."""
        self._factorise_and_differentiate_forces()
        add_shape_derivatives(self._shapes, self._equations, self._arrays)
        self._differentiate_state()

    def _differentiate_with_factorisation(self) -> None:
        """Differentiate with a factorisation of the assembled exact tangent; the force is NaN if it is singular."""
        self._which[SensitivityControlIndex.FACTORISES] = 1
        self._run_kernels()
        if self._which[SensitivityControlIndex.FACTORISES]:
            self.force[:] = np.nan

    def _update_contact_derivatives(self) -> None:
        """Update the derivatives of anchors and contact forces after a step.

        A new anchor moves with its point along the surface; a separated point has no force.
        """
        surface = self._equations.surface
        touching, held, before = surface.forces.any(axis=-1), surface.held[:, 0], self._contact
        if not (touching.any() or held.any() or before.any()):
            return
        rebound = (held > 0) & (surface.held != surface.anchors).any(axis=-1)
        if rebound.any():
            normals = surface.rates[rebound][:,
                                             [ContactLinearisationColumn.NORMAL_R, ContactLinearisationColumn.NORMAL_Z]]
            along = np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
            slip = np.einsum("kni,ni->kn", self._point_rates[:, rebound], along)
            self._anchor_rates[:, rebound] = slip[..., None] * along - self._constraint_rates[:, rebound]
        if not touching.all():
            self._multiplier_rates[:, ~touching] = 0.0
        contact = self._contact = np.empty_like(before)
        contact[0], contact[1], contact[2] = touching, held == HELD, surface.slip_signs
        self._changed |= bool((contact != before).any())
