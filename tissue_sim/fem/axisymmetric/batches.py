"""Elements of a mesh in batches of SIMD lanes, as packed arrays for the kernels, and their equation numbers.

The arrays contain shape functions, weights and pressure modes at the quadrature points of the undeformed mesh. The
equations are numbered with a small half-bandwidth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.elements.quadrature import (
    ElementLanes,
    compute_isoparametric_map,
    compute_orthonormal_pressure_modes,
)
from tissue_sim.fem.linear import band
from tissue_sim.fem.taichi.origins import allocate_array, copy_to_addressable_array
from tissue_sim.fem.taichi.runtime import LANES
from tissue_sim.mesh import Mesh
from tissue_sim.mesh.elements import ELEMENTS


class EquationNumbering(NamedTuple):
    """Equation number of each degree of freedom (r and z of each node in turn), and the bandwidth.

    Attributes:
        equation: equation of each degree of freedom, shape (freedoms,): the free ones first, then the prescribed ones;
            -1 for interior nodes, which are eliminated inside their element.
        direction: displacement of each degree of freedom per depth of the tool, -1 or 0, shape (freedoms,).
        free: number of free equations.
        half_band: half-bandwidth, the largest difference of two free equations in one element.
    """

    equation: np.ndarray
    direction: np.ndarray
    free: int
    half_band: int


def number_equations(mesh: Mesh, supports: dict[str, str], tool: dict[str, str]) -> EquationNumbering:
    """Number the equations of a mesh so that the half-bandwidth is small.

    Args:
        mesh: undeformed mesh.
        supports: node set -> fixed components, "r", "z" or "rz".
        tool: node set -> components that move with the tool.
    """
    prescribed = np.zeros((len(mesh.nodes), 2), dtype=bool)
    direction = np.zeros((len(mesh.nodes), 2))
    prescribed[mesh.sets["axis"], 0] = True
    for sets in (supports, tool):
        for name, components in sets.items():
            for component in components:
                prescribed[mesh.sets[name], "rz".index(component)] = True
    for name in tool:
        direction[mesh.sets[name], 1] = -1.0
    shared = np.zeros(len(mesh.nodes), dtype=bool)
    shared[mesh.connectivity[:, : mesh.element.boundary_nodes]] = True
    free, held = shared[:, None] & ~prescribed, shared[:, None] & prescribed
    # The order with the smaller bandwidth is used: by rows, or by columns.
    by_rows, by_columns = np.arange(len(mesh.nodes)), np.lexsort(mesh.nodes[:, ::-1].T)
    numberings = [_number_equations_in_order(mesh, order, free, held) for order in (by_rows, by_columns)]
    equation, half_band = min(numberings, key=lambda numbering: numbering[1])
    return EquationNumbering(equation.ravel(), direction.ravel(), int(free.sum()), half_band)


def _number_equations_in_order(mesh: Mesh, order: np.ndarray, free: np.ndarray,
                               held: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the equation of every degree of freedom for an order of the nodes, and the half-bandwidth."""
    count = int(free.sum())
    equation = np.full(free.shape, -1, dtype=np.int32)
    for members, first in ((free, 0), (held, count)):
        ordered = np.zeros_like(equation)
        ordered[order] = np.cumsum(members[order].ravel()).reshape(-1, 2)
        equation[members] = first + ordered[members] - 1
    connectivity = mesh.connectivity[:, : mesh.element.boundary_nodes]
    numbers = equation[connectivity].reshape(len(connectivity), -1)
    lowest = np.where(numbers < count, numbers, count).min(axis=1)
    highest = np.where(numbers < count, numbers, -1).max(axis=1)
    return equation, int(max(0, (highest - lowest).max()))


