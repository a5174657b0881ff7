"""Failures of one law that must not end the calibration of the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from calibration.forward.contract import InfeasibleError
from tissue_sim.errors import ConvergenceError

#: What the numbers of one law can raise: no convergence, no force, no such material (`InputError` is a `ValueError`),
#: overflow, a singular matrix (`LinAlgError` is a `ValueError`).
LAW_ERRORS = (ConvergenceError, InfeasibleError, ArithmeticError, ValueError)


@dataclass(frozen=True)
class Failure:
    """Why a part of a calibration has no result."""

    reason: str


def attempt(function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function, or a `Failure` with the reason where the numbers of a law go out of range."""
    try:
        return function(*arguments)
    except LAW_ERRORS as error:
        return Failure(str(error) or type(error).__name__)
