"""Kernel functions of a strain-energy law for all solvers: derivatives as Taichi functions, and J^(-1/3).

The functions work on scalars (one point) and on vectors (several points at once).
"""

from functools import cache
from typing import TYPE_CHECKING

from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.laws import KernelEnergy
from tissue_sim.laws.derivation import load_or_derive_function
from tissue_sim.public_names import LazyModule

if TYPE_CHECKING:
    import sympy as sp
else:
    sp = LazyModule("sympy")

#: |J - 1| up to which a series is a good start of Newton's iteration for the cube root; beyond it may not converge.
_NEAR = 0.3


def make_taichi_expression_builder(derive_arguments_and_expressions, cache_key: tuple | None, source: str):
    """Return a Python function that builds Taichi expressions from symbolic (sympy) expressions.

    A kernel calls the function while it is compiled, on Taichi variables.

    Args:
        derive_arguments_and_expressions: function that returns the arguments and the expressions (sympy).
        cache_key: key of the function in the cache; None: not cached.
        source: file that defines `derive_arguments_and_expressions`; see `tissue_sim.laws.derivation`.
    """
    ti = get_initialised_taichi()
    names = {name: getattr(ti, name) for name in ("exp", "log", "sqrt", "sin", "cos", "tan", "tanh")}
    return load_or_derive_function(derive_arguments_and_expressions, cache_key=cache_key, source=source, names=names)


def make_energy_derivatives_by_invariants(energy: KernelEnergy, tangents: bool = True):
    """Return a function that evaluates energy and derivatives of a law of the isochoric invariants.

    Args:
        energy: energy of (I1, I2).
        tangents: whether second derivatives are needed; they are 0 otherwise.

    Returns:
        Python function of (I1, I2, coefficients) -> W, W1, W2, W11, W12, W22, then the conditions of the domain.
    """
    def derive_arguments_and_expressions():
        """Return the arguments, and the expressions of W, its derivatives and the conditions of the domain (sympy)."""
        W, (I1, I2) = energy.energy, energy.variables
        second = [sp.diff(W, I1, 2), sp.diff(W, I1, I2), sp.diff(W, I2, 2)] if tangents else [sp.Integer(0)] * 3
        return (I1, I2, energy.coefficients), [W, sp.diff(W, I1), sp.diff(W, I2), *second, *energy.domain_conditions]

    return make_taichi_expression_builder(derive_arguments_and_expressions,
                                          _derivation_cache_key_or_none(energy, tangents), __file__)


def make_energy_derivatives_by_stretch(energy: KernelEnergy):
    """Return a function of a law W = sum of w over the isochoric stretches.

    It maps (stretch, coefficients) to w', w'' and w, then the conditions of the domain.
    """
    def derive_arguments_and_expressions():
        """Return the arguments, and the expressions w', w'', w and the conditions of the domain (sympy)."""
        W, (stretch,) = energy.energy, energy.variables
        return (stretch, energy.coefficients), [sp.diff(W, stretch), sp.diff(W, stretch, 2), W,
                                                *energy.domain_conditions]

    return make_taichi_expression_builder(derive_arguments_and_expressions, _derivation_cache_key_or_none(energy),
                                          __file__)


@cache
def make_domain_margin_function():
    """Return the Taichi function ``compute_margin(conditions, like)`` of a point, positive inside the domain of a law.

    It returns the smallest of the conditions of the domain; 1 without conditions. `like` has the shape of the result.
    """
    ti = get_initialised_taichi()

    @ti.func
    def compute_margin(conditions: ti.template(), like):
        margin = 0.0 * like + 1.0
        for condition in ti.static(conditions):
            margin = ti.min(margin, condition)
        return margin

    return compute_margin


@cache
def make_stretch_derivatives_function(energy: KernelEnergy):
    """Return the Taichi function ``compute_stretch_derivatives(stretches, root, coefficients) -> (W, w1, w2, margin)``.

    The energy is a sum over the isochoric principal stretches, or over the full stretches with a function of J; root is
    J^(-1/3). W is the energy density, w1 (3) its derivatives with respect to the principal stretches and w2 (3 x 3) the
    second derivatives. The margin is positive inside the domain of the law.
    """
    return (_make_full_stretch_derivatives_function if energy.family == "stretches and volume"
            else _make_isochoric_stretch_derivatives_function)(energy)


