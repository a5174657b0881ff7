"""What could be opened on this computer, and why the rest could not; nothing moves by it."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from haptics.devices.back_ends import FORCE_SENSORS, HAPTIC_DEVICES, STAGES
from haptics.devices.contracts import DeviceError
from haptics.devices.serial_line import SerialLine, serial_ports
from tissue_sim.errors import InputError

_TABLES = (("force sensor", FORCE_SENSORS), ("stage", STAGES), ("haptic device", HAPTIC_DEVICES))
#: Back-ends with an address of their own, and the one at which a new device is.
_USUAL = {"virtual": "", "rdt": "//192.168.1.1", "haply": "ws://127.0.0.1:10001", "phidget": "any"}
#: Settings without which some cannot be made; to see whether one answers, any will do.
_ANY = {"tic": "steps_per_mm=1000", "ati-serial": "counts_per_N=1,counts_per_Nm=1", "phidget": "steps_per_mm=1000"}
#: Back-ends on a serial port.
_SERIAL = ("ati-serial", "tic", "grbl")
#: What needs a file of the user's.
_FILES = {"replay": "give replay:FILE.csv, a recording to play", "ati-daq": "give ati-daq:FILE.cal and who reads volts"}


@dataclass(frozen=True)
class Tried:
    """A device that was tried: by its name, of which kind; whether it opens; and what it says, or why not."""

    name: str
    kind: str
    opens: bool
    says: str


def find_devices(names: Sequence[str] = ()) -> list[Tried]:
    """Try devices, one after the other: each is started, asked what it is, and stopped.

    Args:
        names: of them; none: the usual addresses of all back-ends; and the serial ports, which are opened only: who
            names a device on one has it asked.
    """
    return [each for name in names for each in _try_name(name)] if names else list(_all())


def _all() -> Iterator[Tried]:
    ports = serial_ports()
    for kind, table in _TABLES:
        for back_end in table:
            if back_end in _SERIAL:
                yield Tried(f"{back_end}:", kind, False, f"name its port, as in {back_end}:{ports[0]}" if ports else
                            "no serial port is there; plug the device in")
            elif back_end in _USUAL:
                yield _try(f"{back_end}:{_USUAL[back_end]}", kind, table)
            else:
                yield Tried(f"{back_end}:", kind, False, _FILES.get(back_end, "give its name with its settings"))
    for port in ports:
        yield _try_port(port)


def _try_port(port: str) -> Tried:
    """Open a port and say nothing on it: what one device takes for a question may move another."""
    try:
        SerialLine(port, 9600, "a device").close()
    except DeviceError as error:
        return Tried(port, "serial port", False, str(error))
    return Tried(port, "serial port", True, f"to ask who is there: tissue-sim devices tic:{port}")


def _try_name(name: str) -> Iterator[Tried]:
    back_end = name.partition(":")[0]
    tables = [(kind, table) for kind, table in _TABLES if back_end in table]
    if not tables:
        known = ", ".join(sorted({each for _, table in _TABLES for each in table}))
        raise InputError(f"no device is called {back_end!r}; there are {known}", field="names")
    for kind, table in tables:
        yield _try(name, kind, table)


def _try(name: str, kind: str, table: Any) -> Tried:
    back_end, _, rest = name.partition(":")
    if back_end in _ANY and "=" not in rest:
        rest = f"{rest},{_ANY[back_end]}"
    try:
        device = table.find(back_end)(rest)
        try:
            device.start()
            said = device.describe()
        finally:
            device.stop()
    except (DeviceError, InputError) as error:
        return Tried(name, kind, False, str(error))
    words = ", ".join(f"{key} {value}" for key, value in said.items() if isinstance(value, str | int | float))
    return Tried(name, kind, True, textwrap.shorten(words, 200, placeholder=" ..."))
