"""The column under its own weight: published figures, a slow solution of the same equations, exact derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq

import tissue_sim as ts
from tissue_sim.closed_form.column import Column, ColumnSettings

STUDY = ts.Specimen(0.04, 0.07, density=1040.0, gravity=9.81)
POLYNOMIAL = ts.find_law("reduced_polynomial_2")
PHANTOM = {"C10": 1404.9, "C20": 699.4}
#: Laws and parameters, from hardly sagging to a column that loses 40 % of its height.
SOLIDS = [("reduced_polynomial_2", [1404.9, 699.4]), ("neo_hooke", [60.0]), ("mooney_rivlin", [624.3, 746.1]),
          ("reduced_polynomial_3", [882.0, 57.0, 36.0]), ("ogden_1", [3225.9, 14.8]), ("ogden_1", [1000.0, -20.0]),
          ("ogden_2", [800.0, 2.0, 900.0, -5.0])]


def slow_height(law, values, pressure, moulded, weight):
    """Height of the column under a pressure by adaptive quadrature, each slice solved by bracketing."""
    def stretch(s):
        return brentq(lambda x: law.nominal_stress(x, values) + pressure + weight * s, 1e-3, 1.0, xtol=1e-15)

    return quad(stretch, 0.0, moulded, epsrel=1e-11)[0]


def test_the_study():
    column = Column(STUDY)
    settled = column.settle(POLYNOMIAL, PHANTOM)
    assert settled.sag == pytest.approx(2.780e-3, abs=5e-7)
    assert (settled.moulded_height, settled.height) == (0.07, pytest.approx(0.07 - settled.sag))
    displacement = np.array([2e-3, 5e-3, 10e-3])
    force = -STUDY.area * column.nominal_stress(POLYNOMIAL, displacement, PHANTOM)
    assert force == pytest.approx([1.3979, 3.7793, 8.9293], abs=5.1e-5)
    without = -STUDY.area * Column(replace(STUDY, gravity=0.0)).nominal_stress(POLYNOMIAL, displacement, PHANTOM)
    assert without == pytest.approx([1.2496, 3.3176, 7.5999], abs=5.1e-5)


@pytest.mark.parametrize(("law", "values"), SOLIDS)
def test_a_slow_solution_agrees(law, values):
    law, column = ts.find_law(law), Column(STUDY)
    settled = column.settle(law, values)
    weight = STUDY.specific_weight
    assert settled.height == pytest.approx(slow_height(law, values, 0.0, 0.07, weight), rel=1e-9)
    displacement = np.array([0.0, 1e-4, 0.003, 0.012, 0.02])
    pressure = -column.nominal_stress(law, displacement, values)
    heights = [slow_height(law, values, p, 0.07, weight) for p in pressure]
    assert settled.height - np.array(heights) == pytest.approx(displacement, rel=2e-5, abs=1e-12)
    base = column.base_stretch_at_displacement(law, displacement, values)
    assert -law.nominal_stress(base, values) == pytest.approx(pressure + weight * 0.07, rel=1e-6)


@pytest.mark.parametrize(("law", "values"), SOLIDS)
def test_without_weight_it_is_the_law(law, values):
    law, column = ts.find_law(law), Column(replace(STUDY, gravity=0.0))
    displacement = np.linspace(0.0, 0.02, 37).reshape(37, 1)
    stretch = 1 - displacement / 0.07
    assert column.settle(law, values).sag == pytest.approx(0.0, abs=1e-15)
    expected = law.nominal_stress(stretch, values)
    np.testing.assert_allclose(column.nominal_stress(law, displacement, values), expected, rtol=1e-5, atol=1e-9)
    slope = -law.nominal_stress_slope(stretch, values) / 0.07
    np.testing.assert_allclose(column.stress_displacement_slope(law, displacement, values), slope, rtol=2e-5)
    np.testing.assert_allclose(column.nominal_stress_parameter_derivatives(law, displacement, values),
                               law.nominal_stress_parameter_derivatives(stretch, values), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("height_is", ["moulded", "placed"])
@pytest.mark.parametrize(("law", "values"), SOLIDS)
def test_derivatives_against_central_differences(law, values, height_is):
    law, column, values = ts.find_law(law), Column(replace(STUDY, height_is=height_is)), np.array(values)
    # The range is fixed, so that both sides of a difference stand on equal states.
    displacement = np.linspace(0.0, 0.012, 13)
    derivatives = column.nominal_stress_parameter_derivatives(law, displacement, values)
    for i, value in enumerate(values):
        step = np.zeros(values.size)
        step[i] = 1e-4 * abs(value)
        # Fourth order, so that the difference is as exact as what it checks.
        near, far = (column.nominal_stress(law, displacement, values + k * step)
                     - column.nominal_stress(law, displacement, values - k * step) for k in (1, 2))
        numeric = (8 * near - far) / (12 * step[i])
        assert np.abs(derivatives[:, i] - numeric).max() < 1e-6 * np.abs(numeric).max()
    inside = displacement[1:-1]
    reach = 1e-6
    numeric = (column.nominal_stress(law, np.append(inside + reach, 0.012), values)
               - column.nominal_stress(law, np.append(inside - reach, 0.012), values))[:-1] / (2 * reach)
    np.testing.assert_allclose(column.stress_displacement_slope(law, np.append(inside, 0.012), values)[:-1], numeric,
                               rtol=1e-6)


@settings(max_examples=25, deadline=None)
@given(modulus=st.floats(60.0, 1e5), height=st.floats(0.01, 0.1), density=st.floats(50.0, 3000.0))
def test_placed_and_moulded_are_one_column(modulus, height, density):
    """A column measured after it settled is the one whose moulded height settles to that, at every depth."""
    law = ts.find_law("neo_hooke")
    moulded = ts.Specimen(0.02, height, density=density, gravity=9.81)
    settled = Column(moulded).settle(law, [modulus])
    assert 0 < settled.sag < height
    placed = replace(moulded, height=settled.height, height_is="placed")
    again = Column(placed).settle(law, [modulus])
    assert again.moulded_height == pytest.approx(height, rel=1e-10)
    displacement = np.linspace(0.0, 0.5, 9) * settled.height
    np.testing.assert_allclose(Column(placed).nominal_stress(law, displacement, [modulus]),
                               Column(moulded).nominal_stress(law, displacement, [modulus]), rtol=1e-7, atol=1e-9)


def test_a_small_sag_is_that_of_linear_elasticity():
    """w H^2 / (2 E) for a stiff column (Timoshenko and Goodier, Theory of Elasticity, section 96)."""
    law = ts.find_law("neo_hooke")
    sag = Column(STUDY).settle(law, [1e6]).sag
    assert sag == pytest.approx(1040 * 9.81 * 0.07**2 / (2 * 6e6), rel=1e-3)


def test_before_contact_the_plate_feels_nothing():
    column = Column(STUDY)
    before = np.array([-3e-3, -1e-9])
    for answer in (column.nominal_stress, column.stress_displacement_slope,
                   column.nominal_stress_parameter_derivatives):
        assert not answer(POLYNOMIAL, before, PHANTOM).any()
    assert column.base_stretch_at_displacement(POLYNOMIAL, before, PHANTOM) == pytest.approx(
        column.settle(POLYNOMIAL, PHANTOM).base_stretch)


def test_beyond_what_the_law_carries_there_is_no_number():
    softening = {"C10": 1600.0, "C20": -500.0}
    column = Column(STUDY)
    displacement = np.linspace(0.0, 0.04, 200)
    stress = column.nominal_stress(POLYNOMIAL, displacement, softening)
    lost = int(np.argmax(np.isnan(stress)))
    assert 0 < lost < 200 and np.isnan(stress[lost:]).all()
    assert np.isnan(column.nominal_stress_parameter_derivatives(POLYNOMIAL, displacement[lost:], softening)).all()
    # The base has come to the largest pressure of the law.
    stretch = np.linspace(0.3, 1.0, 100_000)
    largest = -POLYNOMIAL.nominal_stress(stretch, softening).min()
    base = STUDY.specific_weight * 0.07
    assert -stress[lost - 1] + base == pytest.approx(largest, rel=0.02)


@pytest.mark.parametrize("values", [[-10.0], [1e-3], [1e-300], [1e12]])
def test_wild_parameters_end_in_nan_or_in_a_stiff_column(values):
    law, column = ts.find_law("neo_hooke"), Column(STUDY)
    stress = column.nominal_stress(law, np.array([0.0, 0.01]), values)
    if values[0] < 1e3:
        assert np.isnan(stress).all()
        with pytest.raises(ts.InputError, match=r"does not carry the specimen's weight, 714\.2 Pa") as error:
            column.settle(law, values)
        assert error.value.field == "specimen.density"
    else:
        assert np.isfinite(stress).all()


def test_the_whole_height_cannot_be_pressed_out():
    stress = Column(STUDY).nominal_stress(POLYNOMIAL, np.array([0.01, 0.068, 0.07]), PHANTOM)
    assert np.isnan(stress[1:]).all()
    assert ColumnSettings().smallest_stretch \
        < Column(STUDY).base_stretch_at_displacement(POLYNOMIAL, np.array(0.05), PHANTOM) < 0.3
