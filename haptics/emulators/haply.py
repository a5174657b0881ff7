"""Emulator of a Haply Inverse service, backed by a simulated hand; the mechanics of the arm are not simulated."""

from __future__ import annotations

import contextlib
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from haptics.devices.contracts import Bench, DeviceError, Motion
from haptics.devices.motions import SineMotion, TargetFollowingMotion
from haptics.devices.settings import parse_number_settings
from haptics.devices.virtual.faults import Faults, FaultyMessageQueue
from haptics.devices.virtual.hand import VirtualHand
from haptics.emulators.emulator import Emulator
from haptics.protocols.haply import HaplyDeviceState, encode_state_message, find_force_in_client_message
from tissue_sim.pose import Vector
from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {"emulate_haply": "make_haply_emulator"})

if TYPE_CHECKING:
    from websockets.sync.server import Server, ServerConnection

#: Initial position of the cursor in the frame of the device, m; similar to the maker's examples.
START: Vector = (0.0, -0.15, 0.15)


@dataclass(frozen=True)
class HandSimulationTimes:
    """Time step of the simulated hand, and times of its connection, s.

    Attributes:
        release_time: Time without a message after which the emulator removes the force, s; the real service's time is
            not documented.
        step: Largest time step of the hand, s. A smaller step is more accurate and takes more computing time.
        wait: Longest wait for a message, s; the hand is simulated after each wait, and a shorter wait simulates it more
            often.
    """

    release_time: float = 0.1
    step: float = 1e-3
    wait: float = 5e-3


#: Times of every emulated hand.
TIMES = HandSimulationTimes()
_CONFIG = {"type": "inverse3", "handedness": "right", "gravity_compensation": {"enabled": True, "scaling_factor": 1.0},
           "device_info": {"major_version": 7, "minor_version": 4, "id": "049D"}}
_STATUS = {"calibrated": True, "in_use": False, "power_supply": True, "ready": True, "started": True}


