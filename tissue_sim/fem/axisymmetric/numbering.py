"""Numbering of the equations with a small half-bandwidth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tissue_sim.mesh import Mesh


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
