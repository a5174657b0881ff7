"""True forces along a motion: closed forms where one exists, else a new simulator in fine steps along the true path.

The reference of a reduced or multirate scene is the whole solid on the same mesh.

Where the tissue has mass the reference takes the same ticks: the force of a wave depends on the tick
(docs/realtime.md#inertia), so that only the traps are tested there.

Closed forms: no force in the air before the first touch, nor after lift-off where the tissue has no mass; all moduli
times a factor give all elastic forces times this factor; elastic tissue that the tool has left is as new; a bonded tool
that lands off the axis of a wide specimen feels the force of one that lands on the axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import tissue_sim as ts
from benchmarks.motions.course import NOT_COMPARED, PathTick
from benchmarks.motions.scenes import Scene, coarse_mesh, reduced_model, simulator
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose, compute_rigid_motion, interpolate_pose

#: Substeps are at most this fraction of the tool's radius.
LARGEST_SUBSTEP = 1.0 / 48.0
#: Smallest number of substeps of a tick in contact, by solver.
LEAST_SUBSTEPS = {"axisymmetric": 3, "solid": 1}
#: Largest distance of ticks that are merged for the truth of a multirate or reduced scene, m.
LARGEST_MERGED = 1e-4
#: Largest time of ticks that are merged for the truth of a multirate or reduced scene, s.
MERGED_TIME = 8e-3
#: Depth at which the reference touches first, m: friction there is negligible.
TOUCH_DEPTH = 1e-9
#: Height above which tissue without mass cannot reach a tool that lifted off, m.
CLEAR_HEIGHT = 0.0


@dataclass(frozen=True)
class Truth:
    """True wrench at a tick.

    Attributes:
        force, torque: on the tool, N and N m.
        stiffness: the tissue's own along z, N/m; None if it was not evaluated.
        is_known: whether the reference found an equilibrium.
    """

    force: np.ndarray
    torque: np.ndarray
    stiffness: float | None = None
    is_known: bool = True


NOTHING = Truth(np.zeros(3), np.zeros(3), 0.0)


def truths(scene: Scene, path: Sequence[PathTick]) -> dict[int, Truth]:
    """Return the true wrench at each compared tick of a path, by the index of its operation."""
    reference = _Reference(_whole(scene), _start_of(scene, path), _mesh_of(scene))
    found = {}
    for tick in _sampled(path) if scene.solver in ("multirate", "reduced") else path:
        truth = reference.go(tick)
        if tick.index != NOT_COMPARED:
            found[tick.index] = truth
    return found


def _whole(scene: Scene) -> Scene:
    """Return the scene of the reference: the whole solid instead of a multirate or reduced one."""
    return replace(scene, solver="solid") if scene.solver in ("multirate", "reduced") else scene


def _mesh_of(scene: Scene) -> SolidMesh | None:
    """Return the mesh of the reference; None: that of its scene."""
    if scene.solver == "reduced":
        return reduced_model(scene).mesh
    return coarse_mesh() if scene.solver == "multirate" else None


def _sampled(path: Sequence[PathTick]) -> list[PathTick]:
    """Return a path with merged short ticks in the tissue, for a reference slower than the tested simulator."""
    kept: list[PathTick] = []
    waiting = 0.0
    for tick, following in zip(path, [*path[1:], None], strict=True):
        dt = waiting + tick.dt
        last = kept[-1].pose if kept else None
        can_merge = (last is not None and following is not None and following.factor == tick.factor
                     and math.dist(last.position, following.pose.position) < LARGEST_MERGED
                     and dt < MERGED_TIME and max(pose.position[2] for pose in (last, tick.pose, following.pose)) < 0.0)
        if can_merge:
            waiting = dt
            continue
        kept.append(replace(tick, dt=dt))
        waiting = 0.0
    return kept


def _start_of(scene: Scene, path: Sequence[PathTick]) -> tuple[float, float]:
    """Return x and y of the reference's origin, m: first touch of a bonded tool in space, else the axis."""
    if scene.solver == "axisymmetric" or not scene.is_bonded:
        return 0.0, 0.0
    before = None
    for tick in path:
        if tick.pose.position[2] <= 0.0:
            x, y, _ = _crossing(before, tick.pose)[0].position
            return x, y
        before = tick.pose
    return 0.0, 0.0


