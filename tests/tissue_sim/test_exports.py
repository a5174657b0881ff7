"""Materials for other programs: the numbers in the text, and CalculiX's answer to them."""

import re
import shutil
import subprocess

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.exports import ExportContent
from tissue_sim.exports.abaqus import ABAQUS

BULK = ts.Bulk("bulk_ratio", 50.0)
MATERIALS = {
    "neo_hooke": ts.Material("neo_hooke", {"C10": 1500.0}, BULK),
    "mooney_rivlin": ts.Material("mooney_rivlin", {"C10": 800.0, "C01": 760.0}, BULK),
    "yeoh": ts.Material("reduced_polynomial_3", {"C10": 1404.9, "C20": 699.4, "C30": 30.0}, BULK),
    "biderman": ts.Material("biderman", {"C10": 900.0, "C01": 500.0, "C20": 699.4, "C30": 30.0}, BULK),
    "ogden": ts.Material("ogden_2", {"mu1": 1500.0, "alpha1": 3.0, "mu2": 800.0, "alpha2": -2.5}, BULK),
}
#: A cube of 1 m between three planes of symmetry, compressed by 20 %.
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
{material}*SOLID SECTION, ELSET=CUBE, MATERIAL={name}
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


def export(material):
    return ABAQUS.write(ExportContent((material,)))


def strip_comments(text):
    return re.sub(r"^\*\*.*\n", "", text, flags=re.MULTILINE)


def label(text):
    return re.search(r"NAME=(\w+)", text)[1]


def test_numbers_are_those_of_the_manual():
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("K_Pa", 4e6), 1040.0,
                           "brain 3", viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0), ts.PronyTerm(0.1, 40.0)),
                                                            "long_term"))
    assert strip_comments(export(material)) == ("*MATERIAL, NAME=BRAIN_3\n"
                                "*HYPERELASTIC, REDUCED POLYNOMIAL, N=2, MODULI=LONG TERM\n"
                                "1404.9, 699.4, 5e-07, 1e+20\n"
                                "*VISCOELASTIC, TIME=PRONY\n0.3, 0, 2\n0.1, 0, 40\n*DENSITY\n1040\n")
    incompressible = export(ts.Material("ogden_3", {"mu1": 1.0, "alpha1": 2.0, "mu2": 3.0, "alpha2": 4.0, "mu3": 5.0,
                                                    "alpha3": 6.0}))
    full = export(ts.Material("biderman", {"C10": 1.0, "C01": 2.0, "C20": 3.0, "C30": 4.0}))
    assert strip_comments(full) == ("*MATERIAL, NAME=BIDERMAN\n*HYPERELASTIC, POLYNOMIAL, N=3\n"
                                    "1, 2, 3, 0, 0, 4, 0, 0\n0, 0, 0, 0\n")
    assert strip_comments(incompressible) == ("*MATERIAL, NAME=OGDEN_3\n*HYPERELASTIC, OGDEN, N=3\n"
                                              "1, 2, 3, 4, 5, 6, 0, 0\n0\n")


@pytest.mark.parametrize(("part", "words"), [
    ({"softening": ts.Softening(0.3, 50.0)}, "error function"), ({"layers": (ts.Layer(2e-3, 2.0),)}, "layers"),
    ({"puncture": ts.Puncture(5e-3, 0.2)}, "puncture"), ({"poroelasticity": ts.Poroelasticity(0.2, 1e-9)}, "drainage")])
def test_what_has_no_form_there_is_refused(part, words):
    with pytest.raises(ts.InputError, match=words):
        export(ts.Material("neo_hooke", {"C10": 1500.0}, **part))


@pytest.mark.parametrize("name", MATERIALS)
def test_calculix_gives_our_force(name, tmp_path):
    """Free uniaxial compression of one element, against our energy with the lateral stretch that leaves no stress."""
    if shutil.which("ccx") is None:
        pytest.skip("compares with CalculiX, a system package that pip cannot install; ccx is not on PATH. Debian: "
                    "apt install calculix-ccx. .ci/run installs it")
    material, text = MATERIALS[name], export(MATERIALS[name])
    (tmp_path / "cube.inp").write_text(CUBE.format(material=text, name=label(text)), encoding="utf-8")
    done = subprocess.run(["ccx", "cube"], cwd=tmp_path, capture_output=True, text=True, encoding="utf-8", timeout=120)
    answer = (tmp_path / "cube.dat").read_text(encoding="utf-8")
    assert done.returncode == 0 and answer, done.stdout
    total = [float(number) for number in re.findall(r"total force.*?\n\n((?:\s+\S+){3})", answer)[-1].split()]
    lateral = 1.0 + float(re.findall(r"^\s+7\s+(\S+)", answer, re.MULTILINE)[-1])
    stretches = np.array([lateral, lateral, 0.8])
    J = np.prod(stretches)
    K = material.bulk_modulus
    tau = material.energy_law.compute_energy_and_kirchhoff_stresses(stretches,
                                                                    material.parameters)[1] + K * J * (J - 1.0)
    assert tau[0] == pytest.approx(0.0, abs=1e-3 * abs(tau[2]))
    assert total[2] == pytest.approx(tau[2] / 0.8, rel=1e-4)
