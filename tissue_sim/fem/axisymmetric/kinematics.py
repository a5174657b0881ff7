"""Kinematics of axisymmetric elements as Taichi functions, for a batch of elements with one element in each lane.

The components of a displacement gradient are rR, rZ, zR, zZ and hoop; those of a first Piola stress likewise. The
indices are b for the batch, q for the quadrature point and a for the node of an element.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric.scratch import AT, get_axisymmetric_scratch_field
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.shared_fields import LANES
from tissue_sim.mesh.elements import ELEMENTS


class KinematicFunctions(NamedTuple):
    """Taichi functions of one element type.

    Attributes:
        gather_node_vector: ``gather_node_vector(values, elements, i) -> (r, z)``: components of nodal values, stored
            as r0, z0, r1, z1, ..., at the nodes in row i of ``elements.dofs``, one element in each lane.
        gather_node_vector_of_row: the same for row k of a matrix: ``(values, k, elements, i)``.
        compute_gradient_of_stored_displacements: ``(b, q, elements) -> h0, ..., h4``: displacement gradient of the
            displacements UR and UZ in the scratch field at quadrature point q.
        compute_node_force_from_stresses: ``(a, b, first, elements) -> (r, z)``: force on node a from the stresses times
            weights in the scratch field, five for each quadrature point from `first` on.
    """

    gather_node_vector: object
    gather_node_vector_of_row: object
    compute_gradient_of_stored_displacements: object
    compute_node_force_from_stresses: object


@cache
def make_kinematic_functions(element_name: str) -> KinematicFunctions:
    """Return the Taichi functions of an element type, a key of `tissue_sim.mesh.elements.ELEMENTS`."""
    ti = get_initialised_taichi()
    element = ELEMENTS[element_name]
    nodes, points = element.node_count, element.quadrature[1].size
    vec = ti.types.vector(LANES, ti.f64)
    s = get_axisymmetric_scratch_field()
    UR, UZ = AT["UR"], AT["UZ"]

    @ti.func
    def gather_node_vector(values: ti.template(), elements: ti.template(), i):
        """Return the components (r, z) of nodal values at the nodes of row i, one element in each lane."""
        return (ti.Vector([values[elements.dofs[i][l]] for l in ti.static(range(LANES))]),
                ti.Vector([values[elements.dofs[i][l] + 1] for l in ti.static(range(LANES))]))

    @ti.func
    def gather_node_vector_of_row(values: ti.template(), k, elements: ti.template(), i):
        """Return the components (r, z) of row k of nodal values at the nodes of row i, one element in each lane."""
        return (ti.Vector([values[k, elements.dofs[i][l]] for l in ti.static(range(LANES))]),
                ti.Vector([values[k, elements.dofs[i][l] + 1] for l in ti.static(range(LANES))]))

    @ti.func
    def compute_gradient_of_stored_displacements(b, q, elements: ti.template()):
        """Return the gradient (rR, rZ, zR, zZ, hoop) of the stored nodal displacements at quadrature point q."""
        h0, h1, h2, h3, h4 = vec(0.0), vec(0.0), vec(0.0), vec(0.0), vec(0.0)
        for a in range(nodes):
            g = (b * points + q) * nodes + a
            gr, gz, gh = elements.gradient_r[g], elements.gradient_z[g], elements.value_r[g]
            ur, uz = s[UR + a], s[UZ + a]
            h0 = h0 + ur * gr
            h1 = h1 + ur * gz
            h2 = h2 + uz * gr
            h3 = h3 + uz * gz
            h4 = h4 + ur * gh
        return h0, h1, h2, h3, h4

    @ti.func
    def compute_node_force_from_stresses(a, b, first, elements: ti.template()):
        """Return the force (r, z) on node a from the stored stresses times weights, whose first entry is `first`."""
        fr, fz = vec(0.0), vec(0.0)
        for q in range(points):
            g, at = (b * points + q) * nodes + a, first + 5 * q
            gr, gz, gh = elements.gradient_r[g], elements.gradient_z[g], elements.value_r[g]
            fr = fr + s[at] * gr + s[at + 1] * gz + s[at + 4] * gh
            fz = fz + s[at + 2] * gr + s[at + 3] * gz
        return fr, fz

    return KinematicFunctions(gather_node_vector, gather_node_vector_of_row, compute_gradient_of_stored_displacements,
                              compute_node_force_from_stresses)
