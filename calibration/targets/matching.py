"""Fit of the elastic constants of a physics engine to the calibrated forces of a test.

At a fixed Poisson's ratio the forces at rest are proportional to Young's modulus, which is therefore a linear
least-squares problem. Poisson's ratio is found by a bounded minimisation of the error that is left.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize_scalar

from calibration.targets.runner import TargetCurve, TargetRunner, TargetTest
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.exports.elastic_constants import ElasticConstants, linearise_material
from tissue_sim.laws.stability import find_stability_range
from tissue_sim.material.file import MaterialFile
from tissue_sim.material.material import Bulk, Material
from tissue_sim.material.viscoelasticity import RelaxationSeries
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.parameters import get_parameter_value, with_values
from tissue_sim.simulation import simulate

#: Function that receives a sentence about the current work.
Report = Callable[[str], None]


@dataclass(frozen=True)
class MatchSettings:
    """Numbers of the fit of elastic constants.

    Attributes:
        least_poisson: smallest Poisson's ratio of the search, 1; half of that of the material if this is smaller.
        poisson_tolerance: absolute tolerance of Poisson's ratio, 1.
        max_searches: largest number of Poisson's ratios of the search.
        least_force: smallest force of a sample that counts, as a fraction of the largest force, 1.
        scale_tolerance: change of Young's modulus after which another run confirms the constants, as a fraction, 1.
        numerical_damping_time: damping time of the constants of an elastic material, s; the engine needs it to come to
            rest.
        max_redraws: largest number of draws for each valid one.
    """

    least_poisson: float = 0.3
    poisson_tolerance: float = 0.01
    max_searches: int = 6
    least_force: float = 0.01
    scale_tolerance: float = 2e-3
    numerical_damping_time: float = 0.01
    max_redraws: int = 20


#: Settings of all fits.
SETTINGS = MatchSettings()


@dataclass(frozen=True)
class CalibratedForces:
    """Forces of a test with the calibrated material.

    Attributes:
        depths: displacements of the tool, m, shape (n,).
        forces: forces against the motion, N, shape (n,).
        force_error: estimated error over the largest force, 1; None: not known.
        duration: time of the loading, s.
    """

    depths: np.ndarray
    forces: np.ndarray
    force_error: float | None
    duration: float


@dataclass(frozen=True, kw_only=True)
class TargetComparison:
    """Forces of a test in another program, compared with the calibrated forces.

    Attributes:
        calibrated: forces of the calibrated material.
        depths: depths that were compared, m, shape (n,).
        target_forces: forces in the program at these depths, N, shape (n,).
        is_in_target: whether the forces are those of the program on its mesh; otherwise those of its law alone.
        ended: reason why the program did not reach all depths; empty if it did.
        runs: number of simulations of the program, or of its law.
        version: name and version of the program.
    """

    calibrated: CalibratedForces
    depths: np.ndarray
    target_forces: np.ndarray
    is_in_target: bool
    ended: str = ""
    runs: int = 1
    version: str = ""

    @property
    def calibrated_forces(self) -> np.ndarray:
        """Forces of the calibrated material at `depths`, N, shape (n,)."""
        return self.calibrated.forces[: self.depths.size]

    @property
    def errors(self) -> np.ndarray:
        """Relative errors of the forces at `depths`, 1, shape (n,)."""
        return self.target_forces / self.calibrated_forces - 1.0

    @property
    def deepest(self) -> float:
        """Largest depth at which the errors are known, m."""
        return float(self.depths.max(initial=0.0))

    @property
    def reaches_all_depths(self) -> bool:
        """Whether all samples of the test were compared."""
        return self.depths.size == self.calibrated.depths.size

    def list_remarks(self) -> tuple[str, ...]:
        """Return sentences about depths and errors for the written file."""
        error = self.calibrated.force_error
        lines = ["Error of the calibrated force itself: "
                 + ("not known." if error is None else f"{100.0 * error:.2g} % of the largest force.")]
        lines += [f"depth {1e3 * depth:.4g} mm: calibrated {calibrated:.5g} N, target {force:.5g} N, error "
                  f"{100.0 * wrong:+.2f} %" for depth, calibrated, force, wrong in
                  zip(self.depths, self.calibrated_forces, self.target_forces, self.errors, strict=True)]
        if not self.reaches_all_depths:
            lines.append(f"Valid to a depth of {1e3 * self.deepest:.4g} mm. Do not use it deeper: {self.version} ended "
                         f"{self.ended}.")
        return tuple(lines)


@dataclass(frozen=True, kw_only=True)
class MatchedConstants(TargetComparison):
    """Elastic constants of an engine that reproduce a calibrated test, and the force error that is left.

    Attributes:
        constants: constants of the engine.
        uncompensated: constants of the linearised material, before the fit.
        uncompensated_depths: depths at which their forces are known, m, shape (m,).
        uncompensated_forces: their forces, N, shape (m,).
    """

    constants: ElasticConstants
    uncompensated: ElasticConstants
    uncompensated_depths: np.ndarray
    uncompensated_forces: np.ndarray

    @property
    def uncompensated_errors(self) -> np.ndarray:
        """Relative errors of the forces with `uncompensated`, 1, shape (m,)."""
        return self.uncompensated_forces / self.calibrated.forces[: self.uncompensated_depths.size] - 1.0

    def list_remarks(self) -> tuple[str, ...]:
        """Return sentences about constants, depths and errors for the written file."""
        c, before = self.constants, self.uncompensated
        where = f"in {self.version}, on the mesh of the test" if self.is_in_target else "with the engine's law alone"
        lines = [f"Young's modulus {c.young:.6g} Pa, Poisson's ratio {c.poisson:.4g}, fitted to the calibrated force "
                 f"{where} (linearised material: {before.young:.6g} Pa, {before.poisson:.4g})."]
        if not self.is_in_target:
            lines.append("Errors of the mesh and the contact of the engine are neither compensated nor stated. Use "
                         "--in-target.")
        if c.damping_time != SETTINGS.numerical_damping_time:
            lines.append(f"Damping time {c.damping_time:.4g} s: the loss factor of the relaxation at the frequency "
                         f"1 / {self.calibrated.duration:.4g} s, the time of the loading.")
        else:
            lines.append(f"Damping time {c.damping_time:.4g} s: numerical, so that the engine comes to rest; the "
                         "material is elastic.")
        return (*lines, *super().list_remarks())


def compute_damping_time(series: RelaxationSeries | None, duration: float) -> float:
    """Return the damping time of a Kelvin-Voigt body with the loss factor of a Prony series, s.

    An elastic material has the numerical damping `MatchSettings.numerical_damping_time`.

    A Kelvin-Voigt body has the loss factor ``tan delta = omega damping_time``. The Prony series with instantaneous
    modulus 1 has the storage modulus ``G' = 1 - sum g + sum g (omega tau)^2 / (1 + (omega tau)^2)`` and the loss
    modulus ``G'' = sum g omega tau / (1 + (omega tau)^2)``. Both agree at ``omega = 2 pi / duration``.

    Args:
        series: relaxation; None: elastic material.
        duration: time of the loading, s.

    Source: Ferry, Viscoelastic Properties of Polymers, 1980, chapter 3.
    """
    if series is None:
        return SETTINGS.numerical_damping_time
    omega = 2.0 * math.pi / duration
    x = omega * series.tau
    storage = 1.0 - series.relaxing_fraction + float((series.g * x**2 / (1.0 + x**2)).sum())
    return float((series.g * x / (1.0 + x**2)).sum()) / storage / omega


def compute_calibrated_forces(model: Model, *, resolution: str = "accurate", solver: str = "axisymmetric"
                              ) -> CalibratedForces:
    """Simulate a test with the calibrated material; the forces are those of the loading, after the first touch.

    Raises:
        ConvergenceError: the test did not converge.
    """
    chosen = _find_loaded_samples(model.experiment)
    recording = simulate(model, resolution=resolution, solver=solver)
    depths = recording.displacement
    loading = recording.time[chosen[-1]] - recording.time[max(chosen[0] - 1, 0)]
    return CalibratedForces(depths[chosen], recording.force[chosen], recording.metadata["solver"]["force_error"],
                            max(float(loading), 1e-9))


def _find_loaded_samples(experiment: Experiment) -> np.ndarray:
    """Return the indices of the samples from the first touch to the largest depth."""
    experiment.protocol.require_displacement_control("a match with another program", "experiment.protocol")
    depths = experiment.protocol.displacement
    return np.flatnonzero(depths[: int(depths.argmax()) + 1] > 0.0)


def make_target_test(experiment: Experiment, mesh: SolidMesh, **options: float) -> TargetTest:
    """Make the test of a runner from an experiment, without the samples before the first touch.

    Args:
        experiment: specimen, tool, interfaces and motion.
        mesh: mesh of the specimen in the target.
        **options: further fields of `TargetTest`.

    Raises:
        InputError: a part of the experiment that a `TargetTest` cannot state.
    """
    approach, specimen = experiment.approach, experiment.specimen
    refused = {
        "approach.angle": (approach is not None and approach.angle != 0.0, "a tilted tool. Use an upright tool"),
        "friction": (experiment.friction == "stick", "sticking contact. Use 'bonded' or a coefficient of friction"),
        "friction_base": (experiment.resolved_base_interface != "bonded", "a base that is not bonded. Use 'bonded'"),
        "has_lateral_wall": (experiment.has_lateral_wall, "lateral walls. Use a test with free sides"),
        "slip": (bool(experiment.slip), "a face that slips in part. Use 'bonded'"),
        "contact_laws": (bool(experiment.acting_laws), "adhesion and further contact laws. Leave them out"),
        "tilt": (bool(experiment.tilt), "the correction for a tilted face. Leave it out"),
        "gravity": (bool(specimen.specific_weight), "self-weight. Leave it out"),
    }
    for name, (is_present, words) in refused.items():
        if is_present:
            raise InputError(f"tests in other programs do not have {words}.", field=name)
    is_bonded = experiment.friction == "bonded"
    if experiment.tool.is_plate:
        mesh = replace(mesh, sets={**mesh.sets, "face": mesh.sets["top"]})
    depths = experiment.protocol.displacement[_find_loaded_samples(experiment)]
    positions = np.zeros((depths.size + 1, 3))
    positions[1:, 2] = -depths
    positions[:, 0] = 0.0 if approach is None else approach.offset
    friction = experiment.friction if isinstance(experiment.friction, float) else 0.0
    return TargetTest(mesh, experiment.tool, positions, is_bonded, friction, **options)  # type: ignore[arg-type]


def fit_scale(forces: np.ndarray, calibrated: np.ndarray) -> float:
    """Return the factor on forces that minimises the sum of squares of their relative errors.

    Samples with a small calibrated force (`MatchSettings.least_force`) do not count. With ``r = force / calibrated``
    the factor is ``sum r / sum r^2``.

    Args:
        forces: N, shape (n,).
        calibrated: N, at least n values.
    """
    ratios = _compute_ratios(forces, calibrated)
    return float(ratios.sum() / (ratios**2).sum())


def cut_at_falling_force(curve: TargetCurve) -> TargetCurve:
    """Return a curve up to the position from which its force falls although the depth grows.

    The body has lost its stability there: the law of Saint Venant and Kirchhoff softens below the stretch 1 / sqrt(3).
    """
    falls = (np.diff(curve.depths) > 0.0) & (np.diff(curve.forces[:, 2]) < 0.0)
    if not falls.any():
        return curve
    first = int(falls.argmax()) + 1
    return replace(curve, positions=curve.positions[:first], forces=curve.forces[:first], steps=curve.steps[:first],
                   penetrations=curve.penetrations[:first],
                   ended=f"at {1e3 * curve.depths[first]:.4g} mm: the force falls, so that the body is not stable")


def _compute_ratios(forces: np.ndarray, calibrated: np.ndarray) -> np.ndarray:
    """Return forces over calibrated forces, without the samples that do not count."""
    counted = np.abs(calibrated[: forces.size]) > SETTINGS.least_force * np.abs(calibrated).max()
    return forces[counted] / calibrated[: forces.size][counted]


@dataclass
class _Search:
    """Runs of an engine, or of its law, with constants that are scaled afterwards.

    Attributes:
        run: returns the curve of constants.
        calibrated: calibrated forces.
        start: constants whose density and damping are kept.
        report: receives a sentence about each run.
    """

    run: Callable[[ElasticConstants], TargetCurve]
    calibrated: CalibratedForces
    start: ElasticConstants
    report: Report
    runs: int = 0
    curves: dict[float, tuple[ElasticConstants, TargetCurve]] = field(default_factory=dict)

    def simulate(self, constants: ElasticConstants) -> TargetCurve:
        """Run with constants.

        Raises:
            InputError: no depth was reached.
        """
        self.runs += 1
        self.report(f"run {self.runs}: E = {constants.young:.5g} Pa, nu = {constants.poisson:.4g}")
        return self.run(constants)

    def simulate_at_poisson_ratio(self, poisson: float) -> tuple[ElasticConstants, TargetCurve]:
        """Run with a Poisson's ratio and the shear modulus of the start; known ratios are not run again."""
        if poisson not in self.curves:
            constants = replace(self.start, poisson=poisson, young=2.0 * self.start.mu * (1.0 + poisson))
            self.curves[poisson] = constants, self.simulate(constants)
        return self.curves[poisson]

    def compute_remaining_error(self, poisson: float) -> float:
        """Return the root mean square of the relative errors after scaling, plus the fraction of missing samples."""
        curve = self.simulate_at_poisson_ratio(poisson)[1]
        forces = curve.forces[1:, 2]
        if not forces.size:
            return 2.0
        ratios = fit_scale(forces, self.calibrated.forces) * _compute_ratios(forces, self.calibrated.forces)
        return float(np.sqrt(np.mean((ratios - 1.0)**2))) + 1.0 - forces.size / self.calibrated.forces.size

    def find_poisson_ratio(self, bounds: tuple[float, float]) -> float:
        """Return the Poisson's ratio with the smallest remaining error of all runs."""
        self.simulate_at_poisson_ratio(bounds[1])
        minimize_scalar(self.compute_remaining_error, bounds=bounds, method="bounded",
                        options={"xatol": SETTINGS.poisson_tolerance, "maxiter": SETTINGS.max_searches})
        return min(self.curves, key=self.compute_remaining_error)

    def scale_and_confirm(self, constants: ElasticConstants, curve: TargetCurve
                          ) -> tuple[ElasticConstants, TargetCurve]:
        """Scale Young's modulus to the calibrated forces, and run again with the scaled constants."""
        for _ in range(2):
            scale = fit_scale(curve.forces[1:, 2], self.calibrated.forces)
            if not (math.isfinite(scale) and scale > 0.0):
                raise InputError("the forces in the target are not positive, so that no modulus reproduces the test. "
                                 "Check mesh and tool.", field="--match")
            if abs(scale - 1.0) < SETTINGS.scale_tolerance:
                break
            constants = replace(constants, young=scale * constants.young)
            curve = self.simulate(constants)
        return constants, curve


