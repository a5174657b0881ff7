"""The axisymmetric solid: a mesh, a material and how its faces are held, stepped by tool displacement."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.axisymmetric import contact as contacts
from tissue_sim.fem.axisymmetric import contact_kernels, newton
from tissue_sim.fem.axisymmetric.batches import ElementBatches
from tissue_sim.fem.axisymmetric.contact import HOLD, Contact, ContactPoints
from tissue_sim.fem.axisymmetric.newton import StepStatus
from tissue_sim.fem.axisymmetric.numbering import number_equations
from tissue_sim.fem.axisymmetric.touch import bring_down
from tissue_sim.fem.history import Memory
from tissue_sim.fem.inertia import Motion
from tissue_sim.fem.linear import band
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.runtime import LOCK
from tissue_sim.laws import KernelEnergy
from tissue_sim.material.material import BULK_RATIOS, Material, incompressible_ratio
from tissue_sim.material.viscoelasticity import Prony
from tissue_sim.mesh import Mesh

if TYPE_CHECKING:
    from tissue_sim.fem.axisymmetric.sensitivity import Sensitivity


#: Unbalanced forces are measured against the reactions, but at least this share of the largest load so far: what is
#: left of it when the tool has lifted off need not be resolved any closer.
FLOOR_SHARE = 0.1


_STATUSES = {int(status): status for status in StepStatus}


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the solver.

    Attributes:
        status: how it ended.
        iterations: linear solves.
        residual: norm of unbalanced over balanced nodal forces at the end.
        force: on the tool, N, positive when the tissue pushes back; only meaningful when converged.
        violation: the largest of a contact condition (penetration, or slip of what must not slip), m.
        slipping: how many Gauss points of the surface slip against friction.
        stiffness: growth of the force with depth within the step, N/m, where it is asked for.
    """

    status: StepStatus
    iterations: int
    residual: float
    force: float
    violation: float = 0.0
    slipping: int = 0
    stiffness: float = 0.0