def _make_full_stretch_derivatives_function(energy: KernelEnergy):
    """Return the function of `make_stretch_derivatives_function` for an energy w(l_i) + u(J)/3, summed over i."""
    ti = get_initialised_taichi()
    count = energy.coefficient_count

    def make_derivatives_by(variable: int):
        """Return a function of (variable, coefficients) -> first and second derivative, energy, at 1 of the other."""
        def derive_arguments_and_expressions():
            """Return the arguments and the expressions (sympy)."""
            x = energy.variables[variable]
            alone = energy.energy.subs(energy.variables[1 - variable], 1)
            return (x, energy.coefficients), [sp.diff(alone, x), sp.diff(alone, x, 2), alone]

        return make_taichi_expression_builder(derive_arguments_and_expressions,
                                              _derivation_cache_key_or_none(energy, variable), __file__)

    by_stretch, by_volume = make_derivatives_by(0), make_derivatives_by(1)

    @ti.func
    def compute_stretch_derivatives(stretches: ti.template(), root, coefficients: ti.template()):
        J = stretches[0] * stretches[1] * stretches[2]
        w = [[v + 0.0 * root for v in ti.static(by_stretch(stretches[k], [coefficients[m] for m in range(count)]))]
             for k in ti.static(range(3))]
        u = [3.0 * v + 0.0 * root for v in ti.static(by_volume(J, [coefficients[m] for m in range(count)]))]
        # J u' and the second derivative of u with respect to ln J.
        volume = J * u[0]
        curvature = J * J * u[1] + volume
        w1 = [w[k][0] + volume / stretches[k] for k in ti.static(range(3))]
        w2 = [[(curvature - ti.static(float(i == k)) * volume) / (stretches[i] * stretches[k])
               + ti.static(float(i == k)) * w[i][1] for k in ti.static(range(3))] for i in ti.static(range(3))]
        return w[0][2] + w[1][2] + w[2][2] + u[2], w1, w2, 0.0 * root + 1.0

    return compute_stretch_derivatives


def _make_isochoric_stretch_derivatives_function(energy: KernelEnergy):
    """Return the function of `make_stretch_derivatives_function` for a sum over the isochoric stretches."""
    ti = get_initialised_taichi()
    count, values = energy.coefficient_count, 3 + len(energy.domain_conditions)
    derivatives, compute_margin = make_energy_derivatives_by_stretch(energy), make_domain_margin_function()

    @ti.func
    def compute_stretch_derivatives(stretches: ti.template(), root, coefficients: ti.template()):
        bars = [stretches[k] * root for k in ti.static(range(3))]
        # First and second derivatives with respect to the logarithm of each isochoric stretch.
        w = [[v + 0.0 * root for v in ti.static(derivatives(bars[k], [coefficients[m] for m in range(count)]))]
             for k in ti.static(range(3))]
        t = [w[k][0] * bars[k] for k in ti.static(range(3))]
        mean_t = (t[0] + t[1] + t[2]) / 3.0
        w1 = [(t[k] - mean_t) / stretches[k] for k in ti.static(range(3))]
        u = [w[k][1] * bars[k] * bars[k] + t[k] for k in ti.static(range(3))]
        mean_u = (u[0] + u[1] + u[2]) / 3.0
        w2 = [[((-(u[i] + u[k]) / 3.0 + mean_u / 3.0
                 + ti.static(float(i == k)) * (u[i] - (t[i] - mean_t))) / (stretches[i] * stretches[k]))
               for k in ti.static(range(3))] for i in ti.static(range(3))]
        margin = compute_margin([w[k][n] for k in ti.static(range(3)) for n in ti.static(range(3, values))], root)
        return w[0][2] + w[1][2] + w[2][2], w1, w2, margin

    return compute_stretch_derivatives