class UndeformedMeshQuadrature(NamedTuple):
    """Quadrature data of the undeformed mesh: points, volumes, shape function gradients, pressure modes.

    Attributes:
        points: (r, z) of the quadrature points, m, shape (elements, q, 2).
        weights: volumes of the quadrature points, m3, shape (elements, q).
        node_gradients: derivatives of the shape functions along r and z, and shape functions over r, 1/m, shape
            (elements, q, nodes, 3).
        pressure_modes: pressure modes, orthonormal in each element, shape (elements, q, modes).
        volumes: volume that each node represents, m3, shape (elements, nodes): the integral of its shape function; of
            elements with a negative integral, the scaled diagonal of the mass matrix.
        rounding: force residual caused by rounding errors of displacements, N per m of displacement and Pa of bulk
            modulus, shape (elements,).
    """

    points: np.ndarray
    weights: np.ndarray
    node_gradients: np.ndarray
    pressure_modes: np.ndarray
    volumes: np.ndarray
    rounding: np.ndarray


def compute_undeformed_mesh_quadrature(mesh: Mesh) -> UndeformedMeshQuadrature:
    """Compute the quadrature data of an undeformed mesh.

    Raises:
        InputError: an element has zero or negative area, or its type is not registered.
    """
    element = mesh.element
    ELEMENTS.find(element.name, "mesh")  # kernels refer to elements by name
    points, weights = element.quadrature
    N, _ = element.evaluate_shape_functions_and_gradients(points)
    place, determinants, gradient = compute_isoparametric_map(mesh)
    weights = 2.0 * np.pi * place[..., 0] * determinants * weights
    if not (weights > 0).all():
        raise InputError("must have elements of positive area; got an element of zero or negative area. "
                         "Number the nodes of each element counterclockwise.", field="mesh")
    node_gradients = np.ascontiguousarray(np.concatenate([gradient, (N / place[..., :1])[..., None]], axis=-1))
    modes = compute_orthonormal_pressure_modes(mesh, place, weights)
    # Rounding of displacements u causes strain errors eps u / h, where h is the smallest node spacing of an element;
    # the bulk modulus K turns the errors into residual forces. The sum of squares overestimates observed residuals
    # 13-fold for spacings from 0.27 mm to 0.15 um; the factor 0.25 is fitted.
    divergence = gradient.copy()
    divergence[..., 0] += N / place[..., :1]
    constraint = np.einsum("eq,eqm,eqai->emai", weights, modes, divergence)
    spacing = np.ptp(mesh.nodes[mesh.connectivity], axis=1).min(axis=1) / element.order
    per_element = np.einsum("emai,emai->e", constraint, constraint) * weights.sum(axis=1) / spacing**2
    volumes = np.einsum("eq,qa->ea", weights, N)
    if volumes.min() < -1e-9 * volumes.max():  # the integral of a node on the axis of Q9/P-1 is zero up to rounding
        # The corners of serendipity elements. The diagonal of the consistent mass matrix is positive; it is scaled to
        # the volume of the element (Hinton, Rock and Zienkiewicz, Earthquake Eng. Struct. Dyn. 4 (1976) 245).
        volumes = np.einsum("eq,qa->ea", weights, N**2)
        volumes *= (weights.sum(axis=1) / volumes.sum(axis=1))[:, None]
    return UndeformedMeshQuadrature(place, weights, node_gradients, modes, volumes,
                                    0.25 * np.finfo(float).eps * np.sqrt(per_element))


