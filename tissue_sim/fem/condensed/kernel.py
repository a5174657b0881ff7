"""The contact on a condensed bulk as a Taichi kernel: displacements, states, and the equations of the next iteration.

The method is that of `tissue_sim.fem.solid.contact`, node by node, with the same springs and the same states; the
equations hold the nodes that are pressed only.
"""

from functools import cache

from tissue_sim.fem.taichi.runtime import initialise
from tissue_sim.fem.taichi.scratch import LANES, VECTORS, scratch

#: Stiffness of a held node over that of the springs; see `tissue_sim.fem.solid.contact`.
HOLD = 3.0
#: Places in `settings`: number of nodes, whether states may change, negligible friction, tolerance, whether the tool
#: is where it touched or deeper, whether pulling nodes are let go, whether equations are wanted anew, shear modulus, of
#: how many nodes the forces follow the tool first, how many are looked at (0: all, which finds how many the next looks
#: need), how near the others are not, m; then rotation (9) and place (3) of the tool, its motion from the pose of the
#: model (6), and from that of the last step (6).
(COUNT, CHANGEABLE, NEGLIGIBLE, TOLERANCE, PRESSED_IN, RELEASE, ANEW, MODULUS, FOLLOWS, LOOKED, APART) = range(11)
ROTATION, ORIGIN, MOTION, STEP = 11, 20, 23, 29
SETTINGS = 35
#: Places in `results`; the last: how far nodes near the tool have gone against it since all were looked at, m.
VIOLATION, PULLING, UNBALANCED, SIZE, ACTIVE, REBUILT, SLIPPING, GONE = range(8)
RESULTS = 8
# Taichi takes a third of a microsecond for each array to start a kernel: what is known of nodes is in few.
#: Columns of `surface`, of each node of the surface: its place; over the shear modulus its spring; friction with the
#: tool's face and shaft.
PLACE, SPRING, FRICTION = 0, 3, 4
#: Columns of `carried`, of each node of the surface: force; where it is bound to the tool, and where it has met it now.
FORCE, ANCHOR, MET_AT = 0, 3, 6
CARRIED = 9
#: Columns of `states`, of each node of the surface: how it is bound, and would be by what it has met now; whether it is
#: pressed, and slips; which outline it meets.
BOUND, MET, PRESSED, SLIPS, OUTLINE = range(5)
STATES = 5
#: Columns of `lists`: numbers of the model's nodes in the surface, and their states in the equations; then numbers of
#: the nodes that have equations, that have forces, that are near the tool, and that the flat contact has equations of;
#: which of these is the first of each, and how many it has.
NODE, SIGNATURE, ACTIVE_NODE, LOADED, NEAR_TOOL, UNKNOWN_NODE, FIRST_ROW, ROWS = range(8)
LISTS = 8
#: Columns of `local`, of each node of the model: force at the beginning of a look; normal, slip, gap and friction that
#: it found; rates of the force with the node's place, and with itself; force where nothing is missing; lever; where it
#: was against the tool when all were looked at.
GUESS, NORMAL, SLIP, GAP, ROUGH, RATE, TURN, INTERCEPT, LEVER, THEN = 0, 3, 6, 9, 10, 11, 20, 29, 32, 35
LOCAL = 38
#: Displacements of nodes at most, three of each.
MOST_FREEDOMS = LANES * VECTORS
#: Right-hand sides: of the iteration, and of the six motions of the tool.
COLUMNS = 7
#: No linear solution changes forces by more than this share of the largest: it would lead elsewhere.
_FORESEEN = 0.5


@cache
def eases_function():
    """How far a node of a compliance gives way to a force of its own along a normal, and aside, on average, m/N."""
    ti = initialise()

    @ti.func
    def eases(i, n, compliance: ti.template()):
        C = ti.Matrix([[compliance[3 * i + a, 3 * i + b] for b in ti.static(range(3))] for a in ti.static(range(3))])
        # Of a tissue that would buckle without the tool they need not be positive.
        least, along = 1e-2 * ti.abs(C.trace()), n.dot(C @ n)
        return ti.Vector([ti.max(along, least), ti.max(0.5 * (C.trace() - along), least)])

    return eases


