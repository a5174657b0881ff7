"""What becomes of simulated forces at the samples of a recording, by effects in reduced form and a rig that reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.motion import Course
from calibration.forward.placed import PlacedCourse
from tissue_sim.material.effect import ReducedEffect
from tissue_sim.model import Model
from tissue_sim.parameters import with_values
from tissue_sim.recording.recording import Recording
from tissue_sim.rig.rig import Rig

#: Width of a difference with what a rig does to readings, relative.
_READING_WIDTH = 1e-6


def away(value: float) -> float:
    """Width of a difference with a number of the rig's readings, on which these depend almost linearly."""
    return _READING_WIDTH * (abs(value) or 1.0)


def only_read(rig: Rig, path: str, value: float) -> bool:
    """Whether a number of a rig, about this value, leaves the motion of the tool alone."""
    return with_values(rig, {path: value + away(value)}).motion_only == with_values(rig, {path: value}).motion_only


@dataclass(frozen=True, eq=False)
class Reading:
    """A rig as it reads forces."""

    rig: Rig

    @cached_property
    def reading(self) -> Rig | None:
        """What of it reads forces; None where it reads them as they are."""
        reading = self.rig.reading_only
        return None if reading.ideal else reading

    def read(self, measured: MeasuredCurve, force: np.ndarray) -> np.ndarray:
        """What it makes of forces at the samples of a recording."""
        if self.reading is None:
            return force
        channels = {"displacement": measured.displacement, "force": force}
        if measured.time is not None:
            channels["time"] = measured.time
        return self.reading.read(Recording(channels)).force

    def through(self, measured: MeasuredCurve, true: np.ndarray, read: np.ndarray, rates: np.ndarray,
                rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What derivatives of the true force, shape (n, p) and (n,), are of the force that is read."""
        if not any(fault.reads for fault in self.rig.faults.values()):
            gain = 1.0 + self.rig.sensor_gain
            return gain * rates, gain * rate
        # An added fault may be anything that takes a course of forces.
        columns = np.column_stack([rates, rate])
        for place, column in enumerate(columns.T):
            if column.any():
                width = 1e-6 * max(float(np.abs(true).max()), 1e-6) / np.abs(column).max()
                columns[:, place] = (self.read(measured, true + width * column) - read) / width
        return columns[:, :-1], columns[:, -1]


@dataclass(frozen=True, eq=False)
class Left:
    """What effects in reduced form leave of the simulated force: theirs are jumps, which knots would smear.

    Attributes:
        effects: those that act.
    """

    effects: tuple[ReducedEffect, ...]

    @classmethod
    def of(cls, model: Model) -> Left:
        """Those of a model whose tool goes where the stage says, upright; of others the simulation takes care."""
        straight = not model.experiment.tilt and model.rig.motion_only.ideal
        return cls(model.material.reduced_effects(plate=model.experiment.tool.is_plate) if straight else ())

    def owns(self, path: str) -> bool:
        """Whether a number of the material is one of theirs."""
        place = path.rpartition(".")[0]
        return any(place in (effect.name, f"effects.{effect.name}") for effect in self.effects)

    def simulated(self, model: Model) -> Model:
        """The model without them."""
        material = model.material
        if not self.effects:
            return model
        kept = {name: effect for name, effect in material.effects.items() if effect not in self.effects}
        puncture = None if material.puncture in self.effects else material.puncture
        return replace(model, material=replace(material, puncture=puncture, effects=kept))

    def share(self, measured: MeasuredCurve, depth: np.ndarray) -> np.ndarray:
        """Of the force at the samples of a recording where the tool is at these depths, m, shape (n,) or (n, k)."""
        deepest = np.maximum.accumulate(depth, axis=0)
        clock = np.zeros(depth.shape[0]) if measured.time is None else measured.time - measured.time[0]
        time = np.broadcast_to(clock.reshape(-1, *[1] * (depth.ndim - 1)), depth.shape)
        share = np.ones(depth.shape)
        for effect in self.effects:
            share = share * effect.shares(depth, deepest, time)
        return share


def depth_in_tissue(course: Course | PlacedCourse, measured: MeasuredCurve, offset: float | np.ndarray) -> np.ndarray:
    """Where the tool is in the tissue at the samples of a recording, m, shape (n,) or (n, offsets).

    Args:
        course: of its force. measured: the recording. offset: of its contact, m, one or shape (offsets,).
    """
    if isinstance(course, PlacedCourse):
        return course.place(offset)
    return measured.displacement - offset if np.ndim(offset) == 0 else measured.displacement[:, None] - offset


@dataclass(frozen=True, eq=False)
class SimulatedAnswer:
    """Simulated forces.

    Attributes:
        courses: of force and derivatives, of each recording. rigs: that each was read with. left: of each.
        space, values: the parameters that they belong to.
        differences: names whose derivatives are differences.
    """

    courses: Sequence[Course | PlacedCourse]
    rigs: list[Reading]
    left: list[Left]
    space: ParameterSpace
    values: dict[str, float]
    differences: frozenset[str]
