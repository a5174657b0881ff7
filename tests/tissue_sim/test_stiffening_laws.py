"""Laws of Gent, Arruda and Boyce, Fung and Demiray, and Ogden with four terms, against closed forms written out here.

Sources: Gent, Rubber Chem. Technol. 69 (1996) 59; Arruda and Boyce, J. Mech. Phys. Solids 41 (1993) 389, in the
convention of the Abaqus manual; Demiray, J. Biomech. 5 (1972) 309; Ogden, Proc. R. Soc. A 326 (1972) 565.
"""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.laws.modes import MODES
from tissue_sim.mesh.solid import Grading
from tissue_sim.mesh.solid_element import HEX8P0

VALUES = {
    "gent": {"mu": 2800.0, "J_m": 6.0},
    "arruda_boyce": {"mu": 2800.0, "lambda_m": 1.6},
    "fung_demiray": {"mu": 2800.0, "b": 0.9},
    "ogden_4": {"mu1": 1500.0, "alpha1": 1.3, "mu2": 400.0, "alpha2": 5.0, "mu3": 300.0, "alpha3": -2.0, "mu4": 90.0,
                "alpha4": 8.0},
}
#: Coefficients of the series of Arruda and Boyce.
C = (1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750)
#: W1 = dW/dI1 as functions of I1 and the parameters.
SLOPES = {
    "gent": lambda I1, mu, J_m: mu / 2 * J_m / (J_m - I1 + 3),
    "arruda_boyce": lambda I1, mu, m: mu * sum(i * c * I1**(i - 1) / m**(2 * i - 2) for i, c in enumerate(C, start=1)),
    "fung_demiray": lambda I1, mu, b: mu / 2 * np.exp(b * (I1 - 3)),
}
#: Mode -> I1 and the factor of 2 W1 in the nominal stress, as functions of the stretch.
HOMOGENEOUS = {
    "uniaxial": (lambda s: s**2 + 2 / s, lambda s: s - s**-2),
    "planar": (lambda s: s**2 + 1 + s**-2, lambda s: s - s**-3),
    "equibiaxial": (lambda s: 2 * s**2 + s**-4, lambda s: s - s**-5),
}
STRETCHES = np.array([0.75, 0.9, 0.99, 1.01, 1.2, 1.4])
every_law = pytest.mark.parametrize("name", VALUES)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", SLOPES)
def test_nominal_stress_of_laws_of_the_first_invariant(name, mode):
    I1, factor = (function(STRETCHES) for function in HOMOGENEOUS[mode])
    expected = 2 * SLOPES[name](I1, *VALUES[name].values()) * factor
    np.testing.assert_allclose(ts.find_law(name).nominal_stress(STRETCHES, VALUES[name], mode), expected, rtol=1e-12)


@pytest.mark.parametrize(("mode", "exponent"), [("uniaxial", -0.5), ("planar", -1.0), ("equibiaxial", -2.0)])
def test_nominal_stress_of_four_terms_of_ogden(mode, exponent):
    """P = sum 2 mu_i/alpha_i (l^(alpha_i - 1) - l^(e alpha_i - 1)), where l^e is the stretch of a free direction."""
    values = list(VALUES["ogden_4"].values())
    expected = sum(2 * mu / a * (STRETCHES**(a - 1) - STRETCHES**(exponent * a - 1))
                   for mu, a in zip(values[::2], values[1::2], strict=True))
    np.testing.assert_allclose(ts.find_law("ogden_4").nominal_stress(STRETCHES, VALUES["ogden_4"], mode), expected,
                               rtol=1e-12)


@every_law
def test_stress_is_the_slope_of_the_energy(name):
    law, h = ts.find_law(name), 1e-5
    others = {"uniaxial": lambda s: (s**-0.5, s**-0.5), "planar": lambda s: (1.0 + 0 * s, 1 / s),
              "equibiaxial": lambda s: (s, s**-2)}
    for mode in MODES:
        ahead, behind = (law.compute_energy_and_kirchhoff_stresses(np.stack([s, *others[mode](s)], axis=-1),
                                                                   VALUES[name])[0]
                         for s in (STRETCHES + h, STRETCHES - h))
        slope = (ahead - behind) / (2 * h) / (2 if mode == "equibiaxial" else 1)
        np.testing.assert_allclose(law.nominal_stress(STRETCHES, VALUES[name], mode), slope, rtol=1e-7, atol=1e-3)


