"""How a reduced solid at an equilibrium answers small motions of its tool, and how far its force may be off."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.reduced.compliance import MissingForce
from tissue_sim.fem.reduced.contact import LayerContact
from tissue_sim.fem.reduced.linear import size, solution
from tissue_sim.fem.reduced.model import PoseBox


class Response:
    """Derivatives at an equilibrium; all of its linear systems are solved at once.

    Args:
        tangent: stiffness of tissue and contact between the modes, N/m, shape (modes, modes).
        contact: as it was evaluated there.
        lifted: how the modes that the tool carries along follow its position and a rotation, shape (held, 6).
        free: the modes that were solved for; before them are those that the tool carries, behind them those watched.
        residual: unbalanced forces on the modes, N m per m, shape (modes,).

    Attributes:
        answer: how the amplitudes follow the position and a rotation of the tool, shape (modes, 6); none of the
            watched ones does.
        left: by how much what was left unbalanced would move them, shape (modes,).
    """

    def __init__(self, tangent: np.ndarray, contact: LayerContact, lifted: np.ndarray, free: slice,
                 residual: np.ndarray):
        self._tangent, self._contact, self._lifted = tangent, contact, lifted
        self._free, self._residual = free, residual
        modes, held = len(residual), free.start
        watched = slice(free.stop, modes)
        right = np.empty((free.stop - held, 7 + modes - free.stop), order="F")
        right[:, :6] = contact.rates_of_modes[free]
        if held:
            right[:, :6] += tangent[free, :held] @ lifted
        right[:, 6] = residual[free]
        right[:, 7:] = tangent[free, watched]
        found = solution(tangent[free, free], right)
        answer = np.zeros((modes, 7))
        answer[:held, :6] = lifted
        answer[free] = -found[:, :7]
        self.answer, self.left = answer[:, :6], answer[:, 6]
        self._followed = found[:, 7:]

    def force_error(self, factors: tuple[float, float], force: np.ndarray, missing: MissingForce | None = None
                    ) -> float | None:
        """Estimated error of a force on the tool, N: by missing modes, and by missing compliance of the contact nodes.

        The part by missing modes is a fraction of the force, and of its change if the tissue could make the watched
        modes (hierarchical estimate: Bank and Weiser, Math. Comp. 44 (1985) 283; calibrated by `training.verify`).

        Args:
            factors: see `ReducedModel.error_factors`.
            force: N, shape (3,).
            missing: of the contact at this equilibrium; None: that part is not known.

        Returns:
            None if neither part is known.
        """
        known = self._modes_error(factors, force) if self._free.stop < len(self._residual) else None
        return known if missing is None else (known or 0.0) + missing.error(size(force))

    def _modes_error(self, factors: tuple[float, float], force: np.ndarray) -> float:
        """Error by missing modes, N."""
        free, held = self._free, self._free.start
        tangent = self._tangent
        # What the iteration has left on the others says nothing of the modes.
        change = np.zeros(len(self._residual))
        change[free.stop :] = moved = solution(
            tangent[free.stop :, free.stop :] - tangent[free.stop :, free] @ self._followed,
            -self._residual[free.stop :])
        change[free] = -self._followed @ moved
        added = self._contact.force_of(change)
        if held:
            added = added - (self._lifted.T @ (tangent[:held] @ change))[:3]
        changed, own = factors
        return changed * size(added) + own * size(force)

    def stiffness(self, box: PoseBox) -> np.ndarray:
        """Minus the derivative of the wrench with the tool's pose, shape (6, 6); nothing along what the box does not
        hold."""
        held, contact, answer = self._free.start, self._contact, self.answer
        stiffness = contact.stiffness(answer)
        if held:
            # Of the contact only what the lifted modes move beside the held face is in the residual.
            forces = self._tangent[:held] @ answer + contact.rates_of_modes[:held]
            return stiffness + answer[:held].T @ forces
        # Where the box has no size the modes know no answer: what would be left is the layer.
        known = np.array([box.sideways > 0.0] * 2 + [True] + [box.turn > 0.0] * 3)
        return np.where(known[:, None] & known, stiffness, 0.0)
