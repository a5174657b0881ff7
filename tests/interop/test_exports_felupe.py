"""Materials for FElupe: the exported code runs there, and gives our stresses and forces."""

import dataclasses
import runpy

import felupe as fem
import felupe_problem
import numpy as np
import pytest

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.exports import ExportContent
from tissue_sim.exports.felupe import FELUPE
from tissue_sim.exports.unit_systems import UNIT_SYSTEMS, find_unit_system
from tissue_sim.laws import LAWS, InvariantLaw, StretchLaw
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q4P0, Q9P1

#: Bulk response of most tests.
BULK = ts.Bulk("bulk_ratio", 50.0)
#: Radius, m.
RADIUS = 0.04
#: Height, m.
HEIGHT = 0.07
#: Depths of the compression, m.
DEPTHS = np.array([2e-3, 5e-3, 10e-3])
PARAMETERS = {
    "neo_hooke": {"C10": 1500.0},
    "mooney_rivlin": {"C10": 800.0, "C01": 760.0},
    "reduced_polynomial_1": {"C10": 1500.0},
    "reduced_polynomial_2": {"C10": 1404.9, "C20": 699.4},
    "reduced_polynomial_3": {"C10": 1404.9, "C20": 699.4, "C30": 30.0},
    "biderman": {"C10": 900.0, "C01": 500.0, "C20": 699.4, "C30": 30.0},
    "ogden_1": {"mu1": 3225.9, "alpha1": 14.8},
    "ogden_2": {"mu1": 1500.0, "alpha1": 3.0, "mu2": 800.0, "alpha2": -2.5},
    "ogden_3": {"mu1": 1500.0, "alpha1": 3.0, "mu2": 800.0, "alpha2": -2.5, "mu3": 300.0, "alpha3": 8.0},
    "ogden_4": {"mu1": 1500.0, "alpha1": 3.0, "mu2": 800.0, "alpha2": -2.5, "mu3": 300.0, "alpha3": 8.0, "mu4": 90.0,
                "alpha4": 1.2},
    "gent": {"mu": 2800.0, "J_m": 9.7},
    "arruda_boyce": {"mu": 2100.0, "lambda_m": 1.7},
    "fung_demiray": {"mu": 2800.0, "b": 0.43},
}


class Exponential(InvariantLaw):
    """Law that FElupe does not have."""

    name, title, units = "test_exponential", "Exponential", {"a": "Pa", "b": "1", "c": "Pa"}

    def energy(self, I1, I2, a, b, c):
        import sympy as sp

        return a / (2 * b) * (sp.exp(b * (I1 - 3)) - 1) + c * sp.log(I2 / 3)


class Logarithmic(StretchLaw):
    """Law of stretches that FElupe does not have: Hencky's energy with a power."""

    name, title, units = "test_logarithmic", "Logarithmic", {"mu": "Pa", "k": "1"}

    def energy_of_stretch(self, stretch, mu, k):
        import sympy as sp

        return mu * sp.log(stretch) ** 2 + mu * k * sp.log(stretch) ** 4


@pytest.fixture
def other_laws():
    added = [Exponential(), Logarithmic()]
    for law in added:
        LAWS.register(law)
    yield {"test_exponential": {"a": 1500.0, "b": 0.7, "c": 300.0}, "test_logarithmic": {"mu": 900.0, "k": 0.4}}
    for law in added:
        LAWS.unregister(law.name)


def run_export(material, units, tmp_path, *variants):
    path = tmp_path / "exported.py"
    path.write_text(FELUPE.write(ExportContent((material, *variants), units)), encoding="utf-8")
    return runpy.run_path(str(path))


def make_deformations():
    """Deformation gradients, shape (3, 3, points, 1): three modes with principal stretches from 0.5 to 2, and shear
    with a volume change."""
    stretches = np.linspace(0.5, 2.0, 13)
    diagonals = [np.diag(d) for s in stretches for d in ([s, s**-0.5, s**-0.5], [s, 1.0, 1 / s], [s**-0.5, s**-0.5, s])]
    general = [np.eye(3) + 0.25 * np.random.default_rng(seed).normal(size=(3, 3)) for seed in range(8)]
    return np.stack([*diagonals, *general], axis=-1)[..., None]


def compute_our_stress(material, F):
    """First Piola-Kirchhoff stress of our law, Pa, shape of F."""
    result = np.empty_like(F)
    for index in np.ndindex(F.shape[2:]):
        u, stretches, v = np.linalg.svd(F[(..., *index)])
        J, K = np.prod(stretches), material.bulk_modulus
        tau = material.energy_law.compute_energy_and_kirchhoff_stresses(stretches, material.parameters)[1]
        result[(..., *index)] = u @ np.diag((tau + K * J * (J - 1.0)) / stretches) @ v
    return result


