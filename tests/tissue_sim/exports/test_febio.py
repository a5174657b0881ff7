"""Material section of FEBio: stresses of its formulas, evaluated from the exported text, and documents that are read.

The formulas are those of FEBio 4.11 (``FEMooneyRivlin.cpp``, ``FEYeoh.cpp``, ``FEOgdenMaterial.cpp``,
``FEGentMaterial.cpp``, ``FEVerondaWestmann.cpp``,
``FEUncoupledMaterial.h``, ``FEUncoupledViscoElasticMaterial.cpp``), written here without code of this package.
"""

from xml.etree import ElementTree

import numpy as np
import pytest
from export_materials import BULKS, LAWS, PARAMETERS, STRETCHES, TERMS, our_stress, read, write

import tissue_sim as ts
from tissue_sim.exports.febio import FEBIO
from tissue_sim.exports.unit_systems import SI, UNIT_SYSTEMS

#: Number of the pressure model -> pressure p(J) / K.
PRESSURES = {0: lambda J: np.log(J) / J, 1: lambda J: 0.5 * (J - 1 / J), 2: lambda J: J - 1,
             3: lambda J: 0.5 * (J - 1 / J)}


def numbers(element):
    return {child.tag: float(child.text) for child in element if child.tag not in ("solid", "elastic")}


def deviatoric_stress(element, stretches, J):
    """Deviatoric Cauchy stresses, principal values, of an elastic material, in the units of the file."""
    kind, c = element.attrib["type"], numbers(element)
    if kind == "uncoupled solid mixture":
        return sum(deviatoric_stress(solid, stretches, J) for solid in element.findall("solid"))
    isochoric = stretches / J**(1 / 3)
    B = isochoric**2
    I1 = B.sum()
    if kind == "Mooney-Rivlin":
        stress = 2.0 / J * (B * (c["c1"] + c["c2"] * I1) - c["c2"] * B**2)
    elif kind == "Gent":
        stress = 2.0 / J * B * 0.5 * c["G"] * c["Jm"] / (c["Jm"] - I1 + 3.0)
    elif kind == "Veronda-Westmann":
        W1, W2 = c["c1"] * c["c2"] * np.exp(c["c2"] * (I1 - 3.0)), -0.5 * c["c1"] * c["c2"]
        stress = 2.0 / J * (B * (W1 + W2 * I1) - W2 * B**2)
    elif kind == "Yeoh":
        stress = 2.0 / J * B * sum(c.get(f"c{i}", 0.0) * (I1 - 3.0)**(i - 1) for i in range(1, 7))
    else:
        assert kind == "Ogden"
        stress = sum(c[f"c{i}"] / c[f"m{i}"] * (isochoric**c[f"m{i}"] - 1.0) for i in range(1, 7) if f"c{i}" in c) / J
    return stress - stress.mean()


def stress_of_text(text, stretches, relaxed=None):
    """Principal Cauchy stresses; with relaxation `relaxed` s after a sudden strain."""
    material = ElementTree.fromstring(text).find("Material/material")
    outer, J = numbers(material), float(np.prod(stretches))
    pressure = outer["k"] * PRESSURES[int(outer["pressure_model"])](J)
    elastic, factor = material, 1.0
    if relaxed is not None:
        assert material.attrib["type"] == "uncoupled viscoelastic"
        elastic = material.find("elastic")
        factor = outer["g0"] + sum(outer[f"g{i}"] * np.exp(-relaxed / outer[f"t{i}"]) for i in range(1, 7)
                                   if f"g{i}" in outer)
    return factor * deviatoric_stress(elastic, stretches, J) + pressure


@pytest.mark.parametrize("units", UNIT_SYSTEMS)
@pytest.mark.parametrize("bulk", BULKS, ids=lambda bulk: bulk.kind)
@pytest.mark.parametrize("law", LAWS["febio"])
def test_stresses_of_the_text_are_ours(law, bulk, units):
    """Uniaxial stretch with lateral stretches that change the volume by up to 1 %."""
    material = ts.Material(law, PARAMETERS[law], bulk, name="gel")
    text = write(FEBIO, material, units)
    K = material.bulk_modulus if bulk.value is not None else 1e4 * material.mu0
    for stretch in STRETCHES:
        for J in (0.99, 1.0, 1.003):
            stretches = np.array([stretch, np.sqrt(J / stretch), np.sqrt(J / stretch)])
            found = stress_of_text(text, stretches) * UNIT_SYSTEMS[units].stress
            ours = our_stress(material, K, stretches)
            deviatoric = np.abs(ours - ours.mean()).max()
            np.testing.assert_allclose(found, ours, rtol=0.0, atol=1e-6 * max(deviatoric, 1e-3 * material.mu0))


