"""Product of the exact tangent of elastic tissue with a displacement, element by element, as Taichi functions.

With this product, the factorisation of the last step, which belongs to a nearby tangent, solves the equations of the
exact tangent iteratively (modified Newton method, iterative refinement). The equations are those of displacements and
pressures, so that the convergence does not depend on K/mu (`condensation`).
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric import energy as point
from tissue_sim.fem.axisymmetric.condensation import make_condensation_functions
from tissue_sim.fem.axisymmetric.kinematics import make_kinematic_functions
from tissue_sim.fem.axisymmetric.scratch import AT, get_axisymmetric_scratch_field
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.shared_fields import LANES
from tissue_sim.mesh.elements import ELEMENTS


class TangentProductFunctions(NamedTuple):
    """Taichi functions of the tangent product for one element type."""

    add_tangent_product_to_residual: object
    update_condensed_derivatives: object


@cache
def make_tangent_product_functions(element_name: str) -> TangentProductFunctions:
    """Return the Taichi functions of the tangent product for an element type."""
    ti = get_initialised_taichi()
    element = ELEMENTS[element_name]
    nodes, modes = element.node_count, element.pressure_modes
    points = element.quadrature[1].size
    has_centre, centre = nodes > element.boundary_nodes, nodes - 1
    own = make_condensation_functions(element_name)
    vec = ti.types.vector(LANES, ti.f64)
    s, kinematics = get_axisymmetric_scratch_field(), make_kinematic_functions(element_name)
    UR, UZ, FR, FZ, SR, SZ, RATE = (AT[name] for name in ("UR", "UZ", "FR", "FZ", "SR", "SZ", "STRESS"))
    row = point.PLACE

    @ti.func
    def add_tangent_product_to_residual(b, k, kappa, batches, elements: ti.template(), rates: ti.template(),
                                        residual: ti.template()):
        """Add the forces of the displacement derivatives (row k of `dx`) and pressure derivatives to the residual.

        `way_r` and `way_z` get the displacement derivatives of the interior nodes, including those at fixed shared
        nodes (`centre_r`, `centre_z`). `swelling` gets the residual of the volume constraint, which is eliminated with
        the volume derivatives of the factorised matrix. `rates.law` contains the tangents of the quadrature points
        times their weight. Returns the sum of the force differences caused by the difference between
        these volume derivatives and the present ones.
        """
        for a in range(nodes):
            i = b * nodes + a
            s[UR + a], s[UZ + a] = kinematics.gather_node_vector_of_row(rates.dx, k, elements, i)
        for q in range(points):
            h0, h1, h2, h3, h4 = kinematics.compute_gradient_of_stored_displacements(b, q, elements)
            H, at = [h0, h1, h2, h3, h4], RATE + 5 * q
            A = [1.0 * h0 for _n in ti.static(range(15))]
            for n in ti.static(range(15)):
                of = (b * points + q) * 15 + n
                A[n] = rates.law[of]
            for i in ti.static(range(5)):
                s[at + i] = (A[ti.static(row[i][0])] * H[0] + A[ti.static(row[i][1])] * H[1]
                             + A[ti.static(row[i][2])] * H[2] + A[ti.static(row[i][3])] * H[3]
                             + A[ti.static(row[i][4])] * H[4])
        for a in range(nodes):
            s[FR + a], s[FZ + a] = kinematics.compute_node_force_from_stresses(a, b, RATE, elements)
        aside = vec(0.0)
        for m in range(modes):
            mode = b * modes + m
            p, bulk = rates.pressure_rates[mode], kappa * elements.moduli[b]
            missed = -p / bulk
            for a in range(nodes):
                v = mode * nodes + a
                missed = missed + elements.volume_r[v] * s[UR + a] + elements.volume_z[v] * s[UZ + a]
            rates.swelling[mode] = missed
            missed = bulk * missed
            for a in range(nodes):
                v = mode * nodes + a
                s[FR + a] = s[FR + a] + p * elements.volume_r[v] + missed * elements.known_volume_r[v]
                s[FZ + a] = s[FZ + a] + p * elements.volume_z[v] + missed * elements.known_volume_z[v]
                aside = aside + ti.abs(missed * (elements.known_volume_r[v] - elements.volume_r[v])) + ti.abs(
                    missed * (elements.known_volume_z[v] - elements.volume_z[v]))
        own.condense_interior_force_and_get_square(b, b, elements, rates.way_r, rates.way_z)
        if ti.static(has_centre):
            at = k * batches + b
            rates.way_r[b], rates.way_z[b] = rates.way_r[b] + rates.centre_r[at], rates.way_z[b] + rates.centre_z[at]
        own.add_forces_to_residual(b, elements, residual)
        return (elements.real[b] * aside).sum()

    @ti.func
    def update_condensed_derivatives(b, k, kappa, motion: ti.template(), elements: ti.template(),
                                     rates: ti.template()):
        """Update the derivatives of interior nodes (row k of `dx`) and pressures after the `motion` of shared nodes."""
        own.store_increments_of_all_nodes(b, motion, elements, rates.way_r, rates.way_z)
        if ti.static(has_centre):
            i, cr, cz = b * nodes + centre, s[SR + centre], s[SZ + centre]
            for l in ti.static(range(LANES)):
                if elements.real[b][l] > 0.0:
                    rates.dx[k, elements.dofs[i][l]] = rates.dx[k, elements.dofs[i][l]] + cr[l]
                    rates.dx[k, elements.dofs[i][l] + 1] = rates.dx[k, elements.dofs[i][l] + 1] + cz[l]
        for m in range(modes):
            mode = b * modes + m
            rates.pressure_rates[mode] = rates.pressure_rates[mode] + kappa * elements.moduli[b] * (
                rates.swelling[mode] + own.compute_volume_increment_of_mode(mode, elements))

    return TangentProductFunctions(add_tangent_product_to_residual, update_condensed_derivatives)
