"""Additional stresses (effects) at the quadrature points of the axisymmetric solid.

Six components are reduced to four (RR, RZ, ZZ, hoop); stress and tangent are expressed by the deformation gradient.
"""

from functools import cache

from tissue_sim.fem.axisymmetric.energy import PACKED
from tissue_sim.fem.elements.point_effects import sum_effect_responses
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.trace import FormulaClassAndConstants, extract_expressions, wrap_as_traced_numbers

#: Indices of RR, RZ, ZZ and hoop among the six components of a symmetric tensor.
_COMPONENTS = (0, 3, 1, 2)


@cache
def make_effect_stress_function(formulas: tuple[FormulaClassAndConstants, ...]):
    """Return the Taichi function ``add_effect_stresses(F, P, A, states, settings) -> (S, P, A, states)``.

    The function adds the first Piola stress F S of the effects to P and its derivative to A. S is the second Piola
    stress of the effects. All arguments are vectors; see `tissue_sim.fem.elements.point_effects.PointEffects`.
    """
    ti = get_initialised_taichi()
    count = 1 + sum(len(formula.parameter_names) for formula in formulas)

    def trace_effect_expressions(F, P, A, states, settings):
        return _add_effects_to_stress_expressions(formulas, F, P, A, states, settings)

    @ti.func
    def add_effect_stresses(F, P, A, states, settings: ti.template()):
        return ti.static(trace_effect_expressions(F, P, A, states, [settings[i] for i in range(count)]))

    return add_effect_stresses


def _add_effects_to_stress_expressions(formulas: tuple[FormulaClassAndConstants, ...], F: list, P: list, A: list,
                                       states: list, settings: list) -> tuple:
    """Return the expressions (S, P, A, states) of the summed effects at a quadrature point.

    Arguments and results are lists of Taichi expressions, as in `make_effect_stress_function`.
    """
    F, P, A = (wrap_as_traced_numbers(each, lanes=True) for each in (F, P, A))
    states, settings = wrap_as_traced_numbers(states, lanes=True), wrap_as_traced_numbers(settings, lanes=False)
    C = [F[0] * F[0] + F[2] * F[2], F[1] * F[1] + F[3] * F[3], F[4] * F[4], F[0] * F[1] + F[2] * F[3], 0.0, 0.0]
    S, D, found = sum_effect_responses(formulas, _COMPONENTS, C, states, settings)
    # Derivative of the Green strains RR, 2 RZ, ZZ and hoop with respect to F.
    B = [[F[0], 0.0, F[2], 0.0, 0.0], [F[1], F[0], F[3], F[2], 0.0], [0.0, F[1], 0.0, F[3], 0.0],
         [0.0, 0.0, 0.0, 0.0, F[4]]]
    DB = [[sum((D[i][m] * B[m][k] for m in range(4)), 0.0) for k in range(5)] for i in range(4)]
    geometric = {(0, 0): S[0], (1, 0): S[1], (1, 1): S[2], (2, 2): S[0], (3, 2): S[1], (3, 3): S[2], (4, 4): S[3]}
    P = [P[k] + sum((B[i][k] * S[i] for i in range(4)), 0.0) for k in range(5)]
    A = [A[n] + geometric.get((i, k), 0.0) + sum((B[m][i] * DB[m][k] for m in range(4)), 0.0)
         for n, (i, k) in enumerate(PACKED)]
    like = F[0]
    return (extract_expressions(S, like), extract_expressions(P, like), extract_expressions(A, like),
            extract_expressions(found, like))
