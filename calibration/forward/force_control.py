"""Residuals of recordings under force control, whose displacement is the response of the specimen.

The forward models compute the force F at the measured displacement d. An error e of the displacement changes this force
by K e, with the tangent K = dF/dd, so that the residual F(d) - f has the covariance K Sigma_d K' + Sigma_f. With K = R
diag(k) (see `ForwardTest.remove_memory`), R^-1 (F(d) - f) has independent samples with the variance k^2 sigma_d^2 +
sigma_f^2 (effective variance). This equals least squares on the displacement at the measured force to first order in
the difference of the displacements; one Newton step makes the remaining error of third order.

Source: Orear, Am. J. Phys. 50 (1982) 912 (effective variance).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.statistics.sensor_noise import whiten_columns

#: Depth, in standard deviations of the noise, up to which the noise may place a sample in the air.
_AIR_DEVIATIONS = 5.0
#: Stiffness of a sample at that depth, relative to the median of the recording, below which the median is its weight: a
#: plate in the air has no stiffness, and the simulated force has a rounded corner at first contact.
_LEAST_STIFFNESS = 0.05
#: Largest change of the displacement in the Newton step, relative to the range of the displacement.
_LARGEST_STEP = 0.1


def whiten_force_changes(test: ForwardTest, answer: Any, recording: int, columns: np.ndarray,
                         contact: np.ndarray | None = None) -> np.ndarray:
    """Return residual and derivatives of the force of a recording in units of its noise, with white noise.

    Args:
        test: forward model.
        answer: solution of the forward model.
        recording: index of the recording in the test.
        columns: residual and derivatives of the force, shape (n, m).
        contact: derivative of the force with respect to the contact offset, N/m, shape (n,), which is needed if the
            force is controlled; None: computed for a contact offset of 0.

    Returns:
        Whitened columns, shape (n, m).
    """
    curve = test.measured[recording]
    if curve.force_control is not None:
        if contact is None:
            contact = test.evaluate_force_and_derivatives(answer, recording, 0.0)[2]
        elastic, _, _, weight = _compute_elastic_columns_stiffness_and_weight(test, answer, recording, contact, columns)
        columns = weight[:, None] * elastic
    return whiten_columns(columns, curve.time, curve.noise)


def evaluate_residual_under_force_control(test: Any, answer: Any, recording: int, offset: float, zero: float,
                                          uses_newton_step: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the whitened residual of a closed form, its derivatives, and the force at the measured displacement.

    Args:
        test: closed form of the test.
        answer: solution of the closed form.
        recording: index of the recording in the test.
        offset: contact offset, m.
        zero: zero of the force, N.
        uses_newton_step: whether the model is linearised at the displacement that it predicts for the measured force
            (one Newton step from the measured displacement); otherwise it is linearised at the measured displacement.

    Returns:
        Residual, N, shape (n,); its derivatives with respect to the free parameters, the contact offset and the zero,
        shape (n, p + 2); force with the zero, N, shape (n,).

    Raises:
        InfeasibleError: see `ForwardTest.evaluate_force_and_derivatives`; the median stiffness is not positive.
    """
    curve, at = test.measured[recording], test
    largest = _LARGEST_STEP * float(np.ptp(curve.displacement))
    forces, step = [], np.zeros(curve.force.size)
    for last in ((False, True) if uses_newton_step else (True,)):
        found, rates, contact = at.evaluate_force_and_derivatives(answer, recording, offset)
        forces.append(found + zero)
        columns = np.column_stack([found + zero - curve.force, rates, contact, np.ones(found.size)])
        elastic, stiffness, positive, weight = _compute_elastic_columns_stiffness_and_weight(at, answer, recording,
                                                                                             contact, columns)
        if not last:
            step = np.clip(-elastic[:, 0] / positive, -largest, largest)
            moved = replace(curve, displacement=curve.displacement + step)
            at = replace(test, measured=(*test.measured[:recording], moved, *test.measured[recording + 1:]))
    # Force at the measured displacement, linearised at the displacement after the step.
    elastic[:, 0] -= stiffness * step
    elastic *= weight[:, None]
    return elastic[:, 0], elastic[:, 1:], forces[0]


def compute_displacement_at_measured_force(test: ForwardTest, answer: Any, recording: int, force: np.ndarray,
                                           contact: np.ndarray) -> np.ndarray:
    """Return the displacement that a model predicts for the measured force, m, shape (n,), to first order.

    Args:
        test: forward model.
        answer: solution of the forward model.
        recording: index in the test of a recording under force control.
        force: force of the model at the measured displacement, N, shape (n,).
        contact: derivative of the force with respect to the contact offset, N/m, shape (n,).
    """
    curve = test.measured[recording]
    elastic, _, positive, _ = _compute_elastic_columns_stiffness_and_weight(test, answer, recording, contact,
                                                                            (force - curve.force)[:, None])
    return curve.displacement - elastic[:, 0] / positive


def _compute_elastic_columns_stiffness_and_weight(test: ForwardTest, answer: Any, recording: int, contact: np.ndarray,
                                                  columns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return R^-1 `columns`, the elastic stiffness k, N/m, the positive stiffness of the weights, and the weights.

    The columns have the shape (n, m), the others (n,). The positive stiffness equals k, but the median of k where the
    sample is in the air or k is negative.

    Raises:
        InfeasibleError: the median stiffness is not positive.
    """
    curve = test.measured[recording]
    noise = curve.force_control
    if noise is None:
        raise ValueError(f"{curve.name} must have the noise of both channels")
    elastic = test.remove_memory(answer, recording, np.column_stack([columns, contact]))
    stiffness = -elastic[:, -1]
    nonzero = stiffness[stiffness != 0]
    middle = float(np.median(nonzero)) if nonzero.size else 0.0
    if not 0 < middle < np.inf:
        raise InfeasibleError(f"{curve.name}: the stiffness of the model must be positive under force control")
    depth = np.abs(curve.displacement) if curve.test.kind.has_gripped_ends else curve.displacement
    is_near_air = (depth < _AIR_DEVIATIONS * noise.displacement) & (stiffness < _LEAST_STIFFNESS * middle)
    positive = np.where((stiffness > 0) & ~is_near_air, stiffness, middle)
    return elastic[:, :-1], stiffness, positive, curve.noise.deviation / np.hypot(noise.force,
                                                                                   positive * noise.displacement)
