"""Inverse calibration from many starts: number of minima, cost, and errors of the moduli.

    python -m benchmarks starts [--json] [--repeats N] [--starts N] [--workers N] [--campaign NAME ...]

Data are curves of independent solvers (lubricated compression: the closed form) with noise, three replicates of 401
samples. Starts: the study's 1400/600, then C10 and C20 each from a tenth to ten times the truth, corners included.
Every start begins with nothing simulated. CPU seconds are of one thread, after compiling.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.interpolate import CubicSpline
from scipy.stats import qmc

import tissue_sim as ts
from benchmarks import ROOT
from benchmarks.measure import about, option_parser, show, summary, table, verdict
from calibration.campaign.campaign import Campaign, FitSettings, Noise, Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import iterate_mesh_correction_and_jitter
from calibration.fit.problem import build_generalised_problem
from calibration.fit.trust_region import DESCENT, minimise_from_start
from calibration.fit.uncertainty import compute_marginal_uncertainty
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.sensor_noise import SensorNoise
from calibration.tasks.executors import Workers, open_task_executor

#: Fitted law.
LAW = "reduced_polynomial_2"
#: Parameters of the law.
PARAMETERS = ("C10", "C20")
#: True parameters, Pa.
TRUTH = np.array([1404.9, 699.4])
#: Start values, Pa.
START = np.array([1400.0, 600.0])
#: Specimen of the reference study.
SPECIMEN = ts.Specimen(0.040, 0.070)
#: Radius of the needle, m.
NEEDLE_RADIUS = 0.008
#: Radius of the edge of the needle, m.
EDGE = 0.25e-3
BULK = ts.Bulk("bulk_ratio", 1e4)
#: Depth, m.
DEPTH = 10e-3
#: Speed, m/s.
SPEED = 0.248e-3
#: Samples of a recording.
SAMPLES = 401
#: Recordings of a test.
REPLICATES = 3
#: Standard deviation of the force, N.
NOISE = 0.02
SEED = 5
#: Starts reach from this share of the truth to its inverse.
FARTHEST = 10.0
#: Two ends are one minimum when their sums of squares differ by less: a third of a standard error, squared. A start is
#: not followed farther than `DescentSettings.min_gain_of_start`.
SAME_MINIMUM = 0.1
#: Target: median number of solves per test and start.
MEDIAN_SOLVES = 5
#: Target: largest number of solves per test and start.
MOST_SOLVES = 9
#: Target: CPU time of the joint fit, s.
CPU_TARGET = 2.0
#: Target: relative errors of the moduli of the joint fit.
MAY_ERR = (3e-3, 3e-2)


@dataclass(frozen=True)
class Scene:
    """Kind of test, settings of its experiment, and the curve of an independent solver in tests/reference."""

    kind: str
    overrides: dict
    file: str | None

    def experiment(self, protocol: ts.Protocol) -> ts.Experiment:
        """Return the experiment on `SPECIMEN`."""
        return ts.KINDS[self.kind].experiment(specimen=SPECIMEN, protocol=protocol, **self.overrides)

    def force(self, displacement: np.ndarray) -> np.ndarray:
        """Return the force at the true moduli, N, by smooth interpolation."""
        if self.file is None:
            stretch = 1.0 - displacement / SPECIMEN.height
            slope = TRUTH[0] + 2.0 * TRUTH[1] * (stretch**2 + 2.0 / stretch - 3.0)
            return 2.0 * SPECIMEN.area * slope * (stretch**-2 - stretch)
        folder = ROOT / "tests" / "reference"
        millimetres, force = np.loadtxt(folder / self.file, delimiter=",").T
        return CubicSpline(1e-3 * millimetres, force)(displacement)


SCENES = {
    "lubricated": Scene("lubricated_compression", {}, None),
    "bonded": Scene("bonded_compression", {}, "bonded_RP.csv"),
    "needle": Scene("needle_indentation", {"tool": ts.Tool("flat", NEEDLE_RADIUS)},
                    "punch_bonded_face_side_wall_RP.csv"),
    "plates, friction 0.7": Scene("friction_compression", {}, "friction0.7_RP.csv"),
    "needle, friction 0.7": Scene("needle_indentation", {"tool": ts.Tool("flat", NEEDLE_RADIUS, EDGE), "friction": 0.7},
                                  "punch_friction0.7_edge0.25mm_RP.csv"),
}
JOINT = ("lubricated", "bonded", "needle")
CAMPAIGNS = {"joint": JOINT, **{name: (name,) for name in SCENES}}


def make_campaign(scenes: Sequence[str], noise: Noise) -> Campaign:
    """Return a campaign of these scenes, with recordings in memory."""
    tests = tuple(Test(name, ts.KINDS[SCENES[name].kind], SPECIMEN, (),
                       experiment=SCENES[name].experiment(ts.Protocol.ramp(DEPTH))) for name in scenes)
    settings = FitSettings((LAW,), bulk=BULK, method="inverse_fem", start=dict(zip(PARAMETERS, START, strict=True)))
    return Campaign(Path("synthetic.toml"), {SPECIMEN.name: SPECIMEN}, tests, settings, noise, "")


def make_recordings(campaign: Campaign, force: Callable[[str, np.ndarray], np.ndarray], generator: np.random.Generator,
                    contact: float = 0.0, zero: float = 0.0) -> dict[str, tuple[MeasuredCurve, ...]]:
    """Return recordings of every test with white noise.

    Args:
        campaign: whose tests. force: of a test (its name) at depths, m, in N. generator: of the scatter.
        contact, zero: standard deviations of contact offset, m, and zero, N, between recordings.
    """
    noise, displacement = SensorNoise(NOISE), np.linspace(0.0, DEPTH, SAMPLES)
    found = {}
    for test in campaign.tests:
        curves = []
        for number in range(1, REPLICATES + 1):
            depth = np.maximum(displacement - contact * generator.standard_normal(), 0.0)
            measured = (force(test.name, depth) + zero * generator.standard_normal()
                        + NOISE * generator.standard_normal(SAMPLES))
            curves.append(MeasuredCurve(f"{test.name}/{number}", test, displacement / SPEED, displacement, measured,
                                        np.full(SAMPLES, "ramp"), Path(f"{number}.csv"), "", noise=noise))
        found[test.name] = tuple(curves)
    return found


def spread_starts(count: int) -> np.ndarray:
    """The study's start, the corners of the square of logarithms, and a quasi-random sequence in it: (count, 2)."""
    corners = [(0, 0), (1, 1), (0, 1), (1, 0)]
    inside = qmc.Halton(2, scramble=False).random(max(count, 5) - 4)[1:]
    shares = np.concatenate([corners, inside])
    return np.concatenate([[START], TRUTH * FARTHEST ** (2.0 * shares - 1.0)])[:count]


