"""Force of a test as an operation of PyTorch, differentiated in reverse mode with the Jacobian of the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from tissue_sim.autodiff.force_curve import SECOND_DERIVATIVE, ForceCurve, import_extra_package
from tissue_sim.errors import InputError
from tissue_sim.model import Model


class TorchForceCurve(ForceCurve):
    """Force of a test as a function that PyTorch differentiates: ``curve(theta)`` is the force at all samples.

    ``backward()`` and `torch.autograd.grad` use the Jacobian of the same simulation. Second derivatives are not
    available: differentiating twice raises an error. The simulation runs on the CPU; force and gradient are on the
    device of theta.

    Args:
        model: see `ForceCurve`.
        names: see `ForceCurve`.
        resolution: see `ForceCurve`.
        mesh: see `ForceCurve`.
        solver: see `ForceCurve`.

    Raises:
        InputError: an unknown parameter.
        MissingBackendError: PyTorch is not installed.

    Examples:
        ``((curve(theta) - measured) ** 2).sum().backward()`` sets ``theta.grad``.
    """

    def __init__(self, model: Model, names: Sequence[str] | None = None, *, resolution: str = "fast", mesh: Any = None,
                 solver: str = "axisymmetric"):
        self._torch = import_extra_package("torch", "torch")
        super().__init__(model, names, resolution=resolution, mesh=mesh, solver=solver)

    def __call__(self, theta: Any) -> Any:
        """Return the force, N, a tensor of shape (n,).

        Args:
            theta: values of the parameters, SI, tensor of float64, shape (m,).

        Raises:
            ConvergenceError: the simulation did not converge.
            InputError: a value outside its bounds, or theta of another type or shape.
        """
        if not isinstance(theta, self._torch.Tensor) or theta.dtype != self._torch.float64:
            got = theta.dtype if isinstance(theta, self._torch.Tensor) else type(theta).__name__
            raise InputError(f"theta must be a tensor of torch.float64; got {got}. Use "
                             "torch.tensor(values, dtype=torch.float64).")
        needs_gradient = theta.requires_grad and self._torch.is_grad_enabled()
        return _make_force_function().apply(theta, self, needs_gradient)


@cache
def _make_force_function() -> Any:
    """Return the class of the operation, a `torch.autograd.Function`."""
    torch = import_extra_package("torch", "torch")
    base: Any = torch.autograd.Function

    class Force(base):
        """Force of a curve at theta."""

        @staticmethod
        def forward(ctx: Any, theta: Any, curve: ForceCurve, needs_gradient: bool) -> Any:
            values = theta.detach().cpu().numpy()
            if needs_gradient:
                force, jacobian = curve.compute_force_and_jacobian(values)
                ctx.save_for_backward(theta, torch.from_numpy(jacobian).to(theta.device))
            else:
                force = curve.compute_force(values)
            return torch.from_numpy(force).to(theta.device)

        @staticmethod
        def backward(ctx: Any, weights: Any) -> Any:
            theta, jacobian = ctx.saved_tensors
            return ForceGradient.apply(weights, jacobian, theta), None, None

    class ForceGradient(base):
        """Gradient of a weighted sum of the forces.

        The argument theta makes the gradient depend on theta in the graph. Otherwise, the second derivative of a loss
        that is linear in the force would be zero, without an error.
        """

        @staticmethod
        def forward(ctx: Any, weights: Any, jacobian: Any, theta: Any) -> Any:
            return weights @ jacobian

        @staticmethod
        def backward(ctx: Any, weights: Any) -> Any:
            raise NotImplementedError(SECOND_DERIVATIVE)

    return Force
