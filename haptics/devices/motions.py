"""Where the tool goes when there is no device: motions that are the same for the same seed and time."""

from __future__ import annotations

import math
import random
from bisect import bisect_right

from haptics.devices.contracts import AxialMotion, Motion
from haptics.devices.settings import read_settings
from tissue_sim import Protocol
from tissue_sim.errors import InputError, require_length
from tissue_sim.experiment.approach import Approach
from tissue_sim.pose import Pose, turned

#: Share of the depth by which a random or sine motion lifts off, where nothing else is said.
_LIFT = 0.2
#: Ways, m, and turns, rad, below this are none: half of the smallest numbers is 0.
_NO_WAY = 1e-12
#: Of a tool that leans more than this cosine says a depth is no way along its axis.
_LEAST_COSINE = 0.1


class ProtocolMotion(AxialMotion):
    """The motion of a protocol; it waits at its first and last displacement.

    Args:
        protocol: its time counts from its first sample.
        repeat: begin again at its end; the protocol must come back to where it began.
        approach: of the tool whose displacements these are; None: along the axis of the scene.

    Raises:
        InputError: a protocol to repeat that ends somewhere else, or has one sample only.
    """

    def __init__(self, protocol: Protocol, repeat: bool = False, approach: Approach | None = None):
        self.approach = approach
        self._times = (protocol.time - protocol.time[0]).tolist()
        self._depths = protocol.displacement.tolist()
        self._repeat = repeat
        if repeat and (len(self._times) < 2 or not math.isclose(self._depths[0], self._depths[-1], abs_tol=1e-9)):
            raise InputError(f"the protocol ends {1e3 * (self._depths[-1] - self._depths[0]):.4g} mm from where it "
                             "began, and a tool does not jump; let it end with an unload, or do not repeat it",
                             field="protocol")

    @property
    def duration(self) -> float:
        """Of one run through the protocol, s."""
        return self._times[-1]

    def depth(self, time: float) -> float:
        times, depths = self._times, self._depths
        if self._repeat:
            time %= times[-1]
        after = bisect_right(times, time)
        if after == 0:
            return depths[0]
        if after == len(times):
            return depths[-1]
        share = (time - times[after - 1]) / (times[after] - times[after - 1])
        return depths[after - 1] + share * (depths[after] - depths[after - 1])


class SineMotion(AxialMotion):
    """Up and down between two depths; begins at the upper one, at rest.

    Args:
        deepest: m.
        highest: m; below zero is above the touch.
        frequency: Hz.

    Raises:
        InputError: depths in the wrong order, or a frequency that is not positive.
    """

    def __init__(self, deepest: float, highest: float = 0.0, frequency: float = 1.0):
        _require_range(highest, deepest)
        if not 0 < frequency < math.inf:
            raise InputError(f"{frequency:g} Hz is not a frequency; give a number above zero", field="frequency")
        self._middle, self._amplitude = 0.5 * (highest + deepest), 0.5 * (deepest - highest)
        self._rate = 2 * math.pi * frequency

    def depth(self, time: float) -> float:
        return self._middle - self._amplitude * math.cos(self._rate * time)


