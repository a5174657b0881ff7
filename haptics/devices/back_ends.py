"""Tables of motions and devices by name, such as ``sine``, ``sine:frequency_hz=2`` or ``virtual:``.

A back-end is a function that makes the device from the text after the colon. A package adds a back-end through an entry
point of the table's group, a program through `Registry.register`. Listing the names imports no back-end, so the command
line can list them in its help quickly.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from haptics.devices.contracts import DeviceError
from haptics.devices.serial_line import SerialLine, list_serial_port_names
from tissue_sim.errors import InputError
from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.registry import Registry

if TYPE_CHECKING:
    from haptics.devices.contracts import ForceSensor, HapticDevice, Motion, Stage

__getattr__ = make_getattr_for_old_names(__name__, {"open_motion": "make_motion", "open_sensor": "make_sensor",
                                                    "open_stage": "make_stage", "open_haptic": "make_haptic_device"})

Device = TypeVar("Device")

#: Motions of the tool without a device.
MOTIONS: Registry[Callable[[str], Motion]] = Registry("motion", "tissue_sim.motions", {
    "random": "haptics.devices.motions:make_random_motion",
    "sine": "haptics.devices.motions:make_sine_motion",
    "protocol": "haptics.devices.motions:make_motion_from_protocol_text",
    "hand": "haptics.devices.motions:make_target_following_motion",
})
#: Force sensors.
FORCE_SENSORS: Registry[Callable[[str], ForceSensor]] = Registry("force sensor", "tissue_sim.force_sensors", {
    "virtual": "haptics.devices.virtual.force_sensor:make_constant_load_sensor",
    "replay": "haptics.devices.replay:make_replay_sensor",
    "rdt": "haptics.devices.rdt:make_rdt_sensor",
    "ati-serial": "haptics.devices.ati_serial:make_ati_serial_sensor",
    "ati-daq": "haptics.devices.ati_daq:make_ati_daq_sensor",
})
#: Linear stages.
STAGES: Registry[Callable[[str], Stage]] = Registry("stage", "tissue_sim.stages", {
    "virtual": "haptics.devices.virtual.stage:make_stand_alone_virtual_stage",
    "tic": "haptics.devices.tic:make_tic_stage",
    "grbl": "haptics.devices.grbl:make_grbl_stage",
    "phidget": "haptics.devices.phidget:make_phidget_stage",
})
#: Haptic devices.
HAPTIC_DEVICES: Registry[Callable[[str], HapticDevice]] = Registry("haptic device", "tissue_sim.haptic_devices", {
    "virtual": "haptics.devices.virtual.hand:make_virtual_hand_following_motion",
    "haply": "haptics.devices.haply:make_haply_device",
})


def make_motion(name: str) -> Motion:
    """Return the motion with a name such as ``sine:frequency_hz=2``, not started; see `make_haptic_device`."""
    return _make_device_of_registered_back_end(MOTIONS, name)


def make_sensor(name: str) -> ForceSensor:
    """Return the force sensor with a name such as ``virtual:``, not started; see `make_haptic_device`."""
    return _make_device_of_registered_back_end(FORCE_SENSORS, name)


def make_stage(name: str) -> Stage:
    """Return the stage with a name such as ``virtual:``, not started; see `make_haptic_device`."""
    return _make_device_of_registered_back_end(STAGES, name)


def make_haptic_device(name: str) -> HapticDevice:
    """Return the haptic device with a name such as ``virtual:``, without starting it.

    Args:
        name: Name of the back-end, followed by a colon and its settings if it has any, such as ``virtual:``.

    Raises:
        InputError: No back-end has this name (the message names the nearest), or the settings are invalid.
    """
    return _make_device_of_registered_back_end(HAPTIC_DEVICES, name)


def _make_device_of_registered_back_end(table: Registry[Callable[[str], Device]], name: str) -> Device:
    """Return the device with a name ``BACK_END:SETTINGS`` from a table of back-ends, not started.

    Raises:
        InputError: No back-end has this name, or the settings are invalid (the field is the back-end).
    """
    back_end, _, rest = name.partition(":")
    make = table.find(back_end)
    try:
        return make(rest)
    except InputError as error:
        raise error.with_location(field=back_end) from None


#: Kinds of devices and their tables of back-ends.
_TABLES = (("force sensor", FORCE_SENSORS), ("stage", STAGES), ("haptic device", HAPTIC_DEVICES))
#: Factory addresses of the back-ends that have one.
_DEFAULT_ADDRESSES = {"virtual": "", "rdt": "//192.168.1.1", "haply": "ws://127.0.0.1:10001", "phidget": "any"}
#: Placeholders for required settings; any valid value serves a probe.
_REQUIRED_SETTINGS = {"tic": "steps_per_mm=1000", "ati-serial": "counts_per_N=1,counts_per_Nm=1",
                      "phidget": "steps_per_mm=1000"}
#: Back-ends on a serial port.
_SERIAL = ("ati-serial", "tic", "grbl")
#: Remedies for back-ends that require a file from the user.
_FILES = {"replay": "give replay:FILE.csv with a recording",
          "ati-daq": "give ati-daq:FILE.cal with the function that reads the voltages"}


@dataclass(frozen=True)
class ProbeResult:
    """Result of probing one device.

    Attributes:
        name: Name of the device, as for `make_sensor`, `make_stage` or `make_haptic_device`.
        kind: Force sensor, stage, haptic device or serial port.
        opens: True if the device opened.
        details: Description by the device itself, or the reason why it did not open.
    """

    name: str
    kind: str
    opens: bool
    details: str


def probe_devices(names: Sequence[str] = ()) -> list[ProbeResult]:
    """Start each device, read its description and stop it; return the results, also of devices that fail.

    Args:
        names: Names of devices. Empty: the factory addresses of all back-ends, and all serial ports; serial ports are
            opened without sending anything.

    Returns:
        Results in the order of the names; a name in several tables, such as ``virtual:``, has several results.

    Raises:
        InputError: A name is the name of no back-end.
    """
    return [each for name in names for each in _probe_devices_of_name(name)] if names \
        else list(_probe_default_devices())


def _probe_default_devices() -> Iterator[ProbeResult]:
    """Yield a result for each back-end, opened only if it has a factory address, and for each serial port."""
    ports = list_serial_port_names()
    for kind, table in _TABLES:
        for back_end in table:
            if back_end in _SERIAL:
                yield ProbeResult(f"{back_end}:", kind, False, f"name its port, as in {back_end}:{ports[0]}" if ports
                                  else "no serial port was found; plug the device in")
            elif back_end in _DEFAULT_ADDRESSES:
                yield _probe_back_end(f"{back_end}:{_DEFAULT_ADDRESSES[back_end]}", kind, table)
            else:
                yield ProbeResult(f"{back_end}:", kind, False, _FILES.get(back_end, "give its name with its settings"))
    for port in ports:
        yield _probe_port_by_opening(port)


def _probe_port_by_opening(port: str) -> ProbeResult:
    """Open and close a port without sending anything: a query of one device can be a motion command of another."""
    try:
        SerialLine(port, 9600, "a device").close()
    except DeviceError as error:
        return ProbeResult(port, "serial port", False, str(error))
    return ProbeResult(port, "serial port", True, f"to identify its device: tissue-sim devices tic:{port}")


def _probe_devices_of_name(name: str) -> Iterator[ProbeResult]:
    """Yield a result for each table (sensors, stages, haptic devices) with the name's back-end; InputError if none."""
    back_end = name.partition(":")[0]
    tables = [(kind, table) for kind, table in _TABLES if back_end in table]
    if not tables:
        known = ", ".join(sorted({each for _, table in _TABLES for each in table}))
        raise InputError(f"the name of a device must begin with one of {known}; got {back_end!r}", field="names")
    for kind, table in tables:
        yield _probe_back_end(name, kind, table)


def _probe_back_end(name: str, kind: str, table: Any) -> ProbeResult:
    """Start a device, read its description and stop it; return a result, which states why the device did not open."""
    back_end, _, rest = name.partition(":")
    if back_end in _REQUIRED_SETTINGS and "=" not in rest:
        rest = f"{rest},{_REQUIRED_SETTINGS[back_end]}"
    try:
        device = table.find(back_end)(rest)
        try:
            device.start()
            description = device.describe()
        finally:
            device.stop()
    except (DeviceError, InputError) as error:
        return ProbeResult(name, kind, False, str(error))
    words = ", ".join(f"{key} {value}" for key, value in description.items() if isinstance(value, str | int | float))
    return ProbeResult(name, kind, True, textwrap.shorten(words, 200, placeholder=" ..."))
