"""Files and texts of a diagnosis: plan, report, and material files that simulators and calibrations load."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from virtual_campaign import PLATES, diagnosed_plates

import tissue_sim as ts
from calibration.campaign.campaign import load_campaign
from calibration.campaign.planned import read_or_plan_curves_of_all_tests
from calibration.campaign_diagnosis import write_effect_files_and_get_diagnosis
from calibration.diagnosis.design import (
    evaluate_experiment_design,
    list_variations_of_existing_tests,
    simulate_noise_free_evidence,
)
from calibration.diagnosis.diagnosis import (
    CandidateResult,
    EffectParameter,
    FoundEffect,
    HeldOutPrediction,
    SegmentMisfit,
    summarise_diagnosis,
)
from calibration.diagnosis.evidence import (
    compute_upper_limit_of_estimated_jitter,
    make_one_law_whole_recording_campaign,
)
from calibration.effects.contact import PlateFriction
from calibration.effects.rig import MachineCompliance, SensorDrift
from calibration.effects.tissue import Viscoelasticity
from calibration.fit.run_context import RunContext
from calibration.forward.simulation_cache import SimulationCache
from calibration.tasks.executors import Workers, open_task_executor
from tissue_sim.decode import format_toml
from tissue_sim.errors import InputError

pytestmark = pytest.mark.slow

PLAN = PLATES.replace('recordings = ["plates_*.csv"]', 'protocol = "ramp 3mm @0.2mm/s; hold 30s; unload"')


@pytest.fixture(scope="module", autouse=True)
def four_effects():
    """The whole catalogue takes longer than all that is asked here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calibration.diagnosis.proposals.CATALOGUE", {
            "viscoelasticity": Viscoelasticity, "machine_compliance": MachineCompliance, "sensor_drift": SensorDrift,
            "plate_friction": PlateFriction})
        yield


def diagnose(folder, **hidden):
    """The diagnosis, what it stands on, and the folder that it was written to."""
    folder.mkdir()
    found = diagnosed_plates(folder, **hidden)
    out = folder / "out"
    out.mkdir()
    return write_effect_files_and_get_diagnosis(found.diagnosis, found.after, out), found, out


@pytest.fixture(scope="module")
def relaxing(tmp_path_factory):
    return diagnose(tmp_path_factory.mktemp("hidden") / "relaxes", terms=[(0.1, 4.0), (0.15, 40.0)])


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    return diagnose(tmp_path_factory.mktemp("hidden") / "drifts", rig=ts.Rig(sensor_drift=3e-3))


def test_a_tissue_goes_into_a_material_that_relaxes_in_real_time(relaxing):
    diagnosis, _, out = relaxing
    assert [effect.name for effect in diagnosis.effects] == ["viscoelasticity"]
    assert diagnosis.effects[0].written_to == diagnosis.files["material"]
    material = ts.load_material(out / diagnosis.files["material"])
    error = diagnosis.fit_after.standard_errors["C10"]
    assert error < 0.15 * 1404.9 and abs(material.parameters["C10"] - 1404.9) < 4 * error
    left = 1.0 - sum(term.g for term in material.viscoelastic.terms)
    experiment = ts.Experiment(ts.Specimen(0.020, 0.030), ts.Protocol.ramp(3e-3), ts.Tool("flat", 0.005))
    simulator = ts.Simulator(ts.Model(experiment, material))
    pushed = [simulator.step(depth, 0.01).force for depth in np.linspace(0, 2e-3, 10)][-1]
    relaxed = [simulator.step(2e-3, 30.0).force for _ in range(20)][-1]
    assert relaxed == pytest.approx(left * pushed, rel=0.05)


def test_one_term_is_not_enough_for_two(relaxing):
    diagnosis, found, _ = relaxing
    assert diagnosis.verdict == "NAMED" and [number.symbol for number in diagnosis.effects[0].parameters] == [
        "g1", "tau1", "g2", "tau2"]
    problem, names = found.after.problem, found.after.problem.space.free
    truth = {"C10": 1404.9, "viscoelastic.terms[0].g": 0.15, "viscoelastic.terms[0].tau": 40.0,
             "viscoelastic.terms[1].g": 0.1, "viscoelastic.terms[1].tau": 4.0}
    worse = problem.evaluate(np.array([truth[name]
                                       for name in names])).penalised_sum_of_squares - found.after.estimate.error
    assert 0 <= worse < chi2.isf(1e-4, len(names)), "the truth is among what the data allow"
    assert found.after.has_adequate_region_residuals and not found.before.has_adequate_region_residuals


