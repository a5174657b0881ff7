"""A homogeneous test of an incompressible material: its closed form, with exact derivatives, and its histories."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.contract import InfeasibleError, Reached
from calibration.forward.solves import Solves
from tissue_sim.closed_form.histories import LARGEST_STEP, HomogeneousHistory
from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import TestKind
from tissue_sim.laws import Law, find_law
from tissue_sim.material.material import Material
from tissue_sim.parameters import tokens
from tissue_sim.specimen import Specimen

#: Half width of a difference with a parameter of a history, in its size, and with the contact offset, in the height.
_RATE_WIDTH = 1e-6


@dataclass(frozen=True, eq=False)
class ClosedAnswer:
    """Parameters that `ClosedTest.evaluate` takes.

    Attributes:
        space: of the parameters. law, values: the strain energy and its parameters, shape (m,).
        free: places of the free parameters of the law in `values` and among the free ones.
        named: all parameters. recording: whose they are; None: those of all. material: None where only the law counts.
    """

    space: ParameterSpace
    law: Law
    values: np.ndarray
    free: list[tuple[int, int]]
    named: dict[str, float]
    recording: str | None
    material: Material | None


@dataclass(eq=False)
class ClosedTest:
    """Lubricated compression, tension or shear of an incompressible material.

    Attributes:
        name: of the test. kind: what it is; a plate feels nothing before it has arrived.
        height, area: m and m2. measured: the recordings.
        largest_step: of divided histories, see `HomogeneousHistory`. specimen: that weighs; None here.
    """

    name: str
    kind: TestKind
    height: float
    area: float
    measured: tuple[MeasuredCurve, ...]
    largest_step: float = LARGEST_STEP
    specimen: Specimen | None = None
    _histories: dict[int, HomogeneousHistory] = field(default_factory=dict, repr=False, init=False)

    proportional: ClassVar[bool] = True
    homogeneous: ClassVar[bool] = True
    mesh: ClassVar[str] = ""

    @property
    def timed(self) -> bool:
        return any(curve.segment is not None and np.unique(curve.segment).size > 1 for curve in self.measured)

    @property
    def radius(self) -> float:
        """Of a round specimen of this cross-section, m."""
        return float(np.sqrt(self.area / np.pi))

    @property
    def weightless(self) -> ClosedTest:
        """The test without self-weight."""
        return self

    @property
    def closed_form(self) -> ClosedForm:
        return self.kind.require_closed_form()

    def solve(self, space: ParameterSpace, theta: np.ndarray, solves: Solves) -> list[ClosedAnswer]:
        """As `ForwardTest.solve`; nothing is computed yet."""
        values, answers = space.values(theta), {}
        marks = [space.mark(self.name, curve.name) for curve in self.measured]
        for mark in marks:
            if mark not in answers:
                answers[mark] = self._answer(space, values, mark)
        return [answers[mark] for mark in marks]

    def _answer(self, space: ParameterSpace, values: dict[str, float], recording: str | None) -> ClosedAnswer:
        law = find_law(space.law)
        free = [(law.parameters.index(each.path), place) for place, each in enumerate(space.varied)
                if each.of_law and each.acts_in(self.name, recording)]
        material = None
        if set(space.names) != set(law.parameters):
            try:
                material = space.material(values, test=self.name, recording=recording)
            except InputError as error:
                raise InfeasibleError(f"{self.name}: {error}") from None
        numbers = values if material is None else material.parameters
        return ClosedAnswer(space, law, np.array([numbers[name] for name in law.parameters]), free, values, recording,
                            material if material is not None and material.remembers else None)

    def evaluate(self, answers: list[ClosedAnswer], recording: int, offset: float, contact: bool = True):
        """As `ForwardTest.evaluate`; without `contact` the derivative with the offset is None."""
        answer = answers[recording]
        force, rates, rate = self._elastic(answer, self.measured[recording].displacement - offset, contact) \
            if answer.material is None else self._remembering(answer, answer.material, recording, offset, contact)
        if not (np.isfinite(force).all() and np.isfinite(rates).all()):
            raise InfeasibleError(f"{self.name}: {answer.law.name} gives no finite stress")
        return force, rates, rate

    def differences(self, answers: list[ClosedAnswer]) -> frozenset[str]:
        """As `ForwardTest.differences`."""
        names: set[str] = set()
        for i, answer in enumerate(answers):
            if answer.material is not None:
                exact = self._exact_rates(answer, answer.material, i, 0.0)
                names |= {name for name in answer.space.free if name not in exact or name.endswith(".tau")}
        return frozenset(names)

    def _elastic(self, answer: ClosedAnswer, displacement: np.ndarray, contact: bool):
        """Force, its derivatives with the free parameters, and with the contact offset."""
        law, values, closed_form = answer.law, answer.values, self.closed_form
        strain = self.strain(displacement)
        # Wild trial values overflow; the optimiser turns back from what is not finite.
        with np.errstate(all="ignore"):
            stress = closed_form.stress(law, strain, values)
            derivatives = closed_form.derivatives(law, strain, values)
            slope = -self.kind.sign * closed_form.slope(law, strain, values) / self.height if contact else None
        if not self.kind.gripped:
            apart = self.kind.strain(strain) < 0.0
            stress[apart], derivatives[apart] = 0.0, 0.0
            if slope is not None:
                slope[apart] = 0.0
        return self._as_force(answer, stress, derivatives, slope)

    def _as_force(self, answer: ClosedAnswer, stress: np.ndarray, derivatives: np.ndarray, slope: np.ndarray | None):
        """Force and derivatives of nominal stress, its derivatives with the law's parameters and with the offset."""
        rates = np.zeros((stress.size, len(answer.space.free)))
        if answer.free:
            ours, theirs = zip(*answer.free, strict=True)
            rates[:, theirs] = derivatives[:, ours]
        factor = self.kind.sign * self.area
        return factor * stress, factor * rates, None if slope is None else factor * slope

    def _remembering(self, answer: ClosedAnswer, material: Material, recording: int, offset: float,
                     contact: bool):
        """As `_elastic`, of a history."""
        try:
            force = self._history_force(material, recording, offset)
        except InputError as error:
            raise InfeasibleError(f"{self.name}: {error}") from None
        rates = np.full((force.size, len(answer.space.free)), np.nan)
        exact = self._exact_rates(answer, material, recording, offset)
        for k, name in enumerate(answer.space.free):
            rates[:, k] = exact[name] if name in exact else self._difference(answer, recording, offset, k, force)
        if not contact:
            return force, rates, None
        width = _RATE_WIDTH * self.height
        later, earlier = (self._history_force(material, recording, offset + step) for step in (width, -width))
        return force, rates, (later - earlier) / (2 * width)

    def _exact_rates(self, answer: ClosedAnswer, material: Material, recording: int,
                     offset: float) -> dict[str, np.ndarray]:
        """Derivatives of P = (1 - sum g) elastic + sum g_i relaxing_i, which is linear in moduli and shares.

        None where more than a Prony series acts beside the law. Those with the times are central differences of
        `relaxing` alone; of exponents there are none.
        """
        prony = material.viscoelastic
        if prony is None or not self._divides or not answer.space.of_material_alone or material.effects or (
                material.softening is not None or material.poroelasticity is not None) or (
                material.instantaneous_factor != 1.0):
            return {}
        law, history = answer.law, self.history(recording, offset)
        count, factor = prony.tau.size, self.kind.sign * self.area
        step = _RATE_WIDTH * prony.tau
        rates = {}
        with np.errstate(all="ignore"):
            elastic, relaxing = history.parts(law, answer.values, np.concatenate([prony.tau, prony.tau + step,
                                                                                  prony.tau - step]))
            for unknown in answer.space.varied:
                name, path = unknown.name, tokens(unknown.path)
                if unknown.of_law and law.units[unknown.path] != "1":
                    alone = [float(other == unknown.path) if law.units[other] != "1" else value
                             for other, value in zip(law.parameters, answer.values.tolist(), strict=True)]
                    rates[name] = factor * history.nominal_stress(law, np.array(alone), prony)
                elif "terms" in path:
                    i = int(path[-2])
                    rates[name] = factor * (relaxing[:, i] - elastic) if path[-1] == "g" else \
                        factor * prony.g[i] * (relaxing[:, count + i] - relaxing[:, 2 * count + i]) / (2 * step[i])
        return rates

    def _difference(self, answer: ClosedAnswer, recording: int, offset: float, place: int,
                    force: np.ndarray) -> np.ndarray:
        """Derivative of a history's force with one free parameter."""
        space, values, name = answer.space, answer.named, answer.space.free[place]
        size, ends = float(space.sizes(values)[place]), []
        for step in (_RATE_WIDTH * size, -_RATE_WIDTH * size):
            try:
                material = space.material(values | {name: values[name] + step}, test=self.name,
                                          recording=answer.recording)
                ends.append((self._history_force(material, recording, offset), step))
            except InputError:
                # At the end of what a material may have: to one side.
                ends.append((force, 0.0))
        (more, high), (less, low) = ends
        return (more - less) / (high - low) if high > low else np.full(force.size, np.nan)

    def _history_force(self, material: Material, recording: int, offset: float) -> np.ndarray:
        measured, factor = self.measured[recording], self.kind.sign * self.area
        with np.errstate(all="ignore"):
            if not self._divides or material.effects:
                strain = self.strain(measured.displacement - offset)
                return factor * self.closed_form.history(material, measured.clock, strain, self.radius)
            return factor * self.history(recording, offset).nominal_stress(
                material.energy_law, material.values, material.relaxation(self.radius), material.softening,
                material.instantaneous_factor)

    @property
    def _divides(self) -> bool:
        """Whether its histories are those of `HomogeneousHistory`."""
        return type(self.closed_form) is ClosedForm and self.closed_form.law_mode in ("uniaxial", "simple_shear")

    def history(self, recording: int, offset: float = 0.0) -> HomogeneousHistory:
        """How a recording deformed the specimen."""
        if offset == 0.0 and recording in self._histories:
            return self._histories[recording]
        measured = self.measured[recording]
        mode: Literal["uniaxial", "simple_shear"] = "uniaxial" if self.closed_form.rest else "simple_shear"
        found = HomogeneousHistory(mode, measured.clock, self.strain(measured.displacement - offset), self.largest_step)
        if offset == 0.0:
            self._histories[recording] = found
        return found

    def strain(self, displacement: np.ndarray) -> np.ndarray:
        """Stretch, or shear strain."""
        return self.kind.abscissa(displacement / self.height)

    def refine(self, space: ParameterSpace, theta: np.ndarray, solves: Solves) -> float:
        """The closed form needs no correction."""
        return 0.0

    def forget(self) -> None:
        """There is none."""

    def reached(self, space: ParameterSpace, theta: np.ndarray) -> Reached:
        """As `ForwardTest.reached`."""
        strain = np.concatenate([self.strain(curve.displacement) for curve in self.measured])
        low, high, closed_form = float(strain.min()), float(strain.max()), self.closed_form
        if not closed_form.rest:
            return Reached(closed_form.mode, *closed_form.extremes(low, high), closed_form.extremes(low, high))
        low, high = min(low, 1.0), 1.0 if not self.kind.gripped else max(high, 1.0)
        return Reached(closed_form.mode, low, high, closed_form.extremes(low, high))
