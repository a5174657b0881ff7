"""Coverage of the 95 % intervals of the inverse calibration, in virtual campaigns with known moduli.

    python -m benchmarks coverage [--json] [--data NAME] [--campaigns N] [--workers N] [--seed N] [--profile-every N]

Each campaign: lubricated, bonded and needle test, three replicates of 401 samples each, with white noise of 0.02 N and,
from replicate to replicate, contact offsets of 0.03 mm and zeros of 0.01 N. Each is fitted from 1400/600 with the
jitter stated and with the jitter estimated, and by ordinary least squares: the same model and mesh difference, no
offsets, no zeros, all samples independent.

The curves are the accurate mesh's. Intervals carry what the accurate mesh may be off, which these data do not have in
them: "no mesh error" leaves it out. ``--data drawn`` puts such an error, drawn for each campaign, into the data;
``--data reference`` takes the curves of independent solvers instead.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import time
from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console
from rich.progress import Progress
from scipy import stats
from scipy.interpolate import CubicSpline

import tissue_sim as ts
from benchmarks.inverse.starts import (
    BULK,
    DEPTH,
    JOINT,
    LAW,
    NOISE,
    PARAMETERS,
    SCENES,
    SPEED,
    START,
    TRUTH,
    make_campaign,
    make_recordings,
)
from benchmarks.measure import about, show, table, verdict
from calibration.campaign.campaign import Noise
from calibration.fit.estimate import iterate_mesh_correction_and_jitter
from calibration.fit.problem import GeneralisedProblem, build_generalised_problem
from calibration.fit.trust_region import minimise_from_start
from calibration.fit.uncertainty import compute_marginal_uncertainty, compute_profile_side
from calibration.forward.forms import ACCURATE_MESH_ERRORS
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import ContactAndForceZeroJitter
from calibration.tasks.executors import Workers, open_task_executor

#: Jitter of the contact, m.
CONTACT = 0.03e-3
#: Jitter of the zero, N.
ZERO = 0.01
#: Samples of the accurate curves from which the data are interpolated.
POINTS = 41
#: Length of these curves beyond the data, m.
BEYOND = 6 * CONTACT
#: Nominal coverage.
NOMINAL = 0.95
#: Smallest accepted coverage.
LEAST = 0.92
#: Largest accepted coverage.
MOST = 0.98
#: Fewer campaigns do not tell, so they are not judged.
FEWEST = 200
#: What the curves are made with.
DATA = ("accurate", "drawn", "reference")
#: Relative error of the accurate mesh in each test, as the calibration has it.
MESH_ERROR = {"lubricated": 0.0, "bonded": ACCURATE_MESH_ERRORS["plate"], "needle": ACCURATE_MESH_ERRORS["flat"]}
#: Jitter that is stated, m and N; None: estimated.
STATED = {"jitter stated": Noise(NOISE, contact_jitter=CONTACT, zero_jitter=ZERO, correlation_time=0.0),
          "jitter estimated": Noise(NOISE, contact_jitter=None, zero_jitter=None, correlation_time=0.0)}
NO_MESH_ERROR = ", no mesh error"
ORDINARY = "ordinary least squares"
METHODS = (*(f"{method}{carried}" for method in STATED for carried in ("", NO_MESH_ERROR)), ORDINARY)

Truth = Mapping[str, tuple[np.ndarray, np.ndarray]]


def true_curves(data: str, scenes: Sequence[str] = JOINT) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Depth, m, and force, N, at the true moduli: of independent solvers for ``"reference"``, else our accurate mesh's.
    """
    depth = np.linspace(0.0, DEPTH + BEYOND, POINTS)
    if data == "reference":
        return {name: (depth, SCENES[name].force(depth)) for name in scenes}
    material = ts.Material(LAW, dict(zip(PARAMETERS, TRUTH.tolist(), strict=True)), BULK)
    protocol = ts.Protocol(depth / SPEED, depth)
    return {name: (depth, ts.simulate(ts.Model(SCENES[name].experiment(protocol), material),
                                      resolution="accurate").force) for name in scenes}


