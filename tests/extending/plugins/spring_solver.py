"""A solver in one file: a full 6 x 6 spring on the tool, and a slider that gives way sideways.

The wrench is minus the stiffness matrix times the way of the tool from where it first touches; once the spring's force
across the axis is above the slider's limit, the slider follows the tool and keeps it there.
"""

from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.solver import Solver, Step, StepStatus
from tissue_sim.pose import Pose, compute_rigid_motion

#: N/m, N and N m, per m and rad; symmetric and positive definite, every entry of it in use.
STIFFNESS = np.diag([300.0, 250.0, 400.0, 0.02, 0.03, 0.01]) + 0.002 * np.add.outer(np.arange(6), np.arange(6))
#: Initial shear modulus, Pa, for which that is so; the spring is in proportion to it.
REFERENCE = 3000.0
#: N; the slider's, across the axis.
LIMIT = 0.5
TOUCH = Pose((0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Spring:
    """All that a step leaves behind: where the tool is, and how far the slider has gone along x and y, m."""

    pose: Pose = TOUCH
    slid: tuple[float, float] = (0.0, 0.0)


def wrench(pose: Pose, slid, stiffness=STIFFNESS) -> np.ndarray:
    """Return the wrench on the tool, N and N m, shape (6,)."""
    way = np.array(compute_rigid_motion(TOUCH, pose))
    way[:2] -= slid
    return -stiffness @ way


@dataclass(frozen=True)
class SpringSurface:
    """A square under the tool."""

    outline = None

    def triangles(self, segments: int = 48):
        corners = 0.01 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
        return corners, np.array([[0, 1, 2], [0, 2, 3]])


class SpringSolver(Solver):
    """The contract of `tissue_sim.fem.solver.Solver`."""

    def __init__(self, model, *, resolution, mesh=None, topology=None):
        if resolution not in ("realtime", "fast"):
            raise InputError(f"unknown resolution {resolution!r}; a spring has 'realtime' and 'fast'",
                             field="resolution")
        self._asked, self._spring = False, Spring()
        self.set_material(model.material)

    @property
    def pose(self):
        return self._spring.pose

    def step(self, pose, dt=0.0, *, tolerance=1e-9, max_iterations=20, predictor_order=2, inertial=False,
             resumes=False, own_stiffness=True):
        x, y, *_ = compute_rigid_motion(TOUCH, pose)
        across = np.array([x, y])
        pull = wrench(pose, self._spring.slid, self._stiffness)[:2]
        slid = np.array(self._spring.slid)
        if np.hypot(*pull) > LIMIT:
            # The slider goes where the spring across the axis pulls with the limit, along the old direction.
            aim = pull * LIMIT / np.hypot(*pull)
            rest = wrench(pose, across, self._stiffness)[:2]
            slid = across + np.linalg.solve(self._stiffness[:2, :2], aim - rest)
        self._spring = Spring(pose, tuple(slid))
        total = tuple(wrench(pose, slid, self._stiffness).tolist())
        matrix = tuple(map(tuple, self._stiffness.tolist())) if self._asked else None
        return Step(StepStatus.CONVERGED, 1, 0.0, total, matrix)

    def save(self):
        return self._spring

    def restore(self, saved):
        self._spring = saved

    def set_material(self, material):
        self._stiffness = STIFFNESS * (material.mu0 / REFERENCE)

    def reset_to_first_touch(self):
        self._spring = replace(self._spring, pose=TOUCH)

    def enable_stiffness_output(self):
        self._asked = True

    def field_sample(self):
        return self._spring

    def fields(self, samples):
        return None

    def deformed_surface(self):
        return SpringSurface()

    def get_recording_metadata(self):
        return {"element": "spring", "mesh": {"elements": 1, "freedoms": 6}}
