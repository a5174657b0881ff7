"""A Haply Inverse3 through the maker's Inverse service: JSON over WebSocket, exchanged by a background thread.

Messages follow `haptics.protocols.haply`. They agree with the maker's documentation and with other clients, but are
unverified on hardware; tests run against the emulator in `haptics.emulators.haply`. The WebSocket client is for use by
one thread and has a timeout for each call.
"""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from haptics.devices.contracts import DeviceError, HapticDevice
from haptics.devices.settings import parse_number_settings
from haptics.protocols.haply import ADDRESS, HaplyDeviceState, encode_force_message, find_device_state_in_message
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Quaternion, Screw, Vector


class WebSocketClosedError(OSError):
    """The other end has closed the connection, or is not a WebSocket server."""


class WebSocketClientConnection:
    """A connection to a WebSocket server, for one thread. The constructor opens the connection.

    Args:
        address: ``ws://HOST:PORT/PATH``.
        timeout: Longest time to connect, s.

    Raises:
        OSError: No server listens at the address, or the server does not answer.
        WebSocketClosedError: The server is not a WebSocket server.
    """

    def __init__(self, address: str, timeout: float):
        from websockets.client import ClientProtocol
        from websockets.protocol import State
        from websockets.uri import parse_uri

        host, port = parse_host_and_port(address)
        self._open = State.OPEN
        self._socket = socket.create_connection((host, port), timeout)
        try:
            # Nagle's algorithm would delay a force until the next one fills a packet.
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._protocol = ClientProtocol(parse_uri(address))
            self._protocol.send_request(self._protocol.connect())
            self._parts: list[bytes] = []
            self._send_queued_data(timeout)
            end = time.monotonic() + timeout
            while self._protocol.state is not self._open:
                if self._protocol.handshake_exc is not None:
                    raise WebSocketClosedError(f"the server is not a WebSocket server: {self._protocol.handshake_exc}")
                remaining = end - time.monotonic()
                if remaining <= 0:
                    raise TimeoutError(f"the server does not answer the WebSocket handshake within {timeout:g} s")
                self._receive_data_and_send_replies(remaining)
        except BaseException:
            self._socket.close()
            raise

    def send(self, message: str, timeout: float) -> None:
        """Send one text message, and wait until the system has accepted its bytes.

        Raises:
            OSError: The connection is closed, or accepts no data within `timeout` seconds.
        """
        self._require_open()
        self._protocol.send_text(message.encode())
        self._send_queued_data(timeout)

    def wait_and_receive_all_messages(self, timeout: float) -> list[bytes]:
        """Wait up to `timeout` seconds for a message and return all received messages.

        Returns:
            Messages in order of receipt; empty if none arrived in time.

        Raises:
            OSError: The connection is closed.
        """
        end = time.monotonic() + timeout
        while not (messages := self._take_complete_messages()):
            self._require_open()
            remaining = end - time.monotonic()
            if remaining <= 0:
                return []
            with contextlib.suppress(TimeoutError):
                self._receive_data_and_send_replies(remaining)
        return messages

    def close(self) -> None:
        """Send the closing frame and disconnect; never raises."""
        with contextlib.suppress(Exception):
            if self._protocol.state is self._open:
                self._protocol.send_close(1000)
                self._send_queued_data(0.1)
        self._socket.close()

    def _require_open(self) -> None:
        """Raise a WebSocketClosedError if the connection is not open."""
        if self._protocol.state is not self._open:
            raise WebSocketClosedError("the server has closed the connection")

    def _receive_data_and_send_replies(self, timeout: float) -> None:
        """Read the socket once, waiting up to `timeout` s (TimeoutError), and send the protocol's replies."""
        self._socket.settimeout(timeout)
        data = self._socket.recv(65536)
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        self._send_queued_data(0.1)
        if not data:
            # After the handshake, messages received before the end are returned first; the next call reports the end.
            if self._protocol.handshake_exc is not None:
                raise WebSocketClosedError(f"the server is not a WebSocket server: {self._protocol.handshake_exc}")
            if not self._protocol.events:
                raise WebSocketClosedError("the server has closed the connection")

    def _send_queued_data(self, timeout: float) -> None:
        """Send all data that the protocol has queued, such as messages and replies to pings."""
        for data in self._protocol.data_to_send():
            if data:
                self._socket.settimeout(timeout)
                self._socket.sendall(data)

    def _take_complete_messages(self) -> list[bytes]:
        """Remove and return the complete messages received so far; a fragment stays until its message is complete."""
        from websockets.frames import Frame, Opcode

        messages = []
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._parts.append(bytes(event.data))
                if event.fin:
                    messages.append(b"".join(self._parts))
                    self._parts = []
        return messages


