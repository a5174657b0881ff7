"""Material section of FEBio 4: materials are written and read.

Source: FEBio User's Manual 4, "Uncoupled elastic solids" and "Uncoupled viscoelastic"; classes ``FEUncoupledMaterial``,
``FEMooneyRivlin``, ``FEYeoh``, ``FEOgdenMaterial``, ``FEGentMaterial``, ``FEVerondaWestmann``, ``FEArrudaBoyce``,
``FEUncoupledElasticMixture`` and ``FEUncoupledViscoElasticMaterial`` of FEBio 4.11.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

from tissue_sim.errors import InputError
from tissue_sim.exports.target import ExportContent, ExportTarget, ImportedMaterial, format_comment_lines
from tissue_sim.exports.unit_systems import UnitSystem
from tissue_sim.exports.xml_elements import XmlElement, parse_xml
from tissue_sim.laws import find_law
from tissue_sim.material.material import Bulk, Material
from tissue_sim.material.viscoelasticity import Prony, PronyTerm

#: Number of the pressure model with U(J) = K/2 (J - 1)^2.
_QUADRATIC_PRESSURE = 2
#: Name in lower case or number of a pressure model -> its number.
_PRESSURE_MODELS = {"default": 0, "nike3d": 1, "abaqus": 2, "abaqus (goh)": 3, "0": 0, "1": 1, "2": 2, "3": 3}
#: Number of a pressure model -> formula of U(J), and relative difference of the pressure from K (J - 1) over J - 1.
_OTHER_PRESSURES = {0: ("K/2 (ln J)^2", 1.5), 1: ("K/4 (J^2 - 1 - 2 ln J)", 0.5), 3: ("K/4 (J^2 - 1 - 2 ln J)", 0.5)}
#: Largest number of terms of a series in FEBio.
_MAX_TERMS = 6
#: Type of an elastic material -> names of its parameters.
_PARAMETERS = {
    "Mooney-Rivlin": ("c1", "c2"),
    "incomp neo-Hookean": ("G",),
    "Gent": ("G", "Jm"),
    "Yeoh": tuple(f"c{i}" for i in range(1, _MAX_TERMS + 1)),
    "Ogden": tuple(f"{letter}{i}" for letter in "cm" for i in range(1, _MAX_TERMS + 1))}
#: Type of a sum of elastic materials.
_MIXTURE = "uncoupled solid mixture"
#: Type with W = c1 (exp(c2 (I1 - 3)) - 1) - c1 c2/2 (I2 - 3), which is read as a part of a sum only.
_VERONDA_WESTMANN = "Veronda-Westmann"
#: Law -> type of its elastic material.
_TYPES = {"neo_hooke": "Mooney-Rivlin", "mooney_rivlin": "Mooney-Rivlin", "biderman": _MIXTURE,
          "gent": "Gent", "fung_demiray": _MIXTURE,
          **{f"reduced_polynomial_{n}": "Yeoh" for n in (1, 2, 3)}, **{f"ogden_{n}": "Ogden" for n in (1, 2, 3, 4)}}
#: Type of a series -> largest number of terms of the laws of this package.
_READ_TERMS = {"Yeoh": 3, "Ogden": 4}
#: Law without equivalent -> reason, if FEBio has a type of its name.
_DIFFERENT_TYPES = {
    "arruda_boyce": "the stress of its type Arruda-Boyce has the i-th term of the series times i (FEArrudaBoyce.cpp)"}
#: Tangent of the type Gent.
_GENT_REMARK = ("The tangent of the type Gent in FEBio 4.11 lacks the second derivative of W (FEGentMaterial.cpp). The "
                "stress is exact, but Newton's method converges slowly.")
#: Type of a material with relaxation.
_VISCOELASTIC = "uncoupled viscoelastic"
#: Names of the parameters of a material with relaxation.
_SERIES = ("g0", *(f"{letter}{i}" for letter in "gt" for i in range(1, _MAX_TERMS + 1)))
#: Coefficients of the type Yeoh, for which program and manual differ.
_YEOH_REMARK = ("The stress of the type Yeoh in FEBio 4.4 to 4.11 has dW/dI1 = c1 + c2 (I1 - 3) + c3 (I1 - 3)^2 "
                "(FEYeoh.cpp), but the manual states W = c1 (I1 - 3) + c2 (I1 - 3)^2 + c3 (I1 - 3)^3. The stress "
                "decides: c1 = C10, c2 = 2 C20, c3 = 3 C30. A version with the stress of the manual needs c2 = C20, "
                "c3 = C30.")
#: Rounding of the sum of relative moduli in a file, 1.
_ROUNDING = 1e-12


class FebioTarget(ExportTarget):
    """Material section of FEBio: uncoupled materials with the pressure model K/2 (J - 1)^2.

    The hereditary integral of FEBio acts on the second Piola-Kirchhoff stress, as in this package.
    """

    title = "FEBio 4"
    suffix = ".feb"
    parts = frozenset({"viscoelastic"})
    incompressible_bulk_ratio = 1e4

    def write(self, content: ExportContent) -> str:
        """Return a document with one material for each material of the content."""
        remarks = [remark.replace("--", "- -") for remark in self.list_file_remarks(content)]
        lines = ['<?xml version="1.0" encoding="UTF-8"?>', *(f"{line} -->" for line in
                                                             format_comment_lines(remarks, "<!-- ")),
                 '<febio_spec version="4.0">', '  <Module type="solid"/>', "  <Material>"]
        for number, (label, material) in enumerate(zip(content.labels, content.materials, strict=True), start=1):
            self.require_available_parts(material)
            lines += self._list_material_lines(material, f'id="{number}" name="{label}"', content.units)
        return "\n".join([*lines, "  </Material>", "</febio_spec>"]) + "\n"

    def list_file_remarks(self, content: ExportContent) -> tuple[str, ...]:
        """Return the remarks of a file, with the convention of the type Yeoh and the tangent of the type Gent."""
        has_yeoh = any("C20" in material.parameters for material in content.materials)
        has_gent = any(material.law == "gent" for material in content.materials)
        return (*super().list_file_remarks(content), *([_YEOH_REMARK] if has_yeoh else ()),
                *([_GENT_REMARK] if has_gent else ()))

    def _list_material_lines(self, material: Material, attributes: str, units: UnitSystem) -> list[str]:
        """Return the lines of one material."""
        kind, law_lines = _list_law_lines(material, units)
        outer = [] if material.density is None else [_format_element("density", material.density / units.density)]
        outer += [_format_element("k", self.compute_bulk_modulus(material) / units.stress),
                  f"<pressure_model>{_QUADRATIC_PRESSURE}</pressure_model>"]
        if (relaxation := material.viscoelastic) is not None:
            if len(relaxation.terms) > _MAX_TERMS:
                raise InputError(f"{self.title} has at most {_MAX_TERMS} relaxing terms; the material has "
                                 f"{len(relaxation.terms)}. Use fewer terms", field="to")
            is_instantaneous = relaxation.moduli == "instantaneous"
            long_term = 1.0 - relaxation.relaxing_fraction
            outer.append(_format_element("g0", long_term if is_instantaneous else 1.0))
            for number, term in enumerate(relaxation.terms, start=1):
                outer += [_format_element(f"g{number}", term.g if is_instantaneous else term.g / long_term),
                          _format_element(f"t{number}", term.tau)]
            law_lines = [f'<elastic type="{kind}">', *(f"  {line}" for line in law_lines), "</elastic>"]
            kind = _VISCOELASTIC
        return [f'    <material {attributes} type="{kind}">', *(f"      {line}" for line in [*outer, *law_lines]),
                "    </material>"]

    def split_materials(self, text: str) -> dict[str, XmlElement]:
        """Return name -> element of each material.

        Raises:
            InputError: the text is no document of FEBio 3 or 4, has no material, or refers to another file.
        """
        root = parse_xml(text, "a document of FEBio")
        if root.tag != "febio_spec":
            raise InputError(f"the root must be <febio_spec>; got <{root.tag}>.", line=root.line)
        version = root.attributes.get("version", "")
        if not re.fullmatch(r"[34](\.\d+)?", version, re.ASCII):
            raise InputError(f"version must be 3.0 or 4.0; got {version!r}. Save the file with FEBio Studio",
                             line=root.line)
        found: dict[str, XmlElement] = {}
        for section in root.children:
            if section.tag == "Include" or (section.tag == "Material" and "from" in section.attributes):
                raise InputError(f"<{section.tag}> refers to another file. Write the whole content into one file",
                                 line=section.line)
            for element in section.children if section.tag == "Material" else ():
                if element.tag != "material":
                    raise InputError(f"<Material> must contain <material> only; got <{element.tag}>.",
                                     line=element.line)
                name = element.attributes.get("name") or f"material {element.attributes.get('id', len(found) + 1)}"
                if name in found:
                    raise InputError(f"material {name} is defined twice. Rename one", line=element.line)
                found[name] = replace(element, attributes={**element.attributes, "name": name})
        if not found:
            raise InputError("the document contains no <material>", line=root.line)
        return found

    def read_material(self, section: XmlElement, units: UnitSystem) -> ImportedMaterial:
        """Return the material of an element ``<material>``."""
        name, kind = section.attributes["name"], section.attributes.get("type", "")
        section.require_attributes(("id", "name", "type"))
        is_relaxing = kind == _VISCOELASTIC
        if not is_relaxing:
            _require_known_type(section)
        parts = {_VISCOELASTIC: ("elastic",), _MIXTURE: ("solid",)}.get(kind, _PARAMETERS.get(kind, ()))
        known = ("density", "k", "pressure_model", *(_SERIES if is_relaxing else ()), *parts)
        section.require_children(known, repeated=("solid",))
        scale, relaxation = 1.0, None
        elastic = section
        if is_relaxing:
            elastic = section.get_child("elastic")
            scale, relaxation = _read_relaxation(section)
        law, parameters = _read_law(elastic, is_nested=elastic is not section)
        declared = find_law(law).units
        remarks = [f"{name}: {_YEOH_REMARK}"] if "C20" in parameters else []
        number = _read_pressure_model(section)
        if number in _OTHER_PRESSURES:
            formula, slope = _OTHER_PRESSURES[number]
            remarks.append(f"{name}: U(J) is {formula} in the file and K/2 (J - 1)^2 in this package. The pressures "
                           f"differ by a fraction of {slope:g} |J - 1|.")
        K = section.read_number("k", 0.0) * units.stress
        density = section.read_number("density", 0.0) * units.density if section.find_child("density") else None
        try:
            material = Material(law, {key: value * (scale * units.stress if declared[key] == "Pa" else 1.0)
                                      for key, value in parameters.items()},
                                Bulk("K_Pa", K), density, name, viscoelastic=relaxation)
        except InputError as error:
            raise InputError(error.problem, line=section.line, field=error.field) from None
        return ImportedMaterial(material, tuple(remarks))


def _format_element(tag: str, value: float) -> str:
    """Return an element with a number of 15 digits."""
    return f"<{tag}>{value:.15g}</{tag}>"


def _list_law_lines(material: Material, units: UnitSystem) -> tuple[str, list[str]]:
    """Return the type of the elastic material of a law, and the lines of its parameters.

    Raises:
        InputError: FEBio has no such law.
    """
    if material.law not in _TYPES:
        reason = f": {_DIFFERENT_TYPES[material.law]}" if material.law in _DIFFERENT_TYPES else ""
        raise InputError(f"FEBio has no equivalent of the law {material.law!r}{reason}; fit another law, or write a "
                         "plug-in of FEBio", field="to")
    kind = _TYPES[material.law]
    values = dict(zip(material.energy_law.parameters, material.values, strict=True))
    stresses = {name: value / units.stress for name, value in values.items()}
    if kind == "Mooney-Rivlin":
        return kind, [_format_element("c1", stresses["C10"]),
                      _format_element("c2", stresses.get("C01", 0.0))]
    if kind == "Yeoh":
        return kind, [_format_element(f"c{i}", i * value) for i, value in enumerate(stresses.values(), start=1)]
    if kind == "Gent":
        return kind, [_format_element("G", stresses["mu"]), _format_element("Jm", values["J_m"])]
    if kind == _MIXTURE and material.law == "fung_demiray":
        # The Mooney-Rivlin part cancels the term of I2.
        mu, b = stresses["mu"], values["b"]
        return kind, _list_mixture_lines({_VERONDA_WESTMANN: {"c1": mu / (2.0 * b), "c2": b},
                                          "Mooney-Rivlin": {"c1": 0.0, "c2": mu / 4.0}})
    if kind == _MIXTURE:
        return kind, _list_mixture_lines({
            "Mooney-Rivlin": {"c1": stresses["C10"], "c2": stresses["C01"]},
            "Yeoh": {"c1": 0.0, "c2": 2.0 * stresses["C20"], "c3": 3.0 * stresses["C30"]}})
    # FEBio: W = sum of c_i / m_i^2 (...); this package: W = sum of 2 mu_i / alpha_i^2 (...).
    return kind, [line for i in range(1, len(values) // 2 + 1) for line in (
        _format_element(f"c{i}", 2.0 * stresses[f"mu{i}"]), _format_element(f"m{i}", values[f"alpha{i}"]))]


def _list_mixture_lines(solids: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return the lines of the parts of a sum; `solids` is type -> parameters, in the units of the file."""
    return [line for solid, coefficients in solids.items() for line in (
        f'<solid type="{solid}">', *(f"  {_format_element(name, c)}" for name, c in coefficients.items()),
        "</solid>")]


