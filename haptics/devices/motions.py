"""Motions of the tool without a device: sine, protocol, random walk, pointer; reproducible by seed and time."""

from __future__ import annotations

import math
import random
from bisect import bisect_right
from dataclasses import dataclass

from haptics.devices.contracts import AxialMotion, Motion
from haptics.devices.settings import parse_number_settings
from tissue_sim import Protocol
from tissue_sim.errors import InputError, require_positive_length
from tissue_sim.experiment.experiment import Approach
from tissue_sim.pose import Pose, rotate_pose_about_its_position
from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {"HandMotion": "TargetFollowingMotion"})


@dataclass(frozen=True)
class MotionDefaultsAndTolerances:
    """Defaults and limits of random, sine and protocol motions.

    Attributes:
        lift: height of lift-off of a random or sine motion as a fraction of its depth, 1; default of the setting
            ``lift``.
        negligible_range: sideways ranges, m, and rotation ranges, rad, below this value count as 0, because half of the
            smallest float is 0.
        least_cosine: smallest cosine of the tool's tilt in the conversion of depth to distance along the axis, 1;
            avoids a division by 0.
    """

    lift: float = 0.2
    negligible_range: float = 1e-12
    least_cosine: float = 0.1


_DEFAULTS = MotionDefaultsAndTolerances()


class ProtocolMotion(AxialMotion):
    """Motion along a protocol's displacements; constant before its first and after its last sample.

    Args:
        protocol: Displacement against time; time counts from its first sample.
        repeat: Repeat the protocol; its last displacement must equal its first.
        approach: Approach of the tool that makes the displacements; None: the approach of the scene.

    Raises:
        InputError: the protocol prescribes a force; or `repeat` is set and the protocol ends at another displacement or
            has one sample only.
    """

    def __init__(self, protocol: Protocol, repeat: bool = False, approach: Approach | None = None):
        protocol.require_displacement_control("a motion of the haptic loop")
        self.approach = approach
        self._times = (protocol.time - protocol.time[0]).tolist()
        self._depths = protocol.displacement.tolist()
        self._repeat = repeat
        if repeat and (len(self._times) < 2 or not math.isclose(self._depths[0], self._depths[-1], abs_tol=1e-9)):
            raise InputError("a repeated protocol must end at its first displacement; it ends "
                             f"{1e3 * (self._depths[-1] - self._depths[0]):.4g} mm from it. Add 'unload' at the end or "
                             "use repeat=False", field="protocol")

    @property
    def duration(self) -> float:
        """Duration of one run of the protocol, s."""
        return self._times[-1]

    def depth(self, time: float) -> float:
        """Return the depth, m, at a time since the motion began, s: linear between the samples, constant outside."""
        times, depths = self._times, self._depths
        if self._repeat:
            time %= times[-1]
        after = bisect_right(times, time)
        if after == 0:
            return depths[0]
        if after == len(times):
            return depths[-1]
        fraction = (time - times[after - 1]) / (times[after] - times[after - 1])
        return depths[after - 1] + fraction * (depths[after] - depths[after - 1])


class SineMotion(AxialMotion):
    """Sinusoidal motion between two depths; begins at rest at the upper depth.

    Args:
        deepest: Lower depth, m.
        highest: Upper depth, m; negative values are above the surface.
        frequency: Frequency, Hz.

    Raises:
        InputError: `deepest` is not below `highest`, or the frequency is not positive.
    """

    def __init__(self, deepest: float, highest: float = 0.0, frequency: float = 1.0):
        _require_depth_range(highest, deepest)
        if not 0 < frequency < math.inf:
            raise InputError(f"the frequency must be above 0 Hz; got {frequency:g} Hz", field="frequency")
        self._middle, self._amplitude = 0.5 * (highest + deepest), 0.5 * (deepest - highest)
        self._rate = 2 * math.pi * frequency

    def depth(self, time: float) -> float:
        """Return the depth, m, at a time since the motion began, s."""
        return self._middle - self._amplitude * math.cos(self._rate * time)


