"""Sampled elements of a solid, on its modes: forces and stiffness for amplitudes."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.history import Memory
from tissue_sim.fem.reduced.projection import FOLLOWS, SETTINGS, projection_kernel
from tissue_sim.fem.solid.batches import LANES, ElementBatches
from tissue_sim.fem.solid.element import KAPPA, REMEMBERS
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.runtime import LOCK
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh


class SampledElements:
    """What some elements, each standing for several of its kind, answer to amplitudes of modes.

    The stiffness is kept in groups of elements, so that a step may compute a part of it anew and take the rest from the
    steps before.

    Args:
        mesh: of the whole solid.
        basis: what the modes move, m per amplitude, shape (freedoms, modes).
        elements: numbers of those that are looked at, shape (n,).
        shares: how many each stands for, shape (n,).
        groups: of elements, whose stiffness is computed at one time.
        contact_radius: m; how fast the pores drain, see `Material.relaxation`.

    Attributes:
        memory: what the tissue remembers.
    """

    def __init__(self, mesh: SolidMesh, basis: np.ndarray, elements: np.ndarray, shares: np.ndarray, *,
                 groups: int = 1, contact_radius: float = 1.0):
        connectivity = mesh.connectivity[elements]
        used, local = np.unique(connectivity, return_inverse=True)
        self._element = mesh.element
        part = SolidMesh(mesh.element, mesh.nodes[used], local.reshape(connectivity.shape))
        self._batches = batches = ElementBatches(part, shares=shares)
        self._settings, self._least = np.zeros(SETTINGS), np.zeros(1)
        self.modes = basis.shape[1]
        # The kernel takes two at a time: one that moves nothing makes them even.
        self._even = even = self.modes + self.modes % 2
        self._amplitudes, self._change, self._forces = np.zeros((3, even))
        self._contact_radius = contact_radius
        self.memory = Memory(batches.weights.shape, 6)
        nodes, count = connectivity.shape[1], batches.batches
        self._local = np.zeros(3 * nodes * LANES)
        places = 3 * (np.arange(nodes, dtype=np.int32)[:, None] * LANES + np.arange(LANES, dtype=np.int32))
        self._dofs = np.ascontiguousarray(np.tile(places, (count, 1)))
        lanes = np.zeros((count * LANES, 3 * nodes, even))
        lanes[: len(connectivity), :, : self.modes] = basis.reshape(-1, 3, self.modes)[connectivity].reshape(
            len(connectivity), -1, self.modes)
        self._basis = np.ascontiguousarray(np.moveaxis(lanes.reshape(count, LANES, -1), 1, -1).reshape(-1, LANES))
        groups = min(groups, count)
        self._groups = (np.arange(count) * groups // count).astype(np.int32)
        self._wanted, self._tangents = np.zeros(groups), np.zeros((groups, even, even))
        # The group whose turn is next; below 0 all are due.
        self._next = -1
        self._tangent: np.ndarray | None = None
        self._coefficients = np.zeros(0)
        self._kernel: BoundKernel | None = None

    @property
    def forces(self) -> np.ndarray:
        """On the modes at the last evaluation, N m per m, shape (modes,)."""
        return self._forces[: self.modes]

    @property
    def are_known(self) -> bool:
        """Whether all of the stiffness has been computed since the material or the state was last put in place."""
        return self._next >= 0

    @property
    def least(self) -> float:
        """The smallest J there."""
        return float(self._least[0])

    @property
    def pressures(self) -> np.ndarray:
        """Amplitudes of the pressure modes, Pa; part of the state."""
        return self._batches.pressures

    def set_material(self, material: Material, bulk: float) -> None:
        """Take over a law, its parameters and what it remembers; `bulk` in Pa."""
        coefficients = material.energy_law.kernel_coefficients(material.parameters)
        if coefficients.size == self._coefficients.size:
            self._coefficients[:] = coefficients
        else:
            self._coefficients = np.array(coefficients)
        memory = self.memory
        memory.set_material(material.relaxation(self._contact_radius), material.softening,
                            material.instantaneous_factor)
        self._settings[KAPPA], self._settings[REMEMBERS] = bulk, memory.works
        named = self._batches.arrays(self._batches.parts[0]) | {
            "settings": self._settings, "least": self._least, "amplitudes": self._amplitudes, "change": self._change,
            "basis": self._basis, "x": self._local, "dofs": self._dofs, "coefficients": self._coefficients,
            "past": memory.past, "inherited": memory.inherited, "largest": memory.largest,
            "stresses": memory.stresses, "energies": memory.energies, "on_modes": self._forces,
            "groups": self._groups, "wanted": self._wanted, "tangents": self._tangents}
        with LOCK:
            kernel = projection_kernel(self._element.name, material.energy_law.kernel_energy)
            self._kernel = BoundKernel.of(kernel, named)
        self._next = -1

    def evaluate(self, amplitudes: np.ndarray, change: np.ndarray | None, anew: int) -> None:
        """Find the forces at these amplitudes.

        Args:
            amplitudes: shape (modes,).
            change: since the last evaluation, which the pressures follow; None: they stay as they are.
            anew: how many groups of the stiffness to compute anew; all after a change of the material.
        """
        self._amplitudes[: self.modes] = amplitudes
        self._settings[FOLLOWS] = change is not None
        if change is not None:
            self._change[: self.modes] = change
        groups = self._wanted.size
        if self._next < 0:
            anew, self._next = groups, 0
        anew = min(anew, groups)
        self._wanted[:] = 0.0
        self._wanted[np.arange(self._next, self._next + anew) % groups] = 1.0
        self._next = (self._next + anew) % groups
        if anew:
            self._tangent = None
        assert self._kernel is not None
        with LOCK:
            self._kernel()

    def renew(self, amplitudes: np.ndarray) -> None:
        """Evaluate a state that was put in place: its volumes; all of the stiffness is due next."""
        self._next = -1
        self.evaluate(amplitudes, None, 0)
        self._next = -1

    @property
    def tangent(self) -> np.ndarray:
        """Stiffness between the modes, shape (modes, modes)."""
        if self._tangent is None:
            upper = self._tangents.sum(axis=0)[: self.modes, : self.modes]
            self._tangent = upper + np.triu(upper, 1).T
        return self._tangent
