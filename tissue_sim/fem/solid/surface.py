"""Deformed surface of a three-dimensional solid."""

from __future__ import annotations

import numpy as np

from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.mesh.subdivision import triangulate_surface_faces


class SolidSurface:
    """Surface of a solid at a state, in the frame of the scene; `outline` is None because the solid has no axis.

    Args:
        mesh: undeformed mesh.
        displacement: displacement of its nodes, m, shape (nodes, 3).
        datum: height of the scene's origin in the frame of the mesh, m.
    """

    outline = None

    def __init__(self, mesh: SolidMesh, displacement: np.ndarray, datum: float):
        self._mesh, self._displacement, self._datum = mesh, displacement, datum

    def triangles(self, segments: int = 48) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices, m, shape (v, 3), and triangles, shape (t, 3), with normals that point outwards."""
        triangles = triangulate_surface_faces(self._mesh.element, np.concatenate(list(self._mesh.faces.values())))
        numbers, indices = np.unique(triangles, return_inverse=True)
        vertices = self._mesh.nodes[numbers] + self._displacement[numbers] - [0.0, 0.0, self._datum]
        return vertices, indices.reshape(-1, 3)