def test_initial_shear_moduli():
    m = VALUES["arruda_boyce"]["lambda_m"]
    series = 1 + 3 / (5 * m**2) + 99 / (175 * m**4) + 513 / (875 * m**6) + 42039 / (67375 * m**8)
    for name, expected in (("gent", 2800.0), ("fung_demiray", 2800.0), ("arruda_boyce", 2800.0 * series),
                           ("ogden_4", 1500.0 + 400.0 + 300.0 + 90.0)):
        assert ts.find_law(name).mu0(VALUES[name]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("name", "parameter", "value"), [
    ("gent", "J_m", 1e6), ("arruda_boyce", "lambda_m", 1e4), ("fung_demiray", "b", 0.0)])
def test_limit_is_neo_hooke(name, parameter, value):
    law = ts.find_law(name)
    expected = ts.find_law("neo_hooke").nominal_stress(STRETCHES, {"C10": 1400.0})
    np.testing.assert_allclose(law.nominal_stress(STRETCHES, {"mu": 2800.0, parameter: value}), expected, rtol=2e-6)


def test_four_terms_of_ogden_contain_three():
    three = {key: value for key, value in VALUES["ogden_4"].items() if not key.endswith("4")}
    np.testing.assert_allclose(ts.find_law("ogden_4").nominal_stress(STRETCHES, {**three, "mu4": 0.0, "alpha4": 3.0}),
                               ts.find_law("ogden_3").nominal_stress(STRETCHES, three), rtol=1e-13)


@every_law
def test_laws_are_stable_inside_their_domain(name):
    limits = (0.6, 1.6) if name == "gent" else (0.3, 3.0)
    assert ts.find_stability_range(ts.find_law(name), VALUES[name], limits).is_stable_in_whole_range


class TestDomain:
    @pytest.mark.parametrize("mode", MODES)
    def test_stress_of_gent_is_not_finite_from_the_limit_on(self, mode):
        stretch = np.linspace(1.0, 4.0, 301)
        outside = HOMOGENEOUS[mode][0](stretch) - 3 >= 6.0
        law = ts.find_law("gent")
        assert outside.any() and not outside.all()
        for values in (law.nominal_stress(stretch, VALUES["gent"], mode),
                       law.nominal_stress_slope(stretch, VALUES["gent"], mode),
                       law.nominal_stress_parameter_derivatives(stretch, VALUES["gent"], mode)[:, 1]):
            np.testing.assert_array_equal(np.isfinite(values), ~outside)

    def test_energy_and_kirchhoff_stress_of_gent_are_not_finite_outside(self):
        energy, tau = ts.find_law("gent").compute_energy_and_kirchhoff_stresses(
            [[1.2, 1.0, 1 / 1.2], [4.0, 0.5, 0.5]], VALUES["gent"])
        assert np.isfinite(energy[0]) and np.isfinite(tau[0]).all()
        assert np.isnan(energy[1]) and np.isnan(tau[1]).all()

    def test_overflow_gives_no_finite_stress(self):
        assert not np.isfinite(ts.find_law("fung_demiray").nominal_stress(40.0, {"mu": 2800.0, "b": 0.9}))

    @pytest.mark.parametrize("mode", MODES)
    def test_stability_ends_at_the_limit_of_gent(self, mode):
        found = ts.find_stability_range(ts.find_law("gent"), VALUES["gent"], (0.2, 4.0)).limits[mode]
        for limit in found:
            assert HOMOGENEOUS[mode][0](limit) - 3 == pytest.approx(6.0, rel=1e-6)

    @pytest.mark.parametrize(("name", "parameter", "value"), [
        ("gent", "J_m", -1.0), ("gent", "J_m", 0.0), ("arruda_boyce", "lambda_m", 0.0), ("fung_demiray", "b", -0.1)])
    def test_parameters_outside_their_bounds_are_refused(self, name, parameter, value):
        with pytest.raises(ts.InputError, match=f"parameters.{parameter}: must be within"):
            ts.Material(name, {"mu": 1000.0, parameter: value})


