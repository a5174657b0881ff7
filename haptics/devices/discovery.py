"""Probe the devices of this computer: which ones open, and why the others do not. No device moves."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from haptics.devices.back_ends import FORCE_SENSORS, HAPTIC_DEVICES, STAGES
from haptics.devices.contracts import DeviceError
from haptics.devices.serial_line import SerialLine, list_serial_port_names
from tissue_sim.errors import InputError

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
