"""Force of a test as a function of parameters, with its Jacobian matrix; the results at the last theta are cached."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np

from tissue_sim.differentiation import Sensitivities, sensitivities
from tissue_sim.errors import InputError, MissingBackendError
from tissue_sim.model import Model
from tissue_sim.parameters import get_parameters_at_paths, parameters, with_values
from tissue_sim.simulation import simulate

#: Message of an attempt to differentiate twice.
SECOND_DERIVATIVE = ("a force curve has first derivatives only. Use the Gauss-Newton matrix J^T J with the Jacobian J "
                     "of the force, or a quasi-Newton method, instead of second derivatives.")


class ForceCurve:
    """Force of a test at all its samples as a function of parameters: theta -> F(theta), with the Jacobian dF/dtheta.

    F is the force on the tool, before the sensor reads it. The protocol, all other parameters and the elements of the
    mesh are those of the model; geometry moves the nodes of this mesh.

    One simulation gives force and Jacobian. The curve caches force and Jacobian of the last theta. Several threads may
    use one curve; they wait for each other.

    Args:
        model: experiment, material and rig.
        names: paths of m parameters, see `tissue_sim.parameters`; ``material.`` may be left out. None: all of the
            material.
        resolution: as in `tissue_sim.simulate`.
        mesh: as in `tissue_sim.simulate`.
        solver: as in `tissue_sim.simulate`.

    Attributes:
        model: the model.
        names: paths of the parameters.
        values: values of the parameters in the model, SI, shape (m,).
        bounds: lowest and highest value of each parameter, SI, shape (m, 2).

    Raises:
        InputError: an unknown parameter, or a protocol that prescribes a force.
    """

    def __init__(self, model: Model, names: Sequence[str] | None = None, *, resolution: str = "fast", mesh: Any = None,
                 solver: str = "axisymmetric"):
        model.experiment.protocol.require_displacement_control("derivatives of the force", "experiment.protocol")
        self.names = tuple(parameters(model.material) if names is None else names)
        found = get_parameters_at_paths(model, self.names)
        self.model = model
        self.values = np.array([each.value for each in found])
        self.bounds = np.array([each.declaration.bounds for each in found]).reshape(-1, 2)
        self._paths = [each.path for each in found]
        self._options = {"resolution": resolution, "mesh": mesh, "solver": solver, "topology": model}
        self._lock = threading.RLock()
        self._theta: bytes | None = None
        self._force: np.ndarray | None = None
        self._answer: Sensitivities | None = None
        self._exact: np.ndarray | None = None

    @property
    def sample_count(self) -> int:
        """Number n of samples of the protocol, and of the force."""
        return self.model.experiment.protocol.time.size

    @property
    def exact(self) -> np.ndarray:
        """Whether the derivative is exact (True) or a difference of simulations, as in `Sensitivities`, shape (m,).

        It belongs to the last Jacobian and may change with theta: at a coefficient of friction of 0 the derivative is
        a difference. Before the first Jacobian, reading this attribute computes the Jacobian at `values`.
        """
        with self._lock:
            if self._exact is None:
                self.compute_force_and_jacobian(self.values)
            assert self._exact is not None
            return self._exact.copy()

    def compute_force(self, theta: np.ndarray) -> np.ndarray:
        """Return the force, N, shape (n,).

        If all derivatives of the last Jacobian are exact, the Jacobian is computed and cached too, because exact
        derivatives add little time. Otherwise, and before the first Jacobian, only the model itself is simulated.

        Args:
            theta: values of the parameters, SI, float64, shape (m,).

        Raises:
            ConvergenceError: the simulation did not converge.
            InputError: a value outside its bounds, or theta of another type or shape.
        """
        theta = self._check_parameter_values(theta)
        with self._lock:
            if self._theta == theta.tobytes() and self._force is not None:
                return self._force.copy()
            if self._exact is not None and self._exact.all():
                return self.compute_force_and_jacobian(theta)[0]
            model = self._make_model(theta)
            force = simulate(model, estimate_error=False, **self._options).force
            self._theta, self._force, self._answer = theta.tobytes(), force, None
            return force.copy()

    def compute_force_and_jacobian(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the force, N, shape (n,), and its derivatives, N per SI unit of the parameter, shape (n, m).

        Args:
            theta: values of the parameters, SI, float64, shape (m,).

        Raises:
            ConvergenceError: the simulation did not converge, or one with a changed parameter for a difference.
            InputError: a value outside its bounds, or theta of another type or shape.

        Source: `tissue_sim.sensitivities`.
        """
        theta = self._check_parameter_values(theta)
        with self._lock:
            if self._theta != theta.tobytes() or self._answer is None:
                answer = sensitivities(self._make_model(theta), self._paths, **self._options)
                self._theta, self._force, self._answer = theta.tobytes(), answer.recording.force, answer
                self._exact = answer.exact
            assert self._force is not None
            return self._force.copy(), self._answer.values.copy()

    def _make_model(self, theta: np.ndarray) -> Model:
        """Return the model with other parameter values and without the sensor effects of the rig."""
        changed = with_values(self.model, dict(zip(self._paths, theta.tolist(), strict=True)))
        return Model(changed.experiment, changed.material, changed.rig.with_motion_effects_only)

    def _check_parameter_values(self, theta: Any) -> np.ndarray:
        """Return theta as an array; raise an `InputError` for another type or shape, or for a value out of bounds."""
        theta = np.ascontiguousarray(theta)
        if theta.dtype != np.float64 or theta.shape != self.values.shape:
            raise InputError(f"theta must be float64 of shape {self.values.shape}; got {theta.dtype} of shape "
                             f"{theta.shape}.")
        for name, value, (low, high) in zip(self.names, theta.tolist(), self.bounds.tolist(), strict=True):
            if not low <= value <= high:
                raise InputError(f"must be between {low:g} and {high:g}; got {value:g}. Use an optimiser with bounds.",
                                 field=name)
        return theta


def import_extra_package(package: str, extra: str) -> Any:
    """Import a package of an extra of tissue_sim.

    Raises:
        MissingBackendError: the package is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise MissingBackendError(f"{package} must be installed for this function ({error}). "
                                  f"Install it with pip install 'tissue-sim[{extra}]'.") from None
