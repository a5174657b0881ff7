"""Deformed surface of an axisymmetric specimen for visualisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.mesh import Mesh


@dataclass(frozen=True, eq=False)
class DeformedSurface:
    """Outline of an axisymmetric specimen, in the frame of the scene.

    Attributes:
        outline: (r, z) from the axis along the top and down the side to the base, m, shape (n, 2); z = 0 is the height
            of the first touch.
    """

    outline: np.ndarray

    def triangles(self, segments: int = 48) -> tuple[np.ndarray, np.ndarray]:
        """Return a triangulation of the surface of revolution.

        Args:
            segments: number of segments around the axis, 3 or more.

        Returns:
            Vertices, m, shape (v, 3), and vertex indices of the triangles, shape (t, 3), with outward normals.
        """
        ring = self.outline[1:] if self.outline[0, 0] == 0.0 else self.outline
        angle = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)
        r, z = ring[:, :1], np.broadcast_to(ring[:, 1:], (len(ring), segments))
        rings = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1).reshape(-1, 3)
        here = np.arange(len(ring) * segments).reshape(len(ring), segments)
        next_ones = np.roll(here, -1, axis=1)
        inner, outer = here[:-1], here[1:]
        quads = np.concatenate([np.stack([inner, outer, next_ones[:-1]], axis=-1).reshape(-1, 3),
                                np.stack([next_ones[:-1], outer, next_ones[1:]], axis=-1).reshape(-1, 3)])
        if ring is self.outline:
            return rings, quads
        centre = np.array([[0.0, 0.0, self.outline[0, 1]]])
        fan = np.stack([np.zeros(segments, dtype=int), here[0] + 1, next_ones[0] + 1], axis=-1)
        return np.concatenate([centre, rings]), np.concatenate([fan, quads + 1])


def extract_deformed_surface(mesh: Mesh, state: np.ndarray, datum: float) -> DeformedSurface:
    """Return the deformed outline of a mesh.

    Args:
        mesh: undeformed mesh.
        state: solution vector, nodal displacements first, m.
        datum: height of the first touch, which becomes z = 0, m.
    """
    top, side = mesh.sets["top"], mesh.sets["side"]
    order = np.concatenate([top[np.argsort(mesh.nodes[top, 0])], side[np.argsort(-mesh.nodes[side, 1])][1:]])
    positions = (mesh.nodes + state[: 2 * len(mesh.nodes)].reshape(-1, 2))[order]
    return DeformedSurface(positions - [0.0, datum])
