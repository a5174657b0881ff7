"""What the tissue remembers of its past, at the quadrature points."""

from __future__ import annotations

import numpy as np

from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import Prony

#: Places in `Memory.past`.
FACTOR, INSTANT, LOSS, LOSS_MODULUS, LOSS_SHARE = range(5)


class Memory:
    """Hereditary stresses and the largest load; the arrays that a step's kernel works on.

    Args:
        points: elements, and quadrature points of each. components: of a symmetric tensor.

    Attributes:
        past: how stresses act in this step; places as named above.
        inherited: isochoric second Piola stress that is left of earlier ones, Pa, shape (elements, q, components).
        largest: largest isochoric energy density so far, J/m3, shape (elements, q).
        stresses, energies: of the law, softened but not relaxed, in this step; before: those of the step before.
        internal: Q_i of each term, Pa, shape (terms, elements, q, components).
        step: decay and gain of each term in this step.

    The recursion is that of `tissue_sim.material.viscoelasticity`: within a step the stress of the law changes linearly
    in time.
    """

    def __init__(self, points: tuple[int, int], components: int):
        self.past = np.zeros(5)
        self.inherited, self.stresses = np.zeros((2, *points, components))
        self.largest, self.energies = np.zeros(points), np.zeros(points)
        self.before, self._scratch = np.zeros_like(self.stresses), np.zeros_like(self.stresses)
        self.internal = np.zeros((0, *self.stresses.shape))
        self.step = (np.zeros(0), np.zeros(0))
        self.set_material(None, None, 1.0)

    def set_material(self, relaxation: Prony | None, softening: Softening | None, factor: float) -> None:
        """Take over what relaxes and softens; `factor` is the instantaneous stress over that of the law."""
        self._prony: Prony | None = relaxation
        self._known: float | None = None
        terms = 0 if relaxation is None else len(relaxation.terms)
        if len(self.internal) != terms:
            self.internal = np.zeros((terms, *self.stresses.shape))
        self.past[FACTOR] = factor
        self.past[LOSS], self.past[LOSS_MODULUS], self.past[LOSS_SHARE] = (
            (0.0, 1.0, 0.0) if softening is None else (softening.loss, softening.modulus, softening.share))
        self.works = relaxation is not None or softening is not None
        if relaxation is None:
            self.inherited[:] = 0.0
        self.prepare(0.0)

    def prepare(self, dt: float) -> None:
        """Before a step of `dt` (s): 0 is a sudden one, infinity one that has come to rest."""
        self.dt = dt
        if self._prony is None:
            self.past[INSTANT] = 1.0
            return
        if dt != self._known:
            self._increment, self._known = self._prony.increment(dt), dt
        self.past[INSTANT], decay, gain = self._increment
        self.step = decay, gain
        np.multiply(self.before, -gain.sum(), out=self.inherited)
        for term, left in zip(self.internal, decay, strict=True):
            np.multiply(term, left, out=self._scratch)
            self.inherited += self._scratch

    def commit(self) -> None:
        """After a step that converged."""
        if not self.works:
            return
        if self._prony is not None:
            decay, gain = self.step
            np.subtract(self.stresses, self.before, out=self.before)
            for term, left, more in zip(self.internal, decay, gain, strict=True):
                term *= left
                np.multiply(self.before, more, out=self._scratch)
                term += self._scratch
            self.before[:] = self.stresses
        np.maximum(self.largest, self.energies, out=self.largest)

    def total(self) -> np.ndarray:
        """Isochoric second Piola stress of the last committed step, relaxation included, Pa, shape (elements, q,
        components)."""
        if self._prony is None:
            return self.stresses.copy()
        return (1.0 - self._prony.relaxing) * self.before + self.internal.sum(axis=0)

    @property
    def kept(self) -> tuple[np.ndarray, ...]:
        """All that a committed step leaves behind; to go back there, fill them with what they were."""
        return self.before, self.internal, self.largest, self.stresses
