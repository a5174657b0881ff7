"""Laws of compressible solids, whose energy is not split into an isochoric and a volumetric part."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.laws.law import KernelEnergy, Law
from tissue_sim.laws.modes import STRETCH_MODES
from tissue_sim.public_names import LazyModule

if TYPE_CHECKING:
    import sympy as sp
else:
    sp = LazyModule("sympy")

#: Rows and columns of the entries of a symmetric 3 x 3 matrix in the order of the compiled function.
_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class LateralEquilibriumSettings:
    """Newton's method for the stretch of the traction-free directions.

    The prescribed stretches grow from 1 in increments, so that the solution stays on the branch that starts at rest.

    Attributes:
        increment: largest increment of the logarithm of a prescribed stretch, 1.
        max_iterations: limit of Newton's method per increment.
        tolerance: correction of the logarithmic strain, 1, after which the next one is below the rounding error.
        largest_correction: largest correction of the logarithmic strain in an iteration, 1.
    """

    increment: float = 0.25
    max_iterations: int = 25
    tolerance: float = 1e-10
    largest_correction: float = 0.5


#: Settings of all laws.
EQUILIBRIUM = LateralEquilibriumSettings()


class CompressibleLaw(Law):
    """Law W = w(l1) + w(l2) + w(l3) + u(J) of the full principal stretches and the volume ratio J = l1 l2 l3.

    A subclass defines `energy_of_stretch` and `energy_of_volume`. W, w and u are 0 at rest, and the stress is 0 there.
    The closed forms solve the stretch of the traction-free directions from equilibrium. Simple shear has J = 1 and the
    third stretch 1; its normal stresses are not 0.
    """

    is_compressible = True

    def energy_of_stretch(self, stretch, *parameters):
        """Return w as an expression of one stretch and the parameters."""
        raise TypeError(f"{type(self).__name__} must state energy_of_stretch(stretch, *parameters)")

    def energy_of_volume(self, J, *parameters):
        """Return u as an expression of the volume ratio and the parameters."""
        raise TypeError(f"{type(self).__name__} must state energy_of_volume(J, *parameters)")

    def energy_of_stretches(self, l1, l2, l3, parameters) -> sp.Expr:
        """Return W as an expression of the full principal stretches, whose product is J."""
        parts = [self.energy_of_stretch(s, *parameters) for s in (l1, l2, l3)]
        return sp.Add(*map(sp.sympify, parts), sp.sympify(self.energy_of_volume(l1 * l2 * l3, *parameters)))

    def list_domain_conditions_of_stretches(self, l1, l2, l3) -> list[sp.Expr]:
        """Return no conditions: w and u are defined for all positive stretches."""
        return []

    def formula_expression(self) -> sp.Expr:
        """Return w + u as an expression of one stretch, J and the parameters."""
        stretch, J = sp.symbols("lambda J", positive=True)
        return sp.sympify(self.energy_of_stretch(stretch, *self.symbols)) + sp.sympify(
            self.energy_of_volume(J, *self.symbols))

    def formula(self) -> str:
        """Return the formulas of W, w and u as text."""
        return f"W = w(lambda_1) + w(lambda_2) + w(lambda_3) + u(J), {super().formula().replace('W', 'w + u', 1)}"

    def latex(self) -> str:
        """Return the formulas of W, w and u in LaTeX."""
        return (r"W = w(\lambda_1) + w(\lambda_2) + w(\lambda_3) + u(J), \quad "
                + super().latex().replace("W", "w + u", 1))

    @property
    def kernel_energy(self) -> KernelEnergy:
        """Energy of the kernel: w + u/3 of one stretch and J, whose sum over the three stretches is W."""
        stretch, J = sp.symbols("stretch J", positive=True)
        return KernelEnergy(self.name, "stretches and volume", (stretch, J), self.symbols,
                            sp.sympify(self.energy_of_stretch(stretch, *self.symbols))
                            + sp.sympify(self.energy_of_volume(J, *self.symbols)) / 3)

    def compute_principal_stretches(self, stretch, values, mode: str = "uniaxial") -> np.ndarray:
        """Return the principal stretches of a homogeneous test, shape (..., 3); see `Law.compute_principal_stretches`.

        NaN where no stretch of the free directions on the branch from rest is in stable equilibrium.
        """
        prescribed, free = _make_directions(mode)
        strain = np.log(_stack_prescribed(stretch, prescribed.shape[1]))
        flat = self._solve_strains(strain.reshape(-1, prescribed.shape[1]), prescribed, free,
                                   self.convert_parameters_to_array(values))
        return np.exp(flat).reshape(*strain.shape[:-1], 3)

    def compute_energy_and_kirchhoff_stresses(self, stretches, values) -> tuple[np.ndarray, np.ndarray]:
        """Return energy density, J/m3, and principal Kirchhoff stresses tau_i = l_i dW/dl_i, Pa, with the pressure.

        Args:
            stretches: principal stretches, shape (..., 3).
            values: parameters, SI.
        """
        strains = np.log(np.asarray(stretches, dtype=float))
        energy, tau, _, _ = self._evaluate(strains, self.convert_parameters_to_array(values))
        return energy, tau

    def compute_log_strain_hessian(self, stretches, values) -> np.ndarray:
        """Return d2W/(de_i de_j) with the logarithmic strains e, Pa, shape (..., 3, 3) of stretches (..., 3)."""
        return self._evaluate(np.log(np.asarray(stretches, dtype=float)), self.convert_parameters_to_array(values))[2]

    def K0(self, values) -> float:
        """Initial bulk modulus, Pa: a third of the slope of the mean stress with the volumetric strain at rest."""
        return float(self.compute_log_strain_hessian(np.ones(3), values).sum() / 9.0)

    def _evaluate(self, strains: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return W, tau (..., 3), d tau/d e (..., 3, 3) and d tau/d parameter (..., 3, m) at logarithmic strains."""
        shape, count = strains.shape[:-1], len(self.parameters)
        with np.errstate(all="ignore"):
            results = _compile_stress_and_derivatives(self)(*np.moveaxis(strains, -1, 0), *values)
        items = np.stack([np.broadcast_to(np.asarray(item, dtype=float), shape) for item in results], axis=-1)
        hessian = np.empty((*shape, 3, 3))
        for n, (i, k) in enumerate(_ENTRIES):
            hessian[..., i, k] = hessian[..., k, i] = items[..., 4 + n]
        return items[..., 0], items[..., 1:4], hessian, items[..., 10:].reshape(*shape, 3, count)

    def _solve_strains(self, strain: np.ndarray, prescribed: np.ndarray, free: np.ndarray,
                       values: np.ndarray) -> np.ndarray:
        """Return the logarithmic principal strains, shape (n, 3), with equilibrium of the free directions.

        Args:
            strain: logarithms of the prescribed stretches, shape (n, k).
            prescribed: directions of these strains, shape (3, k).
            free: direction of the strain of the free directions, shape (3,).
            values: parameters.
        """
        along = strain @ prescribed.T
        if not free.any():
            return along
        lateral = np.zeros(len(strain))
        steps = max(1, int(np.ceil(np.nanmax(np.abs(strain), initial=0.0) / EQUILIBRIUM.increment)))
        increment = along / steps
        with np.errstate(all="ignore"):
            for step in range(steps + 1):
                change = np.full(len(strain), np.inf)
                for _ in range(EQUILIBRIUM.max_iterations):
                    _, tau, hessian, _ = self._evaluate(step * increment + np.outer(lateral, free), values)
                    moved = hessian @ free
                    stiffness = moved @ free
                    change = np.where(stiffness > 0, -(tau @ free) / stiffness, np.nan)
                    lateral = lateral + np.clip(change, -EQUILIBRIUM.largest_correction,
                                                EQUILIBRIUM.largest_correction)
                    if not (np.abs(change) > EQUILIBRIUM.tolerance).any():
                        break
                lateral = np.where(np.abs(change) <= EQUILIBRIUM.tolerance, lateral, np.nan)
                if step < steps:
                    # Along the tangent of the equilibrium path.
                    lateral = lateral - np.einsum("ni,ni->n", moved, increment) / stiffness
        return along + np.outer(lateral, free)

    def _evaluate_stress_slope_and_derivatives(self, mode, stretch, values) -> np.ndarray:
        """Return stress, slopes and parameter derivatives, as in `Law`; implicit differentiation of the equilibrium.

        With the free strain y, N . tau = 0 gives dy = -(N . H A dx + N . D dp) / (N . H N).
        """
        if mode == "simple_shear":
            return super()._evaluate_stress_slope_and_derivatives(mode, stretch, values)
        prescribed, _ = _make_directions(mode)
        given = np.ascontiguousarray(_stack_prescribed(stretch, prescribed.shape[1]), dtype=float)
        if given.shape[-1] != prescribed.shape[1]:
            raise InputError(f"must have {prescribed.shape[1]} values at each point; got {given.shape[-1]}.",
                             field="stretch")
        found = _evaluate_mode(self, mode, given.tobytes(), self.convert_parameters_to_array(values).tobytes())
        return found.reshape(*given.shape[:-1], *found.shape[1:]).copy()

    def evaluate_mode(self, mode: str, l: np.ndarray, array: np.ndarray) -> np.ndarray:
        """Return stress, slopes and parameter derivatives of prescribed stretches, shape (n, k), as (n, k, 1 + k + m).

        The argument `array` contains the parameters.
        """
        prescribed, free = _make_directions(mode)
        count = prescribed.shape[1]
        with np.errstate(all="ignore"):
            strains = self._solve_strains(np.log(l), prescribed, free, array)
            _, tau, hessian, rates = self._evaluate(strains, array)
            # Derivatives of tau with respect to the prescribed strains and the parameters, shape (n, 3, k + m).
            rates = np.concatenate([hessian @ prescribed, rates], axis=-1)
            if free.any():
                moved = hessian @ free
                rates = rates - np.einsum("ni,nk->nik", moved, np.einsum("i,nik->nk", free, rates)
                                          / (moved @ free)[:, None])
            loads = prescribed / prescribed.sum(axis=0)
            # The work of a load on the prescribed strain x is (A . tau) dx for all directions that it loads.
            stress = np.einsum("ij,ni->nj", loads, tau) / l
            found = np.einsum("ij,nik->njk", loads, rates) / l[:, :, None]
            found[..., :count] = (found[..., :count] - np.eye(count) * stress[:, :, None]) / l[:, None, :]
        return np.concatenate([stress[..., None], found], axis=-1)


