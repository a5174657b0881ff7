"""Materials for SOFA: the stress of SOFA's documented energy with the exported numbers, against our laws."""

import ast
import runpy

import numpy as np
import pytest
from scipy.optimize import brentq

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.exports import ExportContent
from tissue_sim.exports.sofa import SOFA
from tissue_sim.exports.unit_systems import SI, UNIT_SYSTEMS

#: Bulk response of most tests.
BULK = ts.Bulk("bulk_ratio", 50.0)
MATERIALS = {
    "neo_hooke": ts.Material("neo_hooke", {"C10": 1500.0}, BULK),
    "reduced_polynomial_1": ts.Material("reduced_polynomial_1", {"C10": 1500.0}, BULK),
    "mooney_rivlin": ts.Material("mooney_rivlin", {"C10": 800.0, "C01": 760.0}, BULK),
    "ogden": ts.Material("ogden_1", {"mu1": 3225.9, "alpha1": 14.8}, BULK),
    "ogden, negative exponent": ts.Material("ogden_1", {"mu1": 1500.0, "alpha1": -5.0}, BULK),
}
#: Principal stretches: uniaxial, planar and equibiaxial with volume ratios 1 and others.
STRETCHES = np.concatenate([volume ** (1 / 3) * np.array([[s, s**-0.5, s**-0.5], [s, 1.0, 1.0 / s], [s, s, s**-2]])
                            for s in np.linspace(0.5, 2.0, 31) for volume in (0.9, 1.0, 1.1)])


def parse_arguments(text):
    """The dictionary MATERIALS of an exported fragment, without executing it."""
    found = {node.targets[0].id: node.value for node in ast.parse(text).body if isinstance(node, ast.Assign)}
    return ast.literal_eval(found["MATERIALS"])


def compute_sofa_stress(arguments, stretches):
    """Isochoric Kirchhoff stresses, and pressure terms k0 ln J, by the formulas of SOFA's deriveSPKTensor."""
    first, second, k0 = (float(number) for number in arguments["ParameterSet"].split())
    J = np.prod(stretches, axis=-1, keepdims=True)
    C = stretches**2
    match arguments["materialName"]:
        case "MooneyRivlin":
            I1 = C.sum(axis=-1, keepdims=True)
            I2 = 0.5 * (I1**2 - (C**2).sum(axis=-1, keepdims=True))
            S = (2.0 * first * J ** (-2 / 3) * (1.0 - I1 / (3.0 * C))
                 + 2.0 * second * J ** (-4 / 3) * (I1 - C - 2.0 * I2 / (3.0 * C)))
        case "Ogden":
            power = C ** (0.5 * second)
            S = first / second * J ** (-second / 3) * (power - power.mean(axis=-1, keepdims=True)) / C
    return S * C, k0 * np.log(J[..., 0])


