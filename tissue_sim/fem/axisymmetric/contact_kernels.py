"""Contact forces at points of the surface, as Taichi functions: semismooth Newton method with active sets.

The contact forces lambda are unknowns besides the displacements; compression is negative. The active set of each state
is the set of points with lambda_n + c g < 0, where g is the gap and c an augmentation parameter (primal-dual active
set: Hintermüller, Ito and Kunisch, SIAM J. Optim. 13 (2002) 865; Hüeber and Wohlmuth, Comput. Methods Appl. Mech. Eng.
194 (2005) 3147). c must be of the order of the tissue stiffness: with a large penalty stiffness, the gap that remains
after a linear solve, of second order, times c exceeds any force, and the active set cycles.

The bodies are rigid. Each force is eliminated with a penalty stiffness k: lambda <- lambda + k g (augmented
Lagrangian, perturbed Lagrangian). The next iteration corrects the remaining gap, so that the constraint holds at
equilibrium for any k.

Friction is Coulomb's law with return mapping: the trial force is lambda_t + c s, with the slip s from the anchor; a
point sticks if its norm is at most mu times the normal force, otherwise the tangential force is mu lambda_n in the
direction of the slip, which makes the tangent unsymmetric. A point on an interface without slip is held where it
touched.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric.contact import (
    PENALTY,
    ContactLinearisationColumn,
    FactorisedRateColumn,
    OutlineSpanColumn,
)
from tissue_sim.fem.axisymmetric.contact_gap import make_closest_point_function
from tissue_sim.fem.axisymmetric.contact_laws import make_contact_law_functions
from tissue_sim.fem.contact_settings import ALL_POINTS, ActiveSetSettings, ContactBondState
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.trace import FormulaClassAndConstants

#: `ContactBondState.FREE` as a float, because the kernels store bonds in arrays of floats.
FREE = float(ContactBondState.FREE)
#: `ContactBondState.HELD` as a float.
HELD = float(ContactBondState.HELD)
#: `ContactBondState.TOUCHED` as a float.
TOUCHED = float(ContactBondState.TOUCHED)
#: Settings of the active set; the kernels contain the values as constants.
ACTIVE_SET = ActiveSetSettings(augmentation_factor=1e-3)
#: Relative tolerance of Coulomb's friction cone, and of negligible friction.
CONE_TOLERANCE = 1e-3


class ContactForceFunctions(NamedTuple):
    """Taichi functions that evaluate and update the contact forces at the contact points."""

    add_contact_forces_and_update_active_set: object
    add_constraint_residual_forces: object
    update_contact_forces_after_linear_solve: object
    subtract_contact_forces: object
    release_points_under_tension: object
    commit_contact_bonds_and_count_changes: object


@cache
def make_contact_force_functions(laws: tuple[FormulaClassAndConstants, ...] = ()) -> ContactForceFunctions:
    """Return the contact functions; `laws` are additional contact laws, such as adhesion."""
    ti = get_initialised_taichi()
    has_laws, law = bool(laws), make_contact_law_functions(laws)
    compute_gap_and_normal_at_closest_point = make_closest_point_function()

    @ti.func
    def add_contact_forces_and_update_active_set(count, changeable, slack, pending, bending, move, depth, lift, free,
                                                 tolerance, negligible,
                                                 reach, law_settings: ti.template(), multipliers, nodes: ti.template(),
                                                 shapes: ti.template(),
                                                 spans: ti.template(), places: ti.template(), areas: ti.template(),
                                                 vertices: ti.template(),
                                                 rounding: ti.template(), friction: ti.template(),
                                                 springs: ti.template(),
                                                 held: ti.template(), pressed: ti.template(), slip_signs: ti.template(),
                                                 met: ti.template(),
                                                 forces: ti.template(), rates: ti.template(), x: ti.template(),
                                                 target: ti.template(),
                                                 equation: ti.template(), residual: ti.template()):
        """Add the contact forces to the residual; store their derivatives and the constraint residuals in `rates`.

        Args (scalars): `changeable`: which points may change their contact state (0: none, `ALL_POINTS`, or a number
        that selects some); `slack`: gap below which a point counts as touching, m; `pending`: 1 if the motion `move`
        (m) of the tool is still to be made in this step; `bending`: factor of the surface curvature in the
        derivatives; `depth`: depth of the tool, m; `lift`: difference between z in the frame of the tool and z, m;
        `negligible`: friction below this force is neglected, N; `reach`: largest gap at which contact laws act, m.

        Returns the axial force on the tool, the sum of the squares of all forces, the largest violation of a contact
        condition (m), and the numbers of points that slip, that changed their state, and that should change their
        state but were not selected.
        """
        axial, squares, violation, slipping, switched, wanting = 0.0, 0.0, 0.0, 0, 0, 0
        for i in range(count):
            moves = float(spans[i, OutlineSpanColumn.MOVES])
            # Displacement in the frame of the body; its differences have smaller rounding errors than positions.
            ur, uz = 0.0, moves * lift
            for a in range(shapes.shape[1]):
                ur += shapes[i, a] * x[2 * nodes[i, a]]
                uz += shapes[i, a] * x[2 * nodes[i, a] + 1]
            bound = held[i, 0]
            # A point without slip that touched in this step stays at the face that it touched: before convergence
            # another face may be closer to a point at an edge.
            clings = bound == TOUCHED and friction[i, 0] < 0.0
            gap, nr, nz, curved, line = compute_gap_and_normal_at_closest_point(places[i, 0]
                                                                                + (held[i, 1] if clings else ur),
                                                                                places[i, 1] + (held[i, 2] if clings
                                                                                                else uz), i, depth,
                                                                                spans, vertices, rounding)
            if clings:
                gap, curved = (ur - held[i, 1]) * nr + (uz - held[i, 2]) * nz, 0.0
            # Rounded edges have the friction of the face.
            mu = friction[i, 0] if curved > 0.0 or line < spans[i, OutlineSpanColumn.SHAFT] else friction[i, 1]
            spring = springs[i]
            at = multipliers + 2 * i
            along = x[at + 1] * nr - x[at] * nz
            normal = x[at] * nr + x[at + 1] * nz
            if spans[i, OutlineSpanColumn.STAYS] == 0:
                normal = ti.min(normal, 0.0)
            trial = normal + ACTIVE_SET.augmentation_factor * spring * gap
            acting = 0.0
            fr, fz, krr, krz, kzr, kzz, missed_r, missed_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            drawn = (changeable == ALL_POINTS
                     or (changeable > 0 and (7 * i + 5 * changeable) % ACTIVE_SET.draw_interval == 0))
            if changeable > 0 and bound != HELD:
                presses = 1.0 if trial < 0.0 or gap < slack or spans[i, OutlineSpanColumn.STAYS] == 1 else 0.0
                if ti.static(not has_laws):
                    if pending == 1 and bound == TOUCHED and mu != 0.0:
                        # The tool is about to reach the point.
                        presses = 1.0
                if presses != pressed[i]:
                    if drawn:
                        switched += 1
                        pressed[i] = presses
                    elif trial > negligible / CONE_TOLERANCE:
                        wanting += 1
            met[i, 0] = FREE
            if mu > 0.0 and gap <= 1e-3 * tolerance:
                # The point touches, with or without force.
                met[i, 0], met[i, 1], met[i, 2] = TOUCHED, ur - gap * nr, uz - gap * nz
                if bound == TOUCHED:
                    met[i, 1], met[i, 2] = held[i, 1], held[i, 2]
            if bound == HELD:
                spring *= PENALTY.stick_factor
                dr, dz = ur - held[i, 1], uz - held[i, 2]
                fr, fz, missed_r, missed_z = x[at], x[at + 1], dr, dz
                krr, kzz = spring, spring
                violation = ti.max(violation, ti.sqrt(dr * dr + dz * dz))
            elif pressed[i] == 1.0:
                tr, tz = -nz, nr
                fr, fz = normal * nr, normal * nz
                missed_r, missed_z = gap * nr, gap * nz
                # Derivatives in the normal-tangential frame: nn, nt, tn, tt.
                nn, nt, tn, tt = spring, 0.0, 0.0, bending * normal * curved
                violation = ti.max(violation, ti.abs(gap))
                if mu != 0.0:
                    met[i, 0] = HELD if mu < 0.0 else TOUCHED
                    met[i, 1], met[i, 2] = ur - gap * nr, uz - gap * nz
                # Negligible friction would alternate between stick and slip. A point without slip that touched in this
                # step sticks from the beginning of the increment.
                weighty = mu < 0.0 or mu * ti.max(-trial, 0.0) > negligible or pending == 1
                if mu != 0.0 and bound == TOUCHED and weighty:
                    acting = ti.max(mu, 0.0)
                    slip = (ur - held[i, 1]) * tr + (uz - held[i, 2]) * tz
                    drag, limit = along, mu * ti.max(-normal, 0.0)
                    way = slip_signs[i]
                    if changeable > 0 and mu > 0.0:
                        tried = drag + ACTIVE_SET.augmentation_factor * spring * slip
                        # A slipping point must stick before it slips in the other direction; otherwise it alternates.
                        if way != 0.0:
                            way = way if way * slip > 0.0 else 0.0
                        elif ti.abs(tried) > mu * ti.max(-trial, 0.0):
                            way = 1.0 if tried > 0.0 else -1.0
                        if way != slip_signs[i]:
                            if drawn:
                                slip_signs[i] = way
                                switched += 1
                            else:
                                if ti.abs(slip) > 1e-3 * tolerance or ti.abs(drag) > (1.0 + CONE_TOLERANCE) * limit:
                                    wanting += 1
                                way = slip_signs[i]
                    if way == 0.0:
                        tt += PENALTY.stick_factor * spring - bending * curved * normal
                        missed_r += slip * tr
                        missed_z += slip * tz
                        met[i, 1], met[i, 2] = held[i, 1], held[i, 2]
                        violation = ti.max(violation, ti.abs(slip))
                    else:
                        drag = way * limit
                        slipping += 1
                        if trial < 0.0:
                            bent = bending * curved
                            nt += bent * (along - drag)
                            tn -= way * mu * spring
                            tt -= way * mu * bent * along
                    fr += drag * tr
                    fz += drag * tz
                krr = nn * nr * nr + (nt + tn) * nr * tr + tt * tr * tr
                krz = nn * nr * nz + nt * nr * tz + tn * tr * nz + tt * tr * tz
                kzr = nn * nz * nr + nt * nz * tr + tn * tz * nr + tt * tz * tr
                kzz = nn * nz * nz + (nt + tn) * nz * tz + tt * tz * tz
            elif gap < 0.0:
                violation = ti.max(violation, -gap)
            forces[i, 0], forces[i, 1] = fr, fz
            x[at], x[at + 1] = fr, fz
            lrr, lrz, lzz = 0.0, 0.0, 0.0
            if ti.static(has_laws):
                if moves > 0.0 and bound != HELD:
                    touches = krr != 0.0 or kzz != 0.0
                    near = bound == TOUCHED and gap < reach
                    if met[i, 0] == FREE and (touches or near):
                        met[i, 0], met[i, 1], met[i, 2] = TOUCHED, ur - gap * nr, uz - gap * nz
                        if mu == 0.0 and bound == TOUCHED:
                            met[i, 1], met[i, 2] = held[i, 1], held[i, 2]
                    if near and areas[i] > 0.0:
                        tr, tz = -nz, nr
                        area = areas[i]
                        slip = (ur - held[i, 1]) * tr + (uz - held[i, 2]) * tz
                        pull, drag, nn, tt = law.evaluate_traction(gap, ti.max(-normal, 0.0) / area, slip, law_settings)
                        fr += area * pull * nr
                        fz += area * pull * nz
                        if ti.static(law.drags):
                            fr += area * drag * tr
                            fz += area * drag * tz
                        if ti.static(law.stiffens):
                            lrr = area * (nn * nr * nr + tt * tr * tr)
                            lrz = area * (nn * nr * nz + tt * tr * tz)
                            lzz = area * (nn * nz * nz + tt * tz * tz)
            krr, krz, kzr, kzz = krr + lrr, krz + lrz, kzr + lrz, kzz + lzz
            rates[i, ContactLinearisationColumn.RR], rates[i, ContactLinearisationColumn.RZ] = krr, krz
            rates[i, ContactLinearisationColumn.ZR], rates[i, ContactLinearisationColumn.ZZ] = kzr, kzz
            (rates[i, ContactLinearisationColumn.NORMAL_R], rates[i, ContactLinearisationColumn.NORMAL_Z],
             rates[i, ContactLinearisationColumn.FRICTION]) = nr, nz, acting
            rates[i, ContactLinearisationColumn.MISSED_R] = missed_r
            rates[i, ContactLinearisationColumn.MISSED_Z] = missed_z
            (rates[i, ContactLinearisationColumn.LAW_RR], rates[i, ContactLinearisationColumn.LAW_RZ],
             rates[i, ContactLinearisationColumn.LAW_ZZ]) = lrr, lrz, lzz
            axial += moves * fz
            squares += fr * fr + fz * fz
            if pending == 1:
                # Motion of the tool, and of the nodes that move with the tool.
                pr, pz = 0.0, moves * move
                for a in range(shapes.shape[1]):
                    dof = 2 * nodes[i, a]
                    if equation[dof] >= free:
                        pr += shapes[i, a] * (target[dof] - x[dof])
                    if equation[dof + 1] >= free:
                        pz += shapes[i, a] * (target[dof + 1] - x[dof + 1])
                fr += krr * pr + krz * pz
                fz += kzr * pr + kzz * pz
            for a in range(shapes.shape[1]):
                ir, iz = equation[2 * nodes[i, a]], equation[2 * nodes[i, a] + 1]
                residual[ir] = residual[ir] + shapes[i, a] * fr
                residual[iz] = residual[iz] + shapes[i, a] * fz
        return axial, squares, violation, slipping, switched, wanting

    @ti.func
    def compute_force_change_with_gap_correction(i, pr, pz, rates: ti.template(), known: ti.template()):
        """Return the change of a point's force for a displacement (pr, pz) and for its constraint residual.

        The derivatives are those in the matrix, because others would leave large unbalanced penalty forces.
        """
        krr = known[i, FactorisedRateColumn.RR] - known[i, FactorisedRateColumn.LAW_RR]
        krz = known[i, FactorisedRateColumn.RZ] - known[i, FactorisedRateColumn.LAW_RZ]
        kzr = known[i, FactorisedRateColumn.ZR] - known[i, FactorisedRateColumn.LAW_RZ]
        kzz = known[i, FactorisedRateColumn.ZZ] - known[i, FactorisedRateColumn.LAW_ZZ]
        wr, wz = pr + rates[i, ContactLinearisationColumn.MISSED_R], pz + rates[i, ContactLinearisationColumn.MISSED_Z]
        return krr * wr + krz * wz, kzr * wr + kzz * wz

    @ti.func
    def add_constraint_residual_forces(count, nodes: ti.template(), shapes: ti.template(), rates: ti.template(),
                                       known: ti.template(), equation: ti.template(), residual: ti.template()):
        """Add the penalty forces of the constraint residuals to the right-hand side (`residual`) of a linear solve."""
        for i in range(count):
            fr, fz = compute_force_change_with_gap_correction(i, 0.0, 0.0, rates, known)
            for a in range(shapes.shape[1]):
                ir, iz = equation[2 * nodes[i, a]], equation[2 * nodes[i, a] + 1]
                residual[ir] = residual[ir] + shapes[i, a] * fr
                residual[iz] = residual[iz] + shapes[i, a] * fz

    @ti.func
    def update_contact_forces_after_linear_solve(count, move, multipliers, nodes: ti.template(), shapes: ti.template(),
                                                 spans: ti.template(), rates: ti.template(), known: ti.template(),
                                                 motion: ti.template(), x: ti.template()):
        """Update the contact forces after a linear solve in which the tool moved down by `move`, m."""
        for i in range(count):
            pr, pz = 0.0, float(spans[i, OutlineSpanColumn.MOVES]) * move
            for a in range(shapes.shape[1]):
                pr += shapes[i, a] * motion[2 * nodes[i, a]]
                pz += shapes[i, a] * motion[2 * nodes[i, a] + 1]
            fr, fz = compute_force_change_with_gap_correction(i, pr, pz, rates, known)
            at = multipliers + 2 * i
            x[at] = x[at] + fr
            x[at + 1] = x[at + 1] + fz

    @ti.func
    def subtract_contact_forces(count, multipliers, nodes: ti.template(), shapes: ti.template(),
                                equation: ti.template(), x: ti.template(), residual: ti.template()):
        """Subtract the present contact forces from the residual.

        The linearised tissue balances these forces, so that only the forces of the next
        `add_contact_forces_and_update_active_set` act as a load.
        """
        for i in range(count):
            at = multipliers + 2 * i
            for a in range(shapes.shape[1]):
                ir, iz = equation[2 * nodes[i, a]], equation[2 * nodes[i, a] + 1]
                residual[ir] = residual[ir] - shapes[i, a] * x[at]
                residual[iz] = residual[iz] - shapes[i, a] * x[at + 1]

    @ti.func
    def release_points_under_tension(count, negligible, strength, reach, places: ti.template(), areas: ti.template(),
                                     spans: ti.template(), vertices: ti.template(), rounding: ti.template(),
                                     held: ti.template(), forces: ti.template()):
        """Release held points whose tension exceeds the strength at an equilibrium; return their number.

        Args (scalars): `negligible`: tension that counts as a rounding error, as at the first touch, N; `strength`:
        largest tension per area, Pa; `reach`: largest gap at which contact laws act, m; 0 without laws.
        """
        released = 0
        for i in range(count):
            if held[i, 0] == HELD and spans[i, OutlineSpanColumn.STAYS] == 0:
                r, z = places[i, 0] + held[i, 1], places[i, 1] + held[i, 2]
                _, nr, nz, _, _ = compute_gap_and_normal_at_closest_point(r, z, i, 0.0, spans, vertices, rounding)
                if nr * forces[i, 0] + nz * forces[i, 1] > strength * areas[i] + negligible:
                    released += 1
                    held[i, 0] = TOUCHED if reach > 0.0 else FREE
        return released

    @ti.func
    def commit_contact_bonds_and_count_changes(count, held: ti.template(), met: ti.template()):
        """Copy the bonds found in this step (`met`) to `held`; return the number of bonds that changed."""
        bound = 0
        for i in range(count):
            if held[i, 0] != HELD:
                if held[i, 0] != met[i, 0]:
                    bound += 1
                for k in ti.static(range(3)):
                    held[i, k] = met[i, k]
        return bound

    return ContactForceFunctions(add_contact_forces_and_update_active_set, add_constraint_residual_forces,
                                 update_contact_forces_after_linear_solve,
                                 subtract_contact_forces, release_points_under_tension,
                                 commit_contact_bonds_and_count_changes)
