"""Jobs of the benchmark of engines: motion, tool and contact on the cylinder of the reference study."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

import tissue_sim as ts
from calibration.targets.runner import TargetTest
from tissue_sim.mesh.solid import SolidMesh, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0

#: Radius of the cylinder, m.
RADIUS = 0.040
#: Height of the cylinder, m.
HEIGHT = 0.070
#: Radius of all tools, m.
TOOL_RADIUS = 8e-3
#: Coefficient of friction of the jobs with contact, 1.
FRICTION = 0.3
#: K / mu0 of the material, 1.
BULK_RATIO = 1e4
#: K / mu0 in CalculiX, 1: with 1e4 its Newton iterations diverge from increments above 0.05 mm.
CALCULIX_BULK_RATIO = 1e3
#: Material of the reference study; nearly incompressible, elastic, with the density of water.
MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", BULK_RATIO),
                       1000.0, name="silicone of the reference study")
#: Speed of pressing in the jobs with inertia, m/s.
PRESS_SPEED = 0.05
#: Speed of the fast retreat, m/s.
RETREAT_SPEED = 0.2
#: Interval of the positions in the jobs with inertia, s.
SAMPLE_TIME = 2e-3


@dataclass(frozen=True)
class MeshSize:
    """Sizes of the elements of a mesh; see `create_cylinder_mesh_under_needle`.

    Attributes:
        smallest: size of the elements at the edge of the tool, m.
        growth: ratio of successive sizes.
        largest: largest size, m.
        around: number of elements along a quarter of the edge.
    """

    smallest: float
    growth: float
    largest: float
    around: int


#: Name -> sizes of the three meshes.
MESHES = {"coarse": MeshSize(4e-3, 2.0, 20e-3, 2), "middle": MeshSize(2.4e-3, 2.0, 16e-3, 3),
          "fine": MeshSize(1.6e-3, 1.8, 15.2e-3, 4)}


@dataclass(frozen=True)
class Job:
    """Job of the benchmark.

    Attributes:
        name: name on the command line.
        title: description in a few words.
        tool_shape: shape of the tool.
        is_bonded: whether the face of the tool is bonded to the tissue; otherwise it is in contact with `FRICTION`.
        make_motion: returns positions, m, shape (n, 3), and times, s, shape (n,), or None for a quasi-static job.
        steps: the two time steps of engines with dynamics, s. In quasi-static jobs they are steps towards rest.
        offset: distance of the tool from the axis of the cylinder, along x, m.
    """

    name: str
    title: str
    tool_shape: str
    is_bonded: bool
    make_motion: Callable[[], tuple[np.ndarray, np.ndarray | None]]
    steps: tuple[float, float]
    offset: float = 0.0

    @property
    def tool(self) -> ts.Tool:
        """Tool of the job."""
        return ts.Tool(self.tool_shape, radius=TOOL_RADIUS)

    @property
    def is_quasi_static(self) -> bool:
        """Whether the engine waits for rest at each position."""
        return self.make_motion()[1] is None

    def make_test(self, mesh: SolidMesh, time_step: float | None, max_seconds: float) -> TargetTest:
        """Make the test of the job on a mesh.

        Args:
            mesh: mesh of the cylinder.
            time_step: time step, s.
            max_seconds: longest wall time of a position, s.
        """
        positions, times = self.make_motion()
        return TargetTest(mesh, self.tool, positions, self.is_bonded, FRICTION, times, time_step, max_seconds)

    def make_model(self, points: int = 2) -> ts.Model:
        """Make experiment and material of the job for this package, with a ramp of `points` samples to its depth."""
        positions, _ = self.make_motion()
        depth = -float(positions[:, 2].min())
        approach = ts.Approach(self.offset) if self.offset else None
        return ts.Model(ts.Experiment(ts.Specimen(RADIUS, HEIGHT), ts.Protocol.ramp(depth, points), tool=self.tool,
                                      friction="bonded" if self.is_bonded else FRICTION, approach=approach), MATERIAL)


def press(depth: float, count: int, offset: float = 0.0) -> tuple[np.ndarray, None]:
    """Return positions from the surface to a depth, m, in `count` equal steps."""
    positions = np.zeros((count + 1, 3))
    positions[:, 0] = offset
    positions[:, 2] = -np.linspace(0.0, depth, count + 1)
    return positions, None


def press_and_drag(depth: float, distance: float, spacing: float) -> tuple[np.ndarray, None]:
    """Return positions from the surface to a depth and then along x, m, with equal spacing."""
    down, _ = press(depth, round(depth / spacing))
    aside = np.zeros((round(distance / spacing), 3))
    aside[:, 0] = spacing * np.arange(1, len(aside) + 1)
    aside[:, 2] = -depth
    return np.concatenate([down, aside]), None


def move_along_depths(corners: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions on the axis and times, s, at intervals of `SAMPLE_TIME`.

    Args:
        corners: depths, m, negative above the surface, and times, s, between which the tool moves at constant speed.
    """
    depths, times = np.array(corners).T
    samples = SAMPLE_TIME * np.arange(round(times[-1] / SAMPLE_TIME) + 1)
    positions = np.zeros((len(samples), 3))
    positions[:, 2] = -np.interp(samples, times, depths)
    return positions, samples


def release_and_touch_again() -> tuple[np.ndarray, np.ndarray]:
    """Return the motion of the job ``retouch``: 5 mm in, 2 mm above the surface, 5 mm in; a hold after each."""
    depth, above, hold = 5e-3, -2e-3, 0.1
    down, move = depth / PRESS_SPEED, (depth - above) / PRESS_SPEED
    times = np.cumsum([0.0, down, hold, move, hold, move, hold])
    return move_along_depths(list(zip([0.0, depth, depth, above, above, depth, depth], times, strict=True)))


def retreat_fast() -> tuple[np.ndarray, np.ndarray]:
    """Return the motion of the job ``retreat``: 5 mm in, a hold, and out to 5 mm above the surface at 0.2 m/s."""
    depth, above, hold = 5e-3, -5e-3, 0.1
    times = np.cumsum([0.0, depth / PRESS_SPEED, hold, (depth - above) / RETREAT_SPEED, hold])
    return move_along_depths(list(zip([0.0, depth, depth, above, above], times, strict=True)))


#: Name -> job.
JOBS = {job.name: job for job in (
    Job("punch", "bonded flat punch, 10 mm", "flat", True, lambda: press(10e-3, 10), (0.02, 0.01)),
    Job("off_axis", "bonded flat punch 15 mm off the axis, 10 mm", "flat", True, lambda: press(10e-3, 10, 15e-3),
        (0.02, 0.01), 15e-3),
    Job("drag", "ball with friction 0.3, 5 mm in and 5 mm aside", "sphere", False,
        lambda: press_and_drag(5e-3, 5e-3, 0.5e-3), (0.02, 0.01)),
    Job("retouch", "ball, 5 mm in at 50 mm/s, released and pressed in again", "sphere", False, release_and_touch_again,
        (2e-3, 1e-3)),
    Job("retreat", "ball, 5 mm in, retreat at 200 mm/s", "sphere", False, retreat_fast, (2e-3, 1e-3)))}


@cache
def make_mesh(size: str, offset: float) -> SolidMesh:
    """Make a mesh of hexahedra of the cylinder with small elements under a tool at a distance from the axis, m."""
    sizes = MESHES[size]
    return create_cylinder_mesh_under_needle(RADIUS, HEIGHT, TOOL_RADIUS, HEX8P0, smallest=sizes.smallest,
                                             growth=sizes.growth, largest=sizes.largest, around=sizes.around,
                                             centre=(offset, 0.0))
