"""Strain of homogeneous tests with a prescribed stress, in closed form and by finite elements."""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.closed_form import creep
from tissue_sim.closed_form.creep import CREEP, shear_strain_history, stretch_history
from tissue_sim.closed_form.histories import nominal_stress_history, shear_stress_history

SERIES = ts.Prony((ts.PronyTerm(0.3, 2.0), ts.PronyTerm(0.2, 10.0)))
SOFT = ts.Softening(0.4, modulus=20.0, share=0.5)
STUDY = {"C10": 1404.9, "C20": 699.4}
#: Times after a sudden load, s.
TIMES = np.concatenate([[0.0, 0.0], np.geomspace(0.01, 60.0, 60)])


def study(**options):
    return ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e6), **options)


class TestSmallStrain:
    """J(t) is the inverse Laplace transform of 1 / (s^2 G(s)), with G(t) = G_inf + sum G_i exp(-t/tau_i)."""

    INSTANTANEOUS = 2000.0

    def compliance(self, history, series, stress=1e-3):
        gel = ts.Material("neo_hooke", {"C10": 0.5 * self.INSTANTANEOUS}, viscoelastic=series)
        return history(gel, TIMES, np.where(np.arange(TIMES.size) > 0, stress, 0.0))[1:] / stress

    def test_one_term(self):
        """J = 1/G_inf - (1/G_inf - 1/G_0) exp(-t/tau_c) with tau_c = tau G_0/G_inf."""
        relaxed = 0.7 * self.INSTANTANEOUS
        retardation = 2.0 * self.INSTANTANEOUS / relaxed
        expected = 1 / relaxed - (1 / relaxed - 1 / self.INSTANTANEOUS) * np.exp(-TIMES[1:] / retardation)
        found = self.compliance(shear_strain_history, ts.Prony((ts.PronyTerm(0.3, 2.0),)))
        np.testing.assert_allclose(found, expected, rtol=1e-5)

    def test_two_terms_in_shear_and_in_tension(self):
        """With poles p_k, the roots of s G(s), and residues: J = 1/G_inf - sum c_k exp(p_k t); E = 3 G in tension."""
        g, tau = SERIES.g, SERIES.tau
        # s G(s)/G_0 = (1 - sum g) + sum g_i s/(s + 1/tau_i); times the product of s + 1/tau_i it is a polynomial.
        factors = [np.array([1.0, 1.0 / each]) for each in tau]
        denominator = np.polymul(*factors)
        numerator = (1.0 - g.sum()) * denominator
        for k, own in enumerate(g):
            numerator = np.polyadd(numerator, own * np.polymul([1.0, 0.0], factors[1 - k]))
        poles = np.roots(numerator)
        slope = np.polyder(numerator)
        expected = 1.0 / (1.0 - g.sum()) + sum(np.polyval(denominator, pole) / (pole * np.polyval(slope, pole))
                                               * np.exp(pole * TIMES[1:]) for pole in poles)
        expected /= self.INSTANTANEOUS
        np.testing.assert_allclose(self.compliance(shear_strain_history, SERIES), expected, rtol=5e-5)
        tension = self.compliance(lambda *each: stretch_history(*each) - 1.0, SERIES, 1e-2)
        np.testing.assert_allclose(tension, expected / 3.0, rtol=5e-5)

    def test_error_falls_with_the_square_of_the_time_step(self, monkeypatch):
        relaxed = 0.7 * self.INSTANTANEOUS
        expected = 1 / relaxed - (1 / relaxed - 1 / self.INSTANTANEOUS) * np.exp(
            -TIMES[1:] * relaxed / (2.0 * self.INSTANTANEOUS))
        errors = []
        for divisions in (1, 2):
            monkeypatch.setattr(creep, "CREEP", replace(CREEP, divisions=divisions))
            found = self.compliance(shear_strain_history, ts.Prony((ts.PronyTerm(0.3, 2.0),)))
            errors.append(abs(found / expected - 1).max())
        assert errors[0] == pytest.approx(4.0 * errors[1], rel=0.1)


