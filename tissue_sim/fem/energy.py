"""Stress and tangent of a law at one point of the axisymmetric solid, as a Taichi function.

Components of a deformation gradient, and of everything conjugate to it, stand in the order rR, rZ, zR, zZ, and hoop.
The isochoric energy is W(F / J^(1/3)); the pressure adds p (J - 1). What happens to the tissue in time acts on the
isochoric part: softening scales it, relaxation scales it and adds what is left of earlier stresses.
"""

from functools import cache

import sympy as sp

from tissue_sim.fem.runtime import initialise
from tissue_sim.laws import KernelEnergy

#: Packed symmetric 5 x 5: row and column of every entry of the tangent.
PACKED = tuple((i, j) for i in range(5) for j in range(i + 1))
#: Second derivatives of the in-plane determinant: F_rR with F_zZ, F_rZ with F_zR.
COFACTOR_PAIRS = ((0, 3, 1.0), (1, 2, -1.0))


def packed(i: int, j: int) -> int:
    return max(i, j) * (max(i, j) + 1) // 2 + min(i, j)


@cache
def _isochoric_chain(tangents: bool):
    """Python function of (a, j, c, s, W1, W2, W11, W12, W22) -> gradient and Hessian of the isochoric energy.

    In axisymmetry every invariant is a function of three scalars: a, the sum of squares of the in-plane deformation
    gradient; j, its determinant; c, the hoop stretch: I1 = a + c^2, I2 = j^2 + a c^2, J = j c. The derivatives are
    those with respect to a, j and c; s = J^(-2/3) comes in ready, so that no other power is taken.
    """
    a, j, c = v = sp.symbols("a j c", positive=True)
    s = sp.Symbol("s", positive=True)
    first = sp.symbols("W1 W2", real=True)
    second = sp.symbols("W11 W12 W22", real=True)
    hessian = sp.Matrix(2, 2, [second[0], second[1], second[1], second[2]])

    def total(expression, x):
        """Derivative with respect to x, s included."""
        inner = 0 if x is a else -sp.Rational(2, 3) * s / x
        return sp.diff(expression, x) + sp.diff(expression, s) * inner

    bars = (s * (a + c**2), s**2 * (j**2 + a * c**2))
    slopes = [[total(bar, x) for x in v] for bar in bars]
    gradient = [sum(first[m] * slopes[m][i] for m in range(2)) for i in range(3)]
    curvature = [sum(first[m] * total(slopes[m][i], v[k]) for m in range(2))
                 + sum(hessian[m, n] * slopes[m][i] * slopes[n][k] for m in range(2) for n in range(2))
                 for i in range(3) for k in range(i + 1)]
    return _taichi_expression((*v, s, *first, *second), [*gradient, *curvature] if tangents else gradient)


def _taichi_expression(arguments, expressions):
    """A Python function that builds these expressions out of Taichi variables when a kernel is compiled."""
    ti = initialise()
    names = {name: getattr(ti, name) for name in ("exp", "log", "sqrt", "sin", "cos", "tan", "tanh")}
    return sp.lambdify(arguments, expressions, modules=[names], cse=True)


@cache
def volume_function():
    """Taichi function ``add_volume(F, p, P, A)``: add p dJ/dF to P and p d2J/dF2 to A."""
    ti = initialise()

    @ti.func
    def add_volume(F, p, P: ti.template(), A: ti.template()):
        c = F[4]
        cof = ti.Vector([F[3], -F[2], -F[1], F[0]])
        j = F[0] * F[3] - F[1] * F[2]
        for i in ti.static(range(4)):
            P[i] += p * c * cof[i]
            A[ti.static(packed(4, i))] += p * cof[i]
        P[4] += p * j
        for i, k, sign in ti.static(COFACTOR_PAIRS):
            A[ti.static(packed(i, k))] += sign * p * c

    return add_volume


