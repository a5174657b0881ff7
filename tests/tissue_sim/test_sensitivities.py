"""Exact derivatives of the force against central differences of whole simulations.

Contact conditions are solved much closer here than a user's simulation needs: a remaining violation would
show in the differences. Differences and exact values are compared while all three runs have had the same points in
contact and slipping.
"""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim import differentiation
from tissue_sim.differentiation import FiniteDifferenceSettings
from tissue_sim.fem.axisymmetric import sensitivity
from tissue_sim.fem.contact import pairs
from tissue_sim.fem.contact.pairs import RelativeContactTolerances
from tissue_sim.parameters import get_parameters_at_paths, parameter_values, with_values

STUDY = {"C10": 1404.9, "C20": 699.4}
PRONY = ts.Prony((ts.PronyTerm(0.3, 2.0), ts.PronyTerm(0.1, 10.0)), "long_term")
CYCLE = "ramp 6mm @0.5mm/s; hold 5s; unload 2mm; reload"


@pytest.fixture(autouse=True)
def close_contact(monkeypatch):
    monkeypatch.setattr(pairs, "TOLERANCES", RelativeContactTolerances(needle=1e-10, plate=1e-12))


def elastic(**options):
    return ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4), **options)


def experiment(text="ramp 5mm", points=6, **options):
    return ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.parse(text, points), **options)


class Status:
    """Notes which points press and which way they slip at every sample."""

    def before_first_step(self, solver):
        self.seen = []

    def after_sample(self, solver, factor):
        surface = solver.equations.surface
        # A point that just touches has a force of rounding, or none.
        presses = abs(surface.forces).max(axis=-1) > 1e-9 * abs(surface.forces).max(initial=0.0)
        self.seen.append((presses.tobytes(), surface.slip_signs.tobytes()))


def difference(model, name, width=1e-4):
    """Central difference of the force, and for how many samples three runs shared their contact."""
    value = parameter_values(model.material)[name]
    runs = []
    for way in (1, -1, 0):
        changed = with_values(model.material, {name: value * (1 + way * width)})
        status = Status()
        force = ts.simulate(ts.Model(model.experiment, changed), watch=status).force
        runs.append((force, status.seen))
    (more, seen1), (less, seen2), (_, seen3) = runs
    shared = np.cumprod([a == b == c for a, b, c in zip(seen1, seen2, seen3, strict=True)]).sum()
    return (more - less) / (2 * width * value), int(shared)


def assert_exact(model, names=None, rel=1e-5):
    answer = ts.sensitivities(model, names)
    assert answer.exact.all()
    np.testing.assert_allclose(answer.recording.force, ts.simulate(model).force, rtol=1e-12, atol=1e-15)
    compared = 0
    for k, name in enumerate(answer.names):
        slope, shared = difference(model, name)
        size = abs(slope).max()
        assert size > 0, name
        # What rounding leaves of a difference: 1e-9 of the force over the width.
        noise = 1e-9 * abs(answer.recording.force).max() / (1e-4 * abs(parameter_values(model.material)[name]))
        assert abs(answer.values[:shared, k] - slope[:shared]).max() < rel * size + noise, name
        compared += shared
    return answer, compared / (len(answer.names) * len(answer.recording))


@pytest.mark.slow
@pytest.mark.parametrize("options", [
    {}, {"friction": "frictionless", "friction_base": "frictionless"}, {"tool": ts.Tool("flat", 8e-3)},
    {"friction": 0.1, "friction_base": 0.1}, {"friction": 0.4, "friction_base": 0.2},
    {"friction": "stick", "friction_base": "stick"}],
    ids=["bonded", "lubricated", "needle", "slip", "slip and stick", "stick"])
def test_elastic(options):
    _, compared = assert_exact(ts.Model(experiment(**options), elastic()))
    assert compared > 0.9


@pytest.mark.parametrize("options", [{}, {"tool": ts.Tool("flat", 8e-3)}, {"friction": 0.4, "friction_base": 0.2}],
                         ids=["bonded", "needle", "slip and stick"])
def test_last_factor_or_exact_tangent(options, monkeypatch):
    """Few parameters are solved for with the step's last factor, many with that of the exact tangent."""
    model, answers, refined = ts.Model(experiment(**options), elastic()), [], []

    def solves(self):
        refined.append(done(self))
        return refined[-1]

    done = sensitivity.MaterialSensitivity._refine_iteratively
    monkeypatch.setattr(sensitivity.MaterialSensitivity, "_refine_iteratively", solves)
    for few in (4, 0):
        monkeypatch.setattr(sensitivity, "SETTINGS",
                            sensitivity.SensitivityReuseSettings(max_refined=few, max_refined_slip=few))
        answers.append(ts.sensitivities(model, ["C10", "C20"]).values)
    assert any(refined)
    np.testing.assert_allclose(*answers, rtol=0, atol=1e-8 * abs(answers[1]).max(axis=0).min())


