"""Export of elastic constants as a flex of MuJoCo, MJCF.

Source: MuJoCo XML reference, ``flexcomp``, ``flex/elasticity``. The law is that of Saint Venant and Kirchhoff;
``damping`` is the damping time of Kelvin and Voigt (Rayleigh damping, in proportion to the stiffness).
"""

from __future__ import annotations

from collections.abc import Iterable
from xml.sax.saxutils import quoteattr

import numpy as np

from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.exports.target import ExportContent, ExportTarget, format_comment_lines
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.mesh.tetrahedral import TetrahedralMesh, make_tetrahedral_mesh

#: Radius of the nodes of a flex in contact, m; a larger one would add to the tissue.
_NODE_RADIUS = 1e-5
#: Density of a flex whose material states none, kg/m3.
_DENSITY = 1000.0


class MujocoTarget(ExportTarget):
    """Flex of MuJoCo: Young's modulus, Poisson's ratio and damping of linear tetrahedra."""

    title = "MuJoCo 4 flex"
    suffix = ".xml"
    verification = "run in the target"
    uses_elastic_constants = True
    writes_mesh = True
    max_poisson = 0.49
    parts = frozenset({"viscoelastic"})
    part_remarks = {"softening": "its flex is elastic"}
    unit_systems = ("SI",)

    def write(self, content: ExportContent) -> str:
        """Return an MJCF model with one flex for each material, or their elements in comments without a mesh."""
        lines = ["<mujoco>", *(f"  <!-- {line} -->" for line in _list_comment_lines(self.list_file_remarks(content))),
                 '  <!-- MuJoCo 4 refuses elastic flexes under the integrators implicit and implicitfast. -->',
                 '  <option integrator="discrete" solver="Newton"/>', '  <size memory="4G"/>', "  <worldbody>"]
        for label, material, constants in zip(content.labels, content.materials, content.constants, strict=True):
            self.require_available_parts(material)
            lines += _list_flex_lines(label, constants, content.mesh)
        return "\n".join([*lines, "  </worldbody>", "</mujoco>"]) + "\n"


def _list_comment_lines(remarks: tuple[str, ...]) -> list[str]:
    """Return the lines of remarks without the two hyphens that end a comment of XML."""
    return [line.replace("--", "- -") for line in format_comment_lines(remarks, "")]


def _list_flex_lines(label: str, constants: ElasticConstants, mesh: SolidMesh | None) -> list[str]:
    """Return the lines of one flex."""
    density = constants.density or _DENSITY
    if mesh is None:
        return [f'    <!-- {label}: put this element into your flexcomp dim="3", whose mass is {density:g} kg/m3 '
                "times its volume: -->", f"    <!-- {make_elasticity_element(constants)} -->"]
    return ["    " + make_flex_element(constants, make_tetrahedral_mesh(mesh), density,
                                       contact='<contact selfcollide="none"/>', name=label)]


def make_elasticity_element(constants: ElasticConstants) -> str:
    """Return the element ``elasticity`` of a flex."""
    return (f'<elasticity young="{constants.young:.15g}" poisson="{constants.poisson:.15g}" '
            f'damping="{constants.damping_time:.15g}"/>')


def make_flex_element(constants: ElasticConstants, mesh: TetrahedralMesh, density: float, *, contact: str,
                      name: str = "tissue") -> str:
    """Return the element ``flexcomp`` of a body that is fixed at its base.

    Args:
        constants: elastic constants and damping.
        mesh: mesh of the body.
        density: kg/m3.
        contact: element ``contact``.
        name: name of the flex.
    """
    return (f'<flexcomp name={quoteattr(name)} type="direct" dim="3" mass="{density * mesh.volume:.15g}" '
            f'radius="{_NODE_RADIUS:g}" point="{format_numbers(mesh.nodes)}" element="{format_numbers(mesh.cells)}">'
            f'{make_elasticity_element(constants)}{contact}<edge equality="false"/>'
            f'<pin id="{format_numbers(mesh.sets["base"])}"/></flexcomp>')


def format_numbers(values: np.ndarray | Iterable[float]) -> str:
    """Return numbers separated by blanks."""
    return " ".join(f"{value:.9g}" for value in np.ravel(np.asarray(values)))


MUJOCO = MujocoTarget()
