"""Derivatives of a solid's mesh and of the distances from its tool with respect to sizes of specimen and tool.

They are central differences of neighbouring solvers, whose meshes have the same elements with moved nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.contact.surface_geometry import (
    differentiate_gap_and_normal_by_outline,
    find_nearest_surface_geometry,
)
from tissue_sim.fem.solid.contact import ContactNodes, ToolFrame, ToolShapeRates
from tissue_sim.fem.solid.equations import SolidEquations


class NeighbourEquations(NamedTuple):
    """Equations of a solid with a size increased and decreased.

    Attributes:
        more, less: equations before their first step, on the same elements with moved nodes.
        width: difference of the two sizes.
    """

    more: SolidEquations
    less: SolidEquations
    width: float


@dataclass(frozen=True, eq=False)
class MeshDerivative:
    """Derivative of the undeformed mesh with respect to one parameter.

    Attributes:
        nodes: derivatives of the nodal positions, m per unit, shape (nodes, 3).
        volumes: derivatives of the volume that each node represents, m3 per unit, shape (nodes,).
        datum: derivative of the height of the scene's origin in the frame of the mesh, m per unit.
        arrays: input arrays of the assembly, and their derivatives divided by `factor`.
        factor: common factor of these derivatives.
    """

    nodes: np.ndarray
    volumes: np.ndarray
    datum: float
    arrays: list[tuple[np.ndarray, np.ndarray]]
    factor: float = 1.0

    @classmethod
    def from_neighbours(cls, equations: SolidEquations, near: NeighbourEquations) -> MeshDerivative:
        """Make the derivative from two neighbours of the equations."""
        more, less, width = near
        arrays = [(array, (above - below) / width) for array, above, below in zip(
            *(each.batches.geometry_arrays for each in (equations, more, less)), strict=True)]
        return cls((more.mesh.nodes - less.mesh.nodes) / width, (more.batches.volumes - less.batches.volumes) / width,
                   (more.datum - less.datum) / width, arrays)

    @classmethod
    def from_logarithm_of_height(cls, equations: SolidEquations) -> MeshDerivative:
        """Make the derivative with respect to the logarithm of the height, for a mesh that is stretched uniformly."""
        batches = equations.batches
        _, _, gradient_z, weights, modes = batches.geometry_arrays
        return cls(equations.mesh.nodes * [0.0, 0.0, 1.0], batches.volumes, 0.0,
                   [(gradient_z, -gradient_z), (weights, weights.copy()), (modes, -0.5 * modes)])

    def scale(self, factor: float) -> MeshDerivative:
        """Return the derivative times a factor."""
        return MeshDerivative(factor * self.nodes, factor * self.volumes, factor * self.datum, self.arrays,
                              factor * self.factor)

    @property
    def inputs(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Input arrays of the assembly, and their derivatives."""
        return [(array, self.factor * rate) for array, rate in self.arrays]


class OutlineRates(NamedTuple):
    """Derivative of the outline of a tool with respect to parameter `number`.

    Attributes:
        number: index of the parameter.
        pair: contact pair with the outline.
        own: indices of its nodes among the contact nodes.
        vertices: derivatives of the vertices of the outline, m per unit, shape (vertices, 2).
        rounding: derivative of the rounding, m per unit.
    """

    number: int
    pair: ContactPair
    own: np.ndarray
    vertices: np.ndarray
    rounding: float


class ToolShapeDerivatives:
    """Derivatives of the distances of fixed points from the tool with respect to m parameters.

    Args:
        contact: contact nodes.
        neighbours: for each parameter the equations around it; None: the tool does not depend on the parameter.
    """

    def __init__(self, contact: ContactNodes, neighbours: Sequence[NeighbourEquations | None]):
        self._contact, self._count = contact, len(neighbours)
        rates = [OutlineRates(k, pair, own, (more.profile.vertices - less.profile.vertices) / near.width,
                              (more.profile.rounding - less.profile.rounding) / near.width)
                 for k, near in enumerate(neighbours) if near is not None
                 for (pair, own), (more, _), (less, _) in zip(contact.parts, near.more.contact.parts,
                                                              near.less.contact.parts, strict=True)
                 if pair.moves and own.size]
        self._rates = [each for each in rates if each.vertices.any() or each.rounding]

    def differentiate(self, displacement: np.ndarray, frame: ToolFrame) -> ToolShapeRates:
        """Differentiate gaps and normals at the present positions of the nodes.

        Args:
            displacement: of the contact nodes, m, shape (n, 3).
            frame: frame of the tool.
        """
        contact, n = self._contact, len(self._contact.nodes)
        gap, normal = np.zeros((n, 1, self._count)), np.zeros((n, 3, self._count))
        for k, pair, own, vertices, rounding in self._rates:
            at = frame.transform_to_tool(contact.places[own] + displacement[own])
            pressed_in = contact.is_pressed_in(frame)
            gap[own, 0, k], tilt = differentiate_gap_and_normal_by_outline(pair, at, pressed_in, vertices, rounding)
            meridian = find_nearest_surface_geometry(pair, at, pressed_in).meridian
            normal[own, :, k] = (tilt[:, None] * meridian) @ frame.rotation.T
        return ToolShapeRates(gap, normal)