class HandMotion(Motion):
    """Goes where somebody points, as a critically damped spring follows, and no faster than `speed`; turned as it
    began.

    Args:
        start: depth at which it is, along the tool's own axis, m; None: where the tool is when this is followed, and
            turned as it is there, or the touch.
        speed: largest, m/s.
        response: rad/s of the spring; a target is reached within about 5 / response seconds.
        approach: where the tool's axis is, and how it leans; None: it is that of the scene.

    Raises:
        InputError: a depth that is no number, or a speed or response that is not positive.
    """

    def __init__(self, start: float | None = 0.0, speed: float = 0.1, response: float = 30.0,
                 approach: Approach | None = None):
        require_length(speed, "speed")  # m/s and rad/s, but finite and above zero all the same
        require_length(response, "response")
        self._speed, self._response = speed, response
        self._goes_on = start is None
        self._time = 0.0
        self._velocity = [0.0, 0.0, 0.0]
        self._begin(approach, start or 0.0, start or 0.0)

    def _begin(self, approach: Approach | None, start: float, target: float) -> None:
        """At rest, so far along an axis, m, on the way to another depth."""
        self.approach = approach
        # The tool's axis meets the height of the touch at x and y, and the tool is so far along it.
        begun = Pose.at_depth(0.0) if approach is None else approach.pose(0.0)
        self._turn_as(begun)
        self._place: list[float] = [begun.position[0], begun.position[1], start]
        self._target = list(self._place)
        self.aim(target)

    def go_along(self, approach: Approach | None) -> None:
        if self.approach is None and approach is not None and not self._goes_on:
            self._begin(approach, self._place[2], self._target[2])

    def _turn_as(self, pose: Pose) -> None:
        """Keep the orientation of a pose; `_lean` is the way along x and y of a way along the axis, and its depth."""
        self._orientation = pose.orientation
        (_, _, a), (_, _, b), (_, _, c) = pose.rotation
        self._lean = -a, -b, max(c, _LEAST_COSINE)

    def take_over(self, pose: Pose) -> None:
        if not self._goes_on:
            return
        self._turn_as(pose)
        (x, y, _), (u, v, cosine) = pose.position, self._lean
        way = pose.depth / cosine
        self._place = [x - u * way, y - v * way, way]
        self._target = list(self._place)

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        """Name the place to go to; see `HapticDevice.aim`.

        Raises:
            InputError: not a finite number.
        """
        x, y = self._target[:2] if across is None else across
        if not math.isfinite(depth):
            raise InputError(f"{depth} is not a depth to go to; give a number", field="depth")
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(f"({x}, {y}) is no place to go to; give two numbers", field="across")
        self._target = [x, y, depth]

    def pose(self, time: float) -> Pose:
        depth = self.depth(time)
        (x, y, _), (u, v, cosine) = self._place, self._lean
        return Pose((x + u * depth, y + v * depth, -cosine * depth), self._orientation)

    def depth(self, time: float) -> float:
        """How far the tool has gone along its axis at a time since the motion began, s; m."""
        dt, self._time = max(time - self._time, 0.0), time
        if dt == 0.0:
            return self._place[2]
        # The exact motion of the spring, so that no time step is too long for it.
        w, steps, slopes = self._response, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        fade = math.exp(-w * dt)
        for axis, (place, target, velocity) in enumerate(zip(self._place, self._target, self._velocity, strict=True)):
            away = place - target
            rate = velocity + w * away
            steps[axis] = target + (away + rate * dt) * fade - place
            slopes[axis] = (velocity - w * rate * dt) * fade
        step, slope = (math.hypot(*each) for each in (steps, slopes))
        shorter, slower = (min(self._speed * limit / size, 1.0) if size > 0.0 else 1.0
                           for limit, size in ((dt, step), (1.0, slope)))
        for axis in range(3):
            self._velocity[axis] = slower * slopes[axis]
            self._place[axis] += shorter * steps[axis]
        return self._place[2]


class RandomWalk(AxialMotion):
    """Irregular motion as of a hand: calm and violent phases, reversals at any depth, lift-offs.

    A cubic B-spline of random points every 50 ms. Its speed never exceeds `speed`, and less than 1 % of its power is
    above 10 Hz. The motion is a function of seed and time alone: it does not depend on when, or how often, it is asked.

    Args:
        seed: another motion for each.
        deepest: m.
        highest: m; below zero is above the touch.
        speed: largest, m/s.
        start: where it begins; None: at the upper depth.

    Raises:
        InputError: depths in the wrong order, a start that is not between them, or a speed that is not positive.
    """

    #: s between two points.
    SPACING = 0.05
    #: Share of the velocity that stays from one point to the next, and of the vigour.
    _INERTIA, _MOOD = 0.6, 0.95

    def __init__(self, seed: int | str = 0, deepest: float = 8e-3, highest: float = -2e-3, speed: float = 0.2,
                 start: float | None = None):
        _require_range(highest, deepest)
        require_length(speed, "speed")  # m/s, but finite and above zero all the same
        start = highest if start is None else start
        if not highest <= start <= deepest:
            raise InputError(f"{start:g} m is not between {highest:g} and {deepest:g} m, where the motion stays",
                             field="start")
        self._random = random.Random(seed)
        self._highest, self._deepest = highest, deepest
        self._longest_step = speed * self.SPACING
        self._step, self._mood = 0.0, 0.0
        #: It begins at rest: four equal points.
        self._points = [start] * 4

    def depth(self, time: float) -> float:
        place = max(time, 0.0) / self.SPACING
        first = int(place)
        points = self._points
        while len(points) < first + 4:
            points.append(self._next_point())
        u = place - first
        v = 1.0 - u
        return (v * v * v * points[first] + (3 * u * u * u - 6 * u * u + 4) * points[first + 1]
                + (3 * v * v * v - 6 * v * v + 4) * points[first + 2] + u * u * u * points[first + 3]) / 6

    def _next_point(self) -> float:
        gauss = self._random.gauss
        self._mood = self._MOOD * self._mood + math.sqrt(1 - self._MOOD**2) * gauss(0.0, 1.0)
        vigour = min(math.exp(self._mood - 1.5), 1.0) * self._longest_step
        step = self._INERTIA * self._step + vigour * gauss(0.0, 1.0)
        step = min(max(step, -self._longest_step), self._longest_step)
        last = self._points[-1]
        point = last + step
        if not self._highest <= point <= self._deepest:
            step = -step  # turn round; where both ways lead out, go to the end that is nearer
            point = min(max(last + step, self._highest), self._deepest)
        self._step = step
        return point