@cache
def history_functions():
    """Taichi functions ``soften`` and ``relax``, which change an isochoric stress and its tangent in place."""
    ti = initialise()

    @ti.func
    def soften(W, largest, loss, modulus, share, P: ti.template(), A: ti.template()):
        """Multiply the stress by eta = 1 - loss tanh((largest - W) / (modulus + share largest)) where the point was
        loaded higher before (Dorfmann and Ogden, IJSS 40 (2003) 2699)."""
        if W < largest:
            width = modulus + share * largest
            bend = ti.tanh((largest - W) / width)
            eta, slope = 1.0 - loss * bend, loss * (1.0 - bend * bend) / width
            for i in ti.static(range(5)):
                for k in ti.static(range(i + 1)):
                    A[ti.static(packed(i, k))] = eta * A[ti.static(packed(i, k))] + slope * P[i] * P[k]
            P *= eta

    @ti.func
    def relax(F, instant, inherited, P: ti.template(), A: ti.template()):
        """Make the stress F S of this step that of the hereditary integral, F (instant S + inherited), and return S.

        S is the isochoric second Piola stress (RR, RZ, ZZ, hoop); see `tissue_sim.viscoelasticity`.
        """
        j = F[0] * F[3] - F[1] * F[2]
        S = ti.Vector([(F[3] * P[0] - F[1] * P[2]) / j, (F[3] * P[1] - F[1] * P[3]) / j,
                       (F[0] * P[3] - F[2] * P[1]) / j, P[4] / F[4]])
        h = inherited
        P *= instant
        A *= instant
        for i in ti.static(range(2)):
            P[2 * i] += F[2 * i] * h[0] + F[2 * i + 1] * h[1]
            P[2 * i + 1] += F[2 * i] * h[1] + F[2 * i + 1] * h[2]
            A[ti.static(packed(2 * i, 2 * i))] += h[0]
            A[ti.static(packed(2 * i + 1, 2 * i))] += h[1]
            A[ti.static(packed(2 * i + 1, 2 * i + 1))] += h[2]
        P[4] += F[4] * h[3]
        A[ti.static(packed(4, 4))] += h[3]
        return S

    return soften, relax