@pytest.mark.parametrize("units", UNIT_SYSTEMS.values(), ids=UNIT_SYSTEMS)
@pytest.mark.parametrize("name", MATERIALS)
def test_stress_of_the_documented_formula_is_ours(name, units):
    material = MATERIALS[name]
    (arguments,) = parse_arguments(SOFA.write(ExportContent((material,), units))).values()
    tau, pressure = compute_sofa_stress(arguments, STRETCHES)
    expected = material.energy_law.compute_energy_and_kirchhoff_stresses(STRETCHES, material.parameters)[1]
    error = np.abs(tau * units.stress - expected).max(axis=-1)
    assert (error <= 1e-6 * np.abs(expected).max(axis=-1) + 1e-12 * material.mu0).all()
    np.testing.assert_allclose(pressure * units.stress, material.bulk_modulus * np.log(STRETCHES.prod(axis=-1)),
                               rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(("name", "ratio", "limit"), [("neo_hooke", 50.0, 7e-4), ("neo_hooke", 1e4, 1e-6),
                                                      ("mooney_rivlin", 1e4, 1e-6)])
def test_difference_by_the_volumetric_term(name, ratio, limit):
    """Free uniaxial stress over stretch 0.5 to 2: k0/2 (ln J)^2 and K/2 (J - 1)^2 agree for large K / mu0."""
    material = ts.Material(name, MATERIALS[name].parameters, ts.Bulk("bulk_ratio", ratio))
    (arguments,) = parse_arguments(SOFA.write(ExportContent((material,)))).values()

    def compute_ours(stretches):
        J = np.prod(stretches)
        tau = material.energy_law.compute_energy_and_kirchhoff_stresses(stretches, material.parameters)[1]
        return tau + material.bulk_modulus * J * (J - 1.0)

    def compute_theirs(stretches):
        tau, pressure = compute_sofa_stress(arguments, stretches)
        return tau + pressure

    def compute_axial_stress(compute, stretch):
        def make_stretches(lateral):
            return np.array([stretch, lateral, lateral])

        lateral = brentq(lambda lateral: compute(make_stretches(lateral))[1], 0.5 * stretch**-0.5, 2.0 * stretch**-0.5,
                         xtol=1e-15, rtol=1e-14)
        return compute(make_stretches(lateral))[0]

    stretches = [stretch for stretch in np.linspace(0.5, 2.0, 31) if abs(stretch - 1.0) > 1e-9]
    error = max(abs(compute_axial_stress(compute_theirs, stretch) / compute_axial_stress(compute_ours, stretch) - 1.0)
                for stretch in stretches)
    assert error < limit


def test_text_states_what_sofa_needs():
    text = SOFA.write(ExportContent((ts.Material("ogden_1", {"mu1": 1500.0, "alpha1": 3.0}, density=1040.0,
                                                 name="liver 2"),), UNIT_SYSTEMS["mm-N-MPa"], remarks=("a\nb",)))
    assert parse_arguments(text) == {"LIVER_2": {"materialName": "Ogden", "ParameterSet": "0.003 3 1.5",
                                                 "massDensity": "1.04e-09"}}
    assert f"K / mu0 = {SOFA.incompressible_bulk_ratio:g} replaces" in text
    assert "v26.06.00" in text and "# a\n# b\n" in text
    assert "K / mu0 = " not in SOFA.write(ExportContent((MATERIALS["ogden"],)))


@pytest.mark.parametrize(("material", "words"), [
    (ts.Material("ogden_2", {"mu1": 1.0, "alpha1": 2.0, "mu2": 1.0, "alpha2": 3.0}), "the law 'ogden_2'"),
    (ts.Material("reduced_polynomial_2", {"C10": 1.0, "C20": 1.0}), "'reduced_polynomial_2'"),
    (ts.Material("biderman", {"C10": 1.0, "C01": 1.0, "C20": 1.0, "C30": 1.0}), "'biderman'"),
    (ts.Material("neo_hooke", {"C10": 1.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0),))), "relaxation"),
    (ts.Material("neo_hooke", {"C10": 1.0}, softening=ts.Softening(0.3, 50.0)), "softening")])
def test_parts_without_equivalent_are_refused_by_name(material, words):
    with pytest.raises(ts.InputError, match=words):
        SOFA.write(ExportContent((material,)))


class Node:
    """Records the components that a scene adds."""

    def __init__(self, root=None):
        self.root, self.added = root or self, []

    def getRoot(self):  # the name of SofaPython3
        return self.root

    def addObject(self, kind, **arguments):
        self.added.append((kind, arguments))
        return kind, arguments


def test_command_line_writes_a_function_for_a_scene(tmp_path):
    source, output = tmp_path / "m.material.json", tmp_path / "m.py"
    ts.write_material_file(ts.MaterialFile.of(ts.Material("mooney_rivlin", {"C10": 800.0, "C01": 760.0}, BULK, 1040.0,
                                                          "gel")), source)
    assert main(["material", "export", str(source), "--to", "sofa", "-o", str(output), "--units", "mm-mN-kPa"]) == 0
    root = Node()
    child = Node(root)
    kind, arguments = runpy.run_path(str(output))["add_material"](child)
    assert kind == "TetrahedronHyperelasticityFEMForceField"
    assert [float(number) for number in arguments.pop("ParameterSet").split()] == [0.8, 0.76, 156.0]
    assert arguments == {"name": "GEL", "materialName": "MooneyRivlin"}
    assert child.added[0] == ("MeshMatrixMass", {"massDensity": "1.04e-06"})
    assert [kind for kind, _ in root.added] == ["RequiredPlugin", "RequiredPlugin"]


def test_variants_are_entries_of_the_table():
    material = MATERIALS["mooney_rivlin"]
    draws = [ts.Material("mooney_rivlin", {"C10": 800.0 + i, "C01": 760.0}, BULK) for i in range(3)]
    table = parse_arguments(SOFA.write(ExportContent((material, *draws), SI)))
    assert [float(entry["ParameterSet"].split()[0]) for entry in table.values()] == [800.0, 800.0, 801.0, 802.0]
    assert list(table) == ["MOONEY_RIVLIN", "MOONEY_RIVLIN_1", "MOONEY_RIVLIN_2", "MOONEY_RIVLIN_3"]
