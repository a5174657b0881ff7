"""Frictional contact on a condensed bulk, and the wrench on the tool, as Taichi kernels.

One iteration computes the displacements of the nodes, u = u_0 + G m - C f, the contact state, force and derivative of
each node (augmented Lagrangian and Coulomb return mapping as in `tissue_sim.fem.solid.contact`, with the same penalty
stiffness), and assembles the linear equations of Newton's method,

    (I + A C - T) df = f_0 - f + A e,

for the changes df of the forces f of the nodes in contact. A are the derivatives of the contact forces with respect to
the positions of the nodes, T those with respect to the last forces, f_0 the augmented forces (last forces on the
admissible cone plus penalty stiffness times gap and slip), and e the displacements caused by the forces of nodes that
separate. Six more right-hand sides give the derivatives of the forces with respect to the motion of the tool.

After a converged step, another kernel computes the wrench on the tool and its derivative.
"""

from enum import IntEnum
from functools import cache

from tissue_sim.fem.condensed.tables import (
    MAX_FREEDOMS,
    RESULT_COUNT,
    ContactStatus,
    KernelResult,
    KernelSetting,
    LinearisedContactColumn,
    NodeBondAndStatusColumn,
    NodeForceAndAnchorColumn,
    NodeListColumn,
    SurfaceNodeColumn,
)
from tissue_sim.fem.contact.pairs import SOLID_PENALTY, ContactBondState
from tissue_sim.fem.contact.surface_geometry import make_surface_geometry_function
from tissue_sim.fem.taichi.array_tables import LANE_REALS, ArrayLayout, integer_array_type, real_array_type
from tissue_sim.fem.taichi.runtime import LANES, get_initialised_taichi, get_shared_scratch_field


class WrenchKernelEntryIndex(IntEnum):
    """Indices of `answer`: inputs and outputs of the kernel that sums the forces.

    Attributes:
        COUNT: input, number of nodes in contact.
        HELD_WRENCH: input, wrench of the tissue that the tool holds, 6 numbers, N and N m.
        WRENCH: output, wrench on the tool, 6 numbers, N and N m.
        HELD_STIFFNESS: input, stiffness of the tissue that the tool holds, 6 x 6 by rows.
        RATES: output, derivative of `WRENCH` with respect to the motion of the tool, 6 x 6 by rows.
    """

    COUNT = 0
    HELD_WRENCH = 1
    WRENCH = 7
    HELD_STIFFNESS = 13
    RATES = 49


#: Size of `answer`.
ANSWER_SIZE = WrenchKernelEntryIndex.RATES + 36


