"""A Haply Inverse3 through the maker's Inverse service: JSON over WebSocket, in a thread beside the loop.

Messages as in `haptics.protocols.haply`: held against those of the maker's documentation and of clients that are not
ours, but unverified on a device, of which there was none. Tried against the emulator in `haptics.emulators.haply`.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import Any

from haptics.devices.contracts import DeviceError, HapticDevice
from haptics.devices.settings import read_settings
from haptics.devices.web_socket import LineClosedError, WebSocketLine, check_address
from haptics.protocols.haply import ADDRESS, HapticState, force_message, read_state
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Quaternion, Screw, Vector

#: How long to wait for the service at the start, s, and for one of its answers before it is asked again.
CONNECT_WITHIN, ANSWER_WITHIN = 3.0, 0.02
#: A state that is older than this is no pose any more, s; the watchdog of the loop does the rest.
STALE = 0.02
#: Messages that may wait for their answer: more would be forces that arrive late at a service that is slow. After so
#: long without any answer, s, they count as lost.
UNANSWERED, LOST = 2, 0.5
#: Without a force for so long, s, the loop stands: the hand is given none.
SILENCE = 0.05
#: By which the Haply Hub knows this program.
PROFILE = "org.tissue-sim:loop"
#: Largest force, N, unless the settings say otherwise: our choice, not a value of a data sheet.
LARGEST_FORCE = 5.0


class HaplyDevice(HapticDevice):
    """The cursor of an Inverse3 is the tool, and feels its force; the torque is not rendered.

    The service answers each message with one, so each force of the loop brings the next state: a pose is one tick old.
    States come in a thread, and `pose` and `render` do not wait. Where the service falls silent the pose is None. Where
    the loop does, the thread sends no force; where this process dies, the service sees the connection end, and what it
    does with the last force then is not known here.

    Args:
        address: of the service.
        scale: how far the tool moves where the cursor moves by 1.
        force_scale: force on the hand by force on the tool.
        axes: of the device, with their signs, that are x, y and z of the scene: ``"xyz"``, ``"yz-x"``.
        origin: where in the device's frame the centre of the tissue's top is, m; None: so far below where the
            cursor is at the start as `above` says.
        above: m, of the scene.
        turn: turn the tool as the grip is turned from the start on; otherwise it stays upright.
        largest_force: on the hand, N.

    Attributes:
        trouble: why there is no pose any more; empty while there is.

    Raises:
        InputError: an address, a scale or axes that make no sense.
    """

    def __init__(self, address: str = ADDRESS, scale: float = 1.0, force_scale: float = 1.0, axes: str = "xyz",
                 origin: Vector | None = None, above: float = 10e-3, turn: bool = False,
                 largest_force: float = LARGEST_FORCE):
        check_address(address)
        for value, unit, field in ((scale, "", "scale"), (force_scale, "", "force_scale"),
                                   (largest_force, " N", "largest_force")):
            if not 0 < value < math.inf:
                raise InputError(f"{value:g}{unit}; give a finite number above zero", field=field)
        self.address, self._scale, self._force_scale, self._turn = address, scale, force_scale, turn
        self._axes, self._order = axes, _read_axes(axes)
        self._given_origin, self._above, self._most = origin, above, largest_force
        #: What the loop may render at most, so that `largest_force` is kept.
        self.largest_force = largest_force / force_scale
        self._origin: Vector = origin or (0.0, 0.0, 0.0)
        self._first_turn: Quaternion | None = None
        self._line: WebSocketLine | None = None
        self._thread: _Exchange | None = None
        self._trouble = ""
        self._first: HapticState | None = None

    @property
    def trouble(self) -> str:
        return self._trouble if self._thread is None else self._thread.trouble

    def start(self) -> None:
        if self._thread is not None:
            return
        line = self._connect()
        try:
            first = self._greet(line)
        except BaseException:
            line.close()
            raise
        self._first, self._first_turn = first, first.orientation
        if self._given_origin is None:
            x, y, z = self._to_scene(first.position)
            self._origin = self._to_device((x, y, z - self._above / self._scale))
        else:
            self._origin = self._given_origin
        self._thread = _Exchange(line, first, self.address)
        self._thread.start()

    def _connect(self) -> WebSocketLine:
        try:
            return WebSocketLine(self.address, CONNECT_WITHIN)
        except ImportError:
            raise DeviceError("a Haply device needs the package websockets; give 'pip install websockets'") from None
        except LineClosedError as error:
            raise DeviceError(f"what listens at {self.address} is no Haply Inverse service ({error}); give the address "
                              "of its simulation channel, by default port 10001") from None
        except OSError as error:
            raise DeviceError(f"no Haply Inverse service answers at {self.address} ({error}); start the Haply Hub, or "
                              "the service (Linux: systemctl start haply-inverse-service), or give its address as "
                              "haply:ws://HOST:PORT") from None

    def _greet(self, line: WebSocketLine) -> HapticState:
        """Take what the service says first, and introduce this program, with no force."""
        where = f"the Haply Inverse service at {self.address}"
        try:
            messages = line.receive(CONNECT_WITHIN)
            if not messages:
                raise DeviceError(f"{where} said nothing for {CONNECT_WITHIN:g} s; restart it")
            first = read_state(messages[0])
            if first is None:
                raise DeviceError(f"{where} knows no Inverse3; connect the device, give it power, and see in the Haply "
                                  "Hub whether it is there")
            if first.status.get("power_supply") is False:
                raise DeviceError(f"the Inverse3 {first.device_id} has no power for its motors; plug its power supply "
                                  "in, then start again")
            line.send(force_message(first.device_id, (0.0, 0.0, 0.0), PROFILE), CONNECT_WITHIN)
            answers = line.receive(CONNECT_WITHIN)
            if not answers:
                raise DeviceError(f"{where} does not answer; restart it")
            read_state(answers[-1], first.device_id)
        except ValueError as error:
            raise DeviceError(f"{where} says what this program does not understand ({error}); it needs version 3.1 or "
                              "later of the service") from None
        except OSError as error:
            raise DeviceError(f"{where} has gone at the start ({error}); restart it") from None
        return first

    def pose(self, time: float) -> Pose | None:
        thread = self._thread
        state = None if thread is None else thread.newest()
        if state is None:
            return None
        x, y, z = state.position
        a, b, c = self._origin
        u, v, w = self._to_scene((x - a, y - b, z - c))
        place = (self._scale * u, self._scale * v, self._scale * w)
        if not self._turn or state.orientation is None or self._first_turn is None:
            return Pose(place)
        return Pose(place, self._turned(state.orientation, self._first_turn))

    def render(self, wrench: Screw) -> None:
        if self._thread is None:
            return
        x, y, z = (self._force_scale * part for part in wrench[:3])
        size = math.hypot(x, y, z)
        if not size <= self._most:
            # The limits of the loop come first; what is no number gives none.
            cut = self._most / size if math.isfinite(size) else 0.0
            x, y, z = (cut * x, cut * y, cut * z) if cut else (0.0, 0.0, 0.0)
        self._thread.give(self._to_device((x, y, z)))

    def stop(self) -> None:
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.end()
            self._trouble = thread.trouble

    def describe(self) -> dict[str, Any]:
        described: dict[str, Any] = {
            "device": "Haply Inverse3", "address": self.address, "scale": self._scale, "axes": self._axes,
            "force_scale": self._force_scale, "largest_force_N": self._most,
            "origin_mm": [1e3 * part for part in self._origin], "unverified": "messages were never tried on a device"}
        if self._first is not None:
            described |= {"device_id": self._first.device_id, "status": dict(self._first.status)}
        if self.trouble:
            described["trouble"] = self.trouble
        return described

    def _to_scene(self, vector: Vector) -> Vector:
        (i, a), (j, b), (k, c) = self._order
        return a * vector[i], b * vector[j], c * vector[k]

    def _to_device(self, vector: Vector) -> Vector:
        turned = [0.0, 0.0, 0.0]
        for (axis, sign), part in zip(self._order, vector, strict=True):
            turned[axis] = sign * part
        return turned[0], turned[1], turned[2]

    def _turned(self, now: Quaternion, first: Quaternion) -> Quaternion:
        """From the orientation at the start to that of now, in the frame of the scene."""
        (w, x, y, z), (s, a, b, c) = now, first
        u, v, q = self._to_scene((-w * a + x * s - y * c + z * b, -w * b + x * c + y * s - z * a,
                                  -w * c - x * b + y * a + z * s))
        return w * s + x * a + y * b + z * c, u, v, q


class _Exchange:
    """The thread that gives a force and takes a state, again and again."""

    def __init__(self, line: WebSocketLine, first: HapticState, address: str):
        self._line, self._device_id, self._address = line, first.device_id, address
        self._newest = (time.monotonic(), first)
        self._wanted: tuple[float, Vector] = (-math.inf, (0.0, 0.0, 0.0))
        self._unanswered, self._answered = 0, time.monotonic()
        self._given, self._ending = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="Haply device", daemon=True)
        self.trouble = ""

    def start(self) -> None:
        self._thread.start()

    def newest(self) -> HapticState | None:
        """The newest state; None where it is stale."""
        came, state = self._newest
        return None if self.trouble or time.monotonic() - came > STALE else state

    def give(self, force: Vector) -> None:
        """From now on this force, N, in the frame of the device."""
        self._wanted = (time.monotonic(), force)
        self._given.set()

    def end(self) -> None:
        """No force, and the end of the connection."""
        self._ending.set()
        self._given.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                # Also without a loop that ticks the states go on.
                self._given.wait(0.5 * STALE)
                self._given.clear()
                asked, force = self._wanted
                self._exchange(force if time.monotonic() - asked <= SILENCE else (0.0, 0.0, 0.0))
            # Until it is answered: then the service has taken it.
            self._unanswered = 0
            self._exchange((0.0, 0.0, 0.0), within=0.2)
        except OSError as error:
            self.trouble = (f"the Haply Inverse service at {self._address} has gone ({error}); start it again, then "
                            "this program")
        finally:
            self._line.close()

    def _exchange(self, force: Vector, within: float = ANSWER_WITHIN) -> None:
        if self._unanswered < UNANSWERED:
            self._line.send(force_message(self._device_id, force), within + 1.0)
            self._unanswered += 1
        messages = self._line.receive(within)
        if messages:
            self._unanswered, self._answered = max(self._unanswered - len(messages), 0), time.monotonic()
        elif time.monotonic() - self._answered > LOST:
            self._unanswered, self._answered = 0, time.monotonic()
        for message in messages:
            # What makes no sense counts as not received.
            with contextlib.suppress(ValueError):
                state = read_state(message, self._device_id)
                if state is not None:
                    self._newest = (time.monotonic(), state)


def _read_axes(axes: str) -> tuple[tuple[int, float], ...]:
    """For x, y and z of the scene: which axis of the device, and its sign.

    Raises:
        InputError: not three different axes, or a left-handed frame.
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
    places = [axis for axis, _ in order]
    if sorted(places) != [0, 1, 2]:
        raise InputError(f"{axes!r} are no three axes; give x, y and z in some order, with signs, such as xyz or yz-x",
                         field="axes")
    swaps = sum(places[i] > places[j] for i in range(3) for j in range(i + 1, 3))
    if math.prod(each for _, each in order) != (-1.0 if swaps % 2 else 1.0):
        raise InputError(f"{axes!r} is a left-handed frame; change one sign", field="axes")
    return tuple(order)


