"""Properties that every effect of the catalogue has."""

import importlib
import pkgutil
from dataclasses import replace

import numpy as np
import pytest
from virtual_campaign import TESTS, measured_campaign, model_of, situation_of

import calibration.effects
import tissue_sim as ts
from calibration.campaign.parameter_space import ParameterSpace
from calibration.effects.effect import CATALOGUE, CATEGORIES, NotTestableError

#: Names of the effects in files and reports.
NAMES = [
    "self_weight", "strain_stiffening", "i2_term", "compressibility", "viscoelasticity", "poroelasticity", "softening",
    "layer", "puncture", "plate_friction", "partial_slip", "adhesion", "edge_rounding", "radius_error", "height_error",
    "tilt", "contact_offset", "machine_compliance", "displacement_gain", "backlash", "step_loss", "zero_offset",
    "sensor_drift", "sensor_gain", "latency", "guide_friction", "rate_damping", "session_scale", "inertia",
    "readout_inertia", "readout_compliance", "readout_delay", "population"]
#: Effects that slow tests of one specimen without lift-off cannot show -> part of the reason.
REFUSED = {"adhesion": "past the first contact", "inertia": "quasi-static", "population": "one specimen",
           **dict.fromkeys(("readout_inertia", "readout_compliance", "readout_delay"), "no test is a table of moduli")}
EFFECTS = pytest.mark.parametrize("name", NAMES)


def candidates(situation, name):
    return CATALOGUE[name]().candidates(situation)


def test_catalogue_has_all_effects():
    assert sorted(CATALOGUE) == sorted(NAMES)


def test_every_module_with_an_effect_is_registered():
    modules = [importlib.import_module(f"calibration.effects.{module.name}")
               for module in pkgutil.iter_modules(calibration.effects.__path__)]
    found = {kind.name for module in modules for kind in vars(module).values()
             if isinstance(kind, type) and kind.__module__ == module.__name__ and hasattr(kind, "candidates")
             and hasattr(kind, "category")}
    assert found == set(NAMES)


@EFFECTS
def test_effect_has_name_category_and_sentences(name):
    effect = CATALOGUE[name]()
    assert effect.name == name and effect.category in CATEGORIES
    assert type(effect).__module__ == f"calibration.effects.{effect.category}"
    for sentence in (effect.title, effect.signature, effect.separated_by):
        assert len(sentence) > 5 and not sentence.endswith(".") and "\n" not in sentence
    assert set(effect.known_twins) <= set(NAMES) - {name}