@pytest.mark.slow
def test_everything_in_time():
    material = ts.Material("ogden_1", {"mu1": 3225.9, "alpha1": 14.8}, ts.Bulk("K_Pa", 3e6), viscoelastic=PRONY,
                           softening=ts.Softening(0.3, 50.0, 0.5), layers=(ts.Layer(5e-3, 2.0),),
                           poroelasticity=ts.Poroelasticity(0.2, 1e-4))
    names = [name for name in parameter_values(material) if "thickness" not in name]
    assert len(names) == 13
    answer, compared = assert_exact(ts.Model(experiment(CYCLE), material), names)
    assert compared == 1.0 and not answer.kinks.any()


@pytest.mark.slow
@pytest.mark.parametrize(("options", "text"), [
    ({"friction": 0.2, "friction_base": 0.2}, CYCLE),
    ({"tool": ts.Tool("round", 8e-3), "friction": 0.3}, "ramp 6mm @0.5mm/s; hold 5s"),
    ({"tool": ts.Tool("flat", 8e-3), "friction": "stick"}, CYCLE)], ids=["plates", "round needle", "sticking needle"])
def test_slip_with_a_past(options, text):
    """Anchors, multipliers and the history of the tissue all depend on the parameters."""
    names = ["C10", "viscoelastic.terms[0].g", "viscoelastic.terms[1].tau"]
    answer, compared = assert_exact(ts.Model(experiment(text, **options), elastic(viscoelastic=PRONY)), names)
    assert compared > 0.5 and answer.kinks.any()


def test_a_law_that_is_linear_in_its_parameters():
    """At constant bulk ratio the force is homogeneous of degree one in C10 and C20 (Euler)."""
    answer = ts.sensitivities(ts.Model(experiment(friction=0.3, friction_base=0.3), elastic()), ["C10", "C20"])
    np.testing.assert_allclose(answer.values @ list(STUDY.values()), answer.recording.force, rtol=1e-6, atol=1e-9)


def test_bulk_modulus_held_or_its_ratio():
    """`bulk.K_Pa` held instead of the ratio: the derivatives with C10 differ by that with K."""
    ratio = elastic()
    modulus = ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("K_Pa", ratio.bulk_modulus))
    by_ratio, by_modulus = (ts.sensitivities(ts.Model(experiment(), m)) for m in (ratio, modulus))
    np.testing.assert_allclose(by_ratio.values[:, 0] - by_modulus.values[:, 0], by_modulus.values[:, 2] * 1e4 * 2,
                               rtol=1e-3, atol=1e-12)


def test_by_difference_where_it_must_be():
    model = ts.Model(experiment(friction=0.1, friction_base=0.1), elastic(), ts.Rig(force_noise=0.1, seed=1))
    answer = ts.sensitivities(model, ["rig.displacement_gain", "C10", "experiment.specimen.radius"])
    assert answer.exact.tolist() == [False, True, True]
    # Displacement of the tool (1 + gain) times as large: F(5.05 mm) - F(4.95 mm) for gains of 1 and -1 %.
    runs = [ts.simulate(ts.Model(experiment(f"ramp {depth}mm", friction=0.1, friction_base=0.1), elastic()))
            for depth in (5.05, 4.95)]
    up, down = (run.force[-1] for run in runs)
    assert answer.values[-1, 0] == pytest.approx((up - down) / 0.02, rel=1e-3)
    assert answer.values[-1, 2] == pytest.approx(2 * 3.467 / 0.040, rel=0.1)


def test_one_sided_differences_take_a_simulation_less(monkeypatch):
    counted = []
    monkeypatch.setattr("tissue_sim.differentiation.simulate",
                        lambda *given, **options: counted.append(1) or ts.simulate(*given, **options))
    model = ts.Model(experiment(friction=0.1, friction_base=0.1), elastic())
    path = "rig.displacement_gain"
    central = ts.sensitivities(model, [path])
    assert len(counted) == 3
    one_sided = ts.sensitivities(model, [path], one_sided=True)
    assert len(counted) == 5
    np.testing.assert_allclose(one_sided.values, central.values, rtol=5e-3, atol=1e-3 * np.abs(central.values).max())
    # At the end of a range only one side is there, and the other is the model itself.
    at_end = ts.Model(experiment(friction=0.0, friction_base=0.1), elastic())
    assert ts.sensitivities(at_end, ["experiment.friction"]).values[-1, 0] > 0.0
    assert len(counted) == 7


