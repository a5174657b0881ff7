"""The axisymmetric solid: a mesh, a material and how its faces are held, stepped by tool displacement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from tissue_sim.errors import InputError
from tissue_sim.fem import band, newton
from tissue_sim.fem import contact as contacts
from tissue_sim.fem.contact import Contact, ContactPoints
from tissue_sim.fem.launch import BoundKernel
from tissue_sim.fem.newton import StepStatus
from tissue_sim.fem.runtime import LOCK
from tissue_sim.laws import KernelEnergy
from tissue_sim.material import BULK_RATIOS, Material, incompressible_ratio
from tissue_sim.mesh import Mesh


@dataclass(frozen=True)
class Step:
    """One step of the solver.

    Attributes:
        status: how it ended.
        iterations: linear solves.
        residual: norm of unbalanced over balanced nodal forces at the end.
        force: on the tool, N, positive when the tissue pushes back; only meaningful when converged.
        penetration: the deepest of a Gauss point of the surface into the tool, m.
    """

    status: StepStatus
    iterations: int
    residual: float
    force: float
    penetration: float = 0.0


class AxisymmetricSolver:
    """Stateful Newton solver of one axisymmetric boundary-value problem.

    Args:
        mesh: undeformed mesh.
        material: law, parameters, bulk response.
        supports: node set -> components held, ``"r"``, ``"z"`` or ``"rz"``.
        tool: node set -> components that follow the tool: ``"z"`` moves with it, ``"rz"`` also sticks to it.
        contact: the surface that the tool may meet besides.
        specific_weight: density times gravity, N/m3, towards -z.
        start: state in which the tool touches, see `state`; displacements count from the undeformed mesh. None: the
            undeformed mesh itself.

    Raises:
        InputError: bulk ratio outside `BULK_RATIOS`.
        MissingBackendError: Taichi is not there.
    """

    def __init__(self, mesh: Mesh, material: Material, supports: dict[str, str], tool: dict[str, str], *,
                 contact: Contact | None = None, specific_weight: float = 0.0, start: np.ndarray | None = None):
        self.mesh, self.specific_weight = mesh, specific_weight
        element = mesh.element
        self._connectivity = np.ascontiguousarray(mesh.connectivity, dtype=np.int32)
        self._number_equations(supports, tool)
        self._integrate_reference()
        elements, nb, modes = len(mesh.connectivity), element.boundary_nodes, element.pressure_modes
        self._band_scratch()
        self.contact, self.surface = contact, ContactPoints(mesh, contact)
        states = 2 * len(mesh.nodes) + modes * elements + 2 * self.surface.springs.size
        self.x = np.zeros(states)
        self._history = np.zeros((3, states))
        if start is not None:
            self.x[: start.size] = self._history[0, : start.size] = start
        freedoms = 2 * len(mesh.nodes)
        self.start, self._target = self.x[:freedoms].copy(), np.zeros(freedoms)
        self._depths: list[float] = [0.0]
        self._slots = np.array([0, 1, 2], dtype=np.int32)
        self._weights = np.array([1.0, 0.0, 0.0])
        self._force = np.zeros((3, nb))
        self._rates = np.zeros((10, nb))
        self._stiffness = np.zeros((element.nodes, 4, nb))
        self._centre_stiffness = np.zeros(3)
        self._volume = np.zeros((elements, modes, 2, nb))
        self._centre_volume = np.zeros((elements, modes, 2))
        self._gap = np.zeros((elements, modes))
        self._centre_rows = np.zeros((elements, 2, 2, nb))
        self._centre_inverse = np.zeros((elements, 3))
        self._centre_force = np.zeros((elements, 2))
        self._report = np.zeros(5)
        self._settings = np.zeros(10)
        shaft, stick = (0, (False, False)) if contact is None else (contact.profile.shaft, contact.stick)
        self._counts = np.array([1, self.free, 0, self.surface.count, shaft, *stick], dtype=np.int32)
        self.set_material(material)
        self._touch()

    def _number_equations(self, supports: dict[str, str], tool: dict[str, str]) -> None:
        """Free freedoms first, then the prescribed ones."""
        mesh, nb = self.mesh, self.mesh.element.boundary_nodes
        prescribed = np.zeros((len(mesh.nodes), 2), dtype=bool)
        self._direction = np.zeros((len(mesh.nodes), 2))
        prescribed[mesh.sets["axis"], 0] = True
        for sets in (supports, tool):
            for name, components in sets.items():
                for component in components:
                    prescribed[mesh.sets[name], "rz".index(component)] = True
        for name in tool:
            self._direction[mesh.sets[name], 1] = -1.0
        shared = np.zeros(len(mesh.nodes), dtype=bool)
        shared[mesh.connectivity[:, :nb]] = True
        free = shared[:, None] & ~prescribed
        held = shared[:, None] & prescribed
        self.free = int(free.sum())
        # Row by row or column by column, whichever makes the narrower band; row by row where it is the same.
        by_rows, by_columns = np.arange(len(mesh.nodes)), np.lexsort(mesh.nodes[:, ::-1].T)
        numberings = [self._equations(order, free, held) for order in (by_rows, by_columns)]
        self._equation, self.half_band = min(numberings, key=lambda numbering: numbering[1])
        self._equation, self._direction = self._equation.ravel(), self._direction.ravel()

    def _touch(self) -> None:
        """Bring the tool down on the surface as it stands, and let an interface without slip hold what it meets."""
        self._datum = 0.0
        if self.contact is None:
            return
        profile, surface = self.contact.profile, self.surface
        displacement = self.start.reshape(-1, 2)
        place = np.concatenate([(self.mesh.nodes + displacement)[self.mesh.sets["top"]],
                                surface.positions(displacement).reshape(-1, 2)])

        def clearance(datum):
            return profile.gap(place - [0.0, datum]).min()

        low, high = place[:, 1].min() - self.contact.radius, place[:, 1].max()
        self._datum = high if clearance(high) <= 0.0 else brentq(clearance, low, high, xtol=1e-15)
        if self.contact.stick[0]:
            touching = surface.positions(displacement) - [0.0, self._datum]
            met = profile.gap(touching.reshape(-1, 2)).reshape(touching.shape[:2]) <= 1e-9 * self.contact.radius
            surface.anchors[met & self.contact.tied[:, None], 0] = 1.0
            surface.anchors[..., 1:] = touching

    def _equations(self, order: np.ndarray, free: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, int]:
        """Equation of every freedom when nodes are taken in this order, and the half band that follows.

        Interior nodes have none (-1): they are eliminated inside their element.
        """
        equation = np.full(free.shape, -1, dtype=np.int32)
        for members, first in ((free, 0), (held, self.free)):
            ordered = np.zeros_like(equation)
            ordered[order] = np.cumsum(members[order].ravel()).reshape(-1, 2)
            equation[members] = first + ordered[members] - 1
        connectivity = self.mesh.connectivity[:, : self.mesh.element.boundary_nodes]
        numbers = equation[connectivity].reshape(len(connectivity), -1)
        lowest = np.where(numbers < self.free, numbers, self.free).min(axis=1)
        highest = np.where(numbers < self.free, numbers, -1).max(axis=1)
        return equation, int(max(0, (highest - lowest).max()))

    def _band_scratch(self) -> None:
        rows, width = band.block_shape(self.free, self.half_band)
        self._entries = np.zeros((rows, width, band.BLOCK, band.BLOCK))
        self._inverse = np.zeros(rows * band.BLOCK)
        self._right = np.zeros((rows, band.BLOCK))
        self._residual = np.zeros(max(rows * band.BLOCK, int(self._equation.max()) + 1))

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
        self._gradients = np.ascontiguousarray(
            self.node_gradients[:, :, : element.boundary_nodes].transpose(0, 1, 3, 2))
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
        volumes = np.einsum("eq,qa->ea", self.weights, N)
        self._node_volumes = np.ascontiguousarray(volumes[:, : element.boundary_nodes])
        self._centre_volumes = np.ascontiguousarray(volumes[:, -1])
        constraint = np.einsum("eq,eqm,eqai->emai", self.weights, self.pressure_modes, divergence)
        spacing = np.ptp(X, axis=1).min(axis=1) / element.order
        per_element = np.einsum("emai,emai->e", constraint, constraint) * self.weights.sum(axis=1) / spacing**2
        self._rounding = 0.25 * np.finfo(float).eps * np.sqrt(per_element.sum())

    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law; the state is kept.

        Raises:
            InputError: bulk ratio outside `BULK_RATIOS`.
        """
        law = material.energy_law
        energy: KernelEnergy = law.kernel_energy
        radius, height = np.ptp(self.mesh.nodes, axis=0)
        K = material.bulk_modulus
        self.bulk_modulus = incompressible_ratio(radius, height) * material.mu0 if np.isinf(K) else K
        ratio = self.bulk_modulus / material.mu0
        low, high = BULK_RATIOS
        if not low <= ratio <= high:
            raise InputError(f"K/mu0 is {ratio:g}; the finite elements are checked from {low:g} to {high:g}",
                             field="bulk")
        self.material = material
        self._coefficients = law.kernel_coefficients(material.parameters)
        surface = self.surface
        with LOCK:
            kernel = newton.step_kernel(self.mesh.element.name, energy)
        self._kernel = BoundKernel(kernel, (
            self._counts, self._settings, self._connectivity, self._equation, self._direction, self.start,
            self._target, self._gradients, self.node_gradients, self._quadrature, self._node_volumes,
            self._centre_volumes, surface.edges, surface.shapes, surface.places, surface.first_line,
            surface.vertices, surface.springs, surface.held, surface.met, surface.forces, self._coefficients, self.x,
            self._history, self._slots, self._weights, self._entries, self._entries, self._inverse, self._right,
            self._residual, self._force, self._rates, self._stiffness, self._centre_stiffness, self._volume,
            self._centre_volume, self._gap, self._centre_rows, self._centre_inverse, self._centre_force,
            self._report))
        self.surface.set_stiffness(contacts.STIFFNESS * material.mu0)
        top = self.mesh.nodes[self.mesh.sets["top"], 0].max()
        # Below this force, N, nothing is loaded: the residual is measured against it instead of the reactions.
        self._floor = 1e-6 * material.mu0 * np.pi * top**2

    def step(self, depth: float, *, tolerance: float = 1e-9, max_iterations: int = 20,
             predictor_order: int = 2) -> Step:
        """Move the tool to `depth` and find equilibrium; commits the state only when it converges.

        Args:
            depth: tool displacement, m.
            tolerance: unbalanced over balanced nodal forces.
            max_iterations: linear solves before giving up.
            predictor_order: highest order of extrapolation in depth from earlier steps (0: none).
        """
        self._predict(depth, predictor_order)
        result = self._solve(depth, tolerance, max_iterations)
        if result.status is StepStatus.CONVERGED:
            self._commit(depth)
        return result

    def _solve(self, depth: float, tolerance: float, max_iterations: int) -> Step:
        height = np.ptp(self.mesh.nodes[:, 1])
        reach = abs(depth) + self.specific_weight * height**2 / (6.0 * self.material.mu0)
        rounding = self._rounding * self.bulk_modulus * reach
        self._launch(depth, tolerance, rounding, max_iterations)
        report = self._report
        return Step(StepStatus(int(report[newton.STATUS])), int(report[newton.ITERATIONS]),
                    float(report[newton.RESIDUAL]), float(report[newton.FORCE]), float(report[newton.PENETRATION]))

    def _predict(self, depth: float, order: int) -> None:
        """Weights of Lagrange's extrapolation from the latest state through earlier ones.

        States that lie closer together than a tenth of the step are left out: extrapolation would magnify their
        rounding, and far away it would be a wild guess.
        """
        known = self._depths
        self._weights[:] = 0.0
        if depth in known:
            self._weights[known.index(depth)] = 1.0
            return
        chosen = [0]
        for i in range(1, len(known)):
            apart = min(abs(known[i] - known[j]) for j in chosen)
            if len(chosen) <= order and apart >= 0.1 * abs(depth - known[0]):
                chosen.append(i)
        for i in chosen[: order + 1]:
            self._weights[i] = np.prod([(depth - known[j]) / (known[i] - known[j]) for j in chosen if j != i])

    def _commit(self, depth: float) -> None:
        if depth in self._depths:
            # Coming back to a known depth: newest first, without a second sample at the same place.
            place = self._depths.index(depth)
            order = [place, *(i for i in range(3) if i != place)]
            self._slots[:] = self._slots[order]
            self._depths = [self._depths[i] for i in order if i < len(self._depths)]
        else:
            self._slots[:] = np.roll(self._slots, 1)
            self._depths = [depth, *self._depths][:3]
        self._history[self._slots[0]] = self.x
        self.surface.anchors[:] = self.surface.held

    def _launch(self, depth: float, tolerance: float, rounding: float, max_iterations: int) -> None:
        edge_radius, penetration = (0.0, 0.0) if self.contact is None else (self.contact.profile.rounding,
                                                                            self.contact.tolerance)
        predicted = float(self._weights[: len(self._depths)] @ self._depths)
        self._settings[:] = (depth, predicted, self.bulk_modulus, self.specific_weight, tolerance, self._floor,
                             rounding, self._datum, edge_radius, penetration)
        self._counts[newton.MAX_ITERATIONS] = max_iterations
        self.surface.held[:] = self.surface.anchors
        with LOCK:
            self._kernel()

    def tangent(self) -> np.ndarray:
        """Condensed tangent at the last committed state: lower band in LAPACK's storage, (half_band + 1, free), N/m."""
        self._weights[:] = [1.0, 0.0, 0.0]
        # No residual is small enough and no iteration is allowed: the matrix stays as it was assembled.
        self._launch(self.depth, -1.0, 0.0, 0)
        return band.unpack(self._entries, self.free, self.half_band)

    @property
    def depth(self) -> float:
        """Tool displacement of the last committed state, m."""
        return self._depths[0]

    @property
    def state(self) -> np.ndarray:
        """The last committed state: nodal displacements, then pressure amplitudes; a copy."""
        return self._history[self._slots[0]].copy()
