"""Exact derivatives of a solid's force with respect to its material, carried from step to step.

At a converged step the equations of the tissue and of its contact are differentiated as they stand (Michaleris,
Tortorelli and Vidal, Int. J. Numer. Methods Eng. 37 (1994) 2471). What a parameter does to the forces of a tissue that
does not move is a central difference of the assembly, in the direction of all that depends on the parameter, the past
included; how the tissue moves for it is solved with the tangent at the converged state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.history import INSTANT, Memory
from tissue_sim.fem.linear.sparse import factorise
from tissue_sim.fem.solid.batches import ElementBatches
from tissue_sim.fem.solid.contact import ContactNodes
from tissue_sim.fem.solid.free_part import FreePart
from tissue_sim.fem.solver import Neighbours
from tissue_sim.material.material import Material
from tissue_sim.material.viscoelasticity import Prony

#: Half width of the differences, in those of the neighbours, which are a millionth of the parameter apart.
_WIDTH = 10.0
#: Linear solutions with one factor are refined until this share of the forces is left, or so often; more is no answer.
_LEFT, _ENOUGH, _SOLUTIONS = 1e-10, 1e-7, 12


@dataclass(frozen=True, eq=False)
class SolidParts:
    """What a sensitivity sees of its solver.

    Attributes:
        x: displacements, m, shape (freedoms,). free, moved: numbers of those that are free, and that the tool holds.
        batches, contact, memory, matrix: of the solver.
        inputs: arrays that the material sets and the assembly reads, written in place.
        assemble: forces at the state as it is, and the matrix, if asked for.
    """

    x: np.ndarray
    free: np.ndarray
    moved: np.ndarray
    batches: ElementBatches
    contact: ContactNodes
    memory: Memory
    matrix: FreePart
    inputs: tuple[np.ndarray, ...]
    assemble: Callable[[bool], None]


class SolidSensitivity:
    """Rates of a solver's state with m parameters, at its last committed step.

    Args:
        parts: of a solver before its first step.
        input_rates: of `parts.inputs` with each parameter, in their order. past_rates: of `Memory.past`, shape (m, 5).
        relaxations: of each parameter what relaxes with a little more and a little less of it.
        widths: difference of the two, shape (m,).

    Attributes:
        force: of the force along z, N per unit, shape (m,). vector: of all three components, shape (m, 3).
    """

    def __init__(self, parts: SolidParts, input_rates: Sequence[Sequence[np.ndarray]], past_rates: np.ndarray,
                 relaxations: Sequence[tuple[Prony | None, Prony | None]], widths: np.ndarray):
        self._parts, self._input_rates, self._past_rates = parts, input_rates, past_rates
        self._relaxations, self._half = relaxations, _WIDTH * widths
        self._widths, m = widths, widths.size
        memory, n = parts.memory, parts.contact.nodes.size
        self.vector = np.zeros((m, 3))
        self.force = self.vector[:, 2]
        self._anchors = np.zeros((n, 3, m))
        shape = (m, *memory.stresses.shape) if memory.works else (m, 0)
        self._before, self._largest = np.zeros(shape), np.zeros(shape[:-1])
        self._internal = np.zeros((m, *memory.internal.shape))
        self._kinds, self._changed = np.zeros((4, n), dtype=bool), False

    @classmethod
    def of(cls, parts: SolidParts, neighbours: Neighbours, here: Material, set_material: Callable[[Material], None],
           contact_radius: float) -> SolidSensitivity:
        """With what the solver's `set_material` makes of the neighbours of its material, which it has again afterwards.

        Args:
            parts: of a solver before its first step. neighbours: see `tissue_sim.fem.solver.Neighbours`.
            here: its material. contact_radius: m; how fast the pores drain.
        """
        def inputs(material: Material) -> list[np.ndarray]:
            set_material(material)
            return [array.copy() for array in (*parts.inputs, parts.memory.past)]

        try:
            sides = [(inputs(more), inputs(less)) for more, less, _ in neighbours]
        finally:
            set_material(here)
        widths = np.array([width for *_, width in neighbours])
        rates = [[(a - b) / width for a, b in zip(*both, strict=True)]
                 for both, width in zip(sides, widths, strict=True)]
        relaxations = [(more.relaxation(contact_radius), less.relaxation(contact_radius))
                       for more, less, _ in neighbours]
        past = np.array([rate[-1] for rate in rates]).reshape(-1, parts.memory.past.size)
        past[:, INSTANT] = 0.0
        return cls(parts, [rate[:-1] for rate in rates], past, relaxations, widths)

    def pop_changed(self) -> bool:
        """Whether since the last call the contact changed; see `tissue_sim.fem.solver.Derivatives`."""
        changed, self._changed = self._changed, False
        return changed

    def advance(self) -> None:
        """At an equilibrium whose contact was looked at with the bonds of the step, before it binds anew and anything
        is committed. The matrix is that of the tissue, and gets the rates of contact."""
        parts, m = self._parts, self._widths.size
        state = parts.contact.state
        self._changed |= not np.array_equal(state.kinds, self._kinds)
        self._kinds = state.kinds
        if not m:
            return
        inherited, decays, gains = self._inherited_rates()
        rates = np.empty((parts.x.size, m))
        for k in range(m):
            rates[:, k] = self._difference(k, inherited[k], None)[0]
        motion, forces = self._solve(rates)
        held = -(rates + self._product(motion))[parts.moved].reshape(-1, 3, m)
        self.vector[:] = held.sum(axis=0).T + forces[parts.contact.moves].sum(axis=0).T
        if parts.memory.works:
            self._remember(motion, inherited, decays, gains)
        self._anchors = state.anchor_rates(self._at_contact(motion), self._anchors)

    def _inherited_rates(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of what is left of earlier stresses, nothing moving now, shape (m, elements, q, 6), and of decay and gain of
        the terms, (m, terms)."""
        memory, m = self._parts.memory, self._widths.size
        terms = len(memory.internal)
        decays, gains = np.zeros((2, m, terms))
        inherited = np.zeros_like(self._before)
        if not terms:
            return inherited, decays, gains
        decay, gain = memory.step
        for k, ((more, less), width) in enumerate(zip(self._relaxations, self._widths, strict=True)):
            if more is not None and less is not None and more != less:
                self._past_rates[k, INSTANT], decays[k], gains[k] = (
                    (np.asarray(a) - np.asarray(b)) / width
                    for a, b in zip(more.increment(memory.dt), less.increment(memory.dt), strict=True))
            else:
                self._past_rates[k, INSTANT] = 0.0
            inherited[k] = (np.tensordot(decay, self._internal[k], 1) + np.tensordot(decays[k], memory.internal, 1)
                            - gain.sum() * self._before[k] - gains[k].sum() * memory.before)
        return inherited, decays, gains

    def _difference(self, k: int, inherited: np.ndarray, motion: np.ndarray | None) -> list[np.ndarray]:
        """Rates with parameter k of the forces, shape (freedoms,), and of stresses and energies of the law at the
        points; without motion at a fixed place. All of these are as they were afterwards."""
        parts, memory = self._parts, self._parts.memory
        arrays = [*parts.inputs, memory.past, parts.x]
        rates = [*self._input_rates[k], self._past_rates[k], np.zeros_like(parts.x) if motion is None else motion]
        if memory.works:
            arrays += [memory.inherited, memory.largest]
            rates += [inherited, self._largest[k]]
        results = [parts.batches.residual, memory.stresses, memory.energies]
        here = [array.copy() for array in arrays + results]
        found = []
        try:
            for step in (self._half[k], -self._half[k]):
                for array, value, rate in zip(arrays, here, rates, strict=False):
                    array[:] = value + step * rate
                parts.assemble(False)
                found.append([result.copy() for result in results])
        finally:
            for array, value in zip(arrays + results, here, strict=True):
                array[:] = value
        forces, *others = [(more - less) / (2.0 * self._half[k]) for more, less in zip(*found, strict=True)]
        return [forces[:-1], *others]

    def _solve(self, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How the tissue moves, m per unit, shape (freedoms, m), and how forces of its contact change, (n, 3, m)."""
        parts, contact = self._parts, self._parts.contact
        state, m = contact.state, rates.shape[1]
        motion, forces = np.zeros_like(rates), np.zeros((contact.nodes.size, 3, m))
        parts.matrix.add(contact.rates)
        factor = factorise(parts.matrix.free, symmetric=not state.slides.any())
        if factor is None:
            return np.full_like(motion, np.nan), np.full_like(forces, np.nan)
        # Measured by forces of tissue and contact; those of the springs that hold the contact are larger by far.
        size = np.linalg.norm(rates, axis=0)
        for _ in range(_SOLUTIONS):
            found, missing = state.force_rates(self._at_contact(motion), self._anchors, forces)
            right = rates + self._product(motion)
            np.add.at(right.reshape(-1, 3, m), contact.nodes, found + missing)
            left = np.linalg.norm(right[parts.free], axis=0)
            size = np.maximum(size, np.linalg.norm(found.reshape(-1, m), axis=0))
            if (left <= _LEFT * size).all():
                return motion, found
            change = np.zeros_like(motion)
            change[parts.free] = -factor.solve(np.asfortranarray(right[parts.free])).reshape(-1, m)
            motion += change
            forces = found + missing + contact.rates @ self._at_contact(change)
        found, _ = state.force_rates(self._at_contact(motion), self._anchors, forces)
        if not (left <= _ENOUGH * size).all():
            return np.full_like(motion, np.nan), np.full_like(found, np.nan)
        return motion, found

    def _product(self, motion: np.ndarray) -> np.ndarray:
        """Forces of the tissue alone for a motion, the rates of contact being in the matrix."""
        parts, contact = self._parts, self._parts.contact
        product = parts.matrix.all @ motion
        at = self._at_contact(motion)
        np.add.at(product.reshape(-1, 3, motion.shape[1]), contact.nodes, -(contact.rates @ at))
        return product

    def _at_contact(self, motion: np.ndarray) -> np.ndarray:
        return motion.reshape(-1, 3, motion.shape[1])[self._parts.contact.nodes]

    def _remember(self, motion: np.ndarray, inherited: np.ndarray, decays: np.ndarray, gains: np.ndarray) -> None:
        """What the memory makes of it when the step is committed."""
        memory = self._parts.memory
        for k in range(motion.shape[1]):
            _, stress, energy = self._difference(k, inherited[k], motion[:, k])
            if len(memory.internal):
                decay, gain = memory.step
                wide = (slice(None), None, None, None)
                self._internal[k] = (decay[wide] * self._internal[k] + decays[k][wide] * memory.internal
                                     + gain[wide] * (stress - self._before[k])
                                     + gains[k][wide] * (memory.stresses - memory.before))
            self._before[k] = stress
            self._largest[k] = np.where(memory.energies > memory.largest, energy, self._largest[k])