def assert_stresses_agree(material, units, tmp_path):
    """Difference below 1e-6 of the largest component, or of mu0 near rest: FElupe separates equal eigenvalues by a
    perturbation of 1.5e-8, which leaves a stress at rest."""
    F = make_deformations()
    found = run_export(material, units, tmp_path)["make_material"]().gradient([F, None])[0] * units.stress
    expected = compute_our_stress(material, F)
    error = np.abs(found - expected).max(axis=(0, 1)) / np.maximum(np.abs(expected).max(axis=(0, 1)), material.mu0)
    assert error.max() < 1e-6


@pytest.mark.parametrize("units", UNIT_SYSTEMS.values(), ids=UNIT_SYSTEMS)
@pytest.mark.parametrize("law", PARAMETERS)
def test_stresses_are_ours(law, units, tmp_path):
    assert_stresses_agree(ts.Material(law, PARAMETERS[law], BULK), units, tmp_path)


@pytest.mark.parametrize("law", ["test_exponential", "test_logarithmic"])
def test_energies_of_other_laws_are_written_out(law, other_laws, tmp_path):
    assert_stresses_agree(ts.Material(law, other_laws[law], BULK), find_unit_system("mm-mN-kPa"), tmp_path)


def test_one_element_in_si_units(tmp_path):
    """Free uniaxial compression of one cube by 20 %, against our energy with the lateral stretch without stress."""
    material = ts.Material("reduced_polynomial_2", PARAMETERS["reduced_polynomial_2"], BULK)
    field = fem.FieldContainer([fem.Field(fem.RegionHexahedron(fem.Cube(n=2)), dim=3)])
    boundaries = fem.dof.uniaxial(field, move=-0.2, clamped=False, return_loadcase=False)
    umat = run_export(material, UNIT_SYSTEMS["SI"], tmp_path)["make_material"]()
    step = fem.Step([fem.SolidBody(umat, field)], ramp={boundaries["move"]: -0.2 * np.linspace(0.25, 1.0, 4)},
                    boundaries=boundaries)
    curve = fem.CharacteristicCurve([step], boundary=boundaries["move"])
    curve.evaluate(verbose=False, tol=1e-10)
    lateral = 1.0 + field[0].values[:, 1].max()
    stress = compute_our_stress(material, np.diag([0.8, lateral, lateral])[..., None, None])[..., 0, 0]
    assert stress[1, 1] == pytest.approx(0.0, abs=1e-6 * material.mu0)
    assert np.array(curve.y)[-1, 0] == pytest.approx(stress[0, 0], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("element", "pressure"), [(Q4P0, "P0"), (Q9P1, "P-1")], ids=["Q4/P0", "Q9/P-1"])
@pytest.mark.parametrize("held", ["rz", "z"], ids=["bonded", "lubricated"])
@pytest.mark.parametrize("law", ["neo_hooke", "mooney_rivlin", "reduced_polynomial_2", "ogden_1", "ogden_2"])
def test_force_of_compression_is_ours(law, held, element, pressure, tmp_path):
    """Same mesh and element, the bulk modulus of the exported code."""
    material = ts.Material(law, PARAMETERS[law], ts.Bulk("bulk_ratio", 1e3), name="gel")
    code = run_export(material, find_unit_system("mm-N-MPa"), tmp_path)
    mesh = cylinder_mesh(RADIUS, HEIGHT, (3, 4), element, grading=(2.0, 1.5))
    theirs = felupe_problem.compression_curve(mesh, code["make_isochoric_material"](), code["BULK"]["GEL"] * 1e6,
                                              DEPTHS, held=held, pressure=pressure, tolerance=1e-9)
    face = {"rz": "bonded", "z": "frictionless"}[held]
    protocol = ts.Protocol(np.arange(1.0 + DEPTHS.size), np.concatenate([[0.0], DEPTHS]))
    experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), protocol, friction=face, friction_base=face)
    ours = ts.simulate(ts.Model(experiment, material), mesh=mesh).force[1:]
    np.testing.assert_allclose(theirs, ours, rtol=1e-6)


def test_mixed_material_runs_on_mixed_fields(tmp_path):
    """Confined compression of one cube: the force is that of our energy at J = 0.95."""
    material = ts.Material("mooney_rivlin", PARAMETERS["mooney_rivlin"], BULK)
    field = fem.FieldsMixed(fem.RegionHexahedron(fem.Cube(n=2)), n=3)
    boundaries = fem.dof.uniaxial(field, move=-0.05, clamped=True, return_loadcase=False)
    boundaries["sides"] = fem.Boundary(field[0], mask=np.ones(8, dtype=bool), skip=(1, 0, 0))
    umat = run_export(material, UNIT_SYSTEMS["mm-mN-kPa"], tmp_path)["make_mixed_material"]()
    step = fem.Step([fem.SolidBody(umat, field)], ramp={boundaries["move"]: np.array([-0.05])}, boundaries=boundaries)
    curve = fem.CharacteristicCurve([step], boundary=boundaries["move"])
    curve.evaluate(verbose=False, tol=1e-10)
    stress = compute_our_stress(material, np.diag([0.95, 1.0, 1.0])[..., None, None])[0, 0, 0, 0]
    assert np.array(curve.y)[-1, 0] * 1e3 == pytest.approx(stress, rel=1e-6)