@pytest.mark.slow
@pytest.mark.parametrize(("path", "options", "material"), [
    ("experiment.specimen.radius", {}, {}), ("experiment.specimen.height", {"tool": ts.Tool("flat", radius=8e-3)}, {}),
    ("experiment.tool.radius", {"tool": ts.Tool("flat", radius=8e-3)}, {}),
    ("material.layers[0].thickness", {}, {"layers": (ts.Layer(5e-3, 2.0),)})])
@pytest.mark.parametrize("resolution", ["fast", "accurate"])
def test_differences_by_geometry_approach_the_exact_derivative(path, options, material, resolution, monkeypatch):
    """The nodes of one mesh move; a new mesh would change its number of elements."""
    model = ts.Model(experiment("ramp 3mm", 4, **options), elastic(**material))
    answer = ts.sensitivities(model, [path], resolution=resolution)
    assert answer.exact.all()
    (parameter,) = get_parameters_at_paths(model, [path])
    for width in (1e-2, 1e-3, 1e-4):
        monkeypatch.setattr(differentiation, "DIFFERENCES", FiniteDifferenceSettings(simulation_width=width))
        slope = differentiation._compute_force_derivative_by_differences(
            model, parameter, answer.recording.force,
            {"resolution": resolution, "topology": model, "estimate_error": False}, one_sided=False)
        np.testing.assert_allclose(slope[1:], answer.values[1:, 0], rtol=0.01)


def test_self_weight_and_compliance_go_by_difference():
    """They agree with the exact ones where both can be had: in the limit of no weight and a stiff rig."""
    light = ts.Experiment(ts.Specimen(0.040, 0.070, density=1e-3, gravity=9.81), ts.Protocol.ramp(5e-3, 6))
    reference = ts.sensitivities(ts.Model(experiment(), elastic()), ["C10"])
    for model in (ts.Model(light, elastic()), ts.Model(experiment(), elastic(), ts.Rig(compliance=1e-12))):
        answer = ts.sensitivities(model, ["C10"])
        assert not answer.exact.any()
        np.testing.assert_allclose(answer.values, reference.values, rtol=1e-4, atol=1e-9)


@pytest.mark.slow
def test_the_absent_value_of_a_softening():
    """At loss 0 nothing softens yet, and the derivative to one side is that of a small loss."""
    text = "ramp 5mm; unload 1mm"
    answer = ts.sensitivities(ts.Model(experiment(text), elastic(softening=ts.Softening(0.0, 50.0))),
                              ["softening.loss"])
    some, none = (ts.simulate(ts.Model(experiment(text), elastic(softening=ts.Softening(loss, 50.0)))).force
                  for loss in (1e-3, 0.0))
    np.testing.assert_allclose(answer.values[:, 0], (some - none) / 1e-3, rtol=1e-2, atol=1e-6)
    assert (answer.values[-3:, 0] < 0).all()


@pytest.mark.parametrize(("name", "words"), [
    ("C11", "did you mean 'C10'"), ("experiment.tool.colour", "unknown parameter"),
    ("softening.loss", "unknown parameter"), ("experiment.friction", "must be a number to be changed")])
def test_unknown_names(name, words):
    with pytest.raises(ts.InputError, match=words):
        ts.sensitivities(ts.Model(experiment(), elastic()), [name])


def test_every_parameter_has_a_name_and_can_be_changed():
    material = elastic(viscoelastic=PRONY, softening=ts.Softening(0.3, 50.0, 0.5), layers=(ts.Layer(5e-3, 2.0),),
                       poroelasticity=ts.Poroelasticity(0.2, 1e-4), puncture=ts.Puncture(4e-3, 0.1))
    values = parameter_values(material)
    assert {"C10", "bulk.bulk_ratio", "viscoelastic.terms[1].tau", "layers[0].thickness", "softening.share",
            "poroelasticity.diffusivity", "puncture.drop"} < set(values)
    for name, value in values.items():
        changed = parameter_values(with_values(material, {name: 1.01 * value}))
        assert changed[name] == pytest.approx(1.01 * value)
        assert {k: v for k, v in changed.items() if k != name} == {k: v for k, v in values.items() if k != name}
