"""The Haply device against the emulator of its service: the contract, the coordinate frames, and each failure."""

import json
import math
import pickle
import socket
import threading
import time

import pytest
from device_contracts import HapticDeviceContract
from waiting import wait_until

from haptics.devices.back_ends import make_haptic_device
from haptics.devices.contracts import DeviceError
from haptics.devices.haply import TIMING, HaplyDevice
from haptics.devices.virtual.faults import Faults
from haptics.devices.virtual.hand import VirtualHand
from haptics.emulators.emulator import make_emulator
from haptics.emulators.haply import START, TIMES, HaplyEmulator, make_haply_emulator
from haptics.loop.ticker import Ticker
from haptics.protocols.haply import HaplyDeviceState, encode_state_message, find_force_in_client_message
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose

#: Origin of the scene at the initial position of the emulated hand.
AT_START = "x_mm=0,y_mm=-150,z_mm=150"
NO_WRENCH = (0.0,) * 6


@pytest.fixture
def service():
    with make_haply_emulator(None, "port=0", Faults()) as emulator:
        yield emulator


@pytest.fixture
def started(service):
    device = make_haptic_device(f"{service.address},{AT_START}")
    device.start()
    yield device
    device.stop()


class TestContract(HapticDeviceContract):
    def ticks(self, device, wrench=NO_WRENCH, start=0.0, count=50):
        poses, ticker = [], Ticker(1e-3)
        ticker.start_first_period()
        for _ in range(count):
            poses.append(device.pose(start))
            device.render(wrench)
            ticker.wait_and_get_lateness_nanoseconds()
        return [pose for pose in poses if pose is not None] if wrench != NO_WRENCH else poses

    @pytest.fixture
    def device(self, service):
        return make_haptic_device(service.address)

    def test_a_force_moves_a_hand_and_leaves_a_motion_unchanged(self, device):
        """Run one device after the other, because the hand of the emulator restarts with each client."""
        other, places = pickle.loads(pickle.dumps(device)), []
        for each, force in ((device, 0.0), (other, 1.0)):
            each.start()
            wrench = (0.0, 0.0, force, 0.0, 0.0, 0.0)
            # 1 N on a grip of 400 N/m is 2.5 mm.
            if force:
                wait_until(lambda each=each, wrench=wrench: self.ticks(each, wrench, count=10)[-1].position[2]
                           > places[0][2] + 2e-3)
            places.append(wait_until(lambda each=each, wrench=wrench: self.ticks(each, wrench, count=2)[-1]).position)
            each.stop()
        free, pushed = places
        assert pushed[2] > free[2] and pushed[:2] == pytest.approx(free[:2], abs=1e-12)

    def test_an_unstarted_device_can_be_pickled(self, device):
        """Compare the first poses that arrive; the ticks before them depend on the load of the computer."""
        poses = []
        for each in (pickle.loads(pickle.dumps(device)), device):
            each.start()
            poses.append(wait_until(lambda each=each: self.ticks(each, count=1)[0]))
            each.stop()
        assert poses[0] == poses[1]


def test_the_first_pose_is_above_the_tissue(service):
    device = make_haptic_device(f"{service.address},above_mm=7")
    device.start()
    pose = device.pose(0.0)
    device.stop()
    assert pose.position == pytest.approx((0.0, 0.0, 7e-3), abs=1e-9)
    assert device.pose(0.0) is None, "a device that is stopped knows no pose"


def test_forces_arrive_and_the_last_one_is_zero(started, service):
    started.render((0.25, 0.5, 1.0, 9.0, 9.0, 9.0))
    wait_until(lambda: service.force == (0.25, 0.5, 1.0))
    started.stop()
    assert service.force == (0.0, 0.0, 0.0)
    started.render((0.0, 0.0, 1.0, 0.0, 0.0, 0.0))  # has no effect after the stop
    started.stop()


def test_a_large_force_is_limited_and_an_invalid_force_is_zero(started, service):
    started.render((30.0, 0.0, 40.0, 0.0, 0.0, 0.0))
    wait_until(lambda: math.hypot(*service.force) == pytest.approx(started.largest_force))
    assert service.force == pytest.approx((3.0, 0.0, 4.0))
    started.render((math.nan, 0.0, 1.0, 0.0, 0.0, 0.0))
    wait_until(lambda: service.force == (0.0, 0.0, 0.0))


def test_axes_and_scale_convert_motion_and_force(service):
    """Scene x, y, z are device y, z, x; the tool moves twice as far as the cursor, the hand feels half the force."""
    device = make_haptic_device(f"{service.address},axes=yzx,scale=2,force_scale=0.5,x_mm=1,y_mm=-148,z_mm=147,turn=1")
    device.start()
    assert device.pose(0.0).position == pytest.approx((-4e-3, 6e-3, -2e-3), abs=1e-9)
    assert device.pose(0.0).orientation == (1.0, 0.0, 0.0, 0.0)
    device.render((1.0, 2.0, 3.0, 0.0, 0.0, 0.0))
    wait_until(lambda: service.force == (1.5, 0.5, 1.0))
    device.stop()
    assert device.largest_force == 10.0


