"""Sampled elements of a solid, on its modes: forces and stiffness for amplitudes."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.reduced.elements_kernel import FOLLOWS, SETTINGS, elements_kernel
from tissue_sim.fem.reduced.model import Rest
from tissue_sim.fem.solid.batches import LANES, ElementBatches
from tissue_sim.fem.solid.element import SettingColumn
from tissue_sim.fem.solid.tissue import RegionElements, bulk_modulus, element_groups, layer_ratios
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.runtime import LOCK
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh

#: Change of the amplitudes over their size up to which a stiffness counts as that of the present state. Under a needle
#: the stiffness changes by 0.4 times this ratio.
SAME_STATE = 0.01


class SampledElements:
    """What some elements, each standing for several of its kind, answer to amplitudes of modes.

    The stiffness is kept in groups of elements, so that a step may compute a part of it anew and take the rest from the
    steps before.

    Args:
        mesh: of the whole solid.
        basis: what the modes move, m per amplitude, shape (freedoms, modes).
        elements: numbers of those that are looked at, shape (n,).
        shares: how many each stands for, shape (n,).
        layers: number of the material's layer of each element of the mesh, see `element_layers`.
        groups: of elements, whose stiffness is computed at one time.
        rest: how a solid that weighs stands where no mode moves it; None: undeformed.
        contact_radius: m; how fast the pores drain, see `Material.relaxation`.

    Attributes:
        at: amplitudes at the last evaluation, shape (modes,).
    """

    def __init__(self, mesh: SolidMesh, basis: np.ndarray, elements: np.ndarray, shares: np.ndarray, *,
                 layers: np.ndarray, groups: int = 1, contact_radius: float = 1.0, rest: Rest | None = None):
        connectivity = mesh.connectivity[elements]
        used, local = np.unique(connectivity, return_inverse=True)
        self._mesh, self._layers = mesh, layers[elements]
        # Those of each material stand together.
        chosen = {name: np.flatnonzero(np.isin(elements, each)) for name, each in element_groups(mesh).items()}
        chosen = {name: each for name, each in chosen.items() if each.size}
        part = SolidMesh(mesh.element, mesh.nodes[used], local.reshape(connectivity.shape))
        self._batches = batches = ElementBatches(part, tuple(chosen.values()), shares)
        points = batches.weights.shape[1]
        self._regions = tuple(RegionElements(name, each, points, SETTINGS) for name, each in chosen.items())
        for region in self._regions[1:]:
            region.settings[SettingColumn.ADDS] = True
        self.modes = modes = basis.shape[1]
        self._forces = np.zeros(modes)
        self._contact_radius = contact_radius
        freedoms, count = 3 * connectivity.shape[1], batches.batches
        basis = basis.reshape(-1, 3, modes)
        #: What the modes move: of all nodes, and of the elements in the lanes; those that are left over stay at rest.
        self._rows = np.ascontiguousarray(basis[used].reshape(-1, modes))
        self._x, self._x_before, self._motion = np.zeros((3, len(self._rows)))
        self._standing = np.zeros_like(batches.pressures)
        #: Displacement of the nodes and pressures where nobody touches it, and forces on the modes there, which the
        #: weight bears.
        self._at_rest, self.rest_pressures = np.zeros(len(self._rows)), np.zeros_like(batches.pressures)
        self._borne = np.zeros(modes)
        self._settled: tuple[np.ndarray, ...] = ()
        if rest is not None:
            self._at_rest = rest.displacement.reshape(-1, 3)[used].ravel()
            # Modes of an element that stands for several are smaller.
            self.rest_pressures = batches.in_lanes(rest.pressures[elements] * np.sqrt(shares)[:, None])
        self._x_before[:] = self._at_rest
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
        #: Amplitudes and time, s, for which the stiffness of each group was computed; time of the last committed step
        #: and of the one that is computed, s.
        self._computed_at, self._computed = np.zeros((groups, modes)), np.zeros(groups)
        self._time = self._now = 0.0
        self._tangent: np.ndarray | None = None
        #: Shear moduli in the lanes, Pa.
        self._moduli = np.zeros((count, LANES))

    @property
    def forces(self) -> np.ndarray:
        """On the modes at the last evaluation, N m per m, shape (modes,)."""
        return self._forces

    def _of(self, lanes: np.ndarray, part: slice) -> np.ndarray:
        """Rows of an array of the pressure modes that belong to batches."""
        rows = len(lanes) // self._batches.batches
        return lanes[rows * part.start : rows * part.stop]

    @property
    def are_known(self) -> bool:
        """Whether all of the stiffness has been computed since the material or the state was last put in place."""
        return self._next >= 0

    @property
    def least(self) -> float:
        """The smallest J there."""
        return min(float(region.least[0]) for region in self._regions)

    @property
    def pressures(self) -> np.ndarray:
        """Amplitudes of the pressure modes, Pa; part of the state."""
        return self._batches.pressures

    @property
    def remember(self) -> bool:
        """Whether any of the tissue does."""
        return any(region.memory.works for region in self._regions)

    @property
    def kept(self) -> tuple[np.ndarray, ...]:
        """All that the memory of a committed step is; to go back there, fill them with what they were."""
        return tuple(array for region in self._regions for array in region.memory.kept)

    def prepare(self, dt: float) -> None:
        """Before a step; see `Memory.prepare`."""
        self._now = self._time + dt
        for region in self._regions:
            region.memory.prepare(dt)

    def commit(self) -> None:
        """After a step that converged."""
        self._time = self._now
        for region in self._regions:
            region.memory.commit()

    def stiffness_age(self, amplitudes: np.ndarray) -> float | None:
        """Time since the oldest group of the stiffness was computed, s, in the step that is computed.

        Args:
            amplitudes: of the equilibrium of the step, shape (modes,).

        Returns:
            None if all groups are of this state: their amplitudes differ by at most `SAME_STATE` of their size.
        """
        changes = np.linalg.norm(self._computed_at - amplitudes, axis=1)
        is_old = changes > SAME_STATE * np.linalg.norm(amplitudes)
        return float((self._now - self._computed)[is_old].max()) if is_old.any() else None

    def set_material(self, material: Material, bulk_ratio: float) -> np.ndarray:
        """Take over laws, their parameters and what they remember, with bulk moduli of at most so many times the shear
        moduli; returns how many times as stiff the elements have become, as `pressures` stand, where they had a
        material.

        Raises:
            InputError: a bulk ratio that the elements do not take; nothing is changed.
        """
        batches, freedoms = self._batches, 3 * self._mesh.connectivity.shape[1]
        materials = [material.regions.get(region.name, material) for region in self._regions]
        wholes = [bulk_modulus(each, self._mesh) for each in materials]
        bulks = [min(whole, bulk_ratio * each.mu0) for whole, each in zip(wholes, materials, strict=True)]
        batches.set_moduli(layer_ratios(material, self._layers))
        before = self._moduli.copy()
        for region, part, stated, whole, bulk in zip(self._regions, batches.parts, materials, wholes, bulks,
                                                     strict=True):
            blocks = self._blocks[LANES * part.start : LANES * part.stop]
            named = region.set_material(stated, bulk, self._contact_radius) | batches.arrays(part) | {
                "x": self._x, "motion": self._motion, "groups": self._groups[part], "wanted": self._wanted,
                "blocks": blocks.reshape(len(blocks) * freedoms**2), "standing": self._of(self._standing, part)}
            # The volumes of the whole solid give the pressures that bear the weight with its own bulk modulus.
            per_bulk = (1.0 / whole - 1.0 / bulk) / batches.moduli[part]
            self._of(self._standing, part)[:] = (per_bulk[:, None] * self._of(self.rest_pressures, part).reshape(
                len(per_bulk), -1, LANES)).reshape(-1, LANES)
            with LOCK:
                kernel = elements_kernel(self._mesh.element.name, stated.energy_law.kernel_energy)
                region.kernel = BoundKernel.of(kernel, named)
            self._moduli[part] = stated.mu0 * batches.moduli[part]
        self._next = -1
        stiffer = np.divide(self._moduli, before, out=np.ones_like(before), where=before > 0.0)
        return np.repeat(stiffer, len(self.pressures) // len(stiffer), axis=0)

    def evaluate(self, amplitudes: np.ndarray, follows: bool, anew: int) -> None:
        """Find the forces at these amplitudes.

        Args:
            amplitudes: shape (modes,).
            follows: whether the pressures follow what has changed since the last evaluation, or stay as they are.
            anew: how many groups of the stiffness to compute anew; all after a change of the material.
        """
        np.dot(self._rows, amplitudes, out=self._x)
        self._x += self._at_rest
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
        with LOCK:
            for region in self._regions:
                region.settings[FOLLOWS] = follows
                region.kernel()
        np.dot(self._batches.residual[:-1], self._rows, out=self._forces)
        self._forces -= self._borne
        for group in wanted:
            self._tangent = None
            self._computed_at[group], self._computed[group] = amplitudes, self._now
            lanes = self._lanes[self._ends[group] : self._ends[group + 1]]
            pushed = np.matmul(self._blocks[self._ends[group] : self._ends[group + 1]], lanes)
            flat = lanes.reshape(-1, self.modes)
            self._tangents[group] = np.dot(flat.T, pushed.reshape(flat.shape))

    def settle(self) -> None:
        """Stand there, where it weighs, with the material as it is: the forces are what the weight bears."""
        if not self._at_rest.any():
            return
        self.pressures[:], self._borne[:] = self.rest_pressures, 0.0
        self.prepare(np.inf)
        self._now = self._time
        self.evaluate(np.zeros(self.modes), False, 0)
        self._borne[:] = self._forces
        self.commit()
        self._settled = tuple(array.copy() for array in self.kept)

    def forget(self) -> None:
        """Remember nothing but how it has settled."""
        for number, array in enumerate(self.kept):
            array[:] = self._settled[number] if self._settled else 0.0

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
