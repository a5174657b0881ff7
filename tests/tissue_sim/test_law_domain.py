"""Domain of a law from its formula: logarithms, fractional powers, denominators; overflow in the finite elements."""

import numpy as np
import pytest
import sympy as sp

import tissue_sim as ts
from tissue_sim.laws import InvariantLaw, StretchLaw
from tissue_sim.laws.domain import list_domain_conditions

#: First isochoric invariant, 1.
I1 = sp.Symbol("I1", positive=True)
#: Second isochoric invariant, 1.
I2 = sp.Symbol("I2", positive=True)
#: Coefficient of a formula, 1.
A = sp.Symbol("A", real=True)
#: Exponent of a formula, 1.
N = sp.Symbol("N", real=True)
REST = {I1: 3, I2: 3}


def evaluate(conditions, first, second=3.0, a=2.0, n=0.5):
    """Whether all conditions are positive at invariants and parameters."""
    return all(condition.subs({I1: first, I2: second, A: a, N: n}) > 0 for condition in conditions)


@pytest.mark.parametrize(("energy", "limit"), [
    (-A * sp.log(1 - (I1 - 3) / A), 5.0),
    (A * (1 - (I1 - 3) / A)**N, 5.0),
    (A / (5 - I1), 5.0),
    (A / (I1 - 5)**2, 5.0),
    (A * sp.sqrt(5 - I1), 5.0),
], ids=["logarithm", "power", "denominator", "negative denominator", "square root"])
def test_limit_of_the_first_invariant(energy, limit):
    """A denominator that is negative at rest stays negative."""
    conditions = list_domain_conditions(energy, REST)
    assert len(conditions) == 1
    assert evaluate(conditions, limit - 1e-9) and not evaluate(conditions, limit + 1e-9)


@pytest.mark.parametrize("energy", [
    A * (I1 - 3)**3 + N * (I2 - 3), A * sp.log(I2 / 3), A * (I1**N - 3**N), A * (sp.exp(N * (I1 - 3)) - 1),
    sp.log(A) * (I1 - 3) / N], ids=["polynomial", "positive argument", "positive base", "exponential", "parameters"])
def test_formulas_without_limit(energy):
    assert list_domain_conditions(energy, REST) == ()


def test_overflow_is_a_limit_of_the_finite_elements():
    energy = A * (sp.exp(N * (I1 - 3)) - 1)
    conditions = list_domain_conditions(energy, REST, includes_overflow=True)
    assert evaluate(conditions, 3.0 + 599.0) and not evaluate(conditions, 3.0 + 601.0)


def test_kernels_of_laws_without_limit_have_no_conditions():
    for name in ("neo_hooke", "biderman", "reduced_polynomial_3", "ogden_1", "ogden_3", "ogden_4", "arruda_boyce"):
        assert ts.find_law(name).kernel_energy.domain_conditions == ()
    for name in ("gent", "fung_demiray"):
        assert len(ts.find_law(name).kernel_energy.domain_conditions) == 1


class LimitedChains(InvariantLaw):
    """Law of another package with a limit of I1 and a positive logarithm."""

    name, title, units = "limited_chains", "Limited chains", {"mu": "Pa", "limit": "1"}

    def energy(self, I1, I2, mu, limit):
        return mu / 2 * (I1 - 3) / (1 - (I1 - 3) / limit) + mu / 10 * sp.log(I2 / 3)


class LimitedStretch(StretchLaw):
    """Law of another package whose largest stretch is 2."""

    name, title, units = "limited_stretch", "Limited stretch", {"mu": "Pa"}

    def energy_of_stretch(self, stretch, mu):
        return -mu * sp.log(2 - stretch) - mu * sp.log(stretch)


def test_laws_of_packages_need_no_statement():
    stretch = np.array([1.2, 1.6, 2.5])
    assert np.isfinite(LimitedChains().nominal_stress(stretch, {"mu": 1.0, "limit": 1.0})).tolist() == [
        True, True, False]
    assert np.isfinite(LimitedStretch().nominal_stress([1.5, 1.99, 2.01, 3.0], {"mu": 1.0})).tolist() == [
        True, True, False, False]
    # Compression by the stretch s has the lateral stretch s^-0.5, which is 2 for s = 0.25.
    assert np.isfinite(LimitedStretch().nominal_stress([0.26, 0.24], {"mu": 1.0})).tolist() == [True, False]