def run_campaign(number: int, seed: int, truth: Truth, drawn: bool, profiled: bool,
                 methods: Sequence[str] = tuple(STATED)) -> dict[str, dict]:
    """Fit one virtual campaign by these methods, and by ordinary least squares.

    Args:
        number, seed: of its scatter. truth: see `true_curves`. drawn: whether a mesh error is drawn into the data.
        profiled: whether to follow the profiles too. methods: keys of `STATED`.

    Returns:
        Method -> plain numbers: estimate, standard errors, half widths of the intervals in them, interval ends of the
        profiles (None without), whether it converged; of those that settle, refreshes of the mesh difference and CPU
        seconds.
    """
    generator = np.random.default_rng([seed, number])
    shapes = {name: generator.standard_normal(2) * MESH_ERROR[name] * drawn for name in truth}
    curves = {name: CubicSpline(*curve) for name, curve in truth.items()}

    def force(name: str, depth: np.ndarray) -> np.ndarray:
        constant, linear = shapes[name]
        return curves[name](depth) * (1.0 + constant + linear * (2.0 * depth / DEPTH - 1.0))

    campaigns = {method: make_campaign(tuple(truth), stated)
                 for method, stated in STATED.items() if method in methods}
    measured = make_recordings(next(iter(campaigns.values())), force, generator, CONTACT, ZERO)
    solves, found = SimulationCache(), {}
    for method, campaign in campaigns.items():
        began = time.process_time()
        problem = build_generalised_problem(LAW, campaign, measured, solves)
        estimate = iterate_mesh_correction_and_jitter(problem, minimise_from_start(problem, START).theta,
                                                      STATED[method])
        problem = estimate.problem
        cost = {"refreshes": estimate.refreshes, "cpu_s": time.process_time() - began}
        converged = estimate.converged and not estimate.warnings
        found[method] = _interval(problem, estimate.theta, estimate.error, converged, profiled) | cost
        exact = GeneralisedProblem(problem.space, problem.tests, solves, problem.jitter, (0.0,) * len(problem.tests))
        descent = minimise_from_start(exact, estimate.theta, corrected=True)
        found[method + NO_MESH_ERROR] = _interval(exact, descent.theta, descent.error, descent.converged, profiled)
        if ORDINARY not in found:
            found[ORDINARY] = _ordinary(problem, estimate.theta)
    return found


def _interval(problem: GeneralisedProblem, theta: np.ndarray, error: float, converged: bool, profiled: bool) -> dict:
    """Return the interval of generalised least squares."""
    spread = compute_marginal_uncertainty(problem, problem.evaluate(theta))
    ends = None
    if profiled:
        ends = [[compute_profile_side(problem, theta, error, spread, i, side).end for side in (-1, 1)]
                for i in range(theta.size)]
    return {"theta": theta.tolist(), "errors": spread.standard_errors.tolist(),
            "quantile": np.broadcast_to(spread.quantile, theta.shape).tolist(), "profile": ends,
            "converged": bool(converged)}


def _ordinary(settled: GeneralisedProblem, theta: np.ndarray) -> dict:
    """Return the interval of ordinary least squares with the same model: s^2 (J'J)^-1."""
    problem = GeneralisedProblem(settled.space, settled.tests, settled.solves,
                                 ContactAndForceZeroJitter(0.0, 0.0, None), (0.0,) * len(settled.tests))
    descent = minimise_from_start(problem, theta, corrected=True)
    evaluation = problem.evaluate(descent.theta)
    freedom = problem.samples - theta.size
    covariance = evaluation.penalised_sum_of_squares / freedom * np.linalg.inv(evaluation.rates.T @ evaluation.rates)
    return {"theta": descent.theta.tolist(), "errors": np.sqrt(np.diag(covariance)).tolist(),
            "quantile": [float(stats.t.ppf(0.5 + 0.5 * NOMINAL, freedom))] * theta.size, "profile": None,
            "converged": descent.converged}


