"""Symmetries of a solid and its tool, which multiply the training data: the image of a solution is a solution.

The candidates are the eight symmetries of a square about the vertical line through the first contact point (the
dihedral group D4), which map the box of poses onto itself. An upright cylinder under a central tool has all eight; with
an off-centre tool it has one mirror symmetry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose, compute_rigid_motion, rotate_pose_about_its_position

#: Relative tolerance for equal positions (times the size of the mesh) and equal directions.
_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A rotation about a vertical line, or reflection in a vertical plane, that maps the mesh onto itself.

    Attributes:
        matrix: orthogonal matrix that maps directions, shape (3, 3).
        nodes: number of the image of each node, shape (nodes,).
    """

    matrix: np.ndarray
    nodes: np.ndarray

    @property
    def is_identity(self) -> bool:
        """Whether the symmetry is the identity."""
        return bool((self.matrix == np.eye(3)).all())

    def map_displacements(self, states: np.ndarray) -> np.ndarray:
        """Return the images of nodal displacements, m, shape (states, freedoms)."""
        states = np.asarray(states)
        images = np.empty((len(states), self.nodes.size, 3))
        images[:, self.nodes] = states.reshape(len(states), -1, 3) @ self.matrix.T
        return images.reshape(states.shape)

    def map_pose(self, pose: Pose, start: Pose) -> Pose:
        """Return the image of a pose of a tool of revolution whose motion begins at `start`."""
        x, y, z, *turn = compute_rigid_motion(start, pose)
        offset = self.matrix @ (x, y, z)
        # A rotation vector is an axial vector: a reflection reverses its sign.
        rotation = np.linalg.det(self.matrix) * self.matrix @ turn
        x0, y0, z0 = start.position
        position = (x0 + offset[0], y0 + offset[1], z0 + offset[2])
        return rotate_pose_about_its_position(Pose(position, start.orientation), tuple(rotation.tolist()))


def find_symmetries(solver: SolidSolver, start: Pose) -> list[Symmetry]:
    """Find the symmetries of a solid under a tool that begins at `start`.

    A symmetry maps the mesh, its named sets, regions, supports and the initial axis of the tool onto themselves.

    Returns:
        The symmetry group, the identity first.
    """
    found = []
    # Whether each node is held along x, y and z, by a bonded tool or by the base.
    held = np.isin(np.arange(solver.x.size), solver.equations.free, invert=True).reshape(-1, 3)
    for matrix in _make_square_symmetries():
        axis = np.array(start.rotation_matrix)[:, 2]
        if np.abs(matrix @ axis - axis).max() > _TOLERANCE:
            continue
        nodes = _find_node_images_or_none(solver.mesh, matrix, np.array([*start.position[:2], 0.0]))
        if nodes is None or not _maps_mesh_onto_itself(solver.mesh, nodes):
            continue
        # A support along an axis must have an image that is a support along the image of the axis.
        image = np.empty((nodes.size, 3), dtype=bool)
        image[nodes] = held @ (np.abs(matrix.T) > 0.5)
        if (image == held).all():
            found.append(Symmetry(matrix, nodes))
    return found


def split_into_involutions_and_cosets(group: Sequence[Symmetry]) -> tuple[list[Symmetry], list[Symmetry]]:
    """Split a symmetry group into an abelian subgroup of involutions and representatives of its cosets.

    Returns:
        Independent generators of the subgroup (commuting, each its own inverse, none a product of the others), and one
        representative of each coset, the identity first. Every element of the group is the product of a representative
        and some of the generators.
    """
    commuting: list[Symmetry] = []
    made = [np.eye(3)]
    for each in group:
        own = each.matrix
        if ((own @ own == np.eye(3)).all() and not any((own == one).all() for one in made)
                and all((own @ one.matrix == one.matrix @ own).all() for one in commuting)):
            commuting.append(each)
            made += [own @ one for one in made]
    cosets: list[Symmetry] = []
    for each in group:
        if not any((each.matrix == one @ other.matrix).all() for one in made for other in cosets):
            cosets.append(each)
    return commuting, cosets


def _make_square_symmetries() -> list[np.ndarray]:
    """Return the eight symmetries of a square in the plane of x and y: the identity, the axis mirrors, the others."""
    matrices = []
    for swapped, (x, y) in product((False, True), product((1.0, -1.0), repeat=2)):
        matrix = np.diag([x, y, 1.0])
        matrices.append(matrix[[1, 0, 2]] if swapped else matrix)
    return matrices


def _find_node_images_or_none(mesh: SolidMesh, matrix: np.ndarray, centre: np.ndarray) -> np.ndarray | None:
    """Return the number of the image of each node, shape (nodes,); None if an image is not a node."""
    from scipy.spatial import cKDTree

    size = float(np.ptp(mesh.nodes, axis=0).max())
    distances, nodes = cKDTree(mesh.nodes).query((mesh.nodes - centre) @ matrix.T + centre)
    if distances.max() > _TOLERANCE * size or np.unique(nodes).size != nodes.size:
        return None
    return nodes


def _maps_mesh_onto_itself(mesh: SolidMesh, nodes: np.ndarray) -> bool:
    """Whether a permutation of the nodes maps elements, named sets, regions and depths onto themselves."""
    if any((np.sort(nodes[each]) != np.sort(each)).any() for each in mesh.sets.values()):
        return False
    # Elements with the same nodes up to symmetry must also have the same region and depth (for layers).
    region = np.zeros(len(mesh.connectivity), dtype=np.intp)
    for number, elements in enumerate(mesh.regions.values(), 1):
        region[elements] = number
    depth = np.round(mesh.element_depths / (_TOLERANCE * float(np.ptp(mesh.nodes, axis=0).max()))).astype(np.int64)
    before, after = (np.sort(each, axis=1) for each in (mesh.connectivity, nodes[mesh.connectivity]))
    before, after = before[order := np.lexsort(before.T)], after[image := np.lexsort(after.T)]
    return bool((before == after).all() and (region[order] == region[image]).all()
                and (np.abs(depth[order] - depth[image]) <= 1).all())
