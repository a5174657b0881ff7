"""A Haply Inverse service, played: behind it is a hand that moves and gives way, not an arm."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import TYPE_CHECKING, Any

from haptics.devices.contracts import Bench, DeviceError, Motion
from haptics.devices.motions import HandMotion, SineMotion
from haptics.devices.settings import read_settings
from haptics.devices.virtual.faults import Faults, FaultyLine
from haptics.devices.virtual.hand import VirtualHand
from haptics.emulators.emulator import Emulator
from haptics.protocols.haply import HapticState, read_force, state_message
from tissue_sim.pose import Vector

if TYPE_CHECKING:
    from websockets.sync.server import Server, ServerConnection

#: Where the hand begins, in the frame of the device, m: about where the maker's examples have the cursor.
START: Vector = (0.0, -0.15, 0.15)
#: Without a message for so long, s, this emulator lets go. Of the real service it is not known.
LETS_GO = 0.1
#: How finely the hand is moved, s, and how long a thread waits for a message.
_STEP, _WAIT = 1e-3, 5e-3
_CONFIG = {"type": "inverse3", "handedness": "right", "gravity_compensation": {"enabled": True, "scaling_factor": 1.0},
           "device_info": {"major_version": 7, "minor_version": 4, "id": "049D"}}
_STATUS = {"calibrated": True, "in_use": False, "power_supply": True, "ready": True, "started": True}


class HaplyEmulator(Emulator):
    """Answers as the service does: what is there at once, and then one message of states for each message.

    The hand begins anew with each client. Without a message for `LETS_GO` it gives no force, as without a client.

    Args:
        hand: what moves the cursor; its place at time 0 is `START`.
        port: to listen on; 0: any free one.
        faults: on what the service says.
    """

    name = "haply"

    def __init__(self, hand: VirtualHand, port: int = 0, faults: Faults | None = None):
        self._hand, self._port, self._faults = hand, port, faults or Faults()
        self._server: Server | None = None
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._lock = threading.Lock()
        self._began = self._heard = 0.0
        #: On the hand now, N, in the frame of the device, and the largest so far.
        self.force: Vector = (0.0, 0.0, 0.0)
        self.largest_force = 0.0
        #: How many messages came, and how many of them made no sense.
        self.messages = self.refused = 0

    @property
    def address(self) -> str:
        return f"haply:ws://127.0.0.1:{self._port}"

    def start(self) -> None:
        if self._server is not None:
            return
        from websockets.sync.server import serve

        try:
            # Without compression, as on a line that must be fast.
            self._server = serve(self._serve, "127.0.0.1", self._port, compression=None)
        except OSError as error:
            raise DeviceError(f"port {self._port} cannot be opened for the emulator of a Haply service ({error}); the "
                              "service itself or another emulator may run: give haply:port=0 for any free port"
                              ) from None
        self._port = self._server.socket.getsockname()[1]
        self._ending.clear()
        self._thread = threading.Thread(target=self._server.serve_forever, name="haply emulator", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        if self._server is None or self._thread is None:
            return
        self._ending.set()
        self._server.shutdown()
        self._thread.join()
        self._server = self._thread = None
        self._hand.stop()
        self.force = (0.0, 0.0, 0.0)

    def describe(self) -> dict[str, Any]:
        return {"emulator": "Haply Inverse service", "address": self.address, "messages": self.messages,
                "refused": self.refused, "force_N": list(self.force), "largest_force_N": self.largest_force,
                "unverified": f"that the real service lets go after {LETS_GO:g} s of silence", **self._hand.describe()}

    def place(self) -> Vector:
        """Where the cursor is now, m, in the frame of the device."""
        return self._state().position

    def _serve(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        with self._lock:
            self._hand.start()
            self._began = self._heard = time.monotonic()
            self._moved = 0.0
            first = self._hand.pose(0.0)
            self._zero = first.position if first is not None else (0.0, 0.0, 0.0)
            self._push((0.0, 0.0, 0.0))
        line = FaultyLine(self._faults, self._began)
        with contextlib.suppress(ConnectionClosed):
            connection.send(state_message(self._state(config=_CONFIG), self.force, session=1))
            while not self._ending.is_set():
                message = None
                with contextlib.suppress(TimeoutError):
                    message = connection.recv(timeout=0.1 * _WAIT if self._faults.delay else _WAIT)
                now = time.monotonic()
                if message is not None and not line.is_silent(now):
                    line.put(self._answer(message).encode(), now)
                else:
                    self._state()
                for each in line.take(now):
                    connection.send(each.decode(errors="replace"))
        with self._lock:
            self._push((0.0, 0.0, 0.0))

    def _answer(self, message: str | bytes) -> str:
        self.messages += 1
        state = self._state()
        with self._lock:
            self._heard = time.monotonic()
            try:
                force = read_force(message, state.device_id)
            except ValueError:
                self.refused += 1
                force = None
            if force is not None:
                self._push(force)
        return state_message(state, self.force)

    def _state(self, config: dict[str, Any] | None = None) -> HapticState:
        """Move the hand to this moment."""
        with self._lock:
            now = time.monotonic()
            goal, lets_go = now - self._began, self._heard + LETS_GO - self._began
            pose = None
            while self._moved < goal:
                self._moved = min(self._moved + _STEP, goal)
                pose = self._hand.pose(self._moved)
                if self._moved >= lets_go and any(self.force):
                    self._push((0.0, 0.0, 0.0))
            pose = pose or self._hand.pose(self._moved)
            place = pose.position if pose is not None else self._zero
            x, y, z = (a + b - c for a, b, c in zip(START, place, self._zero, strict=True))
            return HapticState("049D", (x, y, z), self._hand.velocity, (1.0, 0.0, 0.0, 0.0), config or {}, _STATUS)

    def _push(self, force: Vector) -> None:
        self.force = force
        self.largest_force = max(self.largest_force, sum(part * part for part in force) ** 0.5)
        self._hand.render((*force, 0.0, 0.0, 0.0))


def emulate_haply(bench: Bench, text: str, faults: Faults) -> HaplyEmulator:
    """``haply:port=10001,mass_kg=0.15,damping_N_s_m=5,grip_N_m=400,depth_mm=0,frequency_hz=0.5``.

    With a depth, the hand goes up and down between where it begins and so far below. The bench is not used: no specimen
    is behind a haptic device, but a hand.
    """
    given = read_settings(text, port=10001, mass_kg=0.15, damping_N_s_m=5.0, grip_N_m=400.0, depth_mm=0.0,
                          frequency_hz=0.5)
    depth = given["depth_mm"] * 1e-3
    motion: Motion = SineMotion(depth, 0.0, given["frequency_hz"]) if depth else HandMotion()
    hand = VirtualHand(motion, given["mass_kg"], given["damping_N_s_m"], given["grip_N_m"])
    return HaplyEmulator(hand, int(given["port"]), faults)