def parse_host_and_port(address: str) -> tuple[str, int]:
    """Return host and port of an address.

    Raises:
        InputError: The address is not of the form ``ws://HOST:PORT``.
    """
    parts = urlsplit(address)
    try:
        port = parts.port
    except ValueError:
        port = None
    if parts.scheme != "ws" or not parts.hostname or port is None:
            raise InputError(f"the address must be ws://HOST:PORT, such as ws://127.0.0.1:10001; got {address!r}",
                             field="address")
    return parts.hostname, port


#: Name by which the Haply Hub lists this program.
PROFILE = "org.tissue-sim:loop"
#: Default of the largest force, N; chosen by this project, not taken from a data sheet.
LARGEST_FORCE = 5.0


@dataclass(frozen=True)
class HaplyTiming:
    """Times of the exchange with the Inverse service, s, and the number of messages in flight."""

    #: Longest wait for the connection and for each of the first messages, s.
    connect: float = 3.0
    #: Longest wait for an answer before the next message is sent, s.
    answer: float = 0.02
    #: Age at which a state expires, s; `HaplyDevice.pose` then returns None and the loop's watchdog removes the force.
    stale: float = 0.02
    #: Messages in flight; more would make forces arrive late at a slow service.
    max_unanswered: int = 2
    #: Time without any answer after which the messages in flight count as lost, s.
    lost: float = 0.5
    #: Time without a new force from the loop after which the hand gets zero force, s.
    silence: float = 0.05


#: Settings of this process.
TIMING = HaplyTiming()