def _require_known_type(element: XmlElement) -> None:
    """Raise an `InputError` if the elastic material of an element has no equivalent in this package."""
    kind = element.attributes.get("type", "")
    if kind not in (*_PARAMETERS, _MIXTURE):
        raise InputError(f"the type {kind!r} of <{element.tag}> has no equivalent; known: "
                         f"{', '.join((*_PARAMETERS, _MIXTURE, _VISCOELASTIC))}.", line=element.line)


def _read_law(element: XmlElement, *, is_nested: bool) -> tuple[str, dict[str, float]]:
    """Return the law of an elastic material and its parameters, in the units of the file.

    Args:
        element: elastic material.
        is_nested: whether the element is part of another material, which states k, pressure model and density.
    """
    _require_known_type(element)
    kind = element.attributes["type"]
    if is_nested:
        element.require_attributes(("type",))
        element.require_children(("density", "k", "pressure_model", *_PARAMETERS.get(kind, ("solid",))),
                                 repeated=("solid",))
        _require_no_own_bulk_modulus(element)
    if kind == _MIXTURE:
        return _read_mixture(element)
    values = {name: element.read_number(name, 1.0 if name[0] == "m" else 0.0) for name in _PARAMETERS[kind]}
    if kind == "incomp neo-Hookean":
        return "neo_hooke", {"C10": 0.5 * values["G"]}
    if kind == "Gent":
        return "gent", {"mu": values["G"], "J_m": values["Jm"]}
    if kind == "Mooney-Rivlin":
        return (("neo_hooke", {"C10": values["c1"]}) if values["c2"] == 0.0
                else ("mooney_rivlin", {"C10": values["c1"], "C01": values["c2"]}))
    # FEBio Studio writes all six terms; absent terms at the end have the coefficient 0.
    count = max((i for i in range(1, _MAX_TERMS + 1) if values[f"c{i}"] != 0.0), default=1)
    if count > _READ_TERMS[kind]:
        raise InputError(f"c{count} must be 0, because the laws of this package have at most {_READ_TERMS[kind]} terms "
                         f"of the type {kind}; got {values[f'c{count}']:g}.", line=element.line)
    if kind == "Yeoh":
        return f"reduced_polynomial_{count}", {f"C{i}0": values[f"c{i}"] / i for i in range(1, count + 1)}
    return f"ogden_{count}", {name: value for i in range(1, count + 1) for name, value in (
        (f"mu{i}", 0.5 * values[f"c{i}"]), (f"alpha{i}", values[f"m{i}"]))}


