"""Coverage of the intervals of populations: mean, spread and the next specimen, of a few specimens that were each
measured with errors of their own.

    python benchmarks/population.py [--populations 1000]

Two correlated parameters; the errors of the specimens' own fits are strongly correlated, as those of C10 and C20 are.
"""

import argparse

import numpy as np

from calibration.statistics.population import estimate_population

MEAN = np.array([1400.0, 700.0])
ERROR = np.array([60.0, 40.0])
CORRELATION = {"errors": -0.8, "specimens": 0.5}


def covariance(deviations, correlation):
    outer = np.outer(deviations, deviations)
    outer[0, 1] *= correlation
    outer[1, 0] *= correlation
    return outer


def coverage(specimens: int, ratio: float, populations: int, rng) -> np.ndarray:
    """Share of populations whose intervals of the first parameter hold mean, spread and a further specimen.

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--populations", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    print("| specimens | spread / error | mean, % | spread, % | next specimen, % |\n|---|---|---|---|---|")
    for specimens in (3, 5, 10):
        for ratio in (0.5, 1.0, 3.0):
            mean, spread, following = coverage(specimens, ratio, arguments.populations, rng)
            print(f"| {specimens} | {ratio:g} | {mean:.1f} | {spread:.1f} | {following:.1f} |", flush=True)


if __name__ == "__main__":
    main()
