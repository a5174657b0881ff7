"""Bridge between ROS 2 and a tissue server: poses of a tool in, wrenches and diagnostics out.

``python -m haptics.clients.ros2`` runs the node where ROS 2 (rclpy) is installed. All other functions and classes work
on message objects and need no ROS 2: they read the attributes of messages, and create messages by keyword arguments
with the classes of `MessageClasses`.

Conventions. ROS: SI units, right-handed, quaternions (x, y, z, w); a wrench is expressed in the frame of its header,
and its torque is about the origin of that frame. Scene: frame `haptics.server.wire.FRAME`, quaternions (w, x, y, z).
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Any

from haptics.server.client import TissueClient
from haptics.server.wire import Reply, Status
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Vector, multiply_quaternions

_ZERO: Vector = (0.0, 0.0, 0.0)
_ORIGIN = Pose(_ZERO)
#: A time stamp that decreases by more than this is a restarted clock, ns; by less, a late message.
_CLOCK_RESTART = 1_000_000_000
#: Longest time between two diagnostics without a change, ns.
_DIAGNOSTIC_INTERVAL = 1_000_000_000


@dataclass(frozen=True)
class MessageClasses:
    """Classes of messages, of ROS 2 or of another library with the same fields.

    Attributes:
        Header: `std_msgs/Header`.
        Vector3: `geometry_msgs/Vector3`.
        Wrench: `geometry_msgs/Wrench`.
        WrenchStamped: `geometry_msgs/WrenchStamped`.
        DiagnosticArray: `diagnostic_msgs/DiagnosticArray`.
        DiagnosticStatus: `diagnostic_msgs/DiagnosticStatus`.
        KeyValue: `diagnostic_msgs/KeyValue`.
    """

    Header: Any
    Vector3: Any
    Wrench: Any
    WrenchStamped: Any
    DiagnosticArray: Any
    DiagnosticStatus: Any
    KeyValue: Any


@dataclass(frozen=True)
class SceneFrame:
    """Fixed pose of the scene in a frame of ROS.

    Attributes:
        frame_id: frame of ROS in which the poses of the tool are given.
        scene: pose of the scene in that frame: position of the centre of the undeformed top face, m, and orientation
            (w, x, y, z): its rotation matrix converts components along the axes of the scene to components along
            the axes of the frame.

    Raises:
        InputError: the frame has no name, or a number is not finite.
    """

    frame_id: str
    scene: Pose = _ORIGIN

    def __post_init__(self):
        if not self.frame_id:
            raise InputError("must be the name of a frame; got an empty text. Give the frame_id of the poses.",
                             field="frame_id")
        if not self.scene.is_finite:
            raise InputError(f"must be finite; got {self.scene}. Give the fixed pose of the scene.", field="scene")

    @classmethod
    def from_parameters(cls, frame_id: str, position: Any, orientation: Any) -> SceneFrame:
        """Make the frame from parameters of ROS.

        Args:
            frame_id: frame of the poses.
            position: position of the scene, x, y, z, m, shape (3,).
            orientation: quaternion of the scene (x, y, z, w), shape (4,).

        Raises:
            InputError: a length is wrong, a number is not finite, or the quaternion is not a unit quaternion.
        """
        if len(orientation) != 4:
            raise InputError(f"must be four numbers, x, y, z, w; got {list(orientation)}.", field="scene_orientation")
        x, y, z, w = map(float, orientation)
        return cls(frame_id, Pose(tuple(map(float, position)), (w, x, y, z)))  # type: ignore[arg-type]

    def convert_to_scene(self, pose: Pose) -> Pose:
        """Return a pose of this frame in the frame of the scene: R^T (p - t), conj(q_scene) q."""
        (tx, ty, tz), (w, x, y, z) = self.scene.position, self.scene.orientation
        px, py, pz = pose.position
        return Pose(_rotate_back(self.scene, (px - tx, py - ty, pz - tz)),
                    multiply_quaternions((w, -x, -y, -z), pose.orientation))

    def convert_vector_from_scene(self, vector: Vector) -> Vector:
        """Return a vector of the scene, such as a force, in this frame: R v."""
        return _rotate(self.scene, vector)


def read_pose_message(message: Any) -> Pose:
    """Return the pose of a `geometry_msgs/PoseStamped` in the frame of its header.

    Raises:
        InputError: a number is not finite, or the quaternion is not a unit quaternion.
    """
    position, orientation = message.pose.position, message.pose.orientation
    pose = Pose((position.x, position.y, position.z), (orientation.w, orientation.x, orientation.y, orientation.z))
    if not pose.is_finite:
        raise InputError(f"must be finite; got {pose}. Check the source of the poses.", field="pose")
    return pose


def read_stamp(stamp: Any) -> int:
    """Return a time stamp `builtin_interfaces/Time` in ns."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def compute_wrench_in_tool(force: Vector, torque: Vector, pose: Pose) -> tuple[Vector, Vector]:
    """Return a wrench at the tip in the axes of the tool.

    Args:
        force: force on the tool in the frame of the scene, N.
        torque: torque about the tip in the frame of the scene, N m.
        pose: pose of the tool in the frame of the scene.
    """
    return _rotate_back(pose, force), _rotate_back(pose, torque)


