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

In the matrix of a step only the derivatives that have changed since the factorisation are added, so that the
factorisation can be updated from the first changed block row on.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric.array_layouts import NEWTON, StepSettingIndex
from tissue_sim.fem.axisymmetric.contact import (
    KNOWN_RATE_COLUMNS,
    PENALTY,
    ContactLinearisationColumn,
    FactorisedRateColumn,
    OutlineSpanColumn,
)
from tissue_sim.fem.contact.laws import make_contact_law_functions
from tissue_sim.fem.contact.pairs import ALL_POINTS, ActiveSetSettings, ContactBondState
from tissue_sim.fem.contact.surface_geometry import make_closest_point_function
from tissue_sim.fem.linear.band import BLOCK, make_add_lower_entry_function, make_add_unsymmetric_entry_function
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.trace import FormulaClassAndConstants


@cache
def make_gap_function():
    """Return the Taichi function of the gap of a contact point.

    ``compute_gap_and_normal(r, z, i, depth, surface) -> (gap, normal r, normal z, curvature, line)`` evaluates point i
    of `ContactPoints` at (r, z) in the frame of its body, with the tool at `depth`.
    """
    ti = get_initialised_taichi()
    find_closest_outline_point = make_closest_point_function()

    @ti.func
    def compute_gap_and_normal(r, z, i, depth, surface: ti.template()):
        """Return gap (m), outward normal, absolute curvature (1/m) and index of the line segment closest to (r, z).

        If the edge between face and shaft is sharp and the tool is pressed in, the line of the shaft is extended below
        the face for points that can touch the shaft only. These points cannot move under the face, where other tissue
        is.
        """
        first, is_endless = surface.spans[i, OutlineSpanColumn.FIRST_LINE], 0
        if first == surface.spans[i, OutlineSpanColumn.SHAFT] and surface.rounding[i] == 0.0 and depth >= 0.0:
            is_endless = 1
        line, distance, nr, nz, curvature = find_closest_outline_point(
            r, z, first, surface.spans[i, OutlineSpanColumn.END_LINE], is_endless, surface.lines)
        return distance - surface.rounding[i], nr, nz, ti.abs(curvature), line

    return compute_gap_and_normal


#: A derivative counts as changed if it differs by more than this fraction of the penalty stiffness of its point.
CHANGE_TOLERANCE = 0.01


class ContactStiffnessFunctions(NamedTuple):
    """Taichi functions that add the derivatives of the contact forces to the matrix of a step."""

    clear_factorised_contact_stiffness: object
    find_first_changed_and_slipping_rows: object
    add_contact_stiffness_to_matrix: object
    has_contact_stiffness_changed: object
    add_depth_derivatives_and_get_stiffness: object