def match_constants(model: Model, calibrated: CalibratedForces, max_poisson: float, *,
                    runner: TargetRunner | None = None, mesh: SolidMesh | None = None, poisson: float | None = None,
                    report: Report = lambda sentence: None, **options: float) -> MatchedConstants:
    """Find the elastic constants of an engine that reproduce the calibrated forces of a test.

    Args:
        model: test and calibrated material.
        calibrated: result of `compute_calibrated_forces` for the model.
        max_poisson: largest Poisson's ratio of the engine.
        runner: runs the test in the engine; None: the neo-Hookean law alone, in this program.
        mesh: mesh in the engine; required with `runner`.
        poisson: Poisson's ratio; None: it is fitted with `runner`, and is `max_poisson` without.
        report: receives sentences about the progress.
        **options: further fields of `TargetTest`.

    Raises:
        InputError: a test that the engine cannot run, or the engine does not reach the first depth.
    """
    linear = replace(linearise_material(model.material, max_poisson),
                     damping_time=compute_damping_time(model.material.viscoelastic, calibrated.duration))
    if runner is None:
        def run(constants: ElasticConstants) -> TargetCurve:
            return _simulate_law_alone(model, constants, calibrated)

        ratio = linear.poisson if poisson is None else poisson
    else:
        assert mesh is not None, "a runner needs a mesh"
        test = make_target_test(model.experiment, mesh, **options)

        def run(constants: ElasticConstants) -> TargetCurve:
            return cut_at_falling_force(runner.run(test, constants, lambda done, count: report(
                f"position {done} of {count}")))

        ratio = math.nan if poisson is None else poisson
    search = _Search(run, calibrated, linear, report)
    _, before = search.simulate_at_poisson_ratio(linear.poisson)
    if math.isnan(ratio):
        ratio = search.find_poisson_ratio((min(SETTINGS.least_poisson, 0.5 * linear.poisson), linear.poisson))
    constants, curve = search.simulate_at_poisson_ratio(ratio)
    if curve.forces.shape[0] < 2:
        raise InputError(f"the target does not reach the first depth: {curve.ended}. Use a finer mesh, more points or "
                         "a smaller Poisson's ratio.", field="--match")
    constants, curve = search.scale_and_confirm(constants, curve)
    reached, first = curve.forces.shape[0] - 1, before.forces.shape[0] - 1
    return MatchedConstants(constants=constants, calibrated=calibrated, depths=calibrated.depths[:reached],
                            target_forces=curve.forces[1:, 2], uncompensated=linear,
                            uncompensated_depths=calibrated.depths[:first], uncompensated_forces=before.forces[1:, 2],
                            is_in_target=runner is not None, ended=curve.ended, runs=search.runs,
                            version=curve.version)


