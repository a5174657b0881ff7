"""Select the tissue for a loop at 1 kHz: a `MultiRateTissue` or a `Simulator`."""

from __future__ import annotations

from functools import partial
from typing import Any

from haptics.loop.multirate import MultiRateTissue
from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.model import LINEARISATIONS
from tissue_sim.model import Model
from tissue_sim.realtime.simulator import Simulator

#: Default wall-time budget of a step in a tick of 1 ms, s; the rest of the tick is left for the ring and the snapshots.
STEP_BUDGET = 0.8e-3


def make_real_time_tissue_factory(model: Model, *, solver: str, resolution: str, budget: float | None,
                                  inertia: str = "auto", looks_ahead: bool = False,
                                  simulator: type[Simulator] = Simulator, mesh: Any = None) -> partial[Any]:
    """Return a function without arguments that makes a tissue for steps at 1 kHz; it can be sent to another process.

    The tissue is a `MultiRateTissue` if the bulk of the solver can be linearised, otherwise a `Simulator`.

    Args:
        model: experiment and material.
        solver: name of the solver.
        resolution: resolution of the mesh.
        budget: computing time per step, s; see `Simulator`.
        inertia: ``auto``, ``on`` or ``off``; see `Simulator`.
        looks_ahead: see `Simulator`.
        simulator: class used instead of `Simulator`.
        mesh: mesh; None: generated with `resolution`.

    Raises:
        InputError: ``inertia = 'on'`` for a solver without inertia.
    """
    if solver not in LINEARISATIONS:
        given = {} if mesh is None else {"mesh": mesh}
        return partial(simulator, model, resolution=resolution, inertia=inertia, looks_ahead=looks_ahead, budget=budget,
                       solver=solver, **given)
    if inertia == "on":
        raise InputError(f"inertia must be 'auto' or 'off' for a multirate solid, which has no mass ({solver!r}); got "
                         "'on'", field="inertia")
    return partial(MultiRateTissue, model, solver=solver, resolution=resolution, mesh=mesh)
