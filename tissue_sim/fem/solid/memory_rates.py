"""Derivatives of the material history with respect to parameters of the material."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.history import MaterialMemory, RelaxationSofteningCoefficient
from tissue_sim.material.viscoelasticity import Prony


@dataclass(frozen=True)
class SofteningKinkSettings:
    """Distances from the kink of a softening law, where the energy density of a point reaches its largest value so far.

    Attributes:
        tie: relative distance below which the energy density and its largest value are equal, 1.
        below: relative distance below the largest value within which a difference could cross the kink, 1.
        beyond: relative distance above the largest value within which a difference could cross the kink, 1.
    """

    tie: float = 1e-7
    below: float = 1e-5
    beyond: float = 1e-4


_KINK = SofteningKinkSettings()


class HistoryDerivatives:
    """Derivatives of the history of one material with respect to m parameters, at the last committed step.

    Args:
        memory: history of the elements of the material.
        past_rates: derivatives of `MaterialMemory.past`, shape (m, 5).
        relaxations: for each parameter the relaxing terms with the parameter increased and decreased.
        widths: differences of the two parameter values, shape (m,).

    Attributes:
        inherited: derivatives of the contribution of earlier stresses in the step, shape (m, elements, q, 6).
    """

    def __init__(self, memory: MaterialMemory, past_rates: np.ndarray,
                 relaxations: Sequence[tuple[Prony | None, Prony | None]], widths: np.ndarray):
        self.memory, self._past_rates, self._relaxations, self._widths = memory, past_rates, relaxations, widths
        m = widths.size
        self._past_rates[:, RelaxationSofteningCoefficient.INSTANT] = 0.0
        shape = (m, *memory.stresses.shape) if memory.works else (m, 0)
        self._before, self._largest = np.zeros(shape), np.zeros(shape[:-1])
        self._internal = np.zeros((m, *memory.internal.shape))
        self.inherited = np.zeros_like(self._before)
        self._kept: list[tuple[np.ndarray, np.ndarray]] = []
        self._decays, self._gains = np.zeros((2, m, len(memory.internal)))

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Derivatives of stresses, internal variables and largest energy density, parameters first.

        Writing saved copies into these arrays restores the derivatives of another step.
        """
        return self._before, self._internal, self._largest

    def compute_inherited_derivatives(self) -> None:
        """Set `inherited` for a step, after `MaterialMemory.set_step_duration`."""
        memory = self.memory
        if not len(memory.internal):
            return
        decay, gain = memory.step
        for k, ((more, less), width) in enumerate(zip(self._relaxations, self._widths, strict=True)):
            if more is not None and less is not None and more != less:
                self._past_rates[k, RelaxationSofteningCoefficient.INSTANT], self._decays[k], self._gains[k] = (
                    (np.asarray(a) - np.asarray(b)) / width
                    for a, b in zip(more.compute_recursion_coefficients(memory.dt),
                                    less.compute_recursion_coefficients(memory.dt), strict=True))
            self.inherited[k] = (np.tensordot(decay, self._internal[k], 1)
                                 + np.tensordot(self._decays[k], memory.internal, 1)
                                 - gain.sum() * self._before[k] - self._gains[k].sum() * memory.before)

    def begin_shift_from_kink(self) -> bool:
        """Shift points near their largest energy density away from the kink there, until `end_shift_from_kink`.

        Differences must not cross the kink. Points under increasing load are treated as on first load, which changes no
        force; for others `SofteningKinkSettings.below` of the largest value is added to it.

        Returns:
            Whether there are such points; the forces must then be assembled again.
        """
        memory = self.memory
        self._kept = []
        if memory.works and memory.past[RelaxationSofteningCoefficient.LOSS] != 0.0:
            largest, more = memory.largest, memory.energies - memory.largest
            near = (largest > 0.0) & (more >= -_KINK.below * largest) & (more <= _KINK.beyond * largest)
            if near.any():
                self._kept = [(array, array.copy()) for array in (largest, memory.stresses, memory.energies)]
                aside = np.where(more >= -_KINK.tie * largest, 0.0, (1.0 + _KINK.below) * largest)
                largest[near] = aside[near]
        return bool(self._kept)

    def end_shift_from_kink(self) -> None:
        """Restore the values before `begin_shift_from_kink`."""
        for array, before in self._kept:
            array[:] = before

    def get_input_and_derivative_pairs(self, k: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return pairs (history array that the assembly reads, its derivative with respect to parameter k)."""
        memory = self.memory
        if not memory.works:
            return []
        return [(memory.past, self._past_rates[k]), (memory.inherited, self.inherited[k]),
                (memory.largest, self._largest[k])]

    def commit_derivatives_for_parameter(self, k: int, stress: np.ndarray, energy: np.ndarray) -> None:
        """Update the derivatives of the history with respect to parameter k when a step is committed.

        Args:
            k: index of the parameter.
            stress: derivative of the stress of the law, Pa, shape (elements, q, 6).
            energy: derivative of the energy density, J/m3, shape (elements, q).
        """
        memory = self.memory
        if len(memory.internal):
            decay, gain = memory.step
            wide = (slice(None), None, None, None)
            self._internal[k] = (decay[wide] * self._internal[k] + self._decays[k][wide] * memory.internal
                                 + gain[wide] * (stress - self._before[k])
                                 + self._gains[k][wide] * (memory.stresses - memory.before))
        self._before[k] = stress
        self._largest[k] = np.where(memory.energies > memory.largest, energy, self._largest[k])
