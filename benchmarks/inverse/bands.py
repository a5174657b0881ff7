"""Coverage of the prediction bands of new recordings: fraction of samples, and of whole recordings.

    python -m benchmarks bands [--campaigns 100] [--seed 1] [--case NAME ...]

Each campaign is a lubricated compression with a few replicates. The law is fitted to them, and further recordings are
compared with the bands. Replicates differ by noise, contact and zero. In some cases they also differ by a factor of the
force that is no parameter of the fit; in others the law cannot represent the curve.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import tissue_sim as ts
from calibration.campaign.campaign import Campaign, FitSettings, Noise, Test
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameters import SHARED, ScopedCampaignParameter
from calibration.campaign_fit import ESTIMATORS
from calibration.fit.curves import TestCurves, compute_test_curves
from calibration.fit.run_context import RunContext
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.sensor_noise import SensorNoise
from calibration.tasks.executors import Workers, open_task_executor
from tissue_sim.material.material import find_parameter_path_and_declaration

#: Specimen of the reference study.
SPECIMEN = ts.Specimen(0.040, 0.070)
#: Depth, m.
DEPTH = 0.014
#: Speed, m/s.
SPEED = 1e-3
#: Duration of the hold, s.
HOLD = 60.0
YEOH = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4})
RELAXING = ts.Material("neo_hooke", {"C10": 1500.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 1.0),
                                                                            ts.PronyTerm(0.2, 20.0))))
START = {"viscoelastic.terms[0].g": 0.2, "viscoelastic.terms[0].tau": 2.0, "viscoelastic.terms[1].g": 0.2,
         "viscoelastic.terms[1].tau": 10.0}
#: Standard deviation of the force, N.
NOISE = 0.02
#: Jitter of the contact, m.
CONTACT = 0.05e-3
#: Jitter of the zero, N.
ZERO = 0.02
#: Standard deviation of the factor of the force between recordings, 1.
GAIN = 0.03
#: Recordings of each campaign that are not fitted.
NEW = 20


@dataclass(frozen=True)
class Case:
    """Virtual measurement and the settings of its fit.

    Attributes:
        name: of it. replicates: that are fitted. method, law: of the fit. stated: whether contact and zero are.
        gain: standard deviation of a factor of each recording's force. holds: whether a hold follows the ramp.
    """

    name: str
    replicates: int
    method: str = "analytical"
    law: str = "reduced_polynomial_2"
    stated: bool = False
    gain: float = 0.0
    holds: bool = False

    @property
    def start(self) -> dict[str, float]:
        if self.holds:
            return START
        return {"C10": 1400.0, "C20": 600.0} if self.law == "reduced_polynomial_2" else {}


CASES = (
    *(Case(f"contact and zero, {count} recordings", count) for count in (2, 3, 5, 10)),
    Case("the same stated, 1 recording", 1, stated=True), Case("the same stated, 3 recordings", 3, stated=True),
    *(Case(f"stiffness too, {count} recordings", count, gain=GAIN) for count in (3, 5)),
    Case("stiffness too, contact and zero stated, 5 recordings", 5, gain=GAIN, stated=True),
    *(Case(f"a law that cannot follow, {count} recordings", count, law="neo_hooke") for count in (3, 5)),
    *(Case(f"ramp and hold, {count} recordings", count, law="neo_hooke", holds=True) for count in (3, 5)),
    *(Case(f"inverse FEM, {count} recordings", count, "inverse_fem") for count in (3, 5)),
    Case("inverse FEM, the same stated, 3 recordings", 3, "inverse_fem", stated=True),
    Case("inverse FEM, stiffness too, 5 recordings", 5, "inverse_fem", gain=GAIN),
    Case("inverse FEM, a law that cannot follow, 5 recordings", 5, "inverse_fem", law="neo_hooke"),
    Case("inverse FEM, ramp and hold, 3 recordings", 3, "inverse_fem", "neo_hooke", holds=True),
)


def make_campaign(case: Case) -> Campaign:
    """Return the campaign of a case, with recordings in memory."""
    kind = ts.KINDS["lubricated_compression"]
    experiment = kind.experiment(specimen=SPECIMEN, protocol=ts.Protocol.ramp(DEPTH)) \
        if case.method == "inverse_fem" else None
    test = Test("plates", kind, SPECIMEN, (), experiment=experiment)
    named = {path: ScopedCampaignParameter(path, find_parameter_path_and_declaration(path)[1], False, SHARED,
                                           ("plates",))
             for path in START} \
        if case.holds else {}
    settings = FitSettings((case.law,), bulk=ts.Bulk("bulk_ratio", 1e4), method=case.method, start=case.start,
                           starts=1, named=named)
    unknown = None if case.method == "inverse_fem" else 0.0
    contact, zero = (CONTACT, ZERO) if case.stated else (unknown, unknown)
    return Campaign(Path("synthetic.toml"), {SPECIMEN.name: SPECIMEN}, (test,), settings,
                    Noise(NOISE, contact_jitter=contact, zero_jitter=zero, correlation_time=0.0), "")


def recorder(case: Case, test: Test, rng: np.random.Generator) -> Callable[[int], MeasuredCurve]:
    """Return a function that makes one recording per call."""
    fine = np.linspace(0.0, DEPTH / SPEED, 281)
    time = np.linspace(0.0, DEPTH / SPEED, 141)
    if case.holds:
        time = np.append(time, DEPTH / SPEED + np.linspace(0.0, HOLD, 121)[1:])
        fine = np.append(fine, DEPTH / SPEED + np.geomspace(0.01, HOLD, 300))
    closed = ts.KINDS["lubricated_compression"].require_closed_form()
    segment = np.where(time <= DEPTH / SPEED, "ramp", "hold") if case.holds else None
    displacement = np.minimum(SPEED * time, DEPTH)

    def record(number: int) -> MeasuredCurve:
        depth = np.maximum(np.minimum(SPEED * fine, DEPTH) - CONTACT * rng.standard_normal(), 0.0)
        material = RELAXING if case.holds else YEOH
        stress = closed.stress_history(material, fine, 1.0 - depth / SPECIMEN.height,
                                       SPECIMEN.radius) if case.holds else \
            closed.stress(material.energy_law, 1.0 - depth / SPECIMEN.height, material.values)
        force = np.interp(time, fine, -SPECIMEN.area * stress) * (1.0 + case.gain * rng.standard_normal())
        force += ZERO * rng.standard_normal() + NOISE * rng.standard_normal(time.size)
        labels = segment if segment is not None or case.method == "analytical" else np.full(time.size, "ramp")
        return MeasuredCurve(f"plates/{number}", test, time, displacement, force, labels, Path(f"{number}.csv"), "",
                             noise=SensorNoise(NOISE))

    return record


def draw_case(case: Case, rng: np.random.Generator) -> tuple[TestCurves, list[MeasuredCurve]]:
    """Return the curves of one campaign, and new recordings."""
    campaign = make_campaign(case)
    record = recorder(case, campaign.tests[0], rng)
    measured = {"plates": tuple(record(number) for number in range(case.replicates))}
    estimator = ESTIMATORS[case.method](campaign, measured, SimulationCache())
    with open_task_executor(Workers()) as tasks:
        _, estimate = estimator.fit_laws([case.law], RunContext("bands", tasks))[case.law]
    if isinstance(estimate, str):
        raise RuntimeError(estimate)
    spread = estimator.problem_uncertainty_function(estimate.problem, estimate.evaluation)
    tests = list(zip(estimate.problem.tests, estimate.problem.mesh_error, strict=True))
    curves, = compute_test_curves(estimate, spread, tests, estimator.get_replicate_jitter_or_none(estimate))
    return curves, [record(100 + number) for number in range(NEW)]


def coverage(case: Case, campaigns: int, seed: int) -> tuple[float, float, float]:
    """Share of the samples of new recordings inside the band, of new recordings wholly inside the other, and the mean
    half width of the first, as a share of the largest force."""
    inside, whole, width = [], [], []
    for number in range(campaigns):
        curves, new = draw_case(case, np.random.default_rng([seed, number]))
        at = curves.displacement if curves.time is None else curves.time
        for recording in new:
            place = recording.displacement if curves.time is None else recording.sample_times
            force, band, all_of_it = (np.interp(place, at, values)
                                      for values in (curves.force, curves.band, curves.whole_band))
            away = np.abs(recording.force - force)
            inside.append(float(np.mean(away <= band)))
            whole.append(bool(np.all(away <= all_of_it)))
        width.append(float(np.mean(curves.band)) / float(np.abs(curves.force).max()))
    return 100.0 * float(np.mean(inside)), 100.0 * float(np.mean(whole)), 100.0 * float(np.mean(width))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=100, metavar="N", help="for each case (default 100)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--case", nargs="+", default=[], metavar="WORDS", help="cases whose name holds these")
    asked = parser.parse_args(arguments)
    print("| recordings differ by, fitted | samples inside, % | recordings wholly inside, % | half width, % |\n"
          "|---|---|---|---|")
    for case in CASES:
        if not asked.case or any(words in case.name for words in asked.case):
            samples, whole, width = coverage(case, asked.campaigns, asked.seed)
            print(f"| {case.name} | {samples:.1f} | {whole:.1f} | {width:.2f} |", flush=True)


if __name__ == "__main__":
    main()
