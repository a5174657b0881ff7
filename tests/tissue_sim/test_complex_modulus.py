"""Complex modulus of small oscillations: textbook formulas, and time stepping of the same hereditary form."""

import numpy as np
import pytest

import tissue_sim as ts

PRONY = ts.Prony((ts.PronyTerm(0.3, 0.02), ts.PronyTerm(0.25, 0.5)))
FREQUENCIES = np.array([0.1, 1.0, 10.0])
#: Kind of test -> pre-strain.
PRE_STRAINS = {"uniaxial_tension": 1.3, "lubricated_compression": 0.8, "planar_tension": 1.25,
               "equibiaxial_tension": 1.2, "simple_shear": 0.4, "torsion": 0.5, "confined_compression": 0.9}


def fourier_modulus(kind: str, material: ts.Material, frequency: float, pre_strain: float, amplitude: float,
                    per_cycle: int = 256) -> complex:
    """Return the first Fourier coefficient of the stress over that of the strain in the last cycle, by time stepping.

    A hold at the pre-strain of 50 times the longest relaxation time precedes the oscillation, which lasts 12 times this
    relaxation time.
    """
    cycles = 1 + round(6.0 * frequency)
    form = ts.KINDS[kind].require_closed_form()
    phase = np.arange(1, cycles * per_cycle + 1) / per_cycle
    wave = amplitude * np.sin(2 * np.pi * phase)
    time = np.concatenate([[0.0, 25.0], 25.0 + phase / frequency])
    stress = form.stress_history(material, time, np.concatenate([[pre_strain] * 2, pre_strain + wave]), 0.01)
    turn = np.exp(-2j * np.pi * phase[-per_cycle:])
    # The stress is that of lines between the samples. The difference from a sinusoid changes the result by up to 9e-5
    # with 256 samples in a cycle, and by a quarter of it with 512.
    return (stress[-per_cycle:] @ turn) / (wave[-per_cycle:] @ turn)


@pytest.mark.parametrize("moduli", ["instantaneous", "long_term"])
def test_prony_series_at_no_pre_strain_is_the_textbook_formula(moduli):
    """G' = G_inf + sum G_i w^2 tau^2 / (1 + w^2 tau^2), G'' = sum G_i w tau / (1 + w^2 tau^2); E = 3 G."""
    gel = ts.Material("neo_hooke", {"C10": 1000.0}, viscoelastic=ts.Prony(PRONY.terms, moduli))
    fast = 2000.0 if moduli == "instantaneous" else 2000.0 / 0.45
    x = 2 * np.pi * FREQUENCIES[:, None] * PRONY.tau
    storage = fast * (0.45 + (x**2 / (1 + x**2)) @ PRONY.g)
    loss = fast * ((x / (1 + x**2)) @ PRONY.g)
    for mode, factor in (("simple_shear", 1.0), ("uniaxial", 3.0), ("planar", 4.0), ("equibiaxial", 6.0)):
        modulus = ts.complex_modulus(gel, FREQUENCIES, mode)
        np.testing.assert_allclose(modulus, factor * (storage + 1j * loss), rtol=1e-9)
    torsion = ts.KINDS["torsion"].require_closed_form().complex_modulus(gel, FREQUENCIES)
    np.testing.assert_allclose(torsion, storage + 1j * loss, rtol=1e-9)


@pytest.mark.parametrize("kind", PRE_STRAINS)
@pytest.mark.parametrize(("law", "values"), [
    ("mooney_rivlin", {"C10": 800.0, "C01": 300.0}), ("ogden_1", {"mu1": 1500.0, "alpha1": 7.0})])
def test_equal_to_time_stepping_about_a_pre_strain(kind, law, values):
    """0.1 % amplitude, within 1e-4 of the modulus."""
    gel = ts.Material(law, values, ts.Bulk("K_Pa", 20e3), viscoelastic=PRONY)
    form = ts.KINDS[kind].require_closed_form()
    expected = form.complex_modulus(gel, FREQUENCIES, PRE_STRAINS[kind])
    found = [fourier_modulus(kind, gel, f, PRE_STRAINS[kind], 1e-3) for f in FREQUENCIES]
    assert np.abs(found / expected - 1.0).max() < 1e-4
    assert (expected.real > 0).all() and (expected.imag > 0).all()


def test_elastic_material_has_the_slope_of_the_stress():
    law = ts.find_law("ogden_1")
    values = {"mu1": 1500.0, "alpha1": 7.0}
    modulus = ts.complex_modulus(ts.Material("ogden_1", values), [1.0], "uniaxial", 1.4)
    assert modulus[0] == pytest.approx(float(law.nominal_stress_slope(1.4, values)), rel=1e-9)