@EFFECTS
def test_candidates_are_within_bounds_and_can_be_added(plain, name):
    if name in REFUSED:
        with pytest.raises(NotTestableError, match=REFUSED[name]):
            candidates(plain.situation, name)
        return
    known = [test.name for test in plain.campaign.tests]
    found = candidates(plain.situation, name)
    assert found and len({(each.name, tuple(each.shape.values())) for each in found}) == len(found)
    for candidate in found:
        assert candidate.effect.name == name and set(candidate.tests or known) <= set(known)
        assert set(candidate.bounds) >= set(candidate.sizes)
        for path, size in candidate.sizes.items():
            low, high = candidate.bounds[path]
            absent = candidate.find_value_without_effect(plain.campaign, path)
            assert low <= min(absent, size) and max(absent, size) <= high and size != absent, path
        for path, value in candidate.shape.items():
            low, high = candidate.bounds.get(path, (-np.inf, np.inf))
            assert low <= value <= high, path
        for free in (True, False):
            fit = candidate.add_to_campaign(plain.campaign, free=free).fit
            held, varied = (fit.start, fit.fixed) if free else (fit.fixed, fit.start)
            expected = {*candidate.sizes, *candidate.shape} - {candidate.jump}
            assert expected <= set(held) and not set(candidate.sizes) & set(varied)
            # Gradient descent cannot move a jump, so the depth of the jump is fixed.
            assert candidate.jump in {"", *fit.fixed}
        assert all(candidate.make_symbols_by_path(plain.campaign).values())


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name not in REFUSED])
def test_effect_changes_the_force_and_is_absent_at_its_absent_value(plain, name):
    candidate = candidates(plain.situation, name)[0]
    test = candidate.tests[0] if candidate.tests else "needle"
    model = model_of(test, points=13)
    force = ts.simulate(model).force
    with_it = ts.simulate(candidate.effect.apply(model, {**candidate.sizes, **candidate.shape})).force
    changed = np.abs(with_it - force).max() / force.max()
    # The trial value of gravity is its full value, so its change is larger.
    assert 5e-4 < changed < (0.3 if name == "self_weight" else 0.12), changed
    absent = {path: candidate.find_value_without_effect(plain.campaign, path) for path in candidate.sizes}
    if name == "viscoelasticity":
        # A Prony term with g = 0 is refused.
        absent = dict.fromkeys(absent, 1e-12)
    without = ts.simulate(candidate.effect.apply(model, {**absent, **candidate.shape})).force
    # A layer changes the mesh; its score compares forces on one mesh.
    np.testing.assert_allclose(without, force, atol=(3e-3 if name == "layer" else 1e-9) * force.max())
    assert candidate.has_mesh_changing_shape_parameter(plain.campaign) == (name == "layer")


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name not in REFUSED])
def test_change_of_residuals_is_confined_to_acting_tests(plain, name):
    """The whitened change is large in the acting tests and zero to rounding in the others."""
    candidate = candidates(plain.situation, name)[-1]
    column = plain.change(candidate)
    assert column.shape == (plain.evaluation.residual.size, 1) and np.linalg.norm(column) > 0.1
    for rows, (number, _) in zip(plain.problem.rows, plain.problem.places, strict=True):
        if candidate.tests is not None and plain.problem.tests[number].name not in candidate.tests:
            assert np.abs(column[rows]).max() < 1e-7 * np.abs(column).max()


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    """Ramps between lubricated plates on two specimens, recorded without time."""
    folder = tmp_path_factory.mktemp("plates")
    path = measured_campaign(folder, tests={"plates": TESTS["plates"]}, specimens=("one", "two"))
    for file in folder.glob("*.csv"):
        recording = ts.read_recording(file)
        loading = recording.time <= 16.0
        ts.write_recording(ts.Recording({name: recording.channels[name][loading]
                                         for name in ("displacement", "force")}), file)
    return situation_of(path)


class TestRefusals:
    """Reasons why tests cannot show an effect."""

    @pytest.mark.parametrize(("name", "words"), [
        ("viscoelasticity", "no time"), ("poroelasticity", "no time"), ("sensor_drift", "no time"),
        ("latency", "no time"), ("rate_damping", "no time"), ("inertia", "no time"), ("softening", "has an unloading"),
        ("backlash", "has an unloading"), ("adhesion", "no tool returns past"), ("layer", "no test has a needle"),
        ("puncture", "no test has a needle"), ("edge_rounding", "no test has a tool with an edge"),
        ("partial_slip", "no test has bonded faces")])
    def test_ramps_between_plates(self, plates, name, words):
        with pytest.raises(NotTestableError, match=words):
            candidates(plates, name)

    def test_population_has_one_factor_per_specimen_except_the_first(self, plates):
        candidate, = candidates(plates, "population")
        named = candidate.add_to_campaign(plates.campaign, free=True).fit.named["effects.stiffness_scale.ratio"]
        assert named.scope == "per_specimen" and named.tests == candidate.tests == ("plates_two",)

    @pytest.mark.parametrize(("law", "name", "words"), [
        ("ogden_1", "i2_term", "polynomial term"), ("ogden_2", "strain_stiffening", "polynomial term"),
        ("mooney_rivlin", "i2_term", "already"), ("reduced_polynomial_3", "strain_stiffening", "third power")])
    def test_laws_that_cannot_be_extended(self, plain, law, name, words):
        with pytest.raises(NotTestableError, match=words):
            candidates(replace(plain.situation, law=law), name)

    @pytest.mark.parametrize(("law", "path"), [("neo_hooke", "C20"), ("mooney_rivlin", "C20"),
                                               ("reduced_polynomial_2", "C30")])
    def test_strain_stiffening_adds_the_lowest_missing_power(self, plain, law, path):
        candidate, = candidates(replace(plain.situation, law=law), "strain_stiffening")
        assert set(candidate.sizes) == {path}

    def test_softening_has_the_form_of_the_campaign(self, plain):
        for form in ("tanh", "erf"):
            fit = replace(plain.campaign.fit, softening_form=form)
            situation = replace(plain.situation, campaign=replace(plain.campaign, fit=fit))
            candidate = candidates(situation, "softening")[0]
            model = candidate.effect.apply(model_of("needle", points=3), {**candidate.sizes, **candidate.shape})
            assert model.material.softening.form == form
            space = ParameterSpace.from_campaign("neo_hooke", candidate.add_to_campaign(situation.campaign, free=True))
            values = {"C10": 1500.0, **candidate.sizes, **candidate.shape}
            assert space.build_material(values).softening.form == form

    def test_parameter_that_the_campaign_fits_is_refused(self, tmp_path):
        path = measured_campaign(tmp_path, tests={"plates": TESTS["plates"]})
        text = path.read_text(encoding="utf-8").replace("C20 = 700.0", 'C20 = 700.0, "rig.compliance" = 1e-6')
        path.write_text(text, encoding="utf-8")
        with pytest.raises(NotTestableError, match="fits or fixes this parameter already"):
            candidates(situation_of(path), "machine_compliance")


