"""The bridge to ROS 2: messages and CDR serialisation of rosbags; the node with a replacement of rclpy.

The node was not run with ROS 2: rclpy is not on the package registry.
"""

import math
import struct
import sys
import threading
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from haptics.clients.ros2 import (
    MessageClasses,
    PoseWrenchBridge,
    SceneFrame,
    compute_wrench_at_frame_origin,
    compute_wrench_in_tool,
    make_diagnostic_message,
    make_wrench_message,
    read_pose_message,
    read_stamp,
    run_node,
)
from haptics.server.client import TissueClient
from haptics.server.server import TissueServer
from haptics.server.wire import Reply, Status
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, ToolForce

STORE = get_typestore(Stores.ROS2_HUMBLE)
CLASSES = MessageClasses(*(STORE.types[name] for name in (
    "std_msgs/msg/Header", "geometry_msgs/msg/Vector3", "geometry_msgs/msg/Wrench", "geometry_msgs/msg/WrenchStamped",
    "diagnostic_msgs/msg/DiagnosticArray", "diagnostic_msgs/msg/DiagnosticStatus", "diagnostic_msgs/msg/KeyValue")))
LEVELS = CLASSES.DiagnosticStatus
#: 2026-11-28 in s.
START = 1_795_000_000


def make_stamp(nanoseconds=0, seconds=START):
    return STORE.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)


def make_pose_message(position, xyzw=(0.0, 0.0, 0.0, 1.0), nanoseconds=0, frame="world", seconds=START):
    types = STORE.types
    return types["geometry_msgs/msg/PoseStamped"](
        header=CLASSES.Header(stamp=make_stamp(nanoseconds, seconds), frame_id=frame),
        pose=types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](**dict(zip("xyz", position, strict=True))),
            orientation=types["geometry_msgs/msg/Quaternion"](**dict(zip("xyzw", xyzw, strict=True)))))


def vectors(wrench):
    return tuple((v.x, v.y, v.z) for v in (wrench.wrench.force, wrench.wrench.torque))


class Spring:
    """Spring of 800 N/m along z, with 2 N m/m about x."""

    status = ForceStatus.CONVERGED

    def __init__(self):
        self.steps, self.resets = [], 0

    def step(self, pose, dt):
        self.steps.append((pose, dt))
        force = ToolForce.from_axial_force(800.0 * pose.depth, 800.0, self.status)
        return ToolForce((0.0, 0.0, force.force, 2.0 * pose.depth, 0.0, 0.0), force.stiffness_matrix, self.status)

    def reset(self):
        self.resets += 1


@contextmanager
def serving(tissue, port=0):
    with TissueServer(tissue, port=port, configuration_port=None, releases=False) as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            yield server.address[1]
        finally:
            server.stop()
            thread.join(300.0)


def test_pose_message_of_golden_bytes():
    """CDR, written by hand: header, stamp, length and text of the frame with NUL, padding to 8, seven doubles."""
    golden = (bytes.fromhex("00010000") + struct.pack("<iI", 12, 345_000_000) + struct.pack("<I", 6) + b"world\0"
              + bytes(6) + struct.pack("<7d", 0.01, -0.02, 0.03, 0.5, -0.5, 0.5, 0.5))
    message = STORE.deserialize_cdr(golden, "geometry_msgs/msg/PoseStamped")
    assert read_pose_message(message) == Pose((0.01, -0.02, 0.03), (0.5, 0.5, -0.5, 0.5))
    assert read_stamp(message.header.stamp) == 12_345_000_000


def test_wrench_message_has_golden_bytes():
    golden = (bytes.fromhex("00010000") + struct.pack("<iI", 12, 345_000_000) + struct.pack("<I", 9)
              + b"tool_tip\0" + bytes(3) + struct.pack("<6d", 0.1, -0.2, 4.0, 1e-3, -0.0, 5e-324))
    message = make_wrench_message(CLASSES, make_stamp(345_000_000, 12), "tool_tip", (0.1, -0.2, 4.0),
                                  (1e-3, -0.0, 5e-324))
    assert bytes(STORE.serialize_cdr(message, "geometry_msgs/msg/WrenchStamped")) == golden


