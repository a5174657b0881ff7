"""Contact forces at the Gauss points of the surface's edges, as Taichi functions.

Augmented Lagrangian (Simo and Laursen, Computers & Structures 42 (1992) 97): the force of a point is its multiplier,
which is the force of the last equilibrium, plus that of a spring for the distance by which the point violates the
contact condition. An equilibrium whose violation exceeds the tolerance makes its forces the multipliers and is solved
again. The multipliers stand in the state behind the pressures and are extrapolated with it.

A point on a face without slip is held where it touched. With friction the tangential force is that of a spring
between the point and where it was at the last equilibrium, but not more than mu times the normal force as it is now;
slip thus makes the tangent unsymmetric.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.axisymmetric.contact import FIRST_LINE, HOLD, LAST_LINE, MOVES, SHAFT, STAYS
from tissue_sim.fem.axisymmetric.contact_laws import law_functions
from tissue_sim.fem.linear.band import add_any_function, add_entry_function
from tissue_sim.fem.taichi.runtime import initialise
from tissue_sim.fem.taichi.trace import Formula

#: How a point is bound to the body: not at all, held by an interface without slip, touching with friction.
FREE, HELD, TOUCHED = 0.0, 1.0, 2.0


#: A rate has changed if it did by this share of its spring.
CHANGED = 0.01


class ContactFunctions(NamedTuple):
    """Taichi functions of contact."""

    add_contact: object
    add_rates: object
    note_rates: object
    have_changed: object
    add_tool_rates: object
    augment: object
    hold: object


@cache
def functions(slips: bool, laws: tuple[Formula, ...] = ()) -> ContactFunctions:
    """See the functions themselves; without `slips` nothing ever does, without `laws` there are contact and friction
    alone."""
    ti = initialise()
    add_entry, add_any = add_entry_function(), add_any_function()
    has_laws, law = bool(laws), law_functions(laws)
    far = 1e30

    @ti.func
    def nearest(r, z, m, spans: ti.template(), vertices: ti.template(), rounding: ti.template()):
        """Gap, outward normal, curvature of the surface, and line of the body's chain that is nearest to (r, z)."""
        first = spans[m, FIRST_LINE]
        best, gap, nr, nz, curved, line = far, far, 0.0, 0.0, 0.0, first
        front_best = 0.0
        for s in range(first, spans[m, LAST_LINE] + 1):
            tr, tz = vertices[s + 1, 0] - vertices[s, 0], vertices[s + 1, 1] - vertices[s, 1]
            length = ti.sqrt(tr * tr + tz * tz)
            tr, tz = tr / length, tz / length
            dr, dz = r - vertices[s, 0], z - vertices[s, 1]
            along = dr * tr + dz * tz
            share = ti.min(ti.max(along, 0.0), length)
            dr, dz = dr - share * tr, dz - share * tz
            distance = ti.sqrt(dr * dr + dz * dz)
            front = dr * tz - dz * tr
            # At a vertex two lines are equally near: the one that the point stands farther in front of decides.
            if distance < best - 1e-15 or (distance < best + 1e-15 and ti.abs(front) > ti.abs(front_best)):
                best, front_best, line = distance, front, s
                # Before the start of the chain there is no inside.
                inside = front < 0.0 and not (s == first and along < 0.0)
                sign = -1.0 if inside else 1.0
                gap = sign * distance - rounding[m]
                beyond = along < 0.0 or along > length
                nr, nz, curved = tz, -tr, 0.0
                if beyond and distance > 0.0:
                    nr, nz = sign * dr / distance, sign * dz / distance
                    curved = 1.0 / distance
        return gap, nr, nz, curved, line

    @ti.func
    def add_contact(count, changeable, slack, pending, bending, move, lift, free, tolerance, negligible, reach,
                    law_settings: ti.template(), multipliers, edges: ti.template(), spans: ti.template(),
                    shapes: ti.template(), places: ti.template(), areas: ti.template(), vertices: ti.template(),
                    rounding: ti.template(), friction: ti.template(), springs: ti.template(), held: ti.template(),
                    ways: ti.template(), met: ti.template(), forces: ti.template(), rates: ti.template(),
                    x: ti.template(), target: ti.template(), equation: ti.template(), residual: ti.template()):
        """Add the contact forces to the residual, and note their rates with the motion of the points.

        Of the points at most `changeable` change between sticking and slipping: none but at the first look at a state,
        and one at a time where all at once would go round in circles. What is nearer than `slack` counts as touching.
        `lift` takes z into the frame of the tool, `move` is what the tool still has to go down in this step; friction
        below `negligible` (N) is none. Laws of contact act on what has touched the tool up to their `reach`. Returns
        the axial force on the tool, the sum of the squares of all forces, the largest violation of the contact
        conditions and how many points slip.
        """
        axial, squares, violation, slipping, changes = 0.0, 0.0, 0.0, 0, changeable
        n = shapes.shape[2]
        for m in range(count):
            moves = float(spans[m, MOVES])
            for q in range(places.shape[1]):
                # Travel in the frame of the body: small differences of it are more exact than those of places.
                ur, uz = 0.0, moves * lift
                for a in range(n):
                    ur += shapes[m, q, a] * x[2 * edges[m, a]]
                    uz += shapes[m, q, a] * x[2 * edges[m, a] + 1]
                gap, nr, nz, curved, line = nearest(places[m, q, 0] + ur, places[m, q, 1] + uz, m, spans, vertices,
                                                    rounding)
                # What is rounded belongs to the face.
                mu = friction[m, 0] if curved > 0.0 or line < spans[m, SHAFT] else friction[m, 1]
                spring = springs[m, q]
                at = multipliers + 2 * (m * places.shape[1] + q)
                along = x[at + 1] * nr - x[at] * nz
                normal = x[at] * nr + x[at + 1] * nz
                if spans[m, STAYS] == 0:
                    normal = ti.min(normal, 0.0)
                normal += spring * gap
                fr, fz, krr, krz, kzr, kzz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                bound = held[m, q, 0]
                met[m, q, 0] = FREE
                if mu > 0.0 and gap <= 1e-3 * tolerance:
                    # It touches, with or without force.
                    met[m, q, 0], met[m, q, 1], met[m, q, 2] = TOUCHED, ur - gap * nr, uz - gap * nz
                    if bound == TOUCHED:
                        met[m, q, 1], met[m, q, 2] = held[m, q, 1], held[m, q, 2]
                if bound == HELD:
                    spring *= HOLD
                    dr, dz = ur - held[m, q, 1], uz - held[m, q, 2]
                    fr, fz = x[at] + spring * dr, x[at + 1] + spring * dz
                    krr, kzz = spring, spring
                    violation = ti.max(violation, ti.sqrt(dr * dr + dz * dz))
                elif spring > 0.0 and (normal < 0.0 or gap < slack or spans[m, STAYS] == 1):
                    tr, tz = -nz, nr
                    fr, fz = normal * nr, normal * nz
                    # Rates along the normal and the tangent: nn, nt, tn, tt.
                    nn, nt, tn, tt = spring, 0.0, 0.0, bending * normal * curved
                    violation = ti.max(violation, ti.abs(gap))
                    if mu != 0.0:
                        met[m, q, 0] = HELD if mu < 0.0 else TOUCHED
                        met[m, q, 1], met[m, q, 2] = ur - gap * nr, uz - gap * nz
                    # Friction too small to count would only chatter.
                    weighty = mu * ti.max(-normal, 0.0) > negligible or pending == 1
                    if mu > 0.0 and bound == TOUCHED and weighty:
                        slip = (ur - held[m, q, 1]) * tr + (uz - held[m, q, 2]) * tz
                        drag, limit = along + HOLD * spring * slip, mu * ti.max(-normal, 0.0)
                        # What slips one way has to stick before it slips the other way, else it would jump to and fro.
                        way = ways[m, q]
                        if changes > 0:
                            if way != 0.0:
                                way = way if way * slip > 0.0 else 0.0
                            elif ti.abs(drag) > limit:
                                way = 1.0 if drag > 0.0 else -1.0
                            if way != ways[m, q]:
                                ways[m, q] = way
                                changes -= 1
                        if way == 0.0:
                            tt += HOLD * spring - bending * curved * (normal - spring * gap)
                            met[m, q, 1], met[m, q, 2] = held[m, q, 1], held[m, q, 2]
                            violation = ti.max(violation, ti.abs(slip))
                        else:
                            drag = way * limit
                            slipping += 1
                            if normal < 0.0:
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
                forces[m, q, 0], forces[m, q, 1] = fr, fz
                if ti.static(has_laws):
                    if moves > 0.0 and bound != HELD:
                        touches = krr != 0.0 or kzz != 0.0
                        near = bound == TOUCHED and gap < reach
                        if met[m, q, 0] == FREE and (touches or near):
                            met[m, q, 0], met[m, q, 1], met[m, q, 2] = TOUCHED, ur - gap * nr, uz - gap * nz
                            if mu == 0.0 and bound == TOUCHED:
                                met[m, q, 1], met[m, q, 2] = held[m, q, 1], held[m, q, 2]
                        if near and areas[m, q] > 0.0:
                            tr, tz = -nz, nr
                            area = areas[m, q]
                            slip = (ur - held[m, q, 1]) * tr + (uz - held[m, q, 2]) * tz
                            pull, drag, nn, tt = law.traction(gap, ti.max(-normal, 0.0) / area, slip, law_settings)
                            fr += area * pull * nr
                            fz += area * pull * nz
                            if ti.static(law.drags):
                                fr += area * drag * tr
                                fz += area * drag * tz
                            if ti.static(law.stiffens):
                                krr += area * (nn * nr * nr + tt * tr * tr)
                                krz += area * (nn * nr * nz + tt * tr * tz)
                                kzr += area * (nn * nr * nz + tt * tr * tz)
                                kzz += area * (nn * nz * nz + tt * tz * tz)
                rates[m, q, 0], rates[m, q, 1], rates[m, q, 2], rates[m, q, 3] = krr, krz, kzr, kzz
                rates[m, q, 4], rates[m, q, 5], rates[m, q, 6] = nr, nz, mu
                axial += moves * fz
                squares += fr * fr + fz * fz
                if fr != 0.0 or fz != 0.0 or krr != 0.0 or kzz != 0.0:
                    if pending == 1:
                        # The way of the tool, and that of nodes which follow it.
                        pr, pz = 0.0, moves * move
                        for a in range(n):
                            dof = 2 * edges[m, a]
                            if equation[dof] >= free:
                                pr += shapes[m, q, a] * (target[dof] - x[dof])
                            if equation[dof + 1] >= free:
                                pz += shapes[m, q, a] * (target[dof + 1] - x[dof + 1])
                        fr += krr * pr + krz * pz
                        fz += kzr * pr + kzz * pz
                    for a in range(n):
                        ir, iz = equation[2 * edges[m, a]], equation[2 * edges[m, a] + 1]
                        residual[ir] = residual[ir] + shapes[m, q, a] * fr
                        residual[iz] = residual[iz] + shapes[m, q, a] * fz
        return axial, squares, violation, slipping

    @ti.func
    def add_rates(count, slipping, free, width, edges: ti.template(), shapes: ti.template(), rates: ti.template(),
                  equation: ti.template(), entries: ti.template(), upper: ti.template()):
        """Add the rates of the contact forces to the matrix; only where points slip it needs its upper half."""
        n = shapes.shape[2]
        for m in range(count):
            for q in range(rates.shape[1]):
                krr, krz, kzr, kzz = rates[m, q, 0], rates[m, q, 1], rates[m, q, 2], rates[m, q, 3]
                if krr != 0.0 or kzz != 0.0:
                    for a in range(n):
                        ir, iz = equation[2 * edges[m, a]], equation[2 * edges[m, a] + 1]
                        for b in range(n):
                            share = shapes[m, q, a] * shapes[m, q, b]
                            jr, jz = equation[2 * edges[m, b]], equation[2 * edges[m, b] + 1]
                            if ti.static(slips):
                                if slipping > 0:
                                    add_any(ir, jr, share * krr, free, width, entries, upper)
                                    add_any(ir, jz, share * krz, free, width, entries, upper)
                                    add_any(iz, jr, share * kzr, free, width, entries, upper)
                                    add_any(iz, jz, share * kzz, free, width, entries, upper)
                            if slipping == 0:
                                add_entry(ir, jr, share * krr, free, width, entries)
                                add_entry(ir, jz, share * krz, free, width, entries)
                                add_entry(iz, jr, share * kzr, free, width, entries)
                                add_entry(iz, jz, share * kzz, free, width, entries)

    @ti.func
    def note_rates(count, rates: ti.template(), known: ti.template()):
        """Remember the rates that the matrix holds."""
        for m in range(count):
            for q in range(rates.shape[1]):
                for i in ti.static(range(4)):
                    known[m, q, i] = rates[m, q, i]

    @ti.func
    def have_changed(count, springs: ti.template(), rates: ti.template(), known: ti.template()):
        """Whether a point has met or left a body, stuck or slipped, since the rates were noted."""
        changed = 0
        for m in range(count):
            for q in range(rates.shape[1]):
                for i in ti.static(range(4)):
                    if ti.abs(rates[m, q, i] - known[m, q, i]) > CHANGED * springs[m, q]:
                        changed = 1
        return changed

    @ti.func
    def add_tool_rates(count, free, edges: ti.template(), spans: ti.template(), shapes: ti.template(),
                       rates: ti.template(), direction: ti.template(), equation: ti.template(), pull: ti.template(),
                       reaction: ti.template()):
        """Add the rates of the contact forces with the depth of the tool, the tissue held, to `pull`, and those of the
        force on the tool with the tissue's motion to `reaction`; returns that of the force itself, N/m."""
        n, stiff = shapes.shape[2], 0.0
        for m in range(count):
            for q in range(rates.shape[1]):
                krz, kzr, kzz = rates[m, q, 1], rates[m, q, 2], rates[m, q, 3]
                # How the point moves in the frame of its body when only the tool and what follows it does.
                apart = float(spans[m, MOVES])
                for a in range(n):
                    dof = 2 * edges[m, a] + 1
                    if equation[dof] >= free:
                        apart += shapes[m, q, a] * direction[dof]
                if apart != 0.0 and (rates[m, q, 0] != 0.0 or kzz != 0.0):
                    stiff += apart * apart * kzz
                    for a in range(n):
                        ir, iz = equation[2 * edges[m, a]], equation[2 * edges[m, a] + 1]
                        share = shapes[m, q, a] * apart
                        if ir < free:
                            pull[ir] = pull[ir] + share * krz
                            reaction[ir] = reaction[ir] + share * kzr
                        if iz < free:
                            pull[iz] = pull[iz] + share * kzz
                            reaction[iz] = reaction[iz] + share * kzz
        return stiff

    @ti.func
    def augment(count, multipliers, strength, reach, places: ti.template(), areas: ti.template(), spans: ti.template(),
                vertices: ti.template(), rounding: ti.template(), held: ti.template(), forces: ti.template(),
                x: ti.template()):
        """Make the forces of an equilibrium the multipliers, and let go of edges that pull; returns how many do.

        What an edge holds, it holds or lets go as a whole: point by point the tractions beside a sharp edge oscillate,
        and their average tells whether it is pulled. The equilibrium decides, not the way to it.
        """
        released = 0
        for m in range(count):
            pull = 0.0
            for q in range(forces.shape[1]):
                pull -= strength * areas[m, q]
                at = multipliers + 2 * (m * forces.shape[1] + q)
                x[at], x[at + 1] = forces[m, q, 0], forces[m, q, 1]
                if held[m, q, 0] == HELD:
                    r, z = places[m, q, 0] + held[m, q, 1], places[m, q, 1] + held[m, q, 2]
                    _, nr, nz, _, _ = nearest(r, z, m, spans, vertices, rounding)
                    pull += nr * forces[m, q, 0] + nz * forces[m, q, 1]
            if pull > 0.0 and spans[m, STAYS] == 0:
                for q in range(forces.shape[1]):
                    if held[m, q, 0] == HELD:
                        released += 1
                        held[m, q, 0] = TOUCHED if reach > 0.0 else FREE
        return released

    @ti.func
    def hold(count, held: ti.template(), met: ti.template()):
        """Bind the points to what they met in this step."""
        for m in range(count):
            for q in range(held.shape[1]):
                if held[m, q, 0] != HELD:
                    for i in ti.static(range(3)):
                        held[m, q, i] = met[m, q, i]

    return ContactFunctions(add_contact, add_rates, note_rates, have_changed, add_tool_rates, augment, hold)
