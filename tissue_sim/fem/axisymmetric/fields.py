"""Fields of an axisymmetric simulation with the axes r, z and hoop, half section and deformed surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.legendre import leggauss

from tissue_sim.fem.elements.fields import ElementFields
from tissue_sim.fem.result_views import DeformedSurface, HalfSectionGeometry
from tissue_sim.mesh import Mesh

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True)
class HalfSectionDivisionSettings:
    """Number of triangles of a half section.

    Attributes:
        cells: desired number of cells into which the elements are divided; more cells draw curved edges more smoothly.
        min_divisions: smallest number of straight parts of an element edge.
        max_divisions: largest number of straight parts of an element edge.
    """

    cells: int = 350
    min_divisions: int = 2
    max_divisions: int = 5


#: Settings of all pictures.
SETTINGS = HalfSectionDivisionSettings()


@lru_cache(maxsize=4)
def build_half_section(mesh: Mesh, divisions: int | None = None) -> HalfSectionGeometry:
    """Divide the elements of a mesh into small triangles; the result of a mesh is cached.

    Args:
        mesh: quadrilaterals in the (r, z) half plane.
        divisions: number of straight parts of each element edge; None: as `HalfSectionDivisionSettings` states.
    """
    if divisions is None:
        divisions = min(max(round((SETTINGS.cells / len(mesh.connectivity)) ** 0.5), SETTINGS.min_divisions),
                        SETTINGS.max_divisions)
    line = np.linspace(-1.0, 1.0, divisions + 1)
    shapes, _ = mesh.element.evaluate_shape_functions_and_gradients(np.array([(a, b) for b in line for a in line]))
    # A point is identified by its nodes and weights, which are the same in all elements that share the point.
    points: dict[tuple, int] = {}
    number = np.array([[points.setdefault(key, len(points)) for key in _iterate_point_interpolations(nodes, shapes)]
                       for nodes in mesh.connectivity.tolist()])
    rows = np.repeat(np.arange(len(points)), [len(key) for key in points])
    nodes, weights = np.array([entry for key in points for entry in key]).T
    from scipy.sparse import csr_array

    matrix = csr_array((weights, (rows, nodes.astype(int))), shape=(len(points), len(mesh.nodes)))

    grid = number.reshape(-1, divisions + 1, divisions + 1)
    low, right, left, high = (grid[:, :-1, :-1], grid[:, :-1, 1:], grid[:, 1:, :-1], grid[:, 1:, 1:])
    triangles = np.concatenate([np.stack([low, right, high], axis=-1).reshape(-1, 3),
                                np.stack([low, high, left], axis=-1).reshape(-1, 3)])
    rim = np.concatenate([grid[:, 0], grid[:, -1], grid[:, :, 0], grid[:, :, -1]])
    edges = np.unique(np.sort(np.stack([rim[:, :-1], rim[:, 1:]], axis=-1).reshape(-1, 2), axis=1), axis=0)

    coordinates = matrix @ mesh.nodes
    top, side, base = (_select_points_on_node_set(mesh.sets[name], points) for name in ("top", "side", "base"))
    surface_nodes = list_surface_nodes(mesh)
    return HalfSectionGeometry(mesh.nodes, triangles, top[np.argsort(coordinates[top, 0])],
                               side[np.argsort(-coordinates[side, 1])], base[np.argsort(-coordinates[base, 0])], edges,
                               matrix, surface_nodes, _compute_gauss_shape_functions(mesh, surface_nodes))


def list_surface_nodes(mesh: Mesh) -> np.ndarray:
    """Return the node numbers of the top from the axis outwards, then of the side downwards, shape (m,)."""
    top, side = mesh.sets["top"], mesh.sets["side"]
    return np.concatenate([top[np.argsort(mesh.nodes[top, 0])], side[np.argsort(-mesh.nodes[side, 1])][1:]])


def extract_deformed_surface(mesh: Mesh, state: np.ndarray, datum: float) -> DeformedSurface:
    """Return the deformed outline of a mesh.

    Args:
        mesh: undeformed mesh.
        state: solution vector, nodal displacements first, m.
        datum: height of the first touch, which becomes z = 0, m.
    """
    positions = (mesh.nodes + state[: 2 * len(mesh.nodes)].reshape(-1, 2))[list_surface_nodes(mesh)]
    return DeformedSurface(positions - [0.0, datum])


def _iterate_point_interpolations(nodes: list[int], shapes: np.ndarray) -> Iterator[tuple]:
    """Yield for each point of an element the nodes and weights that define the point."""
    for row in shapes.tolist():
        yield tuple(sorted((node, round(weight, 9)) for node, weight in zip(nodes, row, strict=True)
                           if abs(weight) > 1e-9))


def _select_points_on_node_set(nodes: np.ndarray, points: dict[tuple, int]) -> np.ndarray:
    """Return the numbers of the points that depend on the given nodes only."""
    members = set(nodes.tolist())
    return np.array([number for key, number in points.items() if all(node in members for node, _ in key)])


def _compute_gauss_shape_functions(mesh: Mesh, surface_nodes: np.ndarray) -> csr_array:
    """Return the shape functions at the Gauss points between the nodes of the surface, shape (m - 1, nodes)."""
    order = mesh.element.order
    along, _ = leggauss(order)
    shapes, _ = mesh.element.evaluate_shape_functions_and_gradients(np.column_stack([along, np.full(order, -1.0)]))
    edge_shapes = shapes[:, list(mesh.element.local_edge_node_indices[0])]
    edge_nodes = surface_nodes[np.arange(0, surface_nodes.size - 1, order)[:, None] + np.arange(order + 1)]
    columns = np.repeat(edge_nodes, order, axis=0)
    rows = np.broadcast_to(np.arange(len(columns))[:, None], columns.shape)
    weights = np.tile(edge_shapes, (len(edge_nodes), 1))
    from scipy.sparse import csr_array

    return csr_array((weights.ravel(), (rows.ravel(), columns.ravel())), shape=(len(columns), len(mesh.nodes)))


#: Index of each entry of a symmetric tensor among its components RR, RZ, ZZ, hoop and a zero.
_SYMMETRIC = np.array([[0, 1, 4], [1, 2, 4], [4, 4, 3]])
#: Axes of each component of the Cauchy stress.
_AXES = {"cauchy_rr": (0, 0), "cauchy_zz": (1, 1), "cauchy_rz": (0, 1), "cauchy_hoop": (2, 2)}


@dataclass(frozen=True, eq=False)
class Fields(ElementFields):
    """Fields of an axisymmetric simulation at every sample: displacement, stress, pressure, energy, stretch.

    The nodes have the coordinates r and z. The last column of `gradients` contains the shape functions over r, see
    `UndeformedMeshQuadrature.node_gradients`, and `stresses` the components RR, RZ, ZZ and hoop.
    """

    def geometry(self) -> HalfSectionGeometry:
        """Return the half section of the mesh for drawing, the same object for all samples."""
        return build_half_section(self.mesh)

    def deformation_gradient(self, sample: int = -1) -> np.ndarray:
        """Return the deformation gradient (rR, rZ, zR, zZ, hoop) at the quadrature points, shape (elements, q, 5)."""
        u = self.displacement(sample)[self.mesh.connectivity]
        rates = np.einsum("eqak,eai->eqik", self.gradients, u)
        return np.stack([1 + rates[..., 0, 0], rates[..., 0, 1], rates[..., 1, 0], 1 + rates[..., 1, 1],
                         1 + rates[..., 0, 2]], axis=-1)

    def _compute_deformation_gradient_matrices(self, sample: int) -> np.ndarray:
        components = self.deformation_gradient(sample)
        F = np.zeros((*components.shape[:-1], 3, 3))
        F[..., :2, :2] = components[..., :4].reshape(*components.shape[:-1], 2, 2)
        F[..., 2, 2] = components[..., 4]
        return F

    def _compute_principal_stretches(self, F: np.ndarray) -> np.ndarray:
        _, (larger, smaller) = _compute_principal_angle_and_stretches(F)
        return np.stack([larger, smaller, F[..., 2, 2]], axis=-1)

    def _compute_principal_stretches_and_directions(self, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle, (larger, smaller) = _compute_principal_angle_and_stretches(F)
        directions = np.zeros(F.shape)
        directions[..., 0, 0] = directions[..., 1, 1] = np.cos(angle)
        directions[..., 1, 0] = np.sin(angle)
        directions[..., 0, 1] = -directions[..., 1, 0]
        directions[..., 2, 2] = 1.0
        return np.stack([larger, smaller, F[..., 2, 2]], axis=-1), directions

    def _expand_stress_components(self, components: np.ndarray) -> np.ndarray:
        return np.concatenate([components, np.zeros((*components.shape[:-1], 1))], axis=-1)[..., _SYMMETRIC]

    def _compute_component_directions(self, name: str, sample: int) -> tuple[np.ndarray, np.ndarray]:
        first, second = _AXES[name]
        return np.eye(3)[first], np.eye(3)[second]


def _compute_principal_angle_and_stretches(F: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the angle of the larger in-plane principal stretch and both in-plane principal stretches.

    A 2 x 2 matrix is the sum of a scaled rotation and a scaled reflection; their magnitudes give the singular values.

    Args:
        F: deformation gradients, shape (..., 3, 3); axes r, z, hoop.

    Returns:
        Angle from r in the deformed state, rad, and the larger and smaller stretch, each of shape (...).

    Source: Blinn, IEEE Computer Graphics and Applications 16 (1996) 82.
    """
    rR, rZ, zR, zZ = (F[..., i, k] for i in range(2) for k in range(2))
    turned = np.hypot(rR + zZ, zR - rZ)
    mirrored = np.hypot(rR - zZ, zR + rZ)
    angle = 0.5 * (np.arctan2(zR - rZ, rR + zZ) + np.arctan2(zR + rZ, rR - zZ))
    return angle, (0.5 * (turned + mirrored), 0.5 * (turned - mirrored))
