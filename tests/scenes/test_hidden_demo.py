"""`tissue-sim demo --hidden`: drawing of the effect, judgement of the diagnosis, and one complete run."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import tissue_sim as ts
from calibration import diagnose
from calibration.diagnosis.diagnosis import FoundEffect
from calibration.effects.rig import Backlash, MachineCompliance
from calibration.effects.tissue import Viscoelasticity
from scenes.cli import main
from scenes.commands.demo import make_found_effects_scene_with_plain_curve
from scenes.demo.hidden_effect_demo import (
    HIDEABLE_EFFECTS,
    MEASUREMENT,
    PLATES,
    HiddenEffect,
    build_plain_models,
    choose_hidden_or_no_effect,
    judge_diagnosis_with_sentence,
)
from scenes.viewer.measurement import compute_force_residual
from scenes.viewer.session import Session

RELAXING = 23
EFFECTS = {"viscoelasticity": Viscoelasticity, "machine_compliance": MachineCompliance, "backlash": Backlash}


def test_each_effect_is_drawn_and_equal_seeds_draw_equal_effects():
    drawn = [choose_hidden_or_no_effect(seed) for seed in range(200)]
    assert {each.name for each in drawn} == {"", *(each.name for each in HIDEABLE_EFFECTS)}
    assert [choose_hidden_or_no_effect(seed) for seed in range(200)] == drawn
    bounds = {each.name: each.sizes for each in HIDEABLE_EFFECTS}
    for each in drawn:
        for path, value in each.values.items():
            low, high = bounds[each.name][path]
            assert low <= value <= high


@pytest.mark.parametrize("hideable", HIDEABLE_EFFECTS, ids=lambda each: each.name)
def test_each_effect_changes_its_tests_and_has_a_description(hideable):
    hidden = HiddenEffect(hideable.name, {path: ends[1] for path, ends in hideable.sizes.items()}, hideable.tests)
    models = build_plain_models()
    for test, model in models.items():
        assert (hidden.add_effect_to_test_model(test, model) != model) == (test in hideable.tests)
    assert " = " in hidden.describe_with_values(models)
    assert HiddenEffect().describe_with_values(models) == "nothing"


def test_friction_is_applied_to_both_plates():
    friction = HiddenEffect("plate_friction", {"experiment.friction": 0.05}, (PLATES,))
    model = friction.add_effect_to_test_model(PLATES, build_plain_models()[PLATES])
    assert model.experiment.resolved_base_interface == model.experiment.friction == 0.05


@pytest.mark.parametrize(("hidden", "verdict", "named", "candidates", "right", "expected"), [
    ("backlash", "NAMED", ["backlash"], ["backlash"], True, "Found: "),
    ("backlash", "LOOKS_LIKE", ["backlash"], ["backlash"], True, "form unconfirmed"),
    ("backlash", "SET", ["sensor_drift"], ["sensor_drift", "backlash"], True, "one of 2 effects"),
    ("backlash", "SET", ["sensor_drift"], ["sensor_drift", "softening"], False, "Wrong"),
    ("backlash", "NAMED", ["backlash", "softening"], ["backlash", "softening"], False, "effect that was not hidden"),
    ("backlash", "NAMED", ["softening"], ["softening"], False, "Wrong"),
    ("backlash", "NONE", [], [], False, "Missed"),
    ("backlash", "UNKNOWN", [], [], False, "does not identify it"),
    ("", "NONE", [], [], True, "nothing was found"),
    ("", "NAMED", ["softening"], ["softening"], False, "False alarm"),
    ("", "UNKNOWN", [], [], False, "an unknown effect"),
])
def test_the_diagnosis_is_judged(hidden, verdict, named, candidates, right, expected):
    effects = [FoundEffect(name=name, category="rig", title=name) for name in named]
    diagnosis = SimpleNamespace(verdict=verdict, effects=effects, indistinguishable=candidates)
    is_right, sentence = judge_diagnosis_with_sentence(HiddenEffect(hidden), diagnosis)
    assert is_right is right and expected in sentence


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Complete run with fewer samples and effects than the default."""
    import contextlib
    import io

    out, text = tmp_path_factory.mktemp("hidden") / "demo", io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(text):
        patch.setattr("calibration.diagnosis.proposals.CATALOGUE", EFFECTS)
        patch.setattr("scenes.demo.hidden_effect_demo.MEASUREMENT", replace(MEASUREMENT, samples=60, replicates=2))
        patch.setattr("os.cpu_count", lambda: 1)
        assert main(["demo", "--hidden", "--seed", str(RELAXING), "-o", str(out)]) == 0
        yield out, text.getvalue()


