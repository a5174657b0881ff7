"""Additional contact laws (adhesion, lubrication): sum of their tractions, for the nodes of a solid and for kernels.

The formulas are those of `tissue_sim.experiment.contact_law.ContactLaw.traction`. The three-dimensional solver
evaluates them with NumPy arrays; the kernel of the axisymmetric solver contains their traced expressions.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from tissue_sim.errors import located_and_converted_errors
from tissue_sim.experiment.contact_law import (
    ContactLaw,
    Traction,
    evaluate_traction,
    sum_attractive_tractions_at_zero_gap,
)
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.trace import TRIED, FormulaClassAndConstants, extract_expressions, wrap_as_traced_numbers

#: Step of the difference quotient of a pull with respect to the gap, in units of the reach.
_STEP = 1e-6


def sum_tractions(laws: Sequence[ContactLaw], reaches: Sequence[Any], gap: Any, pressure: Any, slip: tuple[Any, Any],
                  face: Any, shift: float = 0.0) -> Traction:
    """Sum the tractions of several laws; each law ends at its reach.

    Args:
        laws: contact laws.
        reaches: reach of each law, m.
        gap: m; a traced number, or an array. Gaps are smaller than the largest reach.
        pressure: Pa, like `gap`.
        slip: two components since the touch, m, like `gap`.
        face: contact area of the tool, m2.
        shift: added to the gap in the formulas only, for difference quotients, m.

    Raises:
        InputError: a law does not return a `Traction`.
    """
    total: list[Any] = [0.0] * 8
    for law, reach in zip(laws, reaches, strict=True):
        # Copies, because a formula may change its arguments, which are passed to the next law.
        own_gap, own_pressure, *own_slip = (each.copy() if isinstance(each, np.ndarray) else each
                                            for each in (gap + shift if shift else gap, pressure, *slip))
        with located_and_converted_errors(field=f"contact_laws.{law.name}"):
            found = evaluate_traction(law, own_gap, own_pressure, (own_slip[0], own_slip[1]), face)
        values = [found.pull, *found.drag, found.pull_rate, *found.drag_rates[0], *found.drag_rates[1]]
        if len(laws) > 1:
            # Zero stays a Python number, so that a kernel leaves it out.
            values = [value if isinstance(value, float | int) and value == 0.0 else np.where(gap < reach, value, 0.0)
                      for value in values]
        total = [before + value for before, value in zip(total, values, strict=True)]
    pull, drag_1, drag_2, pull_rate, rate_11, rate_12, rate_21, rate_22 = total
    return Traction(pull, (drag_1, drag_2), pull_rate, ((rate_11, rate_12), (rate_21, rate_22)))


class NodalContactLaws:
    """Sum of all additional contact laws at the nodes of a solid.

    Args:
        laws: laws in addition to contact and friction.
        face: area of the tool's face at the largest depth, m2.
        areas: area that each node of the mesh represents, m2, shape (nodes,).

    Attributes:
        reach: gap from which on no law has an effect, m; 0 without laws.
        strength: sum of the pulls at zero gap and pressure, Pa.
    """

    def __init__(self, laws: tuple[ContactLaw, ...] = (), face: float = 1.0, areas: np.ndarray | None = None):
        self._laws, self._face, self._areas = laws, face, areas
        self.reach = max((law.reach for law in laws), default=0.0)
        self.strength = sum_attractive_tractions_at_zero_gap(laws, face)

    def __bool__(self) -> bool:
        return bool(self._laws)

    def compute_adhesive_pull_of_nodes_at_touch(self, nodes: np.ndarray) -> np.ndarray:
        """Return the adhesive force on nodes at zero gap and zero pressure, N, shape (n,)."""
        return np.zeros(nodes.size) if self._areas is None else self.strength * self._areas[nodes]

    def compute_law_forces_and_derivatives(self, nodes: np.ndarray, gap: np.ndarray, normal: np.ndarray,
                                           slip: np.ndarray, normals: np.ndarray, meridians: np.ndarray,
                                           curved: np.ndarray, bending: float) -> tuple[np.ndarray, np.ndarray]:
        """Compute the forces on the tool, N, shape (n, 3), and their derivatives, N/m, shape (n, 3, 3).

        Args:
            nodes: indices of the nodes, shape (n,).
            gap: smaller than `reach`, m, shape (n,).
            normal: contact force along the normal, negative in compression, N, shape (n,).
            slip: since each node touched, m, shape (n, 3).
            normals: outward normals of the tool, shape (n, 3).
            meridians: directions along its outline, shape (n, 3).
            curved: derivative of the normals with respect to position, 1/m, shape (n, 3, 3).
            bending: 1: the derivatives contain the rotation of a pull with the surface and its decrease with the gap,
                which is inaccurate far from equilibrium and where surfaces separate; 0: only those that the laws state.

        Raises:
            InputError: a law does not return a `Traction`.
        """
        assert self._areas is not None
        areas, along = self._areas[nodes], (meridians, np.cross(normals, meridians))
        slips = tuple(np.einsum("ni,ni->n", slip, way) for way in along)
        pressure = np.maximum(-normal, 0.0) / np.where(areas > 0.0, areas, 1.0)
        found = self._sum_tractions_at(gap, pressure, slips)
        pull_rate = found.pull_rate
        if bending:
            step = _STEP * self.reach
            further = self._sum_tractions_at(gap, pressure, slips, step).pull
            pull_rate = pull_rate + bending * ((further - np.asarray(found.pull)) / step - pull_rate)
        pull = np.broadcast_to(areas * found.pull, gap.shape)
        rates = np.broadcast_to(areas * pull_rate, gap.shape)[:, None, None] * normals[:, :, None] * normals[:, None]
        forces, rates = pull[:, None] * normals, rates + (bending * pull)[:, None, None] * curved
        for i in range(2):
            forces = forces + (areas * found.drag[i])[:, None] * along[i]
            for j in range(2):
                rate = areas * found.drag_rates[i][j]
                rates = rates + rate[:, None, None] * along[i][:, :, None] * along[j][:, None]
        return forces, rates

    def _sum_tractions_at(self, gap: np.ndarray, pressure: np.ndarray, slip: tuple[np.ndarray, ...],
                          shift: float = 0.0) -> Traction:
        """Return the sum of all tractions at gaps, m, pressures, Pa, and two components of the slip, m, (n,) each."""
        return sum_tractions(self._laws, [law.reach for law in self._laws], gap, pressure, (slip[0], slip[1]),
                             self._face, shift)


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
    """Return the Taichi functions of the sum of several contact laws, with slip in one direction.

    Raises:
        InputError: a law uses an operation that kernels do not support.
    """
    ti = get_initialised_taichi()
    count = 1 + sum(1 + len(formula.parameter_names) for formula in formulas)

    def sum_traced_tractions(place: list, settings: list) -> list:
        """Return normal and tangential traction, and their derivatives with gap and slip, summed over all laws."""
        gap, pressure, slip = wrap_as_traced_numbers(place, lanes=False)
        face, *numbers = wrap_as_traced_numbers(settings, lanes=False)
        laws, reaches = [], []
        for formula in formulas:
            reach, *parameters = numbers[: 1 + len(formula.parameter_names)]
            numbers = numbers[1 + len(formula.parameter_names):]
            laws.append(formula.build_unchecked_instance(parameters))
            reaches.append(reach)
        found = sum_tractions(laws, reaches, gap, pressure, (slip, 0.0), face)
        return [found.pull, found.drag[0], found.pull_rate, found.drag_rates[0][0]]

    constant = [not hasattr(value, "lanes") for value in sum_traced_tractions([TRIED] * 3, [TRIED] * count)]

    def trace_traction_expressions(gap, pressure, slip, settings):
        values = sum_traced_tractions([gap, pressure, slip], settings)
        return extract_expressions(values, wrap_as_traced_numbers([gap], lanes=False)[0])

    @ti.func
    def evaluate_traction(gap, pressure, slip, settings: ti.template()):
        """Return normal and tangential traction, Pa, and their derivatives with gap and slip, Pa/m."""
        return ti.static(trace_traction_expressions(gap, pressure, slip, [settings[i] for i in range(count)]))

    return ContactLawFunctions(evaluate_traction, not constant[1], not (constant[2] and constant[3]))
