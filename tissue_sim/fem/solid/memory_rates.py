"""How what the tissue remembers changes with parameters of its material."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tissue_sim.fem.history import Memory, PastColumn
from tissue_sim.material.viscoelasticity import Prony

#: A point whose energy is this near to the largest so far, of itself, is at it; below it, and beyond it, a step of the
#: differences leads over it from so near.
_TIE, _BELOW, _BEYOND = 1e-7, 1e-5, 1e-4


class MemoryRates:
    """Rates of a memory with m parameters, at the last committed step.

    Args:
        memory: of elements of one material.
        past_rates: of `Memory.past`, shape (m, 5).
        relaxations: of each parameter what relaxes with a little more and a little less of it.
        widths: difference of the two, shape (m,).

    Attributes:
        inherited: of what is left of earlier stresses in the step, nothing moving, shape (m, elements, q, 6).
    """

    def __init__(self, memory: Memory, past_rates: np.ndarray, relaxations: Sequence[tuple[Prony | None, Prony | None]],
                 widths: np.ndarray):
        self.memory, self._past_rates, self._relaxations, self._widths = memory, past_rates, relaxations, widths
        m = widths.size
        self._past_rates[:, PastColumn.INSTANT] = 0.0
        shape = (m, *memory.stresses.shape) if memory.works else (m, 0)
        self._before, self._largest = np.zeros(shape), np.zeros(shape[:-1])
        self._internal = np.zeros((m, *memory.internal.shape))
        self.inherited = np.zeros_like(self._before)
        self._kept: list[tuple[np.ndarray, np.ndarray]] = []
        self._decays, self._gains = np.zeros((2, m, len(memory.internal)))

    @property
    def kept(self) -> tuple[np.ndarray, ...]:
        """All that is carried from step to step, parameters first; to begin with others, fill them with those."""
        return self._before, self._internal, self._largest

    def begin_step(self) -> None:
        """Before the rates of a step are asked for, the memory being prepared for it."""
        memory = self.memory
        if not len(memory.internal):
            return
        decay, gain = memory.step
        for k, ((more, less), width) in enumerate(zip(self._relaxations, self._widths, strict=True)):
            if more is not None and less is not None and more != less:
                self._past_rates[k, PastColumn.INSTANT], self._decays[k], self._gains[k] = (
                    (np.asarray(a) - np.asarray(b)) / width
                    for a, b in zip(more.increment(memory.dt), less.increment(memory.dt), strict=True))
            self.inherited[k] = (np.tensordot(decay, self._internal[k], 1)
                                 + np.tensordot(self._decays[k], memory.internal, 1)
                                 - gain.sum() * self._before[k] - self._gains[k].sum() * memory.before)

    def begin_aside(self) -> bool:
        """Take points that are about at their largest load away from it, until `end_aside`, so that no difference
        straddles the kink there: those that are loaded on are as if for the first time, which changes no force, and
        `_BELOW` of the largest load is added to that of others. Returns whether there are any; then the forces have to
        be assembled anew."""
        memory = self.memory
        self._kept = []
        if memory.works and memory.past[PastColumn.LOSS] != 0.0:
            largest, more = memory.largest, memory.energies - memory.largest
            near = (largest > 0.0) & (more >= -_BELOW * largest) & (more <= _BEYOND * largest)
            if near.any():
                self._kept = [(array, array.copy()) for array in (largest, memory.stresses, memory.energies)]
                aside = np.where(more >= -_TIE * largest, 0.0, (1.0 + _BELOW) * largest)
                largest[near] = aside[near]
        return bool(self._kept)

    def end_aside(self) -> None:
        """Everything is as it was before `begin_aside`."""
        for array, before in self._kept:
            array[:] = before

    def directions(self, k: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Arrays of the memory that the assembly reads, and their rates with parameter k."""
        memory = self.memory
        if not memory.works:
            return []
        return [(memory.past, self._past_rates[k]), (memory.inherited, self.inherited[k]),
                (memory.largest, self._largest[k])]

    def commit(self, k: int, stress: np.ndarray, energy: np.ndarray) -> None:
        """What the memory makes of rates of stresses, Pa, shape (elements, q, 6), and energies of the law, J/m3, with
        parameter k, when the step is committed."""
        memory = self.memory
        if len(memory.internal):
            decay, gain = memory.step
            wide = (slice(None), None, None, None)
            self._internal[k] = (decay[wide] * self._internal[k] + self._decays[k][wide] * memory.internal
                                 + gain[wide] * (stress - self._before[k])
                                 + self._gains[k][wide] * (memory.stresses - memory.before))
        self._before[k] = stress
        self._largest[k] = np.where(memory.energies > memory.largest, energy, self._largest[k])
