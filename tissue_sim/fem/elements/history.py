"""Kernel function of relaxation and softening at the quadrature points of all solids."""

from collections.abc import Callable
from functools import cache

from tissue_sim.fem.elements.softening import make_softening_function
from tissue_sim.fem.history import RelaxationSofteningCoefficient
from tissue_sim.fem.taichi.runtime import LANES, get_initialised_taichi


@cache
def make_history_function(size: int, components: int, make_relaxation_function: Callable):
    """Return the Taichi function ``apply_history(b, q, geometry, W, P, A, elements, material)``.

    The function replaces the stress P and the tangent A of the law at quadrature point q of batch b by those of the
    softened and relaxed tissue. It stores energy density and stress before the relaxation in the arrays of `material`,
    see `tissue_sim.fem.history.MaterialMemory`.

    Args:
        size: number of stress components P; A is packed, see `list_lower_triangle_index_pairs`.
        components: number of components of a symmetric tensor.
        make_relaxation_function: returns the Taichi function ``apply_relaxation(*geometry, instant, h, P, A) ->
            (S, P, A)`` of the hereditary integral.
    """
    ti = get_initialised_taichi()
    apply_softening, apply_relaxation = make_softening_function(size), make_relaxation_function()
    entries = size * (size + 1) // 2

    @ti.func
    def apply_history(b, q, geometry: ti.template(), W, P: ti.template(), A: ti.template(), elements: ti.template(),
                      material: ti.template()):
        f = material.past[RelaxationSofteningCoefficient.FACTOR]
        energy = f * W
        for l in ti.static(range(LANES)):
            material.energies[elements.numbers[b][l], q] = energy[l]
        P1, A1 = [f * P[i] for i in ti.static(range(size))], [f * A[n] for n in ti.static(range(entries))]
        if material.past[RelaxationSofteningCoefficient.LOSS] != 0.0:
            most = ti.Vector([material.largest[elements.numbers[b][l], q] for l in ti.static(range(LANES))])
            P2, A2 = apply_softening(energy, most, material.past[RelaxationSofteningCoefficient.LOSS],
                                     material.past[RelaxationSofteningCoefficient.LOSS_MODULUS],
                                     material.past[RelaxationSofteningCoefficient.LOSS_SHARE],
                                     material.past[RelaxationSofteningCoefficient.FORM], P1, A1)
            for i in ti.static(range(size)):
                P1[i] = P2[i]
            for n in ti.static(range(entries)):
                A1[n] = A2[n]
        h = [ti.Vector([material.inherited[elements.numbers[b][l], q, i] for l in ti.static(range(LANES))])
             for i in ti.static(range(components))]
        S, P3, A3 = apply_relaxation(*geometry, material.past[RelaxationSofteningCoefficient.INSTANT], h, P1, A1)
        for i in ti.static(range(components)):
            for l in ti.static(range(LANES)):
                material.stresses[elements.numbers[b][l], q, i] = S[i][l]
        for i in ti.static(range(size)):
            P[i] = P3[i]
        for n in ti.static(range(entries)):
            A[n] = A3[n]

    return apply_history
