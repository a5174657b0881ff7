"""Product of the exact tangent of elastic tissue with a displacement, element by element, as Taichi functions.

With this product, the factorisation of the last step, which belongs to a nearby tangent, solves the equations of the
exact tangent iteratively (modified Newton method, iterative refinement). The equations are those of displacements and
pressures, so that the convergence does not depend on K/mu (`condensation`).
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric import energy as point
from tissue_sim.fem.axisymmetric.condensation import make_condensation_functions
from tissue_sim.fem.axisymmetric.scratch import AT, get_axisymmetric_scratch_field
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.scratch import LANES
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
    s = get_axisymmetric_scratch_field()
    UR, UZ, FR, FZ, SR, SZ, RATE = (AT[name] for name in ("UR", "UZ", "FR", "FZ", "SR", "SZ", "STRESS"))
    row = point.PLACE

    @ti.func
    def add_tangent_product_to_residual(b, k, kappa, batches, one, tangents: ti.template(), dx: ti.template(),
                                        dofs: ti.template(),
                                        real: ti.template(), gradient_r: ti.template(), gradient_z: ti.template(),
                                        value_r: ti.template(), moduli: ti.template(), equations_r: ti.template(),
                                        equations_z: ti.template(), volume_r: ti.template(), volume_z: ti.template(),
                                        known_r: ti.template(), known_z: ti.template(), pressure_rates: ti.template(),
                                        swelling: ti.template(), rows_rr: ti.template(), rows_rz: ti.template(),
                                        rows_zr: ti.template(), rows_zz: ti.template(), inverse_rr: ti.template(),
                                        inverse_rz: ti.template(), inverse_zz: ti.template(), centre_r: ti.template(),
                                        centre_z: ti.template(), way_r: ti.template(), way_z: ti.template(),
                                        residual: ti.template()):
        """Add the forces of the displacement derivatives (row k of `dx`) and pressure derivatives to the residual.

        `way_r` and `way_z` get the displacement derivatives of the interior nodes, including those at fixed shared
        nodes (`centre_r`, `centre_z`). `swelling` gets the residual of the volume constraint, which is eliminated with
        the volume derivatives of the factorised matrix (`known_r`, `known_z`). `tangents` are the tangents of the
        quadrature points times their weight. Returns the sum of the force differences caused by the difference between
        these volume derivatives and the present ones.
        """
        for a in range(nodes):
            i = b * nodes + a
            s[UR + a] = ti.Vector([dx[k, dofs[i, l]] for l in ti.static(range(LANES))])
            s[UZ + a] = ti.Vector([dx[k, dofs[i, l] + 1] for l in ti.static(range(LANES))])
        for q in range(points):
            h0, h1, h2, h3, h4 = vec(0.0), vec(0.0), vec(0.0), vec(0.0), vec(0.0)
            for a in range(nodes):
                g = (b * points + q) * nodes + a
                gr, gz, gh, ur, uz = gradient_r[g], gradient_z[g], value_r[g], s[UR + a], s[UZ + a]
                h0 = h0 + ur * gr
                h1 = h1 + ur * gz
                h2 = h2 + uz * gr
                h3 = h3 + uz * gz
                h4 = h4 + ur * gh
            H, at = [h0, h1, h2, h3, h4], RATE + 5 * q
            A = [1.0 * h0 for _n in ti.static(range(15))]
            for n in ti.static(range(15)):
                of = (b * points + q) * 15 + n * one
                A[n] = tangents[of]
            for i in ti.static(range(5)):
                s[at + i] = (A[ti.static(row[i][0])] * H[0] + A[ti.static(row[i][1])] * H[1]
                             + A[ti.static(row[i][2])] * H[2] + A[ti.static(row[i][3])] * H[3]
                             + A[ti.static(row[i][4])] * H[4])
        for a in range(nodes):
            fr, fz = vec(0.0), vec(0.0)
            for q in range(points):
                g = (b * points + q) * nodes + a
                gr, gz, gh, at = gradient_r[g], gradient_z[g], value_r[g], RATE + 5 * q
                fr = fr + s[at] * gr + s[at + 1] * gz + s[at + 4] * gh
                fz = fz + s[at + 2] * gr + s[at + 3] * gz
            s[FR + a], s[FZ + a] = fr, fz
        aside = vec(0.0)
        for m in range(modes):
            mode = b * modes + m
            p, bulk = pressure_rates[mode], kappa * moduli[b]
            missed = -p / bulk
            for a in range(nodes):
                v = mode * nodes + a
                missed = missed + volume_r[v] * s[UR + a] + volume_z[v] * s[UZ + a]
            swelling[mode] = missed
            missed = bulk * missed
            for a in range(nodes):
                v = mode * nodes + a
                s[FR + a] = s[FR + a] + p * volume_r[v] + missed * known_r[v]
                s[FZ + a] = s[FZ + a] + p * volume_z[v] + missed * known_z[v]
                aside = aside + ti.abs(missed * (known_r[v] - volume_r[v])) + ti.abs(
                    missed * (known_z[v] - volume_z[v]))
        own.condense_interior_force_and_get_square(b, real, rows_rr, rows_rz, rows_zr, rows_zz, inverse_rr, inverse_rz,
                                                   inverse_zz, way_r, way_z)
        if ti.static(has_centre):
            at = k * batches + b
            way_r[b], way_z[b] = way_r[b] + centre_r[at], way_z[b] + centre_z[at]
        own.add_forces_to_residual(b, equations_r, equations_z, residual)
        return (real[b] * aside).sum()

    @ti.func
    def update_condensed_derivatives(b, k, kappa, motion: ti.template(), dofs: ti.template(), real: ti.template(),
                                     moduli: ti.template(), known_r: ti.template(), known_z: ti.template(),
                                     rows_rr: ti.template(), rows_rz: ti.template(), rows_zr: ti.template(),
                                     rows_zz: ti.template(), way_r: ti.template(), way_z: ti.template(),
                                     pressure_rates: ti.template(), swelling: ti.template(), dx: ti.template()):
        """Update the derivatives of interior nodes (row k of `dx`) and pressures after the `motion` of shared nodes."""
        own.store_increments_of_all_nodes(b, motion, dofs, rows_rr, rows_rz, rows_zr, rows_zz, way_r, way_z)
        if ti.static(has_centre):
            i, cr, cz = b * nodes + centre, s[SR + centre], s[SZ + centre]
            for l in ti.static(range(LANES)):
                if real[b][l] > 0.0:
                    dx[k, dofs[i, l]] = dx[k, dofs[i, l]] + cr[l]
                    dx[k, dofs[i, l] + 1] = dx[k, dofs[i, l] + 1] + cz[l]
        for m in range(modes):
            mode = b * modes + m
            pressure_rates[mode] = pressure_rates[mode] + kappa * moduli[b] * (
                swelling[mode] + own.compute_volume_increment_of_mode(mode, known_r, known_z))

    return TangentProductFunctions(add_tangent_product_to_residual, update_condensed_derivatives)
