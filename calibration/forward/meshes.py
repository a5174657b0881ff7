"""Meshes that a fit uses with each solver, and the errors of these meshes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calibration.forward.motion import build_cubic_or_linear_spline
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.mesh.solid import Grading, SolidMesh
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.model import Model
from tissue_sim.specimen.block import Block

#: Shape of the tool -> standard deviation of the error of the accurate mesh, relative to the force. The values are
#: differences to independent solvers, see docs/simulation.md; "other" are round and pointed tips.
ACCURATE_MESH_ERRORS = {"plate": 0.0005, "flat": 0.001, "other": 0.002}
#: Shape of the tool -> the same error of the fast mesh, which is used if the accurate mesh does not converge.
FAST_MESH_ERRORS = {"plate": 0.003, "flat": 0.008, "other": 0.01}
#: Shape of the tool -> smallest relative error after correction by the finest mesh.
FINEST_MESH_ERRORS = {"plate": 0.0002, "flat": 0.0005}


@dataclass(frozen=True)
class MeshErrorSettings:
    """Settings of the estimated discretisation errors of meshes.

    Attributes:
        finest_fraction: error after correction by the finest mesh, as a fraction of the correction.
        file_fraction: error of second-order elements on a mesh from a file, as a fraction of their difference to first-
            order elements. Such a mesh is never refined, so only the order of the elements can be compared.
        max_file_error: largest relative error of a mesh from a file; the value if second-order elements do not
            converge.
        min_force_fraction: smallest force at which a relative mesh error is computed, as a fraction of the largest
            force.
        min_knots: smallest number of knots of a curve of relative mesh errors.
    """

    finest_fraction: float = 0.5
    file_fraction: float = 0.1
    max_file_error: float = 0.1
    min_force_fraction: float = 1e-3
    min_knots: int = 4


MESH_ERROR = MeshErrorSettings()
#: Element size larger than any specimen, m; the mesh generator cuts elements to the size of the specimen.
_SPECIMEN_SIZE = 10.0


class SolverFitResolutions(NamedTuple):
    """Resolutions of a solver that a fit uses (fast, accurate and finest), and their errors.

    Attributes:
        fast: resolution during the iterations of the fit.
        accurate: resolution whose difference to the fast one is added as a correction.
        finest: resolution that determines the error of the accurate one, once, at the first parameters; None: none.
        error_factor: error of these meshes relative to those of the axisymmetric solver, see `ACCURATE_MESH_ERRORS`.
        finest_under: shapes of tools for which `finest` is used.
        elements: description of the elements for reports.
        slow: whether simulations are so slow that finite differences are one-sided and the finest mesh uses fewer
            steps.
    """

    fast: str
    accurate: str
    finest: str | None = None
    error_factor: float = 1.0
    finest_under: tuple[str, ...] = tuple(FINEST_MESH_ERRORS)
    elements: str = "axisymmetric nine-node finite elements"
    slow: bool = False

    def uses_finest_mesh_for_mesh_error(self, experiment: Experiment) -> bool:
        """Return whether the finest mesh is used to find the error of the accurate mesh in an experiment.

        False for a mesh from a file.
        """
        return (self.finest is not None and experiment.tool.shape in self.finest_under
                and not experiment.specimen.from_file)


#: Name of the solver -> its meshes; other solvers use the entry of the axisymmetric solver.
MESHES = {"axisymmetric": SolverFitResolutions("fast", "accurate", "finest"),
          "solid": SolverFitResolutions("realtime", "fast", "accurate", error_factor=3.0, finest_under=("plate",),
                                        elements="finite elements in space of first order, corrected by ones of second "
                                        "order",
                                        slow=True)}


def get_solver_fit_resolutions(solver: str) -> SolverFitResolutions:
    """Return the resolutions and mesh errors of a solver (fast, accurate, finest) by the name of the solver."""
    return MESHES.get(solver, MESHES["axisymmetric"])


def make_exact_block_mesh_or_none(model: Model, solver: str) -> SolidMesh | None:
    """Return a mesh of eight elements for a block in homogeneous deformation; None for all other models.

    Every mesh is exact if the deformation is homogeneous.
    """
    experiment = model.experiment
    if (solver != "solid" or not isinstance(experiment.specimen, Block) or not experiment.has_homogeneous_deformation
            or experiment.acting_laws or experiment.tilt or experiment.slip or model.material.layers):
        return None
    return experiment.specimen.solid_mesh(Grading(HEX8P0, _SPECIMEN_SIZE, 1.0, _SPECIMEN_SIZE, 1))


@dataclass(frozen=True, eq=False)
class AccurateMeshErrorOverDepth:
    """Relative error of the accurate mesh along a loading, from the finest mesh.

    The relative error depends little on the material parameters, so one evaluation serves the whole fit.

    Attributes:
        depth: depth of the knots, m, shape (k,).
        relative: force of the finest mesh divided by that of the accurate mesh, minus 1, shape (k,).
    """

    depth: np.ndarray
    relative: np.ndarray

    @classmethod
    def from_accurate_and_finest_forces(cls, depth: np.ndarray, accurate: np.ndarray,
                                        finest: np.ndarray) -> AccurateMeshErrorOverDepth:
        """Return the relative error from the forces of both meshes at the knots of one loading.

        The error is unknown if fewer than `MeshErrorSettings.min_knots` knots have a force that is large enough.

        Args:
            depth: depth of the knots, m, shape (k,).
            accurate: force of the accurate mesh, N, shape (k,).
            finest: force of the finest mesh, N, shape (k,).
        """
        large = np.abs(accurate) > MESH_ERROR.min_force_fraction * np.abs(accurate).max(initial=0.0)
        relative = finest[large] / accurate[large] - 1.0
        return cls(depth[large], relative) if large.sum() >= MESH_ERROR.min_knots \
            else cls.make_unknown_error_without_knots()

    @classmethod
    def make_unknown_error_without_knots(cls) -> AccurateMeshErrorOverDepth:
        """Return an error without knots: `largest_error` is infinite and the correction factor is 1."""
        return cls(np.zeros(0), np.zeros(0))

    @property
    def largest_error(self) -> float:
        """Largest absolute value of the relative force error along the loading; infinite if unknown."""
        return float(np.abs(self.relative).max(initial=0.0)) if self.relative.size else float("inf")

    def compute_correction_factor(self, depth: np.ndarray) -> np.ndarray:
        """Return the factors by which forces of the accurate mesh are multiplied; 1 if the error is unknown.

        Args:
            depth: positions of the tool, m, any shape.
        """
        if not self.relative.size:
            return np.ones(np.shape(depth))
        return 1.0 + build_cubic_or_linear_spline(self.depth,
                                                  self.relative)(np.clip(depth, self.depth[0], self.depth[-1]))
