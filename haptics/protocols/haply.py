"""Messages of the Haply Inverse service, version 3.1 and later: JSON over WebSocket, by default ws://127.0.0.1:10001.

When a client connects, the service says what is there: config, state and status of each device. After that it answers
each message of the client with exactly one message of states, and says nothing unasked. Positions are m, forces N, in a
right-handed frame: x right, y forward, z up. A grip that is held beside it gives an orientation.

Sources, none of them tried on a device: docs.haply.co, "Simulation Channel" and "WebSocket Protocol" (versions 3.1 and
3.5 of the service), the maker's Python sample that prints positions, and the client in NVIDIA's Isaac Lab
(`isaaclab.devices.haply`), whose messages the tests hold these functions against.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tissue_sim.pose import Quaternion, Vector

#: Where the service listens, unless its configuration says otherwise.
ADDRESS = "ws://127.0.0.1:10001"
#: What the device itself is called in messages, and the kinds of grips, which give the orientation.
DEVICES = "inverse3"
GRIPS = ("verse_grip", "wireless_verse_grip", "custom_verse_grip")
#: The arm reaches half a metre: a cursor further from its base than this, m, or faster, m/s, is nonsense.
_REACH, _FASTEST = 2.0, 100.0
#: How far the length of an orientation may be from 1: a grip that sleeps says zeros.
_UNIT = 0.05
_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class HapticState:
    """What the service says of one device.

    Attributes:
        device_id: by which commands name it.
        position: of the cursor, m.
        velocity: of the cursor, m/s; None where it is left out.
        orientation: of the first grip that knows it, unit quaternion (w, x, y, z); None where there is none.
        config: of the device; comes with the first message only.
        status: of the device, such as ``power_supply``.
    """

    device_id: str
    position: Vector
    velocity: Vector | None = None
    orientation: Quaternion | None = None
    config: Mapping[str, Any] = field(default_factory=dict)
    status: Mapping[str, Any] = field(default_factory=dict)


def read_state(message: str | bytes, device_id: str | None = None) -> HapticState | None:
    """The state of a device in a message of the service.

    Args:
        message: of the service.
        device_id: of the device that is meant; None: the first.

    Returns:
        Its state; None where that device is not among those of the message.

    Raises:
        ValueError: this is no message of the service; says why.
    """
    content = _object(message)
    devices = _objects(content, DEVICES)
    for device in devices:
        name = device.get("device_id")
        if not isinstance(name, str) or not name:
            raise ValueError("a device without a device_id")
        if device_id is None or name == device_id:
            break
    else:
        return None
    state = _part(device, "state")
    velocity = None
    if "cursor_velocity" in state:
        velocity = _vector(state["cursor_velocity"], "cursor_velocity", _FASTEST)
    return HapticState(name, _vector(state.get("cursor_position"), "cursor_position", _REACH), velocity,
                       _orientation(content), _part(device, "config", {}), _part(device, "status", {}))


def _object(message: str | bytes) -> dict[str, Any]:
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        raise ValueError("no JSON") from None
    if not isinstance(content, dict):
        raise ValueError("JSON, but no object")
    return content


def _objects(content: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    """A list of objects; empty where it is left out."""
    listed = content.get(key)
    if listed is None:
        return []
    if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed):
        raise ValueError(f"{key} is no list of objects")
    return listed


def _part(content: Mapping[str, Any], key: str, default: dict[str, Any] | None = None) -> dict[str, Any]:
    part = content.get(key, default)
    if not isinstance(part, dict):
        raise ValueError(f"a device without {key}")
    return part


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} is no number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{name} is no finite number")
    return number


def _vector(value: Any, name: str, largest: float) -> Vector:
    if not isinstance(value, dict):
        raise ValueError(f"no {name}")
    x, y, z = (_number(value.get(axis), f"{name}.{axis}") for axis in _AXES)
    if math.hypot(x, y, z) > largest:
        raise ValueError(f"{name} is {math.hypot(x, y, z):.3g} from zero, which no device reaches")
    return x, y, z


def _orientation(content: Mapping[str, Any]) -> Quaternion | None:
    for kind in GRIPS:
        for grip in _objects(content, kind):
            given = _part(grip, "state", {}).get("orientation")
            if not isinstance(given, dict):
                continue
            w, x, y, z = (_number(given.get(axis), f"orientation.{axis}") for axis in ("w", *_AXES))
            length = math.sqrt(w * w + x * x + y * y + z * z)
            if abs(length - 1.0) <= _UNIT:
                return w / length, x / length, y / length, z / length
    return None


def force_message(device_id: str, force: Vector, profile: str | None = None) -> str:
    """Ask a device to give a force, N, until the next message; the answer is a message of states.

    Args:
        device_id: of the device.
        force: N, in its frame.
        profile: name by which the Haply Hub knows this program; in the first message only.
    """
    message: dict[str, Any] = {} if profile is None else {"session": {"configure": {"profile": {"name": profile}}}}
    values = dict(zip(_AXES, force, strict=True))
    message[DEVICES] = [{"device_id": device_id, "commands": {"set_cursor_force": {"values": values}}}]
    return json.dumps(message)


def read_force(message: str | bytes, device_id: str) -> Vector | None:
    """The force that a message of a client asks of a device, N; None where it asks for none.

    Raises:
        ValueError: this is no message of a client; says why.
    """
    for device in _objects(_object(message), DEVICES):
        if device.get("device_id") != device_id:
            continue
        command = _part(device, "commands", {}).get("set_cursor_force")
        if command is not None:
            if not isinstance(command, dict):
                raise ValueError("set_cursor_force is no object")
            return _vector(command.get("values"), "set_cursor_force", math.inf)
    return None


def state_message(state: HapticState, force: Vector, session: int | None = None) -> str:
    """What the service says: of a device, and of a grip where its orientation is known.

    Args:
        state: its `config` is said where it is not empty.
        force: that the device gives, N.
        session: number of the session; in the first message only.
    """
    def named(values: tuple[float, ...], axes: tuple[str, ...] = _AXES) -> dict[str, float]:
        return dict(zip(axes, values, strict=True))

    device: dict[str, Any] = {"device_id": state.device_id}
    if state.config:
        device["config"] = dict(state.config)
    device["state"] = {"cursor_position": named(state.position), "cursor_velocity": named(state.velocity or (0.0,) * 3),
                       "current_cursor_force": named(force), "control_domain": "cartesian",
                       "control_mode": "force" if any(force) else "idle"}
    device["status"] = dict(state.status)
    message: dict[str, Any] = {} if session is None else {"session_id": session}
    message[DEVICES] = [device]
    if state.orientation is not None:
        message["wireless_verse_grip"] = [{
            "device_id": "61576",
            "state": {"buttons": {"a": False, "b": False, "c": False},
                      "orientation": named(state.orientation, ("w", *_AXES))}}]
    return json.dumps(message)
