"""A test that the finite elements simulate at a few points of its motion."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.parameters import ParameterSpace
from calibration.forward.contract import InfeasibleError, Reached
from calibration.forward.motion import Course, Loading, Timed
from calibration.forward.solves import SimulatedCurve, Solves, content_key
from tissue_sim.closed_form.homogeneous import UNIAXIAL, ClosedForm
from tissue_sim.differentiation import sensitivities
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.model import Model
from tissue_sim.recording.recording import Recording
from tissue_sim.rig.rig import Rig
from tissue_sim.simulation import simulate
from tissue_sim.specimen import Specimen

#: Shares of the volume that are stretched less, or more, than what counts as the range of the data.
_TAIL = 0.01


@dataclass(eq=False)
class SimulatedTest:
    """A test that the finite elements simulate, on one mesh.

    Attributes:
        name: of the test.
        experiment: what is done to what, with any motion. rig: it is measured with.
        motions: each a `Loading` or `Timed`. motion_of: number of the motion of each recording.
        measured: the recordings.
        layered: whether the material has layers.
        correction: what the accurate mesh has more, N, of each motion, shape (k,); empty until `refine` finds out.
    """

    name: str
    experiment: Experiment
    rig: Rig
    motions: tuple[Loading | Timed, ...]
    motion_of: tuple[int, ...]
    measured: tuple[MeasuredCurve, ...]
    layered: bool = False
    correction: list[np.ndarray] = field(default_factory=list)

    #: What it is where it is homogeneous.
    closed_form: ClassVar[ClosedForm] = UNIAXIAL
    sign: ClassVar[float] = -1.0
    area: ClassVar[float | None] = None

    @property
    def timed(self) -> bool:
        return isinstance(self.motions[0], Timed)

    @property
    def specimen(self) -> Specimen:
        return self.experiment.specimen

    @property
    def proportional(self) -> bool:
        """Whether force is proportional to the moduli: no weight and nothing elastic beside the tissue."""
        return not self.specimen.specific_weight and not self.rig.compliance

    @property
    def homogeneous(self) -> bool:
        """Whether every mesh is exact."""
        return not self.layered and self._experiment(self.motions[0]).homogeneous

    @property
    def height(self) -> float:
        """Of the specimen, m."""
        return self.specimen.height

    def solve(self, space: ParameterSpace, theta: np.ndarray, solves: Solves) -> list[Course]:
        """The course of force and derivatives, (n, 1 + p), along each motion, with the correction.

        Raises:
            InfeasibleError: no such material, or no convergence.
        """
        values = space.values(theta)
        answer = []
        for number, motion in enumerate(self.motions):
            force, rates = self._simulated(space, values, solves, motion, "fast")
            if self.correction:
                force = force + self.correction[number]
            answer.append(motion.through(np.column_stack([force, rates])))
        return answer

    def refine(self, space: ParameterSpace, theta: np.ndarray, solves: Solves) -> float:
        """Compute what the accurate mesh has more at these parameters, and keep it as the correction.

        Returns:
            The largest difference of the two meshes, relative to the largest force.

        Raises:
            InfeasibleError: the accurate mesh does not get through.
        """
        values, found, largest = space.values(theta), [], 0.0
        for motion in () if self.homogeneous else self.motions:
            fast, _ = self._simulated(space, values, solves, motion, "fast")
            accurate = self._accurate(space, values, solves, motion)
            found.append(accurate - fast)
            largest = max(largest, float(np.abs(found[-1]).max() / np.abs(accurate).max()))
        self.correction = found
        return largest

    def _accurate(self, space: ParameterSpace, values: dict[str, float], solves: Solves,
                  motion: Loading | Timed) -> np.ndarray:
        """Force of the accurate mesh at the knots, shape (k,).

        Under friction the fast mesh needs short steps at the touch, and the accurate one gets through more often by
        even ones: what one spacing does not reach the other may.
        """
        first, second = (motion.even, motion) if isinstance(motion, Timed) else (motion, motion.even)
        try:
            way, (force, _) = first, self._simulated(space, values, solves, first, "accurate")
        except InfeasibleError:
            way, (force, _) = second, self._simulated(space, values, solves, second, "accurate")
        return force if way is motion else motion.at_knots(way.through(force[:, None]))[:, 0]

    def _simulated(self, space: ParameterSpace, values: dict[str, float], solves: Solves, motion: Loading | Timed,
                   resolution: str) -> tuple[np.ndarray, np.ndarray]:
        """Force, shape (k,), and derivatives with the free parameters, shape (k, p); none of the accurate mesh."""
        factor = 1.0
        if self.proportional:
            values, factor = space.normalised(values)
        names: Sequence[str] = () if resolution == "accurate" else space.free
        experiment = self._experiment(motion)
        key = content_key(experiment, self.rig.motion_only, space.law, values, space.bulk, list(names), resolution)
        curve = solves.find(key)
        if curve is None:
            curve = _simulate(space, values, experiment, self.rig.motion_only, names, resolution)
            solves.count(self.name, resolution)
            solves.keep(key, curve)
        if curve.problem:
            raise InfeasibleError(f"{self.name}: {curve.problem}")
        force = factor * np.array(curve.force)
        scale = np.array([1.0 if self.proportional and space.is_modulus(name) else factor for name in names])
        return force, np.array(curve.rates).reshape(force.size, len(names)) * scale

    def evaluate(self, answer: list[Course], recording: int, offset: float):
        """Force (n,), derivatives (n, p) and derivative with the contact offset (n,) at the samples of a recording."""
        measured, number = self.measured[recording], self.motion_of[recording]
        motion, time = self.motions[number], measured.time
        if isinstance(motion, Timed):
            # Motions that count as one may have begun at different times of their clocks.
            time = time - measured.time[0] + motion.sampled_from
        values, rate = answer[number](time, measured.displacement, offset)
        force, gain = values[:, 0], 1.0 + self.rig.sensor_gain
        if self.rig.latency:
            columns = np.column_stack([values, rate])
            late = np.column_stack([np.interp(measured.time - self.rig.latency, measured.time, column)
                                    for column in columns.T])
            values, rate = late[:, :-1], late[:, -1]
        if self.reading is not None:
            channels = {"displacement": measured.displacement, "force": force}
            if measured.time is not None:
                channels["time"] = measured.time
            force = self.reading.read(Recording(channels)).force
        return force, gain * values[:, 1:], gain * rate

    def scan(self, answer: list[Course], recording: int, offsets: np.ndarray) -> np.ndarray:
        """Force at the samples of a recording for these contact offsets, m, shape (n, offsets)."""
        if self.reading is not None or self.rig.latency:
            return np.column_stack([self.evaluate(answer, recording, offset)[0] for offset in offsets])
        measured, number = self.measured[recording], self.motion_of[recording]
        motion, time = self.motions[number], measured.time
        if isinstance(motion, Timed):
            time = time - measured.time[0] + motion.sampled_from
        return answer[number].forces(time, measured.displacement, offsets)

    @cached_property
    def reading(self) -> Rig | None:
        """The rig as far as it reads forces; None where it reads them as they are."""
        rig = self.rig.reading_only
        return None if rig.ideal else rig

    def reached(self, space: ParameterSpace, theta: np.ndarray) -> Reached:
        """Of the volume, without a hundredth at either end."""
        deepest = max(float(curve.displacement.max()) for curve in self.measured)
        if self.homogeneous:
            low = 1 - deepest / self.height
            return Reached(self.closed_form.mode, low, 1.0, self.closed_form.extremes(low, 1.0))
        points = max(3, self.motions[0].protocol.time.size // 2)
        experiment = replace(self.experiment, protocol=Protocol.ramp(deepest, points))
        try:
            fields = simulate(Model(experiment, space.material(space.values(theta))), fields=True).fields
        except (ConvergenceError, InputError):
            return _of_volume(1 - deepest / self.height, 1.0)
        F = fields.deformation_gradient()
        plane = np.linalg.svd(F[..., :4].reshape(*F.shape[:-1], 2, 2), compute_uv=False)
        principal = np.concatenate([plane, F[..., 4:]], axis=-1)
        return _of_volume(_quantile(principal.min(axis=-1), fields.weights, _TAIL),
                          _quantile(principal.max(axis=-1), fields.weights, 1 - _TAIL))

    def _experiment(self, motion: Loading | Timed) -> Experiment:
        return replace(self.experiment, protocol=motion.protocol)


def _simulate(space: ParameterSpace, values: dict[str, float], experiment: Experiment, rig: Rig,
              names: Sequence[str], resolution: str) -> SimulatedCurve:
    began = clock.process_time()
    try:
        model = Model(experiment, space.material(values), rig)
        if names:
            answer = sensitivities(model, names, resolution=resolution)
            force, rates = answer.recording.force, answer.values
        else:
            force, rates = simulate(model, resolution=resolution).force, np.zeros((0, 0))
    except (ConvergenceError, InputError) as error:
        return SimulatedCurve([], [], str(error), clock.process_time() - began)
    return SimulatedCurve(force.tolist(), rates.tolist(), "", clock.process_time() - began)


def _of_volume(low: float, high: float) -> Reached:
    return Reached(None, low, high, (low, high))


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    order = np.argsort(values, axis=None)
    total = np.cumsum(weights.ravel()[order])
    return float(values.ravel()[order][np.searchsorted(total, share * total[-1])])