class TargetFollowingMotion(Motion):
    """Motion that follows targets set by `aim`: critically damped spring, limited speed, constant orientation.

    Args:
        start: Initial depth along the tool's axis, m; None: the tool's position and orientation when this motion
            replaces another one, or first contact if there is none.
        speed: Largest speed, m/s.
        response: Natural frequency of the spring, rad/s; a target is reached within about 5 / response seconds.
        approach: Axis and contact height of the tool; None: the approach of the scene.

    Raises:
        InputError: `start` is not a finite number, or `speed` or `response` is not positive.
    """

    def __init__(self, start: float | None = 0.0, speed: float = 0.1, response: float = 30.0,
                 approach: Approach | None = None):
        require_positive_length(speed, "speed")  # checks for finite and positive; the unit is m/s here, rad/s below
        require_positive_length(response, "response")
        self._speed, self._response = speed, response
        self._starts_at_tool = start is None
        self._time = 0.0
        self._velocity = [0.0, 0.0, 0.0]
        self._set_approach_and_depths(approach, start or 0.0, start or 0.0)

    def _set_approach_and_depths(self, approach: Approach | None, start: float, target: float) -> None:
        """Set the approach, and present and target depth on it, m; the tool is placed on the axis of the approach."""
        self.approach = approach
        # A position is x and y, where the tool's axis meets the height of first contact, and the depth along the axis.
        at_contact = Pose.at_depth(0.0) if approach is None else approach.pose(0.0)
        self._set_orientation_and_axis_from_pose(at_contact)
        self._position: list[float] = [at_contact.position[0], at_contact.position[1], start]
        self._target = list(self._position)
        self.aim(target)

    def set_approach(self, approach: Approach | None) -> None:
        """Set the approach and restart the motion on it, unless it has one or begins at the pose of the tool."""
        if self.approach is None and approach is not None and not self._starts_at_tool:
            self._set_approach_and_depths(approach, self._position[2], self._target[2])

    def _set_orientation_and_axis_from_pose(self, pose: Pose) -> None:
        """Store the orientation of a pose, and its tool axis as change of x, y and height per depth along the axis."""
        self._orientation = pose.orientation
        (_, _, a), (_, _, b), (_, _, c) = pose.rotation_matrix
        self._axis = -a, -b, max(c, _DEFAULTS.least_cosine)

    def continue_from_pose(self, pose: Pose) -> None:
        """Begin at the present pose of the tool if the motion was made without a start."""
        if not self._starts_at_tool:
            return
        self._set_orientation_and_axis_from_pose(pose)
        (x, y, _), (u, v, cosine) = pose.position, self._axis
        distance = pose.depth / cosine
        self._position = [x - u * distance, y - v * distance, distance]
        self._target = list(self._position)

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        """Set the target depth, m, and the target position across, x and y, m; see `HapticDevice.aim`.

        Raises:
            InputError: A coordinate is not a finite number.
        """
        x, y = self._target[:2] if across is None else across
        if not math.isfinite(depth):
            raise InputError(f"the target depth must be a finite number; got {depth}", field="depth")
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(f"the target across the axis must be two finite numbers; got ({x}, {y})", field="across")
        self._target = [x, y, depth]

    def pose(self, time: float) -> Pose:
        """Advance the motion to a time since it began, s, and return the pose there, with the constant orientation."""
        depth = self.depth(time)
        (x, y, _), (u, v, cosine) = self._position, self._axis
        return Pose((x + u * depth, y + v * depth, -cosine * depth), self._orientation)

    def depth(self, time: float) -> float:
        """Advance the motion to a time since it began, s, and return the depth along the tool's axis, m."""
        dt, self._time = max(time - self._time, 0.0), time
        if dt == 0.0:
            return self._position[2]
        # The exact solution of x'' + 2 w x' + w^2 (x - target) = 0 is stable for every time step.
        w, steps, slopes = self._response, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        fade = math.exp(-w * dt)
        for axis, (position, target, velocity) in enumerate(
                zip(self._position, self._target, self._velocity, strict=True)):
            offset = position - target
            rate = velocity + w * offset
            steps[axis] = target + (offset + rate * dt) * fade - position
            slopes[axis] = (velocity - w * rate * dt) * fade
        step, slope = (math.hypot(*each) for each in (steps, slopes))
        shorter, slower = (min(self._speed * limit / size, 1.0) if size > 0.0 else 1.0
                           for limit, size in ((dt, step), (1.0, slope)))
        for axis in range(3):
            self._velocity[axis] = slower * slopes[axis]
            self._position[axis] += shorter * steps[axis]
        return self._position[2]


