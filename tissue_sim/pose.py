"""Poses of the tool in three dimensions, and rigid motions between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.public_names import make_getattr_for_old_names, with_old_names

__getattr__ = make_getattr_for_old_names(__name__, {"between": "interpolate_pose", "motion": "compute_rigid_motion"})

#: x, y, z.
Vector = tuple[float, float, float]
#: w, x, y, z.
Quaternion = tuple[float, float, float, float]
#: Translation (or force) along x, y, z, then rotation (or torque) about them.
Screw = tuple[float, float, float, float, float, float]

#: Orientation of an upright tool.
NO_ROTATION: Quaternion = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class QuaternionTolerances:
    """Tolerances of orientations.

    Attributes:
        length: largest difference between the length of a quaternion and 1, 1. Poses of logs and trackers differ by up
            to 1e-4.
        rounding: a quaternion whose length differs from 1 by less is kept bit for bit, 1.
        small_sine: sine of half an angle below which orientations are interpolated linearly, 1.
    """

    length: float = 1e-3
    rounding: float = 1e-12
    small_sine: float = 1e-9


#: Tolerances of all poses.
QUATERNION = QuaternionTolerances()


@with_old_names(rotation="rotation_matrix")
@dataclass(frozen=True, slots=True)
class Pose:
    """Position and orientation of the tool in the frame of the scene.

    The origin of the frame is the centre of the undeformed top; z points out of the tissue.

    Attributes:
        position: of the tool's deepest point, x, y, z, m.
        orientation: quaternion (w, x, y, z), normalised if its length is within `QuaternionTolerances.length` of 1.
            Numbers that are not finite are kept: a tissue refuses such a pose and keeps its state
            (`ForceStatus.REFUSED`).

    Raises:
        InputError: position or orientation that is not a sequence of three or four numbers, or a quaternion of another
            length.
    """

    position: Vector
    orientation: Quaternion = NO_ROTATION

    def __post_init__(self):
        if type(self.position) is not tuple or len(self.position) != 3:
            object.__setattr__(self, "position", _convert_to_floats(self.position, 3, "position", "x, y, z in m"))
        if self.orientation is NO_ROTATION:
            return
        if type(self.orientation) is not tuple or len(self.orientation) != 4:
            numbers = _convert_to_floats(self.orientation, 4, "orientation", "w, x, y, z")
            object.__setattr__(self, "orientation", numbers)
        try:
            w, x, y, z = self.orientation
            length = math.sqrt(w * w + x * x + y * y + z * z)
        except TypeError:
            raise _make_numbers_error(self.orientation, 4, "orientation", "w, x, y, z") from None
        excess = length - 1.0
        if -QUATERNION.rounding < excess < QUATERNION.rounding:
            return
        if not math.isfinite(length):
            if not all(map(math.isfinite, self.orientation)):
                return
            length = math.hypot(w, x, y, z)  # the squares overflow; hypot scales them
            excess = length - 1.0
        # NaN is refused, too: where denormal numbers are flushed to zero, hypot of huge components is NaN.
        if not abs(excess) <= QUATERNION.length:
            raise InputError(f"must be a unit quaternion (w, x, y, z), of length 1 within "
                             f"{QUATERNION.length:g}; got length {_format_quaternion_length(length)}. Divide it by its "
                             "length.",
                             field="orientation")
        object.__setattr__(self, "orientation", (w / length, x / length, y / length, z / length))

    @classmethod
    def at_depth(cls, depth: float) -> Pose:
        """Make the pose of an upright tool on the axis of the scene at a depth, m.

        Examples:
            >>> Pose.at_depth(0.002)
            Pose(position=(0.0, 0.0, -0.002), orientation=(1.0, 0.0, 0.0, 0.0))
        """
        return cls((0.0, 0.0, -depth))

    @property
    def depth(self) -> float:
        """Displacement into the tissue along -z, m."""
        return -self.position[2]

    @property
    def rotation_matrix(self) -> tuple[Vector, Vector, Vector]:
        """Rotation matrix, row by row, from the frame of the tool to that of the scene."""
        w, x, y, z = self.orientation
        return ((1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
                (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
                (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)))

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are finite."""
        return math.isfinite(sum(self.position) + sum(self.orientation))