class HaplyEmulator(Emulator):
    """Emulate the service: it sends the state at once to a new client, and then one state for each message.

    The hand restarts with each client. The force is zero without a client, and after a time
    `HandSimulationTimes.release_time` without a message.

    Args:
        hand: Hand that moves the cursor; its position at time 0 corresponds to `START`.
        port: Port to listen on; 0: any free port.
        faults: Faults of the connection.

    Attributes:
        force: Force on the hand in the frame of the device, N.
        largest_force: Largest magnitude of the force so far, N.
        messages: Number of messages received.
        refused: Number of invalid messages among them.
    """

    name = "haply"

    def __init__(self, hand: VirtualHand, port: int = 0, faults: Faults | None = None):
        self._hand, self._port, self._faults = hand, port, faults or Faults()
        self._server: Server | None = None
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._lock = threading.Lock()
        #: Times of the connection and of the last message, s.
        self._began = self._last_message = 0.0
        self.force: Vector = (0.0, 0.0, 0.0)
        self.largest_force = 0.0
        self.messages = self.refused = 0

    @property
    def address(self) -> str:
        """Name for `make_haptic_device` that connects to this emulator; known after `start`."""
        return f"haply:ws://127.0.0.1:{self._port}"

    def start(self) -> None:
        """Serve clients of the port in a thread; has no effect on a started emulator.

        Raises:
            DeviceError: the port cannot be opened.
        """
        if self._server is not None:
            return
        from websockets.sync.server import serve

        try:
            # Compression would delay messages.
            self._server = serve(self._serve_client, "127.0.0.1", self._port, compression=None)
        except OSError as error:
            raise DeviceError(f"port {self._port} cannot be opened for the emulator of a Haply service ({error}); the "
                              "service itself or another emulator may run: give haply:port=0 for any free port"
                              ) from None
        self._port = self._server.socket.getsockname()[1]
        self._ending.clear()
        self._thread = threading.Thread(target=self._server.serve_forever, name="haply emulator", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the server, stop the hand and set the force to zero."""
        if self._server is None or self._thread is None:
            return
        self._ending.set()
        self._server.shutdown()
        self._thread.join()
        self._server = self._thread = None
        self._hand.stop()
        self.force = (0.0, 0.0, 0.0)

    def describe(self) -> dict[str, Any]:
        """Return address, counts of messages, force and the description of the hand; keys carry units."""
        return {"emulator": "Haply Inverse service", "address": self.address, "messages": self.messages,
                "refused": self.refused, "force_N": list(self.force), "largest_force_N": self.largest_force,
                "unverified": f"that the real service removes the force after {TIMES.release_time:g} s of silence",
                **self._hand.describe()}

    def simulate_and_get_cursor_position(self) -> Vector:
        """Simulate the hand until now, and return the position of the cursor in the frame of the device, m."""
        return self._simulate_hand_and_get_state().position

    def _serve_client(self, connection: ServerConnection) -> None:
        """Restart the hand and serve one client until it disconnects or the emulator stops; then remove the force."""
        from websockets.exceptions import ConnectionClosed

        with self._lock:
            self._hand.start()
            self._began = self._last_message = time.monotonic()
            #: Time to which the hand has been simulated, s since the connection.
            self._simulated = 0.0
            first = self._hand.pose(0.0)
            self._zero = first.position if first is not None else (0.0, 0.0, 0.0)
            self._apply_force_to_hand((0.0, 0.0, 0.0))
        line = FaultyMessageQueue(self._faults, self._began)
        with contextlib.suppress(ConnectionClosed):
            connection.send(encode_state_message(self._simulate_hand_and_get_state(config=_CONFIG), self.force,
                                                 session=1))
            while not self._ending.is_set():
                message = None
                with contextlib.suppress(TimeoutError):
                    message = connection.recv(timeout=0.1 * TIMES.wait if self._faults.delay else TIMES.wait)
                now = time.monotonic()
                if message is not None and not line.is_disconnected(now):
                    line.put_message(self._apply_message_and_get_answer(message).encode(), now)
                else:
                    self._simulate_hand_and_get_state()
                for each in line.take_due_messages(now):
                    connection.send(each.decode(errors="replace"))
        with self._lock:
            self._apply_force_to_hand((0.0, 0.0, 0.0))

    def _apply_message_and_get_answer(self, message: str | bytes) -> str:
        """Simulate the hand until now, then apply the force of a message; return the text of the state message."""
        self.messages += 1
        state = self._simulate_hand_and_get_state()
        with self._lock:
            self._last_message = time.monotonic()
            try:
                force = find_force_in_client_message(message, state.device_id)
            except ValueError:
                self.refused += 1
                force = None
            if force is not None:
                self._apply_force_to_hand(force)
        return encode_state_message(state, self.force)

    def _simulate_hand_and_get_state(self, config: dict[str, Any] | None = None) -> HaplyDeviceState:
        """Simulate the hand until now, remove an expired force, and return the state; `config` is included in it."""
        with self._lock:
            now = time.monotonic()
            goal, release = now - self._began, self._last_message + TIMES.release_time - self._began
            pose = None
            while self._simulated < goal:
                self._simulated = min(self._simulated + TIMES.step, goal)
                pose = self._hand.pose(self._simulated)
                if self._simulated >= release and any(self.force):
                    self._apply_force_to_hand((0.0, 0.0, 0.0))
            pose = pose or self._hand.pose(self._simulated)
            position = pose.position if pose is not None else self._zero
            x, y, z = (a + b - c for a, b, c in zip(START, position, self._zero, strict=True))
            return HaplyDeviceState("049D", (x, y, z), self._hand.velocity, (1.0, 0.0, 0.0, 0.0), config or {}, _STATUS)

    def _apply_force_to_hand(self, force: Vector) -> None:
        """Apply a force, N, in the frame of the device, to the simulated hand; update the largest force."""
        self.force = force
        self.largest_force = max(self.largest_force, sum(part * part for part in force) ** 0.5)
        self._hand.render((*force, 0.0, 0.0, 0.0))


def make_haply_emulator(bench: Bench, text: str, faults: Faults) -> HaplyEmulator:
    """Make an emulator of a service with a simulated hand.

    Defaults: ``haply:port=10001,mass_kg=0.15,damping_N_s_m=5,grip_N_m=400,depth_mm=0,frequency_hz=0.5``. With a depth,
    the hand's target moves sinusoidally between its first position and this depth below it. `bench` is not used:
    a haptic device is held by a hand.
    """
    given = parse_number_settings(text, port=10001, mass_kg=0.15, damping_N_s_m=5.0, grip_N_m=400.0, depth_mm=0.0,
                                  frequency_hz=0.5)
    depth = given["depth_mm"] * 1e-3
    motion: Motion = SineMotion(depth, 0.0, given["frequency_hz"]) if depth else TargetFollowingMotion()
    hand = VirtualHand(motion, given["mass_kg"], given["damping_N_s_m"], given["grip_N_m"])
    return HaplyEmulator(hand, int(given["port"]), faults)
