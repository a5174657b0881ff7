"""Prony series, drainage, softening, layers and puncture as data: what they compute and what they refuse."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import tissue_sim as ts
from tissue_sim.material.force_scaling import Puncture
from tissue_sim.material.material import Layer
from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import Poroelasticity, Prony, PronyTerm, compute_internal_stress_history_over_g

SERIES = Prony((PronyTerm(0.3, 2.0), PronyTerm(0.2, 50.0)))
NEO_HOOKE = ts.Material("neo_hooke", {"C10": 1000.0})


@pytest.mark.parametrize(("make", "field", "message"), [
    (lambda: PronyTerm(0.0, 1.0), "g", "between 0 and 1; got 0"),
    (lambda: PronyTerm(1.0, 1.0), "g", "between 0 and 1; got 1"),
    (lambda: PronyTerm(np.nan, 1.0), "g", "between 0 and 1; got nan"),
    (lambda: PronyTerm(0.1, 0.0), "tau", "must be a positive relaxation time"),
    (lambda: PronyTerm(0.1, np.inf), "tau", "must be a positive relaxation time"),
    (lambda: Prony(()), "terms", "1 to 13 terms; got 0"),
    (lambda: Prony((PronyTerm(0.01, 1.0),) * 14), "terms", "1 to 13 terms; got 14"),
    (lambda: Prony((PronyTerm(0.5, 1.0), PronyTerm(0.5, 2.0))), "terms", "must be below 1"),
    (lambda: Prony((PronyTerm(0.5, 1.0),), "relaxed"), "moduli", "instantaneous, long_term"),
    (lambda: Softening(1.0), "loss", "from 0 to below 1"),
    (lambda: Softening(-0.1), "loss", "from 0 to below 1"),
    (lambda: Softening(0.1, -1.0), "modulus", "must be finite and 0 or more"),
    (lambda: Softening(0.1, 0.0, 0.0), "modulus", "must not both be 0"),
    (lambda: Layer(0.0, 1.0), "thickness", "must be positive and finite"),
    (lambda: Layer(1e-3, 0.0), "ratio", "must be a positive finite factor"),
    (lambda: Puncture(0.0, 0.1), "depth", "must be positive and finite"),
    (lambda: Puncture(1e-3, 1.0), "drop", "from 0 to below 1"),
    (lambda: Poroelasticity(1.0, 1e-8), "phi", "from 0 to below 1"),
    (lambda: Poroelasticity(0.1, 0.0), "diffusivity", "must be positive and finite"),
    (lambda: Poroelasticity(0.1, 1e-8).make_prony_term(0.0), "contact_radius", "must be positive and finite"),
])
def test_refused(make, field, message):
    with pytest.raises(ts.InputError, match=message) as caught:
        make()
    assert caught.value.field == field


@pytest.mark.parametrize("dt", [1e-6, 0.1, 2.0, 300.0])
def test_increment_solves_the_rate_equation(dt):
    """dQ/dt + Q/tau = g dS/dt with S linear over the step, by a Runge-Kutta integrator."""
    Q, change = np.array([4.0, -3.0]), 7.0
    solved = solve_ivp(lambda t, q: SERIES.g * change / dt - q / SERIES.tau, (0.0, dt), Q, rtol=1e-11, atol=1e-12)
    exact = solved.y[:, -1]
    instant, decay, gain = SERIES.compute_recursion_coefficients(dt)
    np.testing.assert_allclose(decay * Q + gain * change, exact, rtol=1e-8)
    assert instant == pytest.approx(1.0 - 0.5 + gain.sum(), rel=1e-14)


def test_increment_at_its_ends():
    instant, decay, gain = SERIES.compute_recursion_coefficients(np.array([0.0, np.inf]))
    np.testing.assert_array_equal(instant, [1.0, 0.5])
    np.testing.assert_array_equal(decay, [[1.0, 1.0], [0.0, 0.0]])
    np.testing.assert_array_equal(gain, [[0.3, 0.2], [0.0, 0.0]])


def test_internal_stress_is_the_recursion():
    rng = np.random.default_rng(1)
    dt, S = rng.choice([0.0, 0.01, 1.0, 100.0, np.inf], 37), rng.normal(size=(37, 2))
    _, decay, gain = SERIES.compute_recursion_coefficients(dt)
    expected, Q, before = [], np.zeros((2, 2)), np.zeros(2)
    for n in range(37):
        Q = decay[n] * Q + gain[n] * (S[n] - before)[:, None]
        before = S[n]
        expected.append(Q)
    np.testing.assert_allclose(SERIES.g * compute_internal_stress_history_over_g(dt, S, SERIES.tau), expected,
                               rtol=1e-12, atol=1e-15)


def test_relaxation_modulus():
    time = np.array([0.0, 2.0, np.inf])
    np.testing.assert_allclose(SERIES.compute_relative_relaxation_modulus(time),
                               [1.0, 0.5 + 0.3 / np.e + 0.2 * np.exp(-0.04), 0.5], rtol=1e-14)


def test_moduli_of_both_conventions():
    instantaneous = dataclasses.replace(NEO_HOOKE, viscoelastic=SERIES)
    assert (instantaneous.mu0, instantaneous.mu_long_term) == pytest.approx((2000.0, 1000.0))
    long_term = dataclasses.replace(NEO_HOOKE, viscoelastic=Prony(SERIES.terms, "long_term"))
    assert (long_term.mu0, long_term.mu_long_term) == pytest.approx((4000.0, 2000.0))
    assert (long_term.E0, long_term.E_long_term) == pytest.approx((12000.0, 6000.0))
    assert long_term.make_prony_series(1.0).instantaneous_over_law_modulus_ratio == 1.0
    assert (NEO_HOOKE.mu0, NEO_HOOKE.mu_long_term, NEO_HOOKE.make_prony_series(1.0)) == (2000.0, 2000.0, None)


def test_the_bulk_modulus_does_not_relax():
    """Poisson's ratio 0.3: K/mu = 2 (1 + nu) / (3 (1 - 2 nu)) = 2.1667 and E = 2 (1 + nu) mu."""
    ratio = 2.6 / 1.2
    material = dataclasses.replace(NEO_HOOKE, bulk=ts.Bulk("bulk_ratio", ratio), viscoelastic=SERIES)
    assert pytest.approx(2.6 * 2000.0) == material.E0
    K = ratio * 2000.0
    assert material.E_long_term == pytest.approx(9 * K * 1000.0 / (3 * K + 1000.0))