def test_diagnostic_message_has_golden_bytes():
    def text(value, offset):
        raw = value.encode("ascii") + b"\0"
        return bytes(-offset % 4) + struct.pack("<I", len(raw)) + raw

    message = make_diagnostic_message(CLASSES, make_stamp(7, 12), LEVELS.ERROR, "no force: x", None)
    golden = bytes.fromhex("00010000")
    golden += struct.pack("<iI", 12, 7) + text("", 12)      # header; the offset of the body is a multiple of 4
    golden += bytes(-len(golden) % 4) + struct.pack("<I", 1) + b"\2"
    for value in ("tissue_sim: force", "no force: x", "tissue_sim"):
        golden += text(value, len(golden))
    golden += bytes(-len(golden) % 4) + struct.pack("<I", 0)
    assert bytes(STORE.serialize_cdr(message, "diagnostic_msgs/msg/DiagnosticArray")) == golden
    with_reply = make_diagnostic_message(CLASSES, make_stamp(), LEVELS.OK, "", Reply(Status.CONVERGED, 1, 0.0))
    values = with_reply.status[0].values
    assert {each.key: each.value for each in values}["force_error_N"] == "unknown"


@pytest.mark.parametrize("seed", range(10))
def test_frames_agree_with_scipy(seed):
    generator = np.random.default_rng(seed)
    scene_rotation, tool_rotation = Rotation.random(2, rng=generator)
    origin, tip, force, torque = generator.normal(size=(4, 3))
    frame = SceneFrame.from_parameters("world", list(origin), list(scene_rotation.as_quat()))
    pose = read_pose_message(make_pose_message(map(float, tip), map(float, tool_rotation.as_quat())))
    in_scene = frame.convert_to_scene(pose)
    assert in_scene.position == pytest.approx(scene_rotation.inv().apply(tip - origin), abs=1e-14)
    relative = (scene_rotation.inv() * tool_rotation).as_matrix()
    assert np.array(in_scene.rotation_matrix) == pytest.approx(relative, abs=1e-14)
    # The same force and torque in the frame of the poses, and in the axes of the tool.
    in_frame, torque_in_frame = scene_rotation.apply(force), scene_rotation.apply(torque)
    at_origin = compute_wrench_at_frame_origin(tuple(force), tuple(torque), pose, frame)
    assert at_origin[0] == pytest.approx(in_frame, abs=1e-14)
    assert at_origin[1] == pytest.approx(torque_in_frame + np.cross(tip, in_frame), abs=1e-13)
    in_tool = compute_wrench_in_tool(tuple(force), tuple(torque), in_scene)
    assert in_tool[0] == pytest.approx(tool_rotation.inv().apply(in_frame), abs=1e-14)
    assert in_tool[1] == pytest.approx(tool_rotation.inv().apply(torque_in_frame), abs=1e-14)


@pytest.mark.parametrize(("changes", "field"), [
    ({"frame_id": ""}, "frame_id"), ({"position": [0.0, math.nan, 0.0]}, "scene"), ({"position": [0.0]}, "position"),
    ({"orientation": [0.0, 0.0, 0.0]}, "scene_orientation"), ({"orientation": [0.0, 0.0, 0.0, 0.0]}, "orientation")])
def test_invalid_frame_is_refused(changes, field):
    with pytest.raises(InputError) as caught:
        SceneFrame.from_parameters(**{"frame_id": "world", "position": [0.0] * 3, "orientation": [0.0, 0.0, 0.0, 1.0],
                                      **changes})
    assert caught.value.field == field


def test_wrench_of_a_pose_in_the_frame_of_the_tool_and_of_the_poses():
    """The scene is at (1, 0, 0.5) m of the world; the tool is turned by 90 degrees about x."""
    half = math.sqrt(0.5)
    frame = SceneFrame.from_parameters("world", [1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0])
    for tool_frame, expected in (("tool_tip", ((0.0, 4.0, 0.0), (0.01, 0.0, 0.0))),
                                 ("", ((0.0, 0.0, 4.0), (0.01 + 0.2 * 4.0, -1.0 * 4.0, 0.0)))):
        tissue = Spring()
        with serving(tissue) as port, TissueClient(port, timeout=60.0) as client:
            bridge = PoseWrenchBridge(client, CLASSES, frame, tool_frame)
            message = make_pose_message((1.0, 0.2, 0.495), (half, 0.0, 0.0, half), 5)
            wrench, diagnostic = bridge.answer(message)
        assert tissue.steps[0][0].position == pytest.approx((0.0, 0.2, -0.005))
        assert wrench.header.frame_id == (tool_frame or "world") and wrench.header.stamp == message.header.stamp
        found = vectors(wrench)
        assert found[0] == pytest.approx(expected[0], abs=1e-12) and found[1] == pytest.approx(expected[1], abs=1e-12)
        assert diagnostic.status[0].level == LEVELS.OK


