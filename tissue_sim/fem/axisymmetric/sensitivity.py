"""Exact sensitivities of a solver's force with respect to its material, carried from step to step."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.axisymmetric.contact import NORMAL_R, NORMAL_Z
from tissue_sim.fem.axisymmetric.contact_kernels import HELD
from tissue_sim.fem.axisymmetric.equations import Equations
from tissue_sim.fem.axisymmetric.sensitivity_kernel import ALL_POINTS, FRESH, NOTED, PARAMETER, respond_kernel
from tissue_sim.fem.history import FACTOR, INSTANT, LOSS
from tissue_sim.fem.solver import Neighbours
from tissue_sim.fem.taichi.launch import BoundKernel


class Sensitivity:
    """Rates of a solver's state with a number of parameters, at its last committed step.

    Args:
        equations: of a solver before its first step.
        neighbours: what each parameter does to coefficients, bulk modulus, relaxation, softening and layers is taken
            from them by a central difference of formulas, which is exact to about ten digits.

    Attributes:
        force: dF/dtheta at the last committed step, N per unit, shape (parameters,).
    """

    def __init__(self, equations: Equations, neighbours: Neighbours):
        self._equations = equations
        m, (elements, q) = len(neighbours), equations.reference.weights.shape
        surface, memory = equations.surface, equations.memory
        here = equations.inputs(equations.material)
        rates = [np.zeros((m, *np.shape(array))) for array in here]
        for k, (up, down, width) in enumerate(neighbours):
            above, below = (map(np.asarray, equations.inputs(material)) for material in (up, down))
            for rate, more, less in zip(rates, above, below, strict=True):
                rate[k] = (more - less) / width
        coefficient_rates, kappa_rates, factor_rates, moduli_rates = rates
        self._directions = np.concatenate([np.tile(here[0], (m, 1)), coefficient_rates], axis=1)
        self._past_rates = np.zeros((m, 5))
        self._past_rates[:, FACTOR] = factor_rates
        for k, (up, down, width) in enumerate(neighbours):
            more, less = (np.array([0.0, 1.0, 0.0] if s is None else [s.loss, s.modulus, s.share])
                          for s in (up.softening, down.softening))
            self._past_rates[k, LOSS:] = (more - less) / width
        self._inherited_rates = np.zeros((m, elements, q, 4))
        self._before_rates, self._stress_rates = np.zeros((m, elements, q, 4)), np.zeros((m, elements, q, 4))
        self._internal_rates = np.zeros((m, len(memory.internal), elements, q, 4))
        self._relaxations = [(equations.relaxation(up), equations.relaxation(down), width)
                             for up, down, width in neighbours]
        self._decay_rates, self._gain_rates = np.zeros((2, m, len(memory.internal)))
        self._largest_rates, self._energy_rates = np.zeros((m, elements, q)), np.zeros((m, elements, q))
        shape = (m, *surface.springs.shape, 2)
        self._multiplier_rates, self._anchor_rates = np.zeros(shape), np.zeros(shape)
        self._point_rates = np.zeros(shape)
        self.force, self._changed = np.zeros(m), False
        self._contact = np.zeros((3, *surface.springs.shape))
        # One parameter a launch: Taichi keeps what it has read of an array that the same kernel writes.
        self._which, self._direction = np.zeros(3, np.int32), np.zeros(self._directions.shape[1])
        self._which[ALL_POINTS] = memory.works or moduli_rates.any()
        energy = equations.material.energy_law.kernel_energy
        self._kernel = BoundKernel(respond_kernel(equations.mesh.element.name, energy), {
            **equations.shared_arrays(), **self._undeformed(), "which": self._which, "kappa_rates": kappa_rates,
            "moduli_rates": moduli_rates, "past_rates": self._past_rates, "inherited_rates": self._inherited_rates,
            "largest_rates": self._largest_rates, "multiplier_rates": self._multiplier_rates,
            "anchor_rates": self._anchor_rates, "direction": self._direction, "stress_rates": self._stress_rates,
            "energy_rates": self._energy_rates, "point_rates": self._point_rates, "force_rates": self.force,
            **self._scratch()})

    def _undeformed(self) -> dict[str, np.ndarray]:
        """Arrays of the kernel that depend on the mesh alone."""
        mesh, reference = self._equations.mesh, self._equations.reference
        moved = self._equations.direction[1::2][mesh.connectivity]
        return {"connectivity": np.ascontiguousarray(mesh.connectivity, dtype=np.int32),
                "node_gradients": reference.node_gradients, "element_moduli": self._equations.moduli,
                "quadrature": np.ascontiguousarray(
                    np.concatenate([reference.weights[..., None], reference.pressure_modes], axis=-1)),
                "along": np.einsum("eqai,ea->eqi", reference.node_gradients[..., :2], moved)}

    def _scratch(self) -> dict[str, np.ndarray]:
        equations, element = self._equations, self._equations.mesh.element
        points = equations.reference.weights.shape
        return {"gap_rates": np.zeros((points[0], element.pressure_modes)), "node_forces": np.zeros((element.nodes, 2)),
                "centre_force": np.zeros((points[0], 2)), "law": np.zeros((*points, NOTED)),
                "base": np.zeros_like(equations.residual), "dx": np.zeros_like(equations.state.x)}

    def pop_changed(self) -> bool:
        """Whether since the last call points came into contact, left it, or changed between sticking and slipping: the
        force has a kink in the parameters near there."""
        changed, self._changed = self._changed, False
        return changed

    def advance(self) -> None:
        """After a step that converged, before it is committed."""
        memory = self._equations.memory
        decay, gain = memory.step
        for k, (up, down, width) in enumerate(self._relaxations):
            if up == down or up is None or down is None:
                changes = [np.zeros(()), np.zeros_like(decay), np.zeros_like(gain)]
            else:
                above, below = (map(np.asarray, series.increment(memory.dt)) for series in (up, down))
                changes = [(more - less) / width for more, less in zip(above, below, strict=True)]
            self._past_rates[k, INSTANT], self._decay_rates[k], self._gain_rates[k] = changes
        if memory.works:
            # The sums over terms of decay times internal stress and gain times stress, differentiated.
            self._inherited_rates[:] = (
                np.einsum("kt,teqi->keqi", self._decay_rates, memory.internal)
                + np.einsum("t,kteqi->keqi", decay, self._internal_rates)
                - self._gain_rates.sum(axis=1)[:, None, None, None] * memory.before - gain.sum() * self._before_rates)
        change = memory.stresses - memory.before
        self._equations.respond(self._launch)
        if memory.works:
            self._internal_rates *= _each(decay)
            self._internal_rates += _each(self._decay_rates) * memory.internal + _each(self._gain_rates) * change
            self._internal_rates += _each(gain) * (self._stress_rates - self._before_rates)[:, None]
            self._before_rates[:] = self._stress_rates
            higher = memory.energies > memory.largest
            self._largest_rates[:, higher] = self._energy_rates[:, higher]
        self._follow_contact()

    def _launch(self) -> None:
        self._which[FRESH] = 1
        for k, direction in enumerate(self._directions):
            self._which[PARAMETER], self._direction[:] = k, direction
            self._kernel()
        if self._which[FRESH]:
            self.force[:] = np.nan

    def _follow_contact(self) -> None:
        """Where a point was bound anew its anchor moves with it along the surface; where it parted nothing presses."""
        surface = self._equations.surface
        normals = surface.rates[:, [NORMAL_R, NORMAL_Z]]
        anew = (surface.held[:, 0] > 0) & (surface.held != surface.anchors).any(axis=-1)
        along = np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
        slid = np.einsum("kni,ni->kn", self._point_rates, along)[..., None] * along
        self._anchor_rates[:, anew] = slid[:, anew]
        touching = (surface.forces != 0).any(axis=-1)
        self._multiplier_rates[:, ~touching] = 0.0
        contact = np.stack([touching, surface.held[:, 0] == HELD, surface.ways])
        self._changed |= bool((contact != self._contact).any())
        self._contact = contact


def _each(factors: np.ndarray) -> np.ndarray:
    """Factors of the terms, shaped for their stresses."""
    return factors[..., None, None, None]
