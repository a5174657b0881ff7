"""Force of a test as an operation of JAX: derivatives in both modes, with the Jacobian of the simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tissue_sim.autodiff.force_curve import SECOND_DERIVATIVE, ForceCurve, import_extra_package
from tissue_sim.errors import InputError
from tissue_sim.model import Model


class JaxForceCurve(ForceCurve):
    """Force of a test as a function that JAX differentiates: ``curve(theta)`` is the force at all samples.

    `jax.jvp`, `jax.grad`, `jax.jacfwd`, `jax.jacrev` and `jax.jit` work; one simulation gives force and derivatives.
    `jax.vmap` simulates one theta after the other. Second derivatives are not available: differentiating twice raises
    an error. The simulation runs on the CPU, outside the compiled function.

    JAX must compute in float64: ``jax.config.update("jax_enable_x64", True)``.

    Args:
        model: see `ForceCurve`.
        names: see `ForceCurve`.
        resolution: see `ForceCurve`.
        mesh: see `ForceCurve`.
        solver: see `ForceCurve`.

    Raises:
        InputError: an unknown parameter.
        MissingBackendError: JAX is not installed.

    Examples:
        ``slope = jax.grad(lambda theta: jax.numpy.sum((curve(theta) - measured) ** 2))(curve.values)``
    """

    def __init__(self, model: Model, names: Sequence[str] | None = None, *, resolution: str = "fast", mesh: Any = None,
                 solver: str = "axisymmetric"):
        self._jax = import_extra_package("jax", "jax")
        super().__init__(model, names, resolution=resolution, mesh=mesh, solver=solver)
        self._operation = self._make_operation()

    def __call__(self, theta: Any) -> Any:
        """Return the force, N, an array of JAX of shape (n,).

        Args:
            theta: values of the parameters, SI, float64, shape (m,).

        Raises:
            ConvergenceError: the simulation did not converge.
            InputError: a value outside its bounds, or theta of another type or shape.
            jax.errors.JaxRuntimeError: one of these two errors in a function that JAX has compiled; the message
                contains theirs.
        """
        theta = self._jax.numpy.asarray(theta)
        if theta.dtype != np.float64:
            raise InputError(f"theta must be float64; got {theta.dtype}. Call "
                             'jax.config.update("jax_enable_x64", True) at the start of the program and use float64.')
        if theta.shape != self.values.shape:
            raise InputError(f"theta must have the shape {self.values.shape}; got {theta.shape}. Use jax.vmap for "
                             "several sets of parameters.")
        return self._operation(theta)

    def _make_operation(self) -> Callable[[Any], Any]:
        """Make the function of JAX and its rules of differentiation."""
        jax, n, m = self._jax, self.sample_count, self.values.size
        force_type = jax.ShapeDtypeStruct((n,), np.float64)
        jacobian_type = jax.ShapeDtypeStruct((n, m), np.float64)

        def evaluate(function: Callable[[np.ndarray], Any], types: Any, theta: Any) -> Any:
            """Call a function of NumPy; in a traced function by a callback, in which JAX wraps its errors."""
            if isinstance(theta, jax.core.Tracer):
                return jax.pure_callback(lambda theta: function(np.asarray(theta)), types, theta,
                                         vmap_method="sequential")
            return jax.tree.map(jax.numpy.asarray, function(np.asarray(theta)))

        @jax.custom_jvp
        def compute_force(theta: Any) -> Any:
            return evaluate(self.compute_force, force_type, theta)

        @jax.custom_jvp
        def compute_force_and_jacobian(theta: Any) -> Any:
            return evaluate(self.compute_force_and_jacobian, (force_type, jacobian_type), theta)

        @compute_force.defjvp
        def differentiate_force(primals: Any, tangents: Any) -> Any:
            force, jacobian = compute_force_and_jacobian(*primals)
            return force, jacobian @ tangents[0]

        @compute_force_and_jacobian.defjvp
        def refuse_second_derivative(primals: Any, tangents: Any) -> Any:
            raise NotImplementedError(SECOND_DERIVATIVE)

        return compute_force