class HaplyDevice(HapticDevice):
    """An Inverse3: the cursor is the tool's position, and the hand feels the tool's force. Torques are not rendered.

    The service answers each message with one state, so the force of one tick brings the pose of the next: poses are one
    tick old. A thread exchanges the messages; `pose` and `render` do not wait. If the service stops answering, `pose`
    returns None. If the loop stops rendering, the thread sends zero force. If this process dies, the connection ends;
    the service's handling of the last force is then undocumented.

    Args:
        address: Address of the service.
        scale: Motion of the tool divided by motion of the cursor.
        force_scale: Force on the hand divided by force on the tool.
        axes: Axes of the device that are x, y and z of the scene, with signs: ``"xyz"``, ``"yz-x"``.
        origin: Centre of the tissue's top in the device's frame, m; None: `above` below the cursor at the start.
        above: Height of the cursor above the tissue at the start, m in the scene.
        turn: True: the tool turns with the grip from its first orientation. False: the tool stays upright.
        largest_force: Largest force on the hand, N.

    Attributes:
        exchange_error_message: Reason why poses are missing; empty while the exchange works.

    Raises:
        InputError: The address, a scale, the axes or the largest force are invalid.
    """

    def __init__(self, address: str = ADDRESS, scale: float = 1.0, force_scale: float = 1.0, axes: str = "xyz",
                 origin: Vector | None = None, above: float = 10e-3, turn: bool = False,
                 largest_force: float = LARGEST_FORCE):
        parse_host_and_port(address)
        for value, unit, field in ((scale, "", "scale"), (force_scale, "", "force_scale"),
                                   (largest_force, " N", "largest_force")):
            if not 0 < value < math.inf:
                raise InputError(f"scales and largest force must be finite numbers above 0; got {value:g}{unit}",
                                 field=field)
        self.address, self._scale, self._force_scale, self._uses_orientation = address, scale, force_scale, turn
        self._axes, self._axis_order = axes, _parse_axis_indices_and_signs(axes)
        self._given_origin, self._above, self._largest_hand_force = origin, above, largest_force
        #: Largest force of the loop, N, with which the force on the hand stays within its limit.
        self.largest_force = largest_force / force_scale
        self._origin: Vector = origin or (0.0, 0.0, 0.0)
        self._first_orientation: Quaternion | None = None
        self._line: WebSocketClientConnection | None = None
        self._thread: _ExchangeThread | None = None
        self._trouble = ""
        self._first: HaplyDeviceState | None = None

    @property
    def exchange_error_message(self) -> str:
        """Message with the reason why poses are missing; empty while the exchange works, and before the start."""
        return self._trouble if self._thread is None else self._thread.exchange_error_message

    def start(self) -> None:
        """Connect to the service, set the origin of the motion and start the thread that exchanges messages."""
        if self._thread is not None:
            return
        line = self._open_connection()
        try:
            first = self._register_and_get_first_state(line)
        except BaseException:
            line.close()
            raise
        self._first, self._first_orientation = first, first.orientation
        if self._given_origin is None:
            x, y, z = self._permute_to_scene_axes(first.position)
            self._origin = self._permute_to_device_axes((x, y, z - self._above / self._scale))
        else:
            self._origin = self._given_origin
        self._thread = _ExchangeThread(line, first, self.address)
        self._thread.start()

    def _open_connection(self) -> WebSocketClientConnection:
        """Open and return the connection to the service; raises a DeviceError with the remedy if this fails."""
        try:
            return WebSocketClientConnection(self.address, TIMING.connect)
        except ImportError:
            raise DeviceError("a Haply device requires the package websockets; run 'pip install websockets'") from None
        except WebSocketClosedError as error:
            raise DeviceError(f"the server at {self.address} is no Haply Inverse service ({error}); give the address "
                              "of its simulation channel, by default port 10001") from None
        except OSError as error:
            raise DeviceError(f"no Haply Inverse service answers at {self.address} ({error}); start the Haply Hub, or "
                              "the service (Linux: systemctl start haply-inverse-service), or give its address as "
                              "haply:ws://HOST:PORT") from None

    def _register_and_get_first_state(self, line: WebSocketClientConnection) -> HaplyDeviceState:
        """Receive the first state, register this program by a message with zero force, and return the first state."""
        service = f"the Haply Inverse service at {self.address}"
        try:
            messages = line.wait_and_receive_all_messages(TIMING.connect)
            if not messages:
                raise DeviceError(f"{service} sent nothing within {TIMING.connect:g} s; restart it")
            first = find_device_state_in_message(messages[0])
            if first is None:
                raise DeviceError(f"{service} has no Inverse3; connect the device, switch it on, and check in the "
                                  "Haply Hub that it is listed")
            if first.status.get("power_supply") is False:
                raise DeviceError(f"the Inverse3 {first.device_id} has no power for its motors; plug its power supply "
                                  "in, then start again")
            line.send(encode_force_message(first.device_id, (0.0, 0.0, 0.0), PROFILE), TIMING.connect)
            answers = line.wait_and_receive_all_messages(TIMING.connect)
            if not answers:
                raise DeviceError(f"{service} does not answer; restart it")
            find_device_state_in_message(answers[-1], first.device_id)
        except ValueError as error:
            raise DeviceError(f"{service} sent an unknown message ({error}); install version 3.1 or later of the "
                              "service") from None
        except OSError as error:
            raise DeviceError(f"{service} closed the connection at the start ({error}); restart it") from None
        return first

    def pose(self, time: float) -> Pose | None:
        """Return the newest pose of the tool in the scene, from the scaled cursor position, m; None if too old."""
        thread = self._thread
        state = None if thread is None else thread.get_newest_state_or_none()
        if state is None:
            return None
        x, y, z = state.position
        a, b, c = self._origin
        u, v, w = self._permute_to_scene_axes((x - a, y - b, z - c))
        position = (self._scale * u, self._scale * v, self._scale * w)
        if not self._uses_orientation or state.orientation is None or self._first_orientation is None:
            return Pose(position)
        return Pose(position, self._compute_quaternion_since_start(state.orientation, self._first_orientation))

    def render(self, wrench: Screw) -> None:
        """Store the force, N, scaled and limited, for the thread to send; the torque is ignored. Does not wait."""
        if self._thread is None:
            return
        x, y, z = (self._force_scale * part for part in wrench[:3])
        size = math.hypot(x, y, z)
        if not size <= self._largest_hand_force:
            # A second limit behind the loop's own; a force that is not a number becomes zero.
            factor = self._largest_hand_force / size if math.isfinite(size) else 0.0
            x, y, z = (factor * x, factor * y, factor * z) if factor else (0.0, 0.0, 0.0)
        self._thread.set_force(self._permute_to_device_axes((x, y, z)))

    def stop(self) -> None:
        """End the exchange of messages with the service."""
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.stop_and_close()
            self._trouble = thread.exchange_error_message

    def describe(self) -> dict[str, Any]:
        """Return address, axes, scales, largest force and state of the device; keys carry units."""
        described: dict[str, Any] = {
            "device": "Haply Inverse3", "address": self.address, "scale": self._scale, "axes": self._axes,
            "force_scale": self._force_scale, "largest_force_N": self._largest_hand_force,
            "origin_mm": [1e3 * part for part in self._origin], "unverified": "messages were never tried on a device"}
        if self._first is not None:
            described |= {"device_id": self._first.device_id, "status": dict(self._first.status)}
        if self.exchange_error_message:
            described["trouble"] = self.exchange_error_message
        return described

    def _permute_to_scene_axes(self, vector: Vector) -> Vector:
        """Permute a vector from the device's axes to the scene's, with signs; no scaling, no shift of the origin."""
        (i, a), (j, b), (k, c) = self._axis_order
        return a * vector[i], b * vector[j], c * vector[k]

    def _permute_to_device_axes(self, vector: Vector) -> Vector:
        """Permute a vector from the scene's axes to the device's, with signs; no scaling, no shift of the origin."""
        turned = [0.0, 0.0, 0.0]
        for (axis, sign), part in zip(self._axis_order, vector, strict=True):
            turned[axis] = sign * part
        return turned[0], turned[1], turned[2]

    def _compute_quaternion_since_start(self, now: Quaternion, first: Quaternion) -> Quaternion:
        """Return the grip's rotation from `first` to `now`, a unit quaternion (w, x, y, z) in the scene's axes."""
        (w, x, y, z), (s, a, b, c) = now, first
        u, v, q = self._permute_to_scene_axes((-w * a + x * s - y * c + z * b, -w * b + x * c + y * s - z * a,
                                               -w * c - x * b + y * a + z * s))
        return w * s + x * a + y * b + z * c, u, v, q