@cache
def function(energy: KernelEnergy, tangents: bool = True):
    """Taichi function ``stress_and_tangent(F, coefficients) -> (W, P, A)`` for one kernel energy; A is zero without
    `tangents`.

    Args of the Taichi function:
        F: deformation gradient, 5 components; its determinant must be positive.
        coefficients: array of the energy's coefficients.

    Returns of the Taichi function:
        W: isochoric energy density; P (5): its first Piola stress; A (15): the derivative of that, symmetric, packed
        as `PACKED`.
    """
    ti = initialise()
    count = len(energy.coefficients)

    if energy.family == "invariants":
        W, (I1, I2) = energy.energy, energy.variables
        derivatives = _taichi_expression(
            (I1, I2, energy.coefficients),
            [W, sp.diff(W, I1), sp.diff(W, I2),
             *([sp.diff(W, I1, 2), sp.diff(W, I1, I2), sp.diff(W, I2, 2)] if tangents else [sp.Integer(0)] * 3)])
        chain = _isochoric_chain(tangents)

        @ti.func
        def stress_and_tangent(F, coefficients: ti.template()):
            a = F[0] * F[0] + F[1] * F[1] + F[2] * F[2] + F[3] * F[3]
            j = F[0] * F[3] - F[1] * F[2]
            c = F[4]
            scale = ti.pow(j * c, -2.0 / 3.0)
            I1 = (a + c * c) * scale
            I2 = (j * j + a * c * c) * scale * scale
            w = ti.Vector(ti.static(derivatives(I1, I2, [coefficients[i] for i in range(count)])))
            d = ti.Vector(ti.static(chain(a, j, c, scale, w[1], w[2], w[3], w[4], w[5])))
            density = w[0]
            # dW/dF = d_a 2F + d_j cof F + d_c e, and the same vectors span the second derivative.
            twice = ti.Vector([2.0 * F[0], 2.0 * F[1], 2.0 * F[2], 2.0 * F[3]])
            cof = ti.Vector([F[3], -F[2], -F[1], F[0]])
            P = ti.Vector.zero(ti.f64, 5)
            A = ti.Vector.zero(ti.f64, 15)
            for i in ti.static(range(4)):
                P[i] = d[0] * twice[i] + d[1] * cof[i]
            P[4] = d[2]
            if ti.static(tangents):
                for i in ti.static(range(4)):
                    for k in ti.static(range(i + 1)):
                        A[ti.static(packed(i, k))] = (
                            d[3] * twice[i] * twice[k] + d[4] * (twice[i] * cof[k] + cof[i] * twice[k])
                            + d[5] * cof[i] * cof[k])
                    A[ti.static(packed(i, i))] += 2.0 * d[0]
                    A[ti.static(packed(4, i))] = d[6] * twice[i] + d[7] * cof[i]
                A[ti.static(packed(4, 4))] = d[8]
                for i, k, sign in ti.static(COFACTOR_PAIRS):
                    A[ti.static(packed(i, k))] += sign * d[1]
            return density, P, A

        return stress_and_tangent

    W, (stretch,) = energy.energy, energy.variables
    derivatives = _taichi_expression((stretch, energy.coefficients), [sp.diff(W, stretch), sp.diff(W, stretch, 2), W])

    @ti.func
    def stress_and_tangent(F, coefficients: ti.template()):
        # Singular values and vectors of the in-plane part, well defined in the limit of equal stretches.
        e, h = 0.5 * (F[0] + F[3]), 0.5 * (F[2] - F[1])
        f, g = 0.5 * (F[0] - F[3]), 0.5 * (F[2] + F[1])
        q, r = ti.sqrt(e * e + h * h), ti.sqrt(f * f + g * g)
        sum_angle, difference_angle = ti.atan2(h, e), ti.atan2(g, f)
        left, right = 0.5 * (difference_angle + sum_angle), 0.5 * (difference_angle - sum_angle)
        cl, sl, cr, sr = ti.cos(left), ti.sin(left), ti.cos(right), ti.sin(right)
        s = ti.Vector([q + r, q - r, F[4]])
        scale = ti.pow(s[0] * s[1] * s[2], -1.0 / 3.0)
        # First and second derivatives with respect to the logarithm of each isochoric stretch.
        density = 0.0
        t = ti.Vector.zero(ti.f64, 3)
        u = ti.Vector.zero(ti.f64, 3)
        for i in range(3):
            bar = s[i] * scale
            w = ti.Vector(ti.static(derivatives(bar, [coefficients[m] for m in range(count)])))
            density += w[2]
            t[i] = w[0] * bar
            u[i] = w[1] * bar * bar + w[0] * bar
        mean_t, mean_u = t.sum() / 3.0, u.sum() / 3.0
        t -= mean_t
        # First and second derivatives with respect to the stretches themselves.
        w1 = t / s
        # Directions of the in-plane stretches, as 4-vectors rR, rZ, zR, zZ.
        n1 = ti.Vector([cl * cr, cl * sr, sl * cr, sl * sr])
        n2 = ti.Vector([sl * sr, -sl * cr, -cl * sr, cl * cr])
        P = ti.Vector.zero(ti.f64, 5)
        A = ti.Vector.zero(ti.f64, 15)
        for i in ti.static(range(4)):
            P[i] = w1[0] * n1[i] + w1[1] * n2[i]
        P[4] = w1[2]
        if ti.static(tangents):
            w2 = ti.Matrix.zero(ti.f64, 3, 3)
            for i in ti.static(range(3)):
                for k in ti.static(range(3)):
                    w2[i, k] = (-(u[i] + u[k]) / 3.0 + mean_u / 3.0) / (s[i] * s[k])
                w2[i, i] += (u[i] - t[i]) / (s[i] * s[i])
            twist = (w1[0] + w1[1]) / (s[0] + s[1])
            flip = 0.5 * (w2[0, 0] + w2[1, 1]) - w2[0, 1]
            if s[0] - s[1] > 1e-5 * s[0]:
                flip = (w1[0] - w1[1]) / (s[0] - s[1])
            # Directions of the twist and of the flip.
            m12 = ti.Vector([-cl * sr, cl * cr, -sl * sr, sl * cr])
            m21 = ti.Vector([-sl * cr, -sl * sr, cl * cr, cl * sr])
            turn, shear = m12 - m21, m12 + m21
            for i in ti.static(range(4)):
                for k in ti.static(range(i + 1)):
                    A[ti.static(packed(i, k))] = (
                        w2[0, 0] * n1[i] * n1[k] + w2[1, 1] * n2[i] * n2[k]
                        + w2[0, 1] * (n1[i] * n2[k] + n2[i] * n1[k])
                        + 0.5 * twist * turn[i] * turn[k] + 0.5 * flip * shear[i] * shear[k])
                A[ti.static(packed(4, i))] = w2[2, 0] * n1[i] + w2[2, 1] * n2[i]
            A[ti.static(packed(4, 4))] = w2[2, 2]
        return density, P, A

    return stress_and_tangent
