"""Derivatives of the force of a whole test with respect to parameters of the model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.fem.contact.pairs import differentiate_friction_coefficients
from tissue_sim.fem.solver import (
    FRICTION_PATHS,
    SOLVERS,
    ExperimentDerivatives,
    ForceDerivatives,
    ForceVectorDerivatives,
    Solver,
)
from tissue_sim.material.effect import ForceScalingEffect, TissueEffect
from tissue_sim.material.material import Material
from tissue_sim.material.viscoelasticity import Poroelasticity
from tissue_sim.model import Model
from tissue_sim.parameters import Parameter, get_parameter_value, get_parameters_at_paths, parameters, with_values
from tissue_sim.recording.recording import Recording
from tissue_sim.simulation import simulate


@dataclass(frozen=True)
class FiniteDifferenceSettings:
    """Widths of central differences, relative to the value of the parameter.

    Attributes:
        formula_width: width of differences of formulas within the exact method, 1.
        simulation_width: width of differences of whole simulations, 1. A larger width is less sensitive to the
            tolerance of the solver, and less accurate where the force is nonlinear in the parameter.
    """

    formula_width: float = 1e-6
    simulation_width: float = 1e-3


#: Widths of all derivatives.
DIFFERENCES = FiniteDifferenceSettings()


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """A simulated recording and its derivatives.

    Attributes:
        recording: result of `simulate` with a perfect sensor.
        names: paths of parameters, see `tissue_sim.parameters`; ``material.`` may be left out.
        values: dF/dtheta, N per SI unit of the parameter, shape (samples, parameters).
        exact: whether the derivative is an implicit one (True) or a central difference of simulations, shape
            (parameters,).
        kinks: whether points of the surface came into contact, left it, or changed between sticking and slipping since
            the sample before, shape (samples,). There the force has a kink as a function of the parameters, and the
            derivative is one-sided.
    """

    recording: Recording
    names: tuple[str, ...]
    values: np.ndarray
    exact: np.ndarray
    kinks: np.ndarray


def sensitivities(model: Model, names: Sequence[str] | None = None, *, resolution: str = "fast",
                  mesh: Any = None, solver: str = "axisymmetric", topology: Model | None = None,
                  one_sided: bool = False) -> Sensitivities:
    """Simulate a test and compute the derivatives of its force.

    Derivatives with respect to parameters of the material, to coefficients of friction and to sizes of specimen, tool
    and layers are exact, with the exceptions below: the equations of every converged step are differentiated
    implicitly, with history, slip and stick anchors. The bulk response is held as the material states it:
    `bulk.bulk_ratio` if it is a ratio, `bulk.K_Pa` if it is a modulus.

    Derivatives are central differences of two simulations at the relative distance
    `FiniteDifferenceSettings.simulation_width`, one-sided at the end of a range, in these cases:

    - other parameters of experiment and rig, such as the position of the tool and the angle of a cone;
    - a coefficient of friction or a size of zero; a parameter of drainage while ``phi`` is zero;
    - sizes with self-weight or a contact law; in the solid also with layers or a curved top;
    - all parameters with a compliant rig, a tilted tool, partial slip or additional effects of the material;
    - all parameters with a solver without derivatives for the test: the axisymmetric solver with self-weight, adhesion
      or another contact law; the solid with a contact law under a plate, or on a curved top with the height as placed.

    Changes of geometry move the nodes of one mesh, so that the differences contain no jumps by remeshing.

    Args:
        model: experiment, material, rig; forces are those on the tool, before the sensor reads them.
        names: parameters; None: all of the material.
        resolution: as in `simulate`.
        mesh: as in `simulate`.
        solver: as in `simulate`; with a solver without derivatives all derivatives are differences.
        topology: as in `simulate`.
        one_sided: use one-sided differences to the simulation of the model, which saves one simulation for each.

    Raises:
        ConvergenceError: see `simulate`; for differences also if a simulation with a changed parameter fails.
        InputError: an unknown parameter, a protocol that prescribes a force, or see `simulate`.

    Source: implicit differentiation at the converged step, as in Michaleris, Tortorelli and Vidal, Int. J. Numer.
    Methods Eng. 37 (1994) 2471.
    """
    model.experiment.protocol.require_displacement_control("derivatives of the force", "experiment.protocol")
    of_material = parameters(model.material)
    names = tuple(of_material) if names is None else tuple(names)
    asked = get_parameters_at_paths(model, names)
    model = replace(model, rig=model.rig.with_motion_effects_only)
    own = {f"material.{path}" for path in of_material}
    exact = np.array([(parameter.path in own or parameter.path in FRICTION_PATHS or parameter.declaration.shapes_mesh)
                      and _may_have_exact_derivative(model, parameter) for parameter in asked], dtype=bool)
    options = {"resolution": resolution, "mesh": mesh, "solver": solver, "topology": topology or model,
               "estimate_error": False}
    directions = [_make_parameter_direction(model, parameter)
                  for parameter, one in zip(asked, exact, strict=True) if one]
    watch = _DerivativeObserver(directions, model, options)
    recording = simulate(model, watch=watch, **options)
    exact[exact] = watch.exact
    values = np.zeros((len(watch.rates), len(names)))
    values[:, exact] = watch.rates
    if not np.isfinite(values).all():
        raise ConvergenceError("the tangent of a converged step is singular, so that the force has no derivative there",
                               recording=recording, depth=float(recording.displacement[-1]))
    for k in np.flatnonzero(~exact):
        values[:, k] = _compute_force_derivative_by_differences(model, asked[k], recording.force, options,
                                                                one_sided=one_sided)
    return Sensitivities(recording, names, values, exact, np.array(watch.kinks, dtype=bool))


@dataclass(frozen=True, eq=False)
class _ParameterDirection:
    """Inputs of a solver around a parameter.

    Attributes:
        path: path of the parameter.
        materials: material with the parameter increased, material with it decreased, and the difference.
        experiment: derivatives of the inputs from the experiment; None: zero.
        models: models with the parameter increased and decreased, for a parameter of the geometry; else None.
    """

    path: str
    materials: tuple[Material, Material, float]
    experiment: ExperimentDerivatives | None
    models: tuple[Model, Model] | None = None

    def is_exact(self, solver: Solver) -> bool:
        """Return whether a solver has an exact derivative with respect to the parameter."""
        if self.models is not None:
            return solver.differentiates_geometry
        return self.experiment is None or self.path in solver.exact_experiment_parameters

    def make_experiment_derivatives(self, make_solver: Callable[[Model], Solver]) -> ExperimentDerivatives:
        """Return the derivatives of the inputs from the experiment.

        Args:
            make_solver: makes the solver of a model with other sizes, on the same elements.
        """
        found = self.experiment or ExperimentDerivatives()
        if self.models is None:
            return found
        more, less = map(make_solver, self.models)
        return found._replace(neighbour_solvers=(more, less))


class _DerivativeObserver:
    """Observer of a simulation that collects derivatives.

    Attributes:
        rates: derivatives of the force with respect to the parameters with an exact derivative, one for each sample.
        kinks: whether the contact changed before each sample.
        exact: whether the solver has an exact derivative with respect to each parameter, shape (directions,).
    """

    def __init__(self, directions: list[_ParameterDirection], model: Model, options: dict[str, Any]):
        self._directions, self._model, self._approach = directions, model, model.experiment.approach
        self._options = {name: options[name] for name in ("solver", "resolution")}
        self._derivatives: ForceDerivatives | None = None
        self.rates: list[np.ndarray] = []
        self.kinks: list[bool] = []
        self.exact = np.zeros(len(directions), dtype=bool)

    def before_first_step(self, solver: Solver) -> None:
        """Request derivatives before the first step."""
        exact = np.array([each.is_exact(solver) for each in self._directions], dtype=bool)
        chosen = [each for each, one in zip(self._directions, exact, strict=True) if one]
        derivatives = self._request_derivatives(solver, chosen)
        if derivatives is not None and self._approach is not None and not isinstance(derivatives,
                                                                                     ForceVectorDerivatives):
            derivatives = None
        if derivatives is not None:
            self.exact = exact
        elif chosen:
            # Derivatives without parameters still report the kinks of the force.
            derivatives = self._request_derivatives(solver, [])
        self._derivatives = derivatives

    def _request_derivatives(self, solver: Solver, chosen: list[_ParameterDirection]) -> ForceDerivatives | None:
        """Request the derivatives with respect to some parameters; None if the solver has none."""
        neighbours = [each.materials for each in chosen]
        if all(each.experiment is None and each.models is None for each in chosen):
            return solver.enable_force_derivatives(neighbours)

        def make_neighbour_solver(model: Model) -> Solver:
            """Return the solver of a model with other sizes, on the elements of `solver`."""
            return SOLVERS.find(self._options["solver"], "solver")(
                model, resolution=self._options["resolution"], mesh=solver.mesh, topology=self._model)

        return solver.enable_force_derivatives(neighbours, [each.make_experiment_derivatives(make_neighbour_solver)
                                                            for each in chosen])

    def after_sample(self, solver: Solver, factor: float) -> None:
        """Append the derivatives of the present sample to `rates`, and to `kinks` whether the contact changed.

        `rates` has the derivatives of the force with respect to the parameters.
        """
        derivatives = self._derivatives
        force = np.zeros(0) if derivatives is None else derivatives.force
        if self._approach is not None and isinstance(derivatives, ForceVectorDerivatives):
            force = derivatives.vector @ self._approach.direction_against_motion
        self.rates.append(factor * force)
        self.kinks.append(derivatives is not None and derivatives.pop_contact_changed_flag())


def _may_have_exact_derivative(model: Model, parameter: Parameter) -> bool:
    """Return whether a solver may differentiate its equations with respect to a parameter of material or friction.

    Otherwise, the derivative is a difference of two simulations.
    """
    if model.experiment.tilt or model.experiment.slip or model.rig.compliance:
        return False
    added = [effect for effect in model.material.effects.values() if not isinstance(effect, ForceScalingEffect)]
    if issubclass(parameter.part, TissueEffect) or added:
        return False
    if parameter.declaration.shapes_mesh:
        # A size that is zero may change the kind of the outline; the position of an off-axis tool changes the motion.
        return parameter.value > 0.0 and not parameter.path.startswith("experiment.approach.")
    if parameter.path in FRICTION_PATHS:
        # Without friction the contact has no slipping points, which appear with a change of the coefficient.
        return parameter.value > 0.0
    # With phi = 0 the drainage term is absent, and would appear with a change of phi.
    phi = f"{parameter.path.rpartition('.')[0]}.phi"
    return not (issubclass(parameter.part, Poroelasticity) and get_parameter_value(model, phi) == 0.0)


def _make_parameter_direction(model: Model, parameter: Parameter) -> _ParameterDirection:
    """Return material and inputs from the experiment around a parameter."""
    half = 0.5 * DIFFERENCES.formula_width * (abs(parameter.value) or 1.0)
    more, less, width = _evaluate_at_both_perturbed_values(lambda new: with_values(model, {parameter.path: new}),
                                                           parameter.value, half)
    experiment = None
    if parameter.path in FRICTION_PATHS:
        experiment = differentiate_friction_coefficients(more.experiment, less.experiment, width)
    elif parameter.declaration.shapes_mesh:
        return _ParameterDirection(parameter.path, (model.material, model.material, width), None, (more, less))
    return _ParameterDirection(parameter.path, (more.material, less.material, width), experiment)


def _evaluate_at_both_perturbed_values(change: Callable, value: float, half: float):
    """Evaluate a function at ``value + half`` and ``value - half`` for a central difference.

    The difference is one-sided at the end of the valid range.

    Returns:
        (result at the larger value, result at the smaller value, difference of the two values).

    Raises:
        InputError: both values are invalid.
    """
    made = []
    for new in (value + half, value - half):
        try:
            made.append((change(new), new))
        except InputError as error:
            refusal = error
            made.append((change(value), value))
    (more, high), (less, low) = made
    if high == low:
        raise refusal
    return more, less, high - low


def _compute_force_derivative_by_differences(model: Model, parameter: Parameter, force: np.ndarray, options: dict, *,
                                             one_sided: bool) -> np.ndarray:
    """Compute the derivative of the force by a central difference of two simulations, N per SI unit, shape (n,).

    Both simulations use one mesh, whose nodes move with the geometry.

    The difference is one-sided, with the force of the model itself, N, if requested or if only one side is valid.

    Raises:
        InputError: both values are invalid.
    """
    length = model.experiment.tool.radius or model.experiment.specimen.margin()
    size, value = abs(parameter.value) or (length if parameter.declaration.unit == "m" else 1.0), parameter.value
    half, sides = 0.5 * DIFFERENCES.simulation_width * size, []
    for step in (2.0 * half, -2.0 * half) if one_sided else (half, -half):
        try:
            neighbour = with_values(model, {parameter.path: value + step})
        except InputError as error:
            refusal = error
            continue
        sides.append((simulate(neighbour, **options).force, value + step))
        if one_sided:
            break
    if not sides:
        raise refusal
    if len(sides) == 1:
        sides.append((force, value))
    (more, high), (less, low) = sides
    return (more - less) / (high - low)
