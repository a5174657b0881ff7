"""Messages of the Haply Inverse service, version 3.1 and later: JSON over WebSocket, by default ws://127.0.0.1:10001.

When a client connects, the service sends config, state and status of each device. After that it answers each message of
the client with exactly one message of states, and sends nothing else. Positions are in m, forces in N, in a
right-handed frame: x right, y forward, z up. A separate grip supplies the orientation.

Sources, none of them verified on a device: docs.haply.co, "Simulation Channel" and "WebSocket Protocol" (versions 3.1
and 3.5 of the service), the maker's Python sample that prints positions, and the client in NVIDIA's Isaac Lab
(`isaaclab.devices.haply`); the tests compare these functions with their messages.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tissue_sim.pose import Quaternion, Vector

#: Default address of the service.
ADDRESS = "ws://127.0.0.1:10001"
#: Key of the devices in messages.
DEVICES = "inverse3"
#: Keys of the grips, which supply the orientation.
GRIPS = ("verse_grip", "wireless_verse_grip", "custom_verse_grip")


@dataclass(frozen=True)
class PlausibilityLimits:
    """Largest values that a message of the service can contain; larger values are errors of the message.

    Attributes:
        distance: Largest distance of the cursor from the base, m; the arm reaches 0.5 m.
        speed: Largest speed of the cursor, m/s.
        quaternion_deviation: Largest deviation of a quaternion's length from 1; an inactive grip sends zeros. A larger
            value accepts quaternions with larger rounding errors.
    """

    distance: float = 2.0
    speed: float = 100.0
    quaternion_deviation: float = 0.05


#: Limits of every message.
_LIMITS = PlausibilityLimits()
_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class HaplyDeviceState:
    """State of one device in a message of the service.

    Attributes:
        device_id: Name of the device in commands.
        position: Position of the cursor, m.
        velocity: Velocity of the cursor, m/s; None: absent.
        orientation: Orientation of the first active grip, unit quaternion (w, x, y, z); None: no grip is active.
        config: Configuration of the device; in the first message only.
        status: Status of the device, such as ``power_supply``.
    """

    device_id: str
    position: Vector
    velocity: Vector | None = None
    orientation: Quaternion | None = None
    config: Mapping[str, Any] = field(default_factory=dict)
    status: Mapping[str, Any] = field(default_factory=dict)


def find_device_state_in_message(message: str | bytes, device_id: str | None = None) -> HaplyDeviceState | None:
    """Find a device in a message of the service, and return its state.

    Args:
        message: Message of the service.
        device_id: Name of the device; None: the first device.

    Returns:
        The state, or None if the message does not contain the device.

    Raises:
        ValueError: The message is not a message of the service.
    """
    content = _parse_json_object(message)
    devices = _get_object_list_or_empty(content, DEVICES)
    for device in devices:
        name = device.get("device_id")
        if not isinstance(name, str) or not name:
            raise ValueError("a device has no device_id")
        if device_id is None or name == device_id:
            break
    else:
        return None
    state = _get_object_or_default(device, "state")
    velocity = None
    if "cursor_velocity" in state:
        velocity = _read_vector(state["cursor_velocity"], "cursor_velocity", _LIMITS.speed)
    return HaplyDeviceState(name, _read_vector(state.get("cursor_position"), "cursor_position", _LIMITS.distance),
                            velocity, _find_active_grip_orientation(content),
                            _get_object_or_default(device, "config", {}), _get_object_or_default(device, "status", {}))


def _parse_json_object(message: str | bytes) -> dict[str, Any]:
    """Return the JSON object in a message; raises ValueError for another content."""
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        raise ValueError("the message must be valid JSON") from None
    if not isinstance(content, dict):
        raise ValueError("the message must be a JSON object")
    return content


def _get_object_list_or_empty(content: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    """Return the list of JSON objects at a key; empty if the key is missing; ValueError for another value."""
    listed = content.get(key)
    if listed is None:
        return []
    if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed):
        raise ValueError(f"{key} must be a list of objects")
    return listed


def _get_object_or_default(content: Mapping[str, Any], key: str,
                           default: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return the JSON object at a key, or the default if the key is missing; ValueError if it is no object."""
    part = content.get(key, default)
    if not isinstance(part, dict):
        raise ValueError(f"{key} must be an object")
    return part


