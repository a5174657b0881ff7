"""How the force of a whole test changes with what the model is made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError, nearest
from tissue_sim.experiment.experiment import Model
from tissue_sim.fem.solver import Derivatives, Solver
from tissue_sim.material.parameters import parameter_values, with_parameter
from tissue_sim.recording.recording import Recording
from tissue_sim.simulation import simulate

#: Width of the differences, relative: of formulas inside the exact method, and of whole simulations.
FORMULA_WIDTH, SIMULATION_WIDTH = 1e-6, 1e-3
#: Parameters of the experiment, by the path of their field; all by differences of simulations.
_EXPERIMENT = ("friction", "friction_base", "friction_wall", "tool.radius", "tool.edge_radius", "tool.half_angle",
               "tool.tip_radius", "specimen.radius", "specimen.height", "specimen.density")


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """A simulated recording and its derivatives.

    Attributes:
        recording: what `simulate` gives with a perfect sensor.
        names: parameters, see `tissue_sim.material.parameters`; those of the experiment are paths such as ``friction``
            or ``tool.edge_radius``, in SI.
        values: dF/dtheta, N per unit of the parameter, shape (samples, parameters).
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
                  mesh: Any = None, solver: str = "axisymmetric") -> Sensitivities:
    """Simulate a test with its derivatives.

    Those with the material are exact: the equations of every converged step are differentiated, history, slip and
    anchors included; bulk modulus as the material states it, so that `bulk.bulk_ratio` is held while the law changes
    where the bulk response is a ratio, and `bulk.K_Pa` where it is a modulus. Where the start or the motion depends on
    the material (self-weight, a rig that gives way), the tool adheres or leans, or the parameter is one of the
    experiment or the thickness of a layer, it is a central difference of two simulations `SIMULATION_WIDTH` apart,
    one-sided at the end of the parameter's range.

    Args:
        model: experiment, material, rig; forces are those on the tool, before the sensor of the rig reads them.
        names: parameters; None: all of the material.
        resolution, mesh, solver: as `simulate`; of a solver that has no derivatives all are differences.

    Raises:
        ConvergenceError: as `simulate`; of differences also where a neighbouring simulation fails.
        InputError: unknown parameter, or what `simulate` refuses.

    Source: implicit differentiation at the converged step, as in Michaleris, Tortorelli and Vidal, Int. J. Numer.
    Methods Eng. 37 (1994) 2471.
    """
    known = parameter_values(model.material)
    names = tuple(known) if names is None else tuple(names)
    for name in names:
        if name not in known and name not in _EXPERIMENT:
            raise InputError(f"unknown parameter{nearest(name, [*known, *_EXPERIMENT])}", field=name)
    model = replace(model, rig=model.rig.motion_only)
    if mesh is not None and (shaped := [name for name in names if _shapes_the_mesh(name)]):
        raise InputError("changes the mesh, which is given; leave the mesh out", field=shaped[0])
    exact = np.array([_exact(model, name) for name in names], dtype=bool)
    options = {"resolution": resolution, "mesh": mesh, "solver": solver}
    watch = _Watch([_pair(model, name) for name, one in zip(names, exact, strict=True) if one])
    recording = simulate(model, watch=watch, **options)
    exact &= watch.exact
    values = np.zeros((len(watch.rates), len(names)))
    if watch.exact:
        values[:, exact] = watch.rates
    if not np.isfinite(values).all():
        raise ConvergenceError("the tangent of a converged step is singular, so the force has no derivative there",
                               recording=recording, depth=float(recording.displacement[-1]))
    for k in np.flatnonzero(~exact):
        values[:, k] = _difference(model, names[k], options)
    return Sensitivities(recording, names, values, exact, np.array(watch.kinks, dtype=bool))


class _Watch:
    """Follows a solver through a test."""

    def __init__(self, pairs: list):
        self._pairs = pairs
        self._derivatives: Derivatives | None = None
        self.exact = False
        self.rates: list[np.ndarray] = []
        self.kinks: list[bool] = []

    def begin(self, solver: Solver) -> None:
        self._derivatives = solver.differentiate(self._pairs)
        self.exact = self._derivatives is not None

    def sample(self, solver: Solver, factor: float) -> None:
        self.rates.append(factor * self._derivatives.force if self.exact else np.zeros(0))
        self.kinks.append(self.exact and self._derivatives.pop_changed())


def _shapes_the_mesh(name: str) -> bool:
    return name.endswith(".thickness_mm") or name.startswith("tool.") or name in ("specimen.radius", "specimen.height")


def _exact(model: Model, name: str) -> bool:
    experiment, pores = model.experiment, model.material.poroelasticity
    if experiment.specimen.specific_weight or experiment.adhesion or experiment.tilt or model.rig.compliance:
        return False
    if name.startswith("poroelasticity.") and pores.phi == 0:
        return False  # a term that appears
    return name not in _EXPERIMENT and not name.endswith(".thickness_mm") and "puncture" not in name


def _pair(model: Model, name: str):
    """The material with a little more and a little less of a parameter, and the difference."""
    value = parameter_values(model.material)[name]
    half = 0.5 * FORMULA_WIDTH * (abs(value) or 1.0)
    return _neighbours(lambda new: with_parameter(model.material, name, new), value, half)


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


def _difference(model: Model, name: str, options: dict) -> np.ndarray:
    """Central difference of two simulations."""
    change, value = _changer(model, name)
    length = model.experiment.tool.radius or model.experiment.specimen.radius
    size = abs(value) or (length if name.startswith(("tool.", "specimen.")) else 1.0)
    more, less, width = _neighbours(change, value, 0.5 * SIMULATION_WIDTH * size)
    return (simulate(more, **options).force - simulate(less, **options).force) / width


def _changer(model: Model, name: str) -> tuple[Callable[[float], Model], float]:
    """What sets a parameter of a model, and its value there."""
    if name not in _EXPERIMENT:
        return (lambda value: replace(model, material=with_parameter(model.material, name, value)),
                parameter_values(model.material)[name])
    part, _, field = name.rpartition(".")
    owner = getattr(model.experiment, part) if part else model.experiment
    value = getattr(owner, field)
    if value == "frictionless":
        value = 0.0
    if not isinstance(value, float | int):
        raise InputError(f"is {value!r} and not a number that could change", field=name)

    def change(new: float) -> Model:
        changed = replace(owner, **{field: new})
        return replace(model, experiment=replace(model.experiment, **{part: changed}) if part else changed)

    return change, float(value)