def _crossing(before: Pose | None, pose: Pose) -> tuple[Pose, float]:
    """Return the pose at which a motion reaches the surface, and the fraction of the motion before it."""
    x, y, z = pose.position
    if before is None or before.position[2] <= 0.0:
        return replace(pose, position=(x, y, 0.0)), 0.0
    height = before.position[2]
    fraction = height / (height - z) if height != z else 1.0
    return interpolate_pose(before, pose, fraction), fraction


class _Reference:
    """A new simulator without bound that follows a path in fine steps.

    Args:
        scene: what is simulated, not multirate and not reduced.
        origin: x and y of the path that are the reference's axis, m.
        mesh: of a whole solid; None: that of the scene.
    """

    def __init__(self, scene: Scene, origin: tuple[float, float], mesh: SolidMesh | None = None):
        self._scene, self._origin, self._mesh = scene, origin, mesh
        self._simulator = simulator(scene, bounded=False, mesh=mesh)
        self._before: Pose | None = None
        self._in_contact, self._has_touched = False, False
        self._is_known, self._has_mass = True, scene.inertia != "off"

    def go(self, tick: PathTick) -> Truth:
        """Return the wrench at the next tick."""
        x, y, z = tick.pose.position
        pose = replace(tick.pose, position=(x - self._origin[0], y - self._origin[1], z))
        before, self._before = self._before, pose
        is_above = z > CLEAR_HEIGHT
        if not self._has_touched and is_above:
            if self._has_mass:
                self._step(pose, tick.dt)
            return NOTHING
        if self._has_mass:
            self._has_touched = True
            self._step(pose, tick.dt)
            return self._truth(tick.factor)
        if self._leaves_for_good(is_above):
            self._simulator = simulator(self._scene, bounded=False, mesh=self._mesh)
            self._in_contact, self._has_touched, self._is_known = False, False, True
            return NOTHING
        if is_above and not self._in_contact:
            self._step(pose, tick.dt)
            return self._truth(tick.factor)
        self._go_in(before, pose, tick.dt)
        self._has_touched, self._in_contact = True, self._scene.is_bonded or not is_above
        return self._truth(tick.factor)

    def _leaves_for_good(self, is_above: bool) -> bool:
        """Return whether the tissue is undeformed again: elastic, without mass, and the tool has lifted off."""
        scene = self._scene
        return is_above and not scene.is_bonded and scene.is_elastic and scene.inertia == "off"

    def _go_in(self, before: Pose | None, pose: Pose, dt: float) -> None:
        """Follow a tick in contact; a tick that began in the air is followed from the touch."""
        first = before is None
        start, fraction = (before, 0.0) if self._in_contact and before is not None else _crossing(before, pose)
        if not self._in_contact:
            x, y, z = start.position
            start = replace(start, position=(x, y, min(z, 0.0) - TOUCH_DEPTH))
            self._step(start, 0.0 if first or not self._has_touched else fraction * dt)
        count = self._substeps(start, pose)
        # The first step has no past: no time passes until the tool is where it is first seen.
        rest = 0.0 if first else (1.0 - fraction) * dt
        for number in range(1, count + 1):
            self._step(interpolate_pose(start, pose, number / count), rest / count)

    def _substeps(self, start: Pose, end: Pose) -> int:
        x, y, z, a, b, c = compute_rigid_motion(start, end)
        distance = math.hypot(x, y, z) + self._scene.radius * math.hypot(a, b, c)
        fine = math.ceil(distance / (LARGEST_SUBSTEP * self._scene.radius) - 1e-9)
        return max(LEAST_SUBSTEPS[self._scene.solver], fine)

    def _step(self, pose: Pose, dt: float) -> None:
        answer = self._answer = self._simulator.step(pose, dt)
        # A later equilibrium of tissue that depends on its path is no truth after one that is missing. An equilibrium
        # whose estimated error is large, by waves or by the mesh, is the truth of the same ticks on the same mesh. One
        # at the end of another path is not.
        is_equilibrium = (answer.status is ts.ForceStatus.LATE and answer.age == 0.0
                          and self._simulator._pending.gap == 0.0)
        self._is_known &= answer.status is ts.ForceStatus.CONVERGED or is_equilibrium

    def _truth(self, factor: float) -> Truth:
        answer = self._answer
        return Truth(factor * np.array(answer.force_vector), factor * np.array(answer.torque_vector),
                     factor * answer.stiffness, self._is_known)
