"""Coverage of the 95 % intervals of creep tests under force control, in virtual campaigns with known parameters.

    python -m benchmarks creep [--json] [--campaigns N] [--seed N] [--noise-um X] [--control displacement]

Each campaign: one lubricated compression of a neo-Hookean specimen with one Prony term, `ramp 3N @1.5N/s; hold 60s`,
341 samples. The finite elements solve the test in force control. The displacement has white noise of 5 um and the
load cell of 1 mN; both are estimated from the recording. Fitted: C10, g_1 and tau_1. ``--control displacement``
states that the displacement is controlled, so that the residuals of the force at the measured displacement are fitted
as if they were independent.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

import tissue_sim as ts
from benchmarks.measure import about, show, table, verdict
from calibration.campaign.campaign import load_campaign
from calibration.campaign.measured import read_measured_curves
from calibration.fit.estimate import Estimate
from calibration.fit.ordinary import OrdinaryLeastSquaresEstimator, fit_law_to_descents_and_estimate
from calibration.forward.simulation_cache import SimulationCache
from tissue_sim.rig.rig import generate_sensor_noise

#: Law of the specimen.
LAW = "neo_hooke"
#: True parameters, Pa, 1 and s.
TRUTH = {"C10": 5000.0, "viscoelastic.terms[0].g": 0.3, "viscoelastic.terms[0].tau": 8.0}
#: Radius and height of the specimen, m.
RADIUS_AND_HEIGHT = 0.02
#: Standard deviation of the displacement, m.
DISPLACEMENT_NOISE = 5e-6
#: Standard deviation of the load cell, N.
FORCE_NOISE = 1e-3
#: Smallest accepted coverage of the 95 % intervals.
MIN_COVERAGE = 0.92
#: Largest accepted coverage.
MAX_COVERAGE = 0.98
#: Smallest number of campaigns that is compared with the limits.
MIN_CAMPAIGNS = 200
#: Campaign of one recording; {control} is the controlled quantity.
CAMPAIGN = """
[[specimen]]
name = "gel"
radius_mm = 20.0
height_mm = 20.0
[[test]]
kind = "lubricated_compression"
specimen = "gel"
recordings = ["creep.csv"]
control = "{control}"
[fit]
method = "analytical"
laws = ["neo_hooke"]
start = {{ "viscoelastic.terms[0].g" = 0.2, "viscoelastic.terms[0].tau_s" = 5.0 }}
"""


def simulate_creep() -> ts.Recording:
    """Simulate the test in force control by finite elements on one element, without noise."""
    protocol = ts.Protocol(np.concatenate([np.linspace(0.0, 2.0, 41), np.linspace(2.1, 60.0, 300)]),
                           force=np.concatenate([np.linspace(0.0, 3.0, 41), np.full(300, 3.0)]))
    experiment = ts.KINDS["lubricated_compression"].experiment(
        specimen=ts.Specimen(RADIUS_AND_HEIGHT, RADIUS_AND_HEIGHT), protocol=protocol)
    series = ts.Prony((ts.PronyTerm(TRUTH["viscoelastic.terms[0].g"], TRUTH["viscoelastic.terms[0].tau"]),))
    material = ts.Material(LAW, {"C10": TRUTH["C10"]}, ts.Bulk("bulk_ratio", 1e5), viscoelastic=series)
    return ts.simulate(ts.Model(experiment, material), estimate_error=False)


def run_campaign(true: ts.Recording, number: int, seed: int, noise: float = DISPLACEMENT_NOISE,
                 control: str = "force") -> dict[str, np.ndarray]:
    """Fit one campaign.

    Args:
        true: recording without noise.
        number: number of the campaign.
        seed: seed of the study.
        noise: standard deviation of the displacement, m.
        control: controlled quantity that the campaign states.

    Returns:
        ``estimates``, ``errors`` and ``quantiles`` of C10, g_1 and tau_1, shapes (3,).
    """
    first = 2 * (1_000_000 * seed + number)
    displacement = true.displacement + generate_sensor_noise(true.time.size, noise, first)
    force = true.force + generate_sensor_noise(true.time.size, FORCE_NOISE, first + 1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "campaign.toml"
        path.write_text(CAMPAIGN.format(control=control))
        np.savetxt(path.with_name("creep.csv"), np.column_stack([true.time, 1e3 * displacement, force]), delimiter=",",
                   header="time [s],displacement [mm],force [N]", comments="")
        campaign = load_campaign(path)
        estimator = OrdinaryLeastSquaresEstimator(campaign, read_measured_curves(campaign), SimulationCache())
    _, estimate = fit_law_to_descents_and_estimate(estimator.build_law_problem(LAW))
    if not isinstance(estimate, Estimate):
        raise RuntimeError(estimate)
    spread = estimator.problem_uncertainty_function(estimate.problem, estimate.evaluation)
    order = [estimate.problem.space.free.index(name) for name in TRUTH]
    return {"estimates": estimate.theta[order], "errors": spread.standard_errors[order],
            "quantiles": spread.quantile[order]}


def judge(campaigns: list[dict[str, np.ndarray]]) -> dict[str, dict[str, float]]:
    """Return coverage, mean error and scatter in standard errors, and relative standard error of each parameter."""
    estimates, errors, quantiles = (np.array([each[key] for each in campaigns])
                                    for key in ("estimates", "errors", "quantiles"))
    true = np.array(list(TRUTH.values()))
    score = (estimates - true) / errors
    return {name: {"coverage": float(np.mean(np.abs(score[:, i]) <= quantiles[:, i])),
                   "mean": float(score[:, i].mean()), "scatter": float(score[:, i].std()),
                   "error_percent": float(100.0 * errors[:, i].mean() / true[i])} for i, name in enumerate(TRUTH)}


def draw(result: dict, console) -> None:
    """Print the result as a table."""
    rows = [[name, f"{each['coverage']:.3f}", f"{each['mean']:.2f}", f"{each['scatter']:.2f}",
             f"{each['error_percent']:.3f} %"] for name, each in result["parameters"].items()]
    table(console, f"creep: {result['campaigns']} campaigns, {result['seconds']:.0f} s",
          ["parameter", "coverage of 95 %", "mean error / SE", "scatter / SE", "mean SE"], rows)
    if result["campaigns"] >= MIN_CAMPAIGNS:
        covered = all(MIN_COVERAGE <= each["coverage"] <= MAX_COVERAGE for each in result["parameters"].values())
        console.print(verdict(covered, f"coverage {MIN_COVERAGE} to {MAX_COVERAGE}:"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--campaigns", type=int, default=MIN_CAMPAIGNS, metavar="N")
    parser.add_argument("--seed", type=int, default=1, metavar="N")
    parser.add_argument("--noise-um", type=float, default=1e6 * DISPLACEMENT_NOISE, metavar="X")
    parser.add_argument("--control", choices=("force", "displacement"), default="force")
    arguments = parser.parse_args()
    began, true = time.perf_counter(), simulate_creep()
    found = [run_campaign(true, number, arguments.seed, 1e-6 * arguments.noise_um, arguments.control)
             for number in range(arguments.campaigns)]
    result = about("creep") | {"campaigns": arguments.campaigns, "seed": arguments.seed,
                               "seconds": time.perf_counter() - began, "parameters": judge(found)}
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
