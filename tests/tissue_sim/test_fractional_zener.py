"""Fractional Zener model: Mittag-Leffler function, Prony series in a window, stress, file, parameters, simulation."""

import dataclasses

import msgspec
import numpy as np
import pytest
from scipy.special import erfcx, rgamma

import tissue_sim as ts
from tissue_sim.exports import ExportContent
from tissue_sim.exports.abaqus import ABAQUS
from tissue_sim.exports.febio import FEBIO
from tissue_sim.material.file import make_material_file_from_json_data
from tissue_sim.material.fractional_zener import (
    MAX_EXPANSION_ERROR,
    FractionalRelaxation,
    FractionalZener,
    evaluate_mittag_leffler,
)
from tissue_sim.material.material import make_material_from_numbers, with_changed_or_added_parameters
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.parameters import parameter_values, with_values

#: Time window, s.
WINDOW = (1e-2, 1e2)
MODEL = FractionalZener(alpha=0.4, g=0.6, tau=0.7, shortest=WINDOW[0], longest=WINDOW[1])
GEL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e6), viscoelastic=FractionalRelaxation(MODEL))
PATH = "viscoelastic.fractional_zener"


def test_function_of_special_orders():
    """E_1(-x) = exp(-x), E_1/2(-x) = exp(x^2) erfc(x)."""
    x = np.append(0.0, np.geomspace(1e-8, 1e8, 161))
    np.testing.assert_allclose(evaluate_mittag_leffler(0.5, x), erfcx(x), rtol=1e-14)
    np.testing.assert_allclose(evaluate_mittag_leffler(1.0, x), np.exp(-x), rtol=1e-15)
    near_one = np.linspace(0.0, 5.0, 51)
    np.testing.assert_allclose(evaluate_mittag_leffler(1.0 - 1e-12, near_one), np.exp(-near_one), rtol=1e-9)


@pytest.mark.parametrize("alpha", [0.05, 0.2, 0.45, 0.8, 0.95, 0.999])
def test_function_against_its_series(alpha):
    """Power series at small arguments, asymptotic series -sum (-x)^-k / Gamma(1 - alpha k) at large ones."""
    k = np.arange(60)
    small = np.array([0.0, 1e-6, 0.01, 0.1, 0.3])
    series = ((-small[:, None])**k * rgamma(alpha * k + 1.0)).sum(axis=1)
    np.testing.assert_allclose(evaluate_mittag_leffler(alpha, small), series, rtol=1e-14)
    k, large = np.arange(1, 9), np.array([1e4, 1e6, 1e8])
    series = -((-large[:, None])**-k * rgamma(1.0 - alpha * k)).sum(axis=1)
    np.testing.assert_allclose(evaluate_mittag_leffler(alpha, large), series, rtol=1e-14)


@pytest.mark.parametrize(("alpha", "x", "words"), [
    (0.0, 1.0, "alpha: must be above 0 and at most 1; got 0"), (1.1, 1.0, "got 1.1"), (0.5, -1.0, "x: must be finite")])
def test_refused_arguments(alpha, x, words):
    with pytest.raises(ts.InputError, match=words):
        evaluate_mittag_leffler(alpha, x)