def reference_recordings(campaign: Campaign) -> dict[str, tuple[MeasuredCurve, ...]]:
    """Return the recordings of the reference curves, equal in every process."""
    return make_recordings(campaign, lambda name, depth: SCENES[name].force(depth), np.random.default_rng(SEED))


def run_start(scenes: Sequence[str], start: np.ndarray, settled: bool) -> dict:
    """Run one start of one campaign without cached simulations, and on request continue to the estimate.

    Returns:
        Plain numbers: end, sum of squares, whether it converged and why not, solves of each test, CPU seconds; of the
        estimate parameters, standard errors, mesh difference, simulations on both meshes, CPU seconds.
    """
    campaign = make_campaign(scenes, Noise(NOISE, contact_jitter=None, zero_jitter=None, correlation_time=0.0))
    problem = build_generalised_problem(LAW, campaign, reference_recordings(campaign), SimulationCache())
    descent = minimise_from_start(problem, np.array(start), enough=DESCENT.min_gain_of_start)
    found = {"start": list(start), "end": descent.theta.tolist(), "error": descent.error,
             "converged": descent.converged, "problem": descent.failure, "cpu_s": descent.cpu_s,
             "solves": [descent.simulations.get((name, "fast"), 0) for name in scenes]}
    if settled and descent.converged:
        estimate = iterate_mesh_correction_and_jitter(problem, descent.theta,
                                                      Noise(contact_jitter=None, zero_jitter=None))
        spread = compute_marginal_uncertainty(estimate.problem, estimate.evaluation)
        simulated = Counter(descent.simulations) + Counter(estimate.simulations)
        found["estimate"] = {
            "parameters": estimate.theta.tolist(), "standard_errors": spread.standard_errors.tolist(),
            "converged": estimate.converged, "warnings": list(estimate.warnings), "refreshes": estimate.refreshes,
            "differences": list(estimate.differences), "cpu_s": descent.cpu_s + estimate.cpu_s,
            "fast": [simulated.get((name, "fast"), 0) for name in scenes],
            "accurate": [simulated.get((name, "accurate"), 0) for name in scenes]}
    return found


