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

from tissue_sim.fem.axisymmetric.scratch import AT, get_axisymmetric_scratch_field
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.scratch import LANES
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
    s = get_axisymmetric_scratch_field()
    FR, FZ, SR, SZ = (AT[name] for name in ("FR", "FZ", "SR", "SZ"))

    @ti.func
    def gather_lane_vector_by_index_row(values: ti.template(), places: ti.template(), i):
        """Return the vector with one entry of `values` for each SIMD lane, from the indices in row i of `places`."""
        return ti.Vector([values[places[i, l]] for l in ti.static(range(LANES))])

    # Arrays are updated by `a = a + b`, because `a += b` is an atomic operation in Taichi, four times slower here.

    @ti.func
    def condense_interior_force_and_get_square(b, real: ti.template(), rows_rr: ti.template(), rows_rz: ti.template(),
                                               rows_zr: ti.template(), rows_zz: ti.template(),
                                               inverse_rr: ti.template(),
                                               inverse_rz: ti.template(), inverse_zz: ti.template(),
                                               force_r: ti.template(), force_z: ti.template()):
        """Condense the force on the interior node into the forces of the shared nodes; return its summed square, N2."""
        squares = 0.0
        if ti.static(has_centre):
            f0, f1 = s[FR + centre], s[FZ + centre]
            squares = (real[b] * (f0 * f0 + f1 * f1)).sum()
            force_r[b], force_z[b] = inverse_rr[b] * f0 + inverse_rz[b] * f1, inverse_rz[b] * f0 + inverse_zz[b] * f1
            for a in range(nb):
                at = b * nb + a
                s[FR + a] = s[FR + a] - (f0 * rows_rr[at] + f1 * rows_zr[at])
                s[FZ + a] = s[FZ + a] - (f0 * rows_rz[at] + f1 * rows_zz[at])
        return squares

    @ti.func
    def add_forces_to_residual(b, equations_r: ti.template(), equations_z: ti.template(), residual: ti.template()):
        """Add the forces of the shared nodes to the global residual."""
        for a in range(nb):
            at = b * nb + a
            fr, fz = s[FR + a], s[FZ + a]
            for l in ti.static(range(LANES)):
                residual[equations_r[at, l]] = residual[equations_r[at, l]] + fr[l]
                residual[equations_z[at, l]] = residual[equations_z[at, l]] + fz[l]

    @ti.func
    def copy_volume_derivatives_to_factorised(b, volume_r: ti.template(), volume_z: ti.template(),
                                              known_r: ti.template(), known_z: ti.template()):
        """Copy the present volume derivatives to those of the tangent that is about to be factorised (`known_*`)."""
        for i in range(modes * nodes):
            at = b * modes * nodes + i
            known_r[at], known_z[at] = volume_r[at], volume_z[at]

    @ti.func
    def correct_residual_for_reused_factorisation(b, kappa, real: ti.template(), moduli: ti.template(),
                                                  volume_r: ti.template(),
                                                  volume_z: ti.template(), known_r: ti.template(),
                                                  known_z: ti.template(),
                                                  gap: ti.template(), rows_rr: ti.template(), rows_rz: ti.template(),
                                                  rows_zr: ti.template(), rows_zz: ti.template(),
                                                  inverse_rr: ti.template(),
                                                  inverse_rz: ti.template(), inverse_zz: ti.template(),
                                                  force_r: ti.template(),
                                                  force_z: ti.template(), equations_r: ti.template(),
                                                  equations_z: ti.template(), residual: ti.template()):
        """Correct the residual: eliminate the pressure with the volume derivatives of the factorised matrix."""
        for a in range(nodes):
            s[FR + a], s[FZ + a] = vec(0.0), vec(0.0)
        for m in range(modes):
            at = b * modes + m
            missed = kappa * moduli[b] * gap[at]
            for a in range(nodes):
                i = at * nodes + a
                s[FR + a] = s[FR + a] + missed * (known_r[i] - volume_r[i])
                s[FZ + a] = s[FZ + a] + missed * (known_z[i] - volume_z[i])
        if ti.static(has_centre):
            before_r, before_z = force_r[b], force_z[b]
            condense_interior_force_and_get_square(b, real, rows_rr, rows_rz, rows_zr, rows_zz, inverse_rr, inverse_rz,
                                                   inverse_zz, force_r, force_z)
            force_r[b], force_z[b] = force_r[b] + before_r, force_z[b] + before_z
        add_forces_to_residual(b, equations_r, equations_z, residual)

    @ti.func
    def store_increments_of_all_nodes(b, step: ti.template(), dofs: ti.template(), rows_rr: ti.template(),
                                      rows_rz: ti.template(), rows_zr: ti.template(), rows_zz: ti.template(),
                                      force_r: ti.template(), force_z: ti.template()):
        """Store the displacement increments of all nodes; that of the interior node follows from the shared nodes."""
        for a in range(nb):
            i = b * nodes + a
            s[SR + a] = gather_lane_vector_by_index_row(step, dofs, i)
            s[SZ + a] = ti.Vector([step[dofs[i, l] + 1] for l in ti.static(range(LANES))])
        if ti.static(has_centre):
            cr, cz = -force_r[b], -force_z[b]
            for a in range(nb):
                at = b * nb + a
                cr = cr - (rows_rr[at] * s[SR + a] + rows_rz[at] * s[SZ + a])
                cz = cz - (rows_zr[at] * s[SR + a] + rows_zz[at] * s[SZ + a])
            s[SR + centre], s[SZ + centre] = cr, cz

    @ti.func
    def compute_volume_increment_of_mode(mode, known_r: ti.template(), known_z: ti.template()):
        """Return the volume increment of a pressure mode, with the volume derivatives of the factorised matrix."""
        swelling = vec(0.0)
        for a in range(nodes):
            v = mode * nodes + a
            swelling = swelling + known_r[v] * s[SR + a] + known_z[v] * s[SZ + a]
        return swelling

    @ti.func
    def update_condensed_unknowns(b, kappa, x: ti.template(), pressures, step: ti.template(), elements: ti.template(),
                                  dofs: ti.template(), real: ti.template(), moduli: ti.template(),
                                  known_r: ti.template(), known_z: ti.template(), gap: ti.template(),
                                  rows_rr: ti.template(), rows_rz: ti.template(), rows_zr: ti.template(),
                                  rows_zz: ti.template(), force_r: ti.template(), force_z: ti.template()):
        """Update interior nodes and pressures in `x` from the increment `step` of shared nodes (substitution)."""
        store_increments_of_all_nodes(b, step, dofs, rows_rr, rows_rz, rows_zr, rows_zz, force_r, force_z)
        if ti.static(has_centre):
            i, cr, cz = b * nodes + centre, s[SR + centre], s[SZ + centre]
            for l in ti.static(range(LANES)):
                if real[b][l] > 0.0:
                    x[dofs[i, l]] = x[dofs[i, l]] + cr[l]
                    x[dofs[i, l] + 1] = x[dofs[i, l] + 1] + cz[l]
        for m in range(modes):
            at = b * modes + m
            change = kappa * moduli[b] * (gap[at] + compute_volume_increment_of_mode(at, known_r, known_z))
            for l in ti.static(range(LANES)):
                if real[b][l] > 0.0:
                    i = pressures + modes * elements[b, l] + m
                    x[i] = x[i] + change[l]

    return CondensationFunctions(condense_interior_force_and_get_square, add_forces_to_residual,
                                 copy_volume_derivatives_to_factorised,
                                 correct_residual_for_reused_factorisation, store_increments_of_all_nodes,
                                 compute_volume_increment_of_mode, update_condensed_unknowns)