def compute_wrench_at_frame_origin(force: Vector, torque: Vector, pose: Pose,
                                   frame: SceneFrame) -> tuple[Vector, Vector]:
    """Return a wrench in the frame of the poses, with the torque about its origin: tau + r x F.

    Args:
        force: force on the tool in the frame of the scene, N.
        torque: torque about the tip in the frame of the scene, N m.
        pose: pose of the tool in the frame of the poses; its position is the lever arm r.
        frame: frame of the poses.
    """
    fx, fy, fz = turned = frame.convert_vector_from_scene(force)
    tx, ty, tz = frame.convert_vector_from_scene(torque)
    x, y, z = pose.position
    return turned, (tx + y * fz - z * fy, ty + z * fx - x * fz, tz + x * fy - y * fx)


def make_wrench_message(classes: MessageClasses, stamp: Any, frame_id: str, force: Vector, torque: Vector) -> Any:
    """Return a `geometry_msgs/WrenchStamped`.

    Args:
        classes: classes of messages.
        stamp: time stamp of the pose.
        frame_id: frame of the wrench.
        force: force on the tool, N, shape (3,).
        torque: torque about the origin of the frame, N m, shape (3,).
    """
    force_message, torque_message = (classes.Vector3(x=x, y=y, z=z) for x, y, z in (force, torque))
    return classes.WrenchStamped(header=classes.Header(stamp=stamp, frame_id=frame_id),
                                 wrench=classes.Wrench(force=force_message, torque=torque_message))


def make_diagnostic_message(classes: MessageClasses, stamp: Any, level: Any, text: str, reply: Reply | None) -> Any:
    """Return a `diagnostic_msgs/DiagnosticArray` with one status.

    Args:
        classes: classes of messages.
        stamp: time stamp of the pose.
        level: a constant of `DiagnosticStatus`.
        text: the status as a sentence.
        reply: reply of the server, whose numbers are added; None: no reply.
    """
    values = {} if reply is None else {
        "status": str(reply.status), "age_s": f"{reply.age:.6g}", "compute_time_s": f"{reply.compute_time:.6g}",
        "time_step_s": f"{reply.dt:.6g}", "least_tool_mass_kg": f"{reply.least_tool_mass:.6g}",
        "force_error_N": "unknown" if reply.force_error is None else f"{reply.force_error:.6g}"}
    status = classes.DiagnosticStatus(level=level, name="tissue_sim: force", message=text, hardware_id="tissue_sim",
                                      values=[classes.KeyValue(key=key, value=value) for key, value in values.items()])
    return classes.DiagnosticArray(header=classes.Header(stamp=stamp, frame_id=""), status=[status])