def test_provenance_says_which_diagnosis(drifting):
    diagnosis, _, out = drifting
    data = json.loads((out / diagnosis.files["material"]).read_text())
    said = data["provenance"]["settings"]["diagnosis"]
    assert said["verdict"] == "NAMED" and said["effects"][0]["name"] == "sensor_drift"


def test_a_rig_goes_into_a_rig_file_and_no_material(drifting):
    diagnosis, _, out = drifting
    assert [effect.name for effect in diagnosis.effects] == ["sensor_drift"]
    assert ts.load_rig(out / diagnosis.files["rig"]).sensor_drift == pytest.approx(3e-3, rel=0.05)
    material = ts.load_material(out / diagnosis.files["material"])
    assert material.viscoelastic is None and material.parameters["C10"] == pytest.approx(1404.9, rel=0.01)


@pytest.mark.parametrize(("which", "path"), [
    pytest.param("relaxing", "viscoelastic.terms[1].tau", marks=pytest.mark.slow), ("drifting", "rig.sensor_drift")])
def test_the_campaign_with_it_is_fitted_again(which, path, request):
    diagnosis, found, out = request.getfixturevalue(which)
    again = load_campaign(out / diagnosis.files["campaign"])
    after = next(number for effect in diagnosis.effects for number in effect.parameters if number.path == path)
    assert again.fit.start[path] == pytest.approx(after.value)
    assert again.fit.start["C10"] == pytest.approx(found.after.parameter_values["C10"])
    assert [len(test.recordings) for test in again.tests] == [3]


def test_friction_of_both_plates_is_in_the_campaign(tmp_path):
    diagnosis, _, out = diagnose(tmp_path / "rubs", friction=0.1)
    assert [effect.name for effect in diagnosis.effects] == ["plate_friction"]
    test, = load_campaign(out / diagnosis.files["campaign"]).tests
    assert test.kind.name == "friction_compression" and test.experiment.friction == pytest.approx(0.1, abs=0.01)
    assert test.experiment.resolved_base_interface == test.experiment.friction
    assert load_campaign(out / diagnosis.files["campaign"]).fit.start["experiment.friction"] == test.experiment.friction


def test_what_is_rough_and_the_same_in_all_recordings_is_not_called_nothing(tmp_path):
    diagnosis, found, _ = diagnose(tmp_path / "stick_slip", ripple=0.03)
    assert diagnosis.verdict == "UNKNOWN" and not diagnosis.effects
    assert found.before.tests_with_common_signal == ["plates"]
    assert "all recordings of plates (a wave of" in diagnosis.message, diagnosis.message
    assert diagnose(tmp_path / "smooth")[0].verdict == "NONE"


def test_few_recordings_do_not_prove_that_nothing_scatters(drifting):
    _, found, _ = drifting
    problem, theta = found.before.problem, found.before.estimate.theta
    noise = found.before.campaign.noise
    problem = replace(problem, jitter=replace(problem.jitter, contact=0.0, zero=0.0))
    larger = compute_upper_limit_of_estimated_jitter(problem, theta, noise)
    assert 0 < larger.zero < 0.03 and larger.contact > 0
    assert compute_upper_limit_of_estimated_jitter(problem, theta, replace(noise, zero_jitter=0.0)).zero == 0.0
    problem = replace(problem, jitter=replace(problem.jitter, zero=0.02))
    assert 0.02 < compute_upper_limit_of_estimated_jitter(problem, theta, noise).zero < 0.08


def test_plans_change_one_thing(drifting):
    words = [plan.sentence for plan in list_variations_of_existing_tests(drifting[1].before)]
    assert any("10 times as fast" in sentence for sentence in words) and any("half the height" in one for one in words)
    assert not any("with a hold" in sentence for sentence in words), "it has one"


def test_a_plan_needs_no_recording(tmp_path):
    (tmp_path / "plan.toml").write_text(PLAN + "[noise]\nforce_N = 0.01\n", encoding="utf-8")
    campaign = make_one_law_whole_recording_campaign(load_campaign(tmp_path / "plan.toml", planned=True))
    with open_task_executor(Workers()) as tasks:
        found = evaluate_experiment_design(simulate_noise_free_evidence(
            campaign, read_or_plan_curves_of_all_tests(campaign, replicates=3, samples=121), SimulationCache()),
                                           RunContext("plan", tasks))
    rows = {row.name: row for row in found.candidates}
    assert rows["viscoelasticity"].testable and rows["viscoelasticity"].seen_from["viscoelastic.terms[0].g"] < 0.02
    assert 0 < found.standard_errors["C10"] < 20 and [test.recordings for test in found.tests] == [3]
    shorter = make_one_law_whole_recording_campaign(load_campaign(tmp_path / "plan.toml", planned=True))
    shorter = replace(shorter, tests=(replace(shorter.tests[0], protocol="ramp 3mm @0.2mm/s"),))
    with open_task_executor(Workers()) as tasks:
        ramp = evaluate_experiment_design(simulate_noise_free_evidence(
            shorter, read_or_plan_curves_of_all_tests(shorter, replicates=3, samples=121), SimulationCache()),
                                          RunContext("plan", tasks))
    row = next(row for row in ramp.candidates if row.name == "viscoelasticity")
    assert not row.testable or row.seen_from["viscoelastic.terms[0].g"] > 3 * rows["viscoelasticity"].seen_from[
        "viscoelastic.terms[0].g"], "a ramp alone says little of relaxation"


