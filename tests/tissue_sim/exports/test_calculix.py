"""Keyword blocks of CalculiX: forces of the exported cards in CalculiX, and cards with values that it replaces."""

import re
import shutil
import subprocess

import numpy as np
import pytest
from export_materials import FOAMS, LAWS, PARAMETERS, chain_pressure, read, write

import tissue_sim as ts
from tissue_sim.exports.calculix import CALCULIX
from tissue_sim.exports.unit_systems import SI, UNIT_SYSTEMS

#: Cube of one unit of length between three planes of symmetry, compressed by 20 %.
CUBE = """*NODE, NSET=ALL
1, 0, 0, 0
2, 1, 0, 0
3, 1, 1, 0
4, 0, 1, 0
5, 0, 0, 1
6, 1, 0, 1
7, 1, 1, 1
8, 0, 1, 1
*ELEMENT, TYPE=C3D8, ELSET=CUBE
1, 1, 2, 3, 4, 5, 6, 7, 8
{material}*SOLID SECTION, ELSET=CUBE, MATERIAL=GEL
*NSET, NSET=TOP
5, 6, 7, 8
*BOUNDARY
1, 1, 3
2, 2, 3
3, 3, 3
4, 1, 1
4, 3, 3
5, 1, 2
6, 2, 2
8, 1, 1
*STEP, NLGEOM
*STATIC
0.25, 1
*BOUNDARY
TOP, 3, 3, -0.2
*NODE PRINT, NSET=TOP, TOTALS=ONLY
RF
*NODE PRINT, NSET=TOP
U
*END STEP
"""
#: Radius of the compressed cylinder of the study, m.
RADIUS = 0.04
#: Height of the cylinder, m.
HEIGHT = 0.07
#: Largest displacement of the plate, m.
DEPTH = 0.01
#: Number of elements along the radius.
COLUMNS = 4
#: Number of elements along the height.
ROWS = 6

#: CalculiX computes a sector of 2 degrees of an axisymmetric body.
SECTORS = 180


def run(deck, folder):
    """Printed results of CalculiX."""
    if shutil.which("ccx") is None:
        pytest.skip("compares with CalculiX, a system package that pip cannot install; ccx is not on PATH. Debian: "
                    "apt install calculix-ccx. .ci/run installs it")
    (folder / "job.inp").write_text(deck, encoding="utf-8")
    done = subprocess.run(["ccx", "job"], cwd=folder, capture_output=True, text=True, encoding="utf-8", timeout=120)
    answer = (folder / "job.dat").read_text(encoding="utf-8")
    assert done.returncode == 0 and answer, done.stdout
    return answer


def total_forces(answer):
    """Total forces of all increments, shape (increments, 3)."""
    return np.array([[float(x) for x in row.split()]
                     for row in re.findall(r"total force.*?\n\n((?:\s+\S+){3})", answer)])


def require_our_stress(text, material, K, units, folder):
    """Free uniaxial compression of one element, against our energy with the lateral stretch that leaves no stress."""
    answer = run(CUBE.format(material=text), folder)
    lateral = 1.0 + float(re.findall(r"^\s+7\s+(\S+)", answer, re.MULTILINE)[-1])
    stretches = np.array([lateral, lateral, 0.8])
    J = np.prod(stretches)
    tau = material.energy_law.compute_energy_and_kirchhoff_stresses(
        stretches, material.parameters)[1] + K * J * chain_pressure(material.law)(J)
    assert tau[0] == pytest.approx(0.0, abs=1e-3 * abs(tau[2]))
    assert total_forces(answer)[-1, 2] * UNIT_SYSTEMS[units].stress == pytest.approx(tau[2] / 0.8, rel=1e-4)


@pytest.mark.parametrize("units", UNIT_SYSTEMS)
@pytest.mark.parametrize("law", LAWS["calculix"])
def test_calculix_gives_our_force(law, units, tmp_path):
    material = ts.Material(law, PARAMETERS[law], ts.Bulk("bulk_ratio", 50.0), name="gel")
    require_our_stress(write(CALCULIX, material, units), material, material.bulk_modulus, units, tmp_path)


