"""Export of materials as Python code for FElupe.

FElupe's ``neo_hooke``, ``mooney_rivlin``, ``yeoh``, ``third_order_deformation`` and ``ogden`` have the convention of
this package: isochoric invariants, and 2 mu/alpha^2 in each term of Ogden. Its ``Volumetric`` and
``NearlyIncompressible`` have U(J) = K/2 (J - 1)^2. The energies of other laws are written out for automatic
differentiation. ``OgdenRoxburgh`` is the softening of the form erf. Source: FElupe 11.3, ``felupe/constitution``.
"""

from __future__ import annotations

import re

from tissue_sim.errors import InputError
from tissue_sim.exports.target import ExportContent, ExportTarget, format_comment_lines
from tissue_sim.exports.unit_systems import UnitSystem
from tissue_sim.laws import InvariantLaw, Law, StretchLaw
from tissue_sim.material.material import Material
from tissue_sim.material.softening import Softening

#: Functions of `tensortrax.math` that the energy of a law may use.
_MATH = frozenset({"cos", "cosh", "exp", "log", "sin", "sinh", "sqrt", "tan", "tanh"})

_HEADER = """\
# Material for FElupe 11, written by tissue-sim.
# W = isochoric energy + K/2 (J - 1)^2 with K = BULK. Needs {packages}.
# Elements that do not lock: fem.SolidBodyNearlyIncompressible(make_isochoric_material(), field, bulk=BULK[name]), or
# make_mixed_material() on fem.FieldsMixed(region, n=3). make_material() is for displacement fields.
"""

_FUNCTIONS = '''

def make_isochoric_material(name="{first}"):
    """Return the isochoric part of a material."""
    return ISOCHORIC[name]()


def make_material(name="{first}"):
    """Return a material with its volumetric part, for a displacement field."""
    return make_isochoric_material(name) & fem.Volumetric(bulk=BULK[name])


def make_mixed_material(name="{first}"):
    """Return a material for a field of displacements, pressures and volume ratios."""
    return fem.NearlyIncompressible(make_isochoric_material(name), bulk=BULK[name])
'''

#: Name of the class of `_ENERGY_CLASS`.
_ENERGY_CLASS_NAME = "EnergyHyperelastic"
#: Class with the energy density that OgdenRoxburgh needs; Hyperelastic of FElupe 11 has its derivatives only.
_ENERGY_CLASS = '''

class EnergyHyperelastic(fem.Hyperelastic):
    """Hyperelastic material with its energy density."""

    def function(self, x):
        C = fem.math.dot(fem.math.transpose(x[0]), x[0])
        return [tr.function(self.fun, ntrax=2)(C, **self.kwargs)]
'''

_INVARIANT_ENERGY = """

def {name}(C, {parameters}):
    scale = det(C) ** (-1 / 3)
    I1 = scale * trace(C)
    I2 = (I1**2 - scale**2 * trace(C @ C)) / 2
    return {energy}
"""

_STRETCH_ENERGY = """

def {name}(C, {parameters}):
    stretch = (det(C) ** (-1 / 3) * eigvalsh(C)) ** 0.5
    return tsum({energy})
"""


class FelupeTarget(ExportTarget):
    """Python module with functions that make the materials of FElupe."""

    title = "FElupe 11"
    suffix = ".py"
    verification = "run in the target"
    incompressible_bulk_ratio = 1e5
    part_remarks = {"viscoelastic": "its finite_strain_viscoelastic splits the deformation of a neo-Hookean solid, "
                                    "ours is a hereditary integral",
                    "softening": "its Ogden-Roxburgh model is the form 'erf', an error function in place of tanh"}
    softening_forms = frozenset({"erf"})

    def write(self, content: ExportContent) -> str:
        """Return the code, with all materials by label."""
        energies, isochoric, bulk, densities = {}, [], [], []
        for label, material in zip(content.labels, content.materials, strict=True):
            self.require_available_parts(material)
            call = _write_call_of_own_law(material, content.units)
            if call is None:
                energies[material.law] = _write_energy_function(material.energy_law)
                call = _write_call_of_energy_function(material, content.units)
            isochoric.append(f"    {label!r}: lambda: {_write_softened_call(call, material.softening, content.units)},")
            bulk.append(f"    {label!r}: {self.compute_bulk_modulus(material) / content.units.stress:.15g},")
            if material.density is not None:
                densities.append(f"    {label!r}: {material.density / content.units.density:.15g},")
        is_differentiated = any("Hyperelastic(" in line for line in isochoric)
        has_energies = any(_ENERGY_CLASS_NAME in line for line in isochoric)
        packages = "the packages felupe and tensortrax" if is_differentiated else "the package felupe"
        tables = ["", "#: Label -> function that returns the isochoric part.", "ISOCHORIC = {", *isochoric, "}",
                  f"#: Label -> bulk modulus K, {content.units.stress_name}.", "BULK = {", *bulk, "}"]
        if densities:
            tables += ["#: Label -> density in the units of this file.", "DENSITY = {", *densities, "}"]
        return (_HEADER.format(packages=packages)
                + "".join(line + "\n" for line in format_comment_lines(self.list_file_remarks(content), "# "))
                + "import felupe as fem\n" + "import tensortrax as tr\n" * has_energies
                + _write_imports("".join(energies.values())) + _ENERGY_CLASS * has_energies
                + "".join(energies.values()) + "\n" * (bool(energies) or has_energies) + "\n".join(tables) + "\n"
                + _FUNCTIONS.format(first=content.labels[0]))