class TestWiderLaw:
    def test_missing_parameters_are_fixed_at_zero(self, plain):
        candidate, = candidates(plain.situation, "strain_stiffening")
        fit = candidate.add_to_campaign(plain.campaign, free=True).fit
        assert fit.laws == ("biderman",) and fit.fixed["C01"] == 0.0 and "C01" not in fit.start
        assert fit.start["C30"] == candidate.sizes["C30"] and "C10" not in fit.fixed


def test_deviation_counts_from_the_stated_rig_value(tmp_path):
    """A stated compliance is the value without the effect."""
    path = measured_campaign(tmp_path, tests={"plates": TESTS["plates"]})
    ts.write_rig(ts.Rig(compliance=1e-4), tmp_path / "soft.rig.json")
    text = path.read_text(encoding="utf-8").replace("[fit]", 'rig = "soft.rig.json"\n[fit]')
    path.write_text(text, encoding="utf-8")
    candidate, = candidates(situation_of(path), "machine_compliance")
    assert candidate.absent == {"rig.compliance": 1e-4} and candidate.sizes["rig.compliance"] > 1e-4
    assert candidate.bounds["rig.compliance"][0] == 1e-4


def test_campaign_states_slip(tmp_path):
    """A stated slip is the value without the effect; a fraction above 1 is refused with its field."""
    path = measured_campaign(tmp_path, tests={"glued": TESTS["glued"]})
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("[fit]", "slip = 0.1\n[fit]"), encoding="utf-8")
    candidate, = candidates(situation_of(path), "partial_slip")
    assert candidate.absent == {"experiment.slip": 0.1} and candidate.sizes["experiment.slip"] > 0.1
    path.write_text(text.replace("[fit]", "slip = 1.1\n[fit]"), encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"a fraction from 0 to 1; got 1\.1") as caught:
        situation_of(path)
    assert caught.value.field == "test[0].slip"


def test_campaign_states_the_form_of_softening(tmp_path):
    path = measured_campaign(tmp_path, tests={"glued": TESTS["glued"]})
    assert situation_of(path).campaign.fit.softening_form == "tanh"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("[fit]", '[fit]\nsoftening_form = "erf"'), encoding="utf-8")
    assert situation_of(path).campaign.fit.softening_form == "erf"
    path.write_text(text.replace("[fit]", '[fit]\nsoftening_form = "exp"'), encoding="utf-8")
    with pytest.raises(ts.InputError) as caught:
        situation_of(path)
    assert caught.value.field == "fit.softening_form"


def test_bulk_modulus_scales_by_its_inverse(plain):
    """Half the change of K = 100 mu is that of K = 200 mu; negative factors keep a positive modulus."""
    (candidate,) = candidates(plain.situation, "compressibility")
    (path, tried), = candidate.sizes.items()
    absent = {path: candidate.find_value_without_effect(plain.campaign, path)}
    assert candidate.inverse and candidate.scale_trial_values(absent, 1.0)[path] == pytest.approx(tried)
    assert candidate.scale_trial_values(absent, 0.0) == pytest.approx(absent)
    half = 2.0 / (1.0 / tried + 1.0 / absent[path])
    assert candidate.scale_trial_values(absent, 0.5)[path] == pytest.approx(half)
    assert tried > candidate.scale_trial_values(absent, 3.0)[path] > 0
    assert absent[path] < candidate.scale_trial_values(absent, -5.0)[path] < 10 * absent[path]
