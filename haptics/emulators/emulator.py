"""Base class and table of emulators: programs that any client of a device can connect to instead of the device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Self

from haptics.devices.contracts import Bench
from haptics.devices.virtual.faults import Faults
from tissue_sim.registry import Registry


class Emulator(ABC):
    """A program that speaks the protocol of a device. The constructor opens no connection; `start` does.

    Attributes:
        name: Name of the protocol, as in ``tissue-sim emulate NAME``.
    """

    name: str

    @property
    @abstractmethod
    def address(self) -> str:
        """Name for `make_sensor`, `make_stage` or `make_haptic_device`; known after `start`."""

    @abstractmethod
    def start(self) -> None:
        """Open the connection and answer in a thread; has no effect on a started emulator.

        Raises:
            DeviceError: The connection cannot be opened.
        """

    @abstractmethod
    def stop(self) -> None:
        """Close the connection and stop the device that backs it; has no effect on a stopped emulator."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return protocol, address, settings and counts of messages. Keys carry units, values have JSON types."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


#: Emulators by name; each is a function of (bench, settings after the colon, faults).
EMULATORS: Registry[Any] = Registry("emulator", "tissue_sim.emulators", {
    "rdt": "haptics.emulators.rdt:make_rdt_emulator",
    "ati-serial": "haptics.emulators.ati_serial:make_ati_serial_emulator",
    "tic": "haptics.emulators.tic:make_tic_emulator",
    "grbl": "haptics.emulators.grbl:make_grbl_emulator",
    "haply": "haptics.emulators.haply:make_haply_emulator",
})


def make_emulator(name: str, bench: Bench, faults: Faults | None = None) -> Emulator:
    """Make an emulator by name, without starting it.

    Args:
        name: Name of the protocol, followed by a colon and its settings if it has any: ``rdt:port=49152``.
        bench: Devices whose samples and motions the emulator transmits; the emulator starts and stops the one it uses.
        faults: Faults of the connection; faults of sensor and motor belong to the bench.

    Raises:
        InputError: No emulator has this name (the message names the nearest), or the settings are invalid.
    """
    protocol, _, settings = name.partition(":")
    return EMULATORS.find(protocol)(bench, settings, faults or Faults())