@cache
def make_principal_plane_moduli_function():
    """Return the Taichi function ``compute_principal_plane_moduli(p, q, stretches, w1, w2) -> (twist, flip)``.

    Twist and flip are the second derivatives of the energy for a rotation and for a shear of the plane of the principal
    directions p and q; w1 and w2 are those of `make_stretch_derivatives_function`. Equal stretches have a limit.
    """
    ti = get_initialised_taichi()

    @ti.func
    def compute_principal_plane_moduli(p: ti.template(), q: ti.template(), stretches: ti.template(), w1: ti.template(),
                                       w2: ti.template()):
        twist = (w1[p] + w1[q]) / (stretches[p] + stretches[q])
        apart = ti.abs(stretches[p] - stretches[q]) > 1e-5 * stretches[p]
        flip = ti.select(apart, (w1[p] - w1[q]) / ti.select(apart, stretches[p] - stretches[q], stretches[p]),
                         0.5 * (w2[p][p] + w2[q][q]) - w2[p][q])
        return twist, flip

    return compute_principal_plane_moduli


@cache
def make_isochoric_chain_rule(I1: str, I2: str, J: str, variables: str, tangents: bool = True):
    """Return the function (variables, s, W1, W2, W11, W12, W22) -> gradient and Hessian of the isochoric energy.

    W is a function of the isochoric invariants J^(-2/3) I1 and J^(-4/3) I2. Derivatives are taken with respect to the
    variables; s = J^(-2/3) is an argument, so that the function evaluates no power.

    Args:
        I1: first invariant of F^T F, an expression in the variables.
        I2: second invariant.
        J: determinant of F.
        variables: names of the variables, which are positive, separated by spaces.
        tangents: whether the function returns the Hessian (lower triangle, row by row) after the gradient.
    """
    def derive_arguments_and_expressions():
        """Return the arguments and the symbolic (sympy) gradient and Hessian."""
        v = sp.symbols(variables, positive=True)
        s = sp.Symbol("s", positive=True)
        first = sp.symbols("W1 W2", real=True)
        second = sp.symbols("W11 W12 W22", real=True)
        hessian = sp.Matrix(2, 2, [second[0], second[1], second[1], second[2]])
        first_invariant, second_invariant, volume = (sp.sympify(each, {x.name: x for x in v}) for each in (I1, I2, J))

        def differentiate_including_scale(expression, x):
            """Return the total derivative of an expression with respect to x, where s depends on x."""
            inner = -sp.Rational(2, 3) * s * sp.diff(sp.log(volume), x)
            return sp.diff(expression, x) + sp.diff(expression, s) * inner

        bars = (s * first_invariant, s**2 * second_invariant)
        slopes = [[differentiate_including_scale(bar, x) for x in v] for bar in bars]
        gradient = [sum(first[m] * slopes[m][i] for m in range(2)) for i in range(3)]
        curvature = [sum(first[m] * differentiate_including_scale(slopes[m][i], v[k]) for m in range(2))
                     + sum(hessian[m, n] * slopes[m][i] * slopes[n][k] for m in range(2) for n in range(2))
                     for i in range(3) for k in range(i + 1)]
        return (*v, s, *first, *second), [*gradient, *curvature] if tangents else gradient

    return make_taichi_expression_builder(derive_arguments_and_expressions,
                                          ("isochoric chain rule", I1, I2, J, variables, tangents), __file__)


def _derivation_cache_key_or_none(energy: KernelEnergy, *what) -> tuple | None:
    """Return the cache key of the derivatives of an energy; None if they are not cached."""
    return None if energy.cache_key is None else (*energy.cache_key, "energy", *what)


@cache
def make_inverse_cube_root_function():
    """Return the Taichi function ``inverse_cube_root(J)``: J^(-1/3) of a vector, by Newton's method for J near 1."""
    ti = get_initialised_taichi()

    @ti.func
    def inverse_cube_root(J):
        """Return J^(-1/3) of the positive components of a vector J."""
        x = J - 1.0
        r = 1.0 + x * (-1.0 / 3.0 + x * (2.0 / 9.0 - x * (14.0 / 81.0)))
        for _i in ti.static(range(3)):
            r = r * (4.0 - J * r * r * r) * (1.0 / 3.0)
        if ti.abs(x).max() > _NEAR:
            r = ti.pow(J, -1.0 / 3.0)
        return r

    return inverse_cube_root


def list_lower_triangle_index_pairs(size: int) -> tuple[tuple[int, int], ...]:
    """Return row and column of each entry of a symmetric matrix in packed storage: lower triangle, row by row."""
    return tuple((m, n) for m in range(size) for n in range(m + 1))
