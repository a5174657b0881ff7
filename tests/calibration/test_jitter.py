"""Jitter between replicates, from replicates whose jitter is known."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.statistics.jitter import ContactAndForceZeroJitter, WhitenedReplicate, estimate_jitter
from calibration.statistics.sensor_noise import SensorNoise, whiten_columns
from tissue_sim.rig.rig import generate_sensor_noise

#: Jitter of the contact, m.
CONTACT = 3e-5
#: Jitter of the zero, N.
ZERO = 0.01
#: Force in N at depth d (0 to 1 for 10 mm) of three tests, with their derivatives by d.
TESTS = [lambda d: (5.0 * d + 3.0 * d**3, 5.0 + 9.0 * d**2), lambda d: (4.0 * d + 5.0 * d**2, 4.0 + 10.0 * d),
         lambda d: (2.0 * d**1.5, 3.0 * d**0.5)]


def replicate(curve, rng, contact=CONTACT, zero=ZERO, samples=101, shift=None, noise=None, sign=1.0):
    """One replicate of force F(d) with parameters F = t1 f + t2 f^2 and one mesh-error column."""
    noise = noise or SensorNoise(0.02)
    d, time = np.linspace(0.0, 1.0, samples), np.linspace(0.0, 40.0, samples)
    force, slope = curve(d)
    columns = np.column_stack([slope / 0.01, np.ones(samples), force, force**2 / 8.0, 1e-3 * force * d])
    shared = 0.0 if shift is None else shift
    residual = sign * (columns[:, 0] * rng.normal(0.0, contact) + rng.normal(0.0, zero) + shared * columns[:, 4]
                       + generate_sensor_noise(samples, noise.deviation, int(rng.integers(2**31)), time=time,
                                               correlation_time=noise.correlation_time))
    white = whiten_columns(np.column_stack([columns, residual]), time, noise)
    return WhitenedReplicate(white[:, 5], white[:, 0], white[:, 1], white[:, 2:4], white[:, 4:5])


def campaign(seed, curves=TESTS, replicates=3, **known):
    rng = np.random.default_rng(seed)
    tests = []
    for curve in curves:
        shift = rng.normal()
        tests.append([replicate(curve, rng, shift=shift, **known) for _ in range(replicates)])
    return tests


def dense_criterion(tests, contact, zero):
    """-2 log restricted likelihood from the n x n covariance of all samples."""
    sizes = [one.residual.size for test in tests for one in test]
    covariance = np.eye(sum(sizes))
    fixed, residual, start = [], [], 0
    parameters = tests[0][0].parameters.shape[1]
    for number, test in enumerate(tests):
        first = start
        for one in test:
            part = slice(start, start := start + one.residual.size)
            covariance[part, part] += contact**2 * np.outer(one.contact, one.contact)
            covariance[part, part] += zero**2 * np.outer(one.zero, one.zero)
            columns = np.zeros((one.residual.size, parameters + 2 * len(tests)))
            columns[:, :parameters] = one.parameters
            columns[:, parameters + 2 * number] = one.contact
            columns[:, parameters + 2 * number + 1] = one.zero
            fixed.append(columns)
            residual.append(one.residual)
        shared = np.vstack([one.shared for one in test])
        covariance[first:start, first:start] += shared @ shared.T
    X, r = np.vstack(fixed), np.concatenate(residual)
    X = X / np.linalg.norm(X, axis=0)
    weighted = np.linalg.solve(covariance, X)
    information = X.T @ weighted
    squares = r @ np.linalg.solve(covariance, r) - r @ weighted @ np.linalg.solve(information, weighted.T @ r)
    return np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1] + squares


@pytest.mark.slow
@pytest.mark.parametrize(("curves", "replicates", "trials"), [(TESTS, 3, 120), (TESTS[:1], 10, 120), (TESTS, 2, 120)],
                         ids=["three tests of three", "one test of ten", "three pairs"])
def test_the_variances_are_recovered_in_the_mean(curves, replicates, trials):
    found = [estimate_jitter(campaign(seed, curves, replicates)) for seed in range(trials)]
    freedom = len(curves) * (replicates - 1)
    assert {one.freedom for one in found} == {freedom}
    error = 4 * np.sqrt(2 / freedom / trials)
    assert np.mean([one.contact**2 for one in found]) == pytest.approx(CONTACT**2, rel=error)
    # A replicate's own noise hides a few mN of its zero, so the scatter is less well known.
    assert np.mean([one.zero**2 for one in found]) == pytest.approx(ZERO**2, rel=1.4 * error)


@pytest.mark.slow
def test_coloured_noise_is_not_taken_for_jitter():
    noise = SensorNoise(0.02, 2.0)
    trials = 60
    found = [estimate_jitter(campaign(seed, noise=noise, replicates=4)) for seed in range(trials)]
    assert np.mean([one.contact**2 for one in found]) == pytest.approx(CONTACT**2, rel=4 * np.sqrt(2 / 9 / trials))


@pytest.mark.slow
def test_without_jitter_it_is_zero_or_below_what_a_replicate_resolves():
    found = [estimate_jitter(campaign(seed, contact=0.0, zero=0.0)) for seed in range(60)]
    assert np.mean([one.contact == 0.0 for one in found]) > 0.4
    assert np.mean([one.zero == 0.0 for one in found]) > 0.4
    one = campaign(0)[0][0]
    assert max(found, key=lambda each: each.contact).contact < 10 / np.linalg.norm(one.contact)
    only_zero = [estimate_jitter(campaign(seed, contact=0.0)) for seed in range(60)]
    assert np.mean([one.zero**2 for one in only_zero]) == pytest.approx(ZERO**2, rel=0.4)
    assert np.mean([one.contact for one in only_zero]) < 0.1 * CONTACT


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_it_is_the_maximum_of_the_dense_likelihood(seed):
    rng = np.random.default_rng(seed)
    tests = [[replicate(TESTS[0], rng, samples=n) for n in (20, 31, 25)], [replicate(TESTS[2], rng, samples=15)],
             [replicate(TESTS[1], rng, samples=n) for n in (22, 18)]]
    found = estimate_jitter(tests)
    assert found.freedom == 3
    least = dense_criterion(tests, found.contact, found.zero)
    contacts = [0.0, *np.geomspace(1e-7, 1e-3, 25), 0.97 * found.contact, 1.03 * found.contact]
    zeros = [0.0, *np.geomspace(1e-5, 0.3, 25), 0.97 * found.zero, 1.03 * found.zero]
    assert min(dense_criterion(tests, contact, zero) for contact in contacts for zero in zeros) > least - 1e-4


def test_what_is_stated_is_held():
    tests = campaign(1)
    assert estimate_jitter(tests, contact=1e-5, zero=0.0) == ContactAndForceZeroJitter(1e-5, 0.0, None)
    held = estimate_jitter(tests, zero=ZERO)
    assert held.zero == ZERO
    assert held.freedom == 6
    assert 0.3 * CONTACT < held.contact < 2 * CONTACT
    below, at, above = (dense_criterion(tests, share * held.contact, ZERO) for share in (0.95, 1.0, 1.05))
    assert at < min(below, above)


def test_no_replicates_say_nothing():
    single = [[test[0]] for test in campaign(2)]
    assert estimate_jitter(single) == ContactAndForceZeroJitter(0.0, 0.0, 0)
    assert estimate_jitter(single, contact=3e-5) == ContactAndForceZeroJitter(3e-5, 0.0, 0)
    assert estimate_jitter([]) == ContactAndForceZeroJitter(0.0, 0.0, 0)


def test_a_misfit_that_all_replicates_share_is_not_jitter():
    """The model is 0.3 mm and 0.1 N off in one test: ten times the jitter, the same in every replicate."""
    tests = campaign(3)
    off = [[WhitenedReplicate(one.residual + 3e-4 * one.contact + 0.1 * one.zero, one.contact, one.zero,
                              one.parameters, one.shared) for one in tests[0]], *tests[1:]]
    plain, shifted = estimate_jitter(tests), estimate_jitter(off)
    assert shifted.contact == pytest.approx(plain.contact, rel=1e-3)
    assert shifted.zero == pytest.approx(plain.zero, rel=1e-3)


def test_parameters_may_be_dependent_and_shared_columns_absent():
    tests = campaign(4)
    changed = [[WhitenedReplicate(one.residual, one.contact, one.zero,
                                  np.column_stack([1e6 * one.parameters, one.parameters[:, 0], 0 * one.residual]),
                                  one.shared) for one in test] for test in tests]
    plain, dependent = estimate_jitter(tests), estimate_jitter(changed)
    assert dependent.contact == pytest.approx(plain.contact, rel=1e-3)
    bare = [[WhitenedReplicate(one.residual, one.contact, one.zero, one.parameters[:, :0], one.shared[:, :0])
             for one in test] for test in tests]
    assert estimate_jitter(bare).contact == pytest.approx(plain.contact, rel=0.05), "within a test nothing else moves"


def test_a_linear_force_cannot_tell_offset_from_zero_and_does_not_fail():
    rng = np.random.default_rng(5)
    test = [replicate(lambda d: (8.0 * d, 8.0 + 0 * d), rng) for _ in range(4)]
    found = estimate_jitter([test])
    # 800 N/m x 0.03 mm and 0.01 N make 0.026 N together, however it is divided.
    assert np.hypot(800 * found.contact, found.zero) == pytest.approx(0.026, rel=0.8)


@pytest.mark.parametrize("misfit", [1e6, 1e9, 1e12])
def test_a_model_that_misses_by_any_measure_gives_numbers(misfit):
    """Jitter that swallows a column to rounding is not tried; it ended in a singular matrix."""
    rng = np.random.default_rng(2)
    tests = [[replicate(TESTS[0], rng) for _ in range(2)]]
    far = [replace(one, residual=sign * misfit * (one.residual + one.contact**2))
           for one, sign in zip(tests[0], (1.0, -1.0), strict=True)]
    found = estimate_jitter([far])
    assert np.isfinite([found.contact, found.zero]).all() and found.contact >= 0 and found.zero >= 0