@pytest.mark.parametrize("alpha", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("g", [0.3, 0.9, 0.99])
def test_series_over_four_decades(alpha, g):
    """Largest error at times between those of the fit, for relaxation times within and far outside the window."""
    t = np.geomspace(*WINDOW, 1237)
    for tau in np.geomspace(1e-4, 1e4, 9):
        model = FractionalZener(alpha=alpha, g=g, tau=tau, shortest=WINDOW[0], longest=WINDOW[1])
        exact = 1.0 - g + g * evaluate_mittag_leffler(alpha, (t / tau)**alpha)
        series = FractionalRelaxation(model).compute_relative_relaxation_modulus(t)
        error = np.abs(series / exact - 1.0).max()
        assert error <= MAX_EXPANSION_ERROR
        assert model.expansion_error == pytest.approx(error, rel=0.02, abs=1e-9)
        np.testing.assert_allclose(model.compute_relative_relaxation_modulus(t), exact, rtol=1e-14)
    assert len(model.terms) == 12 and sum(term.g for term in model.terms) == pytest.approx(g, rel=1e-14)


@pytest.mark.parametrize(("changes", "field", "words"), [
    ({"alpha": 1.0}, "term_count", "the relative error of the series must be at most 1% from 0.01 to 100 s"),
    ({"alpha": 0.0}, "alpha", "must be 0.01 to 1; got 0"), ({"g": 1.0}, "g", "between 0 and 1; got 1"),
    ({"tau": -1.0}, "tau", "must be a positive relaxation time; got -1 s"),
    ({"shortest": 0.0}, "shortest", "must be positive and finite"),
    ({"longest": 0.01}, "longest", "must be longer than the begin of the window"),
    ({"term_count": 13}, "term_count", "must be an integer from 4 to 12; got 13"),
    ({"term_count": 5}, "term_count", "5 terms have")])
def test_refused_models(changes, field, words):
    with pytest.raises(ts.InputError, match=words) as caught:
        dataclasses.replace(MODEL, **changes)
    assert caught.value.field == field


def test_stress_history_is_the_convolution():
    """S(t) = integral of G(t - s) dS/ds ds with the exact G, by midpoint quadrature; uniaxial, incompressible.

    With W = C10 (I1 - 3), S = 2 C10 (1 - I1 / (3 l^2)) along the axis and 2 C10 (1 - I1 l / 3) across, and
    P = l S_axial - l^-2 S_lateral.
    """
    corners, levels = np.array([0.0, 0.5, 3.0, 5.0, 20.0]), np.array([1.0, 1.3, 1.3, 1.1, 1.1])
    ends = np.array([0.5, 1.0, 3.0, 4.0, 6.0, 20.0])
    found = ts.nominal_stress_history(GEL, fine := np.linspace(0.0, 20.0, 4001), np.interp(fine, corners, levels))

    def elastic(time):
        stretch = np.interp(time, corners, levels)
        I1 = stretch**2 + 2.0 / stretch
        return 3000.0 * np.stack([1.0 - I1 / (3.0 * stretch**2), 1.0 - I1 * stretch / 3.0])

    for end in ends:
        # Points close to the end, where G is steep.
        past = np.unique(np.concatenate([end - np.append(0.0, np.geomspace(1e-9, end, 6000)), corners[corners < end]]))
        middle = end - 0.5 * (past[1:] + past[:-1])
        G = 1.0 - MODEL.g + MODEL.g * evaluate_mittag_leffler(MODEL.alpha, (middle / MODEL.tau)**MODEL.alpha)
        axial, lateral = (np.diff(elastic(past)) * G).sum(axis=1)
        stretch = np.interp(end, corners, levels)
        expected = stretch * axial - stretch**-2 * lateral
        assert found[np.searchsorted(fine, end - 1e-9)] == pytest.approx(expected, rel=MODEL.expansion_error + 1e-4)


def test_file_keeps_the_model(tmp_path):
    path = tmp_path / "m.material.json"
    errors = {f"{PATH}.alpha": 0.01, f"{PATH}.tau": 0.1}
    few = dataclasses.replace(GEL, viscoelastic=FractionalRelaxation(dataclasses.replace(MODEL, term_count=8),
                                                                     "long_term"))
    for material in (GEL, few):
        ts.write_material_file(ts.MaterialFile.of(material, standard_errors=errors), path)
        assert ts.load_material(path) == material and ts.read_material_file(path).standard_errors == errors
    entry = msgspec.to_builtins(ts.MaterialFile.of(few))["viscoelastic"]
    assert entry["fractional_zener"] == {"alpha": 0.4, "g": 0.6, "tau_s": 0.7, "from_s": 0.01, "to_s": 100.0,
                                         "term_count": 8}
    assert "terms" not in entry
    region = dataclasses.replace(GEL, viscoelastic=None, regions={"lump": few})
    ts.write_material_file(ts.MaterialFile.of(region), path)
    assert ts.load_material(path) == region


@pytest.mark.parametrize(("entry", "field", "words"), [
    ({}, "viscoelastic", "must have either terms or fractional_zener"),
    ({"terms": [{"g": 0.1, "tau_s": 1.0}], "fractional_zener": {}}, "viscoelastic.fractional_zener.alpha", "missing"),
    ({"fractional_zener": {"alpha": 0.95, "g": 0.99, "tau_s": 1.0, "from_s": 1e-2, "to_s": 1e2}},
     "viscoelastic.fractional_zener.term_count", "must be at most 1%"),
    ({"fractional_zener": {"alpha": 0.5, "g": 0.5, "tau_s": 1.0, "from_s": 1.0, "to_s": 0.1}},
     "viscoelastic.fractional_zener.to_s", "must be longer than the begin")])
def test_refused_entries(entry, field, words):
    data = msgspec.to_builtins(ts.MaterialFile.of(GEL))
    with pytest.raises(ts.InputError, match=words) as caught:
        make_material_file_from_json_data({**data, "viscoelastic": entry})
    assert caught.value.field == field


def test_parameters_by_path():
    numbers = {f"{PATH}.{name}": getattr(MODEL, name) for name in ("alpha", "g", "tau", "shortest", "longest")}
    assert {path: value for path, value in parameter_values(GEL).items() if path.startswith(PATH)} == numbers
    made = make_material_from_numbers("neo_hooke", {"C10": 1500.0}, numbers, GEL.bulk)
    assert made == GEL
    assert with_changed_or_added_parameters(dataclasses.replace(GEL, viscoelastic=None), numbers) == GEL
    changed = with_values(GEL, {f"{PATH}.alpha": 0.5}).viscoelastic
    assert changed.fractional_zener.alpha == 0.5 and changed.terms != GEL.viscoelastic.terms
    term = {"viscoelastic.terms[0].g": 0.1, "viscoelastic.terms[0].tau": 1.0}
    with pytest.raises(ts.InputError, match="must not have both Prony terms and a fractional Zener model"):
        make_material_from_numbers("neo_hooke", {"C10": 1500.0}, {**numbers, **term})
    drained = dataclasses.replace(GEL, poroelasticity=ts.Poroelasticity(0.1, 1e-8))
    assert len(drained.make_prony_series(0.01).terms) == 13


def test_export_writes_the_series():
    text = ABAQUS.write(ExportContent((GEL,)))
    assert "*VISCOELASTIC, TIME=PRONY" in text and "represents the fractional Zener model" in text.replace("\n** ", " ")
    again = ABAQUS.read(text, ExportContent((GEL,)).units)[0].material
    assert again.viscoelastic.relaxing_fraction == pytest.approx(0.6)
    with pytest.raises(ts.InputError, match="at most 6 relaxing terms; the material has 12"):
        FEBIO.write(ExportContent((GEL,)))


#: Motion within the window of the model.
PROTOCOL = ts.Protocol.parse("ramp 6mm @3mm/s; hold 10s; unload 3mm", points=161)
RADIUS = 0.04
HEIGHT = 0.05


def model(material, friction="frictionless", tool=None):
    return ts.Model(ts.Experiment(ts.Specimen(RADIUS, HEIGHT), PROTOCOL, friction=friction, friction_base=friction,
                                  tool=tool or ts.Tool()), material)


def test_simulation_gives_the_closed_form():
    found = ts.simulate(model(GEL)).force
    expected = -np.pi * RADIUS**2 * ts.nominal_stress_history(GEL, PROTOCOL.time, 1.0 - PROTOCOL.displacement / HEIGHT)
    assert expected.max() > 1.2 * expected[PROTOCOL.time.searchsorted(12.0) - 1] > 0.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * expected.max())


