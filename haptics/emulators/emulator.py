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
        """Name for `open_sensor`, `open_stage` or `open_haptic` that connects to the emulator; known after `start`."""

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
    "rdt": "haptics.emulators.rdt:emulate_rdt",
    "ati-serial": "haptics.emulators.ati_serial:emulate_ati_serial",
    "tic": "haptics.emulators.tic:emulate_tic",
    "grbl": "haptics.emulators.grbl:emulate_grbl",
    "haply": "haptics.emulators.haply:emulate_haply",
})


def open_emulator(name: str, bench: Bench, faults: Faults | None = None) -> Emulator:
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
