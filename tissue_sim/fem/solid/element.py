"""Three-dimensional mixed elements as Taichi functions: stress, forces, stiffness, and their assembly.

Each lane of the vectors is one element, as in `tissue_sim.fem.axisymmetric.assembly`. A discontinuous pressure in each
element enforces J - 1 = p / K in the mean; it is an unknown of Newton's method and eliminated element by element (Simo,
Taylor and Pister, CMAME 51 (1985) 177).

Components of the deformation gradient F_iJ and of conjugate quantities are in the order xX, xY, xZ, yX, ... zZ. The
isochoric energy is W(F / J^(1/3)); the pressure adds p (J - 1). Softening scales the isochoric stress; relaxation
scales it and adds the contribution of earlier stresses.
"""

from enum import IntEnum
from functools import cache
from typing import Any, NamedTuple

from tissue_sim.fem.elements.energy import (
    list_lower_triangle_index_pairs,
    make_domain_margin_function,
    make_energy_derivatives_by_invariants,
    make_inverse_cube_root_function,
    make_isochoric_chain_rule,
    make_principal_plane_moduli_function,
    make_stretch_derivatives_function,
)
from tissue_sim.fem.elements.history import make_history_function
from tissue_sim.fem.history import MATERIAL_ARRAYS
from tissue_sim.fem.taichi.array_tables import LANE_INTEGERS, LANE_REALS, ArrayLayout
from tissue_sim.fem.taichi.runtime import (
    LANES,
    CountsInLargestElement,
    get_initialised_taichi,
    get_shared_scratch_field,
)
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.solid import SOLID_ELEMENTS
from tissue_sim.mesh.solid_element import MAX_NODES

#: Row and column of every entry of a symmetric 9 x 9 tangent in packed storage.
PACKED = list_lower_triangle_index_pairs(9)
#: Index of entry (m, n) in packed storage.
PLACE = tuple(tuple(PACKED.index((max(m, n), min(m, n))) for n in range(9)) for m in range(9))
#: Rows and columns of the components of a symmetric tensor.
SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
#: Index of entry (i, k) among these components.
SYMMETRIC_PLACE = tuple(tuple(SYMMETRIC.index((min(i, k), max(i, k))) for k in range(3)) for i in range(3))
#: Number of sweeps of Jacobi rotations that diagonalise a 3 x 3 matrix to rounding.
_SWEEPS = 5
#: Index pairs of a sweep.
_PAIRS = ((0, 1), (0, 2), (1, 2))


def _levi_civita_symbol(i: int, k: int, m: int) -> int:
    """Return the Levi-Civita symbol of three indices from 0 to 2: 1, -1 or 0."""
    return (i - k) * (k - m) * (m - i) // 2


