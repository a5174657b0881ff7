"""Frictional contact of nodes on a condensed bulk with the tangent planes of the tool, by semismooth Newton iteration.

The forces f on the tool solve f = P(f + rho g), where g are gaps and slips, linear in f, and P is the projection onto
the admissible contact forces: no tension, and tangential forces within Coulomb's cone. Newton's method on this
piecewise smooth equation finds contact states and forces together (Alart and Curnier, Comput. Methods Appl. Mech. Eng.
92 (1991) 353). The augmentation parameter rho is the stiffness of each node alone; a line search halves the step until
the residual decreases. Gauss-Seidel iteration over the nodes (Jean, ibid. 177 (1999) 235) needs a thousand iterations
on a surface close to an instability.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cache

import numpy as np

from tissue_sim.fem.condensed.kernel import make_normal_tangential_compliance_function
from tissue_sim.fem.condensed.tables import (
    KernelSetting,
    LinearisedContactColumn,
    NodeBondAndStatusColumn,
    NodeForceAndAnchorColumn,
    NodeListColumn,
)
from tissue_sim.fem.contact.pairs import ContactBondState
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.runtime import LOCK, get_initialised_taichi


class FlatKernelOutputIndex(IntEnum):
    """Indices of `found`, the outputs of the kernel of `make_tangent_plane_contact_kernel`.

    Attributes:
        RESIDUAL: square of the norm of the residual, N2.
        FORCES: square of the norm of the forces, N2.
        NODES: number of nodes in the linear equations.
        EQUATIONS: number of linear equations.
    """

    RESIDUAL = 0
    FORCES = 1
    NODES = 2
    EQUATIONS = 3


class FlatKernelInputIndex(IntEnum):
    """Indices of `limits`, the inputs of the kernel of `make_tangent_plane_contact_kernel`.

    Attributes:
        NEAR_GAP: nodes with a smaller gap take part, m.
        TOLERANCE: relative residual below which no linear equations are assembled.
        FLOOR: smallest force against which the residual is measured, N.
        STEP_LENGTH: step length of the line search: 0 evaluates at the present forces; 1 takes the full step of a new
            linear solution; less than 1 takes this fraction of that full step.
    """

    NEAR_GAP = 0
    TOLERANCE = 1
    FLOOR = 2
    STEP_LENGTH = 3


class FlatContactColumn(IntEnum):
    """Columns of `flat`: rows of the nodes of the model, then of the nodes in the linear equations.

    Attributes:
        DISPLACEMENT: displacement since the last evaluation of the tool's surface, 3 numbers, m.
        START: force at the beginning of the step, 3 numbers, N.
        GOAL: force at the end of the full step, 3 numbers, N.
        RATES: derivatives of the node's equations with respect to its position, 3 x 3, N/m.
        DIRECTIONS: force directions of the node's unknowns, 3 x 3.
        DIAGONAL: direct part of each unknown in its own equation, 3 numbers.
        KNOWN: change of the force that is known without the linear equations, 3 numbers, N.
    """

    DISPLACEMENT = 0
    START = 3
    GOAL = 6
    RATES = 9
    DIRECTIONS = 18
    DIAGONAL = 27
    KNOWN = 30


#: Number of columns of `flat`.
FLAT_COLUMNS = FlatContactColumn.KNOWN + 3


@cache
def make_tangent_plane_contact_kernel():
    """Return the kernel of `TangentPlaneContact`: line-search step, then residual and next linear equations.

    A sticking node has three unknowns. A slipping node has two: the normal force, to which the friction is
    proportional, and the tangential force perpendicular to the slip; the change of the friction along the slip is then
    known. A node without friction has one unknown.
    """
    ti = get_initialised_taichi()
    real1, real2 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2))
    int2 = ti.types.ndarray(ti.i32, ndim=2)
    normal_and_tangential_compliance = make_normal_tangential_compliance_function()

    @ti.func
    def apply_line_search_step(settings: ti.template(), found: ti.template(), step_length, lists: ti.template(),
                               carried: ti.template(), flat: ti.template(), right: ti.template()):
        """Move the forces by a step length towards the linear solution; nodes without unknowns move to zero force."""
        many = ti.cast(settings[KernelSetting.COUNT], ti.i32)
        if step_length == 1.0:
            for i in range(many):
                for a in ti.static(range(3)):
                    flat[i, FlatContactColumn.START + a] = carried[lists[i, NodeListColumn.NODE],
                                                                   NodeForceAndAnchorColumn.FORCE + a]
                    flat[i, FlatContactColumn.GOAL + a] = 0.0
            for p in range(ti.cast(found[FlatKernelOutputIndex.NODES], ti.i32)):
                i = lists[p, NodeListColumn.UNKNOWN]
                for a in ti.static(range(3)):
                    value = flat[i, FlatContactColumn.START + a] + flat[p, FlatContactColumn.KNOWN + a]
                    for row in range(lists[p, NodeListColumn.ROWS]):
                        amplitude = right[lists[p, NodeListColumn.FIRST_ROW] + row]
                        value = value + flat[p, FlatContactColumn.DIRECTIONS + 3 * row + a] * amplitude
                    flat[i, FlatContactColumn.GOAL + a] = value
        for i in range(many):
            for a in ti.static(range(3)):
                begun = flat[i, FlatContactColumn.START + a]
                force = begun + step_length * (flat[i, FlatContactColumn.GOAL + a] - begun)
                carried[lists[i, NodeListColumn.NODE], NodeForceAndAnchorColumn.FORCE + a] = force

    @ti.func
    def compute_displacements_by_force_changes(many, carried: ti.template(), lists: ti.template(), local: ti.template(),
                                               compliance: ti.template(), flat: ti.template()):
        """Compute the node displacements caused by force changes since the tool surface was linearised."""
        for p in range(many):
            for a in ti.static(range(3)):
                flat[lists[p, NodeListColumn.NEAR], FlatContactColumn.DISPLACEMENT + a] = 0.0
        for q in range(many):
            j = lists[q, NodeListColumn.NEAR]
            s = lists[j, NodeListColumn.NODE]
            change = ti.Vector([carried[s, NodeForceAndAnchorColumn.FORCE + b]
                                - local[j, LinearisedContactColumn.FORCE + b] for b in ti.static(range(3))])
            if change.norm() > 0.0:
                for p in range(many):
                    i = lists[p, NodeListColumn.NEAR]
                    for a in ti.static(range(3)):
                        before = flat[i, FlatContactColumn.DISPLACEMENT + a]
                        flat[i, FlatContactColumn.DISPLACEMENT + a] = before - (
                            compliance[3 * j, 3 * i + a] * change[0] + compliance[3 * j + 1, 3 * i + a] * change[1]
                            + compliance[3 * j + 2, 3 * i + a] * change[2])

    @ti.func
    def store_coefficients_of_node_unknown(p, row, rate, way, own, rest, lists: ti.template(), flat: ti.template(),
                                           right: ti.template()):
        """Store one unknown of node p: force derivative and direction, diagonal entry, minus the residual."""
        for a in ti.static(range(3)):
            flat[p, FlatContactColumn.RATES + 3 * row + a], flat[p, FlatContactColumn.DIRECTIONS + 3 * row + a] = (
                rate[a], way[a])
        flat[p, FlatContactColumn.DIAGONAL + row], right[lists[p, NodeListColumn.FIRST_ROW] + row] = own, -rest
        lists[p, NodeListColumn.ROWS] = row + 1

    @ti.func
    def evaluate_node_residual(p, i, first, states: ti.template(), carried: ti.template(), lists: ti.template(),
                               local: ti.template(), compliance: ti.template(), flat: ti.template(),
                               right: ti.template()):
        """Return the residual of the equation of node i, N, and store its unknowns.

        For the storage see `store_coefficients_of_node_unknown`. The unknowns are those of the p-th node with
        unknowns, from equation `first` on.
        """
        s = lists[i, NodeListColumn.NODE]
        n = ti.Vector([local[i, LinearisedContactColumn.NORMAL + a] for a in ti.static(range(3))])
        F = ti.Vector([carried[s, NodeForceAndAnchorColumn.FORCE + a] for a in ti.static(range(3))])
        move = ti.Vector([flat[i, FlatContactColumn.DISPLACEMENT + a] for a in ti.static(range(3))])
        slip = ti.Vector([local[i, LinearisedContactColumn.SLIP + a] for a in ti.static(range(3))]) + move
        gap, mu = local[i, LinearisedContactColumn.GAP] + n.dot(move), local[i, LinearisedContactColumn.FRICTION]
        give = normal_and_tangential_compliance(i, n, compliance)
        along, aside = give[0], give[1]
        nn, eye = n.outer_product(n), ti.Matrix.identity(ti.f64, 3)
        held, N = states[s, NodeBondAndStatusColumn.BOND] == ContactBondState.HELD, F.dot(n) + gap / along
        rest, rates, sticks = -F, eye, held
        lists[p,
              NodeListColumn.UNKNOWN], lists[p, NodeListColumn.FIRST_ROW], lists[p, NodeListColumn.ROWS] = i, first, 0
        for a in ti.static(range(3)):
            flat[p, FlatContactColumn.KNOWN + a] = 0.0
        if held:
            rates = eye / ti.max(along, aside)
            rest = rates @ slip
        else:
            states[s, NodeBondAndStatusColumn.PRESSED], states[s, NodeBondAndStatusColumn.SLIPS] = 0, 0
            if N < 0.0:
                tried = F + slip / aside
                q = tried - tried.dot(n) * n
                length, most = q.norm(), -mu * N
                states[s, NodeBondAndStatusColumn.PRESSED] = 1
                sticks = mu > 0.0 and length <= most
                if sticks:
                    rest, rates = N * n + q - F, nn / along + (eye - nn) / aside
                else:
                    states[s, NodeBondAndStatusColumn.SLIPS] = 1
                    way = q / ti.max(length, 1e-300)
                    rest = N * n + most * way - F
                    store_coefficients_of_node_unknown(p, 0, n / along, n - mu * way, 0.0, rest.dot(n), lists, flat,
                                                       right)
                    known = rest - rest.dot(n) * n
                    if mu > 0.0:
                        part, other = most / length, n.cross(way)
                        store_coefficients_of_node_unknown(p, 1, part / aside * other, other, part - 1.0,
                                                           rest.dot(other), lists, flat, right)
                        known = (rest.dot(way) + mu * rest.dot(n)) * way
                    for a in ti.static(range(3)):
                        flat[p, FlatContactColumn.KNOWN + a] = known[a]
        if sticks:
            for a in ti.static(range(3)):
                row = ti.Vector([rates[a, b] for b in ti.static(range(3))])
                unit = ti.Vector([1.0 if a == b else 0.0 for b in ti.static(range(3))])
                store_coefficients_of_node_unknown(p, a, row, unit, 0.0, rest[a], lists, flat, right)
        return rest

    @ti.func
    def add_node_coupling(q, count, k, lists: ti.template(), compliance: ti.template(), flat: ti.template(),
                          matrix: ti.template(), right: ti.template()):
        """Add the coupling of the q-th node's unknowns to all equations, and its known force to the right-hand side."""
        at, first, rows = (3 * lists[q, NodeListColumn.UNKNOWN], lists[q, NodeListColumn.FIRST_ROW],
                           lists[q, NodeListColumn.ROWS])
        known = ti.Vector([flat[q, FlatContactColumn.KNOWN + b] for b in ti.static(range(3))])
        ways = ti.Matrix([[flat[q, FlatContactColumn.DIRECTIONS + 3 * row + b] for b in ti.static(range(3))]
                          for row in ti.static(range(3))])
        for p in range(count):
            i, begin = lists[p, NodeListColumn.UNKNOWN], lists[p, NodeListColumn.FIRST_ROW]
            C = ti.Matrix([[compliance[at + b, 3 * i + a] for a in ti.static(range(3))] for b in ti.static(range(3))])
            for other in range(lists[p, NodeListColumn.ROWS]):
                pushed = C @ ti.Vector([flat[p, FlatContactColumn.RATES + 3 * other + a] for a in ti.static(range(3))])
                right[begin + other] = right[begin + other] + pushed.dot(known)
                for row in ti.static(range(3)):
                    if row < rows:
                        way = ti.Vector([ways[row, b] for b in ti.static(range(3))])
                        matrix[(first + row) * k + begin + other] = -pushed.dot(way)
        for row in range(rows):
            matrix[(first + row) * (k + 1)] = matrix[(first + row) * (k + 1)] + (
                flat[q, FlatContactColumn.DIAGONAL + row])

    @ti.func
    def subtract_separated_force_from_right_side(j, count, carried: ti.template(), lists: ti.template(),
                                                 compliance: ti.template(), flat: ti.template(), right: ti.template()):
        """Subtract the displacement caused by the force of a separating node from the right-hand side."""
        force = ti.Vector([carried[lists[j, NodeListColumn.NODE], NodeForceAndAnchorColumn.FORCE + b]
                           for b in ti.static(range(3))])
        for p in range(count if force.norm() > 0.0 else 0):
            i, begin = lists[p, NodeListColumn.UNKNOWN], lists[p, NodeListColumn.FIRST_ROW]
            C = ti.Matrix([[compliance[3 * j + b, 3 * i + a] for a in ti.static(range(3))]
                           for b in ti.static(range(3))])
            for other in range(lists[p, NodeListColumn.ROWS]):
                pushed = C @ ti.Vector([flat[p, FlatContactColumn.RATES + 3 * other + a] for a in ti.static(range(3))])
                right[begin + other] = right[begin + other] - pushed.dot(force)

    @ti.kernel
    def take_step_and_assemble_contact_equations(settings: real1, found: real1, limits: real1, states: int2,
                                                 carried: real2,
                                                 lists: int2, local: real2, compliance: real2, flat: real2,
                                                 matrix: real1, right: real1):
        """Apply a line-search step, compute the residual, and assemble the next linear equations if needed."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            if limits[FlatKernelInputIndex.STEP_LENGTH] > 0.0:
                apply_line_search_step(settings, found, limits[FlatKernelInputIndex.STEP_LENGTH], lists, carried, flat,
                                       right)
            many, count, k, left, size = 0, 0, 0, 0.0, 0.0
            for i in range(ti.cast(settings[KernelSetting.COUNT], ti.i32)):
                s = lists[i, NodeListColumn.NODE]
                loaded = 0.0
                for a in ti.static(range(3)):
                    loaded = loaded + ti.abs(carried[s, NodeForceAndAnchorColumn.FORCE + a]) + ti.abs(
                        local[i, LinearisedContactColumn.FORCE + a])
                if (states[s, NodeBondAndStatusColumn.BOND] == ContactBondState.HELD or loaded > 0.0
                        or local[i, LinearisedContactColumn.GAP] < limits[FlatKernelInputIndex.NEAR_GAP]):
                    lists[many, NodeListColumn.NEAR] = i
                    many = many + 1
            compute_displacements_by_force_changes(many, carried, lists, local, compliance, flat)
            for p in range(many):
                i = lists[p, NodeListColumn.NEAR]
                rest = evaluate_node_residual(count, i, k, states, carried, lists, local, compliance, flat, right)
                left = left + rest.dot(rest)
                for a in ti.static(range(3)):
                    force = carried[lists[i, NodeListColumn.NODE], NodeForceAndAnchorColumn.FORCE + a]
                    size = size + force * force
                k = k + lists[count, NodeListColumn.ROWS]
                if lists[count, NodeListColumn.ROWS] > 0:
                    count = count + 1
            found[FlatKernelOutputIndex.RESIDUAL], found[FlatKernelOutputIndex.FORCES] = left, size
            found[FlatKernelOutputIndex.NODES], found[FlatKernelOutputIndex.EQUATIONS] = count, k
            if ti.sqrt(left) > limits[FlatKernelInputIndex.TOLERANCE] * ti.max(ti.sqrt(size),
                                                                               limits[FlatKernelInputIndex.FLOOR]):
                for q in range(many):
                    j = lists[q, NodeListColumn.NEAR]
                    s = lists[j, NodeListColumn.NODE]
                    if (states[s, NodeBondAndStatusColumn.BOND] != ContactBondState.HELD
                            and states[s, NodeBondAndStatusColumn.PRESSED] == 0):
                        subtract_separated_force_from_right_side(j, count, carried, lists, compliance, flat, right)
                for q in range(count):
                    add_node_coupling(q, count, k, lists, compliance, flat, matrix, right)

    return take_step_and_assemble_contact_equations


@dataclass(frozen=True)
class TangentPlaneContactSettings:
    """Settings of the semismooth Newton method.

    Attributes:
        max_iterations: maximum number of linear solves.
        max_halvings: maximum number of halvings of the step length in each line search.
        sufficient_decrease: fraction of the predicted decrease of the residual that a step must reach (Armijo rule).
    """

    max_iterations: int = 12
    max_halvings: int = 6
    sufficient_decrease: float = 0.1


#: Settings of every `TangentPlaneContact`.
_SETTINGS = TangentPlaneContactSettings()


class TangentPlaneContact:
    """Solver of the frictional contact of nodes near the tool with the tangent planes of the tool surface.

    Args:
        arrays: arrays of the stepper, by the names of `make_tangent_plane_contact_kernel`; the forces and contact
            states in them are changed.
        near: largest gap of a node that takes part without carrying a force, m.
        floor: smallest force by which the residual is divided, N.
    """

    def __init__(self, arrays: dict[str, np.ndarray], near: float, floor: float):
        n = len(arrays["lists"])
        self._floor, self._found = floor, np.zeros(4)
        self._matrix, self._right = np.zeros(9 * n * n), np.zeros(3 * n)
        self._limits = np.array([near, 0.0, floor, 0.0])
        own = {"found": self._found, "limits": self._limits, "flat": np.zeros((n, FLAT_COLUMNS)),
               "matrix": self._matrix, "right": self._right}
        with LOCK:
            self._kernel = BoundKernel.bind_by_name(make_tangent_plane_contact_kernel(), arrays | own)

    def try_solving_contact_forces(self, tolerance: float) -> bool:
        """Solve for forces and contact states of the nodes; both are written to the arrays of the stepper.

        Args:
            tolerance: largest residual over the norm of the forces.

        Returns:
            Whether the residual is within the tolerance.
        """
        from scipy.linalg import lapack

        self._limits[FlatKernelInputIndex.TOLERANCE] = tolerance
        residual, k = self._take_step_and_get_residual_norm(0.0)
        for _ in range(_SETTINGS.max_iterations):
            if residual <= tolerance:
                return True
            if k:
                right = self._right[:k]
                *_, found, failed = lapack.dgesv(self._matrix[:k * k].reshape(k, k).T, right.reshape(k, 1),
                                                 overwrite_a=1, overwrite_b=1)
                right[:] = found[:, 0]  # the kernel reads the solution there; LAPACK mostly solves in place
                if failed or not math.isfinite(right @ right):
                    return False
            step_length = 1.0
            for halving in range(_SETTINGS.max_halvings + 1):
                now, k = self._take_step_and_get_residual_norm(step_length)
                if now <= (1.0 - _SETTINGS.sufficient_decrease * step_length) * residual:
                    break
                step_length *= 0.5
                if halving == _SETTINGS.max_halvings:
                    return False
            residual = now
        return residual <= tolerance

    def _take_step_and_get_residual_norm(self, step_length: float) -> tuple[float, int]:
        """Evaluate the residual at a step length towards the linear solution, and assemble the next linear equations.

        Args:
            step_length: step length of the line search; 0 evaluates at the present forces.

        Returns:
            Residual over the norm of the forces, and the number of unknowns of the next linear equations.
        """
        self._limits[FlatKernelInputIndex.STEP_LENGTH] = step_length
        with LOCK:
            self._kernel()
        residual, forces, _, unknowns = self._found.tolist()
        return math.sqrt(residual) / max(math.sqrt(forces), self._floor), int(unknowns)