def test_time_steps_are_those_of_the_stamps():
    """To 1 ns, although a double of the seconds since 1970 has a resolution of 240 ns."""
    tissue = Spring()
    with serving(tissue) as port, TissueClient(port, timeout=60.0) as client:
        bridge = PoseWrenchBridge(client, CLASSES, SceneFrame("world"), "tool_tip")
        for nanoseconds in (999_000_001, 999_999_999):
            bridge.answer(make_pose_message((0.0, 0.0, 0.0), nanoseconds=nanoseconds))
        bridge.answer(make_pose_message((0.0, 0.0, 0.0), nanoseconds=7, seconds=START + 1))
    assert [dt for _, dt in tissue.steps] == pytest.approx([0.0, 999_998e-9, 8e-9], rel=1e-6, abs=0.0)


def test_stamps_out_of_order_are_refused_and_a_restarted_clock_resets_the_tissue():
    tissue = Spring()
    with serving(tissue) as port, TissueClient(port, timeout=60.0) as client:
        bridge = PoseWrenchBridge(client, CLASSES, SceneFrame("world"), "tool_tip")
        assert vectors(bridge.answer(make_pose_message((0.0, 0.0, -0.005), nanoseconds=5000))[0])[0][2] == 4.0
        wrench, diagnostic = bridge.answer(make_pose_message((0.0, 0.0, -0.005), nanoseconds=4000))
        assert vectors(wrench) == ((0.0,) * 3,) * 2 and diagnostic.status[0].level == LEVELS.ERROR
        assert "stamp" in diagnostic.status[0].message
        assert vectors(bridge.answer(make_pose_message((0.0, 0.0, -0.005), seconds=10))[0])[0][2] == 4.0
    assert tissue.resets == 2 and [dt for _, dt in tissue.steps] == [0.0, 0.0]


