"""An element of the three-dimensional solver in one file: the eight-node hexahedron with a bubble on each face.

A node at the centre of each face changes the volume of the two elements at the face independently of other nodes, which
makes the element with one pressure inf-sup stable (Bernardi and Raugel, Math. Comput. 44 (1985) 71).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, SolidElement

#: Coordinates of the face centres, in the order of `HEX8P0.local_face_node_indices`: -x, +x, -y, +y, -z, +z.
FACE_CENTRES = np.kron(np.eye(3), [[-1.0], [1.0]])


@dataclass(frozen=True)
class FaceBubbleHexahedron(SolidElement):
    """Hexahedron with straight edges: corners along x first, then y, then z; then the centres of the faces."""

    @cached_property
    def reference_nodes(self):
        return np.concatenate([HEX8P0.reference_nodes, FACE_CENTRES])

    @cached_property
    def local_corner_indices(self):
        return np.arange(8)

    @cached_property
    def local_face_node_indices(self):
        return np.column_stack([HEX8P0.local_face_node_indices, np.arange(8, 14)])

    @cached_property
    def corner_indices_within_face(self):
        return HEX8P0.corner_indices_within_face

    @cached_property
    def edge_midpoint_indices_within_face(self):
        return np.zeros(0, dtype=int)

    @cached_property
    def face_area_fractions_by_node(self):
        # Integrals of the shape functions over a face.
        return np.array([5.0, 5.0, 5.0, 5.0, 16.0]) / 36.0

    @cached_property
    def quadrature(self):
        return HEX27P1.quadrature

    @cached_property
    def quadrature_extrapolation_matrix(self):
        return self.corner_functions_at_nodes @ np.linalg.pinv(self.evaluate_corner_functions(self.quadrature[0]))

    def evaluate_shape_functions_and_gradients(self, points):
        corners, corner_slopes = HEX8P0.evaluate_shape_functions_and_gradients(points)
        bubbles, bubble_slopes = np.empty((len(points), 6)), np.empty((len(points), 6, 3))
        for number, centre in enumerate(FACE_CENTRES):
            # Linear from 0 to 1 towards the face, quadratic along the two other axes.
            along = centre != 0.0
            factors = np.where(along, 0.5 * (1.0 + centre * points), 1.0 - points**2)
            slopes = np.where(along, 0.5 * centre, -2.0 * points)
            bubbles[:, number] = factors.prod(axis=1)
            for axis in range(3):
                bubble_slopes[:, number, axis] = slopes[:, axis] * np.delete(factors, axis, axis=1).prod(axis=1)
        # The trilinear functions are 1/4 at the centre of a face of their corner.
        share = 0.25 * (HEX8P0.reference_nodes @ FACE_CENTRES.T == 1.0)
        return (np.concatenate([corners - bubbles @ share.T, bubbles], axis=1),
                np.concatenate([corner_slopes - np.einsum("qfi,cf->qci", bubble_slopes, share), bubble_slopes], axis=1))

    def evaluate_corner_functions(self, points):
        return HEX8P0.evaluate_corner_functions(points)


H14P0 = FaceBubbleHexahedron("H14/P0", order=1, pressure_modes=1)