def _convert_to_floats(values: object, count: int, field: str, names: str) -> tuple[float, ...]:
    """Convert a sequence of numbers to a tuple of floats.

    Raises:
        InputError: another type, or another number of entries.
    """
    if isinstance(values, str | bytes):
        raise _make_numbers_error(values, count, field, names)
    try:
        numbers = tuple(map(float, values))  # type: ignore[call-overload]
    except (TypeError, ValueError, OverflowError):
        raise _make_numbers_error(values, count, field, names) from None
    if len(numbers) != count:
        raise _make_numbers_error(values, count, field, names)
    return numbers


def _make_numbers_error(values: object, count: int, field: str, names: str) -> InputError:
    """Make the error that a field is not a sequence of `count` numbers, described by `names`."""
    return InputError(f"must be {count} numbers, {names}; got {values!r}.", field=field)


def _format_quaternion_length(length: float) -> str:
    """Format the length of a quaternion with four significant digits of its difference from 1."""
    if not 0.5 < length < 2.0:
        return f"{length:.4g}"
    decimals = 3 - math.floor(math.log10(abs(length - 1.0)))
    return f"{length:.{decimals}f}"


def scale_screw(factor: float, screw: Screw) -> Screw:
    """Multiply a screw by a number."""
    x, y, z, u, v, w = screw
    return (factor * x, factor * y, factor * z, factor * u, factor * v, factor * w)


def shorten_screw(screw: Screw, step: float, other_step: float) -> Screw:
    """Reduce the lengths of the two vectors of a screw by steps; a vector not longer than its step becomes zero.

    Args:
        screw: first and second vector.
        step: largest reduction of the length of the first vector, in its unit.
        other_step: the same for the second vector.
    """
    return _shorten_vector(screw[:3], step) + _shorten_vector(screw[3:], other_step) if any(screw) else screw


def _shorten_vector(vector: Vector, step: float) -> Vector:
    """Return a vector of the same direction whose length is smaller by `step`; zero if it is not longer."""
    size = math.hypot(*vector)
    if size <= step:
        return (0.0, 0.0, 0.0)
    # Divide first: along an axis the direction is exactly 1.
    x, y, z = vector
    return (x - x / size * step, y - y / size * step, z - z / size * step)


def add_screws(one: Screw, other: Screw) -> Screw:
    """Return the sum of two screws."""
    (x, y, z, u, v, w), (a, b, c, d, e, f) = one, other
    return (x + a, y + b, z + c, u + d, v + e, w + f)


def compute_rigid_motion(start: Pose, end: Pose) -> Screw:
    """Compute the motion from the first to the second pose: translation, m, and rotation vector, rad, scene frame.

    Examples:
        >>> compute_rigid_motion(Pose.at_depth(0.0), Pose.at_depth(0.002))
        (0.0, 0.0, -0.002, 0.0, 0.0, 0.0)
    """
    (x0, y0, z0), (x1, y1, z1) = start.position, end.position
    if start.orientation == end.orientation:
        return (x1 - x0, y1 - y0, z1 - z0, 0.0, 0.0, 0.0)
    w, x, y, z = _compute_relative_quaternion(start.orientation, end.orientation)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < QUATERNION.small_sine else 2.0 * math.atan2(sine, w) / sine
    return (x1 - x0, y1 - y0, z1 - z0, factor * x, factor * y, factor * z)


def compute_pose_distance(one: Pose, other: Pose, radius: float) -> float:
    """Return the translation between two poses plus the rotation angle times a radius, m."""
    x, y, z, a, b, c = compute_rigid_motion(one, other)
    return math.hypot(x, y, z) + radius * math.hypot(a, b, c)