class TestInverse:
    @pytest.mark.parametrize("options", [{}, {"viscoelastic": SERIES}, {"softening": SOFT},
                                         {"viscoelastic": SERIES, "softening": SOFT}])
    def test_stress_of_the_strain_is_the_prescribed_stress(self, monkeypatch, options):
        """Both closed forms have the same steps if the points are not divided."""
        monkeypatch.setattr(creep, "CREEP", replace(CREEP, divisions=1))
        time = np.linspace(0.0, 12.0, 49)
        stress = 600.0 * np.sin(time) * np.minimum(1.0, 0.2 * time)
        stretch = stretch_history(study(**options), time, stress)
        assert stretch.min() < 0.95 and stretch.max() > 1.05
        np.testing.assert_allclose(nominal_stress_history(study(**options), time, stretch), stress, atol=1e-9 * 600.0)
        shear = shear_strain_history(study(**options), time, stress)
        np.testing.assert_allclose(shear_stress_history(study(**options), time, shear), stress, atol=1e-9 * 600.0)

    def test_elastic_material_has_no_memory(self):
        stretch = stretch_history(study(), [0.0, 1.0, 50.0, 51.0], [0.0, -300.0, -300.0, 0.0])
        assert stretch[1] == pytest.approx(stretch[2], abs=1e-12) and stretch[3] == pytest.approx(1.0, abs=1e-12)

    def test_drainage_has_the_time_of_the_specimen(self):
        """One relaxing term with tau = a^2/D."""
        draining = study(effects=[], poroelasticity=ts.Poroelasticity(0.3, 8e-7))
        same = study(viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2e-3**2 / 8e-7),)))
        found, expected = (stretch_history(each, [0.0, 1.0, 9.0], [0.0, -300.0, -300.0], 2e-3)
                           for each in (draining, same))
        np.testing.assert_allclose(found, expected, rtol=1e-14)


class TestFiniteElements:
    @pytest.mark.slow
    def test_lubricated_compression(self):
        """Creep, recovery and cycles between forces; the error of the finite elements falls with the time step.

        The material is incompressible in the closed form, and K/mu is 1e6 in the finite elements.
        """
        coarse = ts.Protocol.parse("ramp 2N @0.5N/s; hold 60s; unload; reload 3N; unload 1N", points=11)
        material, errors = study(viscoelastic=SERIES, softening=SOFT), []
        for divisions in (1, 2, 4):
            samples = np.linspace(0.0, coarse.time.size - 1, divisions * (coarse.time.size - 1) + 1)
            time, force = (np.interp(samples, np.arange(coarse.time.size), each)
                           for each in (coarse.time, coarse.force))
            specimen, protocol = ts.Specimen(0.040, 0.070), ts.Protocol(time, force=force)
            found = ts.simulate(ts.Model(ts.Experiment(specimen, protocol, friction="frictionless"), material),
                                estimate_error=False)
            strain = 1.0 - stretch_history(material, time, -force / specimen.area)
            errors.append(abs(found.displacement / specimen.height - strain).max() / strain.max())
        assert errors[2] < 1e-4 and errors[0] > 2.5 * errors[1] > 2.5 * 2.5 * errors[2]

    def test_small_strain_creep(self):
        """J(t) of one term within 1e-4, in time steps of 1/50 of the retardation time."""
        gel = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e6),
                          viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0),)))
        time = np.concatenate([[0.0, 1e-6], np.linspace(0.0, 10.0, 176)[1:]])
        force = np.where(time > 0, 1e-3, 0.0)
        specimen, protocol = ts.Specimen(0.040, 0.070), ts.Protocol(time, force=force)
        found = ts.simulate(ts.Model(ts.Experiment(specimen, protocol, friction="frictionless"), gel),
                            estimate_error=False)
        strain, stress = found.displacement[1:] / specimen.height, 1e-3 / specimen.area
        expected = (1 / 1400.0 - (1 / 1400.0 - 1 / 2000.0) * np.exp(-time[1:] / (2.0 / 0.7))) / 3.0
        np.testing.assert_allclose(strain / stress, expected, rtol=1e-4)


@pytest.mark.parametrize("kind", ["lubricated_compression", "uniaxial_tension", "simple_shear"])
def test_kinds_have_both_histories(kind):
    """The history of the stress of a kind of test, and its inverse."""
    form, time = ts.KINDS[kind].require_closed_form(), np.linspace(0.0, 5.0, 26)
    stress = -200.0 * np.sin(time)
    strain = form.strain_history(study(viscoelastic=SERIES), time, stress, 0.04)
    found = form.stress_history(study(viscoelastic=SERIES), time, strain, 0.04)
    np.testing.assert_allclose(found, stress, atol=0.002 * 200.0)


class TestErrors:
    @pytest.mark.parametrize(("time", "stress", "words"), [
        ([0.0, 1.0], [0.0], "must be two lists of the same length"), ([0.0, 1.0], [0.0, np.nan], "must be finite"),
        ([1.0, 0.0], [0.0, 1.0], "must not decrease")])
    def test_lists(self, time, stress, words):
        with pytest.raises(ts.InputError, match=words):
            stretch_history(study(), time, stress)

    def test_stress_that_is_not_reached(self):
        """A neo-Hookean solid in tension has no limit; the stress of this Ogden law has one."""
        limited = ts.Material("ogden_1", {"mu1": 1000.0, "alpha1": 1.2})
        with pytest.raises(ts.InputError, match="must be a stress that the material reaches at strains up to 3; got"):
            stretch_history(limited, [0.0, 1.0], [0.0, 1e7])

    def test_layers(self):
        layered = study(layers=[ts.Layer(0.01, 2.0)])
        with pytest.raises(ts.InputError, match="a layered specimen does not deform homogeneously"):
            stretch_history(layered, [0.0, 1.0], [0.0, 1.0])
