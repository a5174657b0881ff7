"""Campaigns of virtual recordings with a hold and a return, and what a fit of them knows."""

from dataclasses import dataclass, replace

import numpy as np

import tissue_sim as ts
from calibration.campaign.campaign import Campaign, load_campaign
from calibration.campaign.measured import make_campaign_with_scaled_offset_defaults, read_measured_curves
from calibration.campaign_diagnosis import DiagnosisWithFits, diagnose_campaign, read_campaign_and_curves_for_diagnosis
from calibration.diagnosis.proposals import simulate_whitened_effect_change_or_reason
from calibration.effects.effect import Candidate, DiagnosisData
from calibration.fit.problem import GeneralisedProblem, ProblemEvaluation, build_generalised_problem
from calibration.fit.run_context import RunContext
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.adequacy import EffectDirection, compute_orthonormal_basis
from calibration.tasks.executors import Workers, open_task_executor

#: Name of the law.
LAW = "reduced_polynomial_2"
TRUTH = {"C10": 1404.9, "C20": 699.4}
TESTS = {"plates": ("lubricated_compression", ts.Tool(), "frictionless"),
         "glued": ("bonded_compression", ts.Tool(), "bonded"),
         "needle": ("needle_indentation", ts.Tool("flat", 0.008), "bonded")}
NOISE = 0.01
PROTOCOL = "ramp 8mm @0.5mm/s; hold 20s; unload 0.2mm @0.5mm/s"


def model_of(name, points=41):
    """The model of a test, without any effect."""
    kind, tool, friction = TESTS[name]
    protocol = ts.Protocol.parse(PROTOCOL, points=points)
    experiment = ts.KINDS[kind].experiment(specimen=ts.Specimen(0.04, 0.07, density=1000.0), protocol=protocol,
                                           tool=tool, friction=friction)
    return ts.Model(experiment, ts.Material(LAW, TRUTH, ts.Bulk("bulk_ratio", 1e4)))


@dataclass(frozen=True)
class Fitted:
    """A campaign at the true parameters of its law."""

    situation: DiagnosisData
    problem: GeneralisedProblem
    evaluation: ProblemEvaluation

    @property
    def campaign(self) -> Campaign:
        return self.situation.campaign

    def change(self, candidate: Candidate) -> np.ndarray:
        """Return the change of the whitened forces by an effect of its trial size, (N, q)."""
        column = simulate_whitened_effect_change_or_reason(self.problem, self.evaluation, self.campaign, candidate)
        assert isinstance(column, np.ndarray), (candidate.name, column)
        return column

    def score(self, candidate: Candidate) -> float:
        """Return the signal of an effect in standard deviations, with the sign of its trial size."""
        residual, design = self.evaluation.full_residual_and_jacobian
        column = self.change(candidate)
        direction = EffectDirection.from_whitened_change(np.vstack([column, np.zeros((residual.size - len(column),
                                                                                      column.shape[1]))]),
                                                         compute_orthonormal_basis(design), positive=True)
        return float(direction.compute_score_components(residual)[0]) if direction.degrees_of_freedom else 0.0


def measured_campaign(folder, change=lambda name, model: model, *, tests=TESTS, specimens=("one",), fit="", seed=1):
    """A campaign of virtual recordings; `change` hides something in the model of a test."""
    rng, text = np.random.default_rng(seed), ""
    for specimen in specimens:
        text += f'[[specimen]]\nname = "{specimen}"\nradius_mm = 40.0\nheight_mm = 70.0\ndensity_kg_m3 = 1000.0\n'
    for specimen in specimens:
        for test in tests:
            name = test if len(specimens) == 1 else f"{test}_{specimen}"
            true = ts.simulate(change(name, model_of(test)))
            read = true.with_channels(force=true.force + rng.normal(0.0, NOISE, len(true)))
            ts.write_recording(read, folder / f"{name}.csv")
            text += f'[[test]]\nname = "{name}"\nspecimen = "{specimen}"\nkind = "{TESTS[test][0]}"\n' \
                    f'recordings = ["{name}.csv"]\n'
            text += 'tool = "flat"\ntool_radius_mm = 8.0\nfriction = "bonded"\n' if test == "needle" else ""
    path = folder / "campaign.toml"
    path.write_text(f'{text}[fit]\nmethod = "inverse_fem"\nlaws = ["{LAW}"]\nbulk_ratio = 10000.0\n'
                    f'start = {{ C10 = 1400.0, C20 = 700.0 }}\n{fit}\n[noise]\nforce_N = {NOISE}\n'
                    'contact_jitter_mm = 0.01\nzero_jitter_N = 0.005\n', encoding="utf-8")
    return path


def situation_of(path):
    campaign = load_campaign(path)
    campaign = replace(campaign, fit=replace(campaign.fit, whole=True))
    measured = read_measured_curves(campaign)
    campaign = make_campaign_with_scaled_offset_defaults(campaign, measured)
    return DiagnosisData(campaign, measured, campaign.fit.laws[0])


def fitted(path):
    situation = situation_of(path)
    problem = build_generalised_problem(situation.law, situation.campaign, situation.measured, SimulationCache())
    theta = np.array([TRUTH[name] for name in problem.space.free])
    return Fitted(situation, problem, problem.evaluate(theta))


PLATES = """
[[specimen]]
radius_mm = 20.0
height_mm = 30.0
[[test]]
name = "plates"
kind = "lubricated_compression"
recordings = ["plates_*.csv"]
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 10000.0
starts = 1
start = { C10 = 1500.0 }
"""


def diagnosed_plates(folder, *, terms=(), rig=None, friction="frictionless", ripple=0.0, samples=121,
                     seed=3) -> DiagnosisWithFits:
    """Three recordings of a ramp, a hold and a return with what is hidden in them, diagnosed."""
    time = np.linspace(0.0, 60.0, samples)
    depth = np.interp(time, [0, 15, 45, 60], [0, 3e-3, 3e-3, 0])
    truth = ts.Material("neo_hooke", {"C10": 1404.9}, ts.Bulk("bulk_ratio", 1e4),
                        viscoelastic=ts.Prony(tuple(ts.PronyTerm(*term) for term in terms)) if terms else None)
    experiment = ts.Experiment(ts.Specimen(0.020, 0.030), ts.Protocol(time, depth), ts.Tool("plate"),
                               friction=friction, friction_base=friction)
    force = ts.simulate(ts.Model(experiment, truth, rig or ts.Rig())).force
    force = force + ripple * np.sign(np.sin(2 * np.pi * depth / 0.15e-3)) * (time < 15)
    random = np.random.default_rng(seed)
    for number in (1, 2, 3):
        measured = force + random.normal(0, 0.005) + random.normal(0, 0.01, time.size)
        ts.write_recording(ts.Recording({"time": time, "displacement": depth, "force": measured}),
                           folder / f"plates_{number}.csv")
    (folder / "study.toml").write_text(PLATES, encoding="utf-8")
    campaign, recordings = read_campaign_and_curves_for_diagnosis(folder / "study.toml")
    with open_task_executor(Workers()) as tasks:
        return diagnose_campaign(campaign, recordings, RunContext("study", tasks))
