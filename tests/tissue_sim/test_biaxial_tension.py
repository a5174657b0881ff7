"""Biaxial tension: its two stresses contain the tests with one stretch, with history too."""

import numpy as np
import pytest

import tissue_sim as ts

STRETCH = np.linspace(1.0, 1.6, 13)
VALUES = {"neo_hooke": {"C10": 1000.0}, "mooney_rivlin": {"C10": 1000.0, "C01": 300.0},
          "ogden_2": {"mu1": 1000.0, "alpha1": 2.5, "mu2": 200.0, "alpha2": -3.0},
          "gent": {"mu": 1500.0, "J_m": 30.0}, "fung_demiray": {"mu": 1500.0, "b": 0.8}}
BIAXIAL = ts.KINDS["biaxial_tension"]
#: The tests with one stretch -> their stretch along the second axis.
CONTAINED = {"uniaxial_tension": STRETCH**-0.5, "planar_tension": np.ones_like(STRETCH), "equibiaxial_tension": STRETCH}


@pytest.mark.parametrize("kind", CONTAINED)
@pytest.mark.parametrize("law", VALUES)
def test_stresses_contain_the_tests_with_one_stretch(law, kind):
    expected = ts.KINDS[kind].require_closed_form().stress(ts.find_law(law), STRETCH, VALUES[law])
    stress = BIAXIAL.require_closed_form().stress(ts.find_law(law), np.stack([STRETCH, CONTAINED[kind]], axis=-1),
                                                  VALUES[law])
    np.testing.assert_allclose(stress, expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(("kind", "axis"), [("uniaxial_tension", 0), ("planar_tension", 0), ("equibiaxial_tension", 0),
                                            ("equibiaxial_tension", 1)])
def test_history_contains_the_tests_with_one_stretch(kind, axis):
    material = ts.Material("mooney_rivlin", VALUES["mooney_rivlin"],
                           viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0), ts.PronyTerm(0.2, 20.0))))
    # Between the samples both stretches are linear, and the lateral stretch of uniaxial tension is not: short steps.
    time = np.linspace(0.0, 12.0, 241)
    stretch = 1.0 + 0.05 * time
    other = {"uniaxial_tension": stretch**-0.5, "planar_tension": np.ones_like(stretch)}.get(kind, stretch)
    both = np.stack([stretch, other], axis=-1)
    expected = ts.KINDS[kind].require_closed_form().stress_history(material, time, stretch, 0.01)
    found = BIAXIAL.select_load(axis).require_closed_form().stress_history(material, time, both, 0.01)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_stresses_of_the_neo_hookean_law():
    """P1 = mu (l1 - l1^-3 l2^-2) and P2 = mu (l2 - l1^-2 l2^-3)."""
    l1, l2, law = np.array([1.3, 2.0]), np.array([1.1, 0.9]), ts.find_law("neo_hooke")
    first, second = (BIAXIAL.select_load(i).require_closed_form() for i in (0, 1))
    np.testing.assert_allclose(first.stress(law, np.stack([l1, l2], axis=-1), {"C10": 500.0}),
                               1000.0 * (l1 - l1**-3 * l2**-2), rtol=1e-12)
    np.testing.assert_allclose(second.stress(law, np.stack([l2, l1], axis=-1), {"C10": 500.0}),
                               1000.0 * (l2 - l1**-2 * l2**-3), rtol=1e-12)


def test_slope_and_parameter_derivatives_are_those_of_the_stress():
    form, law, values = BIAXIAL.require_closed_form(), ts.find_law("ogden_2"), np.array([1000.0, 2.5, 200.0, -3.0])
    both = np.array([[1.2, 1.1], [1.5, 0.9]])

    def stress(change=0.0, parameters=values):
        return form.stress(law, both + np.array([change, 0.0]), parameters)

    np.testing.assert_allclose(form.slope(law, both, values), (stress(1e-6) - stress(-1e-6)) / 2e-6, rtol=1e-7)
    for i, derivative in enumerate(form.stress_parameter_derivatives(law, both, values).T):
        step = np.zeros(4)
        step[i] = 1e-5 * abs(values[i])
        numeric = (stress(parameters=values + step) - stress(parameters=values - step)) / (2 * step[i])
        np.testing.assert_allclose(derivative, numeric, rtol=1e-6, atol=1e-6)


def test_forces_belong_to_the_sides_of_the_sheet():
    """The force of an axis acts on the length along the other axis times the thickness."""
    sheet = ts.Block(length=0.040, width=0.002, height=0.020)
    for axis, (own, other) in enumerate(((0.020, 0.040), (0.040, 0.020))):
        form = BIAXIAL.select_load(axis).require_closed_form()
        strain, stress = form.convert_motion_and_load(sheet, np.array([0.004]), np.array([3.0]))
        assert (strain[0], stress[0]) == pytest.approx((0.004 / own, 3.0 / (other * 0.002)))
    with pytest.raises(ts.InputError, match="must be a block with height_mm along axis 1"):
        BIAXIAL.require_closed_form().convert_motion_and_load(ts.Specimen(0.01, 0.02), np.ones(3), np.ones(3))
