"""Drucker stability of a law over a range of stretches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tissue_sim.laws.law import Law
from tissue_sim.laws.modes import MODES, STRETCH_MODES
from tissue_sim.public_names import make_getattr_for_old_names, with_old_names

__getattr__ = make_getattr_for_old_names(__name__, {"check_stability": "find_stability_range"})

#: Default range, stretch.
STRETCH_RANGE = (0.3, 3.0)


@with_old_names(stable="is_stable_in_whole_range")
@dataclass(frozen=True)
class StabilityRange:
    """Range of stretches in which a law is stable.

    Attributes:
        limits: mode -> (lowest, highest) stable stretch, connected to stretch 1; a limit equal to that of
            `stretch_range` means that the law is stable up to the end of the range.
        stretch_range: range that was checked.
    """

    limits: dict[str, tuple[float, float]]
    stretch_range: tuple[float, float]

    @property
    def is_stable_in_whole_range(self) -> bool:
        """Whether the law is stable in every mode over the whole range."""
        return all(limit == self.stretch_range for limit in self.limits.values())

    @property
    def stable_from(self) -> float:
        """Lowest stretch down to which the law is stable in all modes: the highest of their lower limits."""
        return max(low for low, _ in self.limits.values())

    @property
    def stable_to(self) -> float:
        """Highest stretch up to which the law is stable in all modes: the lowest of their upper limits."""
        return min(high for _, high in self.limits.values())

    def __str__(self) -> str:
        return self.describe()

    def describe(self) -> str:
        """Describe the result in one line for reports."""
        low, high = self.stretch_range
        if self.is_stable_in_whole_range:
            return f"stable for stretches {low:g} to {high:g} in uniaxial, planar and equibiaxial loading"
        parts = []
        for mode, (lower, upper) in self.limits.items():
            lost = [f"{kind} {limit:.3g}" for limit, end, kind in ((lower, low, "below"), (upper, high, "above"))
                    if limit != end]
            if lost:
                parts.append(f"{mode}: unstable {' and '.join(lost)}")
        return "; ".join(parts)


@lru_cache
def _compile_log_strain_hessian_entries(law: Law):
    """Return one compiled function: logarithmic strains of three stretches, parameters -> Hessian, conditions.

    The six entries d2W/(de_i de_j) are in the order 11, 22, 33, 12, 13, 23. The conditions of the domain follow.
    """
    return law.compile_cached_function("hessian", lambda: _derive_log_strain_hessian_entries(law))


def _derive_log_strain_hessian_entries(law: Law):
    """Return the arguments, and the six Hessian entries and the conditions of the domain as expressions."""
    import sympy as sp

    e = sp.symbols("e1:4", real=True)
    l1, l2, l3 = (sp.exp(strain) for strain in e)
    energy = law.energy_of_stretches(l1, l2, l3, law.symbols)
    entries = [sp.diff(energy, e[i], e[k]) for i, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return (*e, *law.symbols), [*entries, *law.list_domain_conditions_of_stretches(l1, l2, l3)]


def _compute_log_strain_hessian(law: Law, values: np.ndarray, strains: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return d2W/(de_i de_j), shape (3, 3, n), at logarithmic strains of shape (n, 3), and which are in the domain."""
    results = _compile_log_strain_hessian_entries(law)(*strains.T, *values)
    h = np.empty((3, 3, len(strains)))
    for (i, k), entry in zip(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)), results[:6], strict=True):
        h[i, k] = h[k, i] = entry
    return h, np.all([np.broadcast_to(condition > 0, len(strains)) for condition in results[6:]], axis=0)


def _is_stable_at_log_strains(law: Law, values: np.ndarray, strains: np.ndarray) -> np.ndarray:
    """Return whether d(tau) : d(e) > 0 for every volume-preserving d(e), shape (n,), at strains of shape (n, 3).

    The strains are logarithmic. A number that overflows counts as stable, a strain outside the domain as unstable.
    """
    with np.errstate(all="ignore"):
        h, is_inside = _compute_log_strain_hessian(law, values, strains)
        # The 2 x 2 matrix after elimination of strain k. Its determinant is the same for every k; the matrix with the
        # smallest off-diagonal entry loses the fewest digits by cancellation.
        pairs = []
        for i, j, k in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            a = h[i, i] - 2 * h[i, k] + h[k, k]
            b = h[i, j] - h[i, k] - h[k, j] + h[k, k]
            c = h[j, j] - 2 * h[j, k] + h[k, k]
            pairs.append((a, b, c))
        a, b, c = np.moveaxis(np.array(pairs), 1, 0)
        best = np.abs(b).argmin(axis=0), np.arange(len(strains))
        a, b, c = a[best], b[best], c[best]
        # An overflow is no evidence of instability.
        return is_inside & (~np.isfinite(a * c) | ((a + c > 0) & (a * c - b * b > 0)))


#: Rounding error of the determinant of a 3 x 3 matrix with unit diagonal. A minor above minus this value counts as 0.
_ROUNDING = 1e-13
#: Orthonormal basis of the volume-preserving logarithmic strains, shape (3, 2).
_ISOCHORIC_BASIS = np.array([[1.0, 1.0], [-1.0, 1.0], [0.0, -2.0]]) / np.sqrt([2.0, 6.0])


