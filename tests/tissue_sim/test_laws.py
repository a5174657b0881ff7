"""Everything that follows from a law's one formula, against closed forms and finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.laws.modes import MODES

PARAMETERS = {
    "neo_hooke": [1461.6],
    "mooney_rivlin": [624.3, 746.1],
    "biderman": [800.0, 600.0, 699.4, 20.0],
    "reduced_polynomial_1": [1461.6],
    "reduced_polynomial_2": [1404.9, 699.4],
    "reduced_polynomial_3": [7702.0, -63.0, 248.0],
    "ogden_1": [2729.0, -0.57],
    "ogden_2": [2000.0, 3.0, 800.0, -2.0],
    "ogden_3": [1500.0, 1.3, 20.0, 5.0, -10.0, -2.0],
    "ogden_4": [1500.0, 1.3, 20.0, 5.0, -10.0, -2.0, 300.0, -0.7],
    "gent": [2800.0, 140.0],
    "arruda_boyce": [2800.0, 1.6],
    "fung_demiray": [2800.0, 0.6],
}
STRETCHES = np.array([0.4, 0.7, 0.86, 0.99, 1.0, 1.01, 1.3, 2.5])

every_law = pytest.mark.parametrize("name", sorted(PARAMETERS))


def test_every_law_of_the_table_is_tested():
    """The laws of compressible solids are tested in test_hyperfoam.py."""
    assert set(PARAMETERS) == {name for name, law in ts.LAWS.items() if not law.is_compressible}


@pytest.mark.parametrize(("name", "formula"), [
    # Equations 4 to 7 of the study, written out by hand.
    ("neo_hooke", lambda s, C10: 2 * C10 * (s - s**-2)),
    ("mooney_rivlin", lambda s, C10, C01: 2 * (1 - s**-3) * (C10 * s + C01)),
    ("reduced_polynomial_2", lambda s, C10, C20: 2 * (s - s**-2) * (C10 + 2 * C20 * (s**2 + 2 / s - 3))),
    ("ogden_1", lambda s, mu, a: 2 * mu / a * (s**(a - 1) - s**(-a / 2 - 1))),
])
def test_uniaxial_stress_is_the_published_equation(name, formula):
    law = ts.find_law(name)
    np.testing.assert_allclose(law.nominal_stress(STRETCHES, PARAMETERS[name]), formula(STRETCHES, *PARAMETERS[name]),
                               rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("name", ["neo_hooke", "mooney_rivlin", "reduced_polynomial_2", "reduced_polynomial_3"])
def test_biderman_contains_the_simpler_laws(name):
    law, wider, stretches = ts.find_law(name), ts.find_law("biderman"), np.array([0.4, 0.9, 1.5])
    values = {parameter: 100.0 * (1 + place) for place, parameter in enumerate(law.parameters)}
    for mode in MODES:
        np.testing.assert_allclose(
            wider.nominal_stress(stretches, dict.fromkeys(wider.parameters, 0.0) | values, mode),
            law.nominal_stress(stretches, values, mode), rtol=1e-13)


@every_law
@pytest.mark.parametrize("mode", [*MODES, "simple_shear"])
def test_derivatives_are_those_of_the_stress(name, mode):
    law, values = ts.find_law(name), np.array(PARAMETERS[name])
    h = 1e-6
    ahead, behind = (law.nominal_stress(STRETCHES + step, values, mode) for step in (h, -h))
    slope = (ahead - behind) / (2 * h)
    np.testing.assert_allclose(law.nominal_stress_slope(STRETCHES, values, mode), slope, rtol=1e-7, atol=1e-3)
    analytic = law.nominal_stress_parameter_derivatives(STRETCHES, values, mode)
    for i in range(values.size):
        step = h * max(abs(values[i]), 1.0) * np.eye(values.size)[i]
        numeric = (law.nominal_stress(STRETCHES, values + step, mode)
                   - law.nominal_stress(STRETCHES, values - step, mode)) / (2 * step[i])
        np.testing.assert_allclose(analytic[:, i], numeric, rtol=1e-6, atol=1e-6 * (1 + abs(numeric).max()))


@every_law
def test_biaxial_stresses_contain_the_modes_with_one_stretch(name):
    law, values, s = ts.find_law(name), np.array(PARAMETERS[name]), STRETCHES
    for mode, other in (("uniaxial", s**-0.5), ("planar", np.ones_like(s)), ("equibiaxial", s)):
        both = law.nominal_stress(np.stack([s, other], axis=-1), values, "biaxial")
        np.testing.assert_allclose(both[:, 0], law.nominal_stress(s, values, mode), rtol=1e-9, atol=1e-6)
        if mode == "uniaxial":
            np.testing.assert_allclose(both[:, 1], 0.0, atol=1e-9 * np.abs(both).max())


@every_law
def test_biaxial_derivatives_are_those_of_the_stresses(name):
    law, values = ts.find_law(name), np.array(PARAMETERS[name])
    stretches, h = np.array([[0.7, 1.2], [1.0, 1.0], [1.3, 1.1], [2.0, 0.8]]), 1e-6
    slope = law.nominal_stress_slope(stretches, values, "biaxial")
    derivatives = law.nominal_stress_parameter_derivatives(stretches, values, "biaxial")
    assert slope.shape == (4, 2, 2) and derivatives.shape == (4, 2, values.size)
    for k, step in enumerate(h * np.eye(2)):
        ahead, behind = (law.nominal_stress(stretches + sign * step, values, "biaxial") for sign in (1, -1))
        np.testing.assert_allclose(slope[..., k], (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(slope[..., 0, 1], slope[..., 1, 0], rtol=1e-9, atol=1e-9)  # W is an energy
    for i in range(values.size):
        step = h * max(abs(values[i]), 1.0) * np.eye(values.size)[i]
        numeric = (law.nominal_stress(stretches, values + step, "biaxial")
                   - law.nominal_stress(stretches, values - step, "biaxial")) / (2 * step[i])
        np.testing.assert_allclose(derivatives[..., i], numeric, rtol=1e-6, atol=1e-6 * (1 + abs(numeric).max()))


def test_biaxial_stresses_of_the_neo_hookean_law():
    """P_i = 2 C10 (l_i - l_3^2/l_i)."""
    stretches = np.array([[1.3, 0.9], [2.0, 1.5], [1.0, 1.0]])
    third = 1.0 / stretches.prod(axis=1, keepdims=True)
    np.testing.assert_allclose(ts.find_law("neo_hooke").nominal_stress(stretches, {"C10": 2e5}, "biaxial"),
                               4e5 * (stretches - third**2 / stretches), rtol=1e-12, atol=1e-8)


def test_biaxial_needs_two_stretches():
    with pytest.raises(ts.InputError, match="must have 2 values at each point; got 3"):
        ts.find_law("neo_hooke").nominal_stress([1.0, 1.1, 1.2], [1000.0], "biaxial")


@every_law
def test_moduli_are_the_slopes_at_rest(name):
    law, values = ts.find_law(name), PARAMETERS[name]
    h = 1e-5
    shear = (law.nominal_stress(h, values, "simple_shear") - law.nominal_stress(-h, values, "simple_shear")) / (2 * h)
    assert law.mu0(values) == pytest.approx(shear, rel=1e-7)
    assert law.E0(values) == pytest.approx(3 * law.mu0(values), rel=1e-12)


@pytest.mark.parametrize(("name", "values", "E0", "mu0"), [
    # The study's table of laws.
    ("reduced_polynomial_2", [1404.9, 699.4], 8429.6, 2809.8), ("mooney_rivlin", [624.3, 746.1], 8223.0, 2741.0),
    ("ogden_1", [3225.9, 14.8], 9677.9, 3225.9), ("neo_hooke", [1461.6], 8769.6, 2923.2),
])
def test_moduli_of_the_study(name, values, E0, mu0):
    law = ts.find_law(name)
    assert law.E0(values) == pytest.approx(E0, abs=1.0)
    assert law.mu0(values) == pytest.approx(mu0, abs=1.0)


@every_law
@settings(max_examples=15, deadline=None)
@given(s=st.lists(st.floats(0.6, 1.6), min_size=3, max_size=3), order=st.permutations(range(3)))
def test_response_is_isotropic_and_deviatoric(name, s, order):
    """The response is equal for all orders of the stretches and independent of volume (objectivity: test_energy.py)."""
    law, values, s = ts.find_law(name), PARAMETERS[name], np.array(s)
    energy, tau = law.compute_energy_and_kirchhoff_stresses(s, values)
    energy_permuted, tau_permuted = law.compute_energy_and_kirchhoff_stresses(s[order], values)
    assert energy_permuted == pytest.approx(energy, rel=1e-9, abs=1e-9)
    np.testing.assert_allclose(tau_permuted, tau[order], rtol=1e-9, atol=1e-8)
    energy_swollen, tau_swollen = law.compute_energy_and_kirchhoff_stresses(1.3 * s, values)
    assert energy_swollen == pytest.approx(energy, rel=1e-9, abs=1e-9)
    np.testing.assert_allclose(tau_swollen, tau, rtol=1e-9, atol=1e-8)
    assert abs(tau.sum()) < 1e-9 * (1 + abs(tau).max())


@every_law
def test_kirchhoff_stress_of_uniaxial_loading(name):
    """tau_1 - tau_2 of the tensor form is stretch times the nominal stress of the closed form."""
    law, values = ts.find_law(name), PARAMETERS[name]
    stretches = np.stack([STRETCHES, STRETCHES**-0.5, STRETCHES**-0.5], axis=-1)
    _, tau = law.compute_energy_and_kirchhoff_stresses(stretches, values)
    np.testing.assert_allclose(tau[:, 0] - tau[:, 1], STRETCHES * law.nominal_stress(STRETCHES, values), rtol=1e-10,
                               atol=1e-8)


class TestStability:
    def test_neo_hooke_is_stable_everywhere(self):
        stability = ts.find_stability_range(ts.find_law("neo_hooke"), [1000.0])
        assert stability.is_stable_in_whole_range and (stability.stable_from, stability.stable_to) == (0.3, 3.0)

    @pytest.mark.parametrize("alpha", [-30.0, -14.8, 14.8, 30.0, 200.0])
    def test_one_ogden_term_is_stable(self, alpha):
        """mu > 0: the Hessian mu (l_i^alpha) on the diagonal is positive definite at every stretch."""
        assert ts.find_stability_range(ts.find_law("ogden_1"), [3225.9, alpha]).is_stable_in_whole_range

    @pytest.mark.parametrize("values", [[1000.0, -50.0], [1000.0, -200.0]])
    def test_every_loss_of_a_softening_law(self, values):
        """All six limits of C10 x + C20 x^2, x = I1 - 3, against a Hessian by finite differences, bisected here."""
        def energy(e1, e2):
            x = np.exp(2 * e1) + np.exp(2 * e2) + np.exp(-2 * (e1 + e2)) - 3
            return values[0] * x + values[1] * x**2

        def smallest_eigenvalue(e1, e2, h=1e-3):
            d11 = (energy(e1 + h, e2) - 2 * energy(e1, e2) + energy(e1 - h, e2)) / h**2
            d22 = (energy(e1, e2 + h) - 2 * energy(e1, e2) + energy(e1, e2 - h)) / h**2
            d12 = (energy(e1 + h, e2 + h) - energy(e1 + h, e2 - h) - energy(e1 - h, e2 + h)
                   + energy(e1 - h, e2 - h)) / (4 * h**2)
            return np.linalg.eigvalsh([[d11, d12], [d12, d22]])[0]

        stability = ts.find_stability_range(ts.find_law("reduced_polynomial_2"), values)
        assert not stability.is_stable_in_whole_range
        for mode, ratio in (("uniaxial", -0.5), ("planar", 0.0), ("equibiaxial", 1.0)):
            for end, found in zip(stability.stretch_range, stability.limits[mode], strict=True):
                strains = np.linspace(0, np.log(end), 2001)
                lost = [strain for strain in strains if smallest_eigenvalue(strain, ratio * strain) <= 0]
                expected = np.exp(lost[0]) if lost else end
                assert found == pytest.approx(expected, rel=2e-3), (mode, end)

    def test_limit_is_reported_in_words(self):
        text = ts.find_stability_range(ts.find_law("reduced_polynomial_2"), [1000.0, -50.0]).describe()
        assert "uniaxial" in text and "unstable" in text


@pytest.mark.parametrize(("name", "formula"), [
    ("mooney_rivlin", "W = C10*(I1 - 3) + C01*(I2 - 3)"),
    ("reduced_polynomial_3", "W = C10*(I1 - 3) + C20*(I1 - 3)^2 + C30*(I1 - 3)^3"),
    ("ogden_1", "W = w(lambda_1) + w(lambda_2) + w(lambda_3), w = 2*mu1*(lambda^alpha1 - 1)/alpha1^2"),
])
def test_formula_is_printed_in_the_order_of_its_parameters(name, formula):
    assert ts.find_law(name).formula() == formula


class TestParameters:
    def test_unknown_law_names_the_nearest(self):
        with pytest.raises(ts.InputError, match="did you mean 'neo_hooke'"):
            ts.find_law("neo_hook")

    def test_an_alias_is_replaced_by_the_name(self):
        assert ts.find_law("yeoh") is ts.find_law("reduced_polynomial_3") and "yeoh" not in set(ts.LAWS)
        assert ts.Material("yeoh", PARAMETERS["reduced_polynomial_3"]).law == "reduced_polynomial_3"

    @pytest.mark.parametrize(("values", "words"), [
        ({"C10": 1.0}, "C20 is missing"), ({"C10": 1.0, "C20": 2.0, "C3": 1.0}, "no parameter 'C3'"),
        ({"C10": float("nan"), "C20": 1.0}, r"must be finite; got nan\. State a number"),
        ([1.0], r"must be 2 numbers .* Give C10, C20"),
    ])
    def test_bad_parameters(self, values, words):
        with pytest.raises(ts.InputError, match=words):
            ts.find_law("reduced_polynomial_2").convert_parameters_to_array(values)

    @pytest.mark.parametrize("exponent", [0.0, 1e-9, -1e-9])
    def test_an_exponent_of_zero_is_the_logarithmic_limit(self, exponent):
        """The energy of Hencky: P = 3 mu ln(s) / s."""
        stress = ts.find_law("ogden_1").nominal_stress(STRETCHES, [1000.0, exponent])
        np.testing.assert_allclose(stress, 3000.0 * np.log(STRETCHES) / STRETCHES, rtol=1e-4, atol=1e-9)

    def test_exponent_near_zero_reaches_the_logarithmic_limit(self):
        """2 mu / a (s^(a-1) - s^(-a/2-1)) tends to 3 mu ln(s) / s."""
        stress = ts.find_law("ogden_1").nominal_stress(STRETCHES, [1000.0, 1e-4])
        np.testing.assert_allclose(stress, 3000.0 * np.log(STRETCHES) / STRETCHES, rtol=1e-4, atol=1e-9)


def test_treloar_rubber(data_folder):
    """Ogden's six published numbers (Ogden 1972, converted to this convention) follow Treloar's 1944 tension."""
    table = np.loadtxt(data_folder / "rubber_treloar_kawabata" / "treloar1944_uniaxial.csv", delimiter=",", skiprows=1)
    # Ogden 1972: mu_p = 0.63, 0.0012, -0.01 MPa with alpha = 1.3, 5, -2 and W = sum mu_p/alpha_p (...): mu = mu_p a/2.
    published, exponents = np.array([0.63e6, 0.0012e6, -0.01e6]), np.array([1.3, 5.0, -2.0])
    values = np.column_stack([published * exponents / 2, exponents]).ravel()
    stress = ts.find_law("ogden_3").nominal_stress(table[:, 0], values)
    assert np.sqrt(np.mean((stress - table[:, 1] * 1e6) ** 2)) < 0.05 * 1e6 * table[:, 1].max()
