"""What is left of the equation of a `FlatContact`, and its linear one, as a Taichi kernel."""

from functools import cache

from tissue_sim.fem.condensed.kernel import (
    BOUND,
    COUNT,
    FIRST_ROW,
    FORCE,
    GAP,
    GUESS,
    NEAR_TOOL,
    NODE,
    NORMAL,
    PRESSED,
    ROUGH,
    ROWS,
    SLIP,
    SLIPS,
    UNKNOWN_NODE,
    eases_function,
)
from tissue_sim.fem.taichi.runtime import initialise

#: Places in `found`: what is left of the equation and the forces, squared; nodes with unknowns, and unknowns.
LEFT, FORCES, UNKNOWN, UNKNOWNS = range(4)
#: Places in `limits`: nearer nodes take part, m; what may be left over the forces; forces that are none, N; how much of
#: the way to the linear solution is gone before the look: 0, none; 1, of a solution that was not there yet.
NEAR, ENOUGH, NONE, SHARE = range(4)
#: Columns of `flat`, of each node of the model: displacement since the last look at the tool; force where a step
#: begins, and where it leads. Of each node with unknowns, a row for each of them: rates of its equation with the node's
#: place; the force that it stands for; its own part in its equation. Then the change of the force that is known.
MOVED, START, GOAL, RATES, WAYS, OWN, KNOWN = 0, 3, 6, 9, 18, 27, 30
FLAT = 33