def interpolate_pose(start: Pose, end: Pose, share: float) -> Pose:
    """Interpolate between two poses: linearly in position, and at constant angular velocity about one axis.

    Args:
        start: first pose.
        end: last pose.
        share: fraction of the motion, 0 to 1; at 1 the result is `end` itself.

    Source: Shoemake, SIGGRAPH 1985, spherical linear interpolation.

    Examples:
        >>> interpolate_pose(Pose.at_depth(0.0), Pose.at_depth(0.002), 0.5).position
        (0.0, 0.0, -0.001)
    """
    if share == 1.0:
        return end
    (x0, y0, z0), (x1, y1, z1) = start.position, end.position
    position = (x0 + share * (x1 - x0), y0 + share * (y1 - y0), z0 + share * (z1 - z0))
    if start.orientation == end.orientation:
        return Pose(position, start.orientation)
    w, x, y, z = _compute_relative_quaternion(start.orientation, end.orientation)
    sine = math.sqrt(x * x + y * y + z * z)
    half = share * math.atan2(sine, w)
    factor = share if sine < QUATERNION.small_sine else math.sin(half) / sine
    turn = (math.cos(half), factor * x, factor * y, factor * z)
    return Pose(position, multiply_quaternions(turn, start.orientation))


def rotate_pose_about_its_position(pose: Pose, rotation: Vector) -> Pose:
    """Return a pose that is rotated about its position by a rotation vector, rad, in the frame of the scene."""
    angle = math.sqrt(sum(part * part for part in rotation))
    if angle == 0.0:
        return pose
    x, y, z = (math.sin(0.5 * angle) * part / angle for part in rotation)
    return Pose(pose.position, multiply_quaternions((math.cos(0.5 * angle), x, y, z), pose.orientation))


def find_axis_twist_quaternion_or_none(orientation: Quaternion) -> Quaternion | None:
    """Return the part of an orientation that rotates about the tool's axis, as a quaternion; None without rotation.

    This is the twist of the swing-twist decomposition.
    """
    w, _, _, z = orientation
    size = math.hypot(w, z)
    if size < QUATERNION.small_sine or abs(z) < QUATERNION.rounding * size:
        return None
    return (w / size, 0.0, 0.0, z / size)


def remove_twist(pose: Pose, twist: Quaternion | None) -> Pose:
    """Return a pose without a rotation about the tool's axis, which does not change a body of revolution."""
    if twist is None:
        return pose
    w, _, _, z = twist
    return Pose(pose.position, multiply_quaternions(pose.orientation, (w, 0.0, 0.0, -z)))


def add_twist(pose: Pose, twist: Quaternion | None) -> Pose:
    """Return a pose with an additional rotation about the tool's axis; inverse of `remove_twist`."""
    return pose if twist is None else Pose(pose.position, multiply_quaternions(pose.orientation, twist))


def shift_pose_along_z(pose: Pose, height: float) -> Pose:
    """Return a pose that is shifted along z, out of the tissue, by a height, m."""
    x, y, z = pose.position
    return Pose((x, y, z + height), pose.orientation)


def multiply_poses(first: Pose, second: Pose) -> Pose:
    """Return the pose `second`, which is relative to the frame `first`, in the frame in which `first` is given.

    Examples:
        >>> multiply_poses(Pose((0.0, 0.0, 1.0)), Pose((0.0, 2.0, 0.0))).position
        (0.0, 2.0, 1.0)
    """
    x, y, z = first.position
    a, b, c = second.position
    u, v, w = (row[0] * a + row[1] * b + row[2] * c for row in first.rotation_matrix)
    return Pose((x + u, y + v, z + w), multiply_quaternions(first.orientation, second.orientation))


def invert_pose(pose: Pose) -> Pose:
    """Return the pose of the parent frame in the frame of a pose: ``multiply_poses(invert_pose(p), p)`` is identity."""
    x, y, z = pose.position
    w, a, b, c = pose.orientation
    first, second, third = pose.rotation_matrix
    u, v, n = (-(first[k] * x + second[k] * y + third[k] * z) for k in range(3))
    return Pose((u, v, n), (w, -a, -b, -c))


def _compute_relative_quaternion(start: Quaternion, end: Quaternion) -> Quaternion:
    """Return the quaternion of the rotation, by at most half a turn, from one orientation to another, scene frame."""
    w, x, y, z = start
    relative = multiply_quaternions(end, (w, -x, -y, -z))
    if relative[0] >= 0.0:
        return relative
    w, x, y, z = relative
    return (-w, -x, -y, -z)


def multiply_quaternions(left: Quaternion, right: Quaternion) -> Quaternion:
    """Return the Hamilton product of two quaternions: the rotation `right`, then the rotation `left`."""
    a, b, c, d = left
    e, f, g, h = right
    return (a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e)
