"""How the force of a whole test changes with what the model is made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.approach import Approach
from tissue_sim.fem.solver import Derivatives, Solver, SpatialDerivatives
from tissue_sim.material.effect import ReducedEffect, TissueEffect
from tissue_sim.material.poroelasticity import Poroelasticity
from tissue_sim.model import Model
from tissue_sim.parameters import Parameter, find_parameters, parameters, value, with_values
from tissue_sim.recording.recording import Recording
from tissue_sim.simulation import simulate

#: Width of the differences, relative: of formulas inside the exact method, and of whole simulations.
FORMULA_WIDTH, SIMULATION_WIDTH = 1e-6, 1e-3
@dataclass(frozen=True, eq=False)
class Sensitivities:
    """A simulated recording and its derivatives.

    Attributes:
        recording: what `simulate` gives with a perfect sensor.
        names: paths of parameters, see `tissue_sim.parameters`; ``material.`` may be left out.
        values: dF/dtheta, N per SI unit of the parameter, shape (samples, parameters).
        exact: by implicit differentiation (True) or by a central difference of simulations, shape (parameters,).
        kinks: samples on whose way points of the surface came into contact, left it, or changed between sticking and
            slipping, shape (samples,): near there the force has a kink in the parameters, and a derivative holds to one
            side only.
    """

    recording: Recording
    names: tuple[str, ...]
    values: np.ndarray
    exact: np.ndarray
    kinks: np.ndarray


def sensitivities(model: Model, names: Sequence[str] | None = None, *, resolution: str = "fast",
                  mesh: Any = None, solver: str = "axisymmetric", topology: Model | None = None,
                  one_sided: bool = False) -> Sensitivities:
    """Simulate a test with its derivatives.

    Those with the material are exact: the equations of every converged step are differentiated, history, slip and
    anchors included; bulk modulus as the material states it, so that `bulk.bulk_ratio` is held while the law changes
    where the bulk response is a ratio, and `bulk.K_Pa` where it is a modulus. Where the rig gives way, the tool leans
    or slips in part, an effect was added to the material, the solver has none (the axisymmetric one of a specimen that
    weighs, and with adhesion or another law of contact), or the parameter is one of the experiment, the rig or the
    mesh, it is a central difference of two simulations `SIMULATION_WIDTH` apart, one-sided at the end of its range.
    Geometry moves the nodes of one mesh, so that such a difference has no jumps of remeshing.

    Args:
        model: experiment, material, rig; forces are those on the tool, before the sensor of the rig reads them.
        names: parameters; None: all of the material.
        resolution, mesh, solver, topology: as `simulate`; of a solver that has no derivatives all are differences.
        one_sided: differences are to the simulation that there is anyhow, which takes one less for each.

    Raises:
        ConvergenceError: as `simulate`; of differences also where a neighbouring simulation fails.
        InputError: unknown parameter, or what `simulate` refuses.

    Source: implicit differentiation at the converged step, as in Michaleris, Tortorelli and Vidal, Int. J. Numer.
    Methods Eng. 37 (1994) 2471.
    """
    of_material = parameters(model.material)
    names = tuple(of_material) if names is None else tuple(names)
    asked = find_parameters(model, names)
    model = replace(model, rig=model.rig.motion_only)
    own = {f"material.{path}" for path in of_material}
    exact = np.array([parameter.path in own and _exact(model, parameter) for parameter in asked], dtype=bool)
    options = {"resolution": resolution, "mesh": mesh, "solver": solver, "topology": topology or model,
               "estimate_error": False}
    watch = _Watch([_pair(model, parameter) for parameter, one in zip(asked, exact, strict=True) if one],
                   model.experiment.approach)
    recording = simulate(model, watch=watch, **options)
    exact &= watch.exact
    values = np.zeros((len(watch.rates), len(names)))
    if watch.exact:
        values[:, exact] = watch.rates
    if not np.isfinite(values).all():
        raise ConvergenceError("the tangent of a converged step is singular, so the force has no derivative there",
                               recording=recording, depth=float(recording.displacement[-1]))
    for k in np.flatnonzero(~exact):
        values[:, k] = _difference(model, asked[k], recording.force, options, one_sided=one_sided)
    return Sensitivities(recording, names, values, exact, np.array(watch.kinks, dtype=bool))


class _Watch:
    """Follows a solver through a test."""

    def __init__(self, pairs: list, approach: Approach | None):
        self._pairs, self._approach = pairs, approach
        self._derivatives: Derivatives | None = None
        self.rates: list[np.ndarray] = []
        self.kinks: list[bool] = []
        self.exact = False

    def begin(self, solver: Solver) -> None:
        derivatives = solver.differentiate(self._pairs)
        along_z = self._approach is None
        self.exact = along_z or isinstance(derivatives, SpatialDerivatives) if derivatives else False
        # Without parameters it still tells where the force has kinks.
        self._derivatives = derivatives if self.exact or not self._pairs else solver.differentiate([])

    def sample(self, solver: Solver, factor: float) -> None:
        derivatives = self._derivatives
        force = np.zeros(0) if derivatives is None else derivatives.force
        if self._approach is not None and isinstance(derivatives, SpatialDerivatives):
            force = derivatives.vector @ self._approach.against
        self.rates.append(factor * force)
        self.kinks.append(derivatives is not None and derivatives.pop_changed())


def _exact(model: Model, parameter: Parameter) -> bool:
    """Whether a solver may differentiate its equations with respect to a parameter of the material."""
    if model.experiment.tilt or model.experiment.slip or model.rig.compliance:
        return False
    added = [effect for effect in model.material.effects.values() if not isinstance(effect, ReducedEffect)]
    if issubclass(parameter.part, TissueEffect) or added or parameter.declaration.shapes_mesh:
        return False
    # Pores of no share are a term that appears.
    share = f"{parameter.path.rpartition('.')[0]}.phi"
    return not (issubclass(parameter.part, Poroelasticity) and value(model, share) == 0.0)


def _pair(model: Model, parameter: Parameter):
    """The material with a little more and a little less of a parameter, and the difference."""
    half = 0.5 * FORMULA_WIDTH * (abs(parameter.value) or 1.0)
    return _neighbours(lambda new: with_values(model, {parameter.path: new}).material, parameter.value, half)


def _neighbours(change: Callable, value: float, half: float):
    """What a little more and a little less of a parameter make, and the difference; one-sided at the end of its range.

    Raises:
        InputError: neither side is allowed.
    """
    made = []
    for new in (value + half, value - half):
        try:
            made.append((change(new), new))
        except InputError:
            made.append((change(value), value))
    (more, high), (less, low) = made
    return more, less, high - low


def _difference(model: Model, parameter: Parameter, force: np.ndarray, options: dict, *, one_sided: bool) -> np.ndarray:
    """Central difference of two simulations on one mesh, whose nodes move with the geometry; one-sided, against the
    force of the model itself, N, where that is asked for or only one side is allowed.

    Raises:
        InputError: neither side is allowed.
    """
    length = model.experiment.tool.radius or model.experiment.specimen.margin()
    size, value = abs(parameter.value) or (length if parameter.declaration.unit == "m" else 1.0), parameter.value
    half, sides = 0.5 * SIMULATION_WIDTH * size, []
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