def compare_in_target(model: Model, calibrated: CalibratedForces, runner: TargetRunner, mesh: SolidMesh, *,
                      report: Report = lambda sentence: None, **options: float) -> TargetComparison:
    """Run a test in a program that has the law of the material, and compare the forces.

    Arguments as of `match_constants`.

    Raises:
        InputError: a test that the program cannot run.
    """
    curve = runner.run(make_target_test(model.experiment, mesh, **options), model.material,
                       lambda done, count: report(f"position {done} of {count}"))
    reached = max(curve.forces.shape[0] - 1, 0)
    return TargetComparison(calibrated=calibrated, depths=calibrated.depths[:reached],
                            target_forces=curve.forces[1:, 2], is_in_target=True, ended=curve.ended,
                            version=curve.version)


def _simulate_law_alone(model: Model, constants: ElasticConstants, calibrated: CalibratedForces) -> TargetCurve:
    """Simulate the test with a neo-Hookean material in this program; its forces are those of the engine's law."""
    material = Material("neo_hooke", {"C10": 0.5 * constants.mu}, Bulk("bulk_ratio", constants.bulk_ratio))
    forces = np.zeros((calibrated.depths.size + 1, 3))
    recording = simulate(replace(model, material=material), estimate_error=False)
    forces[1:, 2] = recording.force[_find_loaded_samples(model.experiment)]
    positions = np.zeros_like(forces)
    positions[1:, 2] = -calibrated.depths
    return TargetCurve(positions, forces, version="neo-Hookean law, without mesh and contact of the engine")


