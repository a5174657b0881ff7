"""Taichi kernels of a reduced solid: penalty contact with a rigid body, and sampled elements.

Penalty contact acts between nodes and a rigid body of revolution with a thin elastic layer. The other kernel computes
the forces and the stiffness of the sampled elements.
"""

from enum import IntEnum
from functools import cache

from tissue_sim.fem.contact.surface_geometry import make_surface_geometry_function
from tissue_sim.fem.history import MATERIAL_ARRAYS
from tissue_sim.fem.solid.element import ELEMENT_ARRAYS, AssemblySettingColumn, make_element_kernel_functions
from tissue_sim.fem.taichi.array_tables import ArrayLayout, integer_array_type, real_array_type
from tissue_sim.fem.taichi.runtime import LANES, get_initialised_taichi
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.solid import SOLID_ELEMENTS


class SampledElementSettingColumn(IntEnum):
    """Additional columns of the array ``settings`` of the sampled elements, after those of `AssemblySettingColumn`."""

    #: Whether the pressures are updated with the linearised volume change of the last motion of the nodes.
    UPDATES_PRESSURE = 4
    #: Number of columns.
    COUNT = 5


@cache
def make_sampled_elements_kernel(element_name: str, energy: KernelEnergy):
    """Return the kernel of the nodal forces and, for requested groups of batches, the element stiffness.

    Arrays: ``x`` and ``motion`` are the nodal displacements and their last change, m. ``residual`` receives the nodal
    forces, N, ``blocks`` the stiffness matrix of the element in each lane, row by row, and ``least`` the smallest J.
    ``wanted`` states for each group whether its stiffness is computed. ``standing`` is the residual of the pressure
    equation at rest under self-weight, which is subtracted.
    """
    ti = get_initialised_taichi()
    element = SOLID_ELEMENTS[element_name]
    nodes, pressure_modes = element.node_count, element.pressure_modes
    freedoms = 3 * nodes
    integrate_forces, compute_stiffness_blocks = make_element_kernel_functions(element_name, energy)
    vec = ti.types.vector(LANES, ti.f64)
    real1 = ti.types.ndarray(ti.f64, ndim=1)
    single1 = ti.types.ndarray(ti.f32, ndim=1)
    int1 = ti.types.ndarray(ti.i32, ndim=1)
    vector1 = ti.types.ndarray(vec, ndim=1)

    @ti.func
    def update_batch_pressures_linearly(b, kappa, motion: ti.template(), elements: ti.template()):
        """Update the pressures of batch b by the linearised pressure equation and the last nodal ``motion``."""
        bulk = kappa * elements.moduli[b]
        for m in range(pressure_modes):
            at = b * pressure_modes + m
            gap = elements.gaps[at]
            for a in range(nodes):
                for k in ti.static(range(3)):
                    moved = ti.Vector([motion[elements.dofs[b * nodes + a][l] + k] for l in ti.static(range(LANES))])
                    gap = gap + elements.volume_rates[at * freedoms + 3 * a + k] * moved
            elements.pressures[at] = elements.pressures[at] + bulk * gap

    @ti.func
    def expand_stiffness_to_element_matrices(b, elements: ti.template(), blocks: ti.template()):
        """Copy the stiffness blocks of a batch to one full matrix for each element."""
        for c in range(nodes):
            for a in range(c + 1):
                # Index 3 k + i: force on node a along i for a displacement of node c along k.
                pair = 9 * (c * (c + 1) // 2 + a)
                for l in ti.static(range(LANES)):
                    first = (b * LANES + l) * freedoms * freedoms
                    below, above = first + freedoms * 3 * a + 3 * c, first + freedoms * 3 * c + 3 * a
                    for k in ti.static(range(3)):
                        for i in ti.static(range(3)):
                            K = ti.cast(elements.stiffness[pair + 3 * k + i][l], ti.f32)
                            blocks[below + freedoms * i + k] = K
                            blocks[above + freedoms * k + i] = K

    @ti.kernel
    def compute_sampled_nodal_forces_and_matrices(settings: real1, least: real1, batches: int1, x: real1, motion: real1,
                                                  residual: real1, groups: int1, wanted: real1, blocks: single1,
                                                  standing: vector1, element_table: int1, material_table: int1):
        """Compute nodal forces and the smallest J, and the stiffness matrices of the elements in wanted groups."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            elements, material = ELEMENT_ARRAYS.open_table(element_table), MATERIAL_ARRAYS.open_table(material_table)
            kappa, remembers = settings[AssemblySettingColumn.KAPPA], settings[AssemblySettingColumn.REMEMBERS]
            least[0] = 1e30
            if settings[AssemblySettingColumn.ADDS] == 0.0:
                for i in range(residual.shape[0]):
                    residual[i] = 0.0
            for b in range(batches[0]):
                stiff = wanted[groups[b]]
                if settings[SampledElementSettingColumn.UPDATES_PRESSURE] > 0.0:
                    update_batch_pressures_linearly(b, kappa, motion, elements)
                smallest = integrate_forces(b, kappa, stiff, remembers, x, elements, material)
                least[0] = ti.min(least[0], smallest)
                bulk = kappa * elements.moduli[b]
                for m in range(pressure_modes):
                    at = b * pressure_modes + m
                    elements.gaps[at] = elements.gaps[at] - standing[at]
                for i in range(freedoms):
                    force = elements.forces[b * freedoms + i]
                    for m in range(pressure_modes):
                        at = b * pressure_modes + m
                        force = force - bulk * standing[at] * elements.volume_rates[at * freedoms + i]
                    for l in ti.static(range(LANES)):
                        e = elements.equations[b * freedoms + i][l]
                        residual[e] = residual[e] + force[l]
                if stiff > 0.0:
                    compute_stiffness_blocks(b, kappa, elements)
                    expand_stiffness_to_element_matrices(b, elements, blocks)

    return compute_sampled_nodal_forces_and_matrices


class NodeState(IntEnum):
    """Contact state of a node: free, in contact with stick (also without friction), or in contact with slip."""

    FREE = 0
    STICKS = 1
    SLIPS = 2


class PenaltyContactSetting(IntEnum):
    """Columns of the array ``settings`` of the contact kernel."""

    #: First of nine entries: rotation matrix of the body, row by row.
    ROTATION = 0
    #: First of three entries: position of the origin of the body, m.
    ORIGIN = 9
    #: Rounding radius of the outline, m.
    ROUNDING = 12
    #: Half width of the gap interval in which the pressure rises quadratically from zero, m.
    ZONE = 13
    #: 1 if the body is at or below the height of first contact, else 0.
    PRESSED_IN = 14
    #: A node within this fraction of its friction limit counts as slipping.
    SLIP_MARGIN = 15
    #: Number of columns.
    COUNT = 16


class PenaltyContactResult(IntEnum):
    """Columns of the array ``report``, the results of the contact kernel that concern all nodes."""

    #: Number of touching nodes.
    TOUCHING = 0
    #: Number of slipping nodes.
    SLIPPING = 1
    #: Largest penetration of a node, m.
    DEPTH = 2
    #: Number of columns.
    COUNT = 3


#: Distance from the axis of the body below which both curvatures are equal, m.
AXIS_RADIUS = 1e-12

#: Arrays of the contact kernel, see `make_penalty_contact_kernel`.
LAYER_ARRAYS = ArrayLayout(
    lines=real_array_type(2), shaft=integer_array_type(), places=real_array_type(2), moved=real_array_type(2),
    springs=real_array_type(),
    friction=real_array_type(2), first=integer_array_type(), closed=integer_array_type(), anchors=real_array_type(2),
    touched=integer_array_type(), forces=real_array_type(2), rates=real_array_type(3), gaps=real_array_type(),
    new_anchors=real_array_type(2),
    states=integer_array_type(), rows=real_array_type(2), met=real_array_type(2), answers=real_array_type(2),
    pushes=real_array_type(),
    twists=real_array_type(2))


@cache
def make_penalty_contact_kernel():
    """Return the kernel that computes the nodal contact forces, their derivatives, and the projections on the modes.

    A node with gap g is loaded by the pressure force k phi(g): phi(g) = -g for g < -zone, 0 for g > zone and the
    parabola (zone - g)^2 / (4 zone) between them. Tangentially the penalty stiffness k acts on the distance from the
    stick anchor, which is fixed to the body, up to the Coulomb limit mu k phi (return mapping).

    Arrays: ``first`` is the first line of the outline that a node may touch. ``closed`` states whether the first line
    (of a sharp shaft) is extended downwards without end for a node. Behind the modes come six unit motions of the tool,
    its displacement and its rotation about its origin. For the touching nodes in order, ``met`` receives the
    displacement of the node in each mode and each unit motion, and ``answers`` minus the change of its force; shape
    (3 nodes, modes + 6).
    ``pushes`` receives the generalised forces, shape (modes + 6,), and ``twists`` the derivative of the torque through
    the lever arms, shape (3, modes). Forces are in the frame of the mesh, N.
    """
    ti = get_initialised_taichi()
    find_surface_geometry = make_surface_geometry_function()
    real1, int1 = ti.types.ndarray(ti.f64, ndim=1), ti.types.ndarray(ti.i32, ndim=1)

    @ti.func
    def write_node_force_and_derivative(n, settings: ti.template(), nodes: ti.template()):
        """Write gap and contact state of node n; if it touches, also its force and minus the derivative by position."""
        turn = ti.Matrix([[settings[PenaltyContactSetting.ROTATION + 3 * i + k] for k in ti.static(range(3))]
                          for i in ti.static(range(3))])
        offset = ti.Vector([nodes.places[n, i] + nodes.moved[n, i] - settings[PenaltyContactSetting.ORIGIN + i]
                            for i in ti.static(range(3))])
        at = turn.transpose() @ offset
        rounding, endless = settings[PenaltyContactSetting.ROUNDING], 0
        if (nodes.closed[n] > 0 and settings[PenaltyContactSetting.PRESSED_IN] > 0.0
                and nodes.first[n] == nodes.shaft[0] and rounding == 0.0):
            endless = 1
        gap, normal, meridian, around, bent, hoop, on_shaft = find_surface_geometry(
            at, nodes.first[n], nodes.lines.shape[0], endless, nodes.shaft[0], rounding, AXIS_RADIUS, nodes.lines)
        nodes.gaps[n] = gap
        zone = settings[PenaltyContactSetting.ZONE]
        nodes.states[n] = NodeState.FREE
        for i in ti.static(range(3)):
            nodes.new_anchors[n, i] = at[i]
        if gap < zone:
            depth, slope = -gap, 1.0
            if gap > -zone:
                depth, slope = (zone - gap) * (zone - gap) / (4.0 * zone), (zone - gap) / (2.0 * zone)
            spring = nodes.springs[n]
            pressure = spring * depth
            nn = normal.outer_product(normal)
            rate = spring * slope * nn - pressure * (bent * meridian.outer_product(meridian)
                                                     + hoop * around.outer_product(around))
            force = pressure * normal
            nodes.states[n] = NodeState.STICKS
            mu = nodes.friction[n, on_shaft]
            # A node that comes into contact in this step gets its anchor at the end of the step.
            if mu > 0.0 and nodes.touched[n] > 0:
                anchor = ti.Vector([nodes.anchors[n, i] for i in ti.static(range(3))])
                slip = at - anchor
                slip = slip - slip.dot(normal) * normal
                size, limit = slip.norm(), mu * pressure
                tangent = ti.Matrix.identity(ti.f64, 3) - nn
                share = 1.0
                if spring * size > (1.0 - settings[PenaltyContactSetting.SLIP_MARGIN]) * limit and size > 0.0:
                    nodes.states[n] = NodeState.SLIPS
                    share = ti.min(1.0, limit / (spring * size))
                    way = slip / size
                    rate = rate + spring * share * (tangent - way.outer_product(way)) \
                        + mu * spring * slope * way.outer_product(-normal)
                else:
                    rate = rate + spring * tangent
                force = force - spring * share * slip
                for i in ti.static(range(3)):
                    nodes.new_anchors[n, i] = at[i] - share * slip[i]
            force = turn @ force
            rate = turn @ rate @ turn.transpose()
            for i in ti.static(range(3)):
                nodes.forces[n, i] = force[i]
                for k in ti.static(range(3)):
                    nodes.rates[n, i, k] = rate[i, k]

    @ti.func
    def project_node_force_on_modes(n, at, settings: ti.template(), nodes: ti.template()):
        """Project force and derivative of touching node n on the modes; its rows of ``met`` begin at `at`."""
        modes = nodes.rows.shape[1]
        force = ti.Vector([nodes.forces[n, i] for i in ti.static(range(3))])
        rate = ti.Matrix([[nodes.rates[n, i, k] for k in ti.static(range(3))] for i in ti.static(range(3))])
        lever = ti.Vector([nodes.places[n, i] + nodes.moved[n, i] - settings[PenaltyContactSetting.ORIGIN + i]
                           for i in ti.static(range(3))])
        for m in range(modes):
            row = ti.Vector([nodes.rows[3 * n + i, m] for i in ti.static(range(3))])
            answer = rate @ row
            twist = row.cross(force)
            nodes.pushes[m] = nodes.pushes[m] + row.dot(force)
            for i in ti.static(range(3)):
                nodes.met[at + i, m] = row[i]
                nodes.answers[at + i, m] = answer[i]
                nodes.twists[i, m] = nodes.twists[i, m] + twist[i]
        for m in ti.static(range(6)):
            # A rotation of the tool moves the contact point and rotates the force with the tool.
            axis = ti.Vector([float(i == m % 3) for i in ti.static(range(3))])
            way, turned = axis, 0.0 * force
            if ti.static(m >= 3):
                way, turned = axis.cross(lever), axis.cross(force)
            answer = rate @ way + turned
            nodes.pushes[modes + m] = nodes.pushes[modes + m] + way.dot(force)
            for i in ti.static(range(3)):
                nodes.met[at + i, modes + m] = way[i]
                nodes.answers[at + i, modes + m] = answer[i]

    @ti.kernel
    def evaluate_penalty_contact(settings: real1, report: real1, table: int1):
        """Compute the contact forces of all nodes, their derivatives, and the projections on modes and tool motions."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            nodes = LAYER_ARRAYS.open_table(table)
            for m in range(nodes.pushes.shape[0]):
                nodes.pushes[m] = 0.0
            for m in range(nodes.rows.shape[1]):
                for i in ti.static(range(3)):
                    nodes.twists[i, m] = 0.0
            touching, slipping, depth = 0, 0, 0.0
            for n in range(nodes.places.shape[0]):
                write_node_force_and_derivative(n, settings, nodes)
                if nodes.states[n] != NodeState.FREE:
                    project_node_force_on_modes(n, 3 * touching, settings, nodes)
                    touching += 1
                    depth = ti.max(depth, -nodes.gaps[n])
                if nodes.states[n] == NodeState.SLIPS:
                    slipping += 1
            report[PenaltyContactResult.TOUCHING] = touching
            report[PenaltyContactResult.SLIPPING] = slipping
            report[PenaltyContactResult.DEPTH] = depth

    return evaluate_penalty_contact