class SpatialWalk(Motion):
    """Irregular motion in space, as of a hand: into the tissue, aside and turned at once, each as `RandomWalk` goes.

    The tool's deepest point stays in a box of depths and of places beside the touch; its axis in a cone. Like a
    `RandomWalk` it is a function of seed and time alone. It begins upright above the touch, and at rest.

    Args:
        seed: another motion for each.
        deepest, highest: m; below zero is above the touch.
        sideways: from the touch, along x and y either way, m.
        turn: of the tool from its first orientation, about any axis, rad; 0: it is never turned.
        speed: largest of the deepest point, m/s.
        turn_speed: largest, rad/s.
        approach: of the tool; None: along the axis of the scene.

    Raises:
        InputError: depths in the wrong order, or a size or a speed that is not positive.
    """

    def __init__(self, seed: int = 0, deepest: float = 8e-3, highest: float = -2e-3, sideways: float = 5e-3,
                 turn: float = 0.0, speed: float = 0.2, turn_speed: float = math.radians(60.0),
                 approach: Approach | None = None):
        if not 0.0 <= sideways < math.inf:
            raise InputError(f"{sideways:g} m; give a length of 0 or more", field="sideways")
        require_length(speed, "speed")  # m/s and rad/s, but finite and above zero all the same
        require_length(turn_speed, "turn_speed")
        if not 0.0 <= turn < math.pi:
            raise InputError(f"{turn:g} rad; give 0 or more, and less than half a turn", field="turn")
        self.approach = approach
        # Three at right angles to each other are no longer together than this share of the largest each.
        share = 1.0 / math.sqrt(3.0)
        self._depth = RandomWalk(f"{seed} depth", deepest, highest, share * speed)
        self._across = [RandomWalk(f"{seed} {axis}", sideways, -sideways, share * speed, 0.0) for axis in "xy"
                        ] if sideways > _NO_WAY else []
        self._turns = [RandomWalk(f"{seed} about {axis}", share * turn, -share * turn, share * turn_speed, 0.0)
                       for axis in "xyz"] if turn > _NO_WAY else []

    def pose(self, time: float) -> Pose:
        depth = self._depth.depth(time)
        begun = Pose.at_depth(depth) if self.approach is None else self.approach.pose(depth)
        x, y, z = begun.position
        across, aside = (walk.depth(time) for walk in self._across) if self._across else (0.0, 0.0)
        moved = Pose((x + across, y + aside, z), begun.orientation)
        if not self._turns:
            return moved
        about_x, about_y, about_z = (walk.depth(time) for walk in self._turns)
        return turned(moved, (about_x, about_y, about_z))


def _require_range(highest: float, deepest: float) -> None:
    if not -math.inf < highest < deepest < math.inf:
        raise InputError(f"a motion from {highest:g} to {deepest:g} m; give the upper depth first, and a deeper one",
                         field="deepest")


def open_random(text: str) -> RandomWalk | SpatialWalk:
    """``random:depth_mm=10,lift=0.2,top_speed_mm_s=200,seed=0,sideways_mm=0,turn_deg=0,turn_deg_s=60``; `lift` is a
    share of the depth."""
    given = read_settings(text, depth_mm=10.0, lift=_LIFT, top_speed_mm_s=200.0, seed=0, sideways_mm=0.0, turn_deg=0.0,
                          turn_deg_s=60.0)
    depth, speed, seed = given["depth_mm"] * 1e-3, given["top_speed_mm_s"] * 1e-3, int(given["seed"])
    if not (given["sideways_mm"] or given["turn_deg"]):
        return RandomWalk(seed, depth, -given["lift"] * depth, speed)
    return SpatialWalk(seed, depth, -given["lift"] * depth, given["sideways_mm"] * 1e-3,
                       math.radians(given["turn_deg"]), speed, math.radians(given["turn_deg_s"]))


def open_sine(text: str) -> SineMotion:
    """``sine:depth_mm=10,lift=0.2,frequency_hz=1``; `lift` is a share of the depth."""
    given = read_settings(text, depth_mm=10.0, lift=_LIFT, frequency_hz=1.0)
    depth = given["depth_mm"] * 1e-3
    return SineMotion(depth, -given["lift"] * depth, given["frequency_hz"])


def open_protocol(text: str) -> ProtocolMotion:
    """``protocol:ramp 4mm @2mm/s; unload``, as in `tissue_sim.Protocol.parse`."""
    return follow_protocol(Protocol.parse(text))


def follow_protocol(protocol: Protocol) -> ProtocolMotion:
    """The motion of a protocol, repeated where it ends as it began."""
    closes = abs(protocol.displacement[-1] - protocol.displacement[0]) < 1e-9
    return ProtocolMotion(protocol, repeat=bool(closes))


def open_hand(text: str) -> HandMotion:
    """``hand:depth_mm=0,speed_mm_s=100``; it goes to the depth, and then where it is aimed at."""
    given = read_settings(text, depth_mm=0.0, speed_mm_s=100.0)
    hand = HandMotion(speed=given["speed_mm_s"] * 1e-3)
    hand.aim(given["depth_mm"] * 1e-3)
    return hand