@cache
def contact_kernel():
    """Kernel of one iteration of the contact."""
    ti = initialise()
    real1, real2, real3 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2, 3))
    int2 = ti.types.ndarray(ti.i32, ndim=2)
    vector1 = ti.types.ndarray(ti.types.vector(LANES, ti.f64), ndim=1)
    eases = eases_function()
    move = scratch(LANES, MOST_FREEDOMS // LANES)

    @ti.func
    def follow(settings: ti.template(), lists: ti.template(), carried: ti.template(), columns: ti.template(),
               local: ti.template()):
        """Forces of the nodes that had equations, as they change linearly with the tool's motion."""
        most, largest, many = 0.0, 0.0, ti.cast(settings[FOLLOWS], ti.i32)
        for p in range(many):
            i = lists[p, ACTIVE_NODE]
            for a in ti.static(range(3)):
                more = 0.0
                for c in ti.static(range(6)):
                    more = more + columns[3 * p + a, c] * settings[STEP + c]
                local[i, GUESS + a] = more
                most, largest = ti.max(most, ti.abs(more)), ti.max(largest, ti.abs(carried[lists[i, NODE], FORCE + a]))
        if most < _FORESEEN * largest:
            for p in range(many):
                i = lists[p, ACTIVE_NODE]
                for a in ti.static(range(3)):
                    carried[lists[i, NODE], FORCE + a] = carried[lists[i, NODE], FORCE + a] + local[i, GUESS + a]
        settings[FOLLOWS] = 0.0

    @ti.func
    def displace(n, many, settings: ti.template(), lists: ti.template(), carried: ti.template(), middle: ti.template(),
                 drive: ti.template(), rows: ti.template(), u: ti.template()):
        """Displacements of all nodes under the forces of the loaded ones, by whole rows of the compliance, which is
        symmetric: what is stored as a vector in a loop is vectorised."""
        width = u.shape[0] // LANES
        used = (3 * n + LANES - 1) // LANES
        for q in range(used):
            move[q] = ti.Vector.zero(ti.f64, LANES)
        for l in range(many):
            j = lists[l, LOADED]
            s = lists[j, NODE]
            for m in range(3):
                force = carried[s, FORCE + m]
                for q in range(used):
                    at = (3 * j + m) * width + q
                    move[q] = move[q] - rows[at] * force
        for q in range(used):
            for l in ti.static(range(LANES)):
                u[LANES * q + l] = move[q][l]
        for i in range(n):
            for k in range(3):
                value = middle[i, k]
                for a in ti.static(range(6)):
                    value = value + drive[3 * i + k, a] * settings[MOTION + a]
                u[3 * i + k] = u[3 * i + k] + value

    @ti.func
    def meet(i, s, settings: ti.template(), results: ti.template(), chains: ti.template(), shapes: ti.template(),
             surface: ti.template(), states: ti.template(), carried: ti.template(), lists: ti.template(),
             u: ti.template(), local: ti.template(), compliance: ti.template()):
        """Where a node is against the tool, what state it takes, and its force."""
        R = ti.Matrix([[settings[ROTATION + 3 * a + b] for b in ti.static(range(3))] for a in ti.static(range(3))])
        arm = ti.Vector([surface[s, PLACE + a] + u[3 * i + a] - settings[ORIGIN + a] for a in ti.static(range(3))])
        at = R.transpose() @ arm
        # The nearest place of the outline.
        body = states[s, OUTLINE]
        rounding, shaft, lines = shapes[body, 0], shapes[body, 1], ti.cast(shapes[body, 3], ti.i32)
        closed = shapes[body, 2] * settings[PRESSED_IN]
        r = ti.sqrt(at[0] * at[0] + at[1] * at[1])
        best, distance, front, along, share, arrow_r, arrow_z = 0, 1e30, 0.0, 0.0, 0.0, 0.0, 0.0
        for line in range(lines):
            tr, tz = chains[body, line, 2], chains[body, line, 3]
            x, z = r - chains[body, line, 0], at[2] - chains[body, line, 1]
            l = x * tr + z * tz
            part = ti.min(l, chains[body, line, 4])
            if not (closed > 0.0 and line == 0):
                part = ti.max(part, 0.0)
            ar, az = x - part * tr, z - part * tz
            d, f = ti.sqrt(ar * ar + az * az), ar * tz - az * tr
            if d < distance - 5e-16 or (d <= distance + 5e-16 and ti.abs(f) > ti.abs(front)):
                best, distance, front, along, share, arrow_r, arrow_z = line, d, f, l, part, ar, az
        inside = front < 0.0 and (closed > 0.0 or not (best == 0 and along < 0.0))
        sign = -1.0 if inside else 1.0
        beyond = share != along and distance > 0.0
        n_r, n_z, bent = chains[body, best, 3], -chains[body, best, 2], 0.0
        if beyond:
            n_r, n_z, bent = sign / distance * arrow_r, sign / distance * arrow_z, sign / distance
        out = ti.Vector([1.0, 0.0, 0.0])
        hoop = bent
        if r > 0.0:
            out = ti.Vector([at[0] / r, at[1] / r, 0.0])
        if r > shapes[body, 4]:
            hoop = n_r / r
        up = ti.Vector([0.0, 0.0, 1.0])
        around = R @ ti.Vector([-out[1], out[0], 0.0])
        meridian = R @ (n_r * up - n_z * out)
        n_tool = n_r * out + n_z * up
        n = R @ n_tool
        gap = sign * distance - rounding
        mu = surface[s, FRICTION]
        if best >= shaft and not (beyond and rounding > 0.0):
            mu = surface[s, FRICTION + 1]
        # How far the nodes near the tool have gone against it since all were looked at: others may have come near.
        for a in ti.static(range(3)):
            if settings[LOOKED] == 0.0:
                local[i, THEN + a] = at[a]
            results[GONE] = ti.max(results[GONE], ti.abs(at[a] - local[i, THEN + a]))
        # States and forces.
        k = surface[s, SPRING] * settings[MODULUS]
        F = ti.Vector([carried[s, FORCE + a] for a in ti.static(range(3))])
        normal = ti.min(F.dot(n), 0.0)
        tangential = F - F.dot(n) * n
        give = eases(i, n, compliance)
        held = states[s, BOUND] == 1
        changeable = settings[CHANGEABLE] > 0.0
        if held and settings[RELEASE] > 0.0 and F.dot(n) > 0.0:
            states[s, BOUND] = 0
            held = False
        if changeable and not held:
            states[s, PRESSED] = 1 if normal + gap / give[0] < 0.0 else 0
        is_pressed = states[s, PRESSED] == 1 and not held
        anchor = ti.Vector([carried[s, ANCHOR + a] for a in ti.static(range(3))])
        slip = R @ (at - anchor)
        aside = slip - slip.dot(n) * n
        length = aside.norm()
        nn, eye = n.outer_product(n), ti.Matrix.identity(ti.f64, 3)
        A, T, missing, found = (ti.Matrix.zero(ti.f64, 3, 3), ti.Matrix.zero(ti.f64, 3, 3), ti.Vector.zero(ti.f64, 3),
                                ti.Vector.zero(ti.f64, 3))
        state, sticks, violation = 0, False, 0.0
        if held:
            violation = slip.norm()
            A, missing, found, state = HOLD * k * eye, HOLD * k * slip, F, 3
            if F.dot(n) > 0.0:
                results[PULLING] = results[PULLING] + 1.0
        elif is_pressed:
            violation, state = ti.abs(gap), 1
            A = k * nn + normal * (bent * meridian.outer_product(meridian) + hoop * around.outer_product(around))
            missing, found = k * gap * n, normal * n
            rough = mu * ti.max(-normal - gap / give[0], 0.0)
            if mu > 0.0 and states[s, BOUND] == 2 and rough > settings[NEGLIGIBLE]:
                limit = mu * ti.max(-normal, 0.0)
                tried = tangential + aside / give[1]
                size = tried.norm()
                if changeable:
                    states[s, SLIPS] = 1 if size > rough else 0
                if states[s, SLIPS] == 1:
                    state = 2
                    way = tried / ti.max(size, 1e-300)
                    T = limit / ti.max(size, 1e-300) * (eye - nn - way.outer_product(way))
                    A = A - mu * k * way.outer_product(n) + T / give[1]
                    missing, found = missing - mu * k * gap * way, found + limit * way
                    results[SLIPPING] = results[SLIPPING] + 1.0
                else:
                    sticks, state = True, 4
                    violation = ti.max(violation, length)
                    A, missing, found = A + HOLD * k * (eye - nn), missing + HOLD * k * aside, found + tangential
        else:
            violation = ti.max(-gap, 0.0)
        results[VIOLATION] = ti.max(results[VIOLATION], violation)
        touches = is_pressed or (mu > 0.0 and gap <= 1e-3 * settings[TOLERANCE])
        states[s, MET] = 0
        if mu < 0.0 and is_pressed:
            states[s, MET] = 1
        elif touches and mu > 0.0:
            states[s, MET] = 2
        keeps = sticks or (touches and not is_pressed and states[s, BOUND] == 2)
        for a in ti.static(range(3)):
            carried[s, MET_AT + a] = anchor[a] if keeps else at[a] - gap * n_tool[a]
            local[i, LEVER + a] = arm[a]
            local[i, NORMAL + a], local[i, SLIP + a] = n[a], slip[a]
            local[i, INTERCEPT + a] = found[a] + missing[a]
            change = found[a] - local[i, GUESS + a]
            results[UNBALANCED] = results[UNBALANCED] + change * change
            results[SIZE] = results[SIZE] + found[a] * found[a]
            carried[s, FORCE + a] = found[a]
            for b in ti.static(range(3)):
                local[i, RATE + 3 * a + b] = A[a, b]
                local[i, TURN + 3 * a + b] = T[a, b]
        local[i, GAP] = gap
        local[i, ROUGH] = ti.max(mu, 0.0) if states[s, BOUND] == 2 else 0.0
        # Equations of other states of the same nodes do for a while.
        if (lists[i, SIGNATURE] > 0) != (state > 0) or lists[i, SIGNATURE] < 0:
            settings[ANEW] = 1.0
        lists[i, SIGNATURE] = state

    @ti.kernel
    def iterate(settings: real1, results: real1, chains: real3, shapes: real2, surface: real2, states: int2,
                carried: real2, lists: int2, middle: real2, drive: real2, compliance: real2, rows: vector1, u: real1,
                local: real2, columns: real2, matrix: real1, right: real1):
        ti.loop_config(serialize=True)
        for _ in range(1):
            if settings[FOLLOWS] > 0.0:
                follow(settings, lists, carried, columns, local)
            n, many = ti.cast(settings[COUNT], ti.i32), 0
            for i in range(n):
                s = lists[i, NODE]
                size = 0.0
                for a in ti.static(range(3)):
                    local[i, GUESS + a] = carried[s, FORCE + a]
                    size = size + ti.abs(carried[s, FORCE + a])
                if size > 0.0:
                    lists[many, LOADED] = i
                    many = many + 1
            for k in range(RESULTS):
                results[k] = 0.0
            # Nodes that are apart carry nothing, and are not displaced.
            all_nodes = settings[LOOKED] == 0.0
            if not all_nodes:
                n = ti.cast(settings[LOOKED], ti.i32)
            displace(n, many, settings, lists, carried, middle, drive, rows, u)
            for i in range(n):
                meet(i, lists[i, NODE], settings, results, chains, shapes, surface, states, carried, lists, u, local,
                     compliance)
            count, near = 0, 1
            for i in range(n):
                if lists[i, SIGNATURE] > 0:
                    lists[count, ACTIVE_NODE] = i
                    count = count + 1
                if lists[i, SIGNATURE] > 0 or local[i, GAP] < settings[APART]:
                    near = i + 1
            if all_nodes:
                # What carried a force may be pressed again once others have let go.
                if many > 0:
                    near = ti.max(near, lists[many - 1, LOADED] + 1)
                settings[LOOKED] = ti.min(near, n)
            k = 3 * count
            results[ACTIVE] = count
            rebuilt = settings[ANEW] > 0.0
            results[REBUILT] = settings[ANEW]
            settings[ANEW] = 0.0
            for p in range(count):
                i = lists[p, ACTIVE_NODE]
                # What the nodes that were let go no longer push away.
                e = ti.Vector.zero(ti.f64, 3)
                for l in range(many):
                    j = lists[l, LOADED]
                    if lists[j, SIGNATURE] == 0:
                        for a in ti.static(range(3)):
                            for b in ti.static(range(3)):
                                e[a] = e[a] + compliance[3 * i + a, 3 * j + b] * local[j, GUESS + b]
                x, y, z = local[i, LEVER], local[i, LEVER + 1], local[i, LEVER + 2]
                f = ti.Vector([local[i, INTERCEPT], local[i, INTERCEPT + 1], local[i, INTERCEPT + 2]])
                turning = ti.Matrix([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
                turned = ti.Matrix([[0.0, f[2], -f[1]], [-f[2], 0.0, f[0]], [f[1], -f[0], 0.0]])
                for a in ti.static(range(3)):
                    row = 3 * p + a
                    value = local[i, INTERCEPT + a] - local[i, GUESS + a]
                    for b in ti.static(range(3)):
                        value = value + local[i, RATE + 3 * a + b] * e[b]
                    right[row] = value
                    for c in ti.static(range(6)):
                        value = 0.0
                        if ti.static(c >= 3):
                            value = value + turned[a, ti.static(c - 3)]
                        for b in ti.static(range(3)):
                            way = drive[3 * i + b, c]
                            if ti.static(c >= 3):
                                way = way - turning[b, ti.static(c - 3)]
                            elif ti.static(c == b):
                                way = way - 1.0
                            value = value + local[i, RATE + 3 * a + b] * way
                        right[(c + 1) * k + row] = value
            # Column by column, as it lies in memory; the compliance is symmetric.
            for q in range(count if rebuilt else 0):
                j = lists[q, ACTIVE_NODE]
                start = 3 * q * k
                for p in range(count):
                    i = lists[p, ACTIVE_NODE]
                    C = ti.Matrix([[compliance[3 * j + b, 3 * i + c] for b in ti.static(range(3))]
                                   for c in ti.static(range(3))])
                    A = ti.Matrix([[local[i, RATE + 3 * a + c] for c in ti.static(range(3))]
                                   for a in ti.static(range(3))])
                    value = A @ C
                    for b in ti.static(range(3)):
                        for a in ti.static(range(3)):
                            matrix[start + b * k + 3 * p + a] = value[a, b]
                for b in ti.static(range(3)):
                    for a in ti.static(range(3)):
                        at = start + b * k + 3 * q + a
                        matrix[at] = matrix[at] - local[j, TURN + 3 * a + b] + (1.0 if a == b else 0.0)

    return iterate