class RandomWalk(AxialMotion):
    """Irregular motion like that of a hand: slow and fast phases, reversals at any depth, lift-offs.

    A cubic B-spline with random control points every 50 ms. Its speed never exceeds `speed`, and less than 1 % of its
    power is above 10 Hz. The motion is a function of seed and time alone: earlier calls do not change it.

    Args:
        seed: Seed of the random numbers.
        deepest: Lower end of the range of depths, m.
        highest: Upper end of the range, m; negative values are above the surface.
        speed: Largest speed, m/s.
        start: Initial depth, m; None: `highest`.

    Raises:
        InputError: `deepest` is not below `highest`, `start` is outside the range, or `speed` is not positive.
    """

    #: Time between two control points of the spline, s.
    SPACING = 0.05
    #: Correlation of the increments of two successive control points.
    _INCREMENT_CORRELATION = 0.6
    #: Correlation of the logarithm of the increments' amplitude at two successive control points.
    _AMPLITUDE_CORRELATION = 0.95

    def __init__(self, seed: int | str = 0, deepest: float = 8e-3, highest: float = -2e-3, speed: float = 0.2,
                 start: float | None = None):
        _require_depth_range(highest, deepest)
        require_positive_length(speed, "speed")  # checks for finite and positive; the unit is m/s here
        start = highest if start is None else start
        if not highest <= start <= deepest:
            raise InputError(f"the initial depth must be {highest:g} to {deepest:g} m; got {start:g} m", field="start")
        self._random = random.Random(seed)
        self._highest, self._deepest = highest, deepest
        self._longest_step = speed * self.SPACING
        self._step, self._log_amplitude = 0.0, 0.0
        #: Control points, m; four equal ones make the motion begin at rest.
        self._points = [start] * 4

    def depth(self, time: float) -> float:
        """Return the depth, m, at a time since the motion began, s: a cubic B-spline of random control points."""
        knot = max(time, 0.0) / self.SPACING
        first = int(knot)
        points = self._points
        while len(points) < first + 4:
            points.append(self._draw_next_control_depth())
        u = knot - first
        v = 1.0 - u
        return (v * v * v * points[first] + (3 * u * u * u - 6 * u * u + 4) * points[first + 1]
                + (3 * v * v * v - 6 * v * v + 4) * points[first + 2] + u * u * u * points[first + 3]) / 6

    def _draw_next_control_depth(self) -> float:
        """Return the next random control point of the spline, a depth, m, without appending it to the spline."""
        gauss = self._random.gauss
        self._log_amplitude = (self._AMPLITUDE_CORRELATION * self._log_amplitude
                               + math.sqrt(1 - self._AMPLITUDE_CORRELATION**2) * gauss(0.0, 1.0))
        amplitude = min(math.exp(self._log_amplitude - 1.5), 1.0) * self._longest_step
        step = self._INCREMENT_CORRELATION * self._step + amplitude * gauss(0.0, 1.0)
        step = min(max(step, -self._longest_step), self._longest_step)
        last = self._points[-1]
        point = last + step
        if not self._highest <= point <= self._deepest:
            step = -step  # reflect at the boundary; where both directions leave the range, stop at the nearer boundary
            point = min(max(last + step, self._highest), self._deepest)
        self._step = step
        return point


class SpatialWalk(Motion):
    """Irregular motion in space: depth, sideways position and rotation, each a `RandomWalk`.

    The tool's deepest point stays in a box of depths and sideways positions, and its axis stays in a cone. The motion
    is a function of seed and time alone. It begins upright and at rest above the point of first contact.

    Args:
        seed: Seed of the random numbers.
        deepest: Lower end of the range of depths, m.
        highest: Upper end of the range, m; negative values are above the surface.
        sideways: Largest distance from first contact along x and along y, m.
        turn: Largest rotation from the first orientation about any axis, rad; 0: constant orientation.
        speed: Largest speed of the deepest point, m/s.
        turn_speed: Largest angular speed, rad/s.
        approach: Approach of the tool; None: the approach of the scene.

    Raises:
        InputError: `deepest` is not below `highest`, a range is negative, or a speed is not positive.
    """

    def __init__(self, seed: int = 0, deepest: float = 8e-3, highest: float = -2e-3, sideways: float = 5e-3,
                 turn: float = 0.0, speed: float = 0.2, turn_speed: float = math.radians(60.0),
                 approach: Approach | None = None):
        if not 0.0 <= sideways < math.inf:
            raise InputError(f"the sideways range must be 0 m or more; got {sideways:g} m", field="sideways")
        require_positive_length(speed, "speed")  # checks for finite and positive; the unit is m/s here, rad/s below
        require_positive_length(turn_speed, "turn_speed")
        if not 0.0 <= turn < math.pi:
            raise InputError(f"the rotation range must be 0 rad or more and less than half a turn; got {turn:g} rad",
                             field="turn")
        self.approach = approach
        # Three perpendicular components of at most limit / sqrt(3) have a resultant of at most the limit.
        fraction = 1.0 / math.sqrt(3.0)
        self._depth = RandomWalk(f"{seed} depth", deepest, highest, fraction * speed)
        self._across = [RandomWalk(f"{seed} {axis}", sideways, -sideways, fraction * speed, 0.0) for axis in "xy"
                        ] if sideways > _DEFAULTS.negligible_range else []
        self._rotations = [RandomWalk(f"{seed} about {axis}", fraction * turn, -fraction * turn,
                                      fraction * turn_speed, 0.0)
                           for axis in "xyz"] if turn > _DEFAULTS.negligible_range else []

    def pose(self, time: float) -> Pose:
        """Return the pose at a time, s: depth on the approach, sideways displacement and rotation."""
        depth = self._depth.depth(time)
        straight = Pose.at_depth(depth) if self.approach is None else self.approach.pose(depth)
        x, y, z = straight.position
        dx, dy = (walk.depth(time) for walk in self._across) if self._across else (0.0, 0.0)
        moved = Pose((x + dx, y + dy, z), straight.orientation)
        if not self._rotations:
            return moved
        about_x, about_y, about_z = (walk.depth(time) for walk in self._rotations)
        return rotate_pose_about_its_position(moved, (about_x, about_y, about_z))