@pytest.mark.parametrize("moduli", ["instantaneous", "long_term"])
@pytest.mark.parametrize("law", ["reduced_polynomial_2", "biderman", "ogden_2", "gent", "fung_demiray"])
def test_relaxation_of_the_text_is_ours(law, moduli):
    series = ts.Prony(TERMS, moduli)
    material = ts.Material(law, PARAMETERS[law], ts.Bulk("K_Pa", 4.3e6), name="gel", viscoelastic=series)
    stretches, text = np.array([0.8, 1.118, 1.118]), write(FEBIO, material)
    for time in (0.0, 0.5, 10.0, 1e9):
        factor = series.instantaneous_over_law_modulus_ratio * float(series.compute_relative_relaxation_modulus(time))
        np.testing.assert_allclose(stress_of_text(text, stretches, relaxed=time),
                                   our_stress(material, 4.3e6, stretches, factor), rtol=1e-12)


def test_the_document_is_complete():
    material = ts.Material("ogden_1", {"mu1": 1500.0, "alpha1": 3.0}, ts.Bulk("K_Pa", 4e6), 1040.0, "gel")
    root = ElementTree.fromstring(write(FEBIO, material, "mm-N-MPa"))
    assert root.tag == "febio_spec" and root.attrib == {"version": "4.0"}
    assert root.find("Module").attrib == {"type": "solid"}
    element = root.find("Material/material")
    assert element.attrib == {"id": "1", "name": "GEL", "type": "Ogden"}
    assert numbers(element) == pytest.approx(
        {"density": 1.04e-9, "k": 4.0, "pressure_model": 2, "c1": 0.003, "m1": 3.0})


def test_remarks_are_valid_comments():
    text = FEBIO.write(ts.exports.ExportContent((ts.Material("neo_hooke", {"C10": 1500.0}),),
                                                remarks=("force error with --match 2 %",)))
    assert "with - -match 2 %" in text and ElementTree.fromstring(text).tag == "febio_spec"


def test_the_series_of_febio_is_another_one():
    """W1 = mu sum of i^2 C_i (I1/N)^(i - 1) in FEArrudaBoyce.cpp, and mu sum of i C_i (I1/lambda_m^2)^(i - 1) here."""
    with pytest.raises(ts.InputError, match="the law 'arruda_boyce': the stress of its type Arruda-Boyce"):
        write(FEBIO, ts.Material("arruda_boyce", PARAMETERS["arruda_boyce"]))


def test_the_tangent_of_gent_is_remarked():
    assert "converges slowly" in " ".join(write(FEBIO, ts.Material("gent", PARAMETERS["gent"])).split())


def document(*lines, kind="Mooney-Rivlin", attributes=""):
    inner = "\n".join(lines)
    return (f'<febio_spec version="4.0">\n<Material>\n<material id="1" name="GEL" type="{kind}"{attributes}>\n{inner}\n'
            "</material>\n</Material>\n</febio_spec>\n")


@pytest.mark.parametrize(("stated", "words"), [
    ("", "K/2 (ln J)^2"), ("<pressure_model>default</pressure_model>", "1.5 |J - 1|"),
    ("<pressure_model>NIKE3D</pressure_model>", "0.5 |J - 1|")])
def test_another_pressure_model_is_remarked(stated, words):
    [imported] = FEBIO.read(document("<k>1e6</k>", "<c1>1000</c1>", stated), SI)
    assert imported.material.law == "neo_hooke" and imported.material.bulk_modulus == 1e6
    assert words in imported.remarks[0]


