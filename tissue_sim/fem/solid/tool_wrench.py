"""The wrench of a solid on its tool, and how it changes as the tool moves."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np

from tissue_sim.fem.linear.sparse import Factor
from tissue_sim.fem.solid.contact import ContactNodes
from tissue_sim.fem.solid.frame import Frame, turned_with
from tissue_sim.tool_force import Matrix


class Grip(NamedTuple):
    """What the tool holds and what it presses, at a state.

    Attributes:
        frame: of the tool.
        moved: freedoms of the nodes that it holds, shape (3 n,). held: where these are, m, shape (n, 3).
        forces: of the tissue on them, N, shape (n, 3).
        contact: the nodes that may meet it. places: where these are, m, shape (m, 3).
    """

    frame: Frame
    moved: np.ndarray
    held: np.ndarray
    forces: np.ndarray
    contact: ContactNodes
    places: np.ndarray

    def wrench(self) -> np.ndarray:
        """Force, then torque about the tool's deepest point, on the tool, N and N m, shape (6,)."""
        moves = self.contact.moves
        rates = np.concatenate([self.frame.rates(self.held), self.frame.rates(self.places[moves])])
        # The residual of what the tool holds is the force that it needs.
        forces = np.concatenate([-self.forces, self.contact.acting[moves]])
        return np.einsum("nik,ni->k", rates, forces)

    def stiffness(self, matrix: Any, factor: Factor, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Minus the derivative of the wrench with the tool's place and rotation, shape (6, 6), and how all freedoms go
        with the tool, shape (freedoms, 6).

        Args:
            matrix: stiffness of all freedoms, the rates of the contact with it. factor: of its free part.
            free: numbers of the free freedoms.
        """
        contact, frame, moves = self.contact, self.frame, self.contact.moves
        moved = np.zeros((matrix.shape[0], 6))
        levers = frame.rates(self.held)
        moved[self.moved] = levers.reshape(-1, 6)
        way, turned = np.zeros((2, len(contact.nodes), 3, 6))
        way[moves] = frame.rates(self.places[moves])
        # The forces of what touches the tool turn with it.
        turned[moves] = turned_with(contact.acting[moves])
        # Forces of the nodes when the tool moves and the tissue does not yet; the matrix holds the rates of contact.
        pushed = matrix @ moved
        np.add.at(pushed.reshape(-1, 3, 6), contact.nodes, turned - np.einsum("nij,njk->nik", contact.rates, way))
        answer = moved.copy()
        answer[free] = -factor.solve(pushed[free])
        on_tool = turned + np.einsum("nij,njk->nik", contact.rates, answer.reshape(-1, 3, 6)[contact.nodes] - way)
        reactions = (matrix @ answer)[self.moved].reshape(-1, 3, 6)
        wrench_rate = np.einsum("nia,nib->ab", levers, -reactions)
        wrench_rate += np.einsum("nia,nib->ab", way[moves], on_tool[moves])
        # The levers of the torque change, too: a node goes its way, and the tool's deepest point the tool's.
        apart = np.concatenate([levers, answer.reshape(-1, 3, 6)[contact.nodes[moves]]])
        apart[:, :, :3] -= np.eye(3)
        forces = np.concatenate([-self.forces, contact.acting[moves]])
        wrench_rate[3:] += np.cross(apart, forces[:, :, None], axisa=1, axisb=1, axisc=1).sum(axis=0)
        return -wrench_rate, answer


def rows(matrix: np.ndarray) -> Matrix:
    """A 6 x 6 matrix as those of answers."""
    return cast("Matrix", tuple(map(tuple, matrix.tolist())))