@pytest.mark.parametrize("units", UNIT_SYSTEMS)
def test_lubricated_cylinder(units, tmp_path, reference):
    """Frictionless compression of the study's cylinder by 10 mm, against an independent solver and our closed form."""
    system = UNIT_SYSTEMS[units]
    material = ts.Material("reduced_polynomial_2", PARAMETERS["reduced_polynomial_2"], name="gel")
    columns, rows = 2 * COLUMNS + 1, 2 * ROWS + 1
    number = np.arange(1, columns * rows + 1).reshape(rows, columns)
    lines = ["*NODE, NSET=ALL", *(f"{number[j, i]}, {RADIUS * i / (columns - 1) / system.length:.12g}, "
                                  f"{HEIGHT * j / (rows - 1) / system.length:.12g}, 0"
                                  for j in range(rows) for i in range(columns)),
             "*ELEMENT, TYPE=CAX8R, ELSET=TISSUE"]
    corners = ((0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1))
    lines += [f"{j * COLUMNS + i + 1}, " + ", ".join(str(number[2 * j + y, 2 * i + x]) for x, y in corners)
              for j in range(ROWS) for i in range(COLUMNS)]
    for name, nodes in (("BASE", number[0]), ("TOP", number[-1]), ("AXIS", number[:, 0])):
        lines += [f"*NSET, NSET={name}", *(f"{node}," for node in nodes)]
    deck = "\n".join([*lines, write(CALCULIX, material, units).rstrip(), "*SOLID SECTION, ELSET=TISSUE, MATERIAL=GEL",
                      "*BOUNDARY", "BASE, 2, 2", "AXIS, 1, 1", "*STEP, NLGEOM", "*STATIC, DIRECT",
                      "0.25, 1.", "*BOUNDARY",
                      f"TOP, 2, 2, {-DEPTH / system.length:.12g}", "*NODE PRINT, NSET=TOP, TOTALS=ONLY", "RF",
                      "*END STEP"]) + "\n"
    forces = -total_forces(run(deck, tmp_path))[:, 1] * system.force * SECTORS
    depths = DEPTH * np.array([0.25, 0.5, 0.75, 1.0])
    displacement_mm, force = np.loadtxt(reference / "lubricated_RP.csv", delimiter=",", unpack=True)
    ours = -np.pi * RADIUS**2 * material.energy_law.nominal_stress(1.0 - depths / HEIGHT, material.values)
    assert forces[-1] == pytest.approx(7.600, rel=1e-3)
    np.testing.assert_allclose(forces, np.interp(1e3 * depths, displacement_mm, force), rtol=1e-3)
    np.testing.assert_allclose(forces, ours, rtol=1e-3)


def test_relaxation_is_refused():
    material = ts.Material("neo_hooke", {"C10": 1500.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0),)))
    with pytest.raises(ts.InputError, match=r"CalculiX has no form for relaxation.*no keyword \*VISCOELASTIC"):
        write(CALCULIX, material)


def test_an_incompressible_material_has_a_stated_finite_bulk_modulus():
    material = ts.Material("reduced_polynomial_2", PARAMETERS["reduced_polynomial_2"], name="gel")
    text = write(CALCULIX, material)
    comment = text.replace("\n** ", " ")
    assert "K / mu0 = 10000 replaces" in comment and "0.0033 % in free compression" in comment
    assert read(CALCULIX, text).bulk_modulus == pytest.approx(1e4 * material.mu0, rel=1e-12)
    assert "replaces" not in write(CALCULIX, ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e4)))


def test_a_bulk_modulus_that_calculix_would_replace_is_refused():
    """``hyperelastics.f`` replaces D1 below 1e-10."""
    stiff = ts.Material("neo_hooke", {"C10": 1e5}, ts.Bulk("K_Pa", 3e10), name="gel")
    with pytest.raises(ts.InputError, match=r"K must be at most 2e.10 Pa in the unit system SI.*Use mm-N-MPa"):
        write(CALCULIX, stiff)
    assert read(CALCULIX, write(CALCULIX, stiff, "mm-N-MPa"), "mm-N-MPa").bulk_modulus == pytest.approx(3e10, rel=1e-12)


def test_calculix_computes_with_the_imported_default(tmp_path):
    """CalculiX replaces D1 = 0 by 0.1 / mu0, K = 20 mu0; the imported material has the same force."""
    text = "*MATERIAL, NAME=GEL\n*HYPERELASTIC, NEO HOOKE\n1500., 0.\n"
    [imported] = CALCULIX.read(text, SI)
    assert imported.material.bulk_modulus == pytest.approx(20.0 * 3000.0, rel=1e-12)
    assert "replaces D_i = 0" in imported.remarks[0]
    require_our_stress(text, imported.material, imported.material.bulk_modulus, "SI", tmp_path)


@pytest.mark.parametrize(("options", "row", "words"), [
    (", YEOH", "1, 2, 3, 0.5, 0, 0", "line 2: D2 must be absent"),
    (", NEO HOOKE, MODULI=LONG TERM", "1, 0.1", "line 2: the option MODULI"),
    (", NEO HOOKE", "1, 0.1\n*VISCOELASTIC, TIME=PRONY\n0.3, 0, 1", r"line 4: \*VISCOELASTIC in material GEL cannot")])
def test_refused_cards(options, row, words):
    with pytest.raises(ts.InputError, match=words):
        CALCULIX.read(f"*MATERIAL, NAME=GEL\n*HYPERELASTIC{options}\n{row}\n", SI)


@pytest.mark.parametrize("units", UNIT_SYSTEMS)
@pytest.mark.parametrize("law", FOAMS)
def test_force_of_foams(law, units, tmp_path):
    """The cube has one unit of length; `hyperfoam_1` is written with two halves of its term."""
    material = ts.Material(law, FOAMS[law], density=30.0, name="GEL")
    force = total_forces(run(CUBE.format(material=write(CALCULIX, material, units)), tmp_path))[-1, 2]
    expected = material.energy_law.nominal_stress(0.8, FOAMS[law]) / UNIT_SYSTEMS[units].stress
    assert force == pytest.approx(expected, rel=1e-6)