class PoseWrenchBridge:
    """Answer each pose message by a wrench message, and by a diagnostic message if the status changed.

    The wrench is zero if the server did not answer in time, or refused the pose. The first pose, and the first one
    after the clock of the stamps was restarted, resets the tissue to its undeformed state. The reset is requested again
    with each pose until a step is executed, that is, until the status is below 100 and neither REFUSED nor FAILED.

    Args:
        client: client of the server.
        classes: classes of messages.
        frame: frame of the poses.
        tool_frame_id: frame at the tip of the tool, with its axes, in which wrenches are given; empty: wrenches are
            given in the frame of the poses, with the torque about its origin.
    """

    def __init__(self, client: TissueClient, classes: MessageClasses, frame: SceneFrame, tool_frame_id: str = ""):
        self._client, self._classes, self._frame, self._tool_frame_id = client, classes, frame, tool_frame_id
        #: Stamp of the newest pose and of the first one, ns; None: no pose yet.
        self._newest: int | None = None
        #: Whether the next step requests a reset, because no executed step has confirmed the last request.
        self._needs_reset = True
        self._first = 0
        #: Level, text and stamp of the last diagnostic.
        self._reported: tuple[Any, str, int] | None = None

    @property
    def wrench_frame_id(self) -> str:
        """Frame of the wrenches."""
        return self._tool_frame_id or self._frame.frame_id

    def answer(self, message: Any) -> tuple[Any, Any | None]:
        """Step the tissue to the pose of a `PoseStamped`.

        Returns:
            The `WrenchStamped` with the stamp of the pose, and the `DiagnosticArray`; None: the status is unchanged.
        """
        levels, wrench, reply = self._classes.DiagnosticStatus, (_ZERO, _ZERO), None
        try:
            reply, pose = self._step(message)
        except InputError as error:
            level, text = levels.ERROR, f"no force: {error}"
        except TimeoutError:
            level, text = levels.ERROR, "no force: no reply of the server within the time-out"
        except OSError:
            level, text = levels.ERROR, "no force: no server; start tissue-sim serve"
        else:
            level, text = self._describe(reply)
            if level != levels.ERROR:
                if self._tool_frame_id:
                    in_scene = self._frame.convert_to_scene(pose)
                    wrench = compute_wrench_in_tool(reply.force, reply.torque, in_scene)
                else:
                    wrench = compute_wrench_at_frame_origin(reply.force, reply.torque, pose, self._frame)
        stamp = message.header.stamp
        return (make_wrench_message(self._classes, stamp, self.wrench_frame_id, *wrench),
                self._make_due_diagnostic(stamp, level, text, reply))

    def make_silence_messages(self, stamp: Any) -> tuple[Any, Any | None]:
        """Return a zero wrench and a diagnostic for the case that no poses arrive.

        Args:
            stamp: present time stamp.
        """
        level = self._classes.DiagnosticStatus.STALE
        return (make_wrench_message(self._classes, stamp, self.wrench_frame_id, _ZERO, _ZERO),
                self._make_due_diagnostic(stamp, level, "no force: no poses arrive", None))

    def _step(self, message: Any) -> tuple[Reply, Pose]:
        """Return the reply of the server, and the pose in the frame of the poses.

        Raises:
            InputError: the frame, the pose or the stamp is refused, or the server uses another version.
            TimeoutError: no reply in time.
            OSError: no server.
        """
        if message.header.frame_id != self._frame.frame_id:
            raise InputError(f"must be {self._frame.frame_id!r}; got {message.header.frame_id!r}. Transform the poses, "
                             "or set the parameter frame_id.", field="frame_id")
        pose, stamp = read_pose_message(message), read_stamp(message.header.stamp)
        if self._newest is not None and stamp < self._newest - _CLOCK_RESTART:
            self._needs_reset, self._newest = True, None
        if self._newest is not None and stamp < self._newest:
            raise InputError("must not decrease; a later pose was answered already. Send poses in order.",
                             field="stamp")
        if self._needs_reset:
            self._first = stamp
        # The difference of integers keeps nanoseconds, which a double of the time since 1970 does not.
        reply = self._client.step(self._frame.convert_to_scene(pose), at=1e-9 * (stamp - self._first),
                                  reset=self._needs_reset)
        self._newest = stamp
        if _is_executed(reply):
            self._needs_reset = False
        return reply, pose

    def _describe(self, reply: Reply) -> tuple[Any, str]:
        """Return the level and the text of a reply; at the level ERROR no force is published."""
        levels = self._classes.DiagnosticStatus
        try:
            text = Status(reply.status).message
        except ValueError:
            text = "unknown status of a newer server"
        if not _is_executed(reply):
            return levels.ERROR, f"no force: {text}"
        if not all(map(math.isfinite, (*reply.force, *reply.torque))):
            return levels.ERROR, "no force: the force of the reply is not finite"
        return (levels.OK if reply.status == Status.CONVERGED else levels.WARN), text

    def _make_due_diagnostic(self, stamp: Any, level: Any, text: str, reply: Reply | None) -> Any | None:
        """Return a diagnostic if level or text have changed, or once a second."""
        now = read_stamp(stamp)
        if self._reported is not None and self._reported[:2] == (level, text) \
                and 0 <= now - self._reported[2] < _DIAGNOSTIC_INTERVAL:
            return None
        self._reported = (level, text, now)
        return make_diagnostic_message(self._classes, stamp, level, text, reply)


def _is_executed(reply: Reply) -> bool:
    """Return whether the server executed the step: its tissue is at the pose, and a requested reset is done."""
    return reply.status < 100 and reply.status not in (Status.REFUSED, Status.FAILED)


