"""Path of the tool since the last equilibrium, as a list of ticks.

A step that is late leaves its tick to the next steps. The force on tissue with mass, memory or friction depends on the
whole path: if one straight line replaced the late ticks, the force after a turn of the tool would be that of another
motion. Ticks are merged if the tool moves along one line (evenly, if the force depends on time). If more than
`MOST_TICKS` ticks are pending, the oldest ticks are merged as well, and `PendingPath.lost` is the time for which the
force may be wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from tissue_sim.pose import Pose, Screw, between, motion
from tissue_sim.wave_error import WaveError

#: Largest number of ticks that are followed one by one. The oldest ones beyond it are merged.
MOST_TICKS = 32


@dataclass(frozen=True, slots=True)
class Tick:
    """A part of the path.

    Attributes:
        pose: where it ends.
        dt: its time, s.
        touches: whether the tool is in the air until then and meets tissue in the next tick; see
            `FreeTool.bind_points_on_path`.
    """

    pose: Pose
    dt: float
    touches: bool = False


class PendingPath:
    """Ticks between the pose of the last equilibrium and that of the tool.

    Attributes:
        ticks: in their order.
        meets: whether the tool meets tissue in the next increment; see `FreeTool.bind_points_on_path`.
        lost: time for which an equilibrium is not that of the tool's own motion, since ticks that were not on one line
            were merged, s.
        gap: time for which an equilibrium depends on a part of the path that was left out, s; infinite while the tool
            is in contact, because friction depends on the whole path since the touch.
        is_direct: whether the tool has moved straight down since its touch, as it does in a `restart`.
        waves: error of the force by waves that the steps do not resolve.
    """

    __slots__ = ("_spare", "gap", "is_direct", "lost", "meets", "ticks", "waves")

    def __init__(self) -> None:
        self.ticks: list[Tick] = []
        self.meets, self.lost, self._spare, self.waves = False, 0.0, 0.0, WaveError()
        self.gap, self.is_direct = 0.0, True

    def copy(self) -> PendingPath:
        """An independent copy, for saved states."""
        other = PendingPath()
        other.ticks, other.meets, other.lost, other._spare = list(self.ticks), self.meets, self.lost, self._spare
        other.gap, other.is_direct, other.waves = self.gap, self.is_direct, self.waves.copy()
        return other

    @property
    def time(self) -> float:
        """Time since the last equilibrium, s."""
        return self._spare + sum(tick.dt for tick in self.ticks)

    @property
    def is_empty(self) -> bool:
        """Whether the last equilibrium is that of the last pose."""
        return not self.ticks and self._spare == 0.0

    def extend(self, pose: Pose, dt: float) -> None:
        """Append a tick that lasts dt, s."""
        self.ticks.append(Tick(pose, self._spare + dt))
        self._spare = 0.0
        self.lost, self.gap = max(0.0, self.lost - dt), max(0.0, self.gap - dt)

    def extend_to_touch(self, pose: Pose, dt: float) -> None:
        """Append the part of a tick, s, in which a tool that comes back from a pose has yet to reach the tissue."""
        if dt > 0.0:
            self.ticks.append(Tick(pose, dt, touches=True))
        else:
            self.meets = True

    def split_first(self, start: Pose, fraction: float) -> None:
        """Split the first tick where a tool that comes back from a pose touches, after this fraction of the tick."""
        first, self.ticks = self.ticks[0], self.ticks[1:]
        rest = replace(first, dt=(1.0 - fraction) * first.dt)
        air = Tick(start, fraction * first.dt, touches=True)
        self.meets = air.dt == 0.0
        self.ticks[:0] = [rest] if self.meets else [air, rest]

    def give_up(self) -> None:
        """Leave out the poses of all ticks, which cannot be reached; their time is added to the next tick."""
        self._spare, self.ticks = self.time, []

    @property
    def is_incomplete(self) -> bool:
        """Whether an equilibrium may differ from that of the tool's own motion, because a part of it was left out."""
        return self.lost > 0.0 or self.gap > 0.0

    def restart(self, pose: Pose, *, rubs: bool, ages: bool) -> None:
        """Replace all ticks by one that leads straight down to a pose in the same time, from the undeformed tissue.

        Args:
            pose: end of the tick.
            rubs: whether the force depends on the path, as with friction.
            ages: whether the force depends on the time of the path.
        """
        self._spare, self.ticks = 0.0, [Tick(pose, self.time)]
        if ages or (rubs and not self.is_direct):
            self.gap = math.inf

    def note_motion(self, way: Screw, negligible: float) -> None:
        """Register a motion of the tool in contact, m and rad; shorter parts than `negligible` are ignored."""
        x, y, z, a, b, c = way
        if z > negligible or max(abs(x), abs(y), abs(a), abs(b), abs(c)) > negligible:
            self.is_direct = False

    def lift_off(self, memory: float) -> None:
        """Shorten `gap` in the air, where friction ends, to the time for which the tissue remembers its path, s."""
        self.gap = min(self.gap, memory)

    def merge(self, start: Pose, radius: float, tolerance: float, lasts: float, *, timed: bool) -> None:
        """Merge the first ticks as far as the tool moves along one line, and the oldest if there are too many.

        Args:
            start: pose of the last equilibrium.
            radius: of the contact, m: a rotation counts as the motion of its edge.
            tolerance: largest distance of a tick's end from the line, m; infinite if the tissue does not depend on the
                path.
            timed: whether the tool must also move evenly, since time counts.
            lasts: time for which the tissue remembers a path that was merged although it was not straight, s.
        """
        if len(self.ticks) < 2:
            return
        count = self._count_straight_ticks(start, radius, tolerance, timed)
        if len(self.ticks) - count >= MOST_TICKS:
            count, self.lost = len(self.ticks) - MOST_TICKS + 1, lasts
        if count > 1:
            merged = self.ticks[:count]
            self.ticks[:count] = [replace(merged[-1], dt=sum(tick.dt for tick in merged))]

    def _count_straight_ticks(self, start: Pose, radius: float, tolerance: float, timed: bool) -> int:
        """Number of the first ticks in which the tool moves along one line."""
        count, before = 1, start
        passed: list[float] = []
        for number, tick in enumerate(self.ticks):
            length = tick.dt if timed else _pose_distance(before, tick.pose, radius)
            passed.append(length + (passed[-1] if passed else 0.0))
            before, total = tick.pose, passed[-1]
            if number and self.ticks[number - 1].touches:
                break
            away = max(_pose_distance(between(start, tick.pose, at / total if total else 0.0), skipped.pose, radius)
                       for at, skipped in zip(passed, self.ticks, strict=False))
            if away > tolerance:
                break
            count = number + 1
        return count

    def advance(self, dt: float, *, arrives: bool, timed: bool) -> None:
        """Take an equilibrium off the first tick.

        Args:
            dt: time of the step, s.
            arrives: whether the step ended at the end of the tick, and no time is left to be followed.
            timed: whether time counts. Otherwise ticks in which the tool rests need no step.
        """
        first = self.ticks[0]
        if arrives:
            self.meets = first.touches
            del self.ticks[0]
            while self.ticks and not timed and self.ticks[0].pose == first.pose:
                del self.ticks[0]
        else:
            self.ticks[0] = replace(first, dt=max(0.0, first.dt - dt))


def _pose_distance(one: Pose, other: Pose, radius: float) -> float:
    x, y, z, a, b, c = motion(one, other)
    return math.hypot(x, y, z) + radius * math.hypot(a, b, c)