@pytest.mark.parametrize("message", [
    make_pose_message((0.0, math.nan, 0.0)), make_pose_message((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
    make_pose_message((0.0, 0.0, 0.0), frame="map"), make_pose_message((20.0, 0.0, -0.005))])
def test_refused_pose_gives_a_zero_wrench_and_a_diagnostic(message):
    with serving(Spring()) as port, TissueClient(port, timeout=60.0) as client:
        bridge = PoseWrenchBridge(client, CLASSES, SceneFrame("world"), "tool_tip")
        wrench, diagnostic = bridge.answer(message)
    assert vectors(wrench) == ((0.0,) * 3,) * 2
    assert diagnostic.status[0].level == LEVELS.ERROR and diagnostic.status[0].message.startswith("no force: ")


def test_second_client_and_missing_server_give_a_zero_wrench_and_a_diagnostic():
    message = make_pose_message((0.0, 0.0, -0.005))
    with serving(Spring()) as port, TissueClient(port, timeout=60.0) as owner, \
            TissueClient(port, timeout=60.0) as client:
        owner.step(0.0)
        bridge = PoseWrenchBridge(client, CLASSES, SceneFrame("world"), "tool_tip")
        wrench, diagnostic = bridge.answer(message)
        assert vectors(wrench) == ((0.0,) * 3,) * 2
        assert diagnostic.status[0].message == f"no force: {Status.BUSY.message}"
        assert bridge.answer(message)[1] is None  # unchanged
        owner.close()
        assert vectors(bridge.answer(message)[0])[0] == (0.0, 0.0, 4.0)
    wrench, diagnostic = PoseWrenchBridge(client := TissueClient(port), CLASSES, SceneFrame("world")).answer(message)
    client.close()
    assert vectors(wrench) == ((0.0,) * 3,) * 2 and "start tissue-sim serve" in diagnostic.status[0].message


def test_late_reply_gives_a_zero_wrench_and_the_next_pose_has_a_force():
    class Waiting(Spring):
        def __init__(self):
            super().__init__()
            self.gate = threading.Event()

        def step(self, pose, dt):
            assert self.gate.wait(300.0)
            return super().step(pose, dt)

    tissue = Waiting()
    with serving(tissue) as port:
        client = TissueClient(port, timeout=0.05)
        bridge = PoseWrenchBridge(client, CLASSES, SceneFrame("world"), "tool_tip")
        wrench, diagnostic = bridge.answer(make_pose_message((0.0, 0.0, -0.005)))
        assert vectors(wrench) == ((0.0,) * 3,) * 2 and "time-out" in diagnostic.status[0].message
        tissue.gate.set()
        # A busy machine may need longer than the time-out for an answer.
        later = [bridge.answer(make_pose_message((0.0, 0.0, -0.005), nanoseconds=1_000_000 * k)) for k in range(1, 100)]
        assert (0.0, 0.0, 4.0) in [vectors(wrench)[0] for wrench, _ in later]
        client.close()


@pytest.mark.parametrize(("status", "level", "axial_force"), [
    (Status.LATE, LEVELS.WARN, 2.0), (Status.STOPPED, LEVELS.WARN, 2.0), (Status.FADING, LEVELS.WARN, 2.0),
    (Status.RETURNING, LEVELS.WARN, 2.0), (7, LEVELS.WARN, 2.0), (Status.REFUSED, LEVELS.ERROR, 0.0),
    (Status.FAILED, LEVELS.ERROR, 0.0), (Status.OTHER_VERSION, LEVELS.ERROR, 0.0)])
def test_each_status_has_its_level(status, level, axial_force):
    """The server fades the force of LATE, STOPPED and FADING; it is published with a warning."""
    client = SimpleNamespace(step=lambda pose, at, reset: Reply(status, 0, at, force=(0.0, 0.0, 2.0)))
    wrench, diagnostic = PoseWrenchBridge(client, CLASSES, SceneFrame("world"), "tool_tip").answer(
        make_pose_message((0.0, 0.0, -0.005)))
    assert diagnostic.status[0].level == level and vectors(wrench)[0] == (0.0, 0.0, axial_force)


def test_reset_is_requested_until_a_step_is_executed():
    """At the start, and after the clock of the stamps was restarted."""
    statuses = [Status.BUSY, Status.REFUSED, Status.FAILED, Status.CONVERGED, Status.REFUSED, Status.CONVERGED,
                Status.BUSY, Status.LATE, Status.CONVERGED]
    stamps = [START, START, START, START + 1, START + 2, START + 3, 10, 11, 12]
    requests = []

    def step(pose, at, reset):
        requests.append((at, reset))
        return Reply(statuses[len(requests) - 1], 0, at)

    bridge = PoseWrenchBridge(SimpleNamespace(step=step), CLASSES, SceneFrame("world"))
    for seconds in stamps:
        bridge.answer(make_pose_message((0.0, 0.0, 0.0), seconds=seconds))
    assert [reset for _, reset in requests] == [True] * 4 + [False] * 2 + [True] * 2 + [False]
    assert [at for at, _ in requests] == pytest.approx([0.0] * 4 + [1.0, 2.0] + [0.0] * 2 + [1.0])


def test_reset_is_requested_again_after_a_time_out():
    resets = []

    def step(pose, at, reset):
        resets.append(reset)
        if len(resets) in (1, 4):
            raise TimeoutError
        return Reply(Status.CONVERGED, 0, at)

    bridge = PoseWrenchBridge(SimpleNamespace(step=step), CLASSES, SceneFrame("world"))
    for seconds in (START, START + 1, START + 2, 10, 11, 12):
        bridge.answer(make_pose_message((0.0, 0.0, 0.0), seconds=seconds))
    assert resets == [True, True, False, True, True, False]


def test_force_that_is_not_finite_is_not_published():
    client = SimpleNamespace(step=lambda pose, at, reset: Reply(0, 0, at, force=(0.0, math.nan, 2.0)))
    bridge = PoseWrenchBridge(client, CLASSES, SceneFrame("world"))
    wrench, diagnostic = bridge.answer(make_pose_message((0.0, 0.0, 0.0)))
    assert vectors(wrench)[0] == (0.0, 0.0, 0.0) and diagnostic.status[0].level == LEVELS.ERROR


def test_without_ros_the_node_names_the_reason(capsys):
    assert run_node([]) == 1
    assert "ROS 2 is not installed" in capsys.readouterr().err


class ReplacementNode:
    """The methods of an rclpy node that the bridge uses; `spin` delivers the poses."""

    def __init__(self, parameters):
        self.parameters, self.published, self.callbacks, self.resets = parameters, {}, {}, 0

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, kind, topic, qos):
        self.published[topic] = []
        return SimpleNamespace(publish=self.published[topic].append)

    def create_subscription(self, kind, topic, callback, qos):
        self.callbacks[topic] = callback

    def create_timer(self, period, callback, clock):
        self.expire = callback
        return SimpleNamespace(reset=lambda: setattr(self, "resets", self.resets + 1))

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=make_stamp))

    def destroy_node(self):
        self.callbacks.clear()


