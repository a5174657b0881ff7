"""Stress and tangent of hyperelastic laws in the axisymmetric solid, as Taichi functions.

The order of the components of the deformation gradient F and of the first Piola stress is rR, rZ, zR, zZ, hoop. The
isochoric energy is W(F / J^(1/3)); the pressure adds p (J - 1). Memory acts on the isochoric part: softening multiplies
the stress, relaxation multiplies the stress and adds the inherited stress (hereditary integral).

Every function works on lists of numbers (one point) and on lists of vectors (several points at once).
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

#: Row and column of each entry of the packed symmetric 5 x 5 tangent.
PACKED = list_lower_triangle_index_pairs(5)
#: Second derivatives of the in-plane determinant: (F_zZ, F_rR) and (F_zR, F_rZ).
COFACTOR_SIGNS = {(3, 0): 1.0, (2, 1): -1.0}


#: Index of entry (i, k) in the packed tangent.
PLACE = tuple(tuple(PACKED.index((max(i, k), min(i, k))) for k in range(5)) for i in range(5))


@cache
def make_pressure_term_function():
    """Return the Taichi function ``add_pressure_terms(F, p, P, A) -> (P, A)``: P + p dJ/dF and A + p d2J/dF2."""
    ti = get_initialised_taichi()

    @ti.func
    def add_pressure_terms(F, p, P, A):
        """Return stress P + p dJ/dF and tangent A + p d2J/dF2 for the pressure p."""
        c = F[4]
        cofactor = [F[3], -F[2], -F[1], F[0]]
        stress = [P[i] + 0.0 * c for i in ti.static(range(5))]
        tangent = [A[n] + 0.0 * c for n in ti.static(range(15))]
        for i in ti.static(range(4)):
            stress[i] += p * c * cofactor[i]
            tangent[ti.static(PLACE[4][i])] += p * cofactor[i]
        stress[4] += p * (F[0] * F[3] - F[1] * F[2])
        for place, sign in ti.static(tuple(COFACTOR_SIGNS.items())):
            tangent[ti.static(PLACE[place[0]][place[1]])] += sign * p * c
        return stress, tangent

    return add_pressure_terms


@cache
def make_relaxation_function():
    """Return the Taichi function of the hereditary integral.

    Its form is ``compute_relaxed_stress_and_tangent(F, instant, h, P, A) -> (S, P, A)``.
    """
    ti = get_initialised_taichi()

    @ti.func
    def compute_relaxed_stress_and_tangent(F, instant, h, P, A):
        """Replace the instantaneous stress P = F S by F (instant S + h), and the tangent likewise; return S as well.

        S is the instantaneous and h the inherited isochoric second Piola stress (RR, RZ, ZZ, hoop); see
        `tissue_sim.material.viscoelasticity`.
        """
        j = F[0] * F[3] - F[1] * F[2]
        S = [(F[3] * P[0] - F[1] * P[2]) / j, (F[3] * P[1] - F[1] * P[3]) / j, (F[0] * P[3] - F[2] * P[1]) / j,
             P[4] / F[4]]
        pushed = [F[0] * h[0] + F[1] * h[1], F[0] * h[1] + F[1] * h[2], F[2] * h[0] + F[3] * h[1],
                  F[2] * h[1] + F[3] * h[2], F[4] * h[3]]
        tangent = [instant * A[n] for n in ti.static(range(15))]
        for i in ti.static(range(2)):
            tangent[ti.static(PLACE[2 * i][2 * i])] += h[0]
            tangent[ti.static(PLACE[2 * i + 1][2 * i])] += h[1]
            tangent[ti.static(PLACE[2 * i + 1][2 * i + 1])] += h[2]
        tangent[ti.static(PLACE[4][4])] += h[3]
        return S, [instant * P[i] + pushed[i] for i in ti.static(range(5))], tangent

    return compute_relaxed_stress_and_tangent


@cache
def make_stress_function(energy: KernelEnergy, tangents: bool = True):
    """Return the Taichi function ``compute_stress_and_tangent(F, root, coefficients) -> (W, P, A)`` of an energy.

    The Taichi function takes the deformation gradient F (5 components, positive determinant), root = J^(-1/3), and the
    array of the energy's coefficients. It returns the isochoric energy density W, the first Piola stress P = dW/dF (5
    components) and its derivative A (15 components, packed as `PACKED`), in units of the coefficients.

    Args:
        energy: energy of a law.
        tangents: whether A is computed; otherwise A is zero.
    """
    if energy.family == "invariants":
        return _make_stress_function_of_invariants(energy, tangents)
    return _make_stress_function_of_stretches(energy, tangents)


def _make_stress_function_of_invariants(energy: KernelEnergy, tangents: bool):
    """Return `compute_stress_and_tangent` of an energy that depends on the isochoric invariants."""
    ti = get_initialised_taichi()
    count = energy.coefficient_count

    derivatives = make_energy_derivatives_by_invariants(energy, tangents)
    # In axisymmetry the invariants are functions of a, the sum of squares of the in-plane deformation gradient, j, its
    # determinant, and c, the hoop stretch.
    chain = make_isochoric_chain_rule("a + c**2", "j**2 + a*c**2", "j*c", "a j c", tangents)

    @ti.func
    def compute_stress_and_tangent(F, root, coefficients: ti.template()):
        a = F[0] * F[0] + F[1] * F[1] + F[2] * F[2] + F[3] * F[3]
        j = F[0] * F[3] - F[1] * F[2]
        c = F[4]
        scale = root * root
        first = (a + c * c) * scale
        second = (j * j + a * c * c) * scale * scale
        w = [v + 0.0 * c for v in ti.static(derivatives(first, second, [coefficients[i] for i in range(count)]))]
        d = [v + 0.0 * c for v in ti.static(chain(a, j, c, scale, w[1], w[2], w[3], w[4], w[5]))]
        # dW/dF = d_a 2F + d_j cof F + d_c e, and the same vectors span the second derivative.
        twice = [2.0 * F[i] for i in ti.static(range(4))]
        cofactor = [F[3], -F[2], -F[1], F[0]]
        P = [d[0] * twice[0] + d[1] * cofactor[0], d[0] * twice[1] + d[1] * cofactor[1],
             d[0] * twice[2] + d[1] * cofactor[2], d[0] * twice[3] + d[1] * cofactor[3], 1.0 * d[2]]
        A = [0.0 * c for _n in ti.static(range(15))]
        if ti.static(tangents):
            for i in ti.static(range(4)):
                for k in ti.static(range(i + 1)):
                    A[ti.static(PLACE[i][k])] = (
                        d[3] * twice[i] * twice[k] + d[4] * (twice[i] * cofactor[k] + cofactor[i] * twice[k])
                        + d[5] * cofactor[i] * cofactor[k] + ti.static(COFACTOR_SIGNS.get((i, k), 0.0)) * d[1])
                A[ti.static(PLACE[i][i])] += 2.0 * d[0]
                A[ti.static(PLACE[4][i])] = d[6] * twice[i] + d[7] * cofactor[i]
            A[ti.static(PLACE[4][4])] = d[8]
        return w[0], P, A

    return compute_stress_and_tangent


def _make_stress_function_of_stretches(energy: KernelEnergy, tangents: bool):
    """Return `compute_stress_and_tangent` of an energy that is a sum over the isochoric principal stretches."""
    ti = get_initialised_taichi()
    compute_stretch_derivatives = make_stretch_derivatives_function(energy)
    compute_principal_plane_moduli = make_principal_plane_moduli_function()

    @ti.func
    def compute_stress_and_tangent(F, root, coefficients: ti.template()):
        # Singular value decomposition of the in-plane part; all expressions have a limit for equal stretches. The
        # singular vectors are rotated by half the sum and half the difference of the angles of (e, h) and (f, g); only
        # their products are needed, without trigonometric functions.
        e, h = 0.5 * (F[0] + F[3]), 0.5 * (F[2] - F[1])
        f, g = 0.5 * (F[0] - F[3]), 0.5 * (F[2] + F[1])
        q, r = ti.sqrt(e * e + h * h), ti.sqrt(f * f + g * g)
        turned, least = r > 1e-300, ti.max(r, 1e-300)
        cs, ss = e / q, h / q
        cd, sd = ti.select(turned, f / least, 0.0 * r + 1.0), ti.select(turned, g / least, 0.0 * r)
        s = [q + r, q - r, F[4]]
        density, w1, w2 = compute_stretch_derivatives(s, root, coefficients)
        # Directions of the in-plane stretches, as 4-vectors rR, rZ, zR, zZ.
        n1 = [0.5 * (cs + cd), 0.5 * (sd - ss), 0.5 * (sd + ss), 0.5 * (cs - cd)]
        n2 = [0.5 * (cs - cd), -0.5 * (sd + ss), -0.5 * (sd - ss), 0.5 * (cs + cd)]
        P = [w1[0] * n1[0] + w1[1] * n2[0], w1[0] * n1[1] + w1[1] * n2[1], w1[0] * n1[2] + w1[1] * n2[2],
             w1[0] * n1[3] + w1[1] * n2[3], 1.0 * w1[2]]
        A = [0.0 * q for _n in ti.static(range(15))]
        if ti.static(tangents):
            twist, flip = compute_principal_plane_moduli(0, 1, s, w1, w2)
            # Directions of in-plane rotation and of in-plane shear of the principal axes.
            turn, shear = [ss, cs, -cs, ss], [-sd, cd, cd, sd]
            for i in ti.static(range(4)):
                for k in ti.static(range(i + 1)):
                    A[ti.static(PLACE[i][k])] = (
                        w2[0][0] * n1[i] * n1[k] + w2[1][1] * n2[i] * n2[k]
                        + w2[0][1] * (n1[i] * n2[k] + n2[i] * n1[k])
                        + 0.5 * twist * turn[i] * turn[k] + 0.5 * flip * shear[i] * shear[k])
                A[ti.static(PLACE[4][i])] = w2[2][0] * n1[i] + w2[2][1] * n2[i]
            A[ti.static(PLACE[4][4])] = w2[2][2]
        return density, P, A

    return compute_stress_and_tangent