@pytest.mark.slow
def test_solid_elements_give_the_closed_form():
    """The ratio of the forces is that of the areas of faceted and round cylinder, equal at all times."""
    mesh = create_cylinder_mesh_under_needle(RADIUS, HEIGHT, 0.024, HEX8P0, smallest=9e-3, growth=2.2, largest=20e-3,
                                             around=2)
    protocol = ts.Protocol.parse("ramp 6mm @3mm/s; hold 10s; unload 3mm", points=41)
    of = dataclasses.replace(model(GEL).experiment, protocol=protocol)
    found = ts.simulate(ts.Model(of, GEL), solver="solid", mesh=mesh).force
    expected = ts.nominal_stress_history(GEL, protocol.time, 1.0 - protocol.displacement / HEIGHT)
    ratio = found[1:] / expected[1:]
    np.testing.assert_allclose(ratio, ratio[-1], rtol=2e-4)


def test_sensitivities():
    """Exact derivatives with the parameters of the model against central differences of simulations."""
    of = model(dataclasses.replace(GEL, bulk=ts.Bulk("bulk_ratio", 1e4)), "bonded")
    names = [f"{PATH}.{name}" for name in ("alpha", "g", "tau")]
    answer = ts.sensitivities(of, names)
    assert answer.exact.all()
    for k, name in enumerate(names):
        value = parameter_values(of.material)[name]
        more, less = (ts.simulate(ts.Model(of.experiment, with_values(of.material, {name: factor * value}))).force
                      for factor in (1.0001, 0.9999))
        slope = (more - less) / (2e-4 * value)
        np.testing.assert_allclose(answer.values[:, k], slope, rtol=0, atol=1e-4 * abs(slope).max(), err_msg=name)
