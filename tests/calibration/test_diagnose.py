"""`calibration.diagnose`: folders, what is read back, the page of every verdict, and its numbers."""

import json
import re

import numpy as np
import pytest
from msgspec.structs import replace

import calibration
import tissue_sim as ts
from calibration.campaign_diagnosis import diagnose_campaign, read_campaign_and_curves_for_diagnosis
from calibration.diagnosis.diagnosis import CandidateResult, EffectParameter, NextExperiment, summarise_diagnosis
from calibration.effects.rig import MachineCompliance
from calibration.effects.tissue import Viscoelasticity
from calibration.fit.run_context import RunContext
from calibration.report.content import get_parts
from calibration.report.drawing import FigureEmbedder
from calibration.report.outputs import build_report_page
from calibration.report.quantities import DisplayUnit, ReportUnits
from calibration.report.section import DiagnosisReport
from calibration.report.tables import format_detectable_sizes, make_fitted_parameter_text
from calibration.tasks.executors import Workers, open_task_executor

CAMPAIGN = """
[[specimen]]
radius_mm = 20.0
height_mm = 30.0
[[test]]
name = "ramps"
kind = "lubricated_compression"
recordings = ["ramps_1.csv", "ramps_2.csv"]
[[test]]
name = "later"
kind = "lubricated_compression"
recordings = ["ramps_3.csv"]
hold_out = true
[fit]
method = "inverse_fem"
laws = ["neo_hooke", "reduced_polynomial_2"]
bulk_ratio = 10000.0
starts = 1
start = { C10 = 1500.0 }
[noise]
force_N = 0.01
correlation_time_s = 0
contact_jitter_mm = 0.02
zero_jitter_N = 0.005
"""
UNITS = ReportUnits(DisplayUnit("mm", 1e-3), DisplayUnit("N", 1.0), DisplayUnit("kPa", 1e3))