def test_the_tool_turns_with_the_grip_about_the_axes_of_the_scene():
    device = HaplyDevice(axes="yzx", turn=True)
    s = math.sqrt(0.5)
    # From a quarter turn about x, by a quarter turn about the device's z, which is the scene's y.
    first, now = (s, s, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5)
    assert device._compute_quaternion_since_start(now, first) == pytest.approx((s, 0.0, s, 0.0))
    assert device._compute_quaternion_since_start(first, first) == pytest.approx((1.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(("text", "field"), [
    ("http://127.0.0.1:10001", "address"), ("ws://127.0.0.1", "address"), ("ws://127.0.0.1:99999", "address"),
    ("ws://127.0.0.1:1,scale=0", "scale"), ("ws://127.0.0.1:1,axes=xyy", "axes"), ("ws://127.0.0.1:1,axes=xy", "axes"),
    ("ws://127.0.0.1:1,axes=-xyz", "axes"), ("ws://127.0.0.1:1,axes=abc", "axes"), ("ws://127.0.0.1:1,x_mm=3", "x_mm"),
    ("ws://127.0.0.1:1,largest_force_N=-1", "largest_force"), ("ws://127.0.0.1:1,speed=1", "speed")])
def test_invalid_settings_are_refused(text, field):
    with pytest.raises(InputError) as caught:
        make_haptic_device(f"haply:{text}")
    assert field in caught.value.field


def test_an_address_without_a_service_raises():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, but not listening
        address = f"ws://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(DeviceError, match=f"no Haply Inverse service answers at {address} .*Haply Hub"):
            HaplyDevice(address).start()


class Says(threading.Thread):
    """A WebSocket server with a given function for each connection."""

    def __init__(self, talk):
        super().__init__(daemon=True)
        from websockets.sync.server import serve

        self._server = serve(talk, "127.0.0.1", 0, compression=None)
        self.address = f"ws://127.0.0.1:{self._server.socket.getsockname()[1]}"

    def run(self):
        self._server.serve_forever()

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self._server.shutdown()
        self.join()


def said_first(message):
    def talk(connection):
        connection.send(message)
        for _ in connection:
            connection.send(message)

    return talk


@pytest.mark.parametrize(("first", "sentence"), [
    ('{"session_id": 1, "inverse3": []}', "has no Inverse3; connect the device"),
    ("garbage", r"unknown message \(the message must be valid JSON\); install version 3.1"),
    ('{"inverse3": [{"device_id": "1", "state": {}}]}', r"unknown message \(cursor_position is missing\)"),
    (encode_state_message(HaplyDeviceState("04BA", (0.0, 0.0, 0.1), status={"power_supply": False}), (0.0, 0.0, 0.0)),
     "04BA has no power for its motors; plug")])
def test_a_service_without_a_usable_device_raises(first, sentence):
    with Says(said_first(first)) as server, pytest.raises(DeviceError, match=sentence):
        HaplyDevice(server.address).start()


@pytest.mark.parametrize("answer", [b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", b"", b">\r\n"])
def test_another_server_at_the_address_raises(answer):
    """Another web server, a server that disconnects, and a device with another protocol."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        def speak():
            connection, _ = server.accept()
            with connection:
                connection.recv(4096)
                connection.sendall(answer)

        thread = threading.Thread(target=speak)
        thread.start()
        with pytest.raises(DeviceError, match="no Haply Inverse service"):
            HaplyDevice(f"ws://127.0.0.1:{server.getsockname()[1]}").start()
        thread.join()


def test_a_silent_service_gives_no_pose():
    with make_haply_emulator(None, "port=0", Faults(disconnect_after=0.3)) as service:
        device = make_haptic_device(service.address)
        device.start()
        assert device.pose(0.0) is not None
        wait_until(lambda: device.render(NO_WRENCH) or device.pose(0.0) is None)
        device.stop()


def test_invalid_answers_are_ignored_and_only_invalid_answers_give_no_pose():
    place, answers = [0.1], iter(range(10**9))

    def talk(connection):
        state = HaplyDeviceState("1", (0.0, 0.0, 0.1))
        connection.send(encode_state_message(state, (0.0, 0.0, 0.0)))
        for _ in connection:
            good = place[0] is not None and next(answers) % 2 == 0
            state = HaplyDeviceState("1", (0.0, 0.0, place[0]))
            connection.send(encode_state_message(state, (0.0, 0.0, 0.0)) if good else "{]")

    with Says(talk) as server:
        device = HaplyDevice(server.address, origin=(0.0, 0.0, 0.0))
        device.start()
        place[0] = 0.2
        wait_until(lambda: device.render(NO_WRENCH) or device.pose(0.0) == Pose((0.0, 0.0, 0.2)))
        place[0] = None
        wait_until(lambda: device.render(NO_WRENCH) or device.pose(0.0) is None)
        device.stop()


def test_a_slow_service_does_not_delay_the_loop():
    """Answers arrive after 0.2 s: poses are unknown in between, and no call waits for an answer."""
    with make_haply_emulator(None, "port=0", Faults(delay=0.2)) as service:
        device = make_haptic_device(service.address)
        device.start()
        began, none, ticker = time.monotonic(), 0, Ticker(1e-3)
        ticker.start_first_period()
        for _ in range(100):
            none += device.pose(0.0) is None
            device.render(NO_WRENCH)
            ticker.wait_and_get_lateness_nanoseconds()
        passed = time.monotonic() - began
        device.stop()
    # Waiting for an answer in each tick would take 20 s.
    assert none > 0 and passed < 10.0 and TIMING.stale < 0.2


def test_forces_do_not_accumulate_at_a_slow_service():
    """100 ticks pass without an answer: a new force waits for at most two answers."""
    seen, is_slow, answers = [], threading.Event(), threading.Semaphore(0)

    def talk(connection):
        state = encode_state_message(HaplyDeviceState("1", (0.0, 0.0, 0.1)), (0.0, 0.0, 0.0))
        connection.send(state)
        for message in connection:
            seen.append(find_force_in_client_message(message, "1"))
            if is_slow.is_set():
                answers.acquire()
            connection.send(state)

    with Says(talk) as server:
        device = HaplyDevice(server.address)
        device.start()
        wait_until(lambda: device.render(NO_WRENCH) or len(seen) > 20)
        is_slow.set()
        for _ in range(100):
            device.render(NO_WRENCH)
        asked, pushed = len(seen), (0.0, 0.0, 3.0, 0.0, 0.0, 0.0)
        device.render(pushed)
        wait_until(lambda: answers.release() or device.render(pushed) or (0.0, 0.0, 3.0) in seen)
        assert seen.index((0.0, 0.0, 3.0)) <= asked + 3
        is_slow.clear()
        answers.release()
        device.stop()


def test_lost_messages_do_not_stop_the_exchange():
    with make_haply_emulator(None, "port=0",
                             Faults(loss=0.3, seed=2)) as service:  # with this seed the first message arrives
        device = make_haptic_device(service.address)
        device.start()
        before = service.messages
        wait_until(lambda: device.render(NO_WRENCH) or service.messages > before + 10)
        device.stop()


def test_a_stopped_loop_applies_no_force(started, service):
    """The loop renders once and never again: the thread of the device then sends zero force."""
    started.render((0.0, 0.0, 2.0, 0.0, 0.0, 0.0))
    wait_until(lambda: service.force == (0.0, 0.0, 2.0))
    wait_until(lambda: service.force == (0.0, 0.0, 0.0))
    assert started.pose(0.0) is not None, "states go on"


def test_the_emulator_removes_the_force_after_a_silence(service):
    from websockets.sync.client import connect

    from haptics.protocols.haply import encode_force_message, find_device_state_in_message

    with connect(service.address.removeprefix("haply:")) as client:
        first = find_device_state_in_message(client.recv())
        client.send(encode_force_message(first.device_id, (0.0, 0.0, 3.0)))
        assert find_device_state_in_message(client.recv()).device_id == "049D" and service.force == (0.0, 0.0, 3.0)
        with pytest.raises(TimeoutError):
            client.recv(timeout=2 * TIMES.release_time)  # the service sends nothing unrequested
        wait_until(lambda: service.force == (0.0, 0.0, 0.0))
        client.send("nonsense")
        assert find_device_state_in_message(client.recv()).device_id == "049D", "each message has one answer"
    assert service.refused == 1 and service.messages == 2


def test_the_emulated_hand_yields_to_a_force():
    """With a grip of 100 N/m a force of 1 N moves the hand by 10 mm."""
    with make_haply_emulator(None, "port=0,grip_N_m=100,damping_N_s_m=8", Faults()) as service:
        device = make_haptic_device(f"{service.address},{AT_START}")
        device.start()

        def rises():
            device.render((0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
            pose = device.pose(0.0)
            return pose is not None and abs(pose.position[2] - 10e-3) < 0.1e-3

        wait_until(rises)
        assert service.simulate_and_get_cursor_position() \
            == pytest.approx((START[0], START[1], START[2] + 10e-3), abs=0.2e-3)
        device.stop()


def test_a_port_in_use_raises_with_the_remedy(service):
    port = service.address.rpartition(":")[2]
    with pytest.raises(DeviceError, match=f"port {port} cannot be opened.*another emulator"):
        make_emulator(f"haply:port={port}", None).start()
    with pytest.raises(InputError):
        make_emulator("haply:depth=3", None)
    assert "unverified" in service.describe() and isinstance(service, HaplyEmulator)
    json.dumps(service.describe())


def test_the_emulator_accepts_another_hand():
    from haptics.devices.motions import TargetFollowingMotion

    hand = VirtualHand(TargetFollowingMotion(), grip=0.0)
    with HaplyEmulator(hand) as service:
        device = make_haptic_device(f"{service.address},{AT_START}")
        device.start()

        def has_moved():
            device.render((0.0, 0.0, 0.1, 0.0, 0.0, 0.0))
            pose = device.pose(0.0)  # None while the state is stale, as on a busy machine
            return pose is not None and pose.position[2] > 1e-3

        wait_until(has_moved)
        device.stop()
