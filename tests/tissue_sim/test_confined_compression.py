"""Confined compression: closed form, finite elements of both solvers, aggregate modulus, and what is refused."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.closed_form.confined import CONFINED

#: Radius and height of the specimen, m.
SIZE = 0.010
KIND = ts.KINDS["confined_compression"]
LAWS = {"neo_hooke": {"C10": 1000.0}, "reduced_polynomial_2": {"C10": 1404.9, "C20": 699.4},
        "ogden_1": {"mu1": 3000.0, "alpha1": -4.0}}


def make_material(law, ratio=5.0, **options):
    return ts.Material(law, LAWS[law], ts.Bulk("bulk_ratio", ratio), **options)


def compute_stress(material, recording):
    return -CONFINED.stress_history(material, recording.time, 1.0 - recording.displacement / SIZE, SIZE)


def simulate(material, protocol, solver="axisymmetric"):
    experiment = KIND.experiment(specimen=ts.Specimen(SIZE, SIZE), protocol=protocol)
    return ts.simulate(ts.Model(experiment, material), solver=solver)


def test_stress_of_neo_hooke_written_out():
    """P = 2 C10 J^(-5/3) (l^2 - (l^2 + 2) / 3) + K (l - 1), with J = l."""
    stretch = np.array([0.6, 0.8, 1.0, 1.1])
    written = 2000.0 * stretch**(-5 / 3) * (stretch**2 - (stretch**2 + 2) / 3) + 1e4 * (stretch - 1)
    found = CONFINED.stress_history(make_material("neo_hooke"), np.arange(4.0), stretch, SIZE)
    np.testing.assert_allclose(found, written, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("law", LAWS)
def test_isochoric_part_and_its_derivatives(law):
    material, stretch, h = make_material(law), np.array([0.6, 0.8, 1.0, 1.1]), 1e-6
    energy, values = material.energy_law, material.values
    stress = CONFINED.stress(energy, stretch, values)
    np.testing.assert_allclose(stress + material.bulk_modulus * (stretch - 1.0),
                               CONFINED.stress_history(material, np.arange(4.0), stretch, SIZE), rtol=1e-10, atol=1e-8)
    ahead, behind = (CONFINED.stress(energy, stretch + step, values) for step in (h, -h))
    np.testing.assert_allclose(CONFINED.slope(energy, stretch, values), (ahead - behind) / (2 * h), rtol=1e-6)
    derivatives = CONFINED.stress_parameter_derivatives(energy, stretch, values)
    for i, step in enumerate(1e-4 * np.diag(np.abs(values))):
        ahead, behind = (CONFINED.stress(energy, stretch, values + sign * step) for sign in (1, -1))
        np.testing.assert_allclose(derivatives[:, i], (ahead - behind) / (2 * step[i]), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("law", LAWS)
def test_aggregate_modulus_at_small_strain(law):
    material = make_material(law)
    slope = CONFINED.stress_history(material, [0.0], np.array([1.0 - 1e-6]), SIZE)[0] / -1e-6
    assert slope == pytest.approx(material.bulk_modulus + 4 / 3 * material.mu0, rel=1e-5)


@pytest.mark.parametrize("points", [4, 21])
@pytest.mark.parametrize("ratio", [2.0, 50.0, 1e3, 1e4])
@pytest.mark.parametrize("law", LAWS)
def test_axisymmetric_elements(law, ratio, points):
    """At K/mu0 = 1e4 the pressure is 2000 mu0; plates in frictionless contact would lose the tissue."""
    material = make_material(law, ratio)
    recording = simulate(material, ts.Protocol.ramp(0.2 * SIZE, points))
    np.testing.assert_allclose(recording.force / (np.pi * SIZE**2), compute_stress(material, recording), rtol=1e-8,
                               atol=1e-6)


def test_solid_elements():
    """A block has no faceting error."""
    material = make_material("reduced_polynomial_2")
    experiment = KIND.experiment(specimen=ts.Block(SIZE, SIZE, SIZE), protocol=ts.Protocol.ramp(0.2 * SIZE, 3))
    recording = ts.simulate(ts.Model(experiment, material), solver="solid")
    np.testing.assert_allclose(recording.force / SIZE**2, compute_stress(material, recording), rtol=1e-8, atol=1e-6)


def test_relaxation_agrees_with_elements():
    material = make_material("neo_hooke", viscoelastic=ts.Prony((ts.PronyTerm(0.4, 2.0),)))
    recording = simulate(material, ts.Protocol.parse("ramp 3mm @1mm/s; hold 5s", points=60))
    stress = compute_stress(material, recording)
    # The closed form divides steps, the elements do not.
    np.testing.assert_allclose(recording.force / (np.pi * SIZE**2), stress, atol=1e-5 * stress.max())
    # The volumetric stress does not relax.
    assert stress[-1] > 1.01 * material.bulk_modulus * 0.3


def test_incompressible_material_is_refused():
    material = ts.Material("neo_hooke", LAWS["neo_hooke"])
    with pytest.raises(ts.InputError, match=r"bulk: must be finite in confined compression"):
        CONFINED.stress_history(material, [0.0], np.array([0.9]), SIZE)
    with pytest.raises(ts.InputError, match=r"bulk: must be finite between lateral walls"):
        simulate(material, ts.Protocol.ramp(1e-3, 3))


def test_self_weight_compresses_the_specimen_before_the_test():
    """In uniaxial strain the specimen sags by about rho g H^2 / (2 (K + 4/3 mu0)), and is a little stiffer."""
    material = make_material("neo_hooke", 5.0, density=1000.0)
    experiment = KIND.experiment(specimen=ts.Specimen(SIZE, SIZE, density=1000.0, gravity=9.81),
                                 protocol=ts.Protocol.ramp(0.1 * SIZE, 4))
    force = ts.simulate(ts.Model(experiment, material)).force / (np.pi * SIZE**2)
    recording = simulate(material, ts.Protocol.ramp(0.1 * SIZE, 4))
    stress = compute_stress(material, recording)
    assert (force[1:] / stress[1:] > 1.0).all() and (force[1:] / stress[1:] < 1.02).all()


def test_walls_need_bonded_plates():
    with pytest.raises(ts.InputError, match="friction: must be 'bonded' on both faces between lateral walls"):
        KIND.experiment(specimen=ts.Specimen(SIZE, SIZE), protocol=ts.Protocol.ramp(1e-3), friction="frictionless")
    with pytest.raises(ts.InputError, match="has_lateral_wall: requires a plate"):
        ts.Experiment(ts.Specimen(SIZE, SIZE), ts.Protocol.ramp(1e-3), ts.Tool("flat", radius=2e-3),
                      has_lateral_wall=True)
