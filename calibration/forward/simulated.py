"""Forward model of a test by finite elements, simulated at a few knots of the motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np

from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.contract import InfeasibleError, StretchRange
from calibration.forward.meshes import AccurateMeshErrorOverDepth, get_solver_fit_resolutions
from calibration.forward.motion import ForceCurve, MonotonicLoading, TimedMotion, build_cubic_or_linear_spline
from calibration.forward.readout import (
    ForceFactorEffects,
    ForcePositionCurve,
    RigForceCurve,
    RigReadout,
    SimulatedTestForceCurves,
    build_loading_to_true_depth,
    compute_depth_in_tissue,
    compute_difference_step,
    is_path_dependent_with_rig,
    is_rig_or_tilt_parameter,
    tool_separates_on_retraction,
)
from calibration.forward.simulated_motions import (
    SimulatedMotions,
    compute_compression_stretch_range,
    compute_simulated_stretch_range,
    is_force_proportional_to_moduli,
)
from calibration.forward.simulation_cache import SimulationCache
from tissue_sim.closed_form.confined import CONFINED
from tissue_sim.closed_form.homogeneous import UNIAXIAL, ClosedForm
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.model import Model
from tissue_sim.parameters import with_values
from tissue_sim.rig.rig import Rig

#: Displacement past first contact at which a retracting tool pulls at a bonded face, as a fraction of the depth.
_PULL_FRACTION = 0.02


@dataclass(eq=False)
class SimulatedTest(SimulatedMotions):
    """Forward model that simulates one test with finite elements on one mesh; see `ForwardTest`.

    Between the knots of the simulated motions the force is interpolated at the samples of the recordings.
    """

    area: ClassVar[float | None] = None

    @property
    def closed_form(self) -> ClosedForm:
        """Closed form of a homogeneous test."""
        return CONFINED if self.experiment.has_lateral_wall else UNIAXIAL

    @property
    def has_reversals_or_holds(self) -> bool:
        """Whether the motions have reversals or holds, so that the force may depend on the loading path."""
        return isinstance(self.motions[0], TimedMotion)

    @property
    def _distinct_timed_motions(self) -> tuple[TimedMotion, ...]:
        """Distinct motions that have reversals or holds; `motion_of` maps recordings to motions."""
        return tuple(motion for motion in self.motions if isinstance(motion, TimedMotion))

    @property
    def is_force_proportional_to_moduli(self) -> bool:
        """Whether the force is proportional to the moduli."""
        return is_force_proportional_to_moduli(self.experiment, self.rig)

    @property
    def is_homogeneous(self) -> bool:
        """Whether the deformation is homogeneous, so that every mesh is exact."""
        return not self.layered and self._build_experiment(self.motions[0]).has_homogeneous_deformation

    @property
    def _largest_displacement(self) -> float:
        """Largest measured displacement of all recordings, m."""
        return max(float(curve.displacement.max()) for curve in self.measured)

    @property
    def largest_strain_or_none(self) -> float | None:
        """See `ForwardTest.largest_strain_or_none`; None with a rig, whose compliance makes the strain smaller."""
        if self.rig != Rig() or not self.is_homogeneous:
            return None
        stretch = 1.0 - self._largest_displacement / self.specimen.height
        return float(self.closed_form.compute_first_invariant(stretch) - 3.0)

    def solve(self, space: ParameterSpace, theta: np.ndarray, solves: SimulationCache) -> SimulatedTestForceCurves:
        """Simulate force curves and derivatives for each recording, with the mesh correction; see `ForwardTest.solve`.

        If the force depends on the tool position alone, one simulated loading gives the force at all positions, and the
        positions follow from the rig without further simulations.
        """
        values = space.get_values_by_name(theta)
        models = [self._build_model(space, values, self.motions[number], measured.name)
                  for measured, number in zip(self.measured, self.motion_of, strict=False)]
        curves: Sequence[ForceCurve | RigForceCurve]
        if self._needs_full_motion(models):
            curves, differences = self._simulate_motion_curves_and_differenced_names(space, values, solves, models)
            effects = [ForceFactorEffects.from_model(model) for model in models]
        else:
            curves, differences = self._simulate_rig_curves_and_differenced_names(space, values, solves, models)
            effects = [
                ForceFactorEffects(model.material.list_acting_force_scaling_effects(plate=model.experiment.tool.is_plate))
                for model in models]
        differences |= {each.name for each in space.free_parameters
                        if self._parameter_affects_readings_only(each, values)
                        or any(one.has_effect_parameter(each.path) for one in effects)}
        return SimulatedTestForceCurves(curves, [RigReadout(model.rig) for model in models], effects, space, values,
                                        frozenset(differences))

    def remove_memory(self, answer: SimulatedTestForceCurves, recording: int, columns: np.ndarray) -> np.ndarray:
        """Return `columns`: deviations from the simulated motion change the force by the stiffness at each sample."""
        return columns

    def can_use_position_curve_at_parameters(self, space: ParameterSpace, theta: np.ndarray) -> bool:
        """Return whether the force comes from one loading curve and the tool positions, without the whole motion.

        Raises:
            InfeasibleError: the model is invalid at these parameters.
        """
        values = space.get_values_by_name(theta)
        return not self._needs_full_motion([self._build_model(space, values, self.motions[number], measured.name)
                                            for measured, number in zip(self.measured, self.motion_of, strict=False)])

    def _needs_full_motion(self, models: Sequence[Model]) -> bool:
        """Return whether the forces of these models require a simulation of the whole motion."""
        if self.full_motion or not self.has_reversals_or_holds or (self.correction
                                                                   and self.position_correction is None):
            return True
        # The tensile response of a bonded face cannot be extrapolated from compression.
        paths = [motion.displacement[int(np.argmax(motion.displacement >= 0)):]
                 for motion in self._distinct_timed_motions]
        pulls = min(float(path.min()) for path in paths) < -_PULL_FRACTION * max(float(path.max()) for path in paths)
        return (pulls
                and not tool_separates_on_retraction(self.experiment)) or any(map(is_path_dependent_with_rig, models))

    def _simulate_motion_curves_and_differenced_names(self, space: ParameterSpace, values: dict[str, float],
                                                      solves: SimulationCache,
                                                      models: Sequence[Model]) -> tuple[list[ForceCurve], set[str]]:
        """Simulate the whole motion of each recording.

        Returns:
            Force curve of each recording, and the names of parameters whose derivatives are finite differences.
        """
        curves: dict[tuple[int, str | None], ForceCurve] = {}
        chosen, differences = [], set()
        for measured, number, model in zip(self.measured, self.motion_of, models, strict=False):
            key = number, space.get_recording_if_it_has_own_values(self.name, measured.name)
            if key not in curves:
                motion = self.motions[number]
                force, rates, inexact = self._simulate_or_load_force_and_derivatives(
                    space, values, solves, motion, "fast", key[1])
                differences |= inexact
                if self.correction:
                    force = force + self.correction[number]
                columns = np.column_stack([force, rates])
                curves[key] = motion.make_force_curve(columns,
                                                      position=model.rig.compute_unloaded_tool_displacement(motion.displacement),
                                                      separates=tool_separates_on_retraction(self.experiment)) \
                    if isinstance(motion, TimedMotion) else motion.make_force_curve(columns)
            chosen.append(curves[key])
        return chosen, differences

    def _simulate_rig_curves_and_differenced_names(self, space: ParameterSpace, values: dict[str, float],
                                                   solves: SimulationCache,
                                                   models: Sequence[Model]) -> tuple[list[RigForceCurve], set[str]]:
        """Simulate one loading with an ideal rig, and align its force with the samples of each recording.

        Returns:
            Force curve of each recording, and the names of parameters whose derivatives are finite differences.
        """
        by_mark: dict[str | None, ForcePositionCurve] = {}
        curves, differences = [], set()
        for recording, (measured, number, model) in enumerate(zip(self.measured, self.motion_of, models, strict=False)):
            mark = space.get_recording_if_it_has_own_values(self.name, measured.name)
            align = partial(self._make_rig_force_curve, recording)
            if mark not in by_mark:
                loading = self._build_loading_to_deepest_tool_position(model.rig)
                force, rates, inexact = self._simulate_or_load_force_and_derivatives(
                    space, values, solves, loading, "fast", mark, rigid=True)
                differences |= inexact
                by_mark[mark] = ForcePositionCurve.from_knot_values(
                    loading.depth,
                    np.column_stack([force + self._interpolate_force_correction_at_knots(loading), rates]),
                    holds=not tool_separates_on_retraction(model.experiment))
            neighbours = {}
            for column, each in enumerate(space.free_parameters, start=1):
                if is_rig_or_tilt_parameter(each.path) and each.applies_to_recording(self.name, measured.name) \
                        and not self._parameter_affects_readings_only(each, values):
                    step = compute_difference_step(values[each.name])
                    changed = self._build_model(space, values | {each.name: values[each.name] + step},
                                                self.motions[number], measured.name)
                    neighbours[column] = align(by_mark[mark], changed), step
                    differences.add(each.name)
            curves.append(replace(align(by_mark[mark], model), neighbours=neighbours))
        return curves, differences

    def _make_rig_force_curve(self, recording: int, curve: ForcePositionCurve, model: Model) -> RigForceCurve:
        """Return the curve of the force at the samples of a recording, for the rig and the tilt of a model."""
        motion, measured = self._distinct_timed_motions[self.motion_of[recording]], self.measured[recording]
        tilt, time = model.experiment.tilt, measured.sample_times - measured.sample_times[
            0] + motion.sampled_from
        # Path-dependent faults (backlash, lost steps) act on the straight parts of the motion: noise of the
        # displacement would appear as many reversals.
        straight = np.interp(time, motion.time, motion.displacement)
        position = model.rig.compute_unloaded_tool_displacement(straight) + measured.displacement - straight
        return RigForceCurve(curve.with_tilt(tilt) if tilt else curve, position, model.rig.compliance)

    def _build_loading_to_deepest_tool_position(self, rig: Rig) -> MonotonicLoading:
        """Return a monotonic loading to the largest true tool depth that a rig produces in any of the motions.

        Raises:
            InfeasibleError: the largest depth is not positive.
        """
        paths = [motion.displacement for motion in self._distinct_timed_motions]
        # Deflection of the stated load train, reduced by 10 % so that the depth is not underestimated.
        deflection = 0.9 * self.rig.compliance * max(0.0, *(float(curve.force.max()) for curve in self.measured))
        depth = max(float(path.max()) for path in paths) - deflection
        deepest = max(float(rig.compute_unloaded_tool_displacement(path).max()) for path in paths) - deflection
        if not depth > 0:
            raise InfeasibleError(f"{self.name}: the tool never reaches the tissue; check the contact of its "
                                  "recordings and the compliance of the rig")
        return build_loading_to_true_depth(depth, deepest, 0.999 * self.experiment.thickness)

    def _interpolate_force_correction_at_knots(self, loading: MonotonicLoading) -> np.ndarray:
        """Return the mesh correction (force difference) at the knots of a loading, N, shape (k,); 0 if not computed."""
        if self.position_correction is None:
            return np.zeros(loading.depth.size)
        depth, force = self.position_correction
        return build_cubic_or_linear_spline(depth, force)(np.minimum(loading.depth, depth[-1]))

    def update_mesh_force_difference_and_get_ratio(self, space: ParameterSpace, theta: np.ndarray,
                                                   solves: SimulationCache) -> float:
        """Compute the force difference of the accurate and the fast mesh, and store it as the correction.

        Returns:
            The largest absolute difference divided by the largest force.

        Raises:
            InfeasibleError: the accurate mesh does not converge.
        """
        values, found, largest = space.get_values_by_name(theta), [], 0.0
        if self.is_homogeneous:
            self.discard_mesh_correction()
            return 0.0
        rigid = self.can_use_position_curve_at_parameters(space, theta)
        loading = self._build_loading_to_deepest_tool_position(Rig()) if rigid else None
        for motion in self.motions if loading is None else (loading,):
            fast, *_ = self._simulate_or_load_force_and_derivatives(space, values, solves, motion, "fast", rigid=rigid)
            accurate = self._compute_accurate_mesh_force_at_knots(space, values, solves, motion, rigid=rigid)
            if isinstance(motion, MonotonicLoading) and not self.experiment.is_path_dependent:
                self._set_mesh_error_once(space, values, solves, motion, accurate, rigid=rigid)
            if self.mesh_error is not None:
                accurate = accurate * self.mesh_error.compute_correction_factor(motion.tool_protocol.displacement)
            found.append(accurate - fast)
            largest = max(largest, float(np.abs(found[-1]).max() / np.abs(accurate).max()))
        self.correction, self.position_correction = found, None
        if loading is not None:
            self.position_correction = loading.depth, found[0]
            correction = build_cubic_or_linear_spline(*self.position_correction)
            self.correction = [correction(np.clip(motion.displacement, 0.0, loading.depth[-1]))
                               for motion in self._distinct_timed_motions]
        return largest

    def _set_mesh_error_once(self, space: ParameterSpace, values: dict[str, float], solves: SimulationCache,
                             loading: MonotonicLoading, accurate: np.ndarray, *, rigid: bool) -> None:
        """Set `mesh_error` by comparison of accurate and finest mesh, unless it is set or the finest mesh is not used.

        Args:
            space: parameter space.
            values: name -> value of all parameters, SI.
            solves: cache of simulations.
            loading: loading with k knots.
            accurate: force of the accurate mesh at the knots, N, shape (k,).
            rigid: whether the rig is ideal.
        """
        meshes = get_solver_fit_resolutions(self.solver)
        if self.mesh_error is not None or not meshes.uses_finest_mesh_for_mesh_error(self.experiment):
            return
        fewer, kept = loading.make_coarser_loading_and_kept_knots() if meshes.slow \
            else (loading, np.arange(loading.depth.size))
        try:
            finest, *_ = self._simulate_or_load_force_and_derivatives(space, values, solves, fewer, "finest",
                                                                      rigid=rigid)
            self.mesh_error = AccurateMeshErrorOverDepth.from_accurate_and_finest_forces(
                fewer.depth, accurate[kept], finest)
        except InfeasibleError:
            self.mesh_error = AccurateMeshErrorOverDepth.make_unknown_error_without_knots()

    def discard_mesh_correction(self) -> None:
        """Delete the stored mesh correction, so that forces are those of the fast mesh."""
        self.correction, self.position_correction = [], None

    def evaluate_force_and_derivatives(self, answer: SimulatedTestForceCurves, recording: int, offset: float):
        """Return readings and their derivatives at the samples of a recording.

        See `ForwardTest.evaluate_force_and_derivatives`.
        """
        measured, readout = self.measured[recording], answer.readouts[recording]
        rig = readout.rig
        values, rate = answer.curves[recording](self._convert_to_motion_time_or_none(recording), measured.displacement,
                                                offset)
        if answer.effects[recording].effects:
            values, rate = self._scale_force_and_derivatives_by_effects(answer, recording, offset, values, rate)
        simulated = values[:, 0]
        if rig.latency:
            columns = np.column_stack([values, rate])
            late = np.column_stack(
                [np.interp(measured.sample_times - rig.latency, measured.sample_times, column)
                 for column in columns.T])
            values, rate = late[:, :-1], late[:, -1]
        force = readout.convert_to_readings(measured, simulated)
        rates, rate = readout.convert_derivatives_to_readings(measured, simulated, force, values[:, 1:], rate)
        for column, unknown in enumerate(() if answer.space.has_only_shared_material_parameters
                                         else answer.space.free_parameters):
            if unknown.applies_to_recording(self.name, measured.name) and (
                    self._parameter_affects_readings_only(unknown, answer.values)):
                path, value = unknown.path.removeprefix("rig."), answer.values[unknown.name]
                step = compute_difference_step(value)
                # The difference is one-sided: zero is a lower bound of many faults.
                changed = RigReadout(with_values(rig, {path: value + step})).convert_to_readings(measured, simulated)
                rates[:, column] = (changed - force) / step
        return force, rates, rate

    def _scale_force_and_derivatives_by_effects(self, answer: SimulatedTestForceCurves, recording: int, offset: float,
                                                values: np.ndarray, rate: np.ndarray):
        """Multiply simulated force and derivatives by the factor of the effects that are applied after the simulation.

        Args:
            answer: simulated forces of the test.
            recording: index of the recording.
            offset: contact offset, m.
            values: force and its derivatives at the samples, shape (n, 1 + p).
            rate: derivative of the force with respect to the contact offset, shape (n,).

        Returns:
            `values` and `rate` multiplied by the factor; derivatives by parameters of the effects are added.
        """
        effects, measured, space = answer.effects[recording], self.measured[recording], answer.space
        depth = compute_depth_in_tissue(answer.curves[recording], measured, offset)
        factor = effects.compute_force_factor(measured, depth)
        scaled = factor[:, None] * values
        for column, each in enumerate(space.free_parameters, start=1):
            if each.applies_to_recording(self.name, measured.name) and effects.has_effect_parameter(each.path):
                step = compute_difference_step(answer.values[each.name])
                changed = self._build_model(space, answer.values | {each.name: answer.values[each.name] + step},
                                            self.motions[self.motion_of[recording]], measured.name)
                acting = changed.material.list_acting_force_scaling_effects(plate=changed.experiment.tool.is_plate)
                other = ForceFactorEffects(acting).compute_force_factor(measured, depth)
                scaled[:, column] = (other - factor) / step * values[:, 0]
        return scaled, factor * rate

    def list_finite_difference_parameters(self, answer: SimulatedTestForceCurves) -> frozenset[str]:
        """Return the names of the free parameters whose derivatives are finite differences, not exact ones."""
        return answer.differences

    def compute_force_at_contact_offsets(self, answer: SimulatedTestForceCurves, recording: int,
                                         offsets: np.ndarray) -> np.ndarray:
        """Return the force at the samples of a recording for several contact offsets, m; shape (n, offsets)."""
        if answer.readouts[recording].reading_only_rig_or_none is not None:
            return np.column_stack([self.evaluate_force_and_derivatives(answer, recording, offset)[0]
                                    for offset in offsets])
        measured = self.measured[recording]
        curve, effects = answer.curves[recording], answer.effects[recording]
        forces = curve.compute_force_at_contact_offsets(self._convert_to_motion_time_or_none(recording),
                                                        measured.displacement, offsets)
        # A jump occurs at a true depth, so the contact offset determines its sample.
        return effects.compute_force_factor(measured, compute_depth_in_tissue(curve, measured, offsets)) * forces \
            if effects.effects else forces

    def _convert_to_motion_time_or_none(self, recording: int) -> np.ndarray | None:
        """Return the times of the samples in the time scale of the simulated motion, s, shape (n,); None without times.

        Recordings with equivalent motions share one simulated motion and may have begun at other times.
        """
        motion, measured = self.motions[self.motion_of[recording]], self.measured[recording]
        if isinstance(motion, TimedMotion):
            return measured.sample_times - measured.sample_times[0] + motion.sampled_from
        return measured.time

    def compute_stretch_range(self, space: ParameterSpace, theta: np.ndarray) -> StretchRange:
        """Return the range of principal stretches over the volume at the largest depth, without the outer 1 % each."""
        deepest = self._largest_displacement
        if self.is_homogeneous:
            return compute_compression_stretch_range(self.closed_form, 1 - deepest / self.specimen.height)
        points = max(3, self.motions[0].tool_protocol.time.size // 2)
        experiment = replace(self.experiment, protocol=Protocol.ramp(deepest, points))
        try:
            model = replace(space.build_model(space.get_values_by_name(theta), experiment, self.rig, test=self.name),
                            rig=Rig())
        except InputError:
            model = None
        return compute_simulated_stretch_range(model, self.solver, deepest / self.specimen.height)
