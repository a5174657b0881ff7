"""Geometry of a solid mesh for drawing, and its deformed surface."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tissue_sim.fem.result_views import SolidGeometry, SolidSurface
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.mesh.subdivision import (
    find_outline_edges_of_face,
    subdivide_face_into_triangles,
    subdivide_into_tetrahedra,
    triangulate_surface_faces,
)


@lru_cache(maxsize=4)
def build_solid_geometry(mesh: SolidMesh) -> SolidGeometry:
    """Divide the faces on the surface into triangles and the elements into tetrahedra; the result is cached."""
    element, sides = mesh.element, np.concatenate(list(mesh.faces.values()))
    cell_sides = element.local_face_node_indices[:, subdivide_face_into_triangles(element)].reshape(-1, 3)
    return SolidGeometry(mesh.nodes, triangulate_surface_faces(element, sides).reshape(len(sides), -1, 3),
                         sides[:, find_outline_edges_of_face(element)], mesh.connectivity,
                         subdivide_into_tetrahedra(element), cell_sides, mesh.sets.get("top"))


def extract_deformed_surface(mesh: SolidMesh, displacement: np.ndarray, datum: float) -> SolidSurface:
    """Return the deformed surface of a mesh.

    Args:
        mesh: undeformed mesh.
        displacement: displacements of the nodes, m, shape (nodes, 3).
        datum: height of the first touch, which becomes z = 0, m.
    """
    return SolidSurface(build_solid_geometry(mesh), mesh.nodes + displacement - [0.0, 0.0, datum])
