"""Exact sensitivities of a solver's force with respect to its material, carried from step to step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tissue_sim.fem.assembly import INSTANT
from tissue_sim.fem.contact_kernels import HELD
from tissue_sim.fem.launch import BoundKernel
from tissue_sim.fem.sensitivity_kernel import FRESH, PARAMETER, respond_kernel
from tissue_sim.material import Material

if TYPE_CHECKING:
    from tissue_sim.fem.axisymmetric import AxisymmetricSolver


class Sensitivity:
    """Rates of a solver's state with a number of parameters, at its last committed step.

    Args:
        solver: before its first step.
        pairs: for each parameter the material with a little more and with a little less of it, and the difference:
            what the parameter does to coefficients, bulk modulus, relaxation, softening and layers is taken from them
            by a central difference of formulas, which is exact to about ten digits.

    Attributes:
        force: dF/dtheta at the last committed step, N per unit, shape (parameters,).
        changed: whether in that step points came into contact, left it, or changed between sticking and slipping: the
            force has a kink in the parameters near there.
    """

    def __init__(self, solver: AxisymmetricSolver, pairs: list[tuple[Material, Material, float]]):
        self._solver, self._pairs = solver, pairs
        m, (elements, q) = len(pairs), solver.weights.shape
        surface = solver.surface
        inputs = [tuple((more - less) / width
                        for more, less in zip(solver.inputs(up), solver.inputs(down), strict=True))
                  for up, down, width in pairs]
        coefficient_rates, kappa_rates, factor_rates, moduli_rates = (
            np.array([one[i] for one in inputs]).reshape(m, *np.shape(inputs[0][i])) for i in range(4))
        coefficients = solver.inputs(solver.material)[0]
        self._directions = np.concatenate([np.tile(coefficients, (m, 1)), coefficient_rates], axis=1)
        self._kappa_rates, self._moduli_rates = kappa_rates, np.ascontiguousarray(moduli_rates)
        self._past_rates = np.zeros((m, 5))
        self._past_rates[:, 0] = factor_rates
        for k, (up, down, width) in enumerate(pairs):
            more, less = (np.array([0.0, 1.0, 0.0] if s is None else [s.loss, s.modulus, s.share])
                          for s in (up.softening, down.softening))
            self._past_rates[k, 2:] = (more - less) / width
        self._inherited_rates = np.zeros((m, elements, q, 4))
        self._before_rates, self._stress_rates = np.zeros((m, elements, q, 4)), np.zeros((m, elements, q, 4))
        self._internal_rates = np.zeros((m, len(solver.memory.internal), elements, q, 4))
        self._largest_rates, self._energy_rates = np.zeros((m, elements, q)), np.zeros((m, elements, q))
        shape = (m, *surface.springs.shape, 2)
        self._multiplier_rates, self._anchor_rates = np.zeros(shape), np.zeros(shape)
        self._point_rates = np.zeros(shape)
        self.force, self.changed = np.zeros(m), False
        self._contact = np.zeros((3, *surface.springs.shape))
        # One parameter a launch: Taichi keeps what it has read of an array that the same kernel writes.
        self._which, self._direction = np.zeros(2, np.int32), np.zeros(self._directions.shape[1])
        scratch = [np.zeros_like(array) for array in (solver._residual, solver.x)]
        self._kernel = BoundKernel(respond_kernel(solver.mesh.element.name, solver.material.energy_law.kernel_energy), (
            self._which, *solver.response_arrays(), self._kappa_rates, self._moduli_rates, self._past_rates,
            self._inherited_rates, self._largest_rates, self._multiplier_rates, self._anchor_rates, self._direction,
            *scratch, self._stress_rates, self._energy_rates, self._point_rates, self.force))

    def advance(self) -> None:
        """After a step that converged, before it is committed."""
        solver, memory = self._solver, self._solver.memory
        decay, gain = memory.step
        steps = [tuple((more - less) / width for more, less in zip(
            solver.relaxation_step(up, memory.dt), solver.relaxation_step(down, memory.dt), strict=True))
            for up, down, width in self._pairs]
        for k, (instant_rate, decay_rate, gain_rate) in enumerate(steps):
            self._past_rates[k, INSTANT] = instant_rate
            self._inherited_rates[k] = (
                np.tensordot(decay_rate, memory.internal, 1) + np.tensordot(decay, self._internal_rates[k], 1)
                - gain_rate.sum() * memory.before - gain.sum() * self._before_rates[k])
        before = memory.stresses - memory.before
        solver.respond(self._launch)
        for k, (_instant_rate, decay_rate, gain_rate) in enumerate(steps):
            change_rate = self._stress_rates[k] - self._before_rates[k]
            self._internal_rates[k] = (
                _each(decay_rate) * memory.internal + _each(decay) * self._internal_rates[k]
                + _each(gain_rate) * before + _each(gain) * change_rate)
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
        surface = self._solver.surface
        normals = surface.rates[..., 4:6]
        anew = (surface.held[..., 0] > 0) & (surface.held != surface.anchors).any(axis=-1)
        along = np.stack([-normals[..., 1], normals[..., 0]], axis=-1)
        slid = np.einsum("kmqi,mqi->kmq", self._point_rates, along)[..., None] * along
        self._anchor_rates[:, anew] = slid[:, anew]
        touching = (surface.forces != 0).any(axis=-1)
        self._multiplier_rates[:, ~touching] = 0.0
        contact = np.stack([touching, surface.held[..., 0] == HELD, surface.ways])
        self.changed = bool((contact != self._contact).any())
        self._contact = contact


def _each(factors: np.ndarray) -> np.ndarray:
    """Factors of the terms, shaped for their stresses."""
    return factors[:, None, None, None]
