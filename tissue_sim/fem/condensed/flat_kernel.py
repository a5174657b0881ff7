"""What is left of the equation of a `FlatContact`, and its linear one, as a Taichi kernel."""

from functools import cache

from tissue_sim.fem.condensed.kernel import (
    BOUND,
    COUNT,
    FORCE,
    GAP,
    GUESS,
    NEAR_TOOL,
    NODE,
    NORMAL,
    PRESSED,
    ROUGH,
    SLIP,
    SLIPS,
    UNKNOWN_NODE,
    eases_function,
)
from tissue_sim.fem.taichi.runtime import initialise

#: Places in `found`: what is left of the equation and the forces, squared; unknown nodes.
LEFT, FORCES, UNKNOWN = range(3)
#: Places in `limits`: nearer nodes take part, m; what may be left over the forces; forces that are none, N; how much of
#: the way to the linear solution is gone before the look: 0, none; 1, of a solution that was not there yet.
NEAR, ENOUGH, NONE, SHARE = range(4)
#: Columns of `flat`, of each node of the model: displacement since the last look at the tool; force where a step
#: begins, and where it leads; of each unknown node, rates of the projected force with its place and with itself.
MOVED, START, GOAL, SLOPE = 0, 3, 6, 9
FLAT = 27


@cache
def flat_kernel():
    """Kernel that goes some way to the solution of the linear equation of a `FlatContact`, and finds what is left of
    the equation there, and the next linear one for the nodes that carry a force."""
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
                for a in ti.static(range(3)):
                    flat[lists[p, UNKNOWN_NODE], GOAL + a] = flat[lists[p, UNKNOWN_NODE], START + a] + right[3 * p + a]
        for i in range(many):
            for a in ti.static(range(3)):
                begun = flat[i, START + a]
                carried[lists[i, NODE], FORCE + a] = begun + share * (flat[i, GOAL + a] - begun)

    @ti.kernel
    def look(settings: real1, found: real1, limits: real1, states: int2, carried: real2, lists: int2, local: real2,
             compliance: real2, flat: real2, matrix: real1, right: real1):
        ti.loop_config(serialize=True)
        for _ in range(1):
            if limits[SHARE] > 0.0:
                go(settings, found, limits[SHARE], lists, carried, flat, right)
            many, count, left, size = 0, 0, 0.0, 0.0
            for i in range(ti.cast(settings[COUNT], ti.i32)):
                s = lists[i, NODE]
                loaded = 0.0
                for a in ti.static(range(3)):
                    flat[i, MOVED + a] = 0.0
                    loaded = loaded + ti.abs(carried[s, FORCE + a]) + ti.abs(local[i, GUESS + a])
                if states[s, BOUND] == 1 or loaded > 0.0 or local[i, GAP] < limits[NEAR]:
                    lists[many, NEAR_TOOL] = i
                    many = many + 1
            # Displacements of the last look at the tool belong to the guesses.
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
            for p in range(many):
                i = lists[p, NEAR_TOOL]
                s = lists[i, NODE]
                n = ti.Vector([local[i, NORMAL + a] for a in ti.static(range(3))])
                F = ti.Vector([carried[s, FORCE + a] for a in ti.static(range(3))])
                move = ti.Vector([flat[i, MOVED + a] for a in ti.static(range(3))])
                slip = ti.Vector([local[i, SLIP + a] for a in ti.static(range(3))]) + move
                gap, mu = local[i, GAP] + n.dot(move), local[i, ROUGH]
                give = eases(i, n, compliance)
                along, aside = give[0], give[1]
                nn, eye = n.outer_product(n), ti.Matrix.identity(ti.f64, 3)
                D, E, new = ti.Matrix.zero(ti.f64, 3, 3), ti.Matrix.zero(ti.f64, 3, 3), ti.Vector.zero(ti.f64, 3)
                carries = states[s, BOUND] == 1
                if carries:
                    stiff = 1.0 / ti.max(along, aside)
                    new, D, E = F + stiff * slip, stiff * eye, eye
                else:
                    N = F.dot(n) + gap / along
                    carries = N < 0.0
                    states[s, PRESSED], states[s, SLIPS] = 0, 0
                    if carries:
                        level = eye - nn
                        q = level @ (F + slip / aside)
                        length, most = q.norm(), -mu * N
                        states[s, PRESSED] = 1
                        new, D, E = N * n + q, nn / along + level / aside, eye
                        if length > most:
                            states[s, SLIPS] = 1
                            way, part = q / length, most / length
                            turn = part * (level - way.outer_product(way))
                            new = N * n + most * way
                            D = nn / along - (mu / along) * way.outer_product(n) + turn / aside
                            E = nn - mu * way.outer_product(n) + turn
                rest = new - F
                left, size = left + rest.dot(rest), size + F.dot(F)
                if carries:
                    for a in ti.static(range(3)):
                        right[3 * count + a] = -rest[a]
                        for b in ti.static(range(3)):
                            flat[count, SLOPE + 3 * a + b] = D[a, b]
                            flat[count, SLOPE + 9 + 3 * a + b] = E[a, b]
                    lists[count, UNKNOWN_NODE] = i
                    count = count + 1
            found[LEFT], found[FORCES], found[UNKNOWN] = left, size, count
            k, rows = 3 * count, count
            if ti.sqrt(left) <= limits[ENOUGH] * ti.max(ti.sqrt(size), limits[NONE]):
                rows = 0
            for p in range(rows):
                i = lists[p, UNKNOWN_NODE]
                # What the nodes that are let go no longer push away.
                e = ti.Vector.zero(ti.f64, 3)
                for q in range(many):
                    j = lists[q, NEAR_TOOL]
                    s = lists[j, NODE]
                    if states[s, BOUND] != 1 and states[s, PRESSED] == 0:
                        for a in ti.static(range(3)):
                            for b in ti.static(range(3)):
                                e[a] = e[a] + compliance[3 * j + b, 3 * i + a] * carried[s, FORCE + b]
                for a in ti.static(range(3)):
                    slope = ti.Vector([flat[p, SLOPE + 3 * a + c] for c in ti.static(range(3))])
                    right[3 * p + a] = right[3 * p + a] - slope.dot(e)
            # Column by column, as it lies in memory; the compliance is symmetric.
            for q in range(rows):
                for b in range(3):
                    begin, at = (3 * q + b) * k, 3 * lists[q, UNKNOWN_NODE] + b
                    for p in range(rows):
                        i = lists[p, UNKNOWN_NODE]
                        C = ti.Vector([compliance[at, 3 * i + c] for c in ti.static(range(3))])
                        for a in ti.static(range(3)):
                            slope = ti.Vector([flat[p, SLOPE + 3 * a + c] for c in ti.static(range(3))])
                            matrix[begin + 3 * p + a] = -slope.dot(C)
                    for a in ti.static(range(3)):
                        matrix[begin + 3 * q + a] = matrix[begin + 3 * q + a] + flat[q, SLOPE + 9 + 3 * a + b]
                    matrix[begin + 3 * q + b] = matrix[begin + 3 * q + b] - 1.0

    return look