@cache
def make_bond_commit_and_wrench_kernel():
    """Return the kernel that commits the bonds of the nodes and sums the wrench and its derivative."""
    ti = get_initialised_taichi()
    real1, real2 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2))
    int2 = ti.types.ndarray(ti.i32, ndim=2)

    @ti.func
    def commit_node_bonds(states: ti.template(), carried: ti.template()):
        """Replace bonds and anchors by those found in the step; a node that is not pressed does not slip."""
        for s in range(states.shape[0]):
            if states[s, NodeBondAndStatusColumn.BOND] != ContactBondState.HELD:
                states[s, NodeBondAndStatusColumn.BOND] = states[s, NodeBondAndStatusColumn.NEW_BOND]
                for a in ti.static(range(3)):
                    carried[s, NodeForceAndAnchorColumn.ANCHOR + a] = (
                        carried[s, NodeForceAndAnchorColumn.NEW_ANCHOR + a])
            states[s, NodeBondAndStatusColumn.SLIPS] = (
                states[s, NodeBondAndStatusColumn.SLIPS] & states[s, NodeBondAndStatusColumn.PRESSED])

    @ti.kernel
    def commit_bonds_and_compute_wrench(settings: real1, answer: real1, states: int2, carried: real2, lists: int2,
                                        local: real2, tool_coupling: real2, compliance: real2, columns: real2):
        """Commit the bonds of the nodes, and compute the wrench on the tool and its derivative by the tool motion."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            commit_node_bonds(states, carried)
            count = ti.cast(answer[WrenchKernelEntryIndex.COUNT], ti.i32)
            for a in range(6):
                value = answer[WrenchKernelEntryIndex.HELD_WRENCH + a]
                for c in range(6):
                    held = answer[WrenchKernelEntryIndex.HELD_STIFFNESS + 6 * a + c]
                    value = value - held * settings[KernelSetting.MOTION + c]
                    answer[WrenchKernelEntryIndex.RATES + 6 * a + c] = -held
                answer[WrenchKernelEntryIndex.WRENCH + a] = value
            total = ti.Vector.zero(ti.f64, 3)
            for p in range(count):
                i = lists[p, NodeListColumn.ACTIVE]
                s = lists[i, NodeListColumn.NODE]
                f = ti.Vector([carried[s, NodeForceAndAnchorColumn.FORCE + a] for a in ti.static(range(3))])
                arm = ti.Vector([local[i, LinearisedContactColumn.ARM + a] for a in ti.static(range(3))])
                total = total + f
                torque = arm.cross(f)
                for a in ti.static(range(3)):
                    answer[WrenchKernelEntryIndex.WRENCH + a] = answer[WrenchKernelEntryIndex.WRENCH + a] + f[a]
                    answer[WrenchKernelEntryIndex.WRENCH + 3 + a] = answer[WrenchKernelEntryIndex.WRENCH + 3
                                                                           + a] + torque[a]
                for c in range(6):
                    way = ti.Vector([tool_coupling[3 * i + a, c] for a in ti.static(range(3))])
                    change = ti.Vector([columns[3 * p + a, c] for a in ti.static(range(3))])
                    # Part of the force loads the tissue that is bonded to the tool: - G^T f.
                    answer[WrenchKernelEntryIndex.WRENCH + c] = answer[WrenchKernelEntryIndex.WRENCH + c] - f.dot(way)
                    turned = arm.cross(change) + way.cross(f)
                    for a in ti.static(range(3)):
                        answer[WrenchKernelEntryIndex.RATES + 6 * a + c] = (
                            answer[WrenchKernelEntryIndex.RATES + 6 * a + c] + change[a])
                        answer[WrenchKernelEntryIndex.RATES + 18 + 6 * a + c] = (
                            answer[WrenchKernelEntryIndex.RATES + 18 + 6 * a + c] + turned[a])
                    for b in range(6):
                        value = 0.0
                        for a in ti.static(range(3)):
                            value = value + tool_coupling[3 * i + a, b] * columns[3 * p + a, c]
                        answer[WrenchKernelEntryIndex.RATES + 6 * b + c] = (
                            answer[WrenchKernelEntryIndex.RATES + 6 * b + c] - value)
            # The arms of the torque change with the displacements of the nodes and with the motion of the tool.
            for q in range(3 * count):
                turned, at = ti.Vector.zero(ti.f64, 3), 3 * lists[q // 3, NodeListColumn.ACTIVE] + q % 3
                for p in range(count):
                    i = lists[p, NodeListColumn.ACTIVE]
                    f = ti.Vector([carried[lists[i, NodeListColumn.NODE], NodeForceAndAnchorColumn.FORCE + a]
                                   for a in ti.static(range(3))])
                    turned = turned + ti.Vector([compliance[at, 3 * i + a] for a in ti.static(range(3))]).cross(f)
                for c in range(6):
                    for a in ti.static(range(3)):
                        at_rate = WrenchKernelEntryIndex.RATES + 18 + 6 * a + c
                        answer[at_rate] = answer[at_rate] - turned[a] * columns[q, c]
            for c in ti.static(range(3)):
                unit = ti.Vector([1.0 if a == c else 0.0 for a in ti.static(range(3))])
                turned = unit.cross(total)
                for a in ti.static(range(3)):
                    answer[WrenchKernelEntryIndex.RATES + 18 + 6 * a + c] = (
                        answer[WrenchKernelEntryIndex.RATES + 18 + 6 * a + c] - turned[a])

    return commit_bonds_and_compute_wrench


#: The extrapolation of the forces is discarded if a force changes by more than this fraction of the largest force.
_MAX_PREDICTED_CHANGE = 0.5


#: Arrays of the contact iteration, see the enumerations in `tables`. ``rows`` are those of the compliance in vectors.
CONTACT_ARRAYS = ArrayLayout(
    chains=real_array_type(2), shapes=real_array_type(2), surface=real_array_type(2), states=integer_array_type(2),
    carried=real_array_type(2),
    lists=integer_array_type(2), free_displacement=real_array_type(2), tool_coupling=real_array_type(2),
    compliance=real_array_type(2),
    rows=LANE_REALS, u=real_array_type(), local=real_array_type(2), columns=real_array_type(2),
    matrix=real_array_type(),
    right=real_array_type())


@cache
def make_normal_tangential_compliance_function():
    """Return the Taichi function ``normal_and_tangential_compliance(i, n, compliance)``.

    The function returns the displacement of node i per own force along the normal n, and the mean displacement per own
    tangential force, m/N, both bounded below.
    """
    ti = get_initialised_taichi()

    @ti.func
    def normal_and_tangential_compliance(i, n, compliance: ti.template()):
        """Return the displacement of node i per own normal force and, as mean, per own tangential force, m/N."""
        C = ti.Matrix([[compliance[3 * i + a, 3 * i + b] for b in ti.static(range(3))] for a in ti.static(range(3))])
        # Tissue that would buckle without the tool may have negative compliances.
        least, along = 1e-2 * ti.abs(C.trace()), n.dot(C @ n)
        return ti.Vector([ti.max(along, least), ti.max(0.5 * (C.trace() - along), least)])

    return normal_and_tangential_compliance


@cache
def make_contact_iteration_kernel():
    """Return the kernel of one contact iteration; for its arrays see the enumerations in `tables`."""
    ti = get_initialised_taichi()
    real1, int1 = ti.types.ndarray(ti.f64, ndim=1), ti.types.ndarray(ti.i32, ndim=1)
    find_surface_geometry = make_surface_geometry_function()
    normal_and_tangential_compliance = make_normal_tangential_compliance_function()
    move = get_shared_scratch_field(LANES, MAX_FREEDOMS // LANES)

    @ti.func
    def extrapolate_forces_by_tool_motion(settings: ti.template(), nodes: ti.template()):
        """Predict the forces of the nodes in contact by linear extrapolation with the motion of the tool."""
        most, largest, many = 0.0, 0.0, ti.cast(settings[KernelSetting.PREDICTED], ti.i32)
        for p in range(many):
            i = nodes.lists[p, NodeListColumn.ACTIVE]
            for a in ti.static(range(3)):
                more = 0.0
                for c in ti.static(range(6)):
                    more = more + nodes.columns[3 * p + a, c] * settings[KernelSetting.STEP + c]
                nodes.local[i, LinearisedContactColumn.FORCE + a] = more
                force = nodes.carried[nodes.lists[i, NodeListColumn.NODE], NodeForceAndAnchorColumn.FORCE + a]
                most, largest = ti.max(most, ti.abs(more)), ti.max(largest, ti.abs(force))
        if most < _MAX_PREDICTED_CHANGE * largest:
            for p in range(many):
                i = nodes.lists[p, NodeListColumn.ACTIVE]
                for a in ti.static(range(3)):
                    force = nodes.carried[nodes.lists[i, NodeListColumn.NODE], NodeForceAndAnchorColumn.FORCE + a]
                    nodes.carried[nodes.lists[i, NodeListColumn.NODE], NodeForceAndAnchorColumn.FORCE + a] = (
                        force + nodes.local[i, LinearisedContactColumn.FORCE + a])
        settings[KernelSetting.PREDICTED] = 0.0

    @ti.func
    def compute_displacements_of_leading_nodes(n, many, settings: ti.template(), nodes: ti.template()):
        """Compute the displacements u of all nodes under the contact forces and the motion of the tool.

        The sum uses rows of the symmetric compliance, so that the compiler vectorises the loops.
        """
        width = nodes.u.shape[0] // LANES
        used = (3 * n + LANES - 1) // LANES
        for q in range(used):
            move[q] = ti.Vector.zero(ti.f64, LANES)
        for l in range(many):
            j = nodes.lists[l, NodeListColumn.LOADED]
            s = nodes.lists[j, NodeListColumn.NODE]
            for m in range(3):
                force = nodes.carried[s, NodeForceAndAnchorColumn.FORCE + m]
                for q in range(used):
                    at = (3 * j + m) * width + q
                    move[q] = move[q] - nodes.rows[at] * force
        for q in range(used):
            for l in ti.static(range(LANES)):
                nodes.u[LANES * q + l] = move[q][l]
        for i in range(n):
            for k in range(3):
                value = nodes.free_displacement[i, k]
                for a in ti.static(range(6)):
                    value = value + nodes.tool_coupling[3 * i + k, a] * settings[KernelSetting.MOTION + a]
                nodes.u[3 * i + k] = nodes.u[3 * i + k] + value

    @ti.func
    def evaluate_node_contact(i, s, settings: ti.template(), results: ti.template(), nodes: ti.template()):
        """Evaluate the contact of node i: gap, contact state, force and force derivatives; update `results`."""
        R = ti.Matrix([[settings[KernelSetting.ROTATION + 3 * a + b] for b in ti.static(range(3))]
                       for a in ti.static(range(3))])
        arm = ti.Vector([nodes.surface[s, SurfaceNodeColumn.POSITION + a] + nodes.u[3 * i + a]
                         - settings[KernelSetting.ORIGIN + a] for a in ti.static(range(3))])
        at = R.transpose() @ arm
        body = nodes.states[s, NodeBondAndStatusColumn.OUTLINE]
        first = body * (nodes.chains.shape[0] // nodes.shapes.shape[0])
        endless = 1 if nodes.shapes[body, 2] * settings[KernelSetting.PRESSED_IN] > 0.0 else 0
        gap, n_tool, meridian, around, bent, hoop, on_shaft = find_surface_geometry(
            at, first, first + ti.cast(nodes.shapes[body, 3], ti.i32), endless,
            first + ti.cast(nodes.shapes[body, 1], ti.i32), nodes.shapes[body, 0], nodes.shapes[body, 4], nodes.chains)
        n, meridian, around = R @ n_tool, R @ meridian, R @ around
        mu = nodes.surface[s, SurfaceNodeColumn.FRICTION + on_shaft]
        # Displacement relative to the tool since all nodes were evaluated: other nodes may have come near.
        for a in ti.static(range(3)):
            if settings[KernelSetting.NEAR_COUNT] == 0.0:
                nodes.local[i, LinearisedContactColumn.REFERENCE + a] = at[a]
            results[KernelResult.TRAVEL] = ti.max(results[KernelResult.TRAVEL],
                                                  ti.abs(at[a] - nodes.local[i, LinearisedContactColumn.REFERENCE + a]))
        # Contact state (active set) and force.
        k = nodes.surface[s, SurfaceNodeColumn.PENALTY] * settings[KernelSetting.MODULUS]
        F = ti.Vector([nodes.carried[s, NodeForceAndAnchorColumn.FORCE + a] for a in ti.static(range(3))])
        normal = ti.min(F.dot(n), 0.0)
        tangential = F - F.dot(n) * n
        give = normal_and_tangential_compliance(i, n, nodes.compliance)
        held = nodes.states[s, NodeBondAndStatusColumn.BOND] == ContactBondState.HELD
        changeable = settings[KernelSetting.CHANGEABLE] > 0.0
        if held and settings[KernelSetting.RELEASE] > 0.0 and F.dot(n) > 0.0:
            nodes.states[s, NodeBondAndStatusColumn.BOND] = ContactBondState.FREE
            held = False
        if changeable and not held:
            nodes.states[s, NodeBondAndStatusColumn.PRESSED] = 1 if normal + gap / give[0] < 0.0 else 0
        is_pressed = nodes.states[s, NodeBondAndStatusColumn.PRESSED] == 1 and not held
        anchor = ti.Vector([nodes.carried[s, NodeForceAndAnchorColumn.ANCHOR + a] for a in ti.static(range(3))])
        slip = R @ (at - anchor)
        aside = slip - slip.dot(n) * n
        length = aside.norm()
        nn, eye = n.outer_product(n), ti.Matrix.identity(ti.f64, 3)
        A, T, missing, found = (ti.Matrix.zero(ti.f64, 3, 3), ti.Matrix.zero(ti.f64, 3, 3), ti.Vector.zero(ti.f64, 3),
                                ti.Vector.zero(ti.f64, 3))
        state, sticks, violation = ContactStatus.SEPARATED, False, 0.0
        if held:
            violation = slip.norm()
            A, missing = SOLID_PENALTY.stick_factor * k * eye, SOLID_PENALTY.stick_factor * k * slip
            found, state = F, ContactStatus.HELD
            if F.dot(n) > 0.0:
                results[KernelResult.PULLING] = results[KernelResult.PULLING] + 1.0
        elif is_pressed:
            violation, state = ti.abs(gap), ContactStatus.FRICTIONLESS
            A = k * nn + normal * (bent * meridian.outer_product(meridian) + hoop * around.outer_product(around))
            missing, found = k * gap * n, normal * n
            rough = mu * ti.max(-normal - gap / give[0], 0.0)
            if mu > 0.0 and nodes.states[s, NodeBondAndStatusColumn.BOND] == ContactBondState.TOUCHED and (
                    rough > settings[KernelSetting.NEGLIGIBLE]):
                limit = mu * ti.max(-normal, 0.0)
                tried = tangential + aside / give[1]
                size = tried.norm()
                if changeable:
                    nodes.states[s, NodeBondAndStatusColumn.SLIPS] = 1 if size > rough else 0
                if nodes.states[s, NodeBondAndStatusColumn.SLIPS] == 1:
                    state = ContactStatus.SLIPPING
                    way = tried / ti.max(size, 1e-300)
                    T = limit / ti.max(size, 1e-300) * (eye - nn - way.outer_product(way))
                    A = A - mu * k * way.outer_product(n) + T / give[1]
                    missing, found = missing - mu * k * gap * way, found + limit * way
                    results[KernelResult.SLIPPING] = results[KernelResult.SLIPPING] + 1.0
                else:
                    sticks, state = True, ContactStatus.STICKING
                    violation = ti.max(violation, length)
                    A = A + SOLID_PENALTY.stick_factor * k * (eye - nn)
                    missing, found = missing + SOLID_PENALTY.stick_factor * k * aside, found + tangential
        else:
            violation = ti.max(-gap, 0.0)
        results[KernelResult.VIOLATION] = ti.max(results[KernelResult.VIOLATION], violation)
        touches = is_pressed or (mu > 0.0 and gap <= 1e-3 * settings[KernelSetting.TOLERANCE])
        nodes.states[s, NodeBondAndStatusColumn.NEW_BOND] = ContactBondState.FREE
        if mu < 0.0 and is_pressed:
            nodes.states[s, NodeBondAndStatusColumn.NEW_BOND] = ContactBondState.HELD
        elif touches and mu > 0.0:
            nodes.states[s, NodeBondAndStatusColumn.NEW_BOND] = ContactBondState.TOUCHED
        keeps = sticks or (touches and not is_pressed and nodes.states[s, NodeBondAndStatusColumn.BOND]
                           == ContactBondState.TOUCHED)
        for a in ti.static(range(3)):
            nodes.carried[s, NodeForceAndAnchorColumn.NEW_ANCHOR + a] = anchor[a] if keeps else at[a] - gap * n_tool[a]
            nodes.local[i, LinearisedContactColumn.ARM + a] = arm[a]
            nodes.local[i, LinearisedContactColumn.NORMAL + a] = n[a]
            nodes.local[i, LinearisedContactColumn.SLIP + a] = slip[a]
            nodes.local[i, LinearisedContactColumn.INTERCEPT + a] = found[a] + missing[a]
            change = found[a] - nodes.local[i, LinearisedContactColumn.FORCE + a]
            results[KernelResult.UNBALANCED] = results[KernelResult.UNBALANCED] + change * change
            results[KernelResult.SIZE] = results[KernelResult.SIZE] + found[a] * found[a]
            nodes.carried[s, NodeForceAndAnchorColumn.FORCE + a] = found[a]
            for b in ti.static(range(3)):
                nodes.local[i, LinearisedContactColumn.STIFFNESS + 3 * a + b] = A[a, b]
                nodes.local[i, LinearisedContactColumn.ROTATION + 3 * a + b] = T[a, b]
        nodes.local[i, LinearisedContactColumn.GAP] = gap
        nodes.local[i, LinearisedContactColumn.FRICTION] = (
            ti.max(mu, 0.0) if nodes.states[s, NodeBondAndStatusColumn.BOND] == ContactBondState.TOUCHED else 0.0)
        # The matrix is reused while the set of nodes in contact does not change.
        if (nodes.lists[i, NodeListColumn.STATUS] > 0) != (state > 0) or nodes.lists[i, NodeListColumn.STATUS] < 0:
            settings[KernelSetting.REBUILDS] = 1.0
        nodes.lists[i, NodeListColumn.STATUS] = state

    @ti.kernel
    def evaluate_contact_and_assemble_equations(settings: real1, results: real1, table: int1):
        """Evaluate displacements and contact of the nodes, and assemble the linear equations of their forces."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            nodes = CONTACT_ARRAYS.open_table(table)
            if settings[KernelSetting.PREDICTED] > 0.0:
                extrapolate_forces_by_tool_motion(settings, nodes)
            n, many = ti.cast(settings[KernelSetting.COUNT], ti.i32), 0
            for i in range(n):
                s = nodes.lists[i, NodeListColumn.NODE]
                size = 0.0
                for a in ti.static(range(3)):
                    force = nodes.carried[s, NodeForceAndAnchorColumn.FORCE + a]
                    nodes.local[i, LinearisedContactColumn.FORCE + a] = force
                    size = size + ti.abs(force)
                if size > 0.0:
                    nodes.lists[many, NodeListColumn.LOADED] = i
                    many = many + 1
            for k in range(RESULT_COUNT):
                results[k] = 0.0
            # Nodes far from the tool carry no force; their displacements are not computed.
            all_nodes = settings[KernelSetting.NEAR_COUNT] == 0.0
            if not all_nodes:
                n = ti.cast(settings[KernelSetting.NEAR_COUNT], ti.i32)
            compute_displacements_of_leading_nodes(n, many, settings, nodes)
            for i in range(n):
                evaluate_node_contact(i, nodes.lists[i, NodeListColumn.NODE], settings, results, nodes)
            count, near = 0, 1
            for i in range(n):
                if nodes.lists[i, NodeListColumn.STATUS] > 0:
                    nodes.lists[count, NodeListColumn.ACTIVE] = i
                    count = count + 1
                if nodes.lists[i, NodeListColumn.STATUS] > 0 or (
                        nodes.local[i, LinearisedContactColumn.GAP] < settings[KernelSetting.NEAR_GAP]):
                    near = i + 1
            if all_nodes:
                # Loaded nodes may come into contact again when other nodes separate.
                if many > 0:
                    near = ti.max(near, nodes.lists[many - 1, NodeListColumn.LOADED] + 1)
                settings[KernelSetting.NEAR_COUNT] = ti.min(near, n)
            k = 3 * count
            results[KernelResult.ACTIVE] = count
            rebuilt = settings[KernelSetting.REBUILDS] > 0.0
            results[KernelResult.REBUILT] = settings[KernelSetting.REBUILDS]
            settings[KernelSetting.REBUILDS] = 0.0
            for p in range(count):
                i = nodes.lists[p, NodeListColumn.ACTIVE]
                # Displacement caused by the last forces of nodes that have separated.
                e = ti.Vector.zero(ti.f64, 3)
                for l in range(many):
                    j = nodes.lists[l, NodeListColumn.LOADED]
                    if nodes.lists[j, NodeListColumn.STATUS] == 0:
                        for a in ti.static(range(3)):
                            for b in ti.static(range(3)):
                                e[a] = e[a] + (nodes.compliance[3 * i + a, 3 * j + b]
                                               * nodes.local[j, LinearisedContactColumn.FORCE + b])
                x, y, z = (nodes.local[i, LinearisedContactColumn.ARM], nodes.local[i, LinearisedContactColumn.ARM + 1],
                           nodes.local[i, LinearisedContactColumn.ARM + 2])
                f = ti.Vector([nodes.local[i, LinearisedContactColumn.INTERCEPT],
                               nodes.local[i, LinearisedContactColumn.INTERCEPT + 1],
                               nodes.local[i, LinearisedContactColumn.INTERCEPT + 2]])
                turning = ti.Matrix([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
                turned = ti.Matrix([[0.0, f[2], -f[1]], [-f[2], 0.0, f[0]], [f[1], -f[0], 0.0]])
                for a in ti.static(range(3)):
                    row = 3 * p + a
                    value = (nodes.local[i, LinearisedContactColumn.INTERCEPT + a]
                             - nodes.local[i, LinearisedContactColumn.FORCE + a])
                    for b in ti.static(range(3)):
                        value = value + nodes.local[i, LinearisedContactColumn.STIFFNESS + 3 * a + b] * e[b]
                    nodes.right[row] = value
                    for c in ti.static(range(6)):
                        value = 0.0
                        if ti.static(c >= 3):
                            value = value + turned[a, ti.static(c - 3)]
                        for b in ti.static(range(3)):
                            way = nodes.tool_coupling[3 * i + b, c]
                            if ti.static(c >= 3):
                                way = way - turning[b, ti.static(c - 3)]
                            elif ti.static(c == b):
                                way = way - 1.0
                            value = value + nodes.local[i, LinearisedContactColumn.STIFFNESS + 3 * a + b] * way
                        nodes.right[(c + 1) * k + row] = value
            # Column by column, the order of LAPACK; the compliance is symmetric.
            for q in range(count if rebuilt else 0):
                j = nodes.lists[q, NodeListColumn.ACTIVE]
                start = 3 * q * k
                for p in range(count):
                    i = nodes.lists[p, NodeListColumn.ACTIVE]
                    C = ti.Matrix([[nodes.compliance[3 * j + b, 3 * i + c] for b in ti.static(range(3))]
                                   for c in ti.static(range(3))])
                    A = ti.Matrix(
                        [[nodes.local[i, LinearisedContactColumn.STIFFNESS + 3 * a + c] for c in ti.static(range(3))]
                         for a in ti.static(range(3))])
                    value = A @ C
                    for b in ti.static(range(3)):
                        for a in ti.static(range(3)):
                            nodes.matrix[start + b * k + 3 * p + a] = value[a, b]
                for b in ti.static(range(3)):
                    for a in ti.static(range(3)):
                        at = start + b * k + 3 * q + a
                        rotation = nodes.local[j, LinearisedContactColumn.ROTATION + 3 * a + b]
                        nodes.matrix[at] = nodes.matrix[at] - rotation + (1.0 if a == b else 0.0)

    return evaluate_contact_and_assemble_equations