@pytest.mark.parametrize("form", ["tanh", "erf"])
def test_softening_reduces_the_modulus_about_a_pre_strain(form):
    gel = ts.Material("neo_hooke", {"C10": 1000.0}, softening=ts.Softening(0.4, 50.0, 0.1, form), viscoelastic=PRONY)
    hard = ts.Material("neo_hooke", {"C10": 1000.0}, viscoelastic=PRONY)
    soft, stiff = (ts.complex_modulus(each, FREQUENCIES, "uniaxial", 1.3) for each in (gel, hard))
    assert (np.abs(soft) > 1.1 * np.abs(stiff)).all()
    # The softened state of the mean strain differs by the order of the amplitude.
    found = [fourier_modulus("uniaxial_tension", gel, f, 1.3, 2e-6) for f in FREQUENCIES]
    assert np.abs(found / soft - 1.0).max() < 1e-4
    np.testing.assert_allclose(*(ts.complex_modulus(each, FREQUENCIES) for each in (gel, hard)), rtol=1e-12)


def test_drainage_is_a_relaxing_term():
    gel = ts.Material("neo_hooke", {"C10": 1000.0}, poroelasticity=ts.Poroelasticity(0.4, 1e-6))
    same = ts.Material("neo_hooke", {"C10": 1000.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.4, 100.0),)))
    np.testing.assert_allclose(ts.complex_modulus(gel, [1e-3], contact_radius=0.01), ts.complex_modulus(same, [1e-3]))


class TestFractionalZener:
    MODEL = ts.FractionalZener(alpha=0.4, g=0.7, tau=0.1, shortest=1e-3, longest=1e2)

    def test_series_is_near_the_model(self):
        """G* = G_inf + (G_0 - G_inf) (i w tau)^alpha / (1 + (i w tau)^alpha)."""
        frequency = np.geomspace(1.0 / (2 * np.pi * 99.0), 1.0 / (2 * np.pi * 1.01e-3), 60)
        gel = ts.Material("neo_hooke", {"C10": 1000.0}, viscoelastic=ts.FractionalRelaxation(self.MODEL))
        x = (2j * np.pi * frequency * 0.1)**0.4
        exact = 2000.0 * (0.3 + 0.7 * x / (1.0 + x))
        found = ts.complex_modulus(gel, frequency, "simple_shear")
        np.testing.assert_allclose(2000.0 * self.MODEL.compute_relative_complex_modulus(frequency), exact, rtol=1e-12)
        assert np.abs(found / exact - 1.0).max() < 0.01

    def test_outside_of_the_window(self):
        gel = ts.Material("neo_hooke", {"C10": 1000.0}, viscoelastic=ts.FractionalRelaxation(self.MODEL))
        with pytest.raises(ts.InputError, match=r"frequency: must be 0.00159 to 159 Hz, where the series represents"):
            ts.complex_modulus(gel, [1e-3, 1.0])


@pytest.mark.parametrize(("options", "problem"), [
    ({"mode": "biaxial"}, "mode: must be one of uniaxial, planar, equibiaxial, confined, simple_shear; got biaxial"),
    ({"frequency": [1.0, 0.0]}, "frequency: must be positive and finite"),
    ({"frequency": [[1.0]]}, "frequency: must be positive and finite, one list in Hz"),
    ({"abscissa": -1.0}, "stretch: must be above 0"),
    ({"abscissa": float("nan")}, "abscissa: must be finite; got nan")])
def test_errors(options, problem):
    with pytest.raises(ts.InputError, match=problem):
        ts.complex_modulus(ts.Material("neo_hooke", {"C10": 1000.0}), **({"frequency": [1.0]} | options))


def test_strain_outside_of_the_domain_of_the_law():
    rubber = ts.Material("gent", {"mu": 1000.0, "J_m": 1.0})
    with pytest.raises(ts.InputError, match="abscissa: must be inside the domain of the law; got 2"):
        ts.complex_modulus(rubber, [1.0], "uniaxial", 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("motion", [
    "ramp 1mm @1mm/s; hold 3s; sine 0.01mm @1Hz for 3 cycles",
    "ramp 0.15N @0.15N/s; hold 3s; sine 1.5mN @1Hz for 3 cycles"])
def test_a_simulated_sinusoid_has_the_complex_modulus(motion):
    """A lubricated cylinder with K/mu0 = 1000 about a stretch of 0.9, by displacement and by force: within 0.3 %.

    Lines between 32 samples in a cycle and the compressibility change the modulus by about 0.1 %.
    """
    gel = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3),
                      viscoelastic=ts.Prony((ts.PronyTerm(0.5, 0.3),)))
    experiment = ts.KINDS["lubricated_compression"].experiment(specimen=ts.Specimen(0.01, 0.01),
                                                               protocol=ts.Protocol.parse(motion, points=4))
    recording = ts.simulate(ts.Model(experiment, gel))
    assert set(recording.labels["segment"][-96:]) == {"sine"}
    force, displacement = recording.force[-32:], recording.displacement[-32:]
    turn = np.exp(-2j * np.pi * np.arange(32) / 32)
    found = (force @ turn) / (displacement @ turn) * 0.01 / (np.pi * 0.01**2)
    expected, = ts.complex_modulus(gel, [1.0], "uniaxial", 1.0 - displacement.mean() / 0.01)
    assert abs(found / expected - 1.0) < 3e-3