def _read_finite_number(value: Any, name: str) -> float:
    """Return a JSON value as a float; raises ValueError unless the value is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} of the Haply message must be a number; got {json.dumps(value)[:20]}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite; got {number}")
    return number


def _read_vector(value: Any, name: str, largest: float) -> Vector:
    """Return x, y and z of a JSON object as a vector; raises ValueError if its length exceeds `largest`."""
    if not isinstance(value, dict):
        raise ValueError(f"{name} is missing")
    x, y, z = (_read_finite_number(value.get(axis), f"{name}.{axis}") for axis in _AXES)
    if math.hypot(x, y, z) > largest:
        raise ValueError(f"{name} must have a length of at most {largest:g}; got {math.hypot(x, y, z):.3g}")
    return x, y, z


def _find_active_grip_orientation(content: Mapping[str, Any]) -> Quaternion | None:
    """Return the first active grip's orientation, a unit quaternion (w, x, y, z); None: no grip is active."""
    for kind in GRIPS:
        for grip in _get_object_list_or_empty(content, kind):
            quaternion = _get_object_or_default(grip, "state", {}).get("orientation")
            if not isinstance(quaternion, dict):
                continue
            w, x, y, z = (_read_finite_number(quaternion.get(axis), f"orientation.{axis}") for axis in ("w", *_AXES))
            length = math.sqrt(w * w + x * x + y * y + z * z)
            if abs(length - 1.0) <= _LIMITS.quaternion_deviation:
                return w / length, x / length, y / length, z / length
    return None


def encode_force_message(device_id: str, force: Vector, profile: str | None = None) -> str:
    """Return the message that sets the force of a device until the next message.

    Args:
        device_id: Name of the device.
        force: Force in the frame of the device, N.
        profile: Name by which the Haply Hub lists this program; in the first message only.
    """
    message: dict[str, Any] = {} if profile is None else {"session": {"configure": {"profile": {"name": profile}}}}
    values = dict(zip(_AXES, force, strict=True))
    message[DEVICES] = [{"device_id": device_id, "commands": {"set_cursor_force": {"values": values}}}]
    return json.dumps(message)


def find_force_in_client_message(message: str | bytes, device_id: str) -> Vector | None:
    """Return the force, N, that a client's message sets for a device; None: the message sets no force for it.

    Raises:
        ValueError: The message is not a message of a client.
    """
    for device in _get_object_list_or_empty(_parse_json_object(message), DEVICES):
        if device.get("device_id") != device_id:
            continue
        command = _get_object_or_default(device, "commands", {}).get("set_cursor_force")
        if command is not None:
            if not isinstance(command, dict):
                raise ValueError("set_cursor_force must be an object")
            return _read_vector(command.get("values"), "set_cursor_force", math.inf)
    return None


def encode_state_message(state: HaplyDeviceState, force: Vector, session: int | None = None) -> str:
    """Return the service's message about a device, and about a grip if the orientation is known.

    Args:
        state: State of the device; an empty `config` is left out.
        force: Force that the device applies, N.
        session: Number of the session; in the first message only.
    """
    def to_json_object(values: tuple[float, ...], axes: tuple[str, ...] = _AXES) -> dict[str, float]:
        """Return the values by axis."""
        return dict(zip(axes, values, strict=True))

    device: dict[str, Any] = {"device_id": state.device_id}
    if state.config:
        device["config"] = dict(state.config)
    device["state"] = {"cursor_position": to_json_object(state.position),
                       "cursor_velocity": to_json_object(state.velocity or (0.0,) * 3),
                       "current_cursor_force": to_json_object(force), "control_domain": "cartesian",
                       "control_mode": "force" if any(force) else "idle"}
    device["status"] = dict(state.status)
    message: dict[str, Any] = {} if session is None else {"session_id": session}
    message[DEVICES] = [device]
    if state.orientation is not None:
        message["wireless_verse_grip"] = [{
            "device_id": "61576",
            "state": {"buttons": {"a": False, "b": False, "c": False},
                      "orientation": to_json_object(state.orientation, ("w", *_AXES))}}]
    return json.dumps(message)
