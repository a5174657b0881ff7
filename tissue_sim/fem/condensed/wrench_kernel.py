"""Wrench on the tool and its derivative after a converged step on a condensed bulk, as a Taichi kernel."""

from enum import IntEnum
from functools import cache

from tissue_sim.fem.condensed.tables import (
    KernelSetting,
    LinearisedContactColumn,
    NodeBondAndStatusColumn,
    NodeForceAndAnchorColumn,
    NodeListColumn,
)
from tissue_sim.fem.contact.settings import ContactBondState
from tissue_sim.fem.taichi.runtime import get_initialised_taichi


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