def _write_call_of_own_law(material: Material, units: UnitSystem) -> str | None:
    """Return the call that makes the isochoric part by a law of FElupe; None if FElupe does not have the law."""
    values = [float(value) for value in material.values]
    name, series = material.law, re.fullmatch(r"(reduced_polynomial|ogden)_(\d+)", material.law)
    if name in ("neo_hooke", "reduced_polynomial_1"):
        return f"fem.NeoHooke(mu={2.0 * values[0] / units.stress:.15g})"
    if name == "mooney_rivlin":
        function, arguments = name, dict(zip(("C10", "C01"), values, strict=True))
    elif name == "biderman":
        function = "third_order_deformation"
        arguments = {**dict.fromkeys(("C10", "C01", "C11", "C20", "C30"), 0.0), **material.parameters}
    elif series and series[1] == "ogden":
        moduli = ", ".join(f"{modulus / units.stress:.15g}" for modulus in values[::2])
        exponents = ", ".join(f"{exponent:.15g}" for exponent in values[1::2])
        return f"fem.Hyperelastic(fem.ogden, mu=[{moduli}], alpha=[{exponents}])"
    elif series and int(series[2]) <= 3:
        function, arguments = "yeoh", dict(zip(("C10", "C20", "C30"), [*values, 0.0, 0.0], strict=False))
    else:
        return None
    listed = ", ".join(f"{key}={value / units.stress:.15g}" for key, value in arguments.items())
    return f"fem.Hyperelastic(fem.{function}, {listed})"


def _write_softened_call(call: str, softening: Softening | None, units: UnitSystem) -> str:
    """Return the call that makes the isochoric part with softening of the form erf, from that without softening.

    Raises:
        InputError: the modulus of the softening is 0, for which FElupe divides 0 by 0 at rest.
    """
    if softening is None or softening.loss == 0.0:
        return call
    if softening.modulus == 0.0:
        raise InputError("softening.modulus must be above 0, because FElupe divides by it at rest; got 0. Use a small "
                         "modulus, such as 1e-6 times the shear modulus", field="to")
    base = call.replace("fem.Hyperelastic(", f"{_ENERGY_CLASS_NAME}(")
    return (f"fem.OgdenRoxburgh({base}, r={1.0 / softening.loss:.15g}, m={softening.modulus / units.stress:.15g}, "
            f"beta={softening.share:.15g})")


def _write_energy_function(law: Law) -> str:
    """Return the text of a function of C that computes the isochoric energy of a law."""
    parameters, energy = ", ".join(law.parameters), str(law.formula_expression())
    if isinstance(law, InvariantLaw):
        return _INVARIANT_ENERGY.format(name=_name_energy_function(law), parameters=parameters, energy=energy)
    if isinstance(law, StretchLaw):
        # `formula_expression` has the variable lambda, a keyword of Python.
        energy = re.sub(r"\blambda\b", "stretch", energy)
        return _STRETCH_ENERGY.format(name=_name_energy_function(law), parameters=parameters, energy=energy)
    raise InputError(f"FElupe has no form for the law {law.name!r}, which is neither an InvariantLaw nor a StretchLaw. "
                     "Fit another law", field="to")


def _write_call_of_energy_function(material: Material, units: UnitSystem) -> str:
    """Return the call that makes the isochoric part by the function of `_write_energy_function`."""
    law = material.energy_law
    listed = ", ".join(f"{name}={value / (units.stress if law.units[name] == 'Pa' else 1.0):.15g}"
                       for name, value in zip(law.parameters, material.values, strict=True))
    return f"fem.Hyperelastic({_name_energy_function(law)}, {listed})"


def _name_energy_function(law: Law) -> str:
    """Return the name of the function of a law in the written code."""
    return "compute_energy_of_" + re.sub(r"\W", "_", law.name)


def _write_imports(energies: str) -> str:
    """Return the imports of the functions of tensortrax that the texts of energy functions use.

    Raises:
        InputError: an energy uses a function that tensortrax does not have.
    """
    used = set(re.findall(r"\b(?<!def )(\w+)\(", energies))
    functions = sorted(used & {*_MATH, "trace"}) + ["sum as tsum"] * ("tsum" in used)
    linear = sorted(used & {"det", "eigvalsh"})
    if unknown := sorted(used - {*_MATH, "trace", "tsum", *linear}):
        raise InputError(f"the energy of the law must use {', '.join(sorted(_MATH))} only; got {', '.join(unknown)}. "
                         "Fit another law", field="to")
    return "".join(f"from {module} import {', '.join(names)}\n" for module, names in (
        ("tensortrax.math", functions), ("tensortrax.math.linalg", linear)) if names)


FELUPE = FelupeTarget()