class _ExchangeThread:
    """A thread that repeatedly sends the newest force and receives the newest state.

    Args:
        line: Open connection; the thread closes it at the end.
        first: First state received.
        address: Address of the service, for messages.

    Attributes:
        exchange_error_message: Reason why the exchange ended; empty while it works.
    """

    def __init__(self, line: WebSocketClientConnection, first: HaplyDeviceState, address: str):
        self._line, self._device_id, self._address = line, first.device_id, address
        #: Time of receipt, s, and newest state.
        self._newest = (time.monotonic(), first)
        #: Time of the request, s, and force to apply, N.
        self._request: tuple[float, Vector] = (-math.inf, (0.0, 0.0, 0.0))
        #: Number of messages in flight, and time of the last answer, s.
        self._unanswered, self._answered = 0, time.monotonic()
        self._has_force, self._ending = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run_exchange, name="Haply device", daemon=True)
        self.exchange_error_message = ""

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def get_newest_state_or_none(self) -> HaplyDeviceState | None:
        """Return the newest state, or None if it has expired or the exchange has ended."""
        received, state = self._newest
        return None if self.exchange_error_message or time.monotonic() - received > TIMING.stale else state

    def set_force(self, force: Vector) -> None:
        """Store the force to send from now on, N, in the frame of the device; returns without waiting."""
        self._request = (time.monotonic(), force)
        self._has_force.set()

    def stop_and_close(self) -> None:
        """Make the thread send zero force and close the connection; return when the thread has ended."""
        self._ending.set()
        self._has_force.set()
        self._thread.join()

    def _run_exchange(self) -> None:
        """Exchange messages until `stop_and_close` and send zero force, or store an OSError; the body of the thread."""
        try:
            while not self._ending.is_set():
                # The timeout keeps states fresh while the loop renders nothing.
                self._has_force.wait(0.5 * TIMING.stale)
                self._has_force.clear()
                requested, force = self._request
                self._exchange_once(force if time.monotonic() - requested <= TIMING.silence else (0.0, 0.0, 0.0))
            # The answer confirms that the service has received the zero force.
            self._unanswered = 0
            self._exchange_once((0.0, 0.0, 0.0), within=0.2)
        except OSError as error:
            self.exchange_error_message = (f"the Haply Inverse service at {self._address} is gone ({error}); start it "
                                           "again, then this program")
        finally:
            self._line.close()

    def _exchange_once(self, force: Vector, within: float = TIMING.answer) -> None:
        """Send a force, N, unless too many messages are in flight, and receive answers for up to `within` seconds."""
        if self._unanswered < TIMING.max_unanswered:
            self._line.send(encode_force_message(self._device_id, force), within + 1.0)
            self._unanswered += 1
        messages = self._line.wait_and_receive_all_messages(within)
        if messages:
            self._unanswered, self._answered = max(self._unanswered - len(messages), 0), time.monotonic()
        elif time.monotonic() - self._answered > TIMING.lost:
            self._unanswered, self._answered = 0, time.monotonic()
        for message in messages:
            # An invalid message counts as not received.
            with contextlib.suppress(ValueError):
                state = find_device_state_in_message(message, self._device_id)
                if state is not None:
                    self._newest = (time.monotonic(), state)