#: Second derivatives of the determinant: entry (m, n) -> (component of F, sign).
COFACTOR = {(m, n): (3 * (3 - m // 3 - n // 3) + 3 - m % 3 - n % 3,
                     float(_levi_civita_symbol(m // 3, n // 3, 3 - m // 3 - n // 3)
                           * _levi_civita_symbol(m % 3, n % 3, 3 - m % 3 - n % 3)))
            for m, n in PACKED if m // 3 != n // 3 and m % 3 != n % 3}


@cache
def make_cofactor_function():
    """Return the Taichi function ``compute_cofactor(F)``: dJ/dF, 9 components."""
    ti = get_initialised_taichi()

    @ti.func
    def compute_cofactor(F):
        """Return dJ/dF, the cofactor matrix of F, 9 components."""
        return [F[4] * F[8] - F[5] * F[7], F[5] * F[6] - F[3] * F[8], F[3] * F[7] - F[4] * F[6],
                F[2] * F[7] - F[1] * F[8], F[0] * F[8] - F[2] * F[6], F[1] * F[6] - F[0] * F[7],
                F[1] * F[5] - F[2] * F[4], F[2] * F[3] - F[0] * F[5], F[0] * F[4] - F[1] * F[3]]

    return compute_cofactor


@cache
def make_relaxation_function():
    """Return the Taichi function ``apply_relaxation(F, cof, J, instant, h, P, A) -> (S, P, A)``."""
    ti = get_initialised_taichi()

    @ti.func
    def apply_relaxation(F, cof, J, instant, h, P, A):
        """Replace the elastic stress F S of this step by that of the hereditary integral, F (instant S + h); return S.

        S and h are isochoric second Piola-Kirchhoff stresses (XX, XY, XZ, YY, YZ, ZZ); see
        `tissue_sim.material.viscoelasticity`.
        """
        S = [(cof[ti.static(I)] * P[ti.static(K)] + cof[ti.static(3 + I)] * P[ti.static(3 + K)]
              + cof[ti.static(6 + I)] * P[ti.static(6 + K)]) / J for I, K in ti.static(SYMMETRIC)]
        pushed = [F[ti.static(m // 3 * 3)] * h[ti.static(SYMMETRIC_PLACE[0][m % 3])]
                  + F[ti.static(m // 3 * 3 + 1)] * h[ti.static(SYMMETRIC_PLACE[1][m % 3])]
                  + F[ti.static(m // 3 * 3 + 2)] * h[ti.static(SYMMETRIC_PLACE[2][m % 3])]
                  for m in ti.static(range(9))]
        tangent = [instant * A[n] for n in ti.static(range(45))]
        for i in ti.static(range(3)):
            for I in ti.static(range(3)):
                for K in ti.static(range(I + 1)):
                    tangent[ti.static(PLACE[3 * i + I][3 * i + K])] += h[ti.static(SYMMETRIC_PLACE[I][K])]
        return S, [instant * P[m] + pushed[m] for m in ti.static(range(9))], tangent

    return apply_relaxation


@cache
def make_stress_function(energy: KernelEnergy):
    """Return the Taichi function of stress and tangent of a strain energy.

    Its signature is ``compute_stress_and_tangent(F, J, root, coefficients, tangent) -> (W, P, A, margin)``.

    Args of the Taichi function:
        F: deformation gradient, 9 components; its determinant J must be positive.
        root: J^(-1/3).
        coefficients: array of the energy's coefficients.
        tangent: True or False, known when the kernel is compiled; A is zero without it.

    Returns of the Taichi function:
        W: isochoric energy density; P (9): first Piola-Kirchhoff stress; A (45): tangent dP/dF, symmetric, packed as
        `PACKED`; margin: positive inside the domain of the law.
    """
    return (_make_stress_function_by_invariants if energy.family == "invariants"
            else _make_stress_function_by_stretches)(energy)


def _make_stress_function_by_invariants(energy: KernelEnergy):
    """Return the function of `make_stress_function` for an energy of the invariants I1 and I2."""
    ti = get_initialised_taichi()
    count, values = energy.coefficient_count, 6 + len(energy.domain_conditions)

    derivatives, compute_margin = make_energy_derivatives_by_invariants(energy), make_domain_margin_function()
    chain = make_isochoric_chain_rule("I1", "I2", "J", "I1 I2 J")
    compute_cofactor = make_cofactor_function()

    @ti.func
    def compute_stress_and_tangent(F, J, root, coefficients: ti.template(), tangent: ti.template()):
        """Return energy density W, stress P, tangent A and margin; see `make_stress_function`."""
        scale = root * root
        # F^T F and F F^T.
        right = [[F[i] * F[k] + F[3 + i] * F[3 + k] + F[6 + i] * F[6 + k] for k in ti.static(range(3))]
                 for i in ti.static(range(3))]
        left = [[F[3 * i] * F[3 * k] + F[3 * i + 1] * F[3 * k + 1] + F[3 * i + 2] * F[3 * k + 2]
                 for k in ti.static(range(3))] for i in ti.static(range(3))]
        I1 = right[0][0] + right[1][1] + right[2][2]
        cof = compute_cofactor(F)
        I2 = cof[0] * cof[0]
        for n in ti.static(range(1, 9)):
            I2 += cof[n] * cof[n]
        w = [v + 0.0 * J for v in ti.static(derivatives(I1 * scale, I2 * scale * scale,
                                                        [coefficients[i] for i in range(count)]))]
        d = [v + 0.0 * J for v in ti.static(chain(I1, I2, J, scale, w[1], w[2], w[3], w[4], w[5]))]
        # Derivatives of I1, I2 and J with respect to F; the tangent contains their products.
        first = [2.0 * F[m] for m in ti.static(range(9))]
        second = [2.0 * (I1 * F[m] - F[ti.static(m // 3 * 3)] * right[0][ti.static(m % 3)]
                         - F[ti.static(m // 3 * 3 + 1)] * right[1][ti.static(m % 3)]
                         - F[ti.static(m // 3 * 3 + 2)] * right[2][ti.static(m % 3)]) for m in ti.static(range(9))]
        P = [d[0] * first[m] + d[1] * second[m] + d[2] * cof[m] for m in ti.static(range(9))]
        x = [d[3] * first[m] + d[4] * second[m] + d[6] * cof[m] for m in ti.static(range(9))]
        y = [d[4] * first[m] + d[5] * second[m] + d[7] * cof[m] for m in ti.static(range(9))]
        z = [d[6] * first[m] + d[7] * second[m] + d[8] * cof[m] for m in ti.static(range(9))]
        A = [0.0 * J for _n in ti.static(range(45))]
        for m, n in ti.static(PACKED if tangent else ()):
            i, I, k, K = ti.static(m // 3, m % 3, n // 3, n % 3)
            a = x[m] * first[n] + y[m] * second[n] + z[m] * cof[n] + d[1] * (
                4.0 * F[m] * F[n] - 2.0 * F[ti.static(3 * i + K)] * F[ti.static(3 * k + I)])
            if ti.static(i == k):
                a -= 2.0 * d[1] * right[I][K]
            if ti.static(I == K):
                a -= 2.0 * d[1] * left[i][k]
            if ti.static(m == n):
                a += 2.0 * (d[0] + d[1] * I1)
            if ti.static((m, n) in COFACTOR):
                a += ti.static(COFACTOR[m, n][1] if (m, n) in COFACTOR else 0.0) * d[2] * F[
                    ti.static(COFACTOR[m, n][0] if (m, n) in COFACTOR else 0)]
            A[ti.static(PLACE[m][n])] = a
        return w[0], P, A, compute_margin([w[n] for n in ti.static(range(6, values))], J)

    return compute_stress_and_tangent


def _make_stress_function_by_stretches(energy: KernelEnergy):
    """Return the function of `make_stress_function` for an energy of the principal stretches."""
    ti = get_initialised_taichi()
    compute_stretch_derivatives = make_stretch_derivatives_function(energy)
    compute_principal_plane_moduli = make_principal_plane_moduli_function()

    @ti.func
    def compute_stress_and_tangent(F, J, root, coefficients: ti.template(), tangent: ti.template()):
        """Return energy density W, stress P, tangent A and margin; see `make_stress_function`."""
        # Jacobi rotations diagonalise F^T F; V contains its directions, and F V has orthogonal columns.
        zero = 0.0 * J
        C = [[F[i] * F[k] + F[3 + i] * F[3 + k] + F[6 + i] * F[6 + k] for k in ti.static(range(3))]
             for i in ti.static(range(3))]
        V = [[zero + ti.static(float(i == k)) for k in ti.static(range(3))] for i in ti.static(range(3))]
        for _sweep in range(_SWEEPS):
            for p, q in ti.static(_PAIRS):
                o = ti.static(3 - p - q)
                apart = 0.5 * (C[q][q] - C[p][p])
                reach = ti.abs(apart) + ti.sqrt(apart * apart + C[p][q] * C[p][q])
                turn = ti.select(reach > 1e-150, C[p][q] / ti.max(reach, 1e-150), zero)
                t = ti.select(apart < 0.0, -turn, turn)
                c = 1.0 / ti.sqrt(1.0 + t * t)
                s = t * c
                off, at_p, at_q = C[p][q], C[o][p], C[o][q]
                C[p][p] = C[p][p] - t * off
                C[q][q] = C[q][q] + t * off
                C[p][q], C[q][p] = zero, zero
                C[o][p] = c * at_p - s * at_q
                C[p][o] = C[o][p]
                C[o][q] = s * at_p + c * at_q
                C[q][o] = C[o][q]
                for i in ti.static(range(3)):
                    v, w = V[i][p], V[i][q]
                    V[i][p] = c * v - s * w
                    V[i][q] = s * v + c * w
        # Principal stretches and spatial directions from the columns of F V.
        U = [[F[3 * i] * V[0][k] + F[3 * i + 1] * V[1][k] + F[3 * i + 2] * V[2][k] for k in ti.static(range(3))]
             for i in ti.static(range(3))]
        stretch = [ti.sqrt(U[0][k] * U[0][k] + U[1][k] * U[1][k] + U[2][k] * U[2][k]) for k in ti.static(range(3))]
        for i in ti.static(range(3)):
            for k in ti.static(range(3)):
                U[i][k] = U[i][k] / stretch[k]
        density, w1, w2, margin = compute_stretch_derivatives(stretch, root, coefficients)
        # Dyads of spatial and material principal directions.
        N = [[U[ti.static(m // 3)][k] * V[ti.static(m % 3)][k] for m in ti.static(range(9))]
             for k in ti.static(range(3))]
        P = [w1[0] * N[0][m] + w1[1] * N[1][m] + w1[2] * N[2][m] for m in ti.static(range(9))]
        Q = [[w2[k][0] * N[0][m] + w2[k][1] * N[1][m] + w2[k][2] * N[2][m] for m in ti.static(range(9))]
             for k in ti.static(range(3))]
        A = [zero for _n in ti.static(range(45))]
        for m, n in ti.static(PACKED if tangent else ()):
            A[ti.static(PLACE[m][n])] = N[0][m] * Q[0][n] + N[1][m] * Q[1][n] + N[2][m] * Q[2][n]
        for p, q in ti.static(_PAIRS if tangent else ()):
            # Contributions of rotation and shear of a pair of principal directions.
            twist, flip = compute_principal_plane_moduli(p, q, stretch, w1, w2)
            one = [U[ti.static(m // 3)][p] * V[ti.static(m % 3)][q] for m in ti.static(range(9))]
            other = [U[ti.static(m // 3)][q] * V[ti.static(m % 3)][p] for m in ti.static(range(9))]
            # 1/2 twist (one - other)(one - other) + 1/2 flip (one + other)(one + other)
            same, cross = 0.5 * (flip + twist), 0.5 * (flip - twist)
            along = [same * one[m] + cross * other[m] for m in ti.static(range(9))]
            across = [cross * one[m] + same * other[m] for m in ti.static(range(9))]
            for m, n in ti.static(PACKED):
                A[ti.static(PLACE[m][n])] += along[m] * one[n] + across[m] * other[n]
        return density, P, A, margin

    return compute_stress_and_tangent


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
    vec, is_limited = ti.types.vector(LANES, ti.f64), bool(energy.domain_conditions)
    U, FORCE, PRESSURE, GAP = (_AT[name] for name in ("U", "FORCE", "PRESSURE", "GAP"))
    V, A, RATE, PAIRS = (_AT[name] for name in ("V", "A", "RATE", "PAIRS"))

    # `a = a + b` on arrays, because `a += b` is an atomic operation in Taichi and four times slower here. Sums over
    # points are kept in the scratch field, not in variables: with stores in a loop LLVM uses vector instructions.

    @ti.func
    def get_weighted_stress_and_store_tangent(b, q, tangent: ti.template(), remembers, H, J, p, elements: ti.template(),
                                              material: ti.template()):
        """Return dW/dF and dJ/dF of point q times its weight, and the margin of the domain; store the tangent."""
        F = [H[m] + ti.static(float(m % 4 == 0)) for m in ti.static(range(9))]
        W, P, T, margin = compute_stress_and_tangent(F, J, inverse_cube_root(ti.max(J, 1e-6)), material.coefficients,
                                                     tangent)
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
        return ([wm * P[m] + wp * cof[m] for m in ti.static(range(9))], [w * cof[m] for m in ti.static(range(9))],
                margin)

    @ti.func
    def integrate_forces(b, kappa, tangent, remembers, x: ti.template(), elements: ti.template(),
                         material: ti.template()):
        """Integrate the nodal forces of a batch, with the eliminated pressure increments.

        Return the smallest J, or the smallest margin of the domain of the law if it is smaller. The material history
        is that of `tissue_sim.fem.history`.
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
                P1, cof1, margin = get_weighted_stress_and_store_tangent(b, q, True, remembers, H, 1.0 + dilation, p,
                                                                         elements, material)
                if ti.static(is_limited):
                    least = ti.min(least, margin)
                for m in ti.static(range(9)):
                    P[m], cof[m] = P1[m], cof1[m]
            else:
                P1, cof1, margin = get_weighted_stress_and_store_tangent(b, q, False, remembers, H, 1.0 + dilation, p,
                                                                         elements, material)
                if ti.static(is_limited):
                    least = ti.min(least, margin)
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


@cache
def make_assembly_kernel(element_name: str, energy: KernelEnergy):
    """Return the kernel that assembles the nodal forces, and the tangent if the array `settings` requests it.

    The kernel adds the forces, N, to the array ``residual`` and the stiffness, N/m, to ``data``, and writes to
    ``least[0]`` the smallest volume ratio J of all quadrature points, or the smallest margin of the domain of the law
    if it is smaller. ``batches[0]`` is the number of batches. The columns of ``settings`` are `AssemblySettingColumn`.

    Args:
        element_name: a key of `SOLID_ELEMENTS`.
        energy: strain energy of the material.
    """
    ti = get_initialised_taichi()
    nodes = SOLID_ELEMENTS[element_name].node_count
    pairs = nodes * (nodes + 1) // 2
    integrate_forces, compute_stiffness_blocks = make_element_kernel_functions(element_name, energy)
    real1, int1 = ti.types.ndarray(ti.f64, ndim=1), ti.types.ndarray(ti.i32, ndim=1)

    @ti.kernel
    def assemble_forces_and_tangent(settings: real1, least: real1, batches: int1, x: real1, residual: real1,
                                    data: real1, element_table: int1, material_table: int1):
        """Assemble the nodal forces of all batches, and the stiffness if requested; see `make_assembly_kernel`."""
        # One pass of one serial task, started without waking a thread pool.
        ti.loop_config(serialize=True)
        for _ in range(1):
            elements, material = ELEMENT_ARRAYS.open_table(element_table), MATERIAL_ARRAYS.open_table(material_table)
            kappa, tangent = settings[AssemblySettingColumn.KAPPA], settings[AssemblySettingColumn.TANGENT]
            remembers = settings[AssemblySettingColumn.REMEMBERS]
            if settings[AssemblySettingColumn.ADDS] == 0.0:
                for i in range(residual.shape[0]):
                    residual[i] = 0.0
            if tangent > 0.0 and settings[AssemblySettingColumn.ADDS] == 0.0:
                for i in range(data.shape[0]):
                    data[i] = 0.0
            least[0] = 1e30
            for b in range(batches[0]):
                smallest = integrate_forces(b, kappa, tangent, remembers, x, elements, material)
                least[0] = ti.min(least[0], smallest)
                for i in range(3 * nodes):
                    f, at = elements.forces[3 * b * nodes + i], elements.equations[3 * b * nodes + i]
                    for l in ti.static(range(LANES)):
                        residual[at[l]] = residual[at[l]] + f[l]
                if tangent > 0.0:
                    compute_stiffness_blocks(b, kappa, elements)
                    for i in range(9 * pairs):
                        place = b * 9 * pairs + i
                        at, mirror = elements.places[place], elements.mirrored[place]
                        stiffness = elements.stiffness[i]
                        for l in ti.static(range(LANES)):
                            data[at[l]] = data[at[l]] + stiffness[l]
                            data[mirror[l]] = data[mirror[l]] + stiffness[l]

    return assemble_forces_and_tangent
