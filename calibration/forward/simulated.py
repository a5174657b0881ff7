"""A test that the finite elements simulate at a few points of its motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace, Unknown
from calibration.forward.contract import InfeasibleError, Reached
from calibration.forward.meshes import MeshError, meshes_of
from calibration.forward.motion import Course, Loading, Timed, spline
from calibration.forward.placed import PlaceCurve, PlacedCourse, at_stage, is_of_course, leaves, loading_to, needs_way
from calibration.forward.proportion import in_proportion, keeps_proportion
from calibration.forward.reached import reached_at, reached_in
from calibration.forward.reading import Left, Reading, SimulatedAnswer, away, depth_in_tissue, only_read
from calibration.forward.solves import Solves, content_key, simulate_curve
from tissue_sim.closed_form.homogeneous import UNIAXIAL, ClosedForm
from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.model import Model
from tissue_sim.parameters import with_values
from tissue_sim.rig.rig import Rig
from tissue_sim.specimen import Specimen

#: A motion that goes back past its touch by this share of its depth pulls at a bonded face.
_PULLS = 0.02


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
        placed_correction: the same at the knots of one loading: their depth, m, and the force, N, shapes (k,).
        mesh: what it is known by; tests whose meshes have one name have one error of it. Empty: it has its own.
        along: whether the whole motion is simulated even where the force depends on the tool's place alone.
        solver: name of what simulates it.
        mesh_error: what the accurate mesh errs by, where that has been found.
    """

    name: str
    experiment: Experiment
    rig: Rig
    motions: tuple[Loading | Timed, ...]
    motion_of: tuple[int, ...]
    measured: tuple[MeasuredCurve, ...]
    layered: bool = False
    correction: list[np.ndarray] = field(default_factory=list)
    placed_correction: tuple[np.ndarray, np.ndarray] | None = None
    mesh: str = ""
    along: bool = False
    solver: str = "axisymmetric"
    mesh_error: MeshError | None = None

    #: What it is where it is homogeneous.
    closed_form: ClassVar[ClosedForm] = UNIAXIAL
    area: ClassVar[float | None] = None

    @property
    def timed(self) -> bool:
        return isinstance(self.motions[0], Timed)

    @property
    def _timed_motions(self) -> tuple[Timed, ...]:
        return tuple(motion for motion in self.motions if isinstance(motion, Timed))

    @property
    def specimen(self) -> Specimen:
        return self.experiment.specimen

    @property
    def proportional(self) -> bool:
        return in_proportion(self.experiment, self.rig)

    @property
    def homogeneous(self) -> bool:
        """Whether every mesh is exact."""
        return not self.layered and self._experiment(self.motions[0]).homogeneous

    def solve(self, space: ParameterSpace, theta: np.ndarray, solves: Solves) -> SimulatedAnswer:
        """As `ForwardTest.solve`: the course of force and derivatives along each motion, with the correction.

        Where the force depends on the place of the tool alone, one loading gives it everywhere, and a rig takes the
        tool there without a simulation.
        """
        values = space.values(theta)
        models = [self._possible(space, values, self.motions[number], measured.name)
                  for measured, number in zip(self.measured, self.motion_of, strict=False)]
        courses: Sequence[Course | PlacedCourse]
        if self._needs_way(models):
            courses, differences = self._along_way(space, values, solves, models)
            left = [Left.of(model) for model in models]
        else:
            courses, differences = self._by_place(space, values, solves, models)
            left = [Left(model.material.reduced_effects(plate=model.experiment.tool.is_plate)) for model in models]
        differences |= {each.name for each in space.varied if self._reads(each, values)
                        or any(one.owns(each.path) for one in left)}
        return SimulatedAnswer(courses, [Reading(model.rig) for model in models], left, space, values,
                               frozenset(differences))

    def placed(self, space: ParameterSpace, theta: np.ndarray) -> bool:
        """Whether the force is looked up at the tool's place, and not simulated along its way.

        Raises:
            InfeasibleError: no such model.
        """
        values = space.values(theta)
        return not self._needs_way([self._possible(space, values, self.motions[number], measured.name)
                                    for measured, number in zip(self.measured, self.motion_of, strict=False)])

    def _needs_way(self, models: Sequence[Model]) -> bool:
        """Whether forces of these models have to be simulated along the whole motion."""
        if self.along or not self.timed or (self.correction and self.placed_correction is None):
            return True
        # How a bonded face pulls is no continuation of how it presses.
        ways = [motion.displacement[int(np.argmax(motion.displacement >= 0)):] for motion in self._timed_motions]
        pulls = min(float(way.min()) for way in ways) < -_PULLS * max(float(way.max()) for way in ways)
        return (pulls and not leaves(self.experiment)) or any(map(needs_way, models))

    def _along_way(self, space: ParameterSpace, values: dict[str, float], solves: Solves, models: Sequence[Model]
                   ) -> tuple[list[Course], set[str]]:
        """Courses from simulations of each motion, and names whose derivatives are differences."""
        courses: dict[tuple[int, str | None], Course] = {}
        chosen, differences = [], set()
        for measured, number, model in zip(self.measured, self.motion_of, models, strict=False):
            key = number, space.mark(self.name, measured.name)
            if key not in courses:
                motion = self.motions[number]
                force, rates, inexact = self._simulated(space, values, solves, motion, "fast", key[1])
                differences |= inexact
                if self.correction:
                    force = force + self.correction[number]
                columns = np.column_stack([force, rates])
                courses[key] = motion.through(columns, place=model.rig.tool_motion(motion.displacement),
                                              leaves=leaves(self.experiment)) \
                    if isinstance(motion, Timed) else motion.through(columns)
            chosen.append(courses[key])
        return chosen, differences

    def _by_place(self, space: ParameterSpace, values: dict[str, float], solves: Solves, models: Sequence[Model]
                  ) -> tuple[list[PlacedCourse], set[str]]:
        """The same from one loading, which is simulated with a rigid rig."""
        curves: dict[str | None, PlaceCurve] = {}
        courses, differences = [], set()
        for recording, (measured, number, model) in enumerate(zip(self.measured, self.motion_of, models, strict=False)):
            mark = space.mark(self.name, measured.name)
            course = partial(self._course, recording)
            if mark not in curves:
                loading = self._loading(model.rig)
                force, rates, inexact = self._simulated(space, values, solves, loading, "fast", mark, rigid=True)
                differences |= inexact
                curves[mark] = PlaceCurve.through(
                    loading.depth, np.column_stack([force + self._correction_at(loading), rates]),
                    holds=not leaves(model.experiment))
            neighbours = {}
            for place, each in enumerate(space.varied, start=1):
                if is_of_course(each.path) and each.acts_in(self.name, measured.name) and not self._reads(each, values):
                    width = away(values[each.name])
                    more = self._possible(space, values | {each.name: values[each.name] + width},
                                          self.motions[number], measured.name)
                    neighbours[place] = course(curves[mark], more), width
                    differences.add(each.name)
            courses.append(replace(course(curves[mark], model), neighbours=neighbours))
        return courses, differences

    def _course(self, recording: int, curve: PlaceCurve, model: Model) -> PlacedCourse:
        """What a rig and a face that leans make of a curve at the samples of a recording."""
        motion, measured = self._timed_motions[self.motion_of[recording]], self.measured[recording]
        tilt, time = model.experiment.tilt, measured.clock - measured.clock[0] + motion.sampled_from
        # What remembers its way (backlash, lost steps) must not take the trembling of the samples for one.
        straight = np.interp(time, motion.time, motion.displacement)
        place = model.rig.tool_motion(straight) + measured.displacement - straight
        return PlacedCourse(curve.with_tilt(tilt) if tilt else curve, place, model.rig.compliance)

    def _loading(self, rig: Rig) -> Loading:
        """One way in, as deep as a rig takes the tool in any of the motions.

        Raises:
            InfeasibleError: it never goes in.
        """
        ways = [motion.displacement for motion in self._timed_motions]
        # What a load train that is known takes of the way; a tenth in reserve.
        yields = 0.9 * self.rig.compliance * max(0.0, *(float(curve.force.max()) for curve in self.measured))
        depth = max(float(way.max()) for way in ways) - yields
        deepest = max(float(rig.tool_motion(way).max()) for way in ways) - yields
        if not depth > 0:
            raise InfeasibleError(f"{self.name}: the tool never goes in")
        return loading_to(depth, deepest, 0.999 * self.experiment.thickness)

    def _correction_at(self, loading: Loading) -> np.ndarray:
        """What the accurate mesh has more at the knots of a loading, N, shape (k,)."""
        if self.placed_correction is None:
            return np.zeros(loading.depth.size)
        depth, force = self.placed_correction
        return spline(depth, force)(np.minimum(loading.depth, depth[-1]))

    def refine(self, space: ParameterSpace, theta: np.ndarray, solves: Solves) -> float:
        """Compute what the accurate mesh has more at these parameters, and keep it as the correction.

        Returns:
            The largest difference of the two meshes, relative to the largest force.

        Raises:
            InfeasibleError: the accurate mesh does not get through.
        """
        values, found, largest = space.values(theta), [], 0.0
        if self.homogeneous:
            self.forget()
            return 0.0
        rigid = self.placed(space, theta)
        loading = self._loading(Rig()) if rigid else None
        for way in self.motions if loading is None else (loading,):
            fast, *_ = self._simulated(space, values, solves, way, "fast", rigid=rigid)
            accurate = self._accurate(space, values, solves, way, rigid=rigid)
            if isinstance(way, Loading) and not self.experiment.is_path_dependent:
                self._find_mesh_error(space, values, solves, way, accurate, rigid=rigid)
            if self.mesh_error is not None:
                accurate = accurate * self.mesh_error.factor(way.protocol.displacement)
            found.append(accurate - fast)
            largest = max(largest, float(np.abs(found[-1]).max() / np.abs(accurate).max()))
        self.correction, self.placed_correction = found, None
        if loading is not None:
            self.placed_correction = loading.depth, found[0]
            along = spline(*self.placed_correction)
            self.correction = [along(np.clip(motion.displacement, 0.0, loading.depth[-1]))
                               for motion in self._timed_motions]
        return largest

    def _find_mesh_error(self, space: ParameterSpace, values: dict[str, float], solves: Solves, way: Loading,
                         accurate: np.ndarray, *, rigid: bool) -> None:
        """Hold the accurate mesh's force at the knots, shape (k,), against the finest one's, where nobody did."""
        meshes = meshes_of(self.solver)
        if self.mesh_error is not None or not meshes.shows_error(self.experiment):
            return
        fewer, kept = way.with_fewer_steps() if meshes.slow else (way, np.arange(way.depth.size))
        try:
            finest, *_ = self._simulated(space, values, solves, fewer, "finest", rigid=rigid)
            self.mesh_error = MeshError.between(fewer.depth, accurate[kept], finest)
        except InfeasibleError:
            self.mesh_error = MeshError.unknown()

    def forget(self) -> None:
        self.correction, self.placed_correction = [], None

    def _accurate(self, space: ParameterSpace, values: dict[str, float], solves: Solves,
                  motion: Loading | Timed, *, rigid: bool) -> np.ndarray:
        """Force of the accurate mesh at the knots, shape (k,).

        Under friction the fast mesh needs short steps at the touch, and the accurate one gets through more often by
        even ones: what one spacing does not reach the other may.
        """
        first, second = (motion.even, motion) if isinstance(motion, Timed) else (motion, motion.even)
        try:
            way, (force, *_) = first, self._simulated(space, values, solves, first, "accurate", rigid=rigid)
        except InfeasibleError:
            way, (force, *_) = second, self._simulated(space, values, solves, second, "accurate", rigid=rigid)
        return force if way is motion else motion.at_knots(way.through(force[:, None]))[:, 0]

    def _simulated(self, space: ParameterSpace, values: dict[str, float], solves: Solves, motion: Loading | Timed,
                   resolution: str, recording: str | None = None, *, rigid: bool = False
                   ) -> tuple[np.ndarray, np.ndarray, set[str]]:
        """Force, shape (k,), derivatives with the free parameters, shape (k, p), of the fast mesh alone, and the
        names of those that are differences; of a `rigid` rig the tool is where the motion says, and upright."""
        factor, proportional = 1.0, in_proportion(self.experiment, Rig() if rigid else self.rig) and all(
            keeps_proportion(each, rigid=rigid) or self._reads(each, values) for each in space.unknowns
            if each.is_modulus or each.acts_in(self.name, recording))
        if proportional:
            values, factor = space.normalised(values)
        def made(of: dict[str, float]) -> Model:
            # The rig only moves the tool here.
            model = self._possible(space, of, motion, recording)
            return at_stage(model) if rigid else replace(model, rig=model.rig.motion_only)

        model = made(values)
        topology = made(space.before_moving(values)) if space.shapes_mesh(self.name) else None
        left = Left.of(model)
        model, topology = left.simulated(model), topology and left.simulated(topology)
        acting = {} if resolution != "fast" else {
            place: each.path for place, each in enumerate(space.varied)
            if each.acts_in(self.name, recording) and not self._reads(each, values) and not left.owns(each.path)
            and not (rigid and is_of_course(each.path))}
        meshes, paths = meshes_of(self.solver), list(acting.values())
        named = getattr(meshes, resolution)
        key = content_key(model, topology, paths, named, self.solver)
        curve = solves.find(key)
        if curve is None:
            curve = simulate_curve(model, topology, paths, named, self.solver, one_sided=meshes.slow)
            solves.counts[self.name, resolution] += 1
            solves.keep(key, curve)
        if curve.problem:
            raise InfeasibleError(f"{self.name}: {curve.problem}")
        force = factor * np.array(curve.force)
        rates = np.zeros((force.size, 0 if resolution != "fast" else len(space.free)))
        if acting:
            scale = [1.0 if proportional and space.varied[place].is_modulus else factor for place in acting]
            rates[:, list(acting)] = np.array(curve.rates).reshape(force.size, len(acting)) * scale
        return force, rates, {space.free[place] for place, exact in zip(acting, curve.exact, strict=False) if not exact}

    def _possible(self, space: ParameterSpace, values: dict[str, float], motion: Loading | Timed,
                  recording: str | None) -> Model:
        """The model of a recording along a motion.

        Raises:
            InfeasibleError: there is none with these values.
        """
        try:
            return space.model(values, self._experiment(motion), self.rig, test=self.name, recording=recording)
        except InputError as error:
            raise InfeasibleError(f"{self.name}: {error}") from None

    def _reads(self, unknown: Unknown, values: dict[str, float]) -> bool:
        """Whether it is a number of this test's rig that leaves the motion of the tool alone."""
        mine = unknown.path.startswith("rig.") and any(unknown.acts_in(self.name, each.name) for each in self.measured)
        return mine and only_read(self.rig, unknown.path.removeprefix("rig."), values[unknown.name])

    def evaluate(self, answer: SimulatedAnswer, recording: int, offset: float):
        """As `ForwardTest.evaluate`."""
        measured, reading = self.measured[recording], answer.rigs[recording]
        rig = reading.rig
        values, rate = answer.courses[recording](self._time(recording), measured.displacement, offset)
        if answer.left[recording].effects:
            values, rate = self._left(answer, recording, offset, values, rate)
        simulated = values[:, 0]
        if rig.latency:
            columns = np.column_stack([values, rate])
            late = np.column_stack([np.interp(measured.clock - rig.latency, measured.clock, column)
                                    for column in columns.T])
            values, rate = late[:, :-1], late[:, -1]
        force = reading.read(measured, simulated)
        rates, rate = reading.through(measured, simulated, force, values[:, 1:], rate)
        for place, unknown in enumerate(() if answer.space.of_material_alone else answer.space.varied):
            if unknown.acts_in(self.name, measured.name) and self._reads(unknown, answer.values):
                path, value = unknown.path.removeprefix("rig."), answer.values[unknown.name]
                width = away(value)
                # One-sided: many faults cannot be less than absent.
                more = Reading(with_values(rig, {path: value + width})).read(measured, simulated)
                rates[:, place] = (more - force) / width
        return force, rates, rate

    def _left(self, answer: SimulatedAnswer, recording: int, offset: float, values: np.ndarray, rate: np.ndarray):
        """What effects in reduced form leave of force and rates, (n, 1 + p), and of the rate with the offset, (n,)."""
        left, measured, space = answer.left[recording], self.measured[recording], answer.space
        depth = depth_in_tissue(answer.courses[recording], measured, offset)
        share = left.share(measured, depth)
        scaled = share[:, None] * values
        for place, each in enumerate(space.varied, start=1):
            if each.acts_in(self.name, measured.name) and left.owns(each.path):
                width = away(answer.values[each.name])
                more = self._possible(space, answer.values | {each.name: answer.values[each.name] + width},
                                      self.motions[self.motion_of[recording]], measured.name)
                material, plate = more.material, more.experiment.tool.is_plate
                other = Left(material.reduced_effects(plate=plate)).share(measured, depth)
                scaled[:, place] = (other - share) / width * values[:, 0]
        return scaled, share * rate

    def differences(self, answer: SimulatedAnswer) -> frozenset[str]:
        return answer.differences

    def scan(self, answer: SimulatedAnswer, recording: int, offsets: np.ndarray) -> np.ndarray:
        """Force at the samples of a recording for these contact offsets, m, shape (n, offsets)."""
        if answer.rigs[recording].reading is not None:
            return np.column_stack([self.evaluate(answer, recording, offset)[0] for offset in offsets])
        measured = self.measured[recording]
        course, left = answer.courses[recording], answer.left[recording]
        forces = course.forces(self._time(recording), measured.displacement, offsets)
        # A jump is at a depth of the tissue: another contact moves it to other samples.
        return left.share(measured, depth_in_tissue(course, measured, offsets)) * forces if left.effects else forces

    def _time(self, recording: int) -> np.ndarray | None:
        """Of the samples, on the clock of their motion: motions that count as one may have begun at other times."""
        motion, measured = self.motions[self.motion_of[recording]], self.measured[recording]
        return measured.clock - measured.clock[0] + motion.sampled_from if isinstance(motion, Timed) else measured.time

    def reached(self, space: ParameterSpace, theta: np.ndarray) -> Reached:
        """Of the volume, without a hundredth at either end."""
        deepest = max(float(curve.displacement.max()) for curve in self.measured)
        if self.homogeneous:
            return reached_at(self.closed_form, 1 - deepest / self.specimen.height)
        points = max(3, self.motions[0].protocol.time.size // 2)
        experiment = replace(self.experiment, protocol=Protocol.ramp(deepest, points))
        try:
            model = replace(space.model(space.values(theta), experiment, self.rig, test=self.name), rig=Rig())
        except InputError:
            model = None
        return reached_in(model, self.solver, deepest / self.specimen.height)

    def _experiment(self, motion: Loading | Timed) -> Experiment:
        return replace(self.experiment, protocol=motion.protocol)