def draw_materials(file: MaterialFile, count: int, seed: int) -> list[Material]:
    """Draw materials from the covariance of the parameters of a material file.

    Draws with invalid values, or with a law that is not stable over the range of stretches in which that of the file is
    stable, are replaced by new ones.

    Args:
        file: material file.
        count: number of draws.
        seed: seed of the random numbers.

    Raises:
        InputError: the file states no covariance, or too many draws are not valid.
    """
    known = file.paths_and_covariance_SI
    if known is None:
        raise InputError("requires a material file with a covariance; this one states none. Calibrate the material, or "
                         "leave --draws out.", field="--draws")
    paths, covariance = known
    material, random = file.material, np.random.default_rng(seed)
    mean = np.array([get_parameter_value(material, path) for path in paths])
    least = find_stability_range(material.energy_law, material.values)
    drawn: list[Material] = []
    for _ in range(SETTINGS.max_redraws * count):
        if len(drawn) == count:
            return drawn
        values = random.multivariate_normal(mean, covariance)
        try:
            one = with_values(material, dict(zip(paths, values.tolist(), strict=True)))
            found = find_stability_range(one.energy_law, one.values)
        except InputError:
            continue
        if least.is_stable_in_whole_range <= found.is_stable_in_whole_range:
            drawn.append(one)
    if len(drawn) < count:
        raise InputError(f"only {len(drawn)} of {SETTINGS.max_redraws * count} draws are valid and stable. Check the "
                         "covariance of the material file.", field="--draws")
    return drawn


def match_draws(model: Model, matched: MatchedConstants, materials: list[Material], *, report: Report,
                **options: str) -> list[ElasticConstants]:
    """Return the constants of drawn materials, with the Poisson's ratio and the mesh factor of a matched material.

    The force of each material is simulated in this program. The engine does not run again: its forces are proportional
    to Young's modulus.

    Args:
        model: test.
        matched: constants of the calibrated material.
        materials: drawn materials.
        report: receives sentences about the progress.
        **options: options of `compute_calibrated_forces`.

    Raises:
        ConvergenceError: the test of a drawn material did not converge.
    """
    found = []
    for number, material in enumerate(materials, start=1):
        report(f"draw {number} of {len(materials)}")
        try:
            forces = compute_calibrated_forces(replace(model, material=material), **options).forces
        except ConvergenceError as error:
            raise ConvergenceError(f"draw {number}: {error}. Use another --seed or a smaller --depth-mm") from None
        scale = fit_scale(matched.target_forces, forces)
        found.append(replace(matched.constants, young=scale * matched.constants.young, density=material.density,
                             damping_time=compute_damping_time(material.viscoelastic, matched.calibrated.duration)))
    return found
