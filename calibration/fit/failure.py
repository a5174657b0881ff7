"""Failures of one law that must not end the calibration of the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from calibration.forward.contract import InfeasibleError
from tissue_sim.errors import ConvergenceError

#: Exceptions that the parameter values of one law can cause: no convergence, no force, an invalid material
#: (`InputError` is a `ValueError`), overflow, a singular matrix (`LinAlgError` is a `ValueError`).
LAW_ERRORS = (ConvergenceError, InfeasibleError, ArithmeticError, ValueError)


@dataclass(frozen=True)
class LawFailureRecord:
    """Failure of the calibration of one law, which does not end the calibration of the other laws.

    Attributes:
        reason: description of the failure.
    """

    reason: str


def call_and_catch_law_errors(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function and convert exceptions of `LAW_ERRORS` to a `LawFailureRecord`.

    Args:
        function: function to call.
        arguments: arguments of the function.

    Returns:
        Result of the function, or a `LawFailureRecord`.
    """
    try:
        return function(*arguments)
    except LAW_ERRORS as error:
        return LawFailureRecord(str(error) or type(error).__name__)