@cache
def make_contact_stiffness_functions(slips: bool) -> ContactStiffnessFunctions:
    """Return the functions; if `slips` is false, no contact point can slip and the matrix is symmetric."""
    ti = get_initialised_taichi()
    add_lower_entry, add_unsymmetric_entry = make_add_lower_entry_function(), make_add_unsymmetric_entry_function()

    @ti.func
    def clear_factorised_contact_stiffness(count, surface: ti.template()):
        """Set the stored derivatives of the factorised matrix to zero, as in a matrix without contact."""
        for i in range(count):
            for k in ti.static(range(KNOWN_RATE_COLUMNS)):
                surface.known_rates[i, k] = 0.0

    @ti.func
    def has_point_stiffness_changed(i, surface: ti.template()):
        """Return 1 if a derivative of point i differs from the factorised matrix by more than `CHANGE_TOLERANCE`."""
        changed = 0
        for k in ti.static(range(4)):
            if ti.abs(surface.rates[i, k] - surface.known_rates[i, k]) > CHANGE_TOLERANCE * surface.springs[i]:
                changed = 1
        return changed

    @ti.func
    def has_contact_stiffness_changed(count, surface: ti.template()):
        """Return 1 if `has_point_stiffness_changed` holds for any point: it touched, separated, stuck or slipped."""
        changed = 0
        for i in range(count):
            changed = ti.max(changed, has_point_stiffness_changed(i, surface))
        return changed

    @ti.func
    def find_first_changed_and_slipping_rows(count, fresh, free, rows, surface: ti.template(), state: ti.template()):
        """Return the first block row with a changed contact derivative, and the first block row with a slipping point.

        Both are the number of block rows, `rows`, if there is none.
        """
        changed, skewed = rows, rows
        for i in range(count):
            first = rows
            for a in range(surface.shapes.shape[1]):
                for k in range(2):
                    row = state.equation[2 * surface.nodes[i, a] + k]
                    if surface.shapes[i, a] != 0.0 and row < free:
                        first = ti.min(first, row // BLOCK)
            if surface.rates[i, ContactLinearisationColumn.FRICTION] > 0.0 and surface.slip_signs[i] != 0.0:
                skewed = ti.min(skewed, first)
            if fresh == 0 and has_point_stiffness_changed(i, surface) == 1:
                changed = ti.min(changed, first)
        return changed, skewed

    @ti.func
    def add_contact_stiffness_to_matrix(count, fresh, unsymmetric, free, band_table: ti.template(),
                                        surface: ti.template(), state: ti.template()):
        """Add the changes of the contact derivatives to the matrix; all derivatives if the matrix is `fresh`.

        The upper half of the matrix is needed only if points slip.
        """
        for i in range(count):
            if fresh == 1 or has_point_stiffness_changed(i, surface) == 1:
                for a in range(surface.shapes.shape[1]):
                    for b in range(surface.shapes.shape[1]):
                        share = surface.shapes[i, a] * surface.shapes[i, b]
                        if share != 0.0:
                            for e in range(4):
                                row = state.equation[2 * surface.nodes[i, a] + e // 2]
                                column = state.equation[2 * surface.nodes[i, b] + e % 2]
                                value = share * (surface.rates[i, e] - surface.known_rates[i, e])
                                if ti.static(slips):
                                    if unsymmetric > 0:
                                        add_unsymmetric_entry(row, column, value, free, band_table)
                                if unsymmetric == 0:
                                    add_lower_entry(row, column, value, free, band_table)
                for k in ti.static(range(4)):
                    surface.known_rates[i, k] = surface.rates[i, k]
                for k in ti.static(range(KNOWN_RATE_COLUMNS - FactorisedRateColumn.LAW_RR)):
                    surface.known_rates[i, FactorisedRateColumn.LAW_RR + k] = surface.rates[
                        i, ContactLinearisationColumn.LAW_RR + k]

    @ti.func
    def add_depth_derivatives_and_get_stiffness(count, free, surface: ti.template(), state: ti.template()):
        """Add the derivatives of the contact forces with respect to the depth of the tool to the residual.

        They are those at fixed tissue. The derivatives of the force on the tool with respect to the displacements are
        added to `state.reaction`. Returns the derivative of the force on the tool with respect to its depth at fixed
        tissue, N/m.
        """
        stiff = 0.0
        for i in range(count):
            krz, kzr = surface.rates[i, ContactLinearisationColumn.RZ], surface.rates[i, ContactLinearisationColumn.ZR]
            kzz = surface.rates[i, ContactLinearisationColumn.ZZ]
            # Displacement of the point relative to its body per depth of the tool, with the free nodes fixed.
            apart = float(surface.spans[i, OutlineSpanColumn.MOVES])
            for a in range(surface.shapes.shape[1]):
                if state.equation[2 * surface.nodes[i, a] + 1] >= free:
                    apart += surface.shapes[i, a] * state.direction[2 * surface.nodes[i, a] + 1]
            stiff += apart * apart * kzz
            for a in range(surface.shapes.shape[1]):
                ir, iz = state.equation[2 * surface.nodes[i, a]], state.equation[2 * surface.nodes[i, a] + 1]
                share = surface.shapes[i, a] * apart
                if ir < free:
                    state.residual[ir] = state.residual[ir] + share * krz
                    state.reaction[ir] = state.reaction[ir] + share * kzr
                if iz < free:
                    state.residual[iz] = state.residual[iz] + share * kzz
                    state.reaction[iz] = state.reaction[iz] + share * kzz
        return stiff

    return ContactStiffnessFunctions(clear_factorised_contact_stiffness, find_first_changed_and_slipping_rows,
                                     add_contact_stiffness_to_matrix,
                                     has_contact_stiffness_changed, add_depth_derivatives_and_get_stiffness)


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
    compute_gap_and_normal = make_gap_function()

    @ti.func
    def add_contact_forces_and_update_active_set(count, changeable, slack, pending, bending, depth, free,
                                                 settings: ti.template(), surface: ti.template(), state: ti.template()):
        """Add the contact forces to the residual; store their derivatives and the constraint residuals in `rates`.

        Args (scalars): `changeable`: which points may change their contact state (0: none, `ALL_POINTS`, or a number
        that selects some); `slack`: gap below which a point counts as touching, m; `pending`: 1 if the motion of the
        tool is still to be made in this step; `bending`: factor of the surface curvature in the derivatives; `depth`:
        depth of the tool before a motion that is still to be made, m.

        Returns the axial force on the tool, the sum of the squares of all forces, the largest violation of a contact
        condition (m), and the numbers of points that slip, that changed their state, and that should change their
        state but were not selected.
        """
        axial, squares, violation, slipping, switched, wanting = 0.0, 0.0, 0.0, 0, 0, 0
        # Motion that is still to be made, and difference between z in the frame of the tool and z, m.
        move, lift = settings[StepSettingIndex.DEPTH] - depth, depth - settings[StepSettingIndex.TOUCH]
        tolerance, reach = settings[StepSettingIndex.CONTACT_TOLERANCE], settings[StepSettingIndex.REACH]
        negligible = NEWTON.friction_floor * settings[StepSettingIndex.FLOOR]
        multipliers = state.x.shape[0] - 2 * surface.springs.shape[0]
        for i in range(count):
            moves = float(surface.spans[i, OutlineSpanColumn.MOVES])
            # Displacement in the frame of the body; its differences have smaller rounding errors than positions.
            ur, uz = 0.0, moves * lift
            for a in range(surface.shapes.shape[1]):
                ur += surface.shapes[i, a] * state.x[2 * surface.nodes[i, a]]
                uz += surface.shapes[i, a] * state.x[2 * surface.nodes[i, a] + 1]
            bound = surface.held[i, 0]
            # A point without slip that touched in this step stays at the face that it touched: before convergence
            # another face may be closer to a point at an edge.
            clings = bound == TOUCHED and surface.friction[i, 0] < 0.0
            r = surface.places[i, 0] + (surface.held[i, 1] if clings else ur)
            z = surface.places[i, 1] + (surface.held[i, 2] if clings else uz)
            gap, nr, nz, curved, line = compute_gap_and_normal(r, z, i, depth, surface)
            if clings:
                gap, curved = (ur - surface.held[i, 1]) * nr + (uz - surface.held[i, 2]) * nz, 0.0
            # Rounded edges have the friction of the face.
            on_face = curved > 0.0 or line < surface.spans[i, OutlineSpanColumn.SHAFT]
            mu = surface.friction[i, 0] if on_face else surface.friction[i, 1]
            spring = surface.springs[i]
            at = multipliers + 2 * i
            along = state.x[at + 1] * nr - state.x[at] * nz
            normal = state.x[at] * nr + state.x[at + 1] * nz
            if surface.spans[i, OutlineSpanColumn.STAYS] == 0:
                normal = ti.min(normal, 0.0)
            trial = normal + ACTIVE_SET.augmentation_factor * spring * gap
            acting = 0.0
            fr, fz, krr, krz, kzr, kzz, missed_r, missed_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            drawn = (changeable == ALL_POINTS
                     or (changeable > 0 and (7 * i + 5 * changeable) % ACTIVE_SET.draw_interval == 0))
            if changeable > 0 and bound != HELD:
                presses = 1.0 if trial < 0.0 or gap < slack or surface.spans[i, OutlineSpanColumn.STAYS] == 1 else 0.0
                if ti.static(not has_laws):
                    if pending == 1 and bound == TOUCHED and mu != 0.0:
                        # The tool is about to reach the point.
                        presses = 1.0
                if presses != surface.pressed[i]:
                    if drawn:
                        switched += 1
                        surface.pressed[i] = presses
                    elif trial > negligible / CONE_TOLERANCE:
                        wanting += 1
            surface.met[i, 0] = FREE
            if mu > 0.0 and gap <= 1e-3 * tolerance:
                # The point touches, with or without force.
                surface.met[i, 0], surface.met[i, 1], surface.met[i, 2] = TOUCHED, ur - gap * nr, uz - gap * nz
                if bound == TOUCHED:
                    surface.met[i, 1], surface.met[i, 2] = surface.held[i, 1], surface.held[i, 2]
            if bound == HELD:
                spring *= PENALTY.stick_factor
                dr, dz = ur - surface.held[i, 1], uz - surface.held[i, 2]
                fr, fz, missed_r, missed_z = state.x[at], state.x[at + 1], dr, dz
                krr, kzz = spring, spring
                violation = ti.max(violation, ti.sqrt(dr * dr + dz * dz))
            elif surface.pressed[i] == 1.0:
                tr, tz = -nz, nr
                fr, fz = normal * nr, normal * nz
                missed_r, missed_z = gap * nr, gap * nz
                # Derivatives in the normal-tangential frame: nn, nt, tn, tt.
                nn, nt, tn, tt = spring, 0.0, 0.0, bending * normal * curved
                violation = ti.max(violation, ti.abs(gap))
                if mu != 0.0:
                    surface.met[i, 0] = HELD if mu < 0.0 else TOUCHED
                    surface.met[i, 1], surface.met[i, 2] = ur - gap * nr, uz - gap * nz
                # Negligible friction would alternate between stick and slip. A point without slip that touched in this
                # step sticks from the beginning of the increment.
                weighty = mu < 0.0 or mu * ti.max(-trial, 0.0) > negligible or pending == 1
                if mu != 0.0 and bound == TOUCHED and weighty:
                    acting = ti.max(mu, 0.0)
                    slip = (ur - surface.held[i, 1]) * tr + (uz - surface.held[i, 2]) * tz
                    drag, limit = along, mu * ti.max(-normal, 0.0)
                    way = surface.slip_signs[i]
                    if changeable > 0 and mu > 0.0:
                        tried = drag + ACTIVE_SET.augmentation_factor * spring * slip
                        # A slipping point must stick before it slips in the other direction; otherwise it alternates.
                        if way != 0.0:
                            way = way if way * slip > 0.0 else 0.0
                        elif ti.abs(tried) > mu * ti.max(-trial, 0.0):
                            way = 1.0 if tried > 0.0 else -1.0
                        if way != surface.slip_signs[i]:
                            if drawn:
                                surface.slip_signs[i] = way
                                switched += 1
                            else:
                                if ti.abs(slip) > 1e-3 * tolerance or ti.abs(drag) > (1.0 + CONE_TOLERANCE) * limit:
                                    wanting += 1
                                way = surface.slip_signs[i]
                    if way == 0.0:
                        tt += PENALTY.stick_factor * spring - bending * curved * normal
                        missed_r += slip * tr
                        missed_z += slip * tz
                        surface.met[i, 1], surface.met[i, 2] = surface.held[i, 1], surface.held[i, 2]
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
            surface.forces[i, 0], surface.forces[i, 1] = fr, fz
            state.x[at], state.x[at + 1] = fr, fz
            lrr, lrz, lzz = 0.0, 0.0, 0.0
            if ti.static(has_laws):
                if moves > 0.0 and bound != HELD:
                    touches = krr != 0.0 or kzz != 0.0
                    near = bound == TOUCHED and gap < reach
                    if surface.met[i, 0] == FREE and (touches or near):
                        surface.met[i, 0], surface.met[i, 1], surface.met[i, 2] = TOUCHED, ur - gap * nr, uz - gap * nz
                        if mu == 0.0 and bound == TOUCHED:
                            surface.met[i, 1], surface.met[i, 2] = surface.held[i, 1], surface.held[i, 2]
                    if near and surface.areas[i] > 0.0:
                        tr, tz = -nz, nr
                        area = surface.areas[i]
                        slip = (ur - surface.held[i, 1]) * tr + (uz - surface.held[i, 2]) * tz
                        pull, drag, nn, tt = law.evaluate_traction(gap, ti.max(-normal, 0.0) / area, slip,
                                                                   surface.law_settings)
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
            surface.rates[i, ContactLinearisationColumn.RR], surface.rates[i, ContactLinearisationColumn.RZ] = krr, krz
            surface.rates[i, ContactLinearisationColumn.ZR], surface.rates[i, ContactLinearisationColumn.ZZ] = kzr, kzz
            surface.rates[i, ContactLinearisationColumn.NORMAL_R] = nr
            surface.rates[i, ContactLinearisationColumn.NORMAL_Z] = nz
            surface.rates[i, ContactLinearisationColumn.FRICTION] = acting
            surface.rates[i, ContactLinearisationColumn.ON_SHAFT] = 0.0 if on_face else 1.0
            surface.rates[i, ContactLinearisationColumn.MISSED_R] = missed_r
            surface.rates[i, ContactLinearisationColumn.MISSED_Z] = missed_z
            (surface.rates[i, ContactLinearisationColumn.LAW_RR], surface.rates[i, ContactLinearisationColumn.LAW_RZ],
             surface.rates[i, ContactLinearisationColumn.LAW_ZZ]) = lrr, lrz, lzz
            axial += moves * fz
            squares += fr * fr + fz * fz
            if pending == 1:
                # Motion of the tool, and of the nodes that move with the tool.
                pr, pz = 0.0, moves * move
                for a in range(surface.shapes.shape[1]):
                    dof = 2 * surface.nodes[i, a]
                    if state.equation[dof] >= free:
                        pr += surface.shapes[i, a] * (state.target[dof] - state.x[dof])
                    if state.equation[dof + 1] >= free:
                        pz += surface.shapes[i, a] * (state.target[dof + 1] - state.x[dof + 1])
                fr += krr * pr + krz * pz
                fz += kzr * pr + kzz * pz
            for a in range(surface.shapes.shape[1]):
                ir, iz = state.equation[2 * surface.nodes[i, a]], state.equation[2 * surface.nodes[i, a] + 1]
                state.residual[ir] = state.residual[ir] + surface.shapes[i, a] * fr
                state.residual[iz] = state.residual[iz] + surface.shapes[i, a] * fz
        return axial, squares, violation, slipping, switched, wanting

    @ti.func
    def compute_force_change_with_gap_correction(i, pr, pz, surface: ti.template()):
        """Return the change of a point's force for a displacement (pr, pz) and for its constraint residual.

        The derivatives are those in the matrix, because others would leave large unbalanced penalty forces.
        """
        krr = surface.known_rates[i, FactorisedRateColumn.RR] - surface.known_rates[i, FactorisedRateColumn.LAW_RR]
        krz = surface.known_rates[i, FactorisedRateColumn.RZ] - surface.known_rates[i, FactorisedRateColumn.LAW_RZ]
        kzr = surface.known_rates[i, FactorisedRateColumn.ZR] - surface.known_rates[i, FactorisedRateColumn.LAW_RZ]
        kzz = surface.known_rates[i, FactorisedRateColumn.ZZ] - surface.known_rates[i, FactorisedRateColumn.LAW_ZZ]
        wr = pr + surface.rates[i, ContactLinearisationColumn.MISSED_R]
        wz = pz + surface.rates[i, ContactLinearisationColumn.MISSED_Z]
        return krr * wr + krz * wz, kzr * wr + kzz * wz

    @ti.func
    def add_constraint_residual_forces(count, surface: ti.template(), state: ti.template()):
        """Add the penalty forces of the constraint residuals to the right-hand side (`residual`) of a linear solve."""
        for i in range(count):
            fr, fz = compute_force_change_with_gap_correction(i, 0.0, 0.0, surface)
            for a in range(surface.shapes.shape[1]):
                ir, iz = state.equation[2 * surface.nodes[i, a]], state.equation[2 * surface.nodes[i, a] + 1]
                state.residual[ir] = state.residual[ir] + surface.shapes[i, a] * fr
                state.residual[iz] = state.residual[iz] + surface.shapes[i, a] * fz

    @ti.func
    def update_contact_forces_after_linear_solve(count, move, surface: ti.template(), state: ti.template()):
        """Update the contact forces after a linear solve in which the tool moved down by `move`, m."""
        multipliers = state.x.shape[0] - 2 * surface.springs.shape[0]
        for i in range(count):
            pr, pz = 0.0, float(surface.spans[i, OutlineSpanColumn.MOVES]) * move
            for a in range(surface.shapes.shape[1]):
                pr += surface.shapes[i, a] * state.motion[2 * surface.nodes[i, a]]
                pz += surface.shapes[i, a] * state.motion[2 * surface.nodes[i, a] + 1]
            fr, fz = compute_force_change_with_gap_correction(i, pr, pz, surface)
            at = multipliers + 2 * i
            state.x[at] = state.x[at] + fr
            state.x[at + 1] = state.x[at + 1] + fz

    @ti.func
    def subtract_contact_forces(count, surface: ti.template(), state: ti.template()):
        """Subtract the present contact forces from the residual.

        The linearised tissue balances these forces, so that only the forces of the next
        `add_contact_forces_and_update_active_set` act as a load.
        """
        multipliers = state.x.shape[0] - 2 * surface.springs.shape[0]
        for i in range(count):
            at = multipliers + 2 * i
            for a in range(surface.shapes.shape[1]):
                ir, iz = state.equation[2 * surface.nodes[i, a]], state.equation[2 * surface.nodes[i, a] + 1]
                state.residual[ir] = state.residual[ir] - surface.shapes[i, a] * state.x[at]
                state.residual[iz] = state.residual[iz] - surface.shapes[i, a] * state.x[at + 1]

    @ti.func
    def release_points_under_tension(count, negligible, strength, reach, surface: ti.template()):
        """Release held points whose tension exceeds the strength at an equilibrium; return their number.

        Args (scalars): `negligible`: tension that counts as a rounding error, as at the first touch, N; `strength`:
        largest tension per area, Pa; `reach`: largest gap at which contact laws act, m; 0 without laws.
        """
        released = 0
        for i in range(count):
            if surface.held[i, 0] == HELD and surface.spans[i, OutlineSpanColumn.STAYS] == 0:
                r, z = surface.places[i, 0] + surface.held[i, 1], surface.places[i, 1] + surface.held[i, 2]
                _, nr, nz, _, _ = compute_gap_and_normal(r, z, i, 0.0, surface)
                if nr * surface.forces[i, 0] + nz * surface.forces[i, 1] > strength * surface.areas[i] + negligible:
                    released += 1
                    surface.held[i, 0] = TOUCHED if reach > 0.0 else FREE
        return released

    @ti.func
    def commit_contact_bonds_and_count_changes(count, surface: ti.template()):
        """Copy the bonds found in this step (`met`) to `held`; return the number of bonds that changed."""
        bound = 0
        for i in range(count):
            if surface.held[i, 0] != HELD:
                if surface.held[i, 0] != surface.met[i, 0]:
                    bound += 1
                for k in ti.static(range(3)):
                    surface.held[i, k] = surface.met[i, k]
        return bound

    return ContactForceFunctions(add_contact_forces_and_update_active_set, add_constraint_residual_forces,
                                 update_contact_forces_after_linear_solve,
                                 subtract_contact_forces, release_points_under_tension,
                                 commit_contact_bonds_and_count_changes)
