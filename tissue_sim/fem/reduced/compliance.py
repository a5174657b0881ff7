"""Compliance of the contact nodes that the modes of a reduced solid do not represent, and the error of the force by it.

A basis represents the displacement under the contact forces of the training strokes. It contains nearly no motion of a
node that no stroke pressed, so that the reduced solid is too stiff there. The residual on further modes of the same
strokes cannot show this. The compliance of the contact nodes can: that of the whole solid, G, and that of the reduced
solid, G_r, are known at rest (residual attachment modes: MacNeal, Computers & Structures 1 (1971) 581; a-posteriori
error of a reduced basis: Rozza, Huynh and Patera, Arch. Comput. Methods Eng. 15 (2008) 229).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg import lapack

from tissue_sim.fem.reduced.compliance_table import ContactCompliance
from tissue_sim.fem.reduced.contact import LayerContact
from tissue_sim.fem.reduced.elements import SampledElements
from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.solid.elastic import node_compliance
from tissue_sim.fem.solid.solver import SolidSolver


class MissingForce:
    """Error of the force of a reduced solid by the compliance that its contact nodes lack.

    Nodes under a given displacement with forces f exert too much where their compliance lacks D = G - G_r: they would
    move by D f more, and a rigid tool that holds them in place reduces the forces by G^-1 D f. The sum 1' G^-1 D f over
    the nodes that touch is the missing force. It depends on ratios of compliances, so that it holds for other moduli.

    A deformed solid is not as compliant as at rest, so that the missing force is not zero where the answer is right.
    The error is the excess over the values in right answers on the training strokes (`ContactCompliance.accepted`).

    Args:
        table: compliances of the contact nodes.
        contact: whose forces are taken; its nodes are those of the table.
    """

    def __init__(self, table: ContactCompliance, contact: LayerContact):
        self._table, self._contact = table, contact
        #: Nodes for which the weights, missing force per force on each node, are those now.
        self._touching = b""
        self._weights = np.zeros((table.nodes.size, 3))

    def value(self) -> float:
        """Missing force at the present contact forces, N."""
        touching = self._contact.touching
        if (key := touching.tobytes()) != self._touching:
            self._touching = key
            self._weights = self._weights_of(np.flatnonzero(touching))
        return abs(float(np.vdot(self._weights, self._contact.forces)))

    def error(self, force: float) -> float:
        """Estimated error of a force of this size on the tool, N."""
        return max(0.0, self.value() - self._table.accepted_at(force))

    def _weights_of(self, nodes: np.ndarray) -> np.ndarray:
        """Missing force per force on each node where these touch, shape (n, 3)."""
        weights = np.zeros(self._weights.shape)
        if nodes.size:
            block = np.ix_(nodes, nodes)
            _, pressure, failed = lapack.dposv(self._table.whole[block], np.ones(nodes.size))
            assert not failed, "the compliance of a solid that is held is positive definite"
            weights[nodes] = (pressure @ self._table.missing[block])[:, None] * self._table.axis
        return weights


def missing_force(reduced: ReducedModel, contact: LayerContact) -> MissingForce | None:
    """The estimate for a reduced solid; None for a tool that holds tissue."""
    if reduced.lifting:
        return None
    return MissingForce(reduced.compliance or compliance_of_older_file(reduced), contact)


def contact_compliance(reduced: ReducedModel, solver: SolidSolver, nodes: np.ndarray) -> ContactCompliance:
    """The compliances of contact nodes, at which no answer is yet known to be right.

    Args:
        reduced: its modes, elements and material.
        solver: the whole solid of the same material; it is at rest afterwards.
        nodes: that may meet the tool, shape (n,).
    """
    axis = np.array(reduced.model.experiment.tool_pose(0.0).rotation)[:, 2]
    whole = node_compliance(solver, nodes, axis)
    free = slice(reduced.lifting, reduced.basis.shape[1] - reduced.watched)
    moved = reduced.basis.reshape(-1, 3, reduced.basis.shape[1])[nodes][:, :, free].transpose(0, 2, 1) @ axis
    stiffness = _resting_stiffness(reduced)[free, free]
    kept = moved @ np.linalg.solve(stiffness, moved.T)
    return ContactCompliance(nodes, axis, whole, whole - 0.5 * (kept + kept.T), np.zeros(1), np.zeros(1))


def _resting_stiffness(reduced: ReducedModel) -> np.ndarray:
    """Stiffness of the sampled elements between the modes where nothing touches them, shape (modes, modes)."""
    experiment = reduced.model.experiment
    elements = SampledElements(reduced.mesh, reduced.basis, reduced.elements, reduced.shares, rest=reduced.rest,
                               layers=reduced.element_layers, contact_radius=experiment.contact_radius)
    elements.set_material(reduced.model.material, reduced.bulk_ratio)
    elements.settle()
    rest = np.zeros(reduced.basis.shape[1])
    elements.pressures[:] = elements.rest_pressures
    elements.renew(rest)
    elements.evaluate(rest, False, 1)
    return elements.tangent


@lru_cache(maxsize=2)
def compliance_of_older_file(reduced: ReducedModel) -> ContactCompliance:
    """The compliances of a reduced solid whose file was written before they were kept.

    At which missing forces its answers are right is not known: all of the missing force counts as error.
    """
    from tissue_sim.fem.solid.discretisation import make_solver

    solver = make_solver(reduced.model, mesh=reduced.mesh)
    return contact_compliance(reduced, solver, np.sort(solver.contact.nodes[solver.contact.moves]))
