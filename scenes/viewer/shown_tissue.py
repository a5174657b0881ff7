"""The tissue of the viewer's loop: what it publishes for pictures, whichever solver computes it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from tissue_sim.simulator import Simulator
from tissue_sim.snapshot import Snapshot


@dataclass(frozen=True, eq=False)
class SurfaceStates:
    """The triangles of a surface, in the place that fields have in a snapshot which a loop publishes.

    Attributes:
        states: vertices in the frame of the scene, m, shape (vertices, 3).
        triangles: vertex numbers, shape (triangles, 3).
    """

    states: np.ndarray
    triangles: np.ndarray
    stresses: None = None
    #: Nothing of it changes with the material alone.
    OF_THE_MATERIAL: ClassVar = ()


class ShownTissue(Simulator):
    """A simulator whose snapshots have fields where a section can be drawn, and else the triangles of the surface.

    Args:
        arguments, options: as of `Simulator`. The surface of a solver without a section keeps its triangles.
    """

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self._has_section = self.surface().outline is not None

    def snapshot(self) -> Snapshot:
        """The tissue at the last equilibrium; its `fields` may be `SurfaceStates`."""
        snapshot = super().snapshot()
        if self._has_section:
            return snapshot
        vertices, triangles = self.surface().triangles()
        return replace(snapshot, fields=SurfaceStates(np.asarray(vertices, dtype=float).reshape(-1, 3),
                                                      np.asarray(triangles).reshape(-1, 3)))
