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
from tissue_sim.pose import Pose

#: Share of the depth by which a random or sine motion lifts off, where nothing else is said.
_LIFT = 0.2
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
        # The tool's axis meets the height of the touch at x and y, and the tool is so far along it.
        begun = Pose.at_depth(0.0) if approach is None else approach.pose(0.0)
        self._turn_as(begun)
        self._place: list[float] = [begun.position[0], begun.position[1], start or 0.0]
        self._velocity = [0.0, 0.0, 0.0]
        self._target = list(self._place)
        self.aim(self._place[2])

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

    Raises:
        InputError: depths in the wrong order, or a speed that is not positive.
    """

    #: s between two points.
    SPACING = 0.05
    #: Share of the velocity that stays from one point to the next, and of the vigour.
    _INERTIA, _MOOD = 0.6, 0.95

    def __init__(self, seed: int = 0, deepest: float = 8e-3, highest: float = -2e-3, speed: float = 0.2):
        _require_range(highest, deepest)
        require_length(speed, "speed")  # m/s, but finite and above zero all the same
        self._random = random.Random(seed)
        self._highest, self._deepest = highest, deepest
        self._longest_step = speed * self.SPACING
        self._step, self._mood = 0.0, 0.0
        #: It begins at rest: four equal points.
        self._points = [highest] * 4

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


def _require_range(highest: float, deepest: float) -> None:
    if not -math.inf < highest < deepest < math.inf:
        raise InputError(f"a motion from {highest:g} to {deepest:g} m; give the upper depth first, and a deeper one",
                         field="deepest")


def open_random(text: str) -> RandomWalk:
    """``random:depth_mm=10,lift=0.2,top_speed_mm_s=200,seed=0``; `lift` is a share of the depth."""
    given = read_settings(text, depth_mm=10.0, lift=_LIFT, top_speed_mm_s=200.0, seed=0)
    depth = given["depth_mm"] * 1e-3
    return RandomWalk(int(given["seed"]), depth, -given["lift"] * depth, given["top_speed_mm_s"] * 1e-3)


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
