"""State variables of relaxation and softening at the quadrature points."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from tissue_sim.fem.taichi.array_tables import ArrayLayout, real_array_type
from tissue_sim.fem.taichi.origins import allocate_array
from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import Prony


class RelaxationSofteningCoefficient(IntEnum):
    """Indices of `MaterialMemory.past`: coefficients of relaxation and softening in this step, equal at all points."""

    #: Instantaneous stress over the stress of the law, 1.
    FACTOR = 0
    #: Fraction of a stress increment of this step that acts at once, 1; see `Prony.increment`.
    INSTANT = 1
    #: Parameters of `Softening`: loss (1), modulus (Pa) and share (1).
    LOSS = 2
    LOSS_MODULUS = 3
    LOSS_SHARE = 4


#: Coefficients of the law, and the arrays of `MaterialMemory`.
MATERIAL_ARRAYS = ArrayLayout(
    coefficients=real_array_type(), past=real_array_type(), inherited=real_array_type(3), largest=real_array_type(2),
    stresses=real_array_type(3), energies=real_array_type(2), before=real_array_type(3), internal=real_array_type(4))


class MaterialMemory:
    """Material history (relaxation, softening) at the quadrature points, in arrays that the kernel of a step uses.

    The recursion is that of `tissue_sim.material.viscoelasticity`: the stress of the law is linear in time within a
    step.

    Args:
        points: number of elements and number of quadrature points of an element.
        components: number of components of a symmetric tensor.

    Attributes:
        past: coefficients of the stresses in this step, see `RelaxationSofteningCoefficient`, shape (5,).
        inherited: contribution of earlier steps to the isochoric second Piola-Kirchhoff stress, Pa, shape
            (elements, q, components).
        largest: largest isochoric energy density so far, J/m3, shape (elements, q).
        stresses, energies: stress and energy density of the law in this step, softened, not relaxed.
        before: `stresses` of the last committed step.
        internal: Q_i of each term, Pa, shape (terms, elements, q, components).
        step: decay and gain of each term in this step, shapes (terms,).
    """

    def __init__(self, points: tuple[int, int], components: int):
        self.past = allocate_array((len(RelaxationSofteningCoefficient),))
        self.inherited, self.stresses, self.before, self._scratch = (
            allocate_array((*points, components)) for _ in range(4))
        self.largest, self.energies = allocate_array(points), allocate_array(points)
        self.internal = allocate_array((0, *self.stresses.shape))
        self.step = (np.zeros(0), np.zeros(0))
        self.set_relaxation_and_softening(None, None, 1.0)

    def set_relaxation_and_softening(self, relaxation: Prony | None, softening: Softening | None,
                                     factor: float) -> None:
        """Set relaxation and softening of the material; None: the material has none.

        Args:
            relaxation: Prony series.
            softening: softening by the largest energy density so far.
            factor: instantaneous stress over the stress of the law, 1.
        """
        self._prony: Prony | None = relaxation
        self._known: float | None = None
        terms = 0 if relaxation is None else len(relaxation.terms)
        if len(self.internal) != terms:
            self.internal = allocate_array((terms, *self.stresses.shape))
        self.past[RelaxationSofteningCoefficient.FACTOR] = factor
        self.past[[RelaxationSofteningCoefficient.LOSS, RelaxationSofteningCoefficient.LOSS_MODULUS,
                   RelaxationSofteningCoefficient.LOSS_SHARE]] = (
            (0.0, 1.0, 0.0) if softening is None else (softening.loss, softening.modulus, softening.share))
        self.works = relaxation is not None or softening is not None
        if relaxation is None:
            self.inherited[:] = 0.0
        self.set_step_duration(0.0)

    def set_step_duration(self, dt: float) -> None:
        """Set the duration of the next step, and compute the inherited stresses.

        Args:
            dt: duration, s; 0: a sudden step; infinity: the relaxed state.
        """
        self.dt = dt
        if self._prony is None:
            self.past[RelaxationSofteningCoefficient.INSTANT] = 1.0
            return
        if dt != self._known:
            self._increment, self._known = self._prony.compute_recursion_coefficients(dt), dt
        self.past[RelaxationSofteningCoefficient.INSTANT], decay, gain = self._increment
        self.step = decay, gain
        np.multiply(self.before, -gain.sum(), out=self.inherited)
        for term, left in zip(self.internal, decay, strict=True):
            np.multiply(term, left, out=self._scratch)
            self.inherited += self._scratch

    def commit_step(self) -> None:
        """Update the history with the stresses and energies of the last step; to be called if the step converged."""
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

    def compute_committed_stress_with_relaxation(self) -> np.ndarray:
        """Return the isochoric stress of the last committed step with relaxation, Pa, shape (elements, q, components).

        The second Piola-Kirchhoff stress is (1 - sum g) S + sum Q_i.
        """
        if self._prony is None:
            return self.stresses.copy()
        return (1.0 - self._prony.relaxing_fraction) * self.before + self.internal.sum(axis=0)

    def collect_arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return the arrays of `MATERIAL_ARRAYS` except the coefficients of the law."""
        return {"past": self.past, "inherited": self.inherited, "largest": self.largest, "stresses": self.stresses,
                "energies": self.energies, "before": self.before, "internal": self.internal}

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays that define the committed state; writing saved copies into them restores the state."""
        return self.before, self.internal, self.largest, self.stresses
