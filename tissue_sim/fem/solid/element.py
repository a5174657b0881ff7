"""Three-dimensional mixed elements as Taichi functions: forces and stiffness of a batch of elements.

Each lane of the vectors is one element, as in `tissue_sim.fem.axisymmetric.assembly`. A discontinuous pressure in each
element enforces J - 1 = p / K in the mean; it is an unknown of Newton's method and eliminated element by element (Simo,
Taylor and Pister, CMAME 51 (1985) 177).
"""

from enum import IntEnum
from functools import cache
from typing import Any, NamedTuple

from tissue_sim.fem.elements.energy import make_inverse_cube_root_function
from tissue_sim.fem.elements.history import make_history_function
from tissue_sim.fem.solid.energy import (
    COFACTOR,
    PLACE,
    make_cofactor_function,
    make_relaxation_function,
    make_stress_function,
)
from tissue_sim.fem.taichi.array_tables import LANE_INTEGERS, LANE_REALS, ArrayLayout
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.shared_fields import LANES, CountsInLargestElement, get_shared_scratch_field
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.solid import SOLID_ELEMENTS
from tissue_sim.mesh.solid_element import MAX_NODES

#: Elements of a solid, see `tissue_sim.fem.solid.batches.ElementBatches.collect_arrays_by_name`.
ELEMENT_ARRAYS = ArrayLayout(
    numbers=LANE_INTEGERS, dofs=LANE_INTEGERS, equations=LANE_INTEGERS, gradient_x=LANE_REALS, gradient_y=LANE_REALS,
    gradient_z=LANE_REALS, weights=LANE_REALS, mode_values=LANE_REALS, moduli=LANE_REALS, pressures=LANE_REALS,
    volume_rates=LANE_REALS, gaps=LANE_REALS, forces=LANE_REALS, stiffness=LANE_REALS, places=LANE_INTEGERS,
    mirrored=LANE_INTEGERS)


class AssemblySettingColumn(IntEnum):
    """Columns of the array ``settings`` of the assembly kernels."""

    #: Bulk modulus, Pa.
    KAPPA = 0
    #: Whether the tangent is computed.
    TANGENT = 1
    #: Whether the material has a history.
    REMEMBERS = 2
    #: Whether forces and stiffness are added to those of other elements.
    ADDS = 3


#: Size of the largest element.
_LARGEST = CountsInLargestElement(nodes=MAX_NODES, points=MAX_NODES, modes=4)
#: Sections of the scratch field for one batch, with their sizes: displacements and forces of the nodes, pressure
#: amplitudes, residuals of the pressure equations, derivatives of the volume, tangents at the points; for one node the
#: derivatives of the stress at one point, and the stiffness with all other nodes.
_sizes = (("U", 3 * _LARGEST.nodes), ("FORCE", 3 * _LARGEST.nodes), ("PRESSURE", _LARGEST.modes),
          ("GAP", _LARGEST.modes), ("V", 3 * _LARGEST.modes * _LARGEST.nodes), ("A", 45 * _LARGEST.points),
          ("RATE", 27), ("PAIRS", 9 * _LARGEST.nodes))
_AT = {name: sum(size for _, size in _sizes[:i]) for i, (name, _) in enumerate(_sizes)}
#: First entry of the scratch field that is free for other functions.
SCRATCH = sum(size for _, size in _sizes)


class ElementKernelFunctions(NamedTuple):
    """Taichi functions of a batch of elements; `compute_stiffness_blocks` must follow `integrate_forces`.

    Attributes:
        integrate_forces: computes the nodal forces, and the data of the stiffness if a tangent is requested.
        compute_stiffness_blocks: computes the stiffness of all pairs of nodes from these data.
    """

    integrate_forces: Any
    compute_stiffness_blocks: Any