def summarise(runs: Sequence[Mapping[str, Mapping]]) -> list[dict]:
    """Return the coverage of each method and interval; a fit without convergence counts as a miss.

    Returns:
        For each: how many campaigns; arrays over C10 and C20 as lists: share of intervals that hold the truth and its
        binomial standard error, mean error and scatter of the estimates as shares of the truth, standard error on
        average (root mean square) in units of that scatter, mean half width as a share of the truth.
    """
    found = []
    for method in (name for name in METHODS if name in runs[0]):
        for kind in ("Wald", "profile"):
            own = [run[method] for run in runs if kind == "Wald" or run[method]["profile"] is not None]
            if not own:
                continue
            theta, errors, quantile = (np.array([one[key] for one in own]) for key in ("theta", "errors", "quantile"))
            ends = np.stack([theta - quantile * errors, theta + quantile * errors], axis=-1)
            if kind == "profile":
                ends = np.array([one["profile"] for one in own])
            converged = np.array([one["converged"] for one in own])
            inside = (ends[..., 0] <= TRUTH) & (ends[..., 1] >= TRUTH) & converged[:, None]
            share = inside.mean(axis=0)
            # Of one campaign there is none to compare with.
            scatter = theta.std(axis=0, ddof=1) if len(own) > 1 else np.full(TRUTH.size, np.nan)
            found.append({
                "method": method, "interval": kind, "campaigns": len(own), "not_converged": int((~converged).sum()),
                "coverage": share.tolist(), "binomial_error": np.sqrt(share * (1 - share) / len(own)).tolist(),
                "mean_error": (theta.mean(axis=0) / TRUTH - 1).tolist(), "scatter": (scatter / TRUTH).tolist(),
                "error_over_scatter": (np.sqrt((errors**2).mean(axis=0)) / scatter).tolist(),
                "half_width": (0.5 * np.ptp(ends, axis=-1).mean(axis=0) / TRUTH).tolist(),
                "cpu_s": float(np.median([one.get("cpu_s", 0.0) for one in own]))})
    return found


def run_study(data: str, campaigns: int, seed: int, workers: int, profile_every: int) -> list[dict[str, dict]]:
    """Run all campaigns in order."""
    truth = true_curves(data)
    tasks_of = [(number, seed, truth, data == "drawn", bool(profile_every) and number % profile_every == 0)
                for number in range(campaigns)]
    with open_task_executor(Workers(workers)) as tasks, Progress(console=Console(stderr=True)) as progress:
        bar = progress.add_task("campaigns", total=campaigns)
        return tasks.run(run_campaign, tasks_of, lambda *_: progress.advance(bar))


def draw(result: dict, console: Console) -> None:
    """Print the result as a table."""
    rows = []
    for one in result["intervals"]:
        for k, name in enumerate(PARAMETERS):
            judged = one["method"] != ORDINARY and one["campaigns"] >= FEWEST
            rows.append([f"{one['method']}, {one['interval']}", name, str(one["campaigns"]),
                         f"{100 * one['coverage'][k]:.1f} ± {100 * one['binomial_error'][k]:.1f}",
                         verdict(LEAST <= one["coverage"][k] <= MOST, f"{100 * LEAST:g} to {100 * MOST:g}")
                         if judged else "", f"{100 * one['half_width'][k]:.2f}",
                         f"{100 * one['mean_error'][k]:.3f}", f"{100 * one['scatter'][k]:.3f}",
                         f"{one['error_over_scatter'][k]:.2f}"])
    table(console, f"Coverage of {100 * NOMINAL:g} % intervals, data: {result['data']}; %",
          ["method, interval", "modulus", "campaigns", "coverage", "target", "half width", "mean error", "scatter",
           "error / scatter"], rows)
    for one in result["intervals"]:
        if one["not_converged"]:
            console.print(f"{one['method']}: {one['not_converged']} of {one['campaigns']} did not converge; they count "
                          "as misses")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--data", choices=DATA, default=DATA[0], help=f"curves of the campaigns (default {DATA[0]})")
    parser.add_argument("--campaigns", type=int, default=200, metavar="N", help="synthetic campaigns (default 200)")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the scatter (default 1)")
    parser.add_argument("--profile-every", type=int, default=5, metavar="N",
                        help="follow the profiles of every Nth campaign; 0: of none (default 5)")
    arguments = parser.parse_args()
    if arguments.campaigns < 1:
        parser.error("give at least one campaign")
    runs = run_study(arguments.data, arguments.campaigns, arguments.seed, arguments.workers, arguments.profile_every)
    result = about("coverage") | {
        "truth": dict(zip(PARAMETERS, TRUTH.tolist(), strict=True)), "data": arguments.data,
        "seed": arguments.seed,
        "contact_jitter_mm": 1e3 * CONTACT, "zero_jitter_N": ZERO, "noise_N": NOISE, "intervals": summarise(runs)}
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