class AxisymmetricSolver:
    """Stateful Newton solver of one axisymmetric boundary-value problem.

    Args:
        mesh: undeformed mesh.
        material: law, parameters, bulk response.
        supports: node set -> components held, ``"r"``, ``"z"`` or ``"rz"``.
        tool: node set -> components that follow the tool: ``"z"`` moves with it, ``"rz"`` also sticks to it.
        contact: the surface that the tool may meet besides.
        specific_weight: density times gravity, N/m3, towards -z.
        element_layers: number of the material's layer of each element, shape (elements,); that after the last one
            stands for none, as does None for all.
        contact_radius: m; how fast the pores drain, see `Material.relaxation`.
        start: a solver on the same mesh whose last state is the one in which the tool touches; its contact pairs are
            the first of this one's. None: the undeformed mesh.

    Raises:
        InputError: bulk ratio outside `BULK_RATIOS`.
        MissingBackendError: Taichi is not there.
    """

    def __init__(self, mesh: Mesh, material: Material, supports: dict[str, str], tool: dict[str, str], *,
                 contact: Contact | None = None, specific_weight: float = 0.0, element_layers: np.ndarray | None = None,
                 contact_radius: float = 1.0, start: AxisymmetricSolver | None = None):
        self.mesh, self.specific_weight = mesh, specific_weight
        element = mesh.element
        self._connectivity = np.ascontiguousarray(mesh.connectivity, dtype=np.int32)
        self._equation, self._direction, self.free, self.half_band = number_equations(mesh, supports, tool)
        self._integrate_reference()
        elements, modes = len(mesh.connectivity), element.pressure_modes
        self.contact, self.surface = contact, ContactPoints(mesh, contact)
        self._band_scratch()
        self.memory = Memory(self.weights.shape)
        self._element_layers, self.moduli = element_layers, np.ones(elements)
        self._contact_radius = contact_radius
        self._along = np.einsum("eqai,ea->eqi", self.node_gradients[..., :2], self._direction[1::2][mesh.connectivity])
        #: Rates with the parameters of the material, where somebody asked for them.
        self.sensitivity: Sensitivity | None = None
        #: Equilibria since points last met the tool, left it, stuck or slipped, where stiffness is asked for.
        self.unchanged, self._touching = 0, (b"", b"")
        #: Velocities, where somebody asked for inertia.
        self.motion: Motion | None = None
        states = 2 * len(mesh.nodes) + modes * elements + 2 * self.surface.springs.size
        self.x = np.zeros(states)
        self._history = np.zeros((3, states))
        if start is not None:
            settled, bound = start.state, start.surface
            self.x[: settled.size] = self._history[0, : settled.size] = settled
            self.surface.anchors[: bound.count], self.surface.slipped[: bound.count] = (
                bound.anchors[: bound.count], bound.slipped[: bound.count])
        freedoms = 2 * len(mesh.nodes)
        self.start, self._target = self.x[:freedoms].copy(), np.zeros(freedoms)
        self._depths: list[float] = [0.0]
        self._untouched = self.x.copy()
        self._largest_force = 0.0
        self._slots = np.array([0, 1, 2], dtype=np.int32)
        self._weights = np.array([1.0, 0.0, 0.0])
        self._motion, self._masses, self._rest = np.zeros(freedoms), np.zeros(freedoms), np.zeros(freedoms)
        self._report = np.zeros(7)
        self._settings = np.zeros(13)
        if contact is not None:
            self._settings[newton.CONTACT_TOLERANCE: newton.INERTIA] = (
                contact.tolerance, contact.adhesion, contact.adhesion_length)
        self._counts = np.array([1, self.free, 0, self.surface.count, 0, 0, 0, 0, 0], dtype=np.int32)
        self.set_material(material)
        if start is not None:
            self.memory.restore(start.memory.copy())
        #: z of the tool's deepest point where it first touches, m.
        self.datum = self._settings[newton.TOUCH] = 0.0 if contact is None else bring_down(
            mesh, contact, self.surface, self.start.reshape(-1, 2))

    def _band_scratch(self) -> None:
        rows, width = band.block_shape(self.free, self.half_band)
        self.batches.number(self.mesh, self._equation, self.free, self._direction, (rows, width))
        # What is scattered to nobody goes to the end.
        self._scattered = np.zeros(rows * width * band.BLOCK**2 + 1)
        self._entries = self._scattered[:-1].reshape(rows, width, band.BLOCK, band.BLOCK)
        # The upper half, of a tangent of slipping contact.
        self._upper = np.zeros_like(self._entries if self.surface.slips else self._entries[:1])
        self._inverse = np.zeros(rows * band.BLOCK)
        self._right = np.zeros((rows, band.BLOCK))
        self._residual = np.zeros(max(rows * band.BLOCK, int(self._equation.max()) + 1) + 1)
        self._pull, self._lean = np.zeros(self.free + 1), np.zeros(self.free + 1)

    def _integrate_reference(self) -> None:
        """Shape gradients, weights and orthonormal pressure modes at the quadrature points."""
        mesh, element = self.mesh, self.mesh.element
        points, weights = element.quadrature
        N, dN = element.shape_functions(points)
        X = mesh.nodes[mesh.connectivity]  # (elements, nodes, 2)
        jacobian = np.einsum("eai,qaj->eqij", X, dN)
        inverse = np.linalg.inv(jacobian)
        gradient = np.einsum("qaj,eqji->eqai", dN, inverse)
        place = np.einsum("qa,eai->eqi", N, X)
        self.weights = 2.0 * np.pi * place[..., 0] * np.linalg.det(jacobian) * weights
        if not (self.weights > 0).all():
            raise InputError("the mesh has an element of no or negative area", field="mesh")
        self.node_gradients = np.ascontiguousarray(
            np.concatenate([gradient, (N / place[..., :1])[..., None]], axis=-1))  # (elements, q, nodes, 3)
        modes = np.ones((*self.weights.shape, element.pressure_modes))
        if element.pressure_modes == 3:
            modes[..., 1:] = (place - place.mean(axis=1, keepdims=True)) / np.ptp(X, axis=1)[:, None]
        gram = np.einsum("eq,eqm,eqn->emn", self.weights, modes, modes)
        self.pressure_modes = np.einsum("eqm,enm->eqn", modes, np.linalg.inv(np.linalg.cholesky(gram)))
        self._quadrature = np.ascontiguousarray(np.concatenate([self.weights[..., None], self.pressure_modes], axis=-1))
        self.points = place
        # Displacements of size u resolve strains to eps u / h only, h the smallest spacing of an element's nodes; K
        # turns that into unbalanced force. Per m of displacement and Pa of K (the quarter is fitted: the sum overrates
        # what is seen 13-fold, evenly over gradings from 0.27 mm down to 0.15 um):
        divergence = gradient.copy()
        divergence[..., 0] += N / place[..., :1]
        self._volumes = np.einsum("eq,qa->ea", self.weights, N)
        self.batches = ElementBatches(mesh, self.node_gradients, self.weights, self.pressure_modes, self._volumes)
        constraint = np.einsum("eq,eqm,eqai->emai", self.weights, self.pressure_modes, divergence)
        spacing = np.ptp(X, axis=1).min(axis=1) / element.order
        per_element = np.einsum("emai,emai->e", constraint, constraint) * self.weights.sum(axis=1) / spacing**2
        self._rounding = 0.25 * np.finfo(float).eps * np.sqrt(per_element)

    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law; the state is kept.

        Raises:
            InputError: bulk ratio outside `BULK_RATIOS`.
        """
        energy: KernelEnergy = material.energy_law.kernel_energy
        coefficients, self.bulk_modulus, factor, self.moduli[:] = self.inputs(material)
        self.batches.set_moduli(self.moduli)
        ratio = self.bulk_modulus / material.mu0
        low, high = BULK_RATIOS
        if not low <= ratio <= high:
            raise InputError(f"K/mu0 is {ratio:g}; the finite elements are checked from {low:g} to {high:g}",
                             field="bulk")
        self.material = material
        self._coefficients = np.array(coefficients)
        surface, memory = self.surface, self.memory
        memory.set_material(self.relaxation(material), material.softening, factor)
        self._counts[newton.REMEMBERS] = memory.works
        with LOCK:
            kernel = newton.step_kernel(self.mesh.element.name, energy, surface.slips)
        batches, whole = self.batches, self.batches.stiffness
        quarters = tuple(whole[i * batches.pairs: (i + 1) * batches.pairs] for i in range(4))
        self._kernel = BoundKernel(kernel, (
            self._counts, self._settings, self._equation, self._direction, self.start, self._target, batches.elements,
            batches.dofs, batches.real, *batches.gradients, batches.weights, batches.modes, batches.volumes,
            batches.moduli, *batches.equations, batches.places, batches.pull_starts, batches.pulls,
            batches.pull_factors, *quarters, whole.reshape(-1), *batches.volume, batches.gap, *batches.centre_rows,
            *batches.centre_inverse, *batches.centre_force, surface.edges, surface.spans, surface.shapes,
            surface.places, surface.areas, surface.vertices, surface.rounding, surface.friction, surface.springs,
            surface.held, surface.ways, surface.met, surface.forces, surface.rates, surface.known_rates,
            self._coefficients, memory.past, memory.inherited, memory.largest, memory.stresses, memory.energies,
            self._masses, self._rest, self.x, self._motion, self._history, self._slots, self._weights, self._entries,
            self._entries,
            self._scattered[:-1].reshape(-1, band.BLOCK), self._scattered, self._upper, self._upper, self._inverse,
            self._right, self._residual, self._pull, self._lean, self._report))
        self.surface.set_stiffness(contacts.STIFFNESS * material.mu0)
        # Displacements are rounded, and so are the forces of what is stiff: per m of depth, and of the places.
        height = np.ptp(self.mesh.nodes[:, 1])
        stiff = self.bulk_modulus * float(np.linalg.norm(self._rounding * self.moduli))
        self._rounding_rate = stiff + self.surface.rounding_rate * HOLD
        self._rounding_of_places = self.surface.rounding_rate * height
        self._sag = self.specific_weight * height**2 / (6.0 * material.mu0)
        top = self.mesh.nodes[self.mesh.sets["top"], 0].max()
        # Below this force, N, nothing is loaded: the residual is measured against it instead of the reactions.
        self._floor = 1e-6 * material.mu0 * np.pi * top**2

    def inputs(self, material: Material) -> tuple[np.ndarray, float, float, np.ndarray]:
        """What a material is to the kernels: coefficients of its law, bulk modulus (Pa), instantaneous factor, and
        moduli of the elements in units of the law's, shape (elements,)."""
        radius, height = np.ptp(self.mesh.nodes, axis=0)
        K = material.bulk_modulus
        if np.isinf(K):
            K = incompressible_ratio(radius, height) * material.mu0
        moduli = np.ones(len(self.mesh.connectivity))
        if self._element_layers is not None:
            moduli = np.array([*(layer.ratio for layer in material.layers), 1.0])[self._element_layers]
        coefficients = material.energy_law.kernel_coefficients(material.parameters)
        return coefficients, K, material.instantaneous_factor, moduli

    def relaxation(self, material: Material) -> Prony | None:
        """All that relaxes in this material here."""
        return material.relaxation(self._contact_radius)

    def step(self, depth: float, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
             predictor_order: int = 2, inertial: bool = False, resumes: bool = False) -> Step:
        """Move the tool to `depth` and find equilibrium; commits the state only when it converges.

        Args:
            depth: tool displacement, m.
            dt: time since the step before, s; it matters where the material relaxes, and with inertia.
            tolerance: unbalanced over balanced nodal forces.
            max_iterations: linear solves before giving up.
            predictor_order: highest order of extrapolation in depth from earlier steps (0: none).
            inertial: whether the mass of the tissue counts; `motion` must have been set, and dt be positive.
            resumes: go on from where the step before, which did not converge, ended; dt counts from the last one that
                did.
        """
        if resumes:
            self._predicted = self._tried
        else:
            self._predict(depth, predictor_order)
        self._tried, self._counts[newton.KEEPS] = depth, 2 * resumes
        self.memory.prepare(dt)
        if self.motion is not None:
            self._settings[newton.INERTIA] = self.motion.prepare(self._history[self._slots[0]], dt) if inertial else 0.0
        result = self._solve(depth, tolerance, max_iterations)
        if result.status is StepStatus.CONVERGED:
            self._largest_force = max(self._largest_force, abs(result.force))
            if self.sensitivity is not None:
                self.sensitivity.advance()
            if self.motion is not None:
                self.motion.commit(self._history[self._slots[0]], self.x, dt, inertial)
            self._commit(depth)
        return result

    def follow_motion(self, density: float) -> None:
        """Let the tissue have a mass (kg/m3) from now on, for steps that are inertial."""
        self.motion = Motion(self._masses, self._rest, density * self._node_masses())
        self._settings[newton.DENSITY] = density

    def ask_for_stiffness(self) -> None:
        """Let every step answer how the force grows with depth."""
        self._counts[newton.LEANS] = 1

    def _node_masses(self) -> np.ndarray:
        """Volume that each freedom of a shared node stands for, m3, shape (freedoms,)."""
        shared, volumes = self.mesh.element.boundary_nodes, np.zeros(len(self.mesh.nodes))
        np.add.at(volumes, self.mesh.connectivity[:, :shared], self._volumes[:, :shared])
        return np.repeat(volumes, 2)

    def _solve(self, depth: float, tolerance: float, max_iterations: int) -> Step:
        self._launch(depth, tolerance, self._rounding_rate * (abs(depth) + self._sag) + self._rounding_of_places,
                     max_iterations)
        status, iterations, residual, force, violation, slipping, stiffness = self._report.tolist()
        return Step(_STATUSES[int(status)], int(iterations), residual, force, violation, int(slipping), stiffness)

    def _predict(self, depth: float, order: int) -> None:
        """Weights of Lagrange's extrapolation from the latest state through earlier ones.

        States that lie closer together than a tenth of the step are left out: extrapolation would magnify their
        rounding, and far away it would be a wild guess.
        """
        known, weights = self._depths, [0.0, 0.0, 0.0]
        if depth in known:
            weights[known.index(depth)] = 1.0
        else:
            chosen, least = [0], 0.1 * abs(depth - known[0])
            for i in range(1, len(known)):
                if len(chosen) <= order and all(abs(known[i] - known[j]) >= least for j in chosen):
                    chosen.append(i)
            for i in chosen:
                weights[i] = prod([(depth - known[j]) / (known[i] - known[j]) for j in chosen if j != i])
        self._weights[:] = weights
        self._predicted = sum(weight * place for weight, place in zip(weights, known, strict=False))

    def _commit(self, depth: float) -> None:
        if depth in self._depths:
            # Coming back to a known depth: newest first, without a second sample at the same place.
            place = self._depths.index(depth)
            order = [place, *(i for i in range(3) if i != place)]
            slots = self._slots.tolist()
            self._slots[:] = [slots[i] for i in order]
            self._depths = [self._depths[i] for i in order if i < len(self._depths)]
        else:
            self._slots[1], self._slots[2], self._slots[0] = self._slots.tolist()
            self._depths = [depth, *self._depths][:3]
        self._history[self._slots[0]] = self.x
        self.memory.commit()
        surface = self.surface
        surface.anchors[:], surface.slipped[:] = surface.held, surface.ways
        if self._counts[newton.LEANS]:
            touching = surface.forces.any(axis=-1).tobytes(), surface.ways.tobytes()
            self.unchanged = self.unchanged + 1 if touching == self._touching else 0
            self._touching = touching

    def _launch(self, depth: float, tolerance: float, rounding: float, max_iterations: int) -> None:
        self._settings[: newton.TOUCH] = (
            depth, self._predicted, self.bulk_modulus, self.specific_weight, tolerance,
            max(self._floor, FLOOR_SHARE * self._largest_force), rounding)
        self._counts[newton.MAX_ITERATIONS] = max_iterations
        if self._counts[newton.KEEPS] == 0:
            self.surface.held[:], self.surface.ways[:] = self.surface.anchors, self.surface.slipped
        with LOCK:
            self._kernel()

    def let_go(self) -> None:
        """Take the tool away at once: the tissue is where it was before the touch, but remembers what it went
        through. For a tool that is out of the tissue when no way there was found."""
        surface, moves = self.surface, self.surface.moves
        self._slots[:], self._depths, self.unchanged = (0, 1, 2), [0.0], 0
        self._history[0] = self._untouched
        surface.anchors[moves], surface.slipped[moves] = 0.0, 0.0
        if self.motion is not None:
            self.motion.stop()

    def respond(self, launch) -> None:
        """Assemble the exact tangent at the equilibrium just found, with the contact as it was in the step, and call
        `launch` there."""
        surface, after = self.surface, self.surface.held.copy()
        remembered = self.memory.stresses.copy(), self.memory.energies.copy()
        surface.held[:] = surface.anchors
        released = (surface.anchors[..., 0] == contact_kernels.HELD) & (after != surface.anchors).any(axis=-1)
        surface.held[released] = 0.0
        self._settings[newton.PREDICTED] = self._settings[newton.DEPTH]
        self._settings[newton.TOLERANCE] = -1.0
        self._counts[newton.MAX_ITERATIONS], self._counts[newton.KEEPS] = 0, 1
        with LOCK:
            self._kernel()
            launch()
        self._counts[newton.KEEPS] = 0
        surface.held[:] = after
        # With the tangent they come out rounded otherwise.
        self.memory.stresses[:], self.memory.energies[:] = remembered

    def response_arrays(self) -> tuple[np.ndarray, ...]:
        """The arrays of the solver that `tissue_sim.fem.axisymmetric.sensitivity_kernel` works on, in its order."""
        surface, memory, batches = self.surface, self.memory, self.batches
        elements, element = len(self.mesh.connectivity), self.mesh.element
        return (self._counts, self._settings, self._connectivity, self._equation, self.node_gradients,
                self._quadrature, self._along, surface.edges, surface.spans, surface.shapes, surface.springs,
                surface.held, surface.ways, surface.rates, self._coefficients, self.moduli, memory.past,
                memory.inherited, memory.largest, self.x, self._entries, self._entries, self._upper, self._inverse,
                self._right, self._residual, *batches.volume, *batches.centre_rows, *batches.centre_inverse,
                np.zeros((elements, element.pressure_modes)), np.zeros((element.nodes, 2)), np.zeros((elements, 2)))

    def tangent(self) -> np.ndarray:
        """Condensed tangent at the last committed state: lower band in LAPACK's storage, (half_band + 1, free), N/m."""
        self._weights[:], self._predicted = [1.0, 0.0, 0.0], self.depth
        self._counts[newton.KEEPS] = 0
        self.memory.prepare(0.0)
        # No residual is small enough and no iteration is allowed: the matrix stays as it was assembled.
        self._launch(self.depth, -1.0, 0.0, 0)
        return band.unpack(self._entries, self.free, self.half_band)

    def save(self) -> tuple:
        """All that a committed step leaves behind, for `restore`."""
        surface = self.surface
        return (self._history.copy(), self._slots.copy(), list(self._depths), surface.anchors.copy(),
                surface.slipped.copy(), self.memory.copy(), self._largest_force,
                None if self.motion is None else self.motion.copy(), self.unchanged, self._touching)

    def restore(self, saved: tuple) -> None:
        """Go back to where `save` was called."""
        surface = self.surface
        self._history[:], self._slots[:], self._depths = saved[0], saved[1], list(saved[2])
        surface.anchors[:], surface.slipped[:] = saved[3], saved[4]
        self.memory.restore(saved[5])
        self._largest_force, self.unchanged, self._touching = saved[6], saved[8], saved[9]
        if self.motion is not None and saved[7] is not None:
            self.motion.restore(saved[7])

    @property
    def depth(self) -> float:
        """Tool displacement of the last committed state, m."""
        return self._depths[0]

    @property
    def state(self) -> np.ndarray:
        """The last committed state: nodal displacements, then pressure amplitudes; a copy."""
        return self._history[self._slots[0]].copy()
