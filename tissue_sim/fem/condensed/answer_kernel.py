"""What a step of the contact on a condensed bulk answers once it is in balance, as a Taichi kernel."""

from functools import cache

from tissue_sim.fem.condensed.kernel import (
    ACTIVE_NODE,
    ANCHOR,
    BOUND,
    FORCE,
    LEVER,
    MET,
    MET_AT,
    MOTION,
    NODE,
    PRESSED,
    SLIPS,
)
from tissue_sim.fem.condensed.model import HELD
from tissue_sim.fem.taichi.runtime import initialise

#: Places in `answer`, of which the last two are of 6 x 6 numbers each: nodes with equations; wrench of what the tool
#: holds, and its stiffness; then what is answered: the whole wrench, and its derivative with the tool's motion.
ANSWERED, HELD_WRENCH, WRENCH, HELD_STIFFNESS, RATES = 0, 1, 7, 13, 49
ANSWER = 85


@cache
def answer_kernel():
    """Kernel that binds the nodes to what they met, and sums up what they hand on to the tool."""
    ti = initialise()
    real1, real2 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2))
    int2 = ti.types.ndarray(ti.i32, ndim=2)

    @ti.func
    def bind(states: ti.template(), carried: ti.template()):
        for s in range(states.shape[0]):
            if states[s, BOUND] != HELD:
                states[s, BOUND] = states[s, MET]
                for a in ti.static(range(3)):
                    carried[s, ANCHOR + a] = carried[s, MET_AT + a]
            states[s, SLIPS] = states[s, SLIPS] & states[s, PRESSED]

    @ti.kernel
    def answer(settings: real1, answer: real1, states: int2, carried: real2, lists: int2, local: real2, drive: real2,
               compliance: real2, columns: real2):
        ti.loop_config(serialize=True)
        for _ in range(1):
            bind(states, carried)
            count = ti.cast(answer[ANSWERED], ti.i32)
            for a in range(6):
                value = answer[HELD_WRENCH + a]
                for c in range(6):
                    held = answer[HELD_STIFFNESS + 6 * a + c]
                    value = value - held * settings[MOTION + c]
                    answer[RATES + 6 * a + c] = -held
                answer[WRENCH + a] = value
            total = ti.Vector.zero(ti.f64, 3)
            for p in range(count):
                i = lists[p, ACTIVE_NODE]
                s = lists[i, NODE]
                f = ti.Vector([carried[s, FORCE + a] for a in ti.static(range(3))])
                arm = ti.Vector([local[i, LEVER + a] for a in ti.static(range(3))])
                total = total + f
                torque = arm.cross(f)
                for a in ti.static(range(3)):
                    answer[WRENCH + a] = answer[WRENCH + a] + f[a]
                    answer[WRENCH + 3 + a] = answer[WRENCH + 3 + a] + torque[a]
                for c in range(6):
                    way = ti.Vector([drive[3 * i + a, c] for a in ti.static(range(3))])
                    change = ti.Vector([columns[3 * p + a, c] for a in ti.static(range(3))])
                    # Nodes hand their forces on to the tool, but for what the tissue is driven by itself.
                    answer[WRENCH + c] = answer[WRENCH + c] - f.dot(way)
                    turned = arm.cross(change) + way.cross(f)
                    for a in ti.static(range(3)):
                        answer[RATES + 6 * a + c] = answer[RATES + 6 * a + c] + change[a]
                        answer[RATES + 18 + 6 * a + c] = answer[RATES + 18 + 6 * a + c] + turned[a]
                    for b in range(6):
                        value = 0.0
                        for a in ti.static(range(3)):
                            value = value + drive[3 * i + a, b] * columns[3 * p + a, c]
                        answer[RATES + 6 * b + c] = answer[RATES + 6 * b + c] - value
            # The levers of the torque change, too: a node goes its way, and the tool's deepest point the tool's.
            for q in range(3 * count):
                turned, at = ti.Vector.zero(ti.f64, 3), 3 * lists[q // 3, ACTIVE_NODE] + q % 3
                for p in range(count):
                    i = lists[p, ACTIVE_NODE]
                    f = ti.Vector([carried[lists[i, NODE], FORCE + a] for a in ti.static(range(3))])
                    turned = turned + ti.Vector([compliance[at, 3 * i + a] for a in ti.static(range(3))]).cross(f)
                for c in range(6):
                    for a in ti.static(range(3)):
                        answer[RATES + 18 + 6 * a + c] = answer[RATES + 18 + 6 * a + c] - turned[a] * columns[q, c]
            for c in ti.static(range(3)):
                unit = ti.Vector([1.0 if a == c else 0.0 for a in ti.static(range(3))])
                turned = unit.cross(total)
                for a in ti.static(range(3)):
                    answer[RATES + 18 + 6 * a + c] = answer[RATES + 18 + 6 * a + c] - turned[a]

    return answer