@pytest.mark.parametrize(("text", "field"), [(PLAN, "noise.force_N"),
                                             (PLAN.replace("ramp 3mm", "ramp 3xm") + "[noise]\nforce_N = 0.01\n",
                                              "test[0].protocol"),
                                             (PLAN.replace("ramp 3mm", "ramp 40mm") + "[noise]\nforce_N = 0.01\n",
                                              "test[0].protocol")])
def test_a_plan_that_is_none_is_refused(text, field, tmp_path):
    (tmp_path / "plan.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_or_plan_curves_of_all_tests(
            make_one_law_whole_recording_campaign(load_campaign(tmp_path / "plan.toml", planned=True)))
    assert refused.value.field == field


def test_toml_is_read_back():
    content = {"specimen": [{"name": "a b", "radius_mm": 20.0}], "test": [{"recordings": ["x\\y.csv", 'q".csv'],
                                                                           "hold_out": True, "columns": {
                                                                               "Kraft (N)": "force"}}],
               "fit": {"laws": ["neo_hooke"], "start": {"viscoelastic.terms[0].g": 0.1, "C10": 1e3}}, "noise": {}}
    assert tomllib.loads(format_toml(content)) == content


def test_sentences():
    region = SegmentMisfit(test="plates", segment="hold", before_N=0.1, largest_before_N=-0.1, before_sigma=9.0,
                           adequate_before=False,
                           sentence="plates hold: the force falls by 0.1 N, the model's by nothing")
    compliance = FoundEffect(name="machine_compliance", category="rig", title="machine compliance", parameters=[
        EffectParameter(path="rig.compliance", symbol="c", unit="m/N", value=2e-5, standard_error=1e-6, absent=0.0)])
    named = summarise_diagnosis("NAMED", [compliance], ["machine compliance"], [region], (0.1, 0.01, 0.02), 3)
    assert named == ("Machine compliance (c = 0.02 ± 0.001 mm/N) was missing. The misfit falls from 0.1 to 0.01 N "
                     "(5 to 0.5 times the noise).")
    several = summarise_diagnosis("SET", [compliance], ["machine compliance", "height"], [region],
                                  (0.1, 0.01, 0.02), 3)
    assert several.startswith("Machine compliance or height is missing, and these tests cannot distinguish them")
    softening = CandidateResult(name="softening", effect="softening", category="tissue", title="softening",
                                testable=True, explained_percent=49.0)
    unknown = summarise_diagnosis("UNKNOWN", [], [], [region], (0.1, None, 0.02), 3, nearest=softening)
    assert "the force falls by 0.1 N" in unknown and "Softening comes nearest and explains 49 % of it." in unknown
    train = CandidateResult(
        name="machine_compliance", effect="machine_compliance", category="rig", title="machine compliance",
        testable=True, explained_percent=100.0, separated_by="pressing on steel", parameters=[EffectParameter(
            path="rig.compliance", symbol="c", unit="m/N", value=2e-3, standard_error=1e-6, absent=0.0, bound=2e-3)])
    bounded = summarise_diagnosis("UNKNOWN", [], [], [region], (0.1, None, 0.02), 3, nearest=train)
    assert ("Machine compliance comes nearest and explains 100 % of it, but its fit ended on a bound, c = 2 mm/N, the "
            "largest that a fit may take. A value on a bound is not reliable, so the effect was not named. Either its "
            "size exceeds the bound, which a separate measurement would show (here: pressing on steel), or another "
            "effect changes the forces in the same way.") in bounded
    worse = [HeldOutPrediction(name="later", kind="test", before_N=0.1, after_N=0.2)]
    assert "predicted worse" in summarise_diagnosis("NAMED", [compliance], [], [region], (0.1, 0.01, 0.02), 3,
                                                    worse)
    assert summarise_diagnosis("NONE", [], [], [], (0.0, None, 0.02), 3).startswith("Nothing is missing")
