"""Coverage of the 95 % intervals of biaxial tension, in virtual campaigns with known parameters.

    python -m benchmarks biaxial [--json] [--campaigns N] [--method NAME] [--seed N]

Each campaign has eight sheets of a Mooney-Rivlin material under the same motion of both axes, with white noise of both
forces. The analytical method fits recordings without other errors. The inverse method fits recordings whose forces
also have zeros, which differ between the sheets and the axes; it estimates their scatter. The forces are those of the
formulas P1 = 2 (l1 - l1^-3 l2^-2) (C10 + C01 l2^2), and the same with both stretches exchanged (Rivlin and Saunders,
Phil. Trans. R. Soc. A 243 (1951) 251), written here.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

import tissue_sim as ts
from benchmarks.measure import about, option_parser, show, table, verdict
from calibration import calibrate

#: True parameters, Pa.
TRUTH = {"C10": 5000.0, "C01": 2000.0}
#: Sides of the sheet along both axes, m.
SIDES = np.array([0.020, 0.030])
#: Thickness of the sheet, m.
THICKNESS = 0.002
#: Largest strain of each axis.
LARGEST_STRAIN = np.array([0.5, 0.2])
#: Samples of a recording.
SAMPLES = 41
#: Recordings of a campaign.
REPLICATES = 8
#: Noise of a force as a fraction of its largest value, 1.
RELATIVE_FORCE_NOISE = 0.01
#: Scatter of the zeros of a force as a fraction of its largest value, 1.
RELATIVE_ZERO_SCATTER = 0.005
#: Smallest accepted coverage.
MIN_COVERAGE = 0.92
#: Largest accepted coverage.
MAX_COVERAGE = 0.98
#: Smallest number of campaigns that is compared with the limits.
MIN_CAMPAIGNS = 200
#: Methods of the fit.
METHODS = ("analytical", "inverse_fem")


def compute_stresses(stretch: np.ndarray) -> np.ndarray:
    """Return both nominal stresses, Pa, of both stretches, shapes (n, 2)."""
    own, other = stretch, stretch[:, ::-1]
    return 2.0 * (own - own**-3 * other**-2) * (TRUTH["C10"] + TRUTH["C01"] * other**2)


def write_recordings(folder: Path, rng: np.random.Generator, *, has_zeros: bool) -> None:
    """Write the recordings of one campaign."""
    ramp = np.linspace(0.0, 1.0, SAMPLES)
    strain = ramp[:, None] * LARGEST_STRAIN
    areas = SIDES[::-1] * THICKNESS
    largest = compute_stresses(1.0 + LARGEST_STRAIN[None, :])[0] * areas
    for number in range(REPLICATES):
        zero = rng.normal(0.0, RELATIVE_ZERO_SCATTER, 2) if has_zeros else np.zeros(2)
        force = compute_stresses(1.0 + strain) * areas
        force += largest * (zero + rng.normal(0.0, RELATIVE_FORCE_NOISE, force.shape))
        channels = {"time": 10.0 * ramp, "displacement": strain[:, 0] * SIDES[0], "force": force[:, 0],
                    "displacement 2": strain[:, 1] * SIDES[1], "force 2": force[:, 1]}
        ts.write_recording(ts.Recording(channels), folder / f"sheet_{number}.csv")


def run_campaign(method: str, number: int, seed: int) -> dict:
    """Fit one virtual campaign; return status, and estimate and interval of each parameter, Pa."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_recordings(folder, np.random.default_rng([seed, number]), has_zeros=method == "inverse_fem")
        (folder / "study.toml").write_text("\n".join((
            "[[specimen]]", 'shape = "block"', f"height_mm = {1e3 * SIDES[0]:g}", f"length_mm = {1e3 * SIDES[1]:g}",
            f"width_mm = {1e3 * THICKNESS:g}", "[[test]]", 'kind = "biaxial_tension"', 'recordings = ["sheet_*.csv"]',
            "[fit]", 'laws = ["mooney_rivlin"]', f'method = "{method}"')) + "\n", encoding="utf-8")
        result, = calibrate([folder / "study.toml"], folder / "out", figures=False)
    best = result.best
    return {"status": best.status, "estimate": dict(best.parameters), "interval": dict(best.intervals95)}


def summarise(method: str, runs: Sequence[dict]) -> dict:
    """Return the coverage of the intervals; a missing interval counts as a miss."""
    parameters = {}
    for name, truth in TRUTH.items():
        estimates = np.array([run["estimate"][name] for run in runs])
        intervals = [run["interval"][name] for run in runs]
        coverage = float(np.mean([each is not None and each[0] <= truth <= each[1] for each in intervals]))
        widths = [each[1] - each[0] for each in intervals if each is not None]
        parameters[name] = {
            "coverage": coverage, "binomial_error": float(np.sqrt(coverage * (1.0 - coverage) / len(runs))),
            "mean_error": float(estimates.mean() / truth - 1.0),
            "scatter": float(estimates.std(ddof=min(1, len(runs) - 1)) / truth),
            "half_width": float(0.5 * np.mean(widths) / truth) if widths else float("nan"),
            "is_met": MIN_COVERAGE <= coverage <= MAX_COVERAGE}
    statuses = [run["status"] for run in runs]
    return {"method": method, "campaigns": len(runs), "parameters": parameters,
            "statuses": {status: statuses.count(status) for status in dict.fromkeys(statuses)}}


def draw(result: dict, console: Console) -> None:
    """Print the coverage as a table."""
    rows = [(each["method"], name, str(each["campaigns"]), f"{100 * one['coverage']:.1f} ± "
             f"{100 * one['binomial_error']:.1f}", f"{100 * one['half_width']:.2f}", f"{100 * one['mean_error']:+.3f}",
             f"{100 * one['scatter']:.3f}",
             ", ".join(f"{count} {status}" for status, count in each["statuses"].items()))
            for each in result["methods"] for name, one in each["parameters"].items()]
    table(console, "Coverage of 95 % intervals of biaxial tension, %",
          ("method", "parameter", "campaigns", "coverage", "half width", "mean error", "scatter", "status"), rows)
    console.print(verdict(result["is_met"], f"coverage {100 * MIN_COVERAGE:g} to {100 * MAX_COVERAGE:g} %"))


def main() -> int:
    """Run the benchmark; return 0 if all limits are met, or with too few campaigns for a limit."""
    parser = option_parser(__doc__)
    parser.add_argument("--campaigns", type=int, default=MIN_CAMPAIGNS, metavar="N",
                        help="campaigns (default %(default)s)")
    parser.add_argument("--method", choices=METHODS, action="append", help="method of the fit (default: both)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="seed of the noise (default %(default)s)")
    arguments = parser.parse_args()
    if arguments.campaigns < 1:
        parser.error(f"campaigns must be at least 1; got {arguments.campaigns}.")
    found = [summarise(method, [run_campaign(method, number, arguments.seed) for number in range(arguments.campaigns)])
             for method in arguments.method or METHODS]
    is_met = all(one["is_met"] for each in found for one in each["parameters"].values())
    show({**about("biaxial"), "methods": found, "is_met": is_met}, draw, as_json=arguments.json)
    return 0 if is_met or arguments.campaigns < MIN_CAMPAIGNS else 1
