"""Linear response of a resting solid to motions of its tool, and forces of single elements."""

from __future__ import annotations

import numpy as np

from tissue_sim.errors import ConvergenceError
from tissue_sim.fem.solid.frame import ToolFrame
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.pose import Pose

# These functions belong to `SolidSolver` and use its protected members; they are separate to keep the files short.


def get_held_positions_in_tool_frame(solver: SolidSolver) -> np.ndarray:
    """Return the positions of the nodes that a bonded tool holds, in the frame of the tool, m, shape (n, 3)."""
    return solver._held_at


def get_held_component_mask_by_node(solver: SolidSolver) -> np.ndarray:
    """Return whether each node is held along x, y and z, by a bonded tool or by the base, shape (nodes, 3)."""
    held = np.ones(solver.x.size, dtype=bool)
    held[solver._free] = False
    return held.reshape(-1, 3)


def compute_tool_displacement_and_matrix_change(solver: SolidSolver, pose: Pose) -> np.ndarray:
    """Return the motion of a bonded tool from its first touch to a pose: 3 displacements, m, and 9 matrix entries.

    See `ToolFrame.compute_origin_and_matrix_change_from`.
    """
    return ToolFrame(pose, solver.datum).compute_origin_and_matrix_change_from(ToolFrame(solver._start, solver.datum))


def reset_and_solve_linear_response(solver: SolidSolver, motions: np.ndarray) -> np.ndarray:
    """Solve for the linear response of the resting solid to small motions of the nodes that a bonded tool holds.

    Args:
        solver: solver of the solid; it is reset to the resting state.
        motions: displacements of the held degrees of freedom, m, shape (3 held nodes, n).

    Returns:
        Displacements of all degrees of freedom, m, shape (freedoms, n); the free ones are 0 if the tangent is singular.
    """
    solver.reset_to_first_touch()
    solver._update_assembled_forces_and_tangent()
    solver._matrix.add_contact_stiffness(np.zeros_like(solver.contact.rates))
    factor = solver._sparse.factorise_or_none(solver._matrix.free, symmetric=True)
    answer = np.zeros((solver.x.size, motions.shape[1]))
    answer[solver._moved] = motions
    if factor is not None:
        pushed = np.asarray(solver._matrix.all[:, solver._moved] @ motions)
        answer[solver._free] = -factor.solve(pushed[solver._free])
    return answer


def compute_element_forces_at_displacement(solver: SolidSolver, displacement: np.ndarray,
                                           bulk_ratio: float) -> np.ndarray:
    """Return the nodal forces of each element, N, at a displacement from the resting state, m, shape (freedoms,).

    The state of the solver is kept. See `Tissue.compute_element_forces_limiting_bulk`.
    """
    rest, pressures, _ = solver._rest
    solver.x[:] = rest + displacement
    forces = solver.tissue.compute_element_forces_limiting_bulk(bulk_ratio, pressures)
    solver._restore_committed_state()
    return forces


def reset_and_compute_axial_compliance(solver: SolidSolver, nodes: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the compliance matrix of nodes of the resting solid along one axis, m/N, shape (n, n).

    Column k contains the displacements of the nodes along the axis under a unit force on node k along the axis.

    Args:
        solver: solver of the solid; it is at rest afterwards.
        nodes: indices of the nodes, shape (n,).
        axis: unit vector, shape (3,).

    Raises:
        ConvergenceError: the tangent at rest is singular or indefinite.
    """
    solver.reset_to_first_touch()
    solver._update_assembled_forces_and_tangent()
    solver._matrix.add_contact_stiffness(np.zeros_like(solver.contact.rates))
    factor = solver._sparse.factorise_or_none(solver._matrix.free, symmetric=True)
    loads = np.zeros((solver.x.size, nodes.size))
    loads[(3 * nodes[:, None] + np.arange(3)).ravel(), np.repeat(np.arange(nodes.size), 3)] = np.tile(axis, nodes.size)
    loads = loads[solver._free]
    if factor is None:
        raise ConvergenceError("The tangent at rest is singular or indefinite. Hold the specimen, or use a finer mesh.")
    moved = loads.T @ factor.solve(loads)
    return 0.5 * (moved + moved.T)
