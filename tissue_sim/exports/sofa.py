"""Export of materials as a Python fragment of a SOFA scene.

Source of the formulas: SOFA v26.06.00, Sofa.Component.SolidMechanics.FEM.HyperElastic, ``material/MooneyRivlin.h`` and
``material/Ogden.h``, function ``deriveSPKTensor``. SOFA's Ogden has mu1/alpha1^2 where this package has
2 mu/alpha^2. Its NeoHookean has no isochoric split, so that a neo-Hookean material is written as Mooney-Rivlin with
c2 = 0. The volumetric term of both is k0/2 (ln J)^2, that of this package K/2 (J - 1)^2; both agree to first order in
J - 1.
"""

from __future__ import annotations

from tissue_sim.errors import InputError
from tissue_sim.exports.target import ExportContent, ExportTarget, format_comment_lines
from tissue_sim.exports.unit_systems import UnitSystem
from tissue_sim.material.material import Material

_HEADER = """\
# Material for SOFA 26.06 (SofaPython3), written by tissue-sim.
# Formulas and order of the parameters are those of the source of SOFA v26.06.00; other documents of SOFA show other
# orders. Not run in SOFA. I1 and I2 are the invariants of C, l1, l2 and l3 its principal stretches, J = l1 l2 l3.
# MooneyRivlin, c1 c2 k0: W = c1 (J^(-2/3) I1 - 3) + c2 (J^(-4/3) I2 - 3) + k0/2 (ln J)^2
# Ogden, mu1 alpha1 k0: W = mu1/alpha1^2 (J^(-alpha1/3) (l1^alpha1 + l2^alpha1 + l3^alpha1) - 3) + k0/2 (ln J)^2
# The volumetric term of the calibrated material is k0/2 (J - 1)^2, equal to first order in J - 1.
# Ogden needs SOFA 25.12 or later: its tangent was wrong before (SOFA pull request 5748).
# The potential energy that SOFA reports for MooneyRivlin is wrong if J is not 1, because its exponents are integers
# (SOFA issue 4605); the forces are right.
# SOFA has linear tetrahedra, which are too stiff for nearly incompressible materials: refine the mesh until the force
# is constant. ForceFeedback components of SOFA get impulses (SOFA pull request 6117): divide them by the time step.
"""

_FUNCTION = '''

def add_material(node, name="{first}"):
    """Add a material to a node that has a MechanicalObject and a topology of tetrahedra; return the force field."""
    material = MATERIALS[name]
    root = node.getRoot()
    root.addObject("RequiredPlugin", name="Sofa.Component.SolidMechanics.FEM.HyperElastic")
    if "massDensity" in material:
        root.addObject("RequiredPlugin", name="Sofa.Component.Mass")
        node.addObject("MeshMatrixMass", massDensity=material["massDensity"])
    return node.addObject("TetrahedronHyperelasticityFEMForceField", name=name,
                          materialName=material["materialName"], ParameterSet=material["ParameterSet"])
'''


class SofaTarget(ExportTarget):
    """Python function that adds a ``TetrahedronHyperelasticityFEMForceField`` to a node of a SOFA scene."""

    title = "SOFA 26.06"
    suffix = ".py"
    # Poisson's ratio 0.4995; a higher ratio increases the locking of linear tetrahedra more than it improves the law.
    incompressible_bulk_ratio = 1e3

    def write(self, content: ExportContent) -> str:
        """Return the fragment, with the parameters of all materials by label."""
        entries = []
        for label, material in zip(content.labels, content.materials, strict=True):
            self.require_available_parts(material)
            arguments = _make_arguments(material, self.compute_bulk_modulus(material), content.units)
            entries.append(f"    {label!r}: {arguments!r},")
        lines = [*format_comment_lines(self.list_file_remarks(content), "# "), "",
                 "#: Label -> arguments of the force field, and density.", "MATERIALS = {", *entries, "}"]
        return _HEADER + "\n".join(lines) + "\n" + _FUNCTION.format(first=content.labels[0])


def _make_arguments(material: Material, K: float, units: UnitSystem) -> dict[str, str]:
    """Return the arguments of the force field for a material with a bulk modulus, Pa, and its density if known."""
    values = material.values
    match material.law:
        case "neo_hooke" | "reduced_polynomial_1":
            name, parameters = "MooneyRivlin", [values[0] / units.stress, 0.0, K / units.stress]
        case "mooney_rivlin":
            name, parameters = "MooneyRivlin", [*(values / units.stress), K / units.stress]
        case "ogden_1":
            name, parameters = "Ogden", [2.0 * values[0] / units.stress, values[1], K / units.stress]
        case _:
            raise InputError(f"SOFA has no material for the law {material.law!r}. Fit neo_hooke, mooney_rivlin or "
                             "ogden_1", field="to")
    arguments: dict[str, str] = {"materialName": name,
                                         "ParameterSet": " ".join(f"{value:.15g}" for value in parameters)}
    if material.density is not None:
        arguments["massDensity"] = f"{material.density / units.density:.15g}"
    return arguments


SOFA = SofaTarget()
