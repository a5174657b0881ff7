"""Which equation belongs to which freedom, so that the matrix has a narrow band."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tissue_sim.mesh import Mesh


class Numbering(NamedTuple):
    """Freedoms r and z of each node in turn.

    Attributes:
        equation: of each freedom, the free ones first and then the prescribed ones; -1 of an interior node, which is
            eliminated inside its element.
        direction: how each freedom moves with the depth of the tool.
        free: how many are free.
        half_band: largest difference of two free equations in one element.
    """

    equation: np.ndarray
    direction: np.ndarray
    free: int
    half_band: int


def number_equations(mesh: Mesh, supports: dict[str, str], tool: dict[str, str]) -> Numbering:
    """Number the freedoms of a mesh.

    Args:
        mesh: undeformed mesh.
        supports: node set -> components held.
        tool: node set -> components that follow the tool.
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
    # Row by row or column by column, whichever makes the narrower band; row by row where it is the same.
    by_rows, by_columns = np.arange(len(mesh.nodes)), np.lexsort(mesh.nodes[:, ::-1].T)
    numberings = [_equations(mesh, order, free, held) for order in (by_rows, by_columns)]
    equation, half_band = min(numberings, key=lambda numbering: numbering[1])
    return Numbering(equation.ravel(), direction.ravel(), int(free.sum()), half_band)


def _equations(mesh: Mesh, order: np.ndarray, free: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, int]:
    """Equation of every freedom when nodes are taken in this order, and the half band that follows."""
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
