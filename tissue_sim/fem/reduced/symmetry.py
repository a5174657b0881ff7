"""Symmetries of a solid under its tool: what it does on a stroke, it does on the stroke's image.

Looked for among the eight symmetries of a square about the vertical through the tool's first touch, which are those
that keep the box of poses: an upright cylinder has all of them, one beside whose axis the tool comes down has one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from tissue_sim.fem.solid.elastic import held_freedoms
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose, Screw, motion, turned

#: Nodes lie on each other within this share of the mesh's size; directions are the same to this.
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A rotation or reflection of the mesh onto itself, about the vertical through a point.

    Attributes:
        matrix: of directions, orthogonal, shape (3, 3).
        nodes: on which node each one comes to lie, shape (nodes,).
    """

    matrix: np.ndarray
    nodes: np.ndarray

    @property
    def is_identity(self) -> bool:
        """Whether everything stays where it is."""
        return bool((self.matrix == np.eye(3)).all())

    def displacements(self, states: np.ndarray) -> np.ndarray:
        """Images of displacements, m, shape (states, freedoms)."""
        states = np.asarray(states)
        images = np.empty((len(states), self.nodes.size, 3))
        images[:, self.nodes] = states.reshape(len(states), -1, 3) @ self.matrix.T
        return images.reshape(states.shape)

    def pose(self, pose: Pose, start: Pose) -> Pose:
        """Image of a pose of a tool of revolution that begins at `start`."""
        x, y, z, *turn = motion(start, pose)
        way = self.matrix @ (x, y, z)
        # Rotations are axial: a reflection turns them round.
        rotation = np.linalg.det(self.matrix) * self.matrix @ turn
        x0, y0, z0 = start.position
        return turned(Pose((x0 + way[0], y0 + way[1], z0 + way[2]), start.orientation), tuple(rotation.tolist()))

    def wrench(self, wrench: Screw | np.ndarray) -> np.ndarray:
        """Image of a force and a torque, N and N m, shape (6,)."""
        force, torque = np.asarray(wrench[:3]), np.asarray(wrench[3:])
        return np.concatenate([self.matrix @ force, np.linalg.det(self.matrix) * self.matrix @ torque])


def symmetries(solver: SolidSolver, start: Pose) -> list[Symmetry]:
    """Those of a solid under a tool that begins at `start`: the identity first, a group together.

    Mesh, named sets and what holds the solid are mapped onto themselves, and the tool's axis at the start.
    """
    found = []
    for matrix in _square():
        axis = np.array(start.rotation)[:, 2]
        if np.abs(matrix @ axis - axis).max() > _SAME:
            continue
        nodes = _images(solver.mesh, matrix, np.array([*start.position[:2], 0.0]))
        if nodes is None or not _maps(solver.mesh, nodes):
            continue
        # What is held along an axis is held along its image.
        held, image = held_freedoms(solver), np.empty((nodes.size, 3), dtype=bool)
        image[nodes] = held @ (np.abs(matrix.T) > 0.5)
        if (image == held).all():
            found.append(Symmetry(matrix, nodes))
    return found


def parities(group: Sequence[Symmetry]) -> tuple[list[Symmetry], list[Symmetry]]:
    """Of a group, commuting ones that are their own inverses, none a product of others; and one of each of the rest's
    cosets, the identity first: all of the group are products of one of the latter and some of the former."""
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


def _square() -> list[np.ndarray]:
    """The symmetries of a square in the plane of x and y, mirrors along the axes right after the identity."""
    matrices = []
    for swapped, (x, y) in product((False, True), product((1.0, -1.0), repeat=2)):
        matrix = np.diag([x, y, 1.0])
        matrices.append(matrix[[1, 0, 2]] if swapped else matrix)
    return matrices


def _images(mesh: SolidMesh, matrix: np.ndarray, centre: np.ndarray) -> np.ndarray | None:
    """On which node each one comes to lie, shape (nodes,); None where one lies on none."""
    from scipy.spatial import cKDTree

    size = float(np.ptp(mesh.nodes, axis=0).max())
    distances, nodes = cKDTree(mesh.nodes).query((mesh.nodes - centre) @ matrix.T + centre)
    if distances.max() > _SAME * size or np.unique(nodes).size != nodes.size:
        return None
    return nodes


def _maps(mesh: SolidMesh, nodes: np.ndarray) -> bool:
    """Whether a permutation of the nodes maps elements, named sets, regions and depths onto themselves."""
    if any((np.sort(nodes[each]) != np.sort(each)).any() for each in mesh.sets.values()):
        return False
    # What tells elements apart beside their nodes: the region, and how deep they count as.
    region = np.zeros(len(mesh.connectivity), dtype=np.intp)
    for number, elements in enumerate(mesh.regions.values(), 1):
        region[elements] = number
    depth = np.round(mesh.element_depths / (_SAME * float(np.ptp(mesh.nodes, axis=0).max()))).astype(np.int64)
    before, after = (np.sort(each, axis=1) for each in (mesh.connectivity, nodes[mesh.connectivity]))
    before, after = before[order := np.lexsort(before.T)], after[image := np.lexsort(after.T)]
    return bool((before == after).all() and (region[order] == region[image]).all()
                and (np.abs(depth[order] - depth[image]) <= 1).all())
