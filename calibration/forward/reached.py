"""How far a test stretches its tissue."""

from __future__ import annotations

from calibration.forward.contract import Reached
from calibration.forward.meshes import meshes_of
from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.model import Model
from tissue_sim.simulation import simulate


def reached_at(closed_form: ClosedForm, low: float) -> Reached:
    """Of a homogeneous test, to this stretch."""
    return Reached(closed_form.mode, low, 1.0, closed_form.extremes(low, 1.0))


def reached_in(model: Model | None, solver: str, strain: float) -> Reached:
    """Of the volume of a model, without a hundredth at either end, or what the nominal strain says where it does not
    get through.

    Args:
        model: None: there is none. solver: that simulates it. strain: displacement over height.
    """
    fields = None
    if model is not None:
        try:
            fields = simulate(model, resolution=meshes_of(solver).fast, fields=True, solver=solver,
                              estimate_error=False).fields
        except (ConvergenceError, InputError):
            fields = None
    low, high = (1.0 - strain, 1.0) if fields is None else fields.stretch_range()
    return Reached(None, low, high, (low, high))