@lru_cache(maxsize=8)
def _evaluate_mode(law: CompressibleLaw, mode: str, stretches: bytes, values: bytes) -> np.ndarray:
    """Return `CompressibleLaw.evaluate_mode`; cached, because a fit requests stress and derivatives in turn."""
    count = _make_directions(mode)[0].shape[1]
    return law.evaluate_mode(mode, np.frombuffer(stretches).reshape(-1, count), np.frombuffer(values))


def _make_directions(mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions of the prescribed logarithmic strains, (3, k), and of the free one, (3,), of a mode.

    The free directions are those that contract at constant volume; ``"confined"`` has none.
    """
    if mode == "confined":
        return np.array([[1.0], [0.0], [0.0]]), np.zeros(3)
    exponents = STRETCH_MODES[mode].exponent_matrix
    return np.maximum(exponents, 0.0), (exponents < 0).any(axis=1).astype(float)


def _stack_prescribed(stretch, count: int) -> np.ndarray:
    """Return prescribed stretches with their number on the last axis, shape (..., count)."""
    stretch = np.asarray(stretch, dtype=float)
    return stretch[..., None] if count == 1 else stretch


@lru_cache
def _compile_stress_and_derivatives(law: CompressibleLaw):
    """Return one compiled function: logarithmic strains, parameters -> see `_derive_stress_and_derivatives`."""
    return law.compile_cached_function("compressible", lambda: _derive_stress_and_derivatives(law))


def _derive_stress_and_derivatives(law: CompressibleLaw):
    """Return the arguments and the expressions W, tau (3), d tau/d e (6, `_ENTRIES`), d tau/d parameter (3 x m)."""
    e = sp.symbols("e1:4", real=True)
    l1, l2, l3 = (sp.exp(strain) for strain in e)
    energy = law.energy_of_stretches(l1, l2, l3, law.symbols)
    tau = [sp.diff(energy, strain) for strain in e]
    return (*e, *law.symbols), [energy, *tau, *(sp.diff(tau[i], e[k]) for i, k in _ENTRIES),
                                *(sp.diff(stress, parameter) for stress in tau for parameter in law.symbols)]
