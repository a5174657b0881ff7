"""What the axisymmetric solver knows of the past: committed states, memory of the tissue, contact and motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.axisymmetric.contact import ContactPoints
from tissue_sim.fem.axisymmetric.predictor import KEPT
from tissue_sim.fem.history import Memory
from tissue_sim.fem.inertia import Motion
from tissue_sim.fem.point_effects import PointEffects


@dataclass(frozen=True, eq=False)
class SavedState:
    """All that a committed step leaves behind: arrays of `State`, memory and contact, and see its attributes."""

    arrays: tuple[np.ndarray, ...]
    depths: tuple[float, ...]
    times: tuple[float, ...]
    largest_force: float
    unchanged: int
    touching: tuple[bytes, bytes]


class State:
    """The state that a step works on, and those that were committed.

    Args:
        x: where the first step begins, shape (unknowns,): nodal displacements, pressure amplitudes, contact forces.
        surface: points of the contact; memory: of the tissue; effects: at its points.

    Attributes:
        x: the state that a step works on.
        history: the latest committed states, shape (`KEPT`, unknowns), and `slots` their places, the latest first;
            depths: of the tool there, m.
        times: of those of them between which the tissue swung, the latest at 0, s.
        largest_force: so far, N.
        unchanged: equilibria since points last met the tool, left it, stuck or slipped, where contact is `watched`.
        motion: velocities, where somebody asked for inertia.
    """

    def __init__(self, x: np.ndarray, surface: ContactPoints, memory: Memory, effects: PointEffects):
        self.x, self.surface, self.memory, self.effects = x, surface, memory, effects
        self.history = np.zeros((KEPT, x.size))
        self.history[0] = x
        self.slots = np.arange(KEPT, dtype=np.int32)
        self.depths, self.times = [0.0], [0.0]
        self.largest_force = 0.0
        self.unchanged, self._touching = 0, (b"", b"")
        self.motion: Motion | None = None
        self._untouched = x.copy()
        self.note_bonds()

    def note_bonds(self) -> None:
        """Take how the points of the contact are bound now as how they are before the first step."""
        self._first_bonds = self.surface.anchors.copy(), self.surface.slipped.copy()

    @property
    def latest(self) -> np.ndarray:
        """The last committed state; a view."""
        return self.history[self.slots[0]]

    def commit(self, depth: float, swung: float, watched: bool) -> None:
        """Take over x as the equilibrium at a depth, m, and what memory and contact became there; the tissue swung to
        it for so long, s, or came to rest (0)."""
        self.times = [0.0, *(time - swung for time in self.times)][:KEPT] if swung else [0.0]
        if depth in self.depths and not swung:
            # Coming back to a known depth: newest first, without a second sample at the same place.
            place = self.depths.index(depth)
            order = [place, *(i for i in range(KEPT) if i != place)]
            slots = self.slots.tolist()
            self.slots[:] = [slots[i] for i in order]
            self.depths = [self.depths[i] for i in order if i < len(self.depths)]
        else:
            self.slots[1], self.slots[2], self.slots[0] = self.slots.tolist()
            self.depths = [depth, *self.depths][:KEPT]
        self.history[self.slots[0]] = self.x
        self.memory.commit()
        self.effects.commit()
        surface = self.surface
        surface.anchors[:], surface.slipped[:] = surface.held, surface.slip_signs
        if watched:
            touching = surface.forces.any(axis=-1).tobytes(), surface.slip_signs.tobytes()
            self.unchanged = self.unchanged + 1 if touching == self._touching else 0
            self._touching = touching

    def move_tool(self, depth: float) -> None:
        """Let the latest state be one with the tool at another depth, m, where it does not touch either. Earlier states
        belong to other motions and are forgotten."""
        self.depths, self.times = [depth], [0.0]

    def is_at_rest(self, nodal: int, tolerance: float) -> bool:
        """Whether the first `nodal` entries, displacements in m, differ by at most a tolerance from those before the
        first touch."""
        return float(np.abs(self.latest[:nodal] - self._untouched[:nodal]).max()) <= tolerance

    def lift_off(self) -> None:
        """Back to the displacements before the touch; memory stays."""
        self.slots[:], self.depths, self.times, self.unchanged = np.arange(KEPT), [0.0], [0.0], 0
        self.history[0] = self._untouched
        self.surface.anchors[:], self.surface.slipped[:] = self._first_bonds
        if self.motion is not None:
            self.motion.stop()

    def save(self) -> SavedState:
        """All that a committed step leaves behind."""
        return SavedState(tuple(array.copy() for array in self._kept), tuple(self.depths), tuple(self.times),
                          self.largest_force, self.unchanged, self._touching)

    def restore(self, saved: SavedState) -> None:
        """Go back to where `save` was called."""
        # Those of the motion come last, and one of the two may have none.
        for array, before in zip(self._kept, saved.arrays, strict=False):
            array[:] = before
        self.depths, self.times, self.largest_force = list(saved.depths), list(saved.times), saved.largest_force
        self.unchanged, self._touching = saved.unchanged, saved.touching

    @property
    def _kept(self) -> tuple[np.ndarray, ...]:
        return (self.history, self.slots, self.surface.anchors, self.surface.slipped, self.effects.states,
                *self.memory.kept, *(() if self.motion is None else self.motion.kept))