def _rotate(pose: Pose, vector: Vector) -> Vector:
    """Return R v, from the axes of a body to those of the frame in which its pose is given."""
    x, y, z = vector
    first, second, third = (row[0] * x + row[1] * y + row[2] * z for row in pose.rotation_matrix)
    return (first, second, third)


def _rotate_back(pose: Pose, vector: Vector) -> Vector:
    """Return R^T v, from the frame in which the pose of a body is given to the axes of the body."""
    x, y, z = vector
    a, b, c = pose.rotation_matrix
    return (a[0] * x + b[0] * y + c[0] * z, a[1] * x + b[1] * y + c[1] * z, a[2] * x + b[2] * y + c[2] * z)


def _require_positive(value: float, field: str) -> None:
    """Raise InputError if a duration in s is not finite or not above 0."""
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"must be positive and finite; got {value} s. Set the parameter {field}.", field=field)


def _create_client(port: int, host: str, timeout: float) -> TissueClient:
    """Return the client of a server.

    Args:
        port: UDP port, 1 to 65535.
        host: address of the server.
        timeout: longest wait for a reply, s.

    Raises:
        InputError: a value is out of range, or the host is unknown.
    """
    if not 0 < port < 65536:
        raise InputError(f"must be 1 to 65535; got {port}. Set the port that tissue-sim serve prints.", field="port")
    _require_positive(timeout, "timeout")
    try:
        return TissueClient(port, host, timeout)
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(f"must be the address of a server; got {host!r} ({error}). Set the parameter host.",
                         field="host") from None


def run_node(arguments: list[str] | None = None) -> int:
    """Run the node until it is shut down.

    Args:
        arguments: arguments of ROS, such as ``["--ros-args", "-p", "port:=47700"]``; None: those of the command line.

    Returns:
        Exit code; 1 if ROS 2 is not installed or a parameter is refused.
    """
    try:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
        from geometry_msgs.msg import PoseStamped, Vector3, Wrench, WrenchStamped
        from rclpy.clock import Clock, ClockType
        from rclpy.executors import ExternalShutdownException
        from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
        from std_msgs.msg import Header
    except ImportError as error:
        print(f"haptics.clients.ros2: ROS 2 is not installed for this Python ({error}). Source the setup file of "
              "ROS 2.", file=sys.stderr)
        return 1
    rclpy.init(args=arguments)
    node = rclpy.create_node("tissue_sim")
    defaults = {"host": "127.0.0.1", "port": 47700, "timeout": 0.005, "frame_id": "world",
                "scene_position": [0.0, 0.0, 0.0], "scene_orientation": [0.0, 0.0, 0.0, 1.0],
                "tool_frame_id": "tool_tip", "silence": 0.1}
    values = {name: node.declare_parameter(name, default).value for name, default in defaults.items()}
    client = None
    try:
        frame = SceneFrame.from_parameters(values["frame_id"], values["scene_position"], values["scene_orientation"])
        _require_positive(values["silence"], "silence")
        client = _create_client(values["port"], values["host"], values["timeout"])
        bridge = PoseWrenchBridge(client, MessageClasses(Header, Vector3, Wrench, WrenchStamped, DiagnosticArray,
                                                         DiagnosticStatus, KeyValue), frame, values["tool_frame_id"])
        # Only the newest pose counts. A best-effort subscription matches all publishers, a reliable publisher all
        # subscriptions.
        newest = QoSProfile(depth=1, history=QoSHistoryPolicy.KEEP_LAST, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        wrenches = node.create_publisher(WrenchStamped, "tool_wrench", 1)
        diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

        def publish(wrench: Any, diagnostic: Any | None) -> None:
            wrenches.publish(wrench)
            if diagnostic is not None:
                diagnostics.publish(diagnostic)

        # Without poses the timer expires and publishes a zero wrench; each pose restarts it. It also runs while a
        # simulated clock is paused.
        timer = node.create_timer(values["silence"],
                                  lambda: publish(*bridge.make_silence_messages(node.get_clock().now().to_msg())),
                                  clock=Clock(clock_type=ClockType.STEADY_TIME))

        def answer_pose(message: Any) -> None:
            timer.reset()
            publish(*bridge.answer(message))

        node.create_subscription(PoseStamped, "tool_pose", answer_pose, newest)
        rclpy.spin(node)
    except InputError as error:
        print(f"haptics.clients.ros2: {error}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if client is not None:
            client.close()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(run_node())
