"""Sampled elements of a solid, on its modes: forces and stiffness for amplitudes."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.history import Memory
from tissue_sim.fem.reduced.elements_kernel import FOLLOWS, SETTINGS, elements_kernel
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
        at: amplitudes at the last evaluation, shape (modes,).
    """

    def __init__(self, mesh: SolidMesh, basis: np.ndarray, elements: np.ndarray, shares: np.ndarray, *,
                 groups: int = 1, contact_radius: float = 1.0):
        connectivity = mesh.connectivity[elements]
        used, local = np.unique(connectivity, return_inverse=True)
        self._element = mesh.element
        part = SolidMesh(mesh.element, mesh.nodes[used], local.reshape(connectivity.shape))
        self._batches = batches = ElementBatches(part, shares=shares)
        self._settings, self._least = np.zeros(SETTINGS), np.zeros(1)
        self.modes = modes = basis.shape[1]
        self._forces = np.zeros(modes)
        self._contact_radius = contact_radius
        self.memory = Memory(batches.weights.shape, 6)
        freedoms, count = 3 * connectivity.shape[1], batches.batches
        basis = basis.reshape(-1, 3, modes)
        #: What the modes move: of all nodes, and of the elements in the lanes; those that are left over stay at rest.
        self._rows = np.ascontiguousarray(basis[used].reshape(-1, modes))
        self._x, self._x_before, self._motion = np.zeros((3, len(self._rows)))
        self.at = np.zeros(modes)
        # The stiffness is that of other steps in part: in single precision it takes half of the time.
        self._lanes = np.zeros((count * LANES, freedoms, modes), dtype=np.float32)
        self._lanes[batches.lane_of] = basis[connectivity].reshape(-1, freedoms, modes)
        self._blocks = np.zeros((count * LANES, freedoms, freedoms), dtype=np.float32)
        groups = min(groups, count)
        self._groups = (np.arange(count) * groups // count).astype(np.int32)
        #: Lanes of each group.
        self._ends = LANES * np.searchsorted(self._groups, np.arange(groups + 1))
        self._wanted, self._tangents = np.zeros(groups), np.zeros((groups, modes, modes))
        # The group whose turn is next; below 0 all are due.
        self._next = -1
        self._tangent: np.ndarray | None = None
        self._coefficients = np.zeros(0)
        self._kernel: BoundKernel | None = None

    @property
    def forces(self) -> np.ndarray:
        """On the modes at the last evaluation, N m per m, shape (modes,)."""
        return self._forces

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
            "settings": self._settings, "least": self._least, "x": self._x, "motion": self._motion,
            "coefficients": self._coefficients, "past": memory.past, "inherited": memory.inherited,
            "largest": memory.largest, "stresses": memory.stresses, "energies": memory.energies,
            "groups": self._groups, "wanted": self._wanted, "blocks": self._blocks.reshape(-1)}
        with LOCK:
            kernel = elements_kernel(self._element.name, material.energy_law.kernel_energy)
            self._kernel = BoundKernel.of(kernel, named)
        self._next = -1

    def evaluate(self, amplitudes: np.ndarray, follows: bool, anew: int) -> None:
        """Find the forces at these amplitudes.

        Args:
            amplitudes: shape (modes,).
            follows: whether the pressures follow what has changed since the last evaluation, or stay as they are.
            anew: how many groups of the stiffness to compute anew; all after a change of the material.
        """
        np.dot(self._rows, amplitudes, out=self._x)
        self._settings[FOLLOWS] = follows
        np.subtract(self._x, self._x_before, out=self._motion)
        self._x_before[:], self.at[:] = self._x, amplitudes
        groups = self._wanted.size
        if self._next < 0:
            anew, self._next = groups, 0
        anew = min(anew, groups)
        wanted = (np.arange(self._next, self._next + anew) % groups).tolist()
        self._wanted[:] = 0.0
        self._wanted[wanted] = 1.0
        self._next = (self._next + anew) % groups
        assert self._kernel is not None
        with LOCK:
            self._kernel()
        np.dot(self._batches.residual[:-1], self._rows, out=self._forces)
        for group in wanted:
            self._tangent = None
            lanes = self._lanes[self._ends[group] : self._ends[group + 1]]
            pushed = np.matmul(self._blocks[self._ends[group] : self._ends[group + 1]], lanes)
            flat = lanes.reshape(-1, self.modes)
            self._tangents[group] = np.dot(flat.T, pushed.reshape(flat.shape))

    def renew(self, amplitudes: np.ndarray) -> None:
        """Evaluate a state that was put in place: its volumes; all of the stiffness is due next."""
        self._next = -1
        self.evaluate(amplitudes, False, 0)
        self._next = -1

    @property
    def tangent(self) -> np.ndarray:
        """Stiffness between the modes, shape (modes, modes)."""
        if self._tangent is None:
            self._tangent = self._tangents.sum(axis=0)
        return self._tangent