def _read_mixture(element: XmlElement) -> tuple[str, dict[str, float]]:
    """Return the law of a sum of elastic materials and its parameters, in the units of the file.

    A sum of polynomial energies is the law ``biderman``. The type Veronda-Westmann, with a polynomial that cancels its
    term of I2, is the law ``fung_demiray``.
    """
    total = dict.fromkeys(find_law("biderman").parameters, 0.0)
    exponential: tuple[float, float] | None = None
    for solid in element.children:
        if solid.tag != "solid":
            continue
        kind = solid.attributes.get("type")
        if kind == _MIXTURE:
            raise InputError("a mixture must not contain mixtures.", line=solid.line)
        if kind == _VERONDA_WESTMANN and exponential is None:
            solid.require_attributes(("type",))
            solid.require_children(("density", "k", "pressure_model", "c1", "c2"))
            _require_no_own_bulk_modulus(solid)
            exponential = solid.read_number("c1", 0.0), solid.read_number("c2", 0.0)
            continue
        _, parameters = _read_law(solid, is_nested=True)
        if not parameters.keys() <= total.keys():
            raise InputError(f"the type {kind!r} in a mixture has no equivalent; known: Mooney-Rivlin, incomp "
                             f"neo-Hookean, Yeoh, and one {_VERONDA_WESTMANN}.", line=solid.line)
        for name, value in parameters.items():
            total[name] += value
    if exponential is None:
        return "biderman", total
    c1, c2 = exponential
    if not (abs(total.pop("C01") - 0.5 * c1 * c2) <= _ROUNDING * abs(c1 * c2) and not any(total.values())):
        raise InputError(f"the type {_VERONDA_WESTMANN} must be added to Mooney-Rivlin with c1 = 0 and c2 = "
                         f"{0.5 * c1 * c2:g}, which cancels its term of I2, because this package has no law with this "
                         "term.", line=element.line)
    return "fung_demiray", {"mu": 2.0 * c1 * c2, "b": c2}


