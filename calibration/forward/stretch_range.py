"""Range of the principal stretches in a test."""

from __future__ import annotations

from calibration.forward.contract import StretchRange
from calibration.forward.meshes import get_solver_fit_resolutions
from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.model import Model
from tissue_sim.simulation import simulate


def compute_compression_stretch_range(closed_form: ClosedForm, low: float) -> StretchRange:
    """Return the range of the principal stretches in a homogeneous compression, from `low` to 1 along the load.

    Args:
        closed_form: closed form of the test.
        low: smallest stretch along the load.
    """
    return StretchRange(closed_form.mode, low, 1.0, closed_form.find_extreme_stretches(low, 1.0))


def compute_simulated_stretch_range(model: Model | None, solver: str, strain: float) -> StretchRange:
    """Simulate a model, and return the range of its principal stretches without the lowest and highest 1 % of volume.

    Without a converged simulation the range is 1 - `strain` to 1.

    Args:
        model: model in its most deformed state; None: no valid model exists.
        solver: name of the solver.
        strain: displacement divided by the specimen's height.
    """
    fields = None
    if model is not None:
        try:
            fields = simulate(model, resolution=get_solver_fit_resolutions(solver).fast, fields=True, solver=solver,
                              estimate_error=False).fields
        except (ConvergenceError, InputError):
            fields = None
    low, high = (1.0 - strain, 1.0) if fields is None else fields.stretch_range()
    return StretchRange(None, low, high, (low, high))