def _require_depth_range(highest: float, deepest: float) -> None:
    """Raise an InputError unless both depths, m, are finite and `deepest` is larger than `highest`."""
    if not -math.inf < highest < deepest < math.inf:
        raise InputError(f"the deepest position must be deeper than the upper depth, {highest:g} m; got {deepest:g} m",
                         field="deepest")


def make_random_motion(text: str) -> RandomWalk | SpatialWalk:
    """Make a random motion from settings: a `SpatialWalk` with a sideways range or a rotation, else a `RandomWalk`.

    Defaults: ``random:depth_mm=10,lift=0.2,top_speed_mm_s=200,seed=0,sideways_mm=0,turn_deg=0,turn_deg_s=60``.
    `lift` is the height of lift-off as a fraction of the depth.
    """
    given = parse_number_settings(text, depth_mm=10.0, lift=_DEFAULTS.lift, top_speed_mm_s=200.0, seed=0,
                                  sideways_mm=0.0,
                                  turn_deg=0.0, turn_deg_s=60.0)
    depth, speed, seed = given["depth_mm"] * 1e-3, given["top_speed_mm_s"] * 1e-3, int(given["seed"])
    if not (given["sideways_mm"] or given["turn_deg"]):
        return RandomWalk(seed, depth, -given["lift"] * depth, speed)
    return SpatialWalk(seed, depth, -given["lift"] * depth, given["sideways_mm"] * 1e-3,
                       math.radians(given["turn_deg"]), speed, math.radians(given["turn_deg_s"]))


def make_sine_motion(text: str) -> SineMotion:
    """Make a sine motion from settings ``depth_mm=10,lift=0.2,frequency_hz=1``; `lift` is a fraction of the depth."""
    given = parse_number_settings(text, depth_mm=10.0, lift=_DEFAULTS.lift, frequency_hz=1.0)
    depth = given["depth_mm"] * 1e-3
    return SineMotion(depth, -given["lift"] * depth, given["frequency_hz"])


def make_motion_from_protocol_text(text: str) -> ProtocolMotion:
    """Make a motion from the text of a protocol, ``ramp 4mm @2mm/s; unload``; see `tissue_sim.Protocol.parse`.

    It repeats without end if the last displacement equals the first, as in this example.
    """
    return make_protocol_motion_repeated_if_closed(Protocol.parse(text))


def make_protocol_motion_repeated_if_closed(protocol: Protocol) -> ProtocolMotion:
    """Return a motion along a protocol; it repeats without end if the last displacement equals the first."""
    protocol.require_displacement_control("a motion of the haptic loop")
    closes = abs(protocol.displacement[-1] - protocol.displacement[0]) < 1e-9
    return ProtocolMotion(protocol, repeat=bool(closes))


def make_target_following_motion(text: str) -> TargetFollowingMotion:
    """Make a `TargetFollowingMotion`, which is steered by `aim`, from a text such as ``depth_mm=0,speed_mm_s=100``.

    `depth_mm` is the first target.
    """
    given = parse_number_settings(text, depth_mm=0.0, speed_mm_s=100.0)
    hand = TargetFollowingMotion(speed=given["speed_mm_s"] * 1e-3)
    hand.aim(given["depth_mm"] * 1e-3)
    return hand
