"""Finite-element simulation of the motions of a test: forces, range of the stretches, proportionality to the moduli.

If all forces of a test are proportional to the moduli, one simulation serves all sets of moduli with the same ratios.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import FitParameter, ParameterSpace
from calibration.forward.contract import InfeasibleError, StretchRange
from calibration.forward.meshes import AccurateMeshErrorOverDepth, get_solver_fit_resolutions
from calibration.forward.motion import MonotonicLoading, TimedMotion
from calibration.forward.readout import (
    ForceFactorEffects,
    is_rig_or_tilt_parameter,
    make_model_without_rig_and_tilt,
    parameter_affects_readings_only,
)
from calibration.forward.simulation_cache import (
    SimulationCache,
    hash_content_and_source_code,
    simulate_force_or_record_failure,
)
from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.model import Model
from tissue_sim.rig.rig import Rig
from tissue_sim.simulation import simulate
from tissue_sim.specimen import Specimen

#: Parameters of an experiment that are neither forces nor stiffnesses.
_EXPERIMENT_PARAMETERS = frozenset(f"experiment.{name}" for name in (
    "friction", "friction_base", "friction_wall", "tilt", "slip"))
#: Parameters of a rig that only change the motion of the tool.
_MOTION_PARAMETERS = frozenset(f"rig.{name}" for name in (
    "contact_offset", "displacement_gain", "backlash", "step_loss", "step_loss_depth"))


def is_force_proportional_to_moduli(experiment: Experiment, rig: Rig) -> bool:
    """Return whether the tissue is the only source of force and stiffness in a test.

    Self-weight, contact laws with a stress scale and a compliant load train break the proportionality.
    """
    return not (experiment.specimen.specific_weight or experiment.acting_laws or rig.compliance)


def keeps_force_proportional_to_moduli(unknown: FitParameter, *, rigid: bool) -> bool:
    """Return whether forces stay proportional to the moduli for every value of a parameter.

    Args:
        unknown: parameter of the fit.
        rigid: whether the simulation uses an ideal rig, so that parameters of the rig have no influence.
    """
    if unknown.is_modulus:
        # A modulus of some tests or recordings does not scale all forces.
        return unknown.tests is None and unknown.recording is None
    if unknown.is_material_parameter:
        return True
    if unknown.path.startswith("rig."):
        return rigid or unknown.path in _MOTION_PARAMETERS
    return unknown.path in _EXPERIMENT_PARAMETERS or unknown.declaration.shapes_mesh


def compute_compression_stretch_range(closed_form: ClosedForm, low: float) -> StretchRange:
    """Return the range of the principal stretches in a homogeneous compression, from `low` to 1 along the load.

    Args:
        closed_form: closed form of the test.
        low: smallest stretch along the load.
    """
    return StretchRange(closed_form.mode, low, 1.0, closed_form.find_extreme_stretches(low, 1.0))


def compute_simulated_stretch_range(model: Model | None, solver: str, strain: float) -> StretchRange:
    """Simulate a model, and return the range of its principal stretches without the lowest and highest 1 % of volume.

    Without a converged simulation the range is 1 - `strain` to 1.

    Args:
        model: model in its most deformed state; None: no valid model exists.
        solver: name of the solver.
        strain: displacement divided by the specimen's height.
    """
    fields = None
    if model is not None:
        try:
            fields = simulate(model, resolution=get_solver_fit_resolutions(solver).fast, fields=True, solver=solver,
                              estimate_error=False).fields
        except (ConvergenceError, InputError):
            fields = None
    low, high = (1.0 - strain, 1.0) if fields is None else fields.stretch_range()
    return StretchRange(None, low, high, (low, high))


@dataclass(eq=False)
class SimulatedMotions:
    """Motions of a test that finite elements simulate on one mesh.

    Attributes:
        name: name of the test.
        experiment: specimen, tool and contact; its motion is replaced by `motions`.
        rig: testing machine with its faults.
        motions: distinct motions of the recordings.
        motion_of: index of the motion of each recording.
        measured: recordings of the test.
        layered: whether the material has layers.
        correction: force of the accurate mesh minus that of the fast mesh at the knots of each motion, N, shape (k,);
            empty before `update_mesh_force_difference_and_get_ratio`.
        position_correction: depth, m, and the same difference of forces, N, at the knots of one loading, shapes (k,).
        mesh_key: key of the mesh; tests with the same key have the same mesh error. Empty: no other test uses the mesh.
        full_motion: whether the whole motion is simulated even if the force depends on the tool position alone.
        solver: name of the solver.
        mesh_error: relative error of the accurate mesh; None: not computed.
    """

    name: str
    experiment: Experiment
    rig: Rig
    motions: tuple[MonotonicLoading | TimedMotion, ...]
    motion_of: tuple[int, ...]
    measured: tuple[MeasuredCurve, ...]
    layered: bool = False
    correction: list[np.ndarray] = field(default_factory=list)
    position_correction: tuple[np.ndarray, np.ndarray] | None = None
    mesh_key: str = ""
    full_motion: bool = False
    solver: str = "axisymmetric"
    mesh_error: AccurateMeshErrorOverDepth | None = None

    @property
    def specimen(self) -> Specimen:
        """Specimen of the experiment."""
        return self.experiment.specimen

    def _build_experiment(self, motion: MonotonicLoading | TimedMotion) -> Experiment:
        """Return a copy of the experiment in which the tool follows this motion."""
        return replace(self.experiment, protocol=motion.tool_protocol)

    def _build_model(self, space: ParameterSpace, values: dict[str, float], motion: MonotonicLoading | TimedMotion,
                     recording: str | None) -> Model:
        """Return the model of a recording: material and rig at these parameter values, and the given motion.

        Raises:
            InfeasibleError: the values give no valid model.
        """
        try:
            return space.build_model(values, self._build_experiment(motion), self.rig, test=self.name,
                                     recording=recording)
        except InputError as error:
            raise InfeasibleError(f"the parameter values tried give no valid model of test {self.name}: "
                                  f"{error}") from None

    def _parameter_affects_readings_only(self, unknown: FitParameter, values: dict[str, float]) -> bool:
        """Return whether a parameter belongs to the rig of this test and does not change the motion of the tool."""
        acts = unknown.path.startswith("rig.") \
            and any(unknown.applies_to_recording(self.name, each.name) for each in self.measured)
        return acts and parameter_affects_readings_only(self.rig, unknown.path.removeprefix("rig."),
                                                        values[unknown.name])

    def _simulate_or_load_force_and_derivatives(self, space: ParameterSpace, values: dict[str, float],
                                                solves: SimulationCache,
                                                motion: MonotonicLoading | TimedMotion, resolution: str,
                                                recording: str | None = None, *, rigid: bool = False
                                                ) -> tuple[np.ndarray, np.ndarray, set[str]]:
        """Return force and derivatives along a motion, from the cache or from a new simulation that is then cached.

        If forces are proportional to the moduli, the simulation uses normalised moduli and its force is scaled, so that
        one simulation serves all moduli with the same ratios.

        Args:
            space: parameter space.
            values: name -> value of all parameters, SI.
            solves: cache of simulations.
            motion: motion with k knots.
            resolution: ``"fast"``, ``"accurate"`` or ``"finest"``, see
                `calibration.forward.meshes.SolverFitResolutions`.
            recording: name of the recording with these values; None: recordings without own parameters.
            rigid: whether the rig is ideal and the tool not tilted.

        Returns:
            Force, N, shape (k,); derivatives with respect to the free parameters, shape (k, p) on the fast mesh and
            (k, 0) on other meshes; names of parameters whose derivatives are finite differences.

        Raises:
            InfeasibleError: the model is invalid, or the solver does not converge.
        """
        factor, proportional = 1.0, is_force_proportional_to_moduli(self.experiment,
                                                                    Rig() if rigid else self.rig) and all(
            keeps_force_proportional_to_moduli(each, rigid=rigid) or self._parameter_affects_readings_only(each, values)
            for each in space.unknowns if each.is_modulus or each.applies_to_recording(self.name, recording))
        if proportional:
            values, factor = space.normalise_moduli_and_get_factor(values)

        def build_model_without_readout(of: dict[str, float]) -> Model:
            """Return the model at parameter values `of`, whose rig moves the tool but does not change readings."""
            # The readout is applied to the samples later, so only the motion of the rig is simulated.
            model = self._build_model(space, of, motion, recording)
            if rigid:
                return make_model_without_rig_and_tilt(model)
            return replace(model, rig=model.rig.with_motion_effects_only)

        model = build_model_without_readout(values)
        topology = build_model_without_readout(space.replace_geometry_by_start_values(values)) \
            if space.has_free_mesh_geometry_parameter(self.name) else None
        effects = ForceFactorEffects.from_model(model)
        model = effects.remove_effects_from_model(model)
        topology = topology and effects.remove_effects_from_model(topology)
        acting = {} if resolution != "fast" else {
            column: each.path for column, each in enumerate(space.free_parameters)
            if each.applies_to_recording(self.name, recording)
            and not self._parameter_affects_readings_only(each, values)
            and not effects.has_effect_parameter(each.path) and not (rigid and is_rig_or_tilt_parameter(each.path))}
        meshes, paths = get_solver_fit_resolutions(self.solver), list(acting.values())
        mesh = getattr(meshes, resolution)
        key = hash_content_and_source_code(model, topology, paths, mesh, self.solver)
        curve = solves.find_curve(key)
        if curve is None:
            curve = simulate_force_or_record_failure(model, topology, paths, mesh, self.solver, one_sided=meshes.slow)
            solves.counts[self.name, resolution] += 1
            solves.store_curve(key, curve)
        if curve.problem:
            raise InfeasibleError(f"{self.name}: {curve.problem}")
        force = factor * np.array(curve.force)
        rates = np.zeros((force.size, 0 if resolution != "fast" else len(space.free)))
        if acting:
            scale = [1.0 if proportional and space.free_parameters[column].is_modulus else factor for column in acting]
            rates[:, list(acting)] = np.array(curve.rates).reshape(force.size, len(acting)) * scale
        inexact = {space.free[column] for column, exact in zip(acting, curve.exact, strict=False) if not exact}
        return force, rates, inexact

    def _compute_accurate_mesh_force_at_knots(self, space: ParameterSpace, values: dict[str, float],
                                              solves: SimulationCache,
                                              motion: MonotonicLoading | TimedMotion, *, rigid: bool) -> np.ndarray:
        """Return the force of the accurate mesh at the knots, N, shape (k,).

        With friction the fast mesh needs short steps near first contact, and the accurate mesh converges more often
        with equal steps. If one spacing fails, the other one is tried.
        """
        equal = motion.counterpart_with_uniform_first_leg_steps
        first, second = (equal, motion) if isinstance(motion, TimedMotion) else (motion, equal)
        try:
            used, (force, *_) = first, self._simulate_or_load_force_and_derivatives(
                space, values, solves, first, "accurate", rigid=rigid)
        except InfeasibleError:
            used, (force, *_) = second, self._simulate_or_load_force_and_derivatives(
                space, values, solves, second, "accurate", rigid=rigid)
        return force if used is motion else motion.evaluate_curve_at_knots(used.make_force_curve(force[:, None]))[:, 0]