def open_haply(text: str) -> HaplyDevice:
    """``haply:ws://127.0.0.1:10001,scale=1,force_scale=1,axes=xyz,x_mm=0,y_mm=-150,z_mm=150,above_mm=10,turn=0``.

    Without `x_mm`, `y_mm` and `z_mm` the tissue is below where the cursor is at the start; they go together.
    """
    address, _, rest = text.partition(",")
    axes, numbers = "xyz", []
    for part in rest.split(","):
        name, _, value = part.partition("=")
        if name.strip() == "axes":
            axes = value.strip()
        else:
            numbers.append(part)
    given = read_settings(",".join(numbers), scale=1.0, force_scale=1.0, x_mm=math.nan, y_mm=math.nan, z_mm=math.nan,
                          above_mm=10.0, turn=0, largest_force_N=LARGEST_FORCE)
    place = (given["x_mm"] * 1e-3, given["y_mm"] * 1e-3, given["z_mm"] * 1e-3)
    known = sum(math.isfinite(part) for part in place)
    if known not in (0, 3):
        raise InputError("the place of the tissue has three numbers; give x_mm, y_mm and z_mm, or none", field="x_mm")
    return HaplyDevice(address.strip() or ADDRESS, given["scale"], given["force_scale"], axes,
                       place if known else None, given["above_mm"] * 1e-3, bool(given["turn"]),
                       given["largest_force_N"])
