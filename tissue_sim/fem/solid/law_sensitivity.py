"""Derivatives of the nodal forces of contact laws with respect to position, slip and contact force.

They are differences, because the derivatives that a law states are only used in Newton's tangent and may be incomplete.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tissue_sim.fem.solid.contact import ContactNodes, ToolFrame


@dataclass(frozen=True)
class LawFiniteDifferenceSettings:
    """Settings of the differences of contact laws.

    Attributes:
        step: step of a difference over the reach of the laws, or over the force of a node, 1.
        min_force: smallest nodal force for such a step over the largest nodal force, 1.
    """

    step: float = 1e-5
    min_force: float = 1e-3


_DIFFERENCES = LawFiniteDifferenceSettings()


class LawDerivativesByPositionSlipForce(NamedTuple):
    """Derivatives of the nodal forces on the tool, zero where no law acts.

    Attributes:
        by_place: with respect to the position of a node relative to the tool at constant slip, N/m, shape (n, 3, 3).
        by_slip: with respect to the slip, N/m, shape (n, 3, 3).
        by_force: with respect to the contact force along the normal, shape (n, 3).
        normals: outward normals of the tool, shape (n, 3).
    """

    by_place: np.ndarray
    by_slip: np.ndarray
    by_force: np.ndarray
    normals: np.ndarray

    @classmethod
    def make_from_differences_or_none(cls, contact: ContactNodes, displacement: np.ndarray,
                                      frame: ToolFrame) -> LawDerivativesByPositionSlipForce | None:
        """Compute the derivatives by differences at the last evaluated equilibrium; None if no law acts.

        Args:
            contact: contact nodes.
            displacement: of these nodes, m, shape (n, 3).
            frame: frame of the tool.
        """
        state, laws, normals = contact.state, contact.laws, contact.normals.copy()
        near, nodes = state.near, contact.nodes[state.near]
        if not near.any():
            return None

        def evaluate_law_forces(moved: np.ndarray, slip: np.ndarray, normal: np.ndarray) -> np.ndarray:
            """Return the forces of the laws on the tool, N, for moved nodes, other slip and other normal forces."""
            _, gap, curved, _, _, meridians = contact.compute_kinematics_and_store_normals(displacement + moved, frame)
            out = contact.normals[near]
            along = slip[near] - np.einsum("ni,ni->n", slip[near], out)[:, None] * out
            return laws.compute_law_forces_and_derivatives(nodes, gap[near], normal[near], along, out, meridians[near],
                                                           curved[near], 0.0)[0]

        n, step, still, slip, normal = near.size, _DIFFERENCES.step * laws.reach, np.zeros(3), state.slip, state.normal
        by_place, by_slip = np.zeros((2, n, 3, 3))
        by_force = np.zeros((n, 3))
        for i, way in enumerate(step * np.eye(3)):
            by_place[near, :, i] = (evaluate_law_forces(way, slip, normal)
                                    - evaluate_law_forces(-way, slip, normal)) / (2.0 * step)
            by_slip[near, :, i] = (evaluate_law_forces(still, slip + way, normal)
                                   - evaluate_law_forces(still, slip - way, normal)) / (2.0 * step)
        more = _DIFFERENCES.step * np.maximum(np.abs(normal), _DIFFERENCES.min_force * np.abs(normal).max()) + 1e-300
        by_force[near] = ((evaluate_law_forces(still, slip, normal + more)
                           - evaluate_law_forces(still, slip, normal - more))
                          / (2.0 * more[near, None]))
        contact.normals[:] = normals
        return cls(by_place, by_slip, by_force, normals)

    def differentiate_law_forces_by_parameters(self, motion: np.ndarray, slipped: np.ndarray,
                                               contact_forces: np.ndarray) -> np.ndarray:
        """Return the derivatives of the law forces with respect to m parameters, shape (n, 3, m), by the chain rule.

        Args:
            motion: derivatives of the positions relative to the tool, shape (n, 3, m).
            slipped: derivatives of the slip, shape (n, 3, m).
            contact_forces: derivatives of the contact forces, shape (n, 3, m).
        """
        normal = np.einsum("ni,nik->nk", self.normals, contact_forces)
        return self.by_place @ motion + self.by_slip @ slipped + self.by_force[:, :, None] * normal[:, None]

    def differentiate_law_forces_by_displacement(self, rates: np.ndarray) -> np.ndarray:
        """Return the derivatives of the law forces with respect to nodal displacements, N/m, shape (n, 3, 3).

        Args:
            rates: derivatives of the contact forces with respect to nodal displacements, N/m, shape (n, 3, 3).
        """
        normal = np.einsum("ni,nij->nj", self.normals, rates)
        return self.by_place + self.by_slip + self.by_force[:, :, None] * normal[:, None]
