"""Effects of the tissue at the quadrature points: their numbers and memory, whatever the elements are."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain

import numpy as np

from tissue_sim.errors import InputError, located
from tissue_sim.fem.taichi.trace import TRIED, Formula, traced
from tissue_sim.material.effect import PointEffect, TissueEffect

#: The longest step that a formula sees, s: kernels know no infinity.
LONGEST = 1e30


class PointEffects:
    """The arrays of all such effects of a material that a step's kernel works on.

    Attributes:
        formulas: of the effects, in order.
        settings: the time step, s, then the parameters of all effects.
        states: state variables of all effects at the last committed step, then their stress, a second Piola-Kirchhoff
            stress (RR, RZ, ZZ, hoop), Pa, shape (elements, q, variables + 4); found: in the step now.
    """

    def __init__(self, points: tuple[int, int]):
        self._points = points
        self.formulas: tuple[Formula[PointEffect], ...] = ()
        self.settings = np.zeros(1)
        self._allocate(())

    def _allocate(self, rest: tuple[float, ...]) -> None:
        # Without effects nobody looks at them.
        shape = (*self._points, len(rest) + 4) if self.formulas else (1, 1, 1)
        self.states = np.zeros(shape)
        self.states[..., : len(rest)] = rest
        self.found = self.states.copy()

    def set_effects(self, effects: Iterable[TissueEffect]) -> None:
        """Take over the effects of a material; the memory is kept where they are of the same make.

        Raises:
            InputError: a formula that no kernel can take over, or one that gives something else than it should.
        """
        points = [effect for effect in effects if isinstance(effect, PointEffect)]
        formulas = tuple(Formula.of(effect) for effect in points)
        if formulas != self.formulas:
            for formula in formulas:
                require_formula(formula)
            self.formulas = formulas
            self._allocate(tuple(value for effect in points for value in effect.rest))
        numbers = (formula.numbers(effect) for formula, effect in zip(formulas, points, strict=True))
        settings = np.array([0.0, *chain.from_iterable(numbers)])
        if settings.shape == self.settings.shape:
            self.settings[:] = settings  # where the kernel knows it
        else:
            self.settings = settings

    def prepare(self, dt: float) -> None:
        """Before a step of `dt`, s."""
        self.settings[0] = min(dt, LONGEST)

    def commit(self) -> None:
        """After a step that converged."""
        if self.formulas:
            self.states[:] = self.found

    @property
    def stress(self) -> np.ndarray:
        """Of all effects together at the last committed step, Pa, shape (elements, q, 4)."""
        return self.states[..., -4:]


def require_formula(formula: Formula[PointEffect]) -> None:
    """Run a formula once without a kernel.

    Raises:
        InputError: it does what a kernel cannot, or answers in another shape.
    """
    kind, field = formula.kind, f"effects.{formula.kind.name}"
    parameters = traced([TRIED] * len(formula.parameters), lanes=False)
    C, state, (dt,) = traced([TRIED] * 6, True), traced([TRIED] * len(kind.rest), True), traced([TRIED], False)
    with located(field=field):
        stress, tangent, found = formula.bind(parameters).response(C, state, dt)
    shape = len(stress), len(tangent), {len(row) for row in tangent}, len(found)
    if shape != (6, 6, {6}, len(kind.rest)):
        raise InputError(f"the response of {kind.__name__} has {len(stress)} stresses, {len(tangent)} rows of tangent "
                         f"and {len(found)} state variables; give 6, 6 rows of 6, and as many as in `rest`, "
                         f"{len(kind.rest)}", field=field)
