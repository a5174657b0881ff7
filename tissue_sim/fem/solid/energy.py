"""Stress and tangent of a strain-energy law in three dimensions, as Taichi functions.

Components of the deformation gradient F_iJ and of conjugate quantities are in the order xX, xY, xZ, yX, ... zZ. The
isochoric energy is W(F / J^(1/3)); the pressure adds p (J - 1). Softening scales the isochoric stress; relaxation
scales it and adds the contribution of earlier stresses.

Every function works on vectors, one point in each lane.
"""

from functools import cache

from tissue_sim.fem.elements.energy import (
    list_lower_triangle_index_pairs,
    make_energy_derivatives_by_invariants,
    make_isochoric_chain_rule,
    make_principal_plane_moduli_function,
    make_stretch_derivatives_function,
)
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.laws import KernelEnergy

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

    Its signature is ``compute_stress_and_tangent(F, J, root, coefficients, tangent) -> (W, P, A)``.

    Args of the Taichi function:
        F: deformation gradient, 9 components; its determinant J must be positive.
        root: J^(-1/3).
        coefficients: array of the energy's coefficients.
        tangent: True or False, known when the kernel is compiled; A is zero without it.

    Returns of the Taichi function:
        W: isochoric energy density; P (9): first Piola-Kirchhoff stress; A (45): tangent dP/dF, symmetric, packed as
        `PACKED`.
    """
    return (_make_stress_function_by_invariants if energy.family == "invariants"
            else _make_stress_function_by_stretches)(energy)


def _make_stress_function_by_invariants(energy: KernelEnergy):
    """Return the function of `make_stress_function` for an energy of the invariants I1 and I2."""
    ti = get_initialised_taichi()
    count = energy.coefficient_count

    derivatives = make_energy_derivatives_by_invariants(energy)
    chain = make_isochoric_chain_rule("I1", "I2", "J", "I1 I2 J")
    compute_cofactor = make_cofactor_function()

    @ti.func
    def compute_stress_and_tangent(F, J, root, coefficients: ti.template(), tangent: ti.template()):
        """Return energy density W, stress P and tangent A; see `make_stress_function`."""
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
        return w[0], P, A

    return compute_stress_and_tangent


def _make_stress_function_by_stretches(energy: KernelEnergy):
    """Return the function of `make_stress_function` for an energy of the principal stretches."""
    ti = get_initialised_taichi()
    compute_stretch_derivatives = make_stretch_derivatives_function(energy)
    compute_principal_plane_moduli = make_principal_plane_moduli_function()

    @ti.func
    def compute_stress_and_tangent(F, J, root, coefficients: ti.template(), tangent: ti.template()):
        """Return energy density W, stress P and tangent A; see `make_stress_function`."""
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
        density, w1, w2 = compute_stretch_derivatives(stretch, root, coefficients)
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
        return density, P, A

    return compute_stress_and_tangent