def test_incompressible_material_states_its_bulk_modulus(tmp_path):
    material = ts.Material("neo_hooke", {"C10": 1500.0}, density=1040.0)
    code = run_export(material, find_unit_system("mm-N-MPa"), tmp_path)
    assert code["BULK"] == {"NEO_HOOKE": pytest.approx(FELUPE.incompressible_bulk_ratio * 3e-3)}
    assert code["DENSITY"] == {"NEO_HOOKE": pytest.approx(1.04e-9)}
    assert f"K / mu0 = {FELUPE.incompressible_bulk_ratio:g} replaces" in FELUPE.write(ExportContent((material,)))


def test_variants_have_separate_materials(tmp_path):
    draws = [ts.Material("neo_hooke", {"C10": 1500.0 + 100.0 * i}, BULK) for i in range(3)]
    code = run_export(draws[0], UNIT_SYSTEMS["SI"], tmp_path, *draws[1:])
    assert [code["make_isochoric_material"](name).mu for name in code["BULK"]] == [3000.0, 3200.0, 3400.0]
    assert code["make_isochoric_material"]().mu == 3000.0


@pytest.mark.parametrize("law", ["neo_hooke", "biderman", "ogden_2"])
def test_softening_with_an_error_function(law, tmp_path):
    """Loading, unloading and reloading of one cube in tension, against our closed form; K / mu0 = 1e5."""
    soft = ts.Softening(0.4, 30.0, 0.3, "erf")
    material = ts.Material(law, PARAMETERS[law], ts.Bulk("bulk_ratio", 1e5), softening=soft)
    field = fem.FieldContainer([fem.Field(fem.RegionHexahedron(fem.Cube(n=2)), dim=3)])
    boundaries = fem.dof.uniaxial(field, move=0.0, clamped=False, return_loadcase=False)
    code = run_export(material, UNIT_SYSTEMS["mm-N-MPa"], tmp_path)
    strain = np.array([0.2, 0.4, 0.6, 0.5, 0.3, 0.1, 0.3, 0.5, 0.7])
    body = fem.SolidBodyNearlyIncompressible(code["make_isochoric_material"](), field, bulk=next(iter(
        code["BULK"].values())))
    step = fem.Step([body], ramp={boundaries["move"]: strain}, boundaries=boundaries)
    curve = fem.CharacteristicCurve([step], boundary=boundaries["move"])
    curve.evaluate(verbose=False, tol=1e-8)
    ours = ts.nominal_stress_history(material, np.arange(strain.size), 1.0 + strain)
    elastic = ts.nominal_stress_history(dataclasses.replace(material, softening=None), np.arange(strain.size),
                                        1.0 + strain)
    assert (ours / elastic).min() < 0.75
    # A finite K reduces the stress by a fraction of the order of stress / K.
    np.testing.assert_allclose(np.array(curve.y)[:, 0] * 1e6, ours, rtol=2.0 * ours.max() / material.bulk_modulus)


def test_softening_without_a_modulus_is_refused():
    material = ts.Material("neo_hooke", {"C10": 1500.0}, softening=ts.Softening(0.4, 0.0, 0.3, "erf"))
    with pytest.raises(ts.InputError, match=r"softening\.modulus must be above 0"):
        FELUPE.write(ExportContent((material,)))


@pytest.mark.parametrize(("part", "words"), [
    ({"viscoelastic": ts.Prony((ts.PronyTerm(0.3, 2.0),))}, "finite_strain_viscoelastic"),
    ({"softening": ts.Softening(0.3, 50.0)}, "Ogden-Roxburgh"), ({"layers": (ts.Layer(2e-3, 2.0),)}, "layers")])
def test_parts_without_equivalent_are_refused_by_name(part, words):
    with pytest.raises(ts.InputError, match=words):
        FELUPE.write(ExportContent((ts.Material("neo_hooke", {"C10": 1500.0}, **part),)))


def test_command_line_writes_code(tmp_path):
    source, output = tmp_path / "m.material.json", tmp_path / "m.py"
    ts.write_material_file(ts.MaterialFile.of(ts.Material("ogden_1", PARAMETERS["ogden_1"], BULK)), source)
    assert main(["material", "export", str(source), "--to", "felupe", "-o", str(output), "--units", "mm-N-MPa"]) == 0
    umat = runpy.run_path(str(output))["make_material"]()
    stress = umat.gradient([np.diag([0.8, 1.1, 1.1])[..., None, None], None])[0][0, 0, 0, 0]
    ours = compute_our_stress(ts.Material("ogden_1", PARAMETERS["ogden_1"], BULK),
                              np.diag([0.8, 1.1, 1.1])[..., None, None])[0, 0, 0, 0]
    assert stress * 1e6 == pytest.approx(ours, rel=1e-6)
