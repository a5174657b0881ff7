"""Coverage of the intervals of populations (mean, spread, next specimen) and of the bands of held-out specimens.

    python -m benchmarks population [--populations 1000] [--campaigns 200]

Two correlated parameters; the errors of the specimens' own fits are strongly correlated, as those of C10 and C20 are.
A campaign compresses each specimen once, fits them with numbers of their own, and holds the recordings of further ones
against the bands that the mean predicts them with. In one case the exponent is the same in all.
"""

import argparse
from pathlib import Path

import numpy as np

import tissue_sim as ts
from calibration.campaign.campaign import Campaign, FitSettings, Noise, Test
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameters import PER_SPECIMEN, ScopedCampaignParameter
from calibration.fit.curves import compute_test_curves
from calibration.fit.ordinary import OrdinaryLeastSquaresEstimator, fit_law_to_descents_and_estimate
from calibration.fit.population import (
    PredictionParameters,
    determine_population_and_left_out_specimens,
    make_held_out_predictor_or_none,
)
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.population import estimate_population
from calibration.statistics.sensor_noise import SensorNoise
from tissue_sim.material.material import get_law_parameter_declaration

MEAN = np.array([1400.0, 700.0])
ERROR = np.array([60.0, 40.0])
CORRELATION = {"errors": -0.8, "specimens": 0.5}


def covariance(deviations, correlation):
    outer = np.outer(deviations, deviations)
    outer[0, 1] *= correlation
    outer[1, 0] *= correlation
    return outer


def coverage(specimens: int, ratio: float, populations: int, rng) -> np.ndarray:
    """Return the fraction of populations whose intervals contain mean, spread and a new specimen (first parameter).

    Args:
        ratio: spread between specimens, in units of the error of a specimen's own fit.
    """
    between = covariance(ratio * ERROR, CORRELATION["specimens"])
    held = np.zeros(3)
    for _ in range(populations):
        errors = np.array([covariance(ERROR * factor, CORRELATION["errors"])
                           for factor in rng.uniform(0.5, 1.5, specimens)])
        truth = rng.multivariate_normal(MEAN, between, specimens + 1)
        estimates = np.array([rng.multivariate_normal(own, error)
                              for own, error in zip(truth[:-1], errors, strict=True)])
        found = estimate_population(["C10", "C20"], [str(i) for i in range(specimens)], estimates, errors)
        for k, (interval, value) in enumerate(((found.mean_intervals, MEAN[0]),
                                               (found.spread_intervals, ratio * ERROR[0]),
                                               (found.next_specimen, truth[-1, 0]))):
            held[k] += interval[0, 0] <= value <= interval[0, 1]
    return 100.0 * held / populations


#: Law -> numbers of the typical specimen, their standard deviations between specimens, and depth in mm.
LAWS = {"reduced_polynomial_2": ((1400.0, 700.0), (200.0, 90.0), 6.0), "ogden_1": ((3000.0, 8.0), (200.0, 0.0), 2.0)}
#: Radius of a specimen, m.
RADIUS = 0.015
#: Height of a specimen, m.
HEIGHT = 0.020
#: Standard deviation of the force, N.
NOISE = 0.02
#: Number of further specimens that test the prediction.
FURTHER = 20


def held_out_coverage(name: str, specimens: int, rng) -> np.ndarray:
    """Return the fractions of samples and of whole new specimens inside their bands, %."""
    law, (mean, spread, depth) = ts.find_law(name), LAWS[name]
    kind, tests, measured = ts.KINDS["lubricated_compression"], [], {}
    for k in range(specimens + FURTHER):
        specimen = ts.Specimen(RADIUS, HEIGHT, name=f"animal_{k}")
        test = Test(f"plates_{k}", kind, specimen, (), hold_out=k >= specimens)
        way = np.linspace(0.0, depth * 1e-3, 61)
        force = -specimen.area * law.nominal_stress(1 - way / HEIGHT, rng.normal(mean, spread))
        tests.append(test)
        measured[test.name] = (MeasuredCurve(test.name, test, None, way, force + rng.normal(0.0, NOISE, 61), None,
                                             Path("synthetic.csv"), "", noise=SensorNoise(NOISE)),)
    everywhere = tuple(measured)
    named = {path: ScopedCampaignParameter(path, get_law_parameter_declaration(law, path), True, PER_SPECIMEN,
                                           everywhere)
             for path, deviation in zip(law.parameters, spread, strict=True) if deviation}
    campaign = Campaign(Path("synthetic.toml"), {test.specimen.name: test.specimen for test in tests}, tuple(tests),
                        FitSettings((name,), named=named), Noise(NOISE), "")
    estimator = OrdinaryLeastSquaresEstimator(campaign, measured, SimulationCache())
    _, estimate = fit_law_to_descents_and_estimate(estimator.build_law_problem(name))
    spread_of = estimator.problem_uncertainty_function(estimate.problem, estimate.evaluation)
    own = PredictionParameters.from_minimum_and_uncertainty(estimate.problem.space, estimate.theta, spread_of)
    population = determine_population_and_left_out_specimens(own.space, own.theta, own.covariance,
                                                             spread_of.standard_errors).population
    further = tests[specimens:]
    predictors = {test.name: make_held_out_predictor_or_none(test, own, population) for test in further}
    unseen = [estimator.build_held_out_test_and_mesh_error(test, estimate, own) for test in further]
    curves = compute_test_curves(estimate, spread_of, unseen, None, predictors)
    held = []
    for curve in curves:
        recorded, = curve.measured
        away = np.abs(recorded.force - np.interp(recorded.displacement, curve.displacement, curve.force))
        held.append([np.mean(away <= np.interp(recorded.displacement, curve.displacement, curve.band)),
                     np.all(away <= np.interp(recorded.displacement, curve.displacement, curve.whole_band))])
    return 100.0 * np.mean(held, axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--populations", type=int, default=1000)
    parser.add_argument("--campaigns", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    print("| specimens | spread / error | mean, % | spread, % | next specimen, % |\n|---|---|---|---|---|")
    for specimens in (3, 5, 10):
        for ratio in (0.5, 1.0, 3.0):
            mean, spread, following = coverage(specimens, ratio, arguments.populations, rng)
            print(f"| {specimens} | {ratio:g} | {mean:.1f} | {spread:.1f} | {following:.1f} |", flush=True)
    rng = np.random.default_rng(arguments.seed)
    print("\n| law | specimens | samples of further ones, % | whole recordings, % |\n|---|---|---|---|")
    for name in LAWS:
        for specimens in (3, 5, 10):
            found = np.array([held_out_coverage(name, specimens, rng) for _ in range(arguments.campaigns)])
            samples, whole = found.mean(axis=0)
            error = found.std(axis=0).max() / arguments.campaigns**0.5
            print(f"| {name} | {specimens} | {samples:.1f} | {whole:.1f} | (± {error:.1f})", flush=True)


if __name__ == "__main__":
    main()