def summarise(name: str, runs: Sequence[Mapping], timed: Sequence[Mapping]) -> dict:
    """Summarise the results of all starts of one campaign.

    Args:
        name: of the campaign. runs: of all starts. timed: estimates of the study's start, for the CPU seconds.
    """
    lowest = min(run["error"] for run in runs)
    same = [bool(run["converged"] and run["error"] - lowest < SAME_MINIMUM) for run in runs]
    solves = [count for run in runs for count in run["solves"]]
    settled = [run["estimate"] for run in runs if "estimate" in run]
    errors = [np.array(one["parameters"]) / TRUTH - 1.0 for one in settled]
    return {"campaign": name, "starts": len(runs), "same_minimum": sum(same),
            "elsewhere": [run for run, one in zip(runs, same, strict=True) if not one],
            "median_solves": statistics.median(solves), "most_solves": max(solves),
            "settled": len(settled), "errors": np.array(errors).tolist(),
            "worst_errors": np.abs(errors).max(axis=0).tolist(),
            "standard_errors": (np.array(settled[0]["standard_errors"]) / TRUTH).tolist(),
            "differences": settled[0]["differences"], "estimate_converged": all(one["converged"] for one in settled),
            "warnings": sorted({warning for one in settled for warning in one["warnings"]}),
            "median_fast": statistics.median(count for one in settled for count in one["fast"]),
            "median_accurate": statistics.median(count for one in settled for count in one["accurate"]),
            "descent_cpu_s": statistics.median(run["cpu_s"] for run in runs),
            "cpu_s": summary([one["estimate"]["cpu_s"] for one in timed])}


def run_campaigns(names: Sequence[str], starts: int, repeats: int, workers: int) -> list[dict]:
    """Run every start of every campaign; the joint one to the estimate for all starts, the others for the first."""
    found = []
    with open_task_executor(Workers(workers)) as tasks:
        for name in names:
            scenes = CAMPAIGNS[name]
            run_start(scenes, START, True)  # compiles
            timed = [run_start(scenes, START, True) for _ in range(repeats)]
            runs = tasks.run(run_start, [(scenes, start, name == "joint" or number == 0)
                                         for number, start in enumerate(spread_starts(starts))])
            found.append(summarise(name, runs, timed))
    return found


def draw(result: dict, console: Console) -> None:
    """Print the result as tables."""
    rows, more = [], []
    for one in result["campaigns"]:
        joint = one["campaign"] == "joint"
        good = one["median_solves"] <= MEDIAN_SOLVES and one["most_solves"] <= MOST_SOLVES
        rows.append([one["campaign"], f"{one['same_minimum']} of {one['starts']}",
                     f"{one['median_solves']:g}, {one['most_solves']}",
                     verdict(good, f"{MEDIAN_SOLVES}, {MOST_SOLVES}"), f"{one['descent_cpu_s']:.2f}",
                     f"{one['median_fast']:g} + {one['median_accurate']:g}",
                     f"{one['cpu_s']['median_s']:.2f} ({one['cpu_s']['min_s']:.2f} to {one['cpu_s']['max_s']:.2f})",
                     verdict(one["cpu_s"]["median_s"] <= CPU_TARGET, f"{CPU_TARGET:g} s") if joint else ""])
        errors = [f"{100 * error:.2f} ± {100 * deviation:.2f}" for error, deviation in
                  zip(one["errors"][0], one["standard_errors"], strict=True)]
        more.append([one["campaign"], *errors, ", ".join(f"{100 * share:.2f}" for share in one["differences"]),
                     " / ".join(f"{100 * error:.2f}" for error in one["worst_errors"]),
                     verdict(all(error <= most for error, most in zip(one["worst_errors"], MAY_ERR, strict=True)),
                             " / ".join(f"{100 * most:g}" for most in MAY_ERR)) if joint else ""])
    table(console, f"Starts up to {FARTHEST:g} times off, solves of the fast mesh per test and start, CPU seconds",
          ["campaign", "same minimum", "median, most", "target", "CPU s", "estimate: fast + accurate", "CPU s",
           "target"], rows)
    table(console, "Estimate with the difference of the accurate mesh, %",
          ["campaign", *(f"{name} off" for name in PARAMETERS), "mesh difference", "largest error of any start",
           "target"], more)
    for one in result["campaigns"]:
        for run in one["elsewhere"]:
            ends = ["/".join(f"{value:.6g}" for value in run[key]) for key in ("start", "end")]
            console.print(f"{one['campaign']}: start {ends[0]} ends at {ends[1]}, sum of squares {run['error']:.6g}: "
                          f"{run['problem'] or 'another minimum'}")
        for warning in one["warnings"]:
            console.print(f"{one['campaign']}: {warning}")


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--starts", type=int, default=60, metavar="N", help="starts of every campaign (default 60)")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1)")
    parser.add_argument("--campaign", action="append", choices=CAMPAIGNS, help="leave the others out")
    arguments = parser.parse_args()
    if arguments.starts < 1:
        parser.error("give at least one start")
    found = run_campaigns(arguments.campaign or list(CAMPAIGNS), arguments.starts, arguments.repeats,
                          arguments.workers)
    truth = dict(zip(PARAMETERS, TRUTH.tolist(), strict=True))
    show(about("starts") | {"truth": truth, "campaigns": found}, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
