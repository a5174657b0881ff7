"""Committed states of the axisymmetric solver: displacements, memory of the tissue, contact bonds and velocities.

The next equilibrium is predicted by Lagrange extrapolation of earlier states by depth or by time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.axisymmetric.contact import ContactPoints
from tissue_sim.fem.history import MaterialMemory, PointEffects
from tissue_sim.fem.inertia import InertiaTimeIntegrator
from tissue_sim.fem.taichi.origins import allocate_array, copy_to_addressable_array

#: Number of stored states from which the predictor extrapolates.
KEPT = 3


def compute_extrapolation_weights(known: Sequence[float], depth: float, order: int) -> list[float]:
    """Return the weights with which Lagrange extrapolation combines the `KEPT` stored states.

    w_i = prod over j != i of (d - d_j) / (d_i - d_j). States closer together than a tenth of the step are omitted,
    because extrapolation would amplify their rounding errors.

    Args:
        known: depths (m) or times (s) of the states, the latest first.
        depth: depth or time to which the states are extrapolated, in the same unit.
        order: highest polynomial order; 0 returns the latest state.
    """
    weights = [0.0] * KEPT
    if depth in known:
        weights[known.index(depth)] = 1.0
        return weights
    # Plain loops: this function runs in every step, and generators take twice the time.
    chosen, least = [0], 0.1 * abs(depth - known[0])
    for i in range(1, len(known)):
        if len(chosen) > order:
            break
        for j in chosen:
            if abs(known[i] - known[j]) < least:
                break
        else:
            chosen.append(i)
    for i in chosen:
        weight = 1.0
        for j in chosen:
            if j != i:
                weight *= (depth - known[j]) / (known[i] - known[j])
        weights[i] = weight
    return weights


@dataclass(frozen=True, eq=False)
class SavedState:
    """Copy of a `SolverState`, for `SolverState.restore`.

    Attributes:
        arrays: arrays of the state, contact, effects, memory and motion.
        depths, times, largest_force, equilibria_since_contact_change: see `SolverState`.
        touching: contact state at the last equilibrium.
    """

    arrays: tuple[np.ndarray, ...]
    depths: tuple[float, ...]
    times: tuple[float, ...]
    largest_force: float
    equilibria_since_contact_change: int
    touching: tuple[bytes, bytes]


class SolverState:
    """Solution vector that a step changes, and the last committed solution vectors with bonds and history.

    Args:
        x: initial state, shape (unknowns,): nodal displacements (m), pressure amplitudes, contact forces (N).
        surface: contact points.
        memory: memory of the tissue.
        effects: effects at the quadrature points.

    Attributes:
        x: state that a step changes, shape (unknowns,).
        history: last committed states, shape (`KEPT`, unknowns).
        slots: rows of `history`, the latest state first, shape (`KEPT`,).
        depths: depths of the tool in these states, the latest first, m.
        times: times of the latest states of an inertial motion relative to the last one, s.
        largest_force: largest force so far, N.
        equilibria_since_contact_change: number of equilibria since a contact point last touched, separated, stuck or
            slipped; counted if `commit_step` is called with ``watched=True``.
        motion: velocities and accelerations; None without inertia.
    """

    def __init__(self, x: np.ndarray, surface: ContactPoints, memory: MaterialMemory, effects: PointEffects):
        self.x, self.surface, self.memory, self.effects = x, surface, memory, effects
        self.history = allocate_array((KEPT, x.size))
        self.history[0] = x
        self.slots = copy_to_addressable_array(np.arange(KEPT, dtype=np.int32))
        self.depths, self.times = [0.0], [0.0]
        self.largest_force = 0.0
        self.equilibria_since_contact_change, self._touching = 0, (b"", b"")
        self.motion: InertiaTimeIntegrator | None = None
        self._untouched = x.copy()
        self.store_initial_bonds()

    def store_initial_bonds(self) -> None:
        """Store the present contact bonds as the bonds before the first step.

        `restore_untouched_shape_and_bonds` needs them.
        """
        self._first_bonds = self.surface.anchors.copy(), self.surface.slipped.copy()

    @property
    def last_committed_solution(self) -> np.ndarray:
        """Solution vector of the last committed step, a view, shape (unknowns,)."""
        return self.history[self.slots[0]]

    def commit_step(self, depth: float, duration: float, watched: bool) -> None:
        """Commit x as the solution at a depth, with the material history and the contact bonds of the step.

        Args:
            depth: depth of the tool, m.
            duration: duration of an inertial step, s; 0 for a quasi-static step.
            watched: whether changes of the contact state are counted in `equilibria_since_contact_change`.
        """
        self.times = [0.0, *(time - duration for time in self.times)][:KEPT] if duration else [0.0]
        if depth in self.depths and not duration:
            # The new state replaces the one at the same depth, because the predictor needs different depths.
            known = self.depths.index(depth)
            order = [known, *(i for i in range(KEPT) if i != known)]
            slots = self.slots.tolist()
            self.slots[:] = [slots[i] for i in order]
            self.depths = [self.depths[i] for i in order if i < len(self.depths)]
        else:
            self.slots[1], self.slots[2], self.slots[0] = self.slots.tolist()
            self.depths = [depth, *self.depths][:KEPT]
        self.history[self.slots[0]] = self.x
        self.memory.commit_step()
        self.effects.commit_step()
        surface = self.surface
        surface.anchors[:], surface.slipped[:] = surface.held, surface.slip_signs
        if watched:
            forces = surface.forces
            # Twice as fast as any(axis=-1).
            touching = ((forces[:, 0] != 0.0) | (forces[:, 1] != 0.0)).tobytes(), surface.slip_signs.tobytes()
            is_same = touching == self._touching
            self.equilibria_since_contact_change = self.equilibria_since_contact_change + 1 if is_same else 0
            self._touching = touching

    def restart_depth_history_at(self, depth: float) -> None:
        """Set the depth of a tool in the air for the latest state; earlier states are no longer used to extrapolate.

        Args:
            depth: depth of the tool, m.
        """
        self.depths, self.times = [depth], [0.0]

    def have_displacements_recovered(self, nodal: int, tolerance: float) -> bool:
        """Return whether the displacements differ from those before the first touch by at most a tolerance.

        Args:
            nodal: number of displacement components, the first entries of the state.
            tolerance: largest difference, m.
        """
        return float(np.abs(self.last_committed_solution[:nodal] - self._untouched[:nodal]).max()) <= tolerance

    def restore_untouched_shape_and_bonds(self) -> None:
        """Restore the displacements and bonds before the first touch; the material history stays."""
        self.slots[:], self.depths, self.times, self.equilibria_since_contact_change = np.arange(KEPT), [0.0], [0.0], 0
        self.history[0] = self._untouched
        self.surface.anchors[:], self.surface.slipped[:] = self._first_bonds
        if self.motion is not None:
            self.motion.reset_velocity()

    def save(self) -> SavedState:
        """Return a copy of the committed state, for `restore`."""
        return SavedState(tuple(array.copy() for array in self._state_arrays), tuple(self.depths), tuple(self.times),
                          self.largest_force, self.equilibria_since_contact_change, self._touching)

    def restore(self, saved: SavedState) -> None:
        """Restore a state that `save` returned."""
        # The arrays of the motion come last; either of the two may lack them.
        for array, before in zip(self._state_arrays, saved.arrays, strict=False):
            array[:] = before
        self.depths, self.times, self.largest_force = list(saved.depths), list(saved.times), saved.largest_force
        self.equilibria_since_contact_change, self._touching = saved.equilibria_since_contact_change, saved.touching

    @property
    def _state_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays that `save` copies."""
        return (self.history, self.slots, self.surface.anchors, self.surface.slipped, self.effects.states,
                *self.memory.state_arrays, *(() if self.motion is None else self.motion.state_arrays))
