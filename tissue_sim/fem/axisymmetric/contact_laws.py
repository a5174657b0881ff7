"""Tractions of contact laws (adhesion, lubrication) in the axisymmetric solid, as Taichi functions."""

from functools import cache
from typing import NamedTuple

import numpy as np

from tissue_sim.errors import InputError, located_and_converted_errors
from tissue_sim.experiment.contact_law import ContactLaw, Traction
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.trace import TRIED, FormulaClassAndConstants, extract_expressions, wrap_as_traced_numbers


class ContactLawFunctions(NamedTuple):
    """Contact laws in the form that the kernel of a step calls.

    Attributes:
        evaluate_traction: Taichi function ``evaluate_traction(gap, pressure, slip, settings)``. It returns normal and
            tangential traction, Pa, and their derivatives with respect to gap and slip, Pa/m.
        drags: whether a law has a tangential traction.
        stiffens: whether a law has nonzero derivatives.
    """

    evaluate_traction: object
    drags: bool
    stiffens: bool


def pack_contact_law_settings(laws: tuple[ContactLaw, ...], face: float) -> np.ndarray:
    """Return `settings` of `evaluate_traction`: contact area of the tool, m2; then reach, m, and parameters per law."""
    numbers = [[law.reach, *FormulaClassAndConstants.from_law_or_effect(law).get_parameter_values(law)] for law in laws]
    return np.array([face, *(value for law in numbers for value in law)])


@cache
def make_contact_law_functions(formulas: tuple[FormulaClassAndConstants[ContactLaw], ...]) -> ContactLawFunctions:
    """Return the Taichi functions of the sum of several contact laws.

    Raises:
        InputError: a law uses an operation that kernels do not support.
    """
    ti = get_initialised_taichi()
    count = 1 + sum(1 + len(formula.parameter_names) for formula in formulas)
    tried = _sum_law_tractions_and_derivatives(formulas, [TRIED] * 3, [TRIED] * count)
    constant = [not hasattr(value, "lanes") for value in tried]

    def trace_traction_expressions(gap, pressure, slip, settings):
        values = _sum_law_tractions_and_derivatives(formulas, [gap, pressure, slip], settings)
        return extract_expressions(values, wrap_as_traced_numbers([gap], lanes=False)[0])

    @ti.func
    def evaluate_traction(gap, pressure, slip, settings: ti.template()):
        """Return normal and tangential traction, Pa, and their derivatives with gap and slip, Pa/m."""
        return ti.static(trace_traction_expressions(gap, pressure, slip, [settings[i] for i in range(count)]))

    return ContactLawFunctions(evaluate_traction, not constant[1], not (constant[2] and constant[3]))


def _sum_law_tractions_and_derivatives(formulas: tuple[FormulaClassAndConstants[ContactLaw], ...], place: list,
                                       settings: list) -> list:
    """Return normal and tangential traction, and their derivatives with gap and slip, summed over all laws."""
    gap, pressure, slip = wrap_as_traced_numbers(place, lanes=False)
    face, *numbers = wrap_as_traced_numbers(settings, lanes=False)
    total = [0.0] * 4
    for formula in formulas:
        reach, *parameters = numbers[: 1 + len(formula.parameter_names)]
        numbers = numbers[1 + len(formula.parameter_names):]
        with located_and_converted_errors(field=f"contact_laws.{formula.kind.name}"):
            found = formula.build_unchecked_instance(parameters).traction(gap, pressure, (slip, 0.0), face)
            if not isinstance(found, Traction):
                raise InputError(f"traction() must return a tissue_sim.Traction; got {type(found).__name__}.")
        values = [found.pull, found.drag[0], found.pull_rate, found.drag_rates[0][0]]
        if len(formulas) > 1:
            # Each law ends at its own reach; the contact uses the largest reach.
            values = [np.where(gap < reach, value, 0.0) if hasattr(value, "lanes") else value for value in values]
        total = [before + value for before, value in zip(total, values, strict=True)]
    return total