@cache
def make_element_kernel_functions(element_name: str, energy: KernelEnergy) -> ElementKernelFunctions:
    """Return the Taichi functions of an element type, a key of `SOLID_ELEMENTS`, and a strain energy."""
    ti = get_initialised_taichi()
    element = SOLID_ELEMENTS[element_name]
    nodes, modes, points = element.node_count, element.pressure_modes, element.quadrature[1].size
    s = get_shared_scratch_field(LANES, SCRATCH)
    compute_stress_and_tangent = make_stress_function(energy)
    inverse_cube_root, compute_cofactor = make_inverse_cube_root_function(), make_cofactor_function()
    apply_history = make_history_function(9, 6, make_relaxation_function)
    vec = ti.types.vector(LANES, ti.f64)
    U, FORCE, PRESSURE, GAP = (_AT[name] for name in ("U", "FORCE", "PRESSURE", "GAP"))
    V, A, RATE, PAIRS = (_AT[name] for name in ("V", "A", "RATE", "PAIRS"))

    # `a = a + b` on arrays, because `a += b` is an atomic operation in Taichi and four times slower here. Sums over
    # points are kept in the scratch field, not in variables: with stores in a loop LLVM uses vector instructions.

    @ti.func
    def get_weighted_stress_and_store_tangent(b, q, tangent: ti.template(), remembers, H, J, p, elements: ti.template(),
                                              material: ti.template()):
        """Return dW/dF and dJ/dF of quadrature point q times its weight, and store its tangent in the scratch field."""
        F = [H[m] + ti.static(float(m % 4 == 0)) for m in ti.static(range(9))]
        W, P, T = compute_stress_and_tangent(F, J, inverse_cube_root(ti.max(J, 1e-6)), material.coefficients, tangent)
        cof = compute_cofactor(F)
        if remembers > 0.0:
            apply_history(b, q, [F, cof, J], W, P, T, elements, material)
        w = elements.weights[b * points + q]
        wm, wp = w * elements.moduli[b], w * p
        if ti.static(tangent):
            for n in ti.static(range(45)):
                s[A + 45 * q + n] = wm * T[n]
            for m, n in ti.static(tuple(COFACTOR)):
                at = A + 45 * q + ti.static(PLACE[m][n])
                s[at] = s[at] + ti.static(COFACTOR[m, n][1]) * wp * F[ti.static(COFACTOR[m, n][0])]
        return [wm * P[m] + wp * cof[m] for m in ti.static(range(9))], [w * cof[m] for m in ti.static(range(9))]

    @ti.func
    def integrate_forces(b, kappa, tangent, remembers, x: ti.template(), elements: ti.template(),
                         material: ti.template()):
        """Integrate the nodal forces of a batch, with the eliminated pressure increments; return the smallest J.

        The material history is that of `tissue_sim.fem.history`.
        """
        for a in range(nodes):
            i = b * nodes + a
            for k in ti.static(range(3)):
                s[U + 3 * a + k] = ti.Vector([x[elements.dofs[i][l] + k] for l in ti.static(range(LANES))])
                s[FORCE + 3 * a + k] = vec(0.0)
        for i in range(3 * modes * nodes):
            s[V + i] = vec(0.0)
        bulk = kappa * elements.moduli[b]
        for m in range(modes):
            s[PRESSURE + m] = elements.pressures[b * modes + m]
            s[GAP + m] = -elements.pressures[b * modes + m] / bulk
        least = vec(1e30)
        for q in range(points):
            H = [vec(0.0) for _m in ti.static(range(9))]
            for a in range(nodes):
                g = (b * points + q) * nodes + a
                x0, y0, z0 = elements.gradient_x[g], elements.gradient_y[g], elements.gradient_z[g]
                for k in ti.static(range(3)):
                    u = s[U + 3 * a + k]
                    H[3 * k] = H[3 * k] + u * x0
                    H[3 * k + 1] = H[3 * k + 1] + u * y0
                    H[3 * k + 2] = H[3 * k + 2] + u * z0
            # J - 1 from the displacement gradient, without cancellation, because K/mu multiplies it.
            minors = (H[0] * H[4] - H[1] * H[3] + H[0] * H[8] - H[2] * H[6] + H[4] * H[8] - H[5] * H[7])
            cube = (H[0] * (H[4] * H[8] - H[5] * H[7]) - H[1] * (H[3] * H[8] - H[5] * H[6])
                    + H[2] * (H[3] * H[7] - H[4] * H[6]))
            dilation = H[0] + H[4] + H[8] + minors + cube
            least = ti.min(least, 1.0 + dilation)
            p = vec(0.0)
            for m in range(modes):
                phi = elements.mode_values[(b * points + q) * modes + m]
                p = p + phi * s[PRESSURE + m]
                s[GAP + m] = s[GAP + m] + elements.weights[b * points + q] * phi * dilation
            P, cof = [vec(0.0) for _m in ti.static(range(9))], [vec(0.0) for _m in ti.static(range(9))]
            # Compiled twice, because forces alone take three quarters of the time.
            if tangent > 0.0:
                P1, cof1 = get_weighted_stress_and_store_tangent(b, q, True, remembers, H, 1.0 + dilation, p, elements,
                                                                 material)
                for m in ti.static(range(9)):
                    P[m], cof[m] = P1[m], cof1[m]
            else:
                P1, cof1 = get_weighted_stress_and_store_tangent(b, q, False, remembers, H, 1.0 + dilation, p, elements,
                                                                 material)
                for m in ti.static(range(9)):
                    P[m], cof[m] = P1[m], cof1[m]
            for a in range(nodes):
                g = (b * points + q) * nodes + a
                x0, y0, z0 = elements.gradient_x[g], elements.gradient_y[g], elements.gradient_z[g]
                for k in ti.static(range(3)):
                    at = FORCE + 3 * a + k
                    s[at] = s[at] + P[3 * k] * x0 + P[3 * k + 1] * y0 + P[3 * k + 2] * z0
                    rate = cof[3 * k] * x0 + cof[3 * k + 1] * y0 + cof[3 * k + 2] * z0
                    for m in ti.static(range(modes)):
                        at_rate = V + 3 * (m * nodes + a) + k
                        s[at_rate] = s[at_rate] + elements.mode_values[(b * points + q) * modes + m] * rate
        for i in range(3 * nodes):
            f = s[FORCE + i]
            for m in range(modes):
                f = f + bulk * s[GAP + m] * s[V + 3 * m * nodes + i]
            at = 3 * b * nodes + i
            elements.forces[at] = f
        for i in range(3 * modes * nodes):
            at = 3 * b * modes * nodes + i
            elements.volume_rates[at] = s[V + i]
        for m in range(modes):
            at = b * modes + m
            elements.gaps[at] = s[GAP + m]
        return least.min()

    @ti.func
    def compute_stiffness_blocks(b, kappa, elements: ti.template()):
        """Compute the 3 x 3 stiffness blocks of all pairs of nodes (c, a), a <= c, with eliminated pressures.

        Entry 3 k + i of the nine of a pair is the force on a along i for a displacement of c along k.
        """
        bulk = kappa * elements.moduli[b]
        for c in range(nodes):
            for i in range(9 * (c + 1)):
                s[PAIRS + i] = vec(0.0)
            for q in range(points):
                g_c, t = (b * points + q) * nodes + c, A + 45 * q
                x, y, z = elements.gradient_x[g_c], elements.gradient_y[g_c], elements.gradient_z[g_c]
                for k in ti.static(range(3)):
                    for m in ti.static(range(9)):
                        s[RATE + 9 * k + m] = (s[t + ti.static(PLACE[m][3 * k])] * x
                                               + s[t + ti.static(PLACE[m][3 * k + 1])] * y
                                               + s[t + ti.static(PLACE[m][3 * k + 2])] * z)
                for a in range(c + 1):
                    g = (b * points + q) * nodes + a
                    x0, y0, z0 = elements.gradient_x[g], elements.gradient_y[g], elements.gradient_z[g]
                    for n in ti.static(range(9)):
                        at = PAIRS + 9 * a + n
                        s[at] = s[at] + s[RATE + 3 * n] * x0 + s[RATE + 3 * n + 1] * y0 + s[RATE + 3 * n + 2] * z0
            for m in range(modes):
                for k in ti.static(range(3)):
                    moved = bulk * s[V + 3 * (m * nodes + c) + k]
                    for a in range(c + 1):
                        for i in ti.static(range(3)):
                            at = PAIRS + 9 * a + 3 * k + i
                            s[at] = s[at] + moved * s[V + 3 * (m * nodes + a) + i]
            for i in range(9 * (c + 1)):
                at = 9 * (c * (c + 1) // 2) + i
                elements.stiffness[at] = s[PAIRS + i]

    return ElementKernelFunctions(integrate_forces, compute_stiffness_blocks)