@cache
def flat_kernel():
    """Kernel that goes some way to the solution of the linear equation of a `FlatContact`, and finds what is left of
    the equation there, and the next linear one for the nodes that carry a force.

    A node that sticks has three unknowns. One that slips has two, along the normal, where friction goes with it, and
    aside of its way: how friction along the way changes is known then. One without friction has one.
    """
    ti = initialise()
    real1, real2 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2))
    int2 = ti.types.ndarray(ti.i32, ndim=2)
    eases = eases_function()

    @ti.func
    def go(settings: ti.template(), found: ti.template(), share, lists: ti.template(), carried: ti.template(),
           flat: ti.template(), right: ti.template()):
        """Forces some way to the linear solution; nodes that are not in it lose theirs."""
        many = ti.cast(settings[COUNT], ti.i32)
        if share == 1.0:
            for i in range(many):
                for a in ti.static(range(3)):
                    flat[i, START + a], flat[i, GOAL + a] = carried[lists[i, NODE], FORCE + a], 0.0
            for p in range(ti.cast(found[UNKNOWN], ti.i32)):
                i = lists[p, UNKNOWN_NODE]
                for a in ti.static(range(3)):
                    value = flat[i, START + a] + flat[p, KNOWN + a]
                    for row in range(lists[p, ROWS]):
                        value = value + flat[p, WAYS + 3 * row + a] * right[lists[p, FIRST_ROW] + row]
                    flat[i, GOAL + a] = value
        for i in range(many):
            for a in ti.static(range(3)):
                begun = flat[i, START + a]
                carried[lists[i, NODE], FORCE + a] = begun + share * (flat[i, GOAL + a] - begun)

    @ti.func
    def displace(many, carried: ti.template(), lists: ti.template(), local: ti.template(), compliance: ti.template(),
                 flat: ti.template()):
        """Displacements since the last look at the tool, which belong to the guesses."""
        for p in range(many):
            for a in ti.static(range(3)):
                flat[lists[p, NEAR_TOOL], MOVED + a] = 0.0
        for q in range(many):
            j = lists[q, NEAR_TOOL]
            s = lists[j, NODE]
            change = ti.Vector([carried[s, FORCE + b] - local[j, GUESS + b] for b in ti.static(range(3))])
            if change.norm() > 0.0:
                for p in range(many):
                    i = lists[p, NEAR_TOOL]
                    for a in ti.static(range(3)):
                        flat[i, MOVED + a] = flat[i, MOVED + a] - (compliance[3 * j, 3 * i + a] * change[0]
                                                                   + compliance[3 * j + 1, 3 * i + a] * change[1]
                                                                   + compliance[3 * j + 2, 3 * i + a] * change[2])

    @ti.func
    def write(p, row, rate, way, own, rest, lists: ti.template(), flat: ti.template(), right: ti.template()):
        """One unknown of a node."""
        for a in ti.static(range(3)):
            flat[p, RATES + 3 * row + a], flat[p, WAYS + 3 * row + a] = rate[a], way[a]
        flat[p, OWN + row], right[lists[p, FIRST_ROW] + row] = own, -rest
        lists[p, ROWS] = row + 1

    @ti.func
    def meet(p, i, first, states: ti.template(), carried: ti.template(), lists: ti.template(), local: ti.template(),
             compliance: ti.template(), flat: ti.template(), right: ti.template()):
        """What is left of a node's equation, N, and its unknowns as those of the p-th node that has some, from a row
        on; whether it has any."""
        s = lists[i, NODE]
        n = ti.Vector([local[i, NORMAL + a] for a in ti.static(range(3))])
        F = ti.Vector([carried[s, FORCE + a] for a in ti.static(range(3))])
        move = ti.Vector([flat[i, MOVED + a] for a in ti.static(range(3))])
        slip = ti.Vector([local[i, SLIP + a] for a in ti.static(range(3))]) + move
        gap, mu = local[i, GAP] + n.dot(move), local[i, ROUGH]
        give = eases(i, n, compliance)
        along, aside = give[0], give[1]
        nn, eye = n.outer_product(n), ti.Matrix.identity(ti.f64, 3)
        held, N = states[s, BOUND] == 1, F.dot(n) + gap / along
        rest, rates, sticks = -F, eye, held
        lists[p, UNKNOWN_NODE], lists[p, FIRST_ROW], lists[p, ROWS] = i, first, 0
        for a in ti.static(range(3)):
            flat[p, KNOWN + a] = 0.0
        if held:
            rates = eye / ti.max(along, aside)
            rest = rates @ slip
        else:
            states[s, PRESSED], states[s, SLIPS] = 0, 0
            if N < 0.0:
                tried = F + slip / aside
                q = tried - tried.dot(n) * n
                length, most = q.norm(), -mu * N
                states[s, PRESSED] = 1
                sticks = mu > 0.0 and length <= most
                if sticks:
                    rest, rates = N * n + q - F, nn / along + (eye - nn) / aside
                else:
                    states[s, SLIPS] = 1
                    way = q / ti.max(length, 1e-300)
                    rest = N * n + most * way - F
                    write(p, 0, n / along, n - mu * way, 0.0, rest.dot(n), lists, flat, right)
                    known = rest - rest.dot(n) * n
                    if mu > 0.0:
                        part, other = most / length, n.cross(way)
                        write(p, 1, part / aside * other, other, part - 1.0, rest.dot(other), lists, flat, right)
                        known = (rest.dot(way) + mu * rest.dot(n)) * way
                    for a in ti.static(range(3)):
                        flat[p, KNOWN + a] = known[a]
        if sticks:
            for a in ti.static(range(3)):
                row = ti.Vector([rates[a, b] for b in ti.static(range(3))])
                unit = ti.Vector([1.0 if a == b else 0.0 for b in ti.static(range(3))])
                write(p, a, row, unit, 0.0, rest[a], lists, flat, right)
        return rest

    @ti.func
    def couple(q, count, k, lists: ti.template(), compliance: ti.template(), flat: ti.template(),
               matrix: ti.template(), right: ti.template()):
        """What the unknowns of the q-th node do in the equations of all, and what is known of its force."""
        at, first, rows = 3 * lists[q, UNKNOWN_NODE], lists[q, FIRST_ROW], lists[q, ROWS]
        known = ti.Vector([flat[q, KNOWN + b] for b in ti.static(range(3))])
        ways = ti.Matrix([[flat[q, WAYS + 3 * row + b] for b in ti.static(range(3))] for row in ti.static(range(3))])
        for p in range(count):
            i, begin = lists[p, UNKNOWN_NODE], lists[p, FIRST_ROW]
            C = ti.Matrix([[compliance[at + b, 3 * i + a] for a in ti.static(range(3))] for b in ti.static(range(3))])
            for other in range(lists[p, ROWS]):
                pushed = C @ ti.Vector([flat[p, RATES + 3 * other + a] for a in ti.static(range(3))])
                right[begin + other] = right[begin + other] + pushed.dot(known)
                for row in ti.static(range(3)):
                    if row < rows:
                        way = ti.Vector([ways[row, b] for b in ti.static(range(3))])
                        matrix[(first + row) * k + begin + other] = -pushed.dot(way)
        for row in range(rows):
            matrix[(first + row) * (k + 1)] = matrix[(first + row) * (k + 1)] + flat[q, OWN + row]

    @ti.func
    def release(j, count, carried: ti.template(), lists: ti.template(), compliance: ti.template(),
                flat: ti.template(), right: ti.template()):
        """What a node that is let go no longer pushes away."""
        force = ti.Vector([carried[lists[j, NODE], FORCE + b] for b in ti.static(range(3))])
        for p in range(count if force.norm() > 0.0 else 0):
            i, begin = lists[p, UNKNOWN_NODE], lists[p, FIRST_ROW]
            C = ti.Matrix([[compliance[3 * j + b, 3 * i + a] for a in ti.static(range(3))]
                           for b in ti.static(range(3))])
            for other in range(lists[p, ROWS]):
                pushed = C @ ti.Vector([flat[p, RATES + 3 * other + a] for a in ti.static(range(3))])
                right[begin + other] = right[begin + other] - pushed.dot(force)

    @ti.kernel
    def look(settings: real1, found: real1, limits: real1, states: int2, carried: real2, lists: int2, local: real2,
             compliance: real2, flat: real2, matrix: real1, right: real1):
        ti.loop_config(serialize=True)
        for _ in range(1):
            if limits[SHARE] > 0.0:
                go(settings, found, limits[SHARE], lists, carried, flat, right)
            many, count, k, left, size = 0, 0, 0, 0.0, 0.0
            for i in range(ti.cast(settings[COUNT], ti.i32)):
                s = lists[i, NODE]
                loaded = 0.0
                for a in ti.static(range(3)):
                    loaded = loaded + ti.abs(carried[s, FORCE + a]) + ti.abs(local[i, GUESS + a])
                if states[s, BOUND] == 1 or loaded > 0.0 or local[i, GAP] < limits[NEAR]:
                    lists[many, NEAR_TOOL] = i
                    many = many + 1
            displace(many, carried, lists, local, compliance, flat)
            for p in range(many):
                i = lists[p, NEAR_TOOL]
                rest = meet(count, i, k, states, carried, lists, local, compliance, flat, right)
                left = left + rest.dot(rest)
                for a in ti.static(range(3)):
                    size = size + carried[lists[i, NODE], FORCE + a] * carried[lists[i, NODE], FORCE + a]
                k = k + lists[count, ROWS]
                if lists[count, ROWS] > 0:
                    count = count + 1
            found[LEFT], found[FORCES], found[UNKNOWN], found[UNKNOWNS] = left, size, count, k
            if ti.sqrt(left) > limits[ENOUGH] * ti.max(ti.sqrt(size), limits[NONE]):
                for q in range(many):
                    j = lists[q, NEAR_TOOL]
                    if states[lists[j, NODE], BOUND] != 1 and states[lists[j, NODE], PRESSED] == 0:
                        release(j, count, carried, lists, compliance, flat, right)
                for q in range(count):
                    couple(q, count, k, lists, compliance, flat, matrix, right)

    return look
