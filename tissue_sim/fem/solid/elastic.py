"""What a solid answers beside the way of its steps: to small motions of its tool, and element by element."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.solid.frame import Frame
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.pose import Pose

# The solver and this are one thing in two files, so this one uses protected names of the other.


def held_places(solver: SolidSolver) -> np.ndarray:
    """Of the nodes that the tool holds, in its frame, m, shape (n, 3)."""
    return solver._held_at


def held_freedoms(solver: SolidSolver) -> np.ndarray:
    """Along which axes nodes are held, by the tool or where they stand, shape (nodes, 3)."""
    held = np.ones(solver.x.size, dtype=bool)
    held[solver._free] = False
    return held.reshape(-1, 3)


def lifted_amplitudes(solver: SolidSolver, pose: Pose) -> np.ndarray:
    """How far a tool that holds tissue has come at a pose: its way, m, and how the entries of its rotation changed, row
    by row, shape (12,)."""
    return Frame(pose, solver.datum).motion_from(Frame(solver._start, solver.datum))


def elastic_answer(solver: SolidSolver, motions: np.ndarray) -> np.ndarray:
    """What small motions of the nodes that the tool holds do to the resting solid, m, shape (freedoms, n).

    Args:
        solver: is at rest afterwards.
        motions: of these freedoms, m, shape (3 nodes, n).
    """
    solver.lift_off()
    solver._assemble()
    solver._matrix.add(np.zeros_like(solver.contact.rates))
    factor = solver._sparse.factorise(solver._matrix.free, symmetric=True)
    answer = np.zeros((solver.x.size, motions.shape[1]))
    answer[solver._moved] = motions
    if factor is not None:
        pushed = np.asarray(solver._matrix.all[:, solver._moved] @ motions)
        answer[solver._free] = -factor.solve(pushed[solver._free])
    return answer


def element_forces(solver: SolidSolver, displacement: np.ndarray, bulk_ratio: float) -> np.ndarray:
    """See `Tissue.element_forces`; at a displacement of all freedoms from where the solid stands, m. The state of the
    solver stays."""
    rest, pressures, _ = solver._rest
    solver.x[:] = rest + displacement
    forces = solver.tissue.element_forces(bulk_ratio, pressures)
    solver._go_back()
    return forces


def node_compliance(solver: SolidSolver, nodes: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Displacements along an axis of nodes of the resting solid under unit forces on them along this axis, m/N, shape
    (n, n).

    Args:
        solver: is at rest afterwards.
        nodes: numbers, shape (n,).
        axis: of unit length, shape (3,).
    """
    solver.lift_off()
    solver._assemble()
    solver._matrix.add(np.zeros_like(solver.contact.rates))
    factor = solver._sparse.factorise(solver._matrix.free, symmetric=True)
    loads = np.zeros((solver.x.size, nodes.size))
    loads[(3 * nodes[:, None] + np.arange(3)).ravel(), np.repeat(np.arange(nodes.size), 3)] = np.tile(axis, nodes.size)
    loads = loads[solver._free]
    moved = loads.T @ factor.solve(loads)
    return 0.5 * (moved + moved.T)