def test_a_document_of_febio_studio():
    """All six terms are written, absent ones with the coefficient 0; the number is not normalised."""
    terms = "".join(f"<g{i}>{0.5 if i == 1 else 0}</g{i}><t{i}>{3 if i == 1 else 1}</t{i}>" for i in range(1, 7))
    ogden = "".join(f"<c{i}>{2000 if i == 1 else 0}</c{i}><m{i}>{4 if i == 1 else 2}</m{i}>" for i in range(1, 7))
    material = read(FEBIO, document("<density>1</density><k>1e6</k><pressure_model>Abaqus</pressure_model>",
                                    f'<g0>0.75</g0>{terms}<elastic type="Ogden"><density>1</density><k>0</k>{ogden}'
                                    "</elastic>", kind="uncoupled viscoelastic"))
    assert (material.law, dict(material.parameters)) == ("ogden_1", {"mu1": 1250.0, "alpha1": 4.0})
    assert (material.mu0, material.mu_long_term) == pytest.approx((1250.0, 750.0))
    assert material.viscoelastic == ts.Prony((ts.PronyTerm(0.4, 3.0),)) and material.density == 1.0


@pytest.mark.parametrize(("text", "words"), [
    (document("<k>1</k><E>3</E>"), "line 4: <E> in <material> cannot be imported"),
    (document("<k>1</k><c1>a*X</c1>"), "line 4: must be a finite number; got 'a"),
    (document("<k>1</k><c1 type='map'>m</c1>"), "line 4: the attribute type of <c1>"),
    (document("<k>1</k><c1>1</c1><c1>2</c1>"), "line 4: <c1> occurs twice"),
    (document("<c1>1</c1>"), "line 3: bulk.K_Pa: must be positive"),
    (document("<k>1</k><c1>-1</c1>"), "line 3: parameters: must give a positive shear modulus"),
    (document("<k>1</k><c1>1</c1><pressure_model>7</pressure_model>"), "line 4: pressure_model must be 0 to 3"),
    (document("<k>1</k><E>1</E>", kind="neo-Hookean"), "line 3: the type 'neo-Hookean' of <material> has no"),
    (document("<k>1</k><c1>1</c1><c4>1</c4>", kind="Yeoh"), "line 3: c4 must be 0"),
    (document("<k>1</k><g1>0.5</g1>", kind="uncoupled viscoelastic"), "line 3: <material> must contain <elastic>"),
    (document("<k>1</k>", '<elastic type="Mooney-Rivlin"><k>5</k><c1>1</c1></elastic>', kind="uncoupled viscoelastic"),
     "line 5: k must be stated in the outer material only"),
    (document("<k>1</k><g1>-0.5</g1>", '<elastic type="Mooney-Rivlin"><c1>1</c1></elastic>',
              kind="uncoupled viscoelastic"), "line 3: g: must be a fraction"),
    (document("<k>1</k>", '<solid type="Ogden"><c1>1</c1></solid>', kind="uncoupled solid mixture"),
     "line 5: the type 'Ogden' in a mixture"),
    (document("<k>1</k>", '<solid type="Veronda-Westmann"><c1>2</c1><c2>3</c2></solid>',
              kind="uncoupled solid mixture"), "line 3: the type Veronda-Westmann must be added .* c2 = 3, which"),
    (document("<k>1</k><c1>2</c1><c2>3</c2>", kind="Veronda-Westmann"), "line 3: the type 'Veronda-Westmann' of"),
    (document("<k>1</k><mu>2</mu><N>3</N>", kind="Arruda-Boyce"), "line 3: the type 'Arruda-Boyce' of"),
    (document("<k>1</k>", '<solid type="uncoupled solid mixture"/>', kind="uncoupled solid mixture"),
     "line 5: a mixture must not contain mixtures"),
    (document("<k>1</k>", attributes=' from="b.feb"'), "line 3: the attribute from"),
    (document("<k>1</k>").replace('"4.0"', '"2.5"'), "line 1: version must be 3.0 or 4.0; got '2.5'"),
    ('<febio_spec version="4.0"><Material from="a.feb"/></febio_spec>', "line 1: <Material> refers to another file"),
    ('<febio_spec version="4.0"><Include>a.feb</Include></febio_spec>', "line 1: <Include> refers to another file"),
    ('<febio_spec version="4.0"></febio_spec>', "line 1: the document contains no <material>"),
    ("<other/>", "line 1: the root must be <febio_spec>"),
    ('<!DOCTYPE a [<!ENTITY b "c">]><febio_spec/>', "line 1: a document type definition is not supported"),
    ("<febio_spec>\n<a>\n", "line 3: is not valid XML")])
def test_refused_documents(text, words):
    with pytest.raises(ts.InputError, match=words):
        FEBIO.read(text, SI)
