"""Wrench of a solid on its tool, and its derivative with respect to the pose of the tool."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np

from tissue_sim.fem.linear.sparse import Factor
from tissue_sim.fem.solid.contact import ContactNodes
from tissue_sim.fem.solid.frame import ToolFrame, differentiate_rotated_forces
from tissue_sim.tool_force import Matrix


class HeldAndContactNodes(NamedTuple):
    """Nodes that the tool holds or may touch, and their forces, at a state.

    Attributes:
        frame: frame of the tool.
        moved: degrees of freedom of the held nodes, shape (3 n,).
        held: positions of the held nodes, m, shape (n, 3).
        forces: forces of the tissue on the held nodes, N, shape (n, 3).
        contact: contact nodes.
        places: positions of the contact nodes, m, shape (m, 3).
    """

    frame: ToolFrame
    moved: np.ndarray
    held: np.ndarray
    forces: np.ndarray
    contact: ContactNodes
    places: np.ndarray

    def compute_wrench(self) -> np.ndarray:
        """Return force and torque about the tool's deepest point, of tissue on the tool, N and N m, shape (6,)."""
        moves = self.contact.moves
        rates = np.concatenate([self.frame.differentiate_points(self.held),
                                self.frame.differentiate_points(self.places[moves])])
        # The residual at held nodes is the force that the tool must apply.
        forces = np.concatenate([-self.forces, self.contact.contact_and_law_forces_by_node[moves]])
        return np.einsum("nik,ni->k", rates, forces)

    def compute_stiffness_and_motion_by_pose(self, matrix: Any, factor: Factor,
                                             free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Condense the stiffness onto the pose of the tool (Schur complement), and differentiate the displacements.

        Args:
            matrix: stiffness matrix of all degrees of freedom, contact included.
            factor: factor of its free part.
            free: indices of the free degrees of freedom.

        Returns:
            Minus the derivative of the wrench with respect to position and rotation of the tool, shape (6, 6), and the
            derivative of all displacements, shape (freedoms, 6).
        """
        contact, frame, moves = self.contact, self.frame, self.contact.moves
        moved = np.zeros((matrix.shape[0], 6))
        levers = frame.differentiate_points(self.held)
        moved[self.moved] = levers.reshape(-1, 6)
        way, turned = np.zeros((2, len(contact.nodes), 3, 6))
        way[moves] = frame.differentiate_points(self.places[moves])
        # Contact forces rotate with the tool.
        turned[moves] = differentiate_rotated_forces(contact.contact_and_law_forces_by_node[moves])
        # Nodal forces for a motion of the tool with fixed tissue; the matrix contains the contact stiffness.
        pushed = matrix @ moved
        np.add.at(pushed.reshape(-1, 3, 6), contact.nodes, turned - np.einsum("nij,njk->nik", contact.rates, way))
        answer = moved.copy()
        answer[free] = -factor.solve(pushed[free])
        on_tool = turned + np.einsum("nij,njk->nik", contact.rates, answer.reshape(-1, 3, 6)[contact.nodes] - way)
        reactions = (matrix @ answer)[self.moved].reshape(-1, 3, 6)
        wrench_rate = np.einsum("nia,nib->ab", levers, -reactions)
        wrench_rate += np.einsum("nia,nib->ab", way[moves], on_tool[moves])
        # The levers of the torque change as well: by the displacement of the node minus that of the tool.
        apart = np.concatenate([levers, answer.reshape(-1, 3, 6)[contact.nodes[moves]]])
        apart[:, :, :3] -= np.eye(3)
        forces = np.concatenate([-self.forces, contact.contact_and_law_forces_by_node[moves]])
        wrench_rate[3:] += np.cross(apart, forces[:, :, None], axisa=1, axisb=1, axisc=1).sum(axis=0)
        return -wrench_rate, answer


def to_matrix_tuples(matrix: np.ndarray) -> Matrix:
    """Convert a 6 x 6 array to the tuples of `ToolForce`."""
    return cast("Matrix", tuple(map(tuple, matrix.tolist())))