def install_replacement(monkeypatch, node, spin):
    """Install modules with the names that `run_node` imports."""
    modules = {name: ModuleType(name) for name in (
        "rclpy", "rclpy.clock", "rclpy.executors", "rclpy.qos", "diagnostic_msgs", "diagnostic_msgs.msg",
        "geometry_msgs", "geometry_msgs.msg", "std_msgs", "std_msgs.msg")}
    for name in ("init", "try_shutdown"):
        setattr(modules["rclpy"], name, lambda **_: None)
    modules["rclpy"].create_node, modules["rclpy"].spin = lambda name: node, spin
    for name in ("QoSProfile", "QoSHistoryPolicy", "QoSReliabilityPolicy"):
        setattr(modules["rclpy.qos"], name, SimpleNamespace(KEEP_LAST=1, BEST_EFFORT=2))
    modules["rclpy.qos"].QoSProfile = modules["rclpy.clock"].Clock = SimpleNamespace
    modules["rclpy.clock"].ClockType = SimpleNamespace(STEADY_TIME=3)
    modules["rclpy.executors"].ExternalShutdownException = type("ExternalShutdownException", (Exception,), {})
    for kind, found in STORE.types.items():
        package, _, name = kind.partition("/msg/")
        if f"{package}.msg" in modules:
            setattr(modules[f"{package}.msg"], name, found)
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)


def test_node_publishes_wrenches_and_diagnostics(monkeypatch):
    with serving(Spring()) as port:
        node = ReplacementNode({"port": port, "timeout": 60.0, "scene_position": [0.0, 0.0, 0.1]})

        def spin(_):
            node.expire()  # no pose yet
            for k in range(3):
                node.callbacks["tool_pose"](make_pose_message((0.0, 0.0, 0.1 - 1e-3 * k), nanoseconds=1_000_000 * k))

        install_replacement(monkeypatch, node, spin)
        assert run_node([]) == 0
    wrenches, diagnostics = node.published["tool_wrench"], node.published["/diagnostics"]
    assert [vectors(wrench)[0][2] for wrench in wrenches] == pytest.approx([0.0, 0.0, 0.8, 1.6])
    assert {wrench.header.frame_id for wrench in wrenches} == {"tool_tip"}
    assert [each.status[0].level for each in diagnostics] == [LEVELS.STALE, LEVELS.OK]
    assert node.resets == 3


@pytest.mark.parametrize(("parameters", "text"), [
    ({"timeout": -1.0}, "timeout: must be positive"), ({"timeout": 0.0}, "timeout: must be positive"),
    ({"timeout": math.nan}, "timeout: must be positive"), ({"silence": 0.0}, "silence: must be positive"),
    ({"port": 70000}, "port: must be 1 to 65535"), ({"port": -1}, "port: must be 1 to 65535"),
    ({"host": "host.invalid"}, "host: must be the address of a server"),
    ({"host": 70 * "a" + ".invalid"}, "host: must be the address of a server")])
def test_node_refuses_an_invalid_address_or_duration(monkeypatch, capsys, parameters, text):
    install_replacement(monkeypatch, ReplacementNode(parameters), lambda _: None)
    assert run_node([]) == 1
    assert text in capsys.readouterr().err


def test_node_refuses_an_invalid_parameter(monkeypatch, capsys):
    node = ReplacementNode({"scene_orientation": [0.0, 0.0, 0.0, 2.0]})
    install_replacement(monkeypatch, node, lambda _: None)
    assert run_node([]) == 1
    assert "must be a unit quaternion" in capsys.readouterr().err