def compute_invariant(fields) -> np.ndarray:
    """I1 - 3 of the isochoric part at the quadrature points of the last sample, from the principal stretches."""
    F = fields.deformation_gradient()
    if F.shape[-1] == 5:
        F = np.stack([F[..., 0], F[..., 1], 0 * F[..., 0], F[..., 2], F[..., 3], 0 * F[..., 0], 0 * F[..., 0],
                      0 * F[..., 0], F[..., 4]], axis=-1).reshape(*F.shape[:-1], 3, 3)
    stretches = np.linalg.svd(F, compute_uv=False)
    return (stretches**2).sum(axis=-1) * stretches.prod(axis=-1)**(-2 / 3) - 3


@pytest.mark.slow
class TestFiniteElements:
    @every_law
    @pytest.mark.parametrize("solver", ["axisymmetric", "solid"])
    def test_lubricated_compression_follows_the_closed_form(self, name, solver):
        """The difference from the incompressible closed form is at most 2 mu0/K."""
        ratio, kind = 1e5, ts.KINDS["lubricated_compression"]
        if solver == "solid":
            specimen = ts.Block(0.02, 0.02, 0.02)
            options = {"mesh": specimen.solid_mesh(Grading(HEX8P0, 0.01, 1.0, 0.01, 2))}
            area, height = 0.02**2, 0.02
        else:
            specimen, options, area, height = ts.Specimen(0.04, 0.07), {}, np.pi * 0.04**2, 0.07
        experiment = kind.experiment(specimen=specimen, protocol=ts.Protocol.ramp(0.35 * height, 5))
        material = ts.Material(name, VALUES[name], ts.Bulk("bulk_ratio", ratio))
        recording = ts.simulate(ts.Model(experiment, material), solver=solver, estimate_error=False, **options)
        closed = -area * ts.find_law(name).nominal_stress(1 - recording.displacement / height, VALUES[name])
        np.testing.assert_allclose(recording.force[1:], closed[1:], rtol=2 / ratio)

    @pytest.mark.parametrize("solver", ["axisymmetric", "solid"])
    def test_a_step_out_of_the_domain_is_cut(self, solver):
        """One sample or several to the same depth: trial states are outside, converged states inside the domain.

        Outside the domain the formula of the stress has solutions as well: the force of the needle would be lower by
        0.3 %, that of the bonded block by 1.7 %.
        """
        if solver == "solid":
            J_m, depth, specimen = 0.5, 6e-3, ts.Block(0.02, 0.02, 0.02)
            options = {"solver": solver, "mesh": specimen.solid_mesh(Grading(HEX8P0, 0.005, 1.0, 0.005, 2))}
            experiment = ts.KINDS["bonded_compression"].experiment(specimen=specimen,
                                                                   protocol=ts.Protocol.ramp(depth, 2))
            ratio, points = 1e2, 5
        else:
            J_m, depth, options, ratio, points = 0.2, 10e-3, {}, 1e3, 11
            experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(depth, 2),
                                       tool=ts.Tool("flat", 8e-3, 1e-3), friction="frictionless")
        material = ts.Material("gent", {"mu": 2800.0, "J_m": J_m}, ts.Bulk("bulk_ratio", ratio))
        whole, short = (ts.simulate(ts.Model(each, material), estimate_error=False, fields=True, **options)
                        for each in (experiment, replace(experiment, protocol=ts.Protocol.ramp(depth, points))))
        assert 0.9 * J_m < compute_invariant(whole.fields).max() < J_m
        assert whole.force[-1] == pytest.approx(short.force[-1], rel=1e-8)

    def test_a_motion_beyond_the_domain_fails(self):
        """Compression to the stretch 0.6 has I1 - 3 = 0.69, beyond J_m = 0.5; the last converged state is inside."""
        experiment = ts.KINDS["lubricated_compression"].experiment(
            specimen=ts.Specimen(0.02, 0.02), protocol=ts.Protocol.ramp(0.4 * 0.02, 5))
        material = ts.Material("gent", {"mu": 2800.0, "J_m": 0.5}, ts.Bulk("bulk_ratio", 1e5))
        words = r"stopped at.*the law alone is uniaxial: unstable below 0\.65"
        with pytest.raises(ts.ConvergenceError, match=words) as raised:
            ts.simulate(ts.Model(experiment, material), estimate_error=False, fields=True)
        recording = raised.value.recording
        assert np.isfinite(recording.force).all() and compute_invariant(recording.fields).max() < 0.5