def _parse_axis_indices_and_signs(axes: str) -> tuple[tuple[int, float], ...]:
    """Return three pairs, for x, y and z of the scene: index (0 to 2) and sign (1.0 or -1.0) of the device's axis.

    Raises:
        InputError: The axes are not x, y and z in some order, or the frame is left-handed.
    """
    order, sign = [], 1.0
    for letter in axes:
        if letter in "+-":
            sign = -1.0 if letter == "-" else 1.0
        elif letter in "xyz":
            order.append(("xyz".index(letter), sign))
            sign = 1.0
        else:
            order.append((3, sign))
    indices = [axis for axis, _ in order]
    if sorted(indices) != [0, 1, 2]:
        raise InputError(f"the axes must be x, y and z in some order, with signs, such as xyz or yz-x; got {axes!r}",
                         field="axes")
    swaps = sum(indices[i] > indices[j] for i in range(3) for j in range(i + 1, 3))
    if math.prod(each for _, each in order) != (-1.0 if swaps % 2 else 1.0):
        raise InputError(f"the axes must form a right-handed frame; got {axes!r}. Change one sign", field="axes")
    return tuple(order)


def make_haply_device(text: str) -> HaplyDevice:
    """Make a Haply device, which is not started, from its address and settings.

    Defaults: ``haply:ws://127.0.0.1:10001,scale=1,force_scale=1,axes=xyz,above_mm=10,turn=0,largest_force_N=5``. The
    settings ``x_mm=0,y_mm=-150,z_mm=150`` give the centre of the tissue's top in the device's frame; without them the
    tissue is `above_mm` below the cursor at the start.
    """
    address, _, rest = text.partition(",")
    axes, numbers = "xyz", []
    for part in rest.split(","):
        name, _, value = part.partition("=")
        if name.strip() == "axes":
            axes = value.strip()
        else:
            numbers.append(part)
    given = parse_number_settings(",".join(numbers), scale=1.0, force_scale=1.0, x_mm=math.nan, y_mm=math.nan,
                                  z_mm=math.nan,
                                  above_mm=10.0, turn=0, largest_force_N=LARGEST_FORCE)
    origin = (given["x_mm"] * 1e-3, given["y_mm"] * 1e-3, given["z_mm"] * 1e-3)
    known = sum(math.isfinite(part) for part in origin)
    if known not in (0, 3):
        raise InputError("x_mm, y_mm and z_mm must be given together; give all three, or none", field="x_mm")
    return HaplyDevice(address.strip() or ADDRESS, given["scale"], given["force_scale"], axes,
                       origin if known else None, given["above_mm"] * 1e-3, bool(given["turn"]),
                       given["largest_force_N"])
