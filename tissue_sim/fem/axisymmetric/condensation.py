"""Static condensation of the interior node and the pressure of each element, as Taichi functions.

With the volume residual g = v(u) - p / K (per pressure mode) and its derivative B = dv/du, the linearised equations of
an element, A du + B^T dp = -R and B du - dp / K = -g, give dp = K (g + B du) and the condensed stiffness A + K B^T B
(mixed displacement-pressure formulation). The interior node is eliminated by its Schur complement.

If a factorisation is reused, the pressure is eliminated with the B of the factorised matrix. The iteration is then a
modified Newton method for displacements and pressures, whose convergence does not depend on K/mu. With the present B,
the change of B would be multiplied by K without being in the matrix.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric.kinematics import make_kinematic_functions
from tissue_sim.fem.axisymmetric.scratch import AT, get_axisymmetric_scratch_field
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.shared_fields import LANES
from tissue_sim.mesh.elements import ELEMENTS


class CondensationFunctions(NamedTuple):
    """Taichi functions of the static condensation for one element type."""

    condense_interior_force_and_get_square: object
    add_forces_to_residual: object
    copy_volume_derivatives_to_factorised: object
    correct_residual_for_reused_factorisation: object
    store_increments_of_all_nodes: object
    compute_volume_increment_of_mode: object
    update_condensed_unknowns: object


@cache
def make_condensation_functions(element_name: str) -> CondensationFunctions:
    """Return the Taichi functions of the static condensation of an element type."""
    ti = get_initialised_taichi()
    element = ELEMENTS[element_name]
    nodes, nb, modes = element.node_count, element.boundary_nodes, element.pressure_modes
    has_centre, centre = nodes > nb, nodes - 1
    vec = ti.types.vector(LANES, ti.f64)
    s, kinematics = get_axisymmetric_scratch_field(), make_kinematic_functions(element_name)
    FR, FZ, SR, SZ = (AT[name] for name in ("FR", "FZ", "SR", "SZ"))

    # Arrays are updated by `a = a + b`, because `a += b` is an atomic operation in Taichi, four times slower here.

    @ti.func
    def condense_interior_force_and_get_square(b, to, elements: ti.template(), force_r: ti.template(),
                                               force_z: ti.template()):
        """Condense the force on the interior node into the forces of the shared nodes; return its summed square, N2.

        Entry `to` of `force_r` and `force_z` gets the inverse stiffness of the interior node times its force.
        """
        squares = 0.0
        if ti.static(has_centre):
            f0, f1 = s[FR + centre], s[FZ + centre]
            squares = (elements.real[b] * (f0 * f0 + f1 * f1)).sum()
            force_r[to] = elements.inverse_rr[b] * f0 + elements.inverse_rz[b] * f1
            force_z[to] = elements.inverse_rz[b] * f0 + elements.inverse_zz[b] * f1
            for a in range(nb):
                at = b * nb + a
                s[FR + a] = s[FR + a] - (f0 * elements.rows_rr[at] + f1 * elements.rows_zr[at])
                s[FZ + a] = s[FZ + a] - (f0 * elements.rows_rz[at] + f1 * elements.rows_zz[at])
        return squares

    @ti.func
    def add_forces_to_residual(b, elements: ti.template(), residual: ti.template()):
        """Add the forces of the shared nodes to the global residual."""
        for a in range(nb):
            at = b * nb + a
            fr, fz = s[FR + a], s[FZ + a]
            for l in ti.static(range(LANES)):
                residual[elements.equations_r[at][l]] = residual[elements.equations_r[at][l]] + fr[l]
                residual[elements.equations_z[at][l]] = residual[elements.equations_z[at][l]] + fz[l]

    @ti.func
    def copy_volume_derivatives_to_factorised(b, elements: ti.template()):
        """Copy the present volume derivatives to those of the tangent that is about to be factorised."""
        for i in range(modes * nodes):
            at = b * modes * nodes + i
            elements.known_volume_r[at], elements.known_volume_z[at] = elements.volume_r[at], elements.volume_z[at]

    @ti.func
    def correct_residual_for_reused_factorisation(b, kappa, elements: ti.template(), residual: ti.template()):
        """Correct the residual: eliminate the pressure with the volume derivatives of the factorised matrix."""
        for a in range(nodes):
            s[FR + a], s[FZ + a] = vec(0.0), vec(0.0)
        for m in range(modes):
            at = b * modes + m
            missed = kappa * elements.moduli[b] * elements.gap[at]
            for a in range(nodes):
                i = at * nodes + a
                s[FR + a] = s[FR + a] + missed * (elements.known_volume_r[i] - elements.volume_r[i])
                s[FZ + a] = s[FZ + a] + missed * (elements.known_volume_z[i] - elements.volume_z[i])
        if ti.static(has_centre):
            before_r, before_z = elements.force_r[b], elements.force_z[b]
            condense_interior_force_and_get_square(b, b, elements, elements.force_r, elements.force_z)
            elements.force_r[b], elements.force_z[b] = elements.force_r[b] + before_r, elements.force_z[b] + before_z
        add_forces_to_residual(b, elements, residual)

    @ti.func
    def store_increments_of_all_nodes(b, step: ti.template(), elements: ti.template(), force_r: ti.template(),
                                      force_z: ti.template()):
        """Store the displacement increments of all nodes; that of the interior node follows from the shared nodes."""
        for a in range(nb):
            i = b * nodes + a
            s[SR + a], s[SZ + a] = kinematics.gather_node_vector(step, elements, i)
        if ti.static(has_centre):
            cr, cz = -force_r[b], -force_z[b]
            for a in range(nb):
                at = b * nb + a
                cr = cr - (elements.rows_rr[at] * s[SR + a] + elements.rows_rz[at] * s[SZ + a])
                cz = cz - (elements.rows_zr[at] * s[SR + a] + elements.rows_zz[at] * s[SZ + a])
            s[SR + centre], s[SZ + centre] = cr, cz

    @ti.func
    def compute_volume_increment_of_mode(mode, elements: ti.template()):
        """Return the volume increment of a pressure mode, with the volume derivatives of the factorised matrix."""
        swelling = vec(0.0)
        for a in range(nodes):
            v = mode * nodes + a
            swelling = swelling + elements.known_volume_r[v] * s[SR + a] + elements.known_volume_z[v] * s[SZ + a]
        return swelling

    @ti.func
    def update_condensed_unknowns(b, kappa, x: ti.template(), pressures, step: ti.template(), elements: ti.template()):
        """Update interior nodes and pressures in `x` from the increment `step` of shared nodes (substitution)."""
        store_increments_of_all_nodes(b, step, elements, elements.force_r, elements.force_z)
        if ti.static(has_centre):
            i, cr, cz = b * nodes + centre, s[SR + centre], s[SZ + centre]
            for l in ti.static(range(LANES)):
                if elements.real[b][l] > 0.0:
                    x[elements.dofs[i][l]] = x[elements.dofs[i][l]] + cr[l]
                    x[elements.dofs[i][l] + 1] = x[elements.dofs[i][l] + 1] + cz[l]
        for m in range(modes):
            at = b * modes + m
            change = kappa * elements.moduli[b] * (elements.gap[at] + compute_volume_increment_of_mode(at, elements))
            for l in ti.static(range(LANES)):
                if elements.real[b][l] > 0.0:
                    i = pressures + modes * elements.numbers[b][l] + m
                    x[i] = x[i] + change[l]

    return CondensationFunctions(condense_interior_force_and_get_square, add_forces_to_residual,
                                 copy_volume_derivatives_to_factorised,
                                 correct_residual_for_reused_factorisation, store_increments_of_all_nodes,
                                 compute_volume_increment_of_mode, update_condensed_unknowns)
