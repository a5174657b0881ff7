"""Which meshes a fit uses of each solver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calibration.forward.motion import spline
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.mesh.grading import Grading
from tissue_sim.mesh.hexahedra import HEX8P0
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.specimen.block import Block

#: Standard deviation of the accurate mesh's own error relative to the force: what is left against independent
#: solvers, see docs/simulation.md. Between plates, under a flat needle, under a round or pointed one.
REMAINDERS = {"plate": 0.0005, "flat": 0.001, "other": 0.002}
#: The same of the fast mesh, where the accurate one does not get through.
FAST_REMAINDERS = {"plate": 0.003, "flat": 0.008, "other": 0.01}
#: Of the finest mesh, where the accurate one's error was found and taken off: at least this, and this share of it.
FINEST_REMAINDERS = {"plate": 0.0002, "flat": 0.0005}
LEFT_OF_DIFFERENCE = 0.5
#: Of a mesh from a file, whose elements nobody makes smaller: what those of second order err by, as a share of what
#: they differ from those of first order; and at most, which is allowed where they do not get through.
LEFT_OF_ORDER, COARSEST_REMAINDER = 0.1, 0.1
#: A force below this share of the largest is too small to be divided by; knots that a course of shares needs.
_FELT, _FEWEST = 1e-3, 4
#: Longer than any specimen, m: an element of this size is cut to what there is.
_WHOLE = 10.0


class Meshes(NamedTuple):
    """Resolutions of a solver that a fit uses, and how large their errors are.

    Attributes:
        fast: on which parameters move. accurate: whose difference to it is added. finest: by which the accurate one's
            own error is found once, at the first parameters; None: it is not. finest_under: tools under which it is.
        elements: what they are, in words.
        remainder: error of either against that of the axisymmetric solver, see `REMAINDERS`.
        slow: whether a simulation takes so long that derivatives by differences are one-sided, and the finest mesh
            takes fewer steps.
    """

    fast: str
    accurate: str
    finest: str | None = None
    remainder: float = 1.0
    finest_under: tuple[str, ...] = tuple(FINEST_REMAINDERS)
    elements: str = "axisymmetric nine-node finite elements"
    slow: bool = False

    def shows_error(self, experiment: Experiment) -> bool:
        """Whether the finest mesh tells the accurate one's error; the elements of a file stay as large as they are."""
        return (self.finest is not None and experiment.tool.shape in self.finest_under
                and not experiment.specimen.from_file)


#: By the name of the solver; of another one as of the axisymmetric.
MESHES = {"axisymmetric": Meshes("fast", "accurate", "finest"),
          "solid": Meshes("realtime", "fast", "accurate", remainder=3.0, finest_under=("plate",),
                           elements="finite elements in space of first order, corrected by ones of second order",
                           slow=True)}


def meshes_of(solver: str) -> Meshes:
    """What is used of a solver, by its name."""
    return MESHES.get(solver, MESHES["axisymmetric"])


def exact_mesh(model: Model, solver: str) -> SolidMesh | None:
    """Eight elements where every mesh of a block is exact; None where the deformation is not homogeneous."""
    experiment = model.experiment
    if (solver != "solid" or not isinstance(experiment.specimen, Block) or not experiment.homogeneous
            or experiment.acting_laws or experiment.tilt or experiment.slip or model.material.layers):
        return None
    return experiment.specimen.solid_mesh(Grading(HEX8P0, _WHOLE, 1.0, _WHOLE, 1))


@dataclass(frozen=True, eq=False)
class MeshError:
    """By how much the accurate mesh errs along a loading, as the finest one shows: a share of the force, which hardly
    depends on the parameters.

    Attributes:
        depth: of its knots, m, shape (k,). share: force of the finest mesh over that of the accurate one, less 1, (k,).
    """

    depth: np.ndarray
    share: np.ndarray

    @classmethod
    def between(cls, depth: np.ndarray, accurate: np.ndarray, finest: np.ndarray) -> MeshError:
        """From the forces of both meshes at the knots of one loading, N, shape (k,)."""
        felt = np.abs(accurate) > _FELT * np.abs(accurate).max(initial=0.0)
        share = finest[felt] / accurate[felt] - 1.0
        return cls(depth[felt], share) if felt.sum() >= _FEWEST else cls.unknown()

    @classmethod
    def unknown(cls) -> MeshError:
        """Where the finest mesh does not get through."""
        return cls(np.zeros(0), np.zeros(0))

    @property
    def largest(self) -> float:
        """Largest share; infinite where it is not known."""
        return float(np.abs(self.share).max(initial=0.0)) if self.share.size else float("inf")

    def factor(self, depth: np.ndarray) -> np.ndarray:
        """What makes the force of the accurate mesh that of the finest, at places of the tool, m, any shape."""
        if not self.share.size:
            return np.ones(np.shape(depth))
        return 1.0 + spline(self.depth, self.share)(np.clip(depth, self.depth[0], self.depth[-1]))
