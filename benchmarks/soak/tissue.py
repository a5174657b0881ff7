"""Simulator that records every call, so that a session can be replayed."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import tissue_sim as ts
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ToolForce


class LoggedSimulator(ts.Simulator):
    """Simulator that logs its calls in ``FOLDER/PROCESS.calls``, also if the process is killed.

    Args:
        model, settings: see `ts.Simulator`.
        folder: folder of the log.
    """

    def __init__(self, model: ts.Model, *, folder: Path, **settings: Any):
        super().__init__(model, **settings)
        self._first, self._stepped = model, 0.0
        self._calls = (Path(folder) / f"{os.getpid()}.calls").open("wb")

    def warm_up(self) -> None:
        super().warm_up()
        self._note("began", self._first, self.resolution)

    def step(self, pose: float | Pose, dt: float) -> ToolForce:
        answer = super().step(pose, dt)
        self._stepped += dt
        depth = -pose.position[2] if isinstance(pose, Pose) else pose
        self._note("step", self._stepped, depth, int(answer.status), answer.force, dt, False, self._stepped,
                   self._stepped)
        return answer

    def reset(self) -> None:
        super().reset()
        self._note("reset")
        self._note("fault", "reset", self._stepped)

    def set_parameters(self, **values: float) -> None:
        super().set_parameters(**values)
        self._note("parameters", values)
        self._note("fault", "parameters", self._stepped)

    def _note(self, *event: Any) -> None:
        pickle.dump(event, self._calls)


def calls_in(path: Path) -> list[tuple[Any, ...]]:
    """Read the calls of a `LoggedSimulator` up to the end or a damaged record."""
    events = []
    with path.open("rb") as file:
        while True:
            try:
                events.append(pickle.load(file))
            except (EOFError, pickle.UnpicklingError):
                return events