class ElementBatches(ElementLanes):
    """Element data in SIMD batches: lane l of batch b is element LANES b + l.

    Surplus lanes write to an unused entry. Arrays in lanes have one row for each batch and each combination of the axes
    in brackets. Pairs are pairs (c, a), a <= c, of shared nodes, with index c (c + 1) / 2 + a.

    Attributes:
        dofs: first degree of freedom of each node [nodes].
        equations: indices into the residual for r and for z [shared nodes]; the last entry of the residual is unused.
        gradients: derivatives of the shape functions along r and z, and shape functions over r [points, nodes].
        weights: volumes of the quadrature points, m3 [points].
        modes: pressure modes [points, modes].
        volumes: integrals of the shape functions, m3 [nodes].
        places: indices of the stiffness of each pair in the flattened band matrix [rr, zr, rz, zz; pairs]; the last
            entry of the band matrix is unused.
        pull_starts: index of the first row of `pulls` of each batch.
        pulls: rows (target, index of the stiffness) for the forces caused by nodes that move with the tool. The target
            is an equation, or the last entry for the force on the moving nodes themselves.
        pull_factors: factors of these stiffnesses.
        stiffness: stiffness of the pairs of one batch, rr, zr, rz, zz [pairs] each, N/m.
        volume: derivative of the volume of each pressure mode with respect to the displacements along r and z [modes,
            nodes].
        gap: residual of the volume constraint (volume change minus pressure over bulk modulus) [modes].
        known_volume: `volume` as contained in the factorised matrix.
        centre_rows: minus the displacement of the interior node per displacement of the shared nodes, rr, rz, zr, zz
            [shared nodes].
        centre_inverse: inverse of the stiffness block of the interior node, rr, rz, zz, m/N.
        centre_force: this inverse times the force on the interior node, r, z, m.
    """

    def __init__(self, mesh: Mesh, gradients: np.ndarray, weights: np.ndarray, modes: np.ndarray, volumes: np.ndarray):
        """Pack the elements of a mesh.

        Args:
            mesh: undeformed mesh.
            gradients: see `UndeformedMeshQuadrature.node_gradients`, shape (elements, q, nodes, 3).
            weights: volumes of the quadrature points, m3, shape (elements, q).
            modes: pressure modes, shape (elements, q, m).
            volumes: integrals of the shape functions, m3, shape (elements, nodes).
        """
        count, nodes = mesh.connectivity.shape
        shared = mesh.element.boundary_nodes
        pairs = shared * (shared + 1) // 2
        super().__init__([np.arange(count)])
        self.pairs, batches = pairs, self.batches
        self._real = copy_to_addressable_array(self.is_real.astype(float))
        self.dofs = self.arrange_in_lanes(2 * mesh.connectivity.astype(np.int32))
        self.gradients = tuple(self.arrange_in_lanes(gradients[..., i]) for i in range(3))
        self.weights, self.modes, self.volumes = (self.arrange_in_lanes(values) for values in (weights, modes, volumes))
        self.stiffness = allocate_array((4 * pairs, LANES))
        m = mesh.element.pressure_modes
        self.volume, self.known_volume = (
            tuple(allocate_array((batches * m * nodes, LANES)) for _ in range(2)) for _ in range(2))
        self.gap = allocate_array((batches * m, LANES))
        self.centre_rows = tuple(allocate_array((batches * shared, LANES)) for _ in range(4))
        self.centre_inverse = tuple(allocate_array((batches, LANES)) for _ in range(3))
        self.centre_force = tuple(allocate_array((batches, LANES)) for _ in range(2))

    def collect_arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return all arrays by their names in `tissue_sim.fem.axisymmetric.array_layouts.ELEMENT_ARRAYS`."""
        named = {"numbers": self.numbers, "dofs": self.dofs, "real": self._real, "point_weights": self.weights,
                 "mode_values": self.modes, "volumes": self.volumes, "moduli": self.moduli, "places": self.places,
                 "pull_starts": self.pull_starts, "pulls": self.pulls, "pull_factors": self.pull_factors,
                 "stiffness": self.stiffness, "stiffness_numbers": self.stiffness.reshape(-1), "gap": self.gap}
        for names, arrays in (
                (("gradient_r", "gradient_z", "value_r"), self.gradients),
                (("equations_r", "equations_z"), self.equations),
                (("volume_r", "volume_z"), self.volume), (("known_volume_r", "known_volume_z"), self.known_volume),
                (("rows_rr", "rows_rz", "rows_zr", "rows_zz"), self.centre_rows),
                (("inverse_rr", "inverse_rz", "inverse_zz"), self.centre_inverse),
                (("force_r", "force_z"), self.centre_force)):
            named |= zip(names, arrays, strict=True)
        return named

    def back_substitute_interior_displacements(self, displacement: np.ndarray) -> None:
        """Set the displacements of the interior nodes from those of the shared nodes, by back substitution.

        Args:
            displacement: displacements of the degrees of freedom, shape (freedoms,); changed at interior nodes.
        """
        count, shared = self.count, self.centre_rows[0].shape[0] // self.batches
        dofs = self.dofs.reshape(self.batches, -1, LANES)
        if dofs.shape[1] == shared:
            return
        r = dofs[:, :shared].reshape(-1, LANES)
        along_r, along_z = displacement[r], displacement[r + 1]
        rr, rz, zr, zz = self.centre_rows
        inside = dofs[:, shared].reshape(-1)[:count]
        for target, on_r, on_z in ((inside, rr, rz), (inside + 1, zr, zz)):
            moved = (on_r * along_r + on_z * along_z).reshape(self.batches, shared, LANES).sum(axis=1)
            displacement[target] = -moved.reshape(-1)[:count]

    def store_scatter_indices(self, mesh: Mesh, equation: np.ndarray, free: int, direction: np.ndarray,
                              shape: tuple[int, int]) -> None:
        """Store the indices with which kernels add forces and stiffnesses to the residual and the matrix.

        Args:
            mesh: undeformed mesh.
            equation: equation of each degree of freedom, shape (freedoms,).
            free: number of free equations.
            direction: displacement of each degree of freedom per depth of the tool, shape (freedoms,).
            shape: number of block rows, and block width, of the band matrix.
        """
        shared = mesh.element.boundary_nodes
        unused = max(shape[0] * band.BLOCK, int(equation.max()) + 1)
        own = equation.reshape(-1, 2)[mesh.connectivity[:, :shared]]  # (elements, shared, 2)
        self.equations = tuple(self.arrange_indices_in_lanes(own[..., i], unused) for i in range(2))
        c, a = np.array([(c, a) for c in range(shared) for a in range(c + 1)]).T
        # Force on node a along i per displacement of node c along k: rr, zr, rz, zz.
        i, k = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])
        rows, columns = own[:, a][:, :, i].swapaxes(1, 2), own[:, c][:, :, k].swapaxes(1, 2)  # (elements, 4, pairs)
        # In the diagonal block of a node rz equals zr and is omitted.
        twice = (c == a) & ((i == 0) & (k == 1))[:, None]
        places = np.where(twice, -1, _compute_band_indices(rows, columns, free, shape))
        last = shape[0] * shape[1] * band.BLOCK**2
        self.places = self.arrange_indices_in_lanes(np.where(places < 0, last, places), last)
        self._store_force_per_depth_table(mesh, own, direction, rows, columns, twice, free)

    def _store_force_per_depth_table(self, mesh, own, direction, rows, columns, twice, free) -> None:
        """Store the table `pulls`: stiffness between moving and free nodes, and within the moving nodes."""
        shared = mesh.element.boundary_nodes
        moves = np.zeros(int(own.max()) + 1)
        moves[own] = direction.reshape(-1, 2)[mesh.connectivity[:, :shared]]
        moved_row, moved_column = moves[rows], moves[columns]
        found = []
        for row, factor in ((rows, moved_column), (columns, moved_row)):
            found.append(np.where((row < free) & (factor != 0), factor, 0.0))
        itself = np.where((rows == columns), 1.0, 2.0) * moved_row * moved_column
        entries = []
        for target, factor in ((rows, found[0]), (columns, found[1]), (np.full_like(rows, free), itself)):
            e, four, pair = np.nonzero(np.where(twice, 0.0, factor))
            stiffness = (four * self.pairs + pair) * LANES + e % LANES
            entries.append(np.stack([e // LANES, target[e, four, pair], stiffness], axis=1))
            entries[-1] = np.concatenate([entries[-1], factor[e, four, pair][:, None]], axis=1)
        table = np.concatenate(entries)
        table = table[np.argsort(table[:, 0], kind="stable")]
        if not len(table):
            table = np.zeros((1, 4))
            table[0, 0] = self.batches
        starts = np.searchsorted(table[:, 0], np.arange(self.batches + 1))
        self.pull_starts = copy_to_addressable_array(starts.astype(np.int32))
        self.pulls = copy_to_addressable_array(table[:, 1:3].astype(np.int32))
        self.pull_factors = copy_to_addressable_array(table[:, 3])


def _compute_band_indices(rows: np.ndarray, columns: np.ndarray, free: int, shape: tuple[int, int]) -> np.ndarray:
    """Return the index of each entry in the flattened lower band; -1 for equations that are not free."""
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    I, J, width = high // band.BLOCK, low // band.BLOCK, shape[1]
    places = ((I * width + J - I + width - 1) * band.BLOCK + low % band.BLOCK) * band.BLOCK + high % band.BLOCK
    return np.where(high < free, places, -1)
