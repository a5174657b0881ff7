"""Contract of a target runner: a test with a rigid tool that another program simulates on a given mesh."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.mesh.tetrahedral import TetrahedralMesh, make_tetrahedral_mesh
from tissue_sim.registry import Registry

#: Function that receives the number of finished positions and the number of all positions.
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class TargetTest:
    """Test in another program: mesh, rigid tool, contact and motion. Without gravity.

    Attributes:
        mesh: mesh of the specimen, with the node sets ``base`` (fixed) and, if `is_bonded`, ``face`` (moved with the
            tool).
        tool: rigid tool.
        positions: positions of the deepest point of the tool, m, shape (positions, 3); the origin is the centre of the
            undeformed top face, z out of the tissue. The first position does not touch the tissue or touches it
            without force.
        is_bonded: whether the face of the tool is bonded to the node set ``face``; otherwise the tool is in contact
            with `friction`.
        friction: coefficient of friction of the contact, 1.
        times: times of the positions, s, shape (positions,); None: quasi-static, so that the program waits for rest at
            each position.
        time_step: time step of a program with dynamics, s; None: the choice of the runner.
        max_seconds: longest wall time of a position, s.
    """

    mesh: SolidMesh
    tool: Tool
    positions: np.ndarray
    is_bonded: bool = False
    friction: float = 0.0
    times: np.ndarray | None = None
    time_step: float | None = None
    max_seconds: float = 60.0

    @cached_property
    def tetrahedral_mesh(self) -> TetrahedralMesh:
        """Linear tetrahedra of the mesh, for programs without other elements."""
        return make_tetrahedral_mesh(self.mesh)


@dataclass(frozen=True)
class TargetCurve:
    """Forces of a test in another program, up to the last position that the program reached.

    Attributes:
        positions: reached positions, m, shape (n, 3).
        forces: forces on the tool, N, shape (n, 3).
        ended: reason why the program did not reach all positions, as a sentence; empty if it did.
        step_seconds: median CPU time of a time step, or of a position in programs without time steps, s.
        steps: number of time steps of each position, shape (n,).
        penetrations: largest penetration of nodes into the tool at each position, m, shape (n,); empty: not measured.
        version: name and version of the program.
        flagged: number of positions whose force the program itself marks as inaccurate.
    """

    positions: np.ndarray
    forces: np.ndarray
    ended: str = ""
    step_seconds: float = float("nan")
    steps: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    penetrations: np.ndarray = field(default_factory=lambda: np.zeros(0))
    version: str = ""
    flagged: int = 0

    @property
    def depths(self) -> np.ndarray:
        """Depths of the reached positions, m, shape (n,)."""
        return -self.positions[:, 2]


class TargetRunner(ABC):
    """Program that simulates a `TargetTest`.

    Attributes:
        title: name of the program and of its method.
        uses_elastic_constants: whether the program needs `ElasticConstants` instead of the material.
        is_static: whether the program solves for equilibrium only and ignores `TargetTest.times`.
    """

    title: ClassVar[str]
    uses_elastic_constants: ClassVar[bool] = True
    is_static: ClassVar[bool] = False

    @abstractmethod
    def describe_missing_program(self) -> str:
        """Return why the program cannot run here, with the remedy; an empty text if it can."""

    @abstractmethod
    def run(self, test: TargetTest, material: Material | ElasticConstants, progress: Progress | None = None
            ) -> TargetCurve:
        """Simulate a test.

        Args:
            test: test to simulate.
            material: elastic constants if `uses_elastic_constants`, otherwise a material.
            progress: receives finished and all positions.

        Raises:
            InputError: the program is missing, or has no equivalent of a part of the test.
        """


#: Name of an export target -> its runner.
RUNNERS: Registry[TargetRunner] = Registry("runner of a target", "tissue_sim.target_runners", {
    "calculix": "calibration.targets.calculix:RUNNER",
    "felupe": "calibration.targets.felupe:RUNNER",
    "mujoco": "calibration.targets.mujoco_flex:RUNNER",
    "newton": "calibration.targets.newton_vbd:RUNNER",
}, accepts=lambda runner: isinstance(runner, TargetRunner),
    expected="an object of a class derived from TargetRunner")