def compute_stability_margins(law: Law, values, stretch: np.ndarray) -> np.ndarray:
    """Return how far a law is from losing Drucker's stability in each mode, shape (modes, n), in the order of `MODES`.

    The margin is the smallest eigenvalue of d(tau)/d(e) over the largest absolute one, from -1 to 1; the law is stable
    where it is positive. It is -1 where the law is not defined, overflows or has no lateral equilibrium.

    Args:
        law: the law.
        values: parameters, SI.
        stretch: prescribed stretches, shape (n,).
    """
    array, stretch, found = law.convert_parameters_to_array(values), np.asarray(stretch, dtype=float), []
    for mode in MODES:
        stretches = law.compute_principal_stretches(stretch, array, mode)
        with np.errstate(all="ignore"):
            if law.is_compressible:
                hessian = law.compute_log_strain_hessian(stretches, array)
                is_inside = np.isfinite(stretches).all(axis=-1)
            else:
                full, is_inside = _compute_log_strain_hessian(law, array, np.log(stretches))
                hessian = np.einsum("ia,ikn,kb->nab", _ISOCHORIC_BASIS, full, _ISOCHORIC_BASIS)
        is_known = is_inside & np.isfinite(hessian).all(axis=(-2, -1))
        size = hessian.shape[-1]
        eigenvalues = np.linalg.eigvalsh(np.where(is_known[:, None, None], hessian, -np.eye(size)))
        largest = np.abs(eigenvalues).max(axis=-1)
        found.append(np.divide(eigenvalues[:, 0], largest, out=np.full(len(largest), -1.0), where=largest > 0))
    return np.array(found)


def _is_stable_with_change_of_volume(law: Law, values: np.ndarray, stretch: np.ndarray, mode: str) -> np.ndarray:
    """Return whether d(tau) : d(e) > 0 for every d(e), shape (n,), for a compressible law in a mode.

    A stretch without lateral equilibrium counts as unstable, a number that overflows at an equilibrium as stable.
    """
    stretches = law.compute_principal_stretches(stretch, values, mode)
    with np.errstate(all="ignore"):
        h = law.compute_log_strain_hessian(stretches, values)
        scale = 1.0 / np.sqrt(np.abs(np.einsum("nii->ni", h)))
        h = h * scale[:, :, None] * scale[:, None, :]
        minors = np.stack([h[:, 0, 0], h[:, 0, 0] * h[:, 1, 1] - h[:, 0, 1]**2, np.linalg.det(h)], axis=-1)
        is_positive = (minors > -_ROUNDING).all(axis=-1) | ~np.isfinite(minors).all(axis=-1)
        return np.isfinite(stretches).all(axis=-1) & is_positive


def find_stability_range(law: Law, values, stretch_range: tuple[float, float] = STRETCH_RANGE,
                         points: int = 400) -> StabilityRange:
    """Return the range of stretches in which a law fulfils Drucker's criterion, d(tau) : d(e) > 0.

    With the Kirchhoff stress tau and the logarithmic strain e, the 2 x 2 matrix d(tau)/d(e) of an incompressible solid
    is the Hessian of W in two of the logarithmic strains; the third is minus their sum. The matrix must be positive
    definite. It is checked from stretch 1 outwards in tension and compression of each mode, and the first loss is
    located by bisection. A law is not stable outside its domain, such as at I1 - 3 >= J_m of Gent's law. For a
    compressible law the 3 x 3 Hessian must be positive definite, at the stretches with traction-free sides.

    Source: Abaqus Analysis User's Guide, "Hyperelastic behavior of rubberlike materials" and "Hyperelastic behavior in
    elastomeric foams", Drucker stability.

    Args:
        law: the law.
        values: parameters, SI.
        stretch_range: (lowest, highest) stretch to check.
        points: number of samples in each direction.

    Examples:
        >>> from tissue_sim.laws import find_law
        >>> found = find_stability_range(find_law("reduced_polynomial_2"), {"C10": 1000.0, "C20": -300.0})
        >>> found.is_stable_in_whole_range, round(found.stable_from, 2), round(found.stable_to, 2)
        (False, 0.81, 1.25)
    """
    array = law.convert_parameters_to_array(values)

    def is_stable(stretch, mode):
        """Return whether the law is stable at each stretch of a mode, shape (n,)."""
        if law.is_compressible:
            return _is_stable_with_change_of_volume(law, array, np.atleast_1d(stretch), mode)
        direction = STRETCH_MODES[mode].exponent_matrix[:, 0]
        return _is_stable_at_log_strains(law, array, np.multiply.outer(np.log(np.atleast_1d(stretch)), direction))

    def find_last_stable_stretch(end, mode):
        """Return the last stable stretch from 1 towards `end`; `end` itself if the law is stable on the whole range."""
        stretches = np.geomspace(1.0, end, points + 1)
        unstable = np.flatnonzero(~is_stable(stretches, mode))
        if unstable.size == 0:
            return float(end)
        if unstable[0] == 0:
            return 1.0
        good, bad = stretches[unstable[0] - 1], stretches[unstable[0]]
        for _ in range(50):
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if is_stable(middle, mode)[0] else (good, middle)
        return float(good)

    low, high = stretch_range
    return StabilityRange({mode: (find_last_stable_stretch(low, mode), find_last_stable_stretch(high, mode))
                           for mode in MODES}, (float(low), float(high)))