def _require_no_own_bulk_modulus(element: XmlElement) -> None:
    """Raise an error if an elastic material inside another material states a bulk modulus."""
    if element.read_number("k", 0.0) != 0.0:
        raise InputError(f"k must be stated in the outer material only; got {element.read_number('k', 0.0):g} in "
                         f"<{element.tag}>.", line=element.line)


def _read_relaxation(element: XmlElement) -> tuple[float, Prony | None]:
    """Return the factor of the elastic material, and the Prony series of a material with relaxation.

    FEBio: S(t) = integral of (g0 + sum of g_i exp(-(t - s) / t_i)) dS_elastic/ds ds.
    """
    values: Mapping[str, float] = {name: element.read_number(name, 0.0 if name[0] == "g" and name != "g0" else 1.0)
                                   for name in _SERIES}
    acting = [i for i in range(1, _MAX_TERMS + 1) if values[f"g{i}"] != 0.0]
    total = values["g0"] + sum(values[f"g{i}"] for i in acting)
    if not acting:
        return total, None
    if not total > 0.0:
        raise InputError(f"the sum of g0 and all g must be positive; got {total:g}.", line=element.line)
    is_instantaneous = abs(total - 1.0) <= _ROUNDING
    is_long_term = values["g0"] == 1.0
    try:
        return (1.0 if is_instantaneous or is_long_term else total,
                Prony(tuple(PronyTerm(values[f"g{i}"] / (1.0 if is_instantaneous else total), values[f"t{i}"])
                            for i in acting), "long_term" if is_long_term else "instantaneous"))
    except InputError as error:
        raise InputError(error.problem, line=element.line, field=error.field) from None


def _read_pressure_model(element: XmlElement) -> int:
    """Return the number of the pressure model of a material."""
    child = element.find_child("pressure_model")
    if child is None:
        return 0
    if child.text.lower() not in _PRESSURE_MODELS:
        raise InputError(f"pressure_model must be 0 to 3; got {child.text!r}.", line=child.line)
    return _PRESSURE_MODELS[child.text.lower()]


FEBIO = FebioTarget()
