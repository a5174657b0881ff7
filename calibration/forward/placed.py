"""A test whose force depends on the tool's place alone: one loading, and where a rig takes the tool at each sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from calibration.forward.contract import InfeasibleError
from calibration.forward.motion import SLIDING_POWER, TIMED_STEPS, Loading, spline
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.protocol import STUDY_SPEED
from tissue_sim.model import Model
from tissue_sim.rig.rig import Rig
from tissue_sim.tilt import strips

#: Steps to the largest depth that is reported, those of a motion in time; a tool that goes deeper goes on likewise.
STEPS = TIMED_STEPS
#: A tool within this share of the last step is there.
_REACHED = 1e-3
#: Where a load train gives way the tool is found to this part of the largest depth, in so many steps.
_PLACED, _MOST_STEPS = 1e-12, 60
#: It grows by at least this share of the stage's way, or the load train snaps.
_SLOWEST = 0.1


def loading_to(depth: float, deepest: float, most: float) -> Loading:
    """Knots from rest to where the tool goes.

    Args:
        depth: that is reported, m. deepest: that the tool comes to, m. most: depth that no knot goes beyond, m.
    """
    share = (max(deepest, depth) / depth) ** (1.0 / SLIDING_POWER)
    steps = max(STEPS, int(np.ceil(STEPS * share - _REACHED)))
    knots = depth * (np.arange(steps + 1) / STEPS) ** SLIDING_POWER
    return Loading(np.append(knots[knots < most], most) if knots[-1] > most else knots, STUDY_SPEED)


@dataclass(frozen=True, eq=False)
class PlaceCurve:
    """Force, and what else belongs to it, as a function of the tool's place.

    Attributes:
        columns: the force first, and `force` alone, as functions of the place. end: that was simulated to, m.
        holds: whether a tool that goes back past its touch pulls; else it leaves the tissue.
        strips: of the tool's face: how far each is behind, m, and its share of the face.
    """

    columns: Any
    force_alone: Any
    end: float
    holds: bool
    strips: list[tuple[float, float]]

    @classmethod
    def through(cls, depth: np.ndarray, columns: np.ndarray, *, holds: bool, tilt: float = 0.0) -> PlaceCurve:
        """From values at knots.

        Args:
            depth: of the knots, from 0, m, shape (k,). columns: at the knots, the force first, shape (k, m).
            holds: see `PlaceCurve`. tilt: of the tool's face, m.
        """
        return cls(spline(depth, columns), spline(depth, columns[:, 0]), float(depth[-1]), holds, _strips(tilt))

    def with_tilt(self, tilt: float) -> PlaceCurve:
        """The same with another tilt, m."""
        return replace(self, strips=_strips(tilt))

    def __call__(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns at places, m, shape (n, m), and the derivative of the force with the place, shape (n,)."""
        columns, slope = np.zeros(()), np.zeros(())
        for lag, share in self.strips:
            there, moves = _behind(place, lag)
            known, felt = self._known(there)
            rates = self._rates(known) * felt[:, None]
            columns = columns + share * (self.columns(known) * felt[:, None] + rates * (there - known)[:, None])
            slope = slope + share * moves * rates[:, 0]
        return columns, slope

    @cached_property
    def _rates(self) -> Any:
        return self.columns.derivative()

    def force(self, place: np.ndarray) -> np.ndarray:
        """Force at places, m, any shape."""
        force = np.zeros(place.shape)
        for lag, share in self.strips:
            there, _ = _behind(place, lag)
            known, felt = self._known(there)
            beyond = there - known
            part = self.force_alone(known)
            if beyond.any():
                part = part + self.force_alone(known, 1) * beyond
            force += share * felt * part
        return force

    def _known(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The nearest place that was simulated, from which the curve goes on straight, and whether tissue is felt."""
        return np.clip(place, 0.0, self.end), np.ones(place.shape) if self.holds else (place >= 0.0).astype(float)


def _strips(tilt: float) -> list[tuple[float, float]]:
    return strips(tilt) if tilt else [(0.0, 1.0)]


def _behind(place: np.ndarray, lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Where a strip of a face that leans is, and how it moves with the face."""
    if not lag:
        return place, np.ones(place.shape)
    inside = np.maximum(place - lag, 0.0)
    return np.where(place > 0, inside, place), ((inside > 0) | (place <= 0)).astype(float)


@dataclass(frozen=True, eq=False)
class PlacedCourse:
    """Force along a recording, from where a rig takes its tool.

    Attributes:
        curve: force against place. motion: of the tool with a rigid load train at the samples, m, shape (n,).
        compliance: of the load train, m/N.
        neighbours: column -> the course with a little more of the number that it belongs to, and how much more.
    """

    curve: PlaceCurve
    motion: np.ndarray
    compliance: float
    neighbours: Mapping[int, tuple[PlacedCourse, float]] = field(default_factory=dict)

    def __call__(self, time: np.ndarray | None, displacement: np.ndarray,
                 offset: float) -> tuple[np.ndarray, np.ndarray]:
        """As those of `calibration.forward.motion`, at the samples of the recording."""
        place = self.place(offset)
        columns, slope = self.curve(place)
        growth = 1.0 + self.compliance * slope
        if growth.min(initial=1.0) < _SLOWEST:
            raise InfeasibleError("the force falls so steeply that the load train snaps")
        columns[:, 1:] /= growth[:, None]
        rate = -slope / growth
        away = ~np.maximum.accumulate(place >= 0.0)
        # Nothing is felt before the first touch.
        columns[away], rate[away] = 0.0, 0.0
        for number, (other, width) in self.neighbours.items():
            columns[:, number] = (other.forces(time, displacement, np.array([offset]))[:, 0] - columns[:, 0]) / width
        return columns, rate

    def forces(self, time: np.ndarray | None, displacement: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """The force at these contact offsets, m, shape (n, offsets)."""
        place = self.place(offsets)
        return np.where(np.maximum.accumulate(place >= 0.0, axis=0), self.curve.force(place), 0.0)

    def place(self, offset: float | np.ndarray) -> np.ndarray:
        """Where the tool is at the samples, m, shape (n,) or (n, offsets).

        Raises:
            InfeasibleError: the force falls so steeply that the load train snaps.
        """
        goal = self.motion - offset if np.ndim(offset) == 0 else self.motion[:, None] - offset
        if not self.compliance:
            return goal
        place, reached = goal, _PLACED * np.abs(goal).max(initial=1e-6)
        width = 1e-6 * np.abs(goal).max(initial=1e-6)
        for _ in range(_MOST_STEPS):
            force = self.curve.force(place)
            stiffness = (self.curve.force(place + width) - force) / width
            change = (goal - place - self.compliance * force) / np.maximum(1.0 + self.compliance * stiffness, _SLOWEST)
            place = place + change
            if np.abs(change).max(initial=0.0) <= reached:
                return place
        raise InfeasibleError("the tool is nowhere in balance with the load train")


def needs_way(model: Model) -> bool:
    """Whether the force has to be simulated along the way of the tool."""
    reduced = model.material.reduced_effects(plate=model.experiment.tool.is_plate)
    return model.is_path_dependent or bool(reduced and (model.rig.compliance or model.experiment.tilt))


def leaves(experiment: Experiment) -> bool:
    """Whether nothing pulls at a tool that goes back past its touch."""
    return experiment.friction != "bonded" and experiment.adhesion is None and not experiment.contact_laws


def is_of_course(path: str) -> bool:
    """Whether a number says where the parts of the tool are, and not how the tissue answers them."""
    return path.startswith("rig.") or path == "experiment.tilt"


def at_stage(model: Model) -> Model:
    """The model with the tool where the stage says, and upright."""
    return replace(model, experiment=replace(model.experiment, tilt=0.0), rig=Rig())
