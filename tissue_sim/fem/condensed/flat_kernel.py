"""What is left of the equation of a `FlatContact`, and its linear one, as a Taichi kernel."""

from functools import cache

from tissue_sim.fem.condensed.kernel import COUNT, eases_function
from tissue_sim.fem.taichi.runtime import initialise

#: Places in `found`: what is left of the equation and the forces, squared; unknown nodes.
LEFT, FORCES, UNKNOWN = range(3)
#: Places in `limits`: nearer nodes take part, m; what may be left over the forces; forces that are none, N; how much of
#: the way to the linear solution is gone before the look: 0, none; 1, of a solution that was not there yet.
NEAR, ENOUGH, NONE, SHARE = range(4)


@cache
def flat_kernel():
    """Kernel that goes some way to the solution of the linear equation of a `FlatContact`, and finds what is left of
    the equation there, and the next linear one for the nodes that carry a force."""
    ti = initialise()
    real1, real2 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2))
    int1 = ti.types.ndarray(ti.i32, ndim=1)
    eases = eases_function()

    @ti.func
    def go(settings: ti.template(), found: ti.template(), share, nodes: ti.template(), forces: ti.template(),
           start: ti.template(), goal: ti.template(), unknown: ti.template(), right: ti.template()):
        """Forces some way to the linear solution; nodes that are not in it lose theirs."""
        many = ti.cast(settings[COUNT], ti.i32)
        if share == 1.0:
            for i in range(many):
                for a in ti.static(range(3)):
                    start[i, a], goal[i, a] = forces[nodes[i], a], 0.0
            for p in range(ti.cast(found[UNKNOWN], ti.i32)):
                for a in ti.static(range(3)):
                    goal[unknown[p], a] = start[unknown[p], a] + right[3 * p + a]
        for i in range(many):
            for a in ti.static(range(3)):
                forces[nodes[i], a] = start[i, a] + share * (goal[i, a] - start[i, a])

    @ti.kernel
    def look(settings: real1, found: real1, limits: real1, nodes: int1, bound: int1, pressed: int1, slips: int1,
             forces: real2, compliance: real2, geometry: real2, guess: real2, moved: real2, near: int1,
             unknown: int1, slopes: real2, start: real2, goal: real2, matrix: real1, right: real1):
        ti.loop_config(serialize=True)
        for _ in range(1):
            if limits[SHARE] > 0.0:
                go(settings, found, limits[SHARE], nodes, forces, start, goal, unknown, right)
            many, count, left, size = 0, 0, 0.0, 0.0
            for i in range(ti.cast(settings[COUNT], ti.i32)):
                s = nodes[i]
                loaded = 0.0
                for a in ti.static(range(3)):
                    moved[i, a] = 0.0
                    loaded = loaded + ti.abs(forces[s, a]) + ti.abs(guess[i, a])
                if bound[s] == 1 or loaded > 0.0 or geometry[i, 6] < limits[NEAR]:
                    near[many] = i
                    many = many + 1
            # Displacements of the last look at the tool belong to the guesses.
            for q in range(many):
                j = near[q]
                change = ti.Vector([forces[nodes[j], b] - guess[j, b] for b in ti.static(range(3))])
                if change.norm() > 0.0:
                    for p in range(many):
                        i = near[p]
                        for a in ti.static(range(3)):
                            moved[i, a] = moved[i, a] - (compliance[3 * j, 3 * i + a] * change[0]
                                                         + compliance[3 * j + 1, 3 * i + a] * change[1]
                                                         + compliance[3 * j + 2, 3 * i + a] * change[2])
            for p in range(many):
                i = near[p]
                s = nodes[i]
                n = ti.Vector([geometry[i, a] for a in ti.static(range(3))])
                F = ti.Vector([forces[s, a] for a in ti.static(range(3))])
                move = ti.Vector([moved[i, a] for a in ti.static(range(3))])
                slip = ti.Vector([geometry[i, 3 + a] for a in ti.static(range(3))]) + move
                gap, mu = geometry[i, 6] + n.dot(move), geometry[i, 7]
                give = eases(i, n, compliance)
                along, aside = give[0], give[1]
                nn, eye = n.outer_product(n), ti.Matrix.identity(ti.f64, 3)
                D, E, new = ti.Matrix.zero(ti.f64, 3, 3), ti.Matrix.zero(ti.f64, 3, 3), ti.Vector.zero(ti.f64, 3)
                carries = bound[s] == 1
                if carries:
                    stiff = 1.0 / ti.max(along, aside)
                    new, D, E = F + stiff * slip, stiff * eye, eye
                else:
                    N = F.dot(n) + gap / along
                    carries = N < 0.0
                    pressed[s], slips[s] = 0, 0
                    if carries:
                        flat = eye - nn
                        q = flat @ (F + slip / aside)
                        length, most = q.norm(), -mu * N
                        pressed[s] = 1
                        new, D, E = N * n + q, nn / along + flat / aside, eye
                        if length > most:
                            slips[s] = 1
                            way, part = q / length, most / length
                            turn = part * (flat - way.outer_product(way))
                            new = N * n + most * way
                            D = nn / along - (mu / along) * way.outer_product(n) + turn / aside
                            E = nn - mu * way.outer_product(n) + turn
                rest = new - F
                left, size = left + rest.dot(rest), size + F.dot(F)
                if carries:
                    for a in ti.static(range(3)):
                        right[3 * count + a] = -rest[a]
                        for b in ti.static(range(3)):
                            slopes[count, 3 * a + b] = D[a, b]
                            slopes[count, 9 + 3 * a + b] = E[a, b]
                    unknown[count] = i
                    count = count + 1
            found[LEFT], found[FORCES], found[UNKNOWN] = left, size, count
            k, rows = 3 * count, count
            if ti.sqrt(left) <= limits[ENOUGH] * ti.max(ti.sqrt(size), limits[NONE]):
                rows = 0
            for p in range(rows):
                i = unknown[p]
                # What the nodes that are let go no longer push away.
                e = ti.Vector.zero(ti.f64, 3)
                for q in range(many):
                    j = near[q]
                    s = nodes[j]
                    if bound[s] != 1 and pressed[s] == 0:
                        for a in ti.static(range(3)):
                            for b in ti.static(range(3)):
                                e[a] = e[a] + compliance[3 * j + b, 3 * i + a] * forces[s, b]
                for a in ti.static(range(3)):
                    right[3 * p + a] = right[3 * p + a] - (slopes[p, 3 * a] * e[0] + slopes[p, 3 * a + 1] * e[1]
                                                           + slopes[p, 3 * a + 2] * e[2])
            # Column by column, as it lies in memory; the compliance is symmetric.
            for q in range(rows):
                for b in range(3):
                    begin, at = (3 * q + b) * k, 3 * unknown[q] + b
                    for p in range(rows):
                        i = unknown[p]
                        C = ti.Vector([compliance[at, 3 * i + c] for c in ti.static(range(3))])
                        for a in ti.static(range(3)):
                            matrix[begin + 3 * p + a] = -(slopes[p, 3 * a] * C[0] + slopes[p, 3 * a + 1] * C[1]
                                                          + slopes[p, 3 * a + 2] * C[2])
                    for a in ti.static(range(3)):
                        matrix[begin + 3 * q + a] = matrix[begin + 3 * q + a] + slopes[q, 9 + 3 * a + b]
                    matrix[begin + 3 * q + b] = matrix[begin + 3 * q + b] - 1.0

    return look
