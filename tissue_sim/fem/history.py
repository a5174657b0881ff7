"""State variables at the quadrature points: relaxation, softening, and effects of plug-ins."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from enum import IntEnum
from itertools import chain
from typing import Any

import numpy as np

from tissue_sim.errors import InputError, located_and_converted_errors
from tissue_sim.fem.taichi.array_tables import ArrayLayout, real_array_type
from tissue_sim.fem.taichi.origins import allocate_array, copy_to_addressable_array
from tissue_sim.fem.taichi.trace import TRIED, FormulaClassAndConstants, wrap_as_traced_numbers
from tissue_sim.material.effect import PointEffect, TissueEffect
from tissue_sim.material.softening import SOFTENING_FORMS, Softening
from tissue_sim.material.viscoelasticity import Prony

#: Longest time step that is passed to a formula, s, because kernels have no infinity.
_LONGEST = 1e30


class PointEffects:
    """NumPy arrays of all point effects of a material, which the assembly of a step reads and writes.

    Args:
        points: number of elements, and of quadrature points in each.
        components: number of stored stress components.

    Attributes:
        formulas: formulas of the effects, in order.
        settings: time step, s, then the parameters of all effects.
        states: state variables of all effects at the last committed step, then the sum of their second Piola-Kirchhoff
            stresses, Pa; shape (elements, q, variables + components).
        found: values of `states` at the end of the present step.
    """

    def __init__(self, points: tuple[int, int], components: int):
        self._points, self._components = points, components
        self.formulas: tuple[FormulaClassAndConstants[PointEffect], ...] = ()
        self.settings = allocate_array((1,))
        self._allocate_states(())

    def __bool__(self) -> bool:
        return bool(self.formulas) and self._points[0] > 0

    def _allocate_states(self, rest: tuple[float, ...]) -> None:
        """Allocate the state variables; `rest` are their values at rest."""
        # Without effects the arrays are not read.
        shape = (*self._points, len(rest) + self._components) if self.formulas else (1, 1, 1)
        self.states = allocate_array(shape)
        self.states[..., : len(rest)] = rest
        self.found = copy_to_addressable_array(self.states)

    def set_effects(self, effects: Iterable[TissueEffect]) -> None:
        """Set the effects of a material; state variables are kept if the formulas are the same.

        Raises:
            InputError: a kernel cannot execute a formula, or a formula returns other shapes than required.
        """
        points = [effect for effect in effects if isinstance(effect, PointEffect)]
        formulas = tuple(FormulaClassAndConstants.from_law_or_effect(effect) for effect in points)
        if formulas != self.formulas:
            for formula in formulas:
                require_valid_formula(formula)
            self.formulas = formulas
            self._allocate_states(tuple(value for effect in points for value in effect.rest))
        numbers = (formula.get_parameter_values(effect) for formula, effect in zip(formulas, points, strict=True))
        settings = np.array([self.settings[0], *chain.from_iterable(numbers)])
        if settings.shape == self.settings.shape:
            self.settings[:] = settings  # in place: the kernel has a reference to the array
        else:
            self.settings = copy_to_addressable_array(settings)

    def set_step_duration(self, dt: float) -> None:
        """Set the duration dt of the next step, s, in the settings of the formulas."""
        self.settings[0] = min(dt, _LONGEST)

    def commit_step(self) -> None:
        """Commit the state variables of the last step; to be called if the step converged."""
        if self.formulas:
            self.states[:] = self.found

    @property
    def committed_effect_stress(self) -> np.ndarray:
        """Sum of the stresses of all effects at the last committed step, Pa, shape (elements, q, components)."""
        return self.states[..., -self._components:]


def sum_effect_responses(formulas: Iterable[FormulaClassAndConstants[PointEffect]], components: Sequence[int],
                         C: Sequence[Any], states: Sequence[Any],
                         settings: Sequence[Any]) -> tuple[list[Any], list[list[Any]], list[Any]]:
    """Sum the responses of all effects; all numbers may be traced numbers of a kernel or NumPy arrays of points.

    Args:
        formulas: formulas of the effects.
        components: indices of the components of the result among those of the formulas (11, 22, 33, 12, 13, 23).
        C: right Cauchy-Green tensor, 6 components.
        states: state variables of all effects before the step.
        settings: see `PointEffects.settings`.

    Returns:
        Second Piola-Kirchhoff stress, Pa, one entry for each component; rows of its derivative with respect to the
        Green strains (shears doubled), Pa; state variables of all effects after the step.
    """
    dt, *numbers = settings
    S: list[Any] = [0.0] * len(components)
    D: list[list[Any]] = [[0.0] * len(components) for _ in components]
    found: list[Any] = []
    for formula in formulas:
        parameters, numbers = numbers[: len(formula.parameter_names)], numbers[len(formula.parameter_names):]
        state, states = states[: len(formula.kind.rest)], states[len(formula.kind.rest):]
        # Copies, because a formula may change its arguments.
        stress, tangent, new = formula.build_unchecked_instance(parameters).response(
            [copy(each) for each in C], [copy(each) for each in state], dt)
        S = [total + stress[i] for total, i in zip(S, components, strict=True)]
        D = [[total + tangent[i][k] for total, k in zip(row, components, strict=True)]
             for row, i in zip(D, components, strict=True)]
        found += new
    return S, D, found


def require_valid_formula(formula: FormulaClassAndConstants[PointEffect]) -> None:
    """Check a formula of a point effect: execute it once outside of a kernel and check the shapes of its result.

    Raises:
        InputError: the formula uses an operation that kernels do not support, or returns other shapes.
    """
    kind, field = formula.kind, f"effects.{formula.kind.name}"
    parameters = wrap_as_traced_numbers([TRIED] * len(formula.parameter_names), lanes=False)
    C, state, (dt,) = wrap_as_traced_numbers([TRIED] * 6,
                                             True), wrap_as_traced_numbers([TRIED] * len(kind.rest),
                                                                           True), wrap_as_traced_numbers([TRIED], False)
    with located_and_converted_errors(field=field):
        stress, tangent, found = formula.build_unchecked_instance(parameters).response(C, state, dt)
    shape = len(stress), len(tangent), {len(row) for row in tangent}, len(found)
    if shape != (6, 6, {6}, len(kind.rest)):
        raise InputError(f"the response of {kind.__name__} must return 6 stresses, 6 rows of 6 tangent entries and "
                         f"{len(kind.rest)} state variables, as many as `rest` has; got {len(stress)} stresses, "
                         f"{len(tangent)} rows and {len(found)} state variables.", field=field)


class RelaxationSofteningCoefficient(IntEnum):
    """Indices of `MaterialMemory.past`: coefficients of relaxation and softening in this step, equal at all points."""

    #: Instantaneous stress over the stress of the law, 1.
    FACTOR = 0
    #: Fraction of a stress increment of this step that acts at once, 1; see `Prony.increment`.
    INSTANT = 1
    #: Parameters of `Softening`: loss (1), modulus (Pa), share (1), and the index of its form in `SOFTENING_FORMS`.
    LOSS = 2
    LOSS_MODULUS = 3
    LOSS_SHARE = 4
    FORM = 5


def get_softening_coefficients(softening: Softening | None) -> np.ndarray:
    """Return the entries of `MaterialMemory.past` from `RelaxationSofteningCoefficient.LOSS` on; None: no softening."""
    return np.array((0.0, 1.0, 0.0, 0.0) if softening is None else (
        softening.loss, softening.modulus, softening.share, SOFTENING_FORMS.index(softening.form)))


#: Coefficients of the law, and the arrays of `MaterialMemory`.
MATERIAL_ARRAYS = ArrayLayout(
    coefficients=real_array_type(), past=real_array_type(), inherited=real_array_type(3), largest=real_array_type(2),
    stresses=real_array_type(3), energies=real_array_type(2), before=real_array_type(3), internal=real_array_type(4))


class MaterialMemory:
    """Material history (relaxation, softening) at the quadrature points, in arrays that the kernel of a step uses.

    The recursion is that of `tissue_sim.material.viscoelasticity`: the stress of the law is linear in time within a
    step.

    Args:
        points: number of elements and number of quadrature points of an element.
        components: number of components of a symmetric tensor.

    Attributes:
        past: coefficients of the stresses in this step, see `RelaxationSofteningCoefficient`, shape (6,).
        inherited: contribution of earlier steps to the isochoric second Piola-Kirchhoff stress, Pa, shape
            (elements, q, components).
        largest: largest isochoric energy density so far, J/m3, shape (elements, q).
        stresses, energies: stress and energy density of the law in this step, softened, not relaxed.
        before: `stresses` of the last committed step.
        internal: Q_i of each term, Pa, shape (terms, elements, q, components).
        step: decay and gain of each term in this step, shapes (terms,).
    """

    def __init__(self, points: tuple[int, int], components: int):
        self.past = allocate_array((len(RelaxationSofteningCoefficient),))
        self.inherited, self.stresses, self.before, self._scratch = (
            allocate_array((*points, components)) for _ in range(4))
        self.largest, self.energies = allocate_array(points), allocate_array(points)
        self.internal = allocate_array((0, *self.stresses.shape))
        self.step = (np.zeros(0), np.zeros(0))
        self.set_relaxation_and_softening(None, None, 1.0)

    def set_relaxation_and_softening(self, relaxation: Prony | None, softening: Softening | None,
                                     factor: float) -> None:
        """Set relaxation and softening of the material; None: the material has none.

        Args:
            relaxation: Prony series.
            softening: softening by the largest energy density so far.
            factor: instantaneous stress over the stress of the law, 1.
        """
        self._prony: Prony | None = relaxation
        self._known: float | None = None
        terms = 0 if relaxation is None else len(relaxation.terms)
        if len(self.internal) != terms:
            self.internal = allocate_array((terms, *self.stresses.shape))
        self.past[RelaxationSofteningCoefficient.FACTOR] = factor
        self.past[RelaxationSofteningCoefficient.LOSS:] = get_softening_coefficients(softening)
        self.works = relaxation is not None or softening is not None
        if relaxation is None:
            self.inherited[:] = 0.0
        self.set_step_duration(0.0)

    def set_step_duration(self, dt: float) -> None:
        """Set the duration of the next step, and compute the inherited stresses.

        Args:
            dt: duration, s; 0: a sudden step; infinity: the relaxed state.
        """
        self.dt = dt
        if self._prony is None:
            self.past[RelaxationSofteningCoefficient.INSTANT] = 1.0
            return
        if dt != self._known:
            self._increment, self._known = self._prony.compute_recursion_coefficients(dt), dt
        self.past[RelaxationSofteningCoefficient.INSTANT], decay, gain = self._increment
        self.step = decay, gain
        np.multiply(self.before, -gain.sum(), out=self.inherited)
        for term, left in zip(self.internal, decay, strict=True):
            np.multiply(term, left, out=self._scratch)
            self.inherited += self._scratch

    def commit_step(self) -> None:
        """Update the history with the stresses and energies of the last step; to be called if the step converged."""
        if not self.works:
            return
        if self._prony is not None:
            decay, gain = self.step
            np.subtract(self.stresses, self.before, out=self.before)
            for term, left, more in zip(self.internal, decay, gain, strict=True):
                term *= left
                np.multiply(self.before, more, out=self._scratch)
                term += self._scratch
            self.before[:] = self.stresses
        np.maximum(self.largest, self.energies, out=self.largest)

    def compute_committed_stress_with_relaxation(self) -> np.ndarray:
        """Return the isochoric stress of the last committed step with relaxation, Pa, shape (elements, q, components).

        The second Piola-Kirchhoff stress is (1 - sum g) S + sum Q_i.
        """
        if self._prony is None:
            return self.stresses.copy()
        return (1.0 - self._prony.relaxing_fraction) * self.before + self.internal.sum(axis=0)

    def collect_arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return the arrays of `MATERIAL_ARRAYS` except the coefficients of the law."""
        return {"past": self.past, "inherited": self.inherited, "largest": self.largest, "stresses": self.stresses,
                "energies": self.energies, "before": self.before, "internal": self.internal}

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays that define the committed state; writing saved copies into them restores the state."""
        return self.before, self.internal, self.largest, self.stresses


@dataclass(frozen=True)
class SofteningKinkSettings:
    """Distances from the kink of a softening law, where the energy density of a point reaches its largest value so far.

    Attributes:
        tie: relative distance below which the energy density and its largest value are equal, 1.
        below: relative distance below the largest value within which a difference could cross the kink, 1.
        beyond: relative distance above the largest value within which a difference could cross the kink, 1.
    """

    tie: float = 1e-7
    below: float = 1e-5
    beyond: float = 1e-4


#: Distances of all derivatives.
_KINK = SofteningKinkSettings()


@contextmanager
def shift_points_from_softening_kink(memory: MaterialMemory) -> Iterator[bool]:
    """Shift points near their largest energy density away from the kink there, for differences of the law.

    Points under increasing load are treated as on first load, which changes no force; for others
    `SofteningKinkSettings.below` of the largest value is added to it. The history is restored at the end.

    Yields:
        Whether there are such points; the forces must then be assembled again.
    """
    largest, more = memory.largest, memory.energies - memory.largest
    near = (largest > 0.0) & (more >= -_KINK.below * largest) & (more <= _KINK.beyond * largest)
    softens = memory.works and memory.past[RelaxationSofteningCoefficient.LOSS] != 0.0
    if not (softens and near.any()):
        yield False
        return
    kept = [(array, array.copy()) for array in (largest, memory.stresses, memory.energies)]
    largest[near] = np.where(more >= -_KINK.tie * largest, 0.0, (1.0 + _KINK.below) * largest)[near]
    try:
        yield True
    finally:
        for array, before in kept:
            array[:] = before