def test_drainage_takes_the_time_of_the_contact():
    material = dataclasses.replace(NEO_HOOKE, poroelasticity=Poroelasticity(0.2, 1e-8))
    small, large = (material.make_prony_series(radius).terms[0] for radius in (8e-3, 40e-3))
    assert (small.g, small.tau) == (0.2, pytest.approx(6400.0)) and large.tau == pytest.approx(25 * small.tau)
    assert material.mu_long_term == pytest.approx(1600.0)
    both = dataclasses.replace(material, viscoelastic=Prony((PronyTerm(0.3, 2.0),), "long_term"))
    assert both.make_prony_series(8e-3) == Prony((PronyTerm(0.3, 2.0), small))
    assert both.mu_long_term == pytest.approx(both.mu0 * 0.5)
    absent = dataclasses.replace(NEO_HOOKE, poroelasticity=Poroelasticity(0.0, 1e-8))
    assert absent.make_prony_series(8e-3) is None and absent.mu_long_term == 2000.0
    with pytest.raises(ts.InputError, match="must be below 1") as caught:
        dataclasses.replace(material, viscoelastic=Prony((PronyTerm(0.8, 2.0),)))
    assert caught.value.field == "poroelasticity.phi"


@given(loss=st.floats(0, 0.99), modulus=st.floats(1e-3, 1e4), share=st.floats(0, 5), largest=st.floats(0, 1e6),
       part=st.floats(0, 1))
def test_softening_loses_at_most_its_loss_and_nothing_on_first_load(loss, modulus, share, largest, part):
    softening = Softening(loss, modulus, share)
    assert softening.factor(largest, largest) == 1.0
    assert 1.0 - loss - 1e-12 <= softening.factor(part * largest, largest) <= 1.0


def test_softening_factor():
    assert Softening(0.5).factor(0.0, 3.0) == pytest.approx(1 - 0.5 * np.tanh(1.0))
    assert Softening(0.5, 10.0, 0.2).factor(2.0, 7.0) == pytest.approx(1 - 0.5 * np.tanh(5.0 / 11.4))
    np.testing.assert_array_equal(Softening(0.5).factor(np.zeros(2), 0.0), [1.0, 1.0])