@pytest.mark.slow
def test_the_demo_finds_the_effect_and_reveals_it_at_the_end(demo):
    out, text = demo
    hidden = choose_hidden_or_no_effect(RELAXING)
    assert hidden.name == "viscoelasticity"
    found = json.loads((out / "diagnosis" / "diagnosis.json").read_text(encoding="utf-8"))
    assert [each["name"] for each in found["effects"]] == [hidden.name]
    for number in found["effects"][0]["parameters"]:
        assert number["value"] == pytest.approx(hidden.values[number["path"]], rel=0.15)
    assert found["gap_after_N"] < 0.15 * found["gap_before_N"]
    assert (out / "before_and_after.png").read_bytes().startswith(b"\x89PNG")
    last = text.strip().splitlines()[-2:]
    assert f"(seed {RELAXING})" in last[0] and "viscoelasticity (g1 = 0.122, tau1 = 6.3 s) was hidden" in last[0]
    assert last[1].strip().startswith("Found: viscoelasticity (g1 = 0.1")
    assert str(out / "diagnosis" / "report.html") in text and found["message"] in text
    assert len(list((out / "measured").glob("*.csv"))) == 4


@pytest.mark.slow
def test_the_viewer_shows_both_models(demo):
    out, _ = demo
    (result,) = diagnose([out / "campaign.toml"], out / "diagnosis")
    assert result.resumed
    scene = make_found_effects_scene_with_plain_curve(result, out / "measured")
    assert scene.kind.name == "needle_indentation" and scene.compared[0] == "without viscoelasticity"
    assert scene.material.viscoelastic.terms[0].g == pytest.approx(0.122, rel=0.15), "the material relaxes"
    with_it = ts.simulate(ts.Model(scene.experiment, scene.material))
    without_it = compute_force_residual(scene.compared[1], scene.measurement)
    assert compute_force_residual(with_it, scene.measurement).rmse < 0.6 * without_it.rmse


@pytest.mark.slow
def test_a_rig_effect_is_part_of_the_curve_of_the_session(demo, monkeypatch):
    out, _ = demo
    (result,) = diagnose([out / "campaign.toml"], out / "diagnosis")
    scene = make_found_effects_scene_with_plain_curve(result, out / "measured")
    asked = []
    monkeypatch.setattr("scenes.viewer.background_simulation.ModelCurveWorker.store_curve_request",
                        lambda self, model: asked.append(model))
    session = Session(replace(scene, rig=ts.Rig(backlash=1e-4)))
    try:
        assert asked[0].rig.backlash == 1e-4
        assert session.update_and_make_frame().curves.compared is scene.compared
    finally:
        session.close()


@pytest.mark.slow
def test_the_page_opens_after_the_run(demo, monkeypatch, tmp_path):
    """The scene of the page, without a browser."""
    out, _ = demo
    (result,) = diagnose([out / "campaign.toml"], out / "diagnosis")
    shown = []
    monkeypatch.setattr("scenes.demo.hidden_effect_demo.run_hidden_demo",
                        lambda *_, **__: SimpleNamespace(result=result))
    monkeypatch.setattr("scenes.viewer.run.run_viewer_page", lambda scene, *_, **__: shown.append(scene) or 0)
    assert main(["demo", "--hidden", "--view", "--seed", "1", "-o", str(out), "--overwrite"]) == 0
    assert shown[0].kind.name == "needle_indentation" and shown[0].compared is not None


def test_a_folder_with_other_files_is_refused(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    assert main(["demo", "--hidden", "-o", str(tmp_path)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert [path.name for path in Path(tmp_path).iterdir()] == ["notes.txt"]
