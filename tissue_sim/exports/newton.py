"""Export of elastic constants as Python text with a soft body of Newton.

Source: Newton 1.8, ``ModelBuilder.add_soft_mesh`` and the kernels of ``SolverVBD``. ``k_mu`` and ``k_lambda`` are the
constants of Lame at small strains.
"""

from __future__ import annotations

from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.exports.target import ExportContent, ExportTarget, format_comment_lines

#: Density of a body whose material states none, kg/m3.
_DENSITY = 1000.0

_FUNCTION = '''

def add_soft_body(builder, vertices, indices, variant={first!r}, position=(0.0, 0.0, 0.0),
                  particle_radius=1e-6):
    """Add the tissue to a newton.ModelBuilder.

    Args:
        builder: newton.ModelBuilder.
        vertices: positions, m, shape (n, 3).
        indices: indices of the corners of the tetrahedra, shape (4 m,).
        variant: key of CONSTANTS.
        position: position of the origin of the vertices, m.
        particle_radius: radius of the vertices in contact, m.
    """
    import warp as wp

    builder.add_soft_mesh(pos=wp.vec3(*position), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(0.0, 0.0, 0.0),
                          vertices=[wp.vec3(*map(float, vertex)) for vertex in vertices],
                          indices=[int(index) for index in indices], particle_radius=particle_radius,
                          **CONSTANTS[variant])
'''


def compute_k_damp(constants: ElasticConstants) -> float:
    """Return Newton's factor of viscous damping, Pa s: ``k_damp = mu damping_time / 2``.

    `SolverVBD` has the dissipation ``k_damp/2 |dC/dt|^2`` per volume with ``C = F^T F = 1 + 2 E``. Its viscous stress
    is ``4 k_damp dE/dt``; that of Kelvin and Voigt in shear is ``2 mu damping_time dE/dt``. The damping of the volume
    is that of the shear, without the part of lambda.
    """
    return 0.5 * constants.mu * constants.damping_time


class NewtonTarget(ExportTarget):
    """Python text with the constants of a soft body of Newton, and a function that adds the body to a builder."""

    title = "Newton 1.8"
    suffix = ".py"
    verification = "run in the target"
    uses_elastic_constants = True
    has_neo_hookean_law = True
    max_poisson = 0.49
    parts = frozenset({"viscoelastic"})
    part_remarks = {"softening": "its soft body is elastic"}
    unit_systems = ("SI",)

    def write(self, content: ExportContent) -> str:
        """Return the text of the module."""
        remarks = format_comment_lines(self.list_file_remarks(content), "# ")
        lines = ['"""Soft tissue for Newton, SolverVBD."""', "", *remarks, "",
                 "#: Name -> constants of ModelBuilder.add_soft_mesh: k_mu, k_lambda in Pa, k_damp in Pa s, density in "
                 "kg/m3.", "CONSTANTS = {"]
        for label, material, constants in zip(content.labels, content.materials, content.constants, strict=True):
            self.require_available_parts(material)
            numbers = {"k_mu": constants.mu, "k_lambda": constants.lame, "k_damp": compute_k_damp(constants),
                       "density": constants.density or _DENSITY}
            listed = ", ".join(f'"{name}": {value!r}' for name, value in numbers.items())
            lines.append(f'    "{label}": {{{listed}}},')
        return "\n".join([*lines, "}"]) + "\n" + _FUNCTION.format(first=content.labels[0])


NEWTON = NewtonTarget()
