"""Equations of the axisymmetric solid: packed arrays, and the compiled Newton iteration that solves them.

Unknowns are nodal displacements u, pressure amplitudes p of each element (mixed displacement-pressure elements), and
contact forces. The equations are equilibrium, the mean volume constraint integral of phi (J - 1 - p / K) = 0, and the
contact conditions; see `assembly` and `contact_kernels`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from tissue_sim.experiment.contact_law import sum_attractive_tractions_at_zero_gap
from tissue_sim.fem.axisymmetric import contact_kernels, newton
from tissue_sim.fem.axisymmetric.array_layouts import ELEMENT_ARRAYS, STATE_ARRAYS, SURFACE_ARRAYS, TISSUE_ARRAYS
from tissue_sim.fem.axisymmetric.batches import ElementBatches, compute_undeformed_mesh_quadrature, number_equations
from tissue_sim.fem.axisymmetric.contact import PENALTY, ContactPoints
from tissue_sim.fem.axisymmetric.state import SolverState
from tissue_sim.fem.axisymmetric.touch import bind_no_slip_points_where_they_touch
from tissue_sim.fem.contact.laws import pack_contact_law_settings
from tissue_sim.fem.contact.pairs import ContactPairs
from tissue_sim.fem.elements.pressure import compute_element_bulk_modulus
from tissue_sim.fem.history import MaterialMemory, PointEffects
from tissue_sim.fem.linear import band
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.origins import allocate_array, copy_to_addressable_array
from tissue_sim.fem.taichi.runtime import LOCK
from tissue_sim.fem.taichi.trace import FormulaClassAndConstants
from tissue_sim.laws import KernelEnergy
from tissue_sim.material.material import Material
from tissue_sim.material.viscoelasticity import Prony
from tissue_sim.mesh import Mesh

#: The residual is divided by the norm of the reactions, but at least by this fraction of the largest force so far, so
#: that small forces after lift-off are not solved more accurately.
FLOOR_FRACTION = 0.1


class EquilibriumEquations:
    """Discrete equilibrium equations of a mesh, their arrays and kernel; for the arguments see `AxisymmetricSolver`.

    Attributes:
        equation, direction, free, half_band: see `tissue_sim.fem.axisymmetric.batches.EquationNumbering`.
        reference: quantities of the undeformed mesh at its quadrature points.
        specific_weight: density times gravity, N/m3.
        surface: contact points.
        memory: memory of the tissue (relaxation, softening).
        effects: effects at the quadrature points.
        state: state that a step changes, and committed states.
        moduli: moduli of the elements in units of the material's modulus, shape (elements,).
        bulk_modulus: K, Pa.
        counts: integer inputs and outputs of a step, see `newton.StepIntegerIndex`.
        settings: inputs of a step, see `newton.StepSettingIndex`.
        report: results of a step, see `newton.StepReportIndex`.
        entries: lower blocks of the tangent.
        upper: upper blocks of the tangent if contact points can slip.
        residual: residual forces, N.
        masses: nodal masses of the inertia, kg, see `tissue_sim.fem.inertia`.
        rest: position that each degree of freedom would reach without forces, m.
    """

    def __init__(self, mesh: Mesh, material: Material, supports: dict[str, str], tool: dict[str, str],
                 contact: ContactPairs | None, specific_weight: float, element_layers: np.ndarray | None,
                 contact_radius: float, start: EquilibriumEquations | None):
        self.mesh, self.contact, self.specific_weight = mesh, contact, specific_weight
        equation, direction, self.free, self.half_band = number_equations(mesh, supports, tool)
        self.equation, self.direction = map(copy_to_addressable_array, (equation, direction))
        self.reference = reference = compute_undeformed_mesh_quadrature(mesh)
        self.batches = ElementBatches(mesh, reference.node_gradients, reference.weights, reference.pressure_modes,
                                      reference.volumes)
        self.surface, self.memory = ContactPoints(mesh, contact), MaterialMemory(reference.weights.shape, 4)
        self.effects = PointEffects(reference.weights.shape, 4)
        self._allocate_tangent_arrays()
        elements, freedoms = len(mesh.connectivity), 2 * len(mesh.nodes)
        self._element_layers, self._contact_radius, self.moduli = element_layers, contact_radius, np.ones(elements)
        x = allocate_array((freedoms + mesh.element.pressure_modes * elements + 2 * self.surface.springs.size,))
        if start is not None:
            settled, bound = start.state.last_committed_solution, start.surface
            x[: settled.size] = settled
            self.surface.anchors[: bound.count], self.surface.slipped[: bound.count] = (
                bound.anchors[: bound.count], bound.slipped[: bound.count])
        self._before, self._coefficients = allocate_array(x.shape), allocate_array((0,))
        self._kernel: Callable[[], None] = _do_nothing
        self.state: SolverState = SolverState(x, self.surface, self.memory, self.effects)
        self.start = copy_to_addressable_array(x[:freedoms])
        self._target, self._motion, self.masses, self.rest = (allocate_array((freedoms,)) for _ in range(4))
        self.weights, self._predicted = copy_to_addressable_array(np.array([1.0, 0.0, 0.0])), 0.0
        self.report, self.settings = np.zeros(len(newton.StepReportIndex)), np.zeros(len(newton.StepSettingIndex))
        if contact is not None:
            reach = max((law.reach for law in contact.laws), default=0.0)
            self.settings[newton.StepSettingIndex.CONTACT_TOLERANCE: newton.StepSettingIndex.INERTIA] = (
                contact.tolerance, sum_attractive_tractions_at_zero_gap(contact.laws, contact.face), reach)
        laws, face = ((), 1.0) if contact is None else (contact.laws, contact.face)
        self._laws = tuple(map(FormulaClassAndConstants.from_law_or_effect, laws))
        self._law_settings = copy_to_addressable_array(pack_contact_law_settings(laws, face))
        self.counts = np.zeros(len(newton.StepIntegerIndex), dtype=np.int32)
        self.counts[[newton.StepIntegerIndex.PASSES, newton.StepIntegerIndex.FREE, newton.StepIntegerIndex.CONTACTS,
                     newton.StepIntegerIndex.BATCHES]] = 1, self.free, self.surface.count, self.batches.batches
        self._tissue_table = TISSUE_ARRAYS.make_offset_table(self._collect_tissue_arrays_by_name())
        #: Tables of the arrays, by the names of the arguments of the kernels.
        self.tables = {
            "element_table": ELEMENT_ARRAYS.make_offset_table(self.batches.collect_arrays_by_name()),
            "tissue_table": self._tissue_table,
            "surface_table": SURFACE_ARRAYS.make_offset_table({**vars(self.surface),
                                                               "law_settings": self._law_settings}),
            "state_table": STATE_ARRAYS.make_offset_table(self._collect_state_arrays_by_name()),
            "band_table": self._band_table}
        self.set_material(material)
        if start is not None:
            for array, settled in zip(self.memory.state_arrays, start.memory.state_arrays, strict=True):
                array[:] = settled
            self.effects.states[:] = start.effects.states

    def _allocate_tangent_arrays(self) -> None:
        """Allocate the arrays of the matrix, its factorisation and the right-hand sides."""
        rows, width = band.count_block_rows_and_blocks_per_row(self.free, self.half_band)
        self.batches.store_scatter_indices(self.mesh, self.equation, self.free, self.direction, (rows, width))
        # The last entry collects the values that belong to no equation.
        self._scattered = allocate_array((rows * width * band.BLOCK**2 + 1,))
        self.entries = self._scattered[:-1].reshape(rows, width, band.BLOCK, band.BLOCK)
        # The tangent of slipping contact is unsymmetric and needs its upper half.
        upper_rows = rows if self.surface.has_coulomb_friction_points else 1
        self.upper = allocate_array((upper_rows, *self.entries.shape[1:]))
        self._factor, self._upper_factor = allocate_array(self.entries.shape), allocate_array(self.upper.shape)
        self._inverse = allocate_array((rows, band.BLOCK))
        self._right = allocate_array((rows, band.BLOCK))
        self._band_table = band.make_band_table(self.entries, self.upper, self._factor, self._upper_factor,
                                                self._inverse, self._right)
        self.residual = allocate_array((max(rows * band.BLOCK, int(self.equation.max()) + 1) + 1,))
        self._pull, self._reaction = (allocate_array((self.free + 1,)) for _ in range(2))

    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law of the material.

        Raises:
            InputError: the bulk ratio is outside `BULK_RATIOS`.
        """
        energy: KernelEnergy = material.energy_law.kernel_energy
        coefficients, bulk_modulus, factor, moduli = self.compute_law_coefficients_and_moduli(material)
        self.material, self.bulk_modulus = material, bulk_modulus
        self.moduli[:] = moduli
        self.batches.set_modulus_ratios(moduli)
        if len(coefficients) == self._coefficients.size:
            self._coefficients[:] = coefficients
        else:
            self._coefficients = copy_to_addressable_array(np.array(coefficients))
        self.memory.set_relaxation_and_softening(self.get_prony_series_for_contact_radius(material), material.softening,
                                                 factor)
        self.effects.set_effects(material.effects.values())
        self.counts[newton.StepIntegerIndex.REMEMBERS] = self.has_material_history
        with LOCK:
            kernel = newton.make_step_kernel(self.mesh.element.name, energy, self.surface.has_coulomb_friction_points,
                                             self.effects.formulas, self._laws)
            # In place, because kernels of sensitivities are bound to the same table.
            TISSUE_ARRAYS.replace_arrays(self._tissue_table, self._collect_tissue_arrays_by_name())
            if not (isinstance(self._kernel, BoundKernel) and self._kernel.kernel is kernel):
                self._kernel = BoundKernel(kernel, {"report": self.report,
                                                    **self.collect_shared_kernel_arrays_by_name()})
        self.surface.set_penalty_stiffness(PENALTY.normal * material.mu0)
        # Forces of rounding errors, per m of depth and for the coordinates of the contact points.
        height = np.ptp(self.mesh.nodes[:, 1])
        stiff = max(self.bulk_modulus, material.mu0) * float(np.linalg.norm(self.reference.rounding * self.moduli))
        self._rounding_rate = stiff + self.surface.rounding_rate * PENALTY.stick_factor
        self._coordinate_rounding = self.surface.rounding_rate * height
        # Estimate of the sag of the top per specific weight, m4/N.
        self._sag_per_weight = height**2 / (6.0 * material.mu0)
        top = self.mesh.nodes[self.mesh.sets["top"], 0].max()
        # Smallest force by which the residual is divided, N; smaller reactions are no load.
        self._floor = 1e-6 * material.mu0 * np.pi * top**2

    def compute_law_coefficients_and_moduli(self, material: Material) -> tuple[np.ndarray, float, float, np.ndarray]:
        """Compute the numbers of a material that the kernels read.

        Returns:
            Coefficients of its law, bulk modulus (Pa), factor of the instantaneous modulus, and moduli of the elements
            in units of the law's modulus, shape (elements,).

        Raises:
            InputError: see `compute_element_bulk_modulus`.
        """
        radius, height = np.ptp(self.mesh.nodes, axis=0)
        K = compute_element_bulk_modulus(material, radius, height)
        moduli = np.ones(len(self.mesh.connectivity))
        if self._element_layers is not None:
            moduli = np.array([*(layer.ratio for layer in material.layers), 1.0])[self._element_layers]
        coefficients = material.energy_law.kernel_coefficients(material.parameters)
        return coefficients, K, material.instantaneous_over_law_modulus_ratio, moduli

    def get_prony_series_for_contact_radius(self, material: Material) -> Prony | None:
        """Return the Prony series of a material for the contact radius of this problem; None without relaxation."""
        return material.make_prony_series(self._contact_radius)

    @property
    def iterates_contact_on_linearisation(self) -> bool:
        """Whether the contact iterates on the linearised tissue after each solve; see `EvaluatedEquations.CONTACT`."""
        return self.surface.count > 0 and not self._laws

    @property
    def has_material_history(self) -> bool:
        """Whether the tissue has relaxation, softening or point effects, so that the kernel stores stresses."""
        return self.memory.works or bool(self.effects.formulas)

    def set_step_duration(self, dt: float) -> None:
        """Set the duration dt (s) of the next step in the memory and the effects."""
        self.memory.set_step_duration(dt)
        self.effects.set_step_duration(dt)

    def set_extrapolation_weights(self, weights: list[float]) -> None:
        """Set the weights of the stored states in the initial state of the next step.

        Args:
            weights: see `tissue_sim.fem.axisymmetric.state.compute_extrapolation_weights`.
        """
        self.weights[:] = weights
        predicted = 0.0
        for weight, depth in zip(weights, self.state.depths, strict=False):
            predicted += weight * depth
        self._predicted = predicted

    def solve_equilibrium(self, depth: float, tolerance: float, max_iterations: int, *,
                          resumed_depth: float | None = None, iterated: int = 0) -> None:
        """Solve for the equilibrium at a depth from the extrapolated state; results in `report` and `state.x`.

        Args:
            depth: depth of the tool, m.
            tolerance: relative residual of a converged step.
            max_iterations: maximum number of linear solves.
            resumed_depth: depth to which state.x belongs if the iteration of the last call continues, m; None: begin
                with an extrapolation.
            iterated: number of linear solves before this call, if the iteration continues.
        """
        resumes = resumed_depth is not None
        rounding = (self._rounding_rate * (abs(depth) + self._sag_per_weight * self.specific_weight)
                    + self._coordinate_rounding)
        self.settings[: newton.StepSettingIndex.TOUCH] = (
            depth, resumed_depth if resumes else self._predicted, self.bulk_modulus, self.specific_weight,
            tolerance,
            max(self._floor, FLOOR_FRACTION * self.state.largest_force), rounding)
        self.counts[newton.StepIntegerIndex.MAX_ITERATIONS] = max_iterations
        self.counts[newton.StepIntegerIndex.START_MODE] = newton.StartMode.RESUME if resumes \
            else newton.StartMode.PREDICT
        self.counts[newton.StepIntegerIndex.ITERATED] = iterated
        if not resumes:
            surface = self.surface
            surface.initial[:], surface.slip_signs[:], surface.pressed[:] = surface.anchors, surface.slipped, 0.0
            if surface.face.size and not surface.anchors[surface.face, 0].all() and not self._laws:
                self._bind_reached_points(depth)
            surface.held[:] = surface.initial
        with LOCK:
            self._kernel()

    def _bind_reached_points(self, depth: float) -> None:
        """Bind the free points under a no-slip face that the tool reaches in a step to `depth`, m."""
        state, surface, freedoms = self.state, self.surface, self.start.size
        points = surface.face[surface.anchors[surface.face, 0] == contact_kernels.FREE]
        lift, descent = state.depths[0] - self.settings[newton.StepSettingIndex.TOUCH], depth - state.depths[0]
        dofs = 2 * surface.nodes[points] + 1
        heights = surface.places[points, 1] + (
            surface.shapes[points] * state.history[state.slots[:, None, None], dofs]).sum(axis=-1)
        if max(heights[0].max(), (self.weights @ heights).max()) + lift + descent <= 0.0:
            return  # the deepest point of the tool is at z = 0 in its frame
        now, predicted = (x[:freedoms].reshape(-1, 2) for x in (
            state.last_committed_solution, self.weights @ state.history[state.slots]))
        bind_no_slip_points_where_they_touch(surface, points, now, predicted, lift, descent)

    def launch_on_exact_equilibrium_tangent(self, launch, assembles: bool = True,
                                            mode: newton.StartMode = newton.StartMode.FIXED_CONTACT) -> None:
        """Assemble the exact tangent at the last equilibrium with the contact bonds of the step, and call `launch`.

        Args:
            launch: function that uses the assembled tangent.
            assembles: whether the tangent is assembled; otherwise the matrix stays as the step left it.
            mode: contact and results of the assembly, see `newton.StartMode`.
        """
        surface, after = self.surface, self.surface.held.copy()
        surface.held[:] = surface.initial
        released = (surface.initial[:, 0] == contact_kernels.HELD) & (after != surface.initial).any(axis=-1)
        surface.held[released] = 0.0
        if not assembles:
            with LOCK:
                launch()
            surface.held[:] = after
            return
        remembered = [(array, array.copy()) for array in (
            self.memory.stresses, self.memory.energies, self.effects.found, self.state.x, surface.forces)]
        with LOCK:
            self.assemble_at_present_state(mode)
            launch()
        surface.held[:] = after
        # The evaluation with the tangent has other rounding errors, which must not influence later steps.
        for array, before in remembered:
            array[:] = before

    def assemble_at_present_state(self, mode: newton.StartMode = newton.StartMode.FIXED_CONTACT) -> None:
        """Evaluate residual and tangent at `state.x` and the depth in `settings`, without a linear solution.

        Args:
            mode: contact and results of the assembly, see `newton.StartMode`.
        """
        index = newton.StepSettingIndex
        self.settings[index.PREDICTED], self.settings[index.TOLERANCE] = self.settings[index.DEPTH], -1.0
        self.settings[[index.KAPPA, index.WEIGHT]] = self.bulk_modulus, self.specific_weight
        self.counts[newton.StepIntegerIndex.MAX_ITERATIONS] = 0
        self.counts[newton.StepIntegerIndex.START_MODE] = mode
        self._kernel()
        self.counts[newton.StepIntegerIndex.START_MODE] = newton.StartMode.PREDICT

    def compute_static_stiffness_or_none(self) -> float | None:
        """Return the static stiffness at the last inertial equilibrium, with the contact state of that equilibrium.

        Returns:
            Derivative of the axial force with respect to the depth without inertia, N/m; None if the static tangent is
            not positive definite, so that the tissue is unstable without its mass.
        """
        report, right = self.report.copy(), self._right.copy()
        inertia = float(self.settings[newton.StepSettingIndex.INERTIA])
        self.settings[newton.StepSettingIndex.INERTIA] = 0.0
        self.launch_on_exact_equilibrium_tangent(_do_nothing, mode=newton.StartMode.STIFFNESS_ONLY)
        self.settings[newton.StepSettingIndex.INERTIA] = inertia
        stiffness = float(self.report[newton.StepReportIndex.STIFFNESS])
        self.report[:], self._right[:] = report, right
        return stiffness if self.counts[newton.StepIntegerIndex.FACTORISED] else None

    def assemble_committed_tangent(self) -> np.ndarray:
        """Return the condensed tangent at the last committed state, N/m, in LAPACK's lower band storage.

        Returns:
            Array of shape (half_band + 1, free).
        """
        self.set_extrapolation_weights([1.0, 0.0, 0.0])
        self.set_step_duration(0.0)
        # With a negative tolerance and no iteration the matrix stays as assembled.
        self.solve_equilibrium(self.state.depths[0], -1.0, 0)
        return band.unpack_blocks_to_lapack_band(self.entries, self.free, self.half_band)

    @cached_property
    def dof_volumes_of_shared_nodes(self) -> np.ndarray:
        """Lumped nodal volume of each degree of freedom of shared nodes, m3, shape (freedoms,); 0 at interior nodes."""
        shared, volumes = self.mesh.element.boundary_nodes, np.zeros(len(self.mesh.nodes))
        np.add.at(volumes, self.mesh.connectivity[:, :shared], self.reference.volumes[:, :shared])
        return np.repeat(volumes, 2)

    def compute_dof_volumes(self) -> np.ndarray:
        """Return the lumped nodal volume of each degree of freedom, interior nodes too, m3, shape (freedoms,)."""
        volumes = np.zeros(len(self.mesh.nodes))
        np.add.at(volumes, self.mesh.connectivity, self.reference.volumes)
        return np.repeat(volumes, 2)

    def compute_displacement_per_depth(self) -> np.ndarray:
        """Return the displacement per depth of the tool from the stiffness of the last step, shape (freedoms,)."""
        displacement = self.direction.astype(float)
        moved = self._free_dof_numbers
        displacement[moved] = -self._right.reshape(-1)[self.equation[moved]]
        self.batches.back_substitute_interior_displacements(displacement)
        return displacement

    @cached_property
    def _free_dof_numbers(self) -> np.ndarray:
        """Degrees of freedom with a free equation, shape (free,)."""
        return np.flatnonzero((self.equation >= 0) & (self.equation < self.free))

    def replace_masses_by_damping_volumes(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Prepare steps with artificial viscous damping: in the arrays of the inertia, volumes replace the masses.

        Returns:
            Masses, array of the displacements towards which the damping acts (m), and density. Pass masses and density
            to `restore_masses_and_density`.
        """
        masses, density = self.masses.copy(), float(self.settings[newton.StepSettingIndex.DENSITY])
        self.masses[:], self.settings[newton.StepSettingIndex.DENSITY] = self.dof_volumes_of_shared_nodes, 1.0
        return masses, self.rest, density

    def restore_masses_and_density(self, masses: np.ndarray, density: float) -> None:
        """Restore the masses and the density that `replace_masses_by_damping_volumes` returned."""
        self.masses[:], self.settings[newton.StepSettingIndex.DENSITY] = masses, density

    def collect_shared_kernel_arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return the arguments that the kernels of the step and of the sensitivities share, by their names in both."""
        return {"counts": self.counts, "settings": self.settings, **self.tables}

    def _collect_tissue_arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return the arrays of `TISSUE_ARRAYS`."""
        memory, effects = self.memory, self.effects
        return {"coefficients": self._coefficients, **memory.collect_arrays_by_name(),
                "effect_settings": effects.settings, "effect_states": effects.states,
                "effect_states_found": effects.found}

    def _collect_state_arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return the arrays of `STATE_ARRAYS`."""
        state = self.state
        return {"equation": self.equation, "direction": self.direction, "start": self.start, "target": self._target,
                "masses": self.masses, "rest": self.rest, "x": state.x, "before": self._before,
                "motion": self._motion, "history": state.history, "slots": state.slots, "weights": self.weights,
                "scattered": self._scattered, "residual": self.residual, "pull": self._pull,
                "reaction": self._reaction}


def _do_nothing() -> None:
    """Do nothing: placeholder of the kernel before a material is set, and of `launch` if only assembly is needed."""
