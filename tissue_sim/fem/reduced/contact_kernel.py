"""Contact of nodes with a rigid body of revolution through a thin elastic layer, as a Taichi kernel.

The nearest place of the body is found as in `tissue_sim.fem.solid.contact.nearest`.
"""

from functools import cache

from tissue_sim.fem.taichi.runtime import initialise

#: States of a node.
FREE, STICKS, SLIPS = range(3)
#: Places in `settings`: rotation of the body, place of its origin, rounding radius of its outline, half of the width of
#: the zone in which the layer takes hold, m, whether the body is where it touched or deeper, and within which share of
#: the limit of friction a node counts as slipping.
ROTATION, ORIGIN, ROUNDING, ZONE, PRESSED_IN, AT_LIMIT, SETTINGS = 0, 9, 12, 13, 14, 15, 16
#: Places in `report`: how many nodes touch, how many of them slip, and how far the deepest is in the body, m.
TOUCHING, SLIPPING, DEPTH, REPORT = 0, 1, 2, 3


@cache
def contact_kernel():
    """Kernel of the forces on nodes, in the frame of the mesh, and of what they and minus their derivatives with the
    nodes' places are on the modes.

    A node that is x away from the body is pressed by spring times phi(x): phi is -x where x < -zone, 0 where x > zone
    and a parabola between them. Along the surface its anchor, which stands in the frame of the body, holds it by the
    same spring, up to friction times pressure. ``first`` is the first line of the outline that a node may
    meet, ``closed`` whether a sharp shaft goes on downwards for it.

    The modes are followed by six ways of the tool: its position and a rotation about its origin. Of the nodes that
    touch, in their order, ``met`` gets how the modes move them and how they would go with the tool, ``answers`` how the
    forces change with either; shape (3 nodes, modes + 6). ``pushes`` gets the forces on them, ``twists`` the torque of
    the forces where the modes move their nodes.
    """
    ti = initialise()
    real1, real2, real3 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2, 3))
    int1 = ti.types.ndarray(ti.i32, ndim=1)

    @ti.func
    def meet(n, settings: ti.template(), vertices: ti.template(), shaft: ti.template(), places: ti.template(),
             moved: ti.template(), springs: ti.template(), friction: ti.template(), first: ti.template(),
             closed: ti.template(), anchors: ti.template(), touched: ti.template(), forces: ti.template(),
             rates: ti.template(), gaps: ti.template(), new_anchors: ti.template(), states: ti.template()):
        """Find the force on a node, and minus its derivative with the node's place, in the frame of the mesh."""
        turn = ti.Matrix([[settings[ROTATION + 3 * i + k] for k in ti.static(range(3))]
                          for i in ti.static(range(3))])
        offset = ti.Vector([places[n, i] + moved[n, i] - settings[ORIGIN + i] for i in ti.static(range(3))])
        at = turn.transpose() @ offset
        r, z = ti.sqrt(at[0] * at[0] + at[1] * at[1]), at[2]
        endless = 0
        if closed[n] > 0 and settings[PRESSED_IN] > 0.0 and first[n] == shaft[0] and settings[ROUNDING] == 0.0:
            endless = 1
        best, near, front, beyond, arrow_r, arrow_z, before = -1, 1e30, 0.0, 0, 0.0, 0.0, 0
        for line in range(first[n], vertices.shape[0] - 1):
            start_r, start_z = vertices[line, 0], vertices[line, 1]
            way_r, way_z = vertices[line + 1, 0] - start_r, vertices[line + 1, 1] - start_z
            length = ti.sqrt(way_r * way_r + way_z * way_z)
            t_r, t_z = way_r / length, way_z / length
            along = (r - start_r) * t_r + (z - start_z) * t_z
            share = ti.min(along, length)
            if not (endless == 1 and line == first[n]):
                share = ti.max(share, 0.0)
            a_r, a_z = r - start_r - share * t_r, z - start_z - share * t_z
            distance = ti.sqrt(a_r * a_r + a_z * a_z)
            ahead = a_r * t_z - a_z * t_r
            # At a vertex the line decides that the point stands farther in front of.
            if distance < near - 1e-15 or (distance < near + 1e-15 and ti.abs(ahead) > ti.abs(front)):
                best, near, front, arrow_r, arrow_z = line, distance, ahead, a_r, a_z
                beyond = 1 if share != along and distance > 0.0 else 0
                before = 1 if line == first[n] and along < 0.0 and endless == 0 else 0
        sign = -1.0 if front < 0.0 and before == 0 else 1.0
        way_r = vertices[best + 1, 0] - vertices[best, 0]
        way_z = vertices[best + 1, 1] - vertices[best, 1]
        length = ti.sqrt(way_r * way_r + way_z * way_z)
        n_r, n_z, bent = way_z / length, -way_r / length, 0.0
        if beyond == 1:
            n_r, n_z, bent = sign * arrow_r / near, sign * arrow_z / near, sign / near
        gap = sign * near - settings[ROUNDING]
        gaps[n] = gap
        zone = settings[ZONE]
        states[n] = FREE
        for i in ti.static(range(3)):
            new_anchors[n, i] = at[i]
        if gap < zone:
            depth, slope = -gap, 1.0
            if gap > -zone:
                depth, slope = (zone - gap) * (zone - gap) / (4.0 * zone), (zone - gap) / (2.0 * zone)
            out = ti.Vector([1.0, 0.0])
            hoop = bent
            if r > 1e-12:
                out = ti.Vector([at[0] / r, at[1] / r])
                hoop = n_r / r
            normal = ti.Vector([n_r * out[0], n_r * out[1], n_z])
            meridian = ti.Vector([-n_z * out[0], -n_z * out[1], n_r])
            around = ti.Vector([-out[1], out[0], 0.0])
            spring = springs[n]
            pressure = spring * depth
            nn = normal.outer_product(normal)
            rate = spring * slope * nn - pressure * (bent * meridian.outer_product(meridian)
                                                     + hoop * around.outer_product(around))
            force = pressure * normal
            states[n] = STICKS
            on_shaft = 1 if best >= shaft[0] and not (beyond == 1 and settings[ROUNDING] > 0.0) else 0
            mu = friction[n, on_shaft]
            # What comes into contact in this step is bound from its end on.
            if mu > 0.0 and touched[n] > 0:
                anchor = ti.Vector([anchors[n, i] for i in ti.static(range(3))])
                slip = at - anchor
                slip = slip - slip.dot(normal) * normal
                size, limit = slip.norm(), mu * pressure
                tangent = ti.Matrix.identity(ti.f64, 3) - nn
                share = 1.0
                if spring * size > (1.0 - settings[AT_LIMIT]) * limit and size > 0.0:
                    states[n] = SLIPS
                    share = ti.min(1.0, limit / (spring * size))
                    way = slip / size
                    rate = rate + spring * share * (tangent - way.outer_product(way)) \
                        + mu * spring * slope * way.outer_product(-normal)
                else:
                    rate = rate + spring * tangent
                force = force - spring * share * slip
                for i in ti.static(range(3)):
                    new_anchors[n, i] = at[i] - share * slip[i]
            force = turn @ force
            rate = turn @ rate @ turn.transpose()
            for i in ti.static(range(3)):
                forces[n, i] = force[i]
                for k in ti.static(range(3)):
                    rates[n, i, k] = rate[i, k]

    @ti.func
    def note(n, at, settings: ti.template(), places: ti.template(), moved: ti.template(), forces: ti.template(),
             rates: ti.template(), rows: ti.template(), met: ti.template(), answers: ti.template(),
             pushes: ti.template(), twists: ti.template()):
        """Add a node that touches, from this row on, to what is known on the modes."""
        modes = rows.shape[1]
        force = ti.Vector([forces[n, i] for i in ti.static(range(3))])
        rate = ti.Matrix([[rates[n, i, k] for k in ti.static(range(3))] for i in ti.static(range(3))])
        lever = ti.Vector([places[n, i] + moved[n, i] - settings[ORIGIN + i] for i in ti.static(range(3))])
        for m in range(modes):
            row = ti.Vector([rows[3 * n + i, m] for i in ti.static(range(3))])
            answer = rate @ row
            twist = row.cross(force)
            pushes[m] = pushes[m] + row.dot(force)
            for i in ti.static(range(3)):
                met[at + i, m] = row[i]
                answers[at + i, m] = answer[i]
                twists[i, m] = twists[i, m] + twist[i]
        for m in ti.static(range(6)):
            # A turn moves the node, and turns the force that is fixed to the tool.
            axis = ti.Vector([float(i == m % 3) for i in ti.static(range(3))])
            way, turned = axis, 0.0 * force
            if ti.static(m >= 3):
                way, turned = axis.cross(lever), axis.cross(force)
            answer = rate @ way + turned
            pushes[modes + m] = pushes[modes + m] + way.dot(force)
            for i in ti.static(range(3)):
                met[at + i, modes + m] = way[i]
                answers[at + i, modes + m] = answer[i]

    @ti.kernel
    def press(settings: real1, vertices: real2, shaft: int1, places: real2, moved: real2, springs: real1,
              friction: real2, first: int1, closed: int1, anchors: real2, touched: int1, forces: real2, rates: real3,
              gaps: real1, new_anchors: real2, states: int1, rows: real2, met: real2, answers: real2, pushes: real1,
              twists: real2, report: real1):
        ti.loop_config(serialize=True)
        for _ in range(1):
            for m in range(pushes.shape[0]):
                pushes[m] = 0.0
            for m in range(rows.shape[1]):
                for i in ti.static(range(3)):
                    twists[i, m] = 0.0
            touching, slipping, depth = 0, 0, 0.0
            for n in range(places.shape[0]):
                meet(n, settings, vertices, shaft, places, moved, springs, friction, first, closed, anchors, touched,
                     forces, rates, gaps, new_anchors, states)
                if states[n] != FREE:
                    note(n, 3 * touching, settings, places, moved, forces, rates, rows, met, answers, pushes, twists)
                    touching += 1
                    depth = ti.max(depth, -gaps[n])
                if states[n] == SLIPS:
                    slipping += 1
            report[TOUCHING], report[SLIPPING], report[DEPTH] = touching, slipping, depth

    return press