@pytest.fixture(scope="module", autouse=True)
def two_effects():
    """The whole catalogue takes longer than all that is asked here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calibration.diagnosis.proposals.CATALOGUE", {
            "viscoelasticity": Viscoelasticity, "machine_compliance": MachineCompliance})
        yield


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Ramps of a tissue that has no more than its law; one of them in a test that is held out."""
    folder, random = tmp_path_factory.mktemp("plain"), np.random.default_rng(5)
    time, depth = np.linspace(0.0, 15.0, 31), np.linspace(0.0, 3e-3, 31)
    experiment = ts.Experiment(ts.Specimen(0.020, 0.030), ts.Protocol(time, depth), ts.Tool("plate"),
                               friction="frictionless", friction_base="frictionless")
    material = ts.Material("neo_hooke", {"C10": 1404.9}, ts.Bulk("bulk_ratio", 1e4))
    exact = ts.simulate(ts.Model(experiment, material, ts.Rig())).force
    for number in (1, 2, 3):
        force = exact + random.normal(0, 0.005) + random.normal(0, 0.01, time.size)
        ts.write_recording(ts.Recording({"time": time, "displacement": depth, "force": force}),
                           folder / f"ramps_{number}.csv")
    path = folder / "plain.toml"
    path.write_text(CAMPAIGN, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def diagnosed(campaign, two_effects):
    """The parts of a diagnosis of it, and its recordings."""
    asked, measured = read_campaign_and_curves_for_diagnosis(campaign)
    with open_task_executor(Workers()) as tasks:
        return diagnose_campaign(asked, measured, RunContext(asked.name, tasks)), measured


@pytest.mark.slow
def test_nothing_hidden_is_nothing_missing(diagnosed):
    found = diagnosed[0].diagnosis
    assert found.verdict == "NONE" and found.effects == [] and found.fit_after is None
    assert all(region.adequate_before and region.after_N is None for region in found.regions)
    (unseen,) = found.held_out
    assert unseen.name == "later" and unseen.adequate_before and unseen.before_N == pytest.approx(0.01, rel=0.5)
    seen = {each.name: each for each in found.candidates}["machine_compliance"]
    # What a ramp of one test cannot tell from a softer tissue, or tells with a size.
    assert seen.reason if not seen.testable else seen.seen_from["rig.compliance"] > 0


@pytest.mark.slow
def test_a_displacement_zeroed_at_a_preload_is_named_and_counted_from(tmp_path):
    law, area = ts.find_law("neo_hooke"), np.pi * 0.010**2
    displacement = np.linspace(0.0, 2.6e-3, 66)
    force = -area * law.nominal_stress(1.0 - (displacement + 0.4e-3) / 0.012, {"C10": 10e3})
    force = force + np.random.default_rng(3).normal(0.0, 0.01, force.size)
    ts.write_recording(ts.Recording({"time": displacement / 0.5e-3, "displacement": displacement, "force": force}),
                       tmp_path / "preload.csv")
    path = tmp_path / "preload.toml"
    path.write_text("""
[[specimen]]
radius_mm = 10.0
height_mm = 12.0
[[test]]
kind = "lubricated_compression"
recordings = ["preload.csv"]
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 1000.0
""", encoding="utf-8")
    campaign, measured = read_campaign_and_curves_for_diagnosis(path)
    with open_task_executor(Workers()) as tasks:
        found = diagnose_campaign(campaign, measured, RunContext("preload", tasks)).diagnosis
    assert found.verdict == "NONE" and all(region.adequate_before for region in found.regions)
    assert "contact lies 0.40 mm before the zero of the displacement" in found.message
    assert found.fit_before.parameters["C10"] == pytest.approx(10e3, rel=0.01)


def test_a_gap_in_no_region_is_described_by_the_scores():
    gaps = 0.01, None, 0.01
    words = summarise_diagnosis("UNKNOWN", [], [], [], gaps, 0, scored=["zero offset (8.1 standard deviations)"])
    assert ": ." not in words and "of every region are within the noise" in words and "zero offset (8.1" in words


@pytest.mark.slow
def test_a_size_on_its_bound_is_named_with_it(tmp_path):
    """A load train that takes up a third of the way, where a fit may go to a fifth of it."""
    time, depth = np.linspace(0.0, 15.0, 31), np.linspace(0.0, 3e-3, 31)
    material = ts.Material("neo_hooke", {"C10": 1404.9}, ts.Bulk("bulk_ratio", 1e4))
    text = CAMPAIGN.replace("force_N = 0.01", "force_N = 0.002").partition("[[test]]")
    tests, stiffness = "", 0.0
    for number, kind in enumerate(("lubricated_compression", "bonded_compression")):
        experiment = ts.KINDS[kind].experiment(specimen=ts.Specimen(0.020, 0.030), protocol=ts.Protocol(time, depth))
        stiffness = stiffness or ts.simulate(ts.Model(experiment, material)).force[-1] / depth[-1]
        force = ts.simulate(ts.Model(experiment, material, ts.Rig(compliance=0.6 / stiffness))).force
        for each in (1, 2):
            noise = np.random.default_rng(10 * number + each).normal(0, 0.002, time.size)
            ts.write_recording(ts.Recording({"time": time, "displacement": depth, "force": force + noise}),
                               tmp_path / f"{kind}_{each}.csv")
        tests += f'[[test]]\nname = "{kind}"\nkind = "{kind}"\nrecordings = ["{kind}_*.csv"]\n'
    path = tmp_path / "train.toml"
    path.write_text(text[0] + tests + text[2][text[2].index("[fit]"):], encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calibration.diagnosis.proposals.CATALOGUE", {"machine_compliance": MachineCompliance})
        found = calibration.diagnose([path], tmp_path / "out", figures=False)[0].diagnosis
    (row,) = found.candidates
    (number,) = row.parameters
    assert found.verdict == "UNKNOWN" and row.on_bound == ["c"]
    assert number.bound == pytest.approx(number.value, rel=1e-4) and number.bound > 0
    assert f"c = {1e3 * number.value:.4g} mm/N, the largest that a fit may take" in found.message
    assert "c on a bound" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def plain_data(content):
    return json.loads(json.dumps(content))


@pytest.mark.slow
def test_several_campaigns_have_folders_and_are_read_back(campaign, tmp_path):
    other = campaign.with_name("other.toml")
    other.write_text(CAMPAIGN.replace("1500.0", "1600.0"), encoding="utf-8")
    said = []
    results = calibration.diagnose([campaign, other], tmp_path, figures=False,
                                   progress=lambda sentence, *counts: said.append(sentence))
    assert [result.output for result in results] == [tmp_path / "plain", tmp_path / "other"]
    assert {sentence.partition(": ")[0] for sentence in said} == {"plain", "other"}
    assert "plain: effects, one at a time" in said
    written = json.loads((tmp_path / "plain" / "diagnosis.json").read_text(encoding="utf-8"))
    assert written == plain_data(calibration.diagnosis_to_json(results[:1]))
    assert plain_data(calibration.diagnosis_to_json(results))["campaigns"][0] == written
    again = calibration.diagnose([campaign, other], tmp_path)
    assert all(result.resumed for result in again)
    assert [result.diagnosis for result in again] == [result.diagnosis for result in results]
    with pytest.raises(ts.InputError, match="it contains results of other campaigns"):
        calibration.diagnose([campaign, other], tmp_path, law="reduced_polynomial_2")
    with pytest.raises(ts.InputError, match="got 'plain' twice"):
        calibration.diagnose([campaign, campaign], tmp_path / "twice")
    with pytest.raises(ts.InputError, match="figures_format must be"):
        calibration.diagnose([campaign], tmp_path / "gif", figures_format="gif")
    assert not (tmp_path / "twice").exists() and not (tmp_path / "gif").exists()


@pytest.mark.slow
def test_other_decision_limits_and_refit_settings_are_used_and_stated(campaign, diagnosed, tmp_path):
    limits = calibration.DecisionLimits(region_level=0.9999)
    refit_settings = calibration.RefitSettings(on_bound=1e9, starts=(0.1,))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calibration.diagnosis.proposals.CATALOGUE", {"machine_compliance": MachineCompliance})
        results = calibration.diagnose([campaign], tmp_path, figures=False, limits=limits,
                                       refit_settings=refit_settings)
    assert calibration.diagnosis_to_json(results)["decision_limits"] == {"region_level": 0.9999}
    assert results[0].diagnosis.refit_settings == {"on_bound": 1e9, "starts": (0.1,)}
    # With this relative distance every size counts as on its bound.
    (row,) = results[0].diagnosis.candidates
    assert row.on_bound == ["c"]
    assert not all(region.adequate_before for region in results[0].diagnosis.regions)
    plain = diagnosed[0].diagnosis
    assert plain.decision_limits == {} and all(region.adequate_before for region in plain.regions)


def test_decision_limits_must_be_positive():
    with pytest.raises(ts.InputError, match=r"odds must be positive; got -1"):
        calibration.DecisionLimits(odds=-1.0)


def summary(page):
    """Term -> text of the summary."""
    terms = re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", page)
    return {term: re.sub(r"<[^>]+>", " ", text) for term, text in terms}


@pytest.mark.slow
def test_pages_of_verdicts(diagnosed, tmp_path):
    parts, measured = diagnosed
    effects = parts.proposals.effects

    def page(pictures=None, **changes):
        return build_report_page(DiagnosisReport(replace(parts.diagnosis, **changes), parts.before, None, effects,
                                                 measured, pictures))

    plain = page(FigureEmbedder(tmp_path))
    assert next(iter(summary(plain))) == "No effect missing" and summary(plain)["Where"] == "Every region agrees."
    assert plain.count("data:image/png") == 2, "one test that was fitted, and the regions; no candidate to draw"
    statements = [CandidateResult(name="viscoelasticity", effect="viscoelasticity", category="tissue",
                                  title="viscoelasticity", testable=True, score=9.0, p=5e-5, refitted=True,
                                  delta_BIC=70.0, explained_percent=99.0, evidence_ratio=1.0),
                  CandidateResult(name="machine_compliance", effect="machine_compliance", category="rig",
                                  title="machine compliance", testable=True, score=-8.0, p=1.0, refitted=True,
                                  delta_BIC=66.0, evidence_ratio=7.4, on_bound=["c"]),
                  CandidateResult(name="tilt@later", effect="tilt", category="geometry", title="tilt of a face",
                                  testable=False, reason="no face <is> flat")]
    several = page(FigureEmbedder(tmp_path), verdict="SET", message="One of two.", candidates=statements,
                   indistinguishable=["viscoelasticity", "machine_compliance"],
                   next_experiment=[NextExperiment(sentence="hold it", separates=["viscoelasticity"], deviations=12.3)])
    words = summary(several)
    assert next(iter(words)) == "Several possible effects"
    assert words["Several possible effects"].strip().startswith("One of two.")
    assert "Machine compliance (1 : 7.4 against the most likely effect): pressing on steel" in words["Distinguished by"]
    assert words["Next"] == "Hold it." and "by 12 standard deviations" in several
    assert "c on a bound" in several and "wrong sign" in several and "No face &lt;is&gt; flat" in several
    assert "tilt of a face in later" in several and several.count("data:image/png") == 3
    bad = replace(parts.diagnosis.regions[0], adequate_before=False, before_sigma=14.2,
                  sentence="first third: too much")
    unknown = page(verdict="UNKNOWN", regions=[bad, *parts.diagnosis.regions[1:]])
    assert summary(unknown)["Where"].startswith("first third: too much. ") and "data:image" not in unknown


@pytest.mark.parametrize(("path", "unit", "absent", "value", "words"), [
    ("rig.compliance", "m/N", 0.0, 1.2e-5, "c 0.012 mm/N"),
    ("experiment.specimen.height", "m", 0.070, 0.07065, "c 0.65 mm (0.93 %)"),
    ("material.scale", "1", 1.0, 0.9943, "c 0.57 %"),
    ("rig.displacement_gain", "1", 0.0, -0.03, "c 3 %"),
    ("experiment.friction", "1", 0.0, 0.0041, "c 0.0041"),
    ("bulk.bulk_ratio", "1", 1e4, 1e3, "c 1000 instead of 10000"),
    ("C30", "Pa", 0.0, 97.0, "c 0.097 kPa"),
])
def test_sizes_are_in_units_that_people_use(path, unit, absent, value, words):
    candidate = CandidateResult(name="x", effect="x", category="rig", title="x", testable=True,
                                seen_from={path: value}, symbols={path: "c"}, units={path: unit},
                                absent={path: absent})
    assert format_detectable_sizes(candidate, UNITS) == words


def test_numbers_do_not_break():
    number = EffectParameter(path="rig.compliance", symbol="c", unit="m/N", value=2.04e-5, standard_error=3.1e-7)
    symbol, text = get_parts(make_fitted_parameter_text(number, UNITS))
    assert symbol.text == "c" and text == "\u00a0=\u00a00.02040\u00a0±\u00a00.00031\u00a0mm/N"
