"""Multirate simulation whose bulk is linearised in another process."""

from __future__ import annotations

from typing import Any

from haptics.loop.bulk_process import BulkProcess
from tissue_sim.model import Model
from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.realtime import multirate
from tissue_sim.realtime.multirate import BulkLink
from tissue_sim.realtime.tissue import MotionLimits

__getattr__ = make_getattr_for_old_names(__name__, {
    "ERROR_FLOOR": "tissue_sim.tool_force:ERROR_FLOOR", "ERROR_SHARE": "tissue_sim.tool_force:ERROR_SHARE",
    "OLDEST": "tissue_sim.realtime.multirate:OLDEST"})


class MultiRateTissue(multirate.MultiRateTissue):
    """`tissue_sim.realtime.multirate.MultiRateTissue` with a process for the bulk, which `warm_up` starts.

    Args:
        model: experiment and material.
        solver: solver of the bulk; see `tissue_sim.fem.condensed.model.LINEARISATIONS`.
        resolution: resolution of the mesh of the bulk.
        mesh: mesh of the bulk; None: generated with `resolution`.
        link: link to a bulk; None: to a new process.
        oldest: largest age of the model of a CONVERGED force, s.
        waits: whether a step blocks until the bulk has sent a model for the pose of the step.
        limits: limits of poses and time steps; see `MotionLimits`.

    Raises:
        InputError: a `Simulator` refuses the model; `warm_up` also raises the errors of the linearisation.
    """

    def __init__(self, model: Model, *, solver: str = "solid", resolution: str = "realtime", mesh: Any = None,
                 link: BulkLink | None = None, oldest: float = multirate.MULTIRATE.oldest, waits: bool = False,
                 limits: MotionLimits | None = None):
        self.require_valid_arguments(model, oldest)  # before the task of the process is packed
        super().__init__(model, link or BulkProcess(model, solver=solver, resolution=resolution, mesh=mesh),
                         resolution=resolution if mesh is None else "own mesh", oldest=oldest, waits=waits,
                         limits=limits)
