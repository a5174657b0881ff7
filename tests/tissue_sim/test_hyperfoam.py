"""Law of compressible foams: closed forms against equilibrium, finite differences and formulas written by hand."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.closed_form.confined import CONFINED
from tissue_sim.closed_form.histories import StrainHistory, compute_stress_history
from tissue_sim.closed_form.torsion import TORSION, TORSION_WITH_AXIAL_FORCE, compute_torque_and_axial_force
from tissue_sim.laws.modes import MODES
from tissue_sim.material.material import with_changed_or_added_parameters

#: Law -> mu_i (Pa), alpha_i, nu_i of its terms.
PARAMETERS = {
    "hyperfoam_1": [1000.0, 4.0, 0.3],
    "hyperfoam_2": [1000.0, 4.0, 0.2, 500.0, -2.0, 0.35],
    "hyperfoam_3": [1000.0, 4.0, 0.2, 500.0, -2.0, 0.35, 200.0, 8.0, -0.1],
}
#: Stretches of the tests, 1.
STRETCHES = np.array([0.3, 0.6, 0.9, 1.0, 1.1, 1.6, 2.5])

every_law = pytest.mark.parametrize("name", sorted(PARAMETERS))
every_mode = pytest.mark.parametrize("mode", [*MODES, "confined", "simple_shear"])


def make_material(name="hyperfoam_2", **options):
    """Material with the parameters of the table."""
    law = ts.find_law(name)
    return ts.Material(name, dict(zip(law.parameters, PARAMETERS[name], strict=True)), **options)


def compute_kirchhoff_stresses(values, stretches):
    """Principal Kirchhoff stresses, Pa, from the formula sum of 2 mu/alpha (l^alpha - J^(-alpha beta))."""
    J, tau = np.prod(stretches, axis=-1, keepdims=True), 0.0
    for mu, alpha, nu in np.reshape(values, (-1, 3)):
        tau = tau + 2.0 * mu / alpha * (stretches**alpha - J**(-alpha * nu / (1.0 - 2.0 * nu)))
    return tau


def test_every_compressible_law_is_tested():
    assert set(PARAMETERS) == {name for name, law in ts.LAWS.items() if law.is_compressible}
    assert ts.find_law("hyperfoam") is ts.find_law("hyperfoam_1")


@every_law
def test_stress_is_the_published_formula(name):
    law, values = ts.find_law(name), PARAMETERS[name]
    stretches = np.array([[0.4, 0.9, 1.3], [1.2, 1.2, 1.0], [2.0, 0.7, 0.5]])
    _, tau = law.compute_energy_and_kirchhoff_stresses(stretches, values)
    np.testing.assert_allclose(tau, compute_kirchhoff_stresses(values, stretches), rtol=1e-11, atol=1e-9)
    confined = np.stack([STRETCHES, np.ones(7), np.ones(7)], axis=-1)
    np.testing.assert_allclose(law.nominal_stress(STRETCHES, values, "confined"),
                               compute_kirchhoff_stresses(values, confined)[:, 0] / STRETCHES, rtol=1e-11, atol=1e-9)


@every_law
def test_stress_is_the_derivative_of_the_energy(name):
    law, values = ts.find_law(name), PARAMETERS[name]
    stretches, h = np.array([0.7, 1.2, 1.4]), 1e-6
    _, tau = law.compute_energy_and_kirchhoff_stresses(stretches, values)
    for i, step in enumerate(h * np.eye(3)):
        ahead, behind = (law.compute_energy_and_kirchhoff_stresses(stretches + sign * step, values)[0]
                         for sign in (1, -1))
        assert tau[i] == pytest.approx(stretches[i] * (ahead - behind) / (2 * h), rel=1e-7)
    assert law.compute_energy_and_kirchhoff_stresses(np.ones(3), values)[0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("nu", [-0.3, 0.0, 0.1, 0.3, 0.45])
def test_lateral_stretch_with_equal_poisson_ratios(nu):
    """The lateral stretch is l^(-nu) at every strain if all nu_i are equal (Storakers 1986)."""
    law, values = ts.find_law("hyperfoam_2"), [1000.0, 4.0, nu, 500.0, -2.0, nu]
    found = law.compute_principal_stretches(STRETCHES, values)
    np.testing.assert_allclose(found[:, 1], STRETCHES**-nu, rtol=2e-6)
    np.testing.assert_array_equal(found[:, 1], found[:, 2])


@every_law
@pytest.mark.parametrize("mode", MODES)
def test_free_directions_are_free_of_stress(name, mode):
    law, values = ts.find_law(name), PARAMETERS[name]
    stretches = law.compute_principal_stretches(STRETCHES, values, mode)
    tau = compute_kirchhoff_stresses(values, stretches)
    np.testing.assert_allclose(tau[:, 2], 0.0, atol=1e-9 * np.abs(tau).max())
    np.testing.assert_allclose(law.nominal_stress(STRETCHES, values, mode), tau[:, 0] / STRETCHES, rtol=1e-9, atol=1e-8)
    np.testing.assert_array_equal(stretches[:, 0], STRETCHES)


@every_law
@every_mode
def test_derivatives_are_those_of_the_stress(name, mode):
    law, values, h = ts.find_law(name), np.array(PARAMETERS[name]), 1e-6
    ahead, behind = (law.nominal_stress(STRETCHES + step, values, mode) for step in (h, -h))
    np.testing.assert_allclose(law.nominal_stress_slope(STRETCHES, values, mode), (ahead - behind) / (2 * h), rtol=1e-6,
                               atol=1e-3)
    analytic = law.nominal_stress_parameter_derivatives(STRETCHES, values, mode)
    for i, step in enumerate(h * np.diag(np.abs(values))):
        numeric = (law.nominal_stress(STRETCHES, values + step, mode)
                   - law.nominal_stress(STRETCHES, values - step, mode)) / (2 * step[i])
        np.testing.assert_allclose(analytic[:, i], numeric, rtol=1e-6, atol=1e-6 * (1 + abs(numeric).max()))


@every_law
def test_biaxial_stresses_contain_the_modes_with_one_stretch(name):
    law, values, s = ts.find_law(name), PARAMETERS[name], STRETCHES
    for mode in MODES:
        other = law.compute_principal_stretches(s, values, mode)[:, 1]
        both = law.nominal_stress(np.stack([s, other], axis=-1), values, "biaxial")
        np.testing.assert_allclose(both[:, 0], law.nominal_stress(s, values, mode), rtol=1e-8, atol=1e-6)
        if mode == "uniaxial":
            np.testing.assert_allclose(both[:, 1], 0.0, atol=1e-8 * np.abs(both).max())
    slope = law.nominal_stress_slope([[0.7, 1.2], [1.3, 1.1]], values, "biaxial")
    np.testing.assert_allclose(slope[..., 0, 1], slope[..., 1, 0], rtol=1e-9)  # W is an energy


@every_law
def test_moduli_at_rest(name):
    """mu0 = sum of mu_i, K0 = sum of 2 mu_i (1/3 + beta_i); E and the aggregate modulus follow from both."""
    law, terms = ts.find_law(name), np.reshape(PARAMETERS[name], (-1, 3))
    mu = terms[:, 0].sum()
    K = float(np.sum(2 * terms[:, 0] * (1 / 3 + terms[:, 2] / (1 - 2 * terms[:, 2]))))
    material = make_material(name)
    assert (law.mu0(PARAMETERS[name]), law.K0(PARAMETERS[name])) == pytest.approx((mu, K), rel=1e-12)
    assert (material.mu0, material.bulk_modulus) == pytest.approx((mu, K), rel=1e-12)
    assert law.E0(PARAMETERS[name]) == pytest.approx(9 * K * mu / (3 * K + mu), rel=1e-12)
    assert pytest.approx(law.E0(PARAMETERS[name]), rel=1e-12) == material.E0
    assert law.nominal_stress_slope(1.0, PARAMETERS[name], "confined") == pytest.approx(K + 4 / 3 * mu, rel=1e-12)


def test_limits_of_exponent_and_poisson_ratio():
    """alpha = 0: tau = 2 mu (ln l + beta ln J); nu = 0: u = -2 mu/alpha ln J, with no lateral contraction."""
    law = ts.find_law("hyperfoam_1")
    stretches = np.array([0.5, 1.2, 1.1])
    _, tau = law.compute_energy_and_kirchhoff_stresses(stretches, [1000.0, 0.0, 0.3])
    expected = 2000.0 * (np.log(stretches) + 0.75 * np.log(stretches.prod()))
    np.testing.assert_allclose(tau, expected, rtol=1e-4)
    found = law.nominal_stress(STRETCHES, [1000.0, 4.0, 0.0])
    np.testing.assert_allclose(found, 500.0 * (STRETCHES**4 - 1) / STRETCHES, rtol=1e-5, atol=1e-9)
    assert "alpha1 is at its limit 0" in law.describe_limiting_cases([1000.0, 0.0, 0.3])[0]


def test_parameters_without_lateral_equilibrium_give_nan():
    """The second term loses the stiffness of the free directions; the numbers become NaN there, not a wrong branch."""
    law, values = ts.find_law("hyperfoam_2"), [1000.0, 2.0, 0.3, -800.0, 12.0, 0.3]
    stress = law.nominal_stress(np.linspace(0.3, 1.0, 30), values, "equibiaxial")
    assert np.isnan(stress[0]) and np.isfinite(stress[-1])
    first = np.flatnonzero(np.isfinite(stress))[0]
    assert np.isfinite(stress[first:]).all()


def test_stability():
    stable = ts.find_stability_range(ts.find_law("hyperfoam_1"), PARAMETERS["hyperfoam_1"])
    assert stable.is_stable_in_whole_range
    found = ts.find_stability_range(ts.find_law("hyperfoam_2"), [1000.0, 2.0, 0.3, -800.0, 12.0, 0.3])
    assert 1.0 < found.stable_to < 1.5
    limit = found.limits["equibiaxial"][1]
    law = ts.find_law("hyperfoam_2")
    values = np.array([1000.0, 2.0, 0.3, -800.0, 12.0, 0.3])
    for stretch, is_stable in ((limit * 0.999, True), (limit * 1.001, False)):
        hessian = law.compute_log_strain_hessian(law.compute_principal_stretches(stretch, values, "equibiaxial"),
                                                 values)
        assert (np.isfinite(hessian).all() and np.linalg.eigvalsh(hessian).min() > 0) == is_stable


@pytest.mark.parametrize("alpha", [-14.0, -2.0, 3.0, 18.7])
@pytest.mark.parametrize("nu", [0.0, 0.2, 0.42])
def test_one_term_is_stable(alpha, nu):
    """d(tau)/d(e) is the sum of two positive matrices, 2 mu l_i^alpha and 2 mu beta J^(-alpha beta), if nu >= 0."""
    found = ts.find_stability_range(ts.find_law("hyperfoam_1"), [1000.0, alpha, nu])
    assert found.is_stable_in_whole_range


def test_histories_and_confined_compression_use_the_full_stress():
    material, stretch = make_material(), np.array([1.0, 0.9, 0.7])
    law = material.energy_law
    found = compute_stress_history("uniaxial", material, np.arange(3.0), stretch, None)
    np.testing.assert_allclose(found, law.nominal_stress(stretch, material.values), rtol=1e-14)
    confined = CONFINED.stress_history(material, np.arange(3.0), stretch, 0.01)
    np.testing.assert_allclose(confined, law.nominal_stress(stretch, material.values, "confined"), rtol=1e-14)
    for method, mode in ((CONFINED.slope, "nominal_stress_slope"),
                         (CONFINED.stress_parameter_derivatives, "nominal_stress_parameter_derivatives")):
        np.testing.assert_array_equal(method(law, stretch, material.values),
                                      getattr(law, mode)(stretch, material.values, "confined"))


@pytest.mark.parametrize(("mode", "expected"), [("uniaxial", 2600.0), ("planar", 2600.0 / 0.91),
                                                ("equibiaxial", 2600.0 / 0.7), ("simple_shear", 1000.0),
                                                ("confined", 3500.0)])
def test_complex_modulus_at_rest_is_that_of_isotropic_elasticity(mode, expected):
    """mu 1000 Pa, nu 0.3: E, E / (1 - nu^2), E / (1 - nu), mu and the aggregate modulus 2 mu (1 - nu) / (1 - 2 nu)."""
    material = make_material("hyperfoam_1")
    np.testing.assert_allclose(ts.complex_modulus(material, [0.1, 10.0], mode), expected, rtol=2e-6)
    kind = next(kind for kind in ts.KINDS.values() if kind.closed_form is not None
                and (kind.closed_form is CONFINED if mode == "confined" else kind.closed_form.law_mode == mode))
    np.testing.assert_allclose(kind.closed_form.complex_modulus(material, np.array([1.0])), expected, rtol=2e-6)


@every_mode
def test_complex_modulus_about_a_pre_strain_is_the_slope_of_the_stress(mode):
    material, at, h = make_material(), 0.8, 1e-5
    stress = material.energy_law.nominal_stress(np.array([at - h, at + h]), material.values, mode)
    np.testing.assert_allclose(ts.complex_modulus(material, [1.0], mode, at), np.diff(stress) / (2.0 * h), rtol=1e-6)


def test_histories_of_constant_volume_refuse_the_law():
    material = make_material()
    for mode in MODES:
        with pytest.raises(ts.InputError, match="in a history of constant volume; got hyperfoam_2"):
            StrainHistory(mode, np.arange(2.0), np.array([1.0, 1.1])).nominal_stress(material.energy_law,
                                                                                     material.values)


@pytest.mark.parametrize("form", [TORSION, TORSION_WITH_AXIAL_FORCE, TORSION_WITH_AXIAL_FORCE.select_load(1)])
def test_torsion_refuses_the_law_in_every_method(form):
    material, shear = make_material(), np.array([0.0, 0.1])
    law, values = material.energy_law, material.values
    calls = [lambda: form.stress(law, shear, values), lambda: form.slope(law, shear, values),
             lambda: form.stress_parameter_derivatives(law, shear, values)]
    if form.has_history:
        calls += [lambda: form.stress_history(material, np.arange(2.0), shear, 0.01),
                  lambda: form.complex_modulus(material, np.array([1.0]))]
    for call in calls:
        with pytest.raises(ts.InputError, match="in torsion; got hyperfoam_2"):
            call()


def test_results_of_repeated_calls_are_independent():
    """The stresses of equal arguments come from a cache; a caller may change them."""
    law, values = ts.find_law("hyperfoam_1"), PARAMETERS["hyperfoam_1"]
    first = law.nominal_stress(STRETCHES, values)
    expected = first.copy()
    first[:] = 0.0
    np.testing.assert_array_equal(law.nominal_stress(STRETCHES, values), expected)


def test_refusals():
    law = ts.find_law("hyperfoam_1")
    values = dict(zip(law.parameters, PARAMETERS["hyperfoam_1"], strict=True))
    with pytest.raises(ts.InputError, match=r"bulk\.K_Pa.*whose parameters state the volumetric response"):
        ts.Material("hyperfoam", values, ts.Bulk("K_Pa", 1e4))
    with pytest.raises(ts.InputError, match="must be stated for neo_hooke"):
        ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("of_law"))
    with pytest.raises(ts.InputError, match=r"viscoelastic.*which a compressible law does not separate"):
        make_material(viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0),)))
    with pytest.raises(ts.InputError, match=r"parameters\.nu1.*must be within \[-0.9, 0.49\]; got 0.5"):
        ts.Material("hyperfoam", values | {"nu1": 0.5})
    with pytest.raises(ts.InputError, match="positive bulk modulus"):
        ts.Material("hyperfoam_2", {"mu1": 1e3, "alpha1": 2.0, "nu1": 0.1, "mu2": -900.0, "alpha2": 2.0, "nu2": 0.4})
    with pytest.raises(ts.InputError, match="in torsion; got hyperfoam_1"):
        compute_torque_and_axial_force(law, PARAMETERS["hyperfoam_1"], 10.0, 0.01)


def test_material_file(tmp_path):
    material = make_material(name="hyperfoam_1")
    path = tmp_path / "foam.material.json"
    ts.write_material_file(ts.MaterialFile.of(material), path)
    assert '"of_law": true' in path.read_text() and ts.load_material(path) == material
    path.write_text(path.read_text().replace('"of_law"', '"incompressible"'))
    with pytest.raises(ts.InputError, match=r"bulk\.incompressible.*Write of_law: true"):
        ts.load_material(path)


def test_other_parameters_can_be_added():
    layered = with_changed_or_added_parameters(make_material(), {"layers[0].thickness": 1e-3, "layers[0].ratio": 2.0})
    assert layered.bulk.kind == "of_law" and layered.layers[0].ratio == 2.0
