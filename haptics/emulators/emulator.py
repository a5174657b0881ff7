"""What an emulator is: a program that answers as a device does, on a line that any client of the device can open."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Self

from haptics.devices.contracts import Bench
from haptics.devices.virtual.faults import Faults
from tissue_sim.registry import Registry


class Emulator(ABC):
    """Speaks the protocol of a device. Making one opens nothing; `start` does.

    Attributes:
        name: of the protocol, as in ``tissue-sim emulate NAME``.
    """

    name: str

    @property
    @abstractmethod
    def address(self) -> str:
        """What `open_sensor`, `open_stage` or `open_haptic` takes to reach it; known once it is started."""

    @abstractmethod
    def start(self) -> None:
        """Open the line and answer on it, in a thread; nothing where it does already.

        Raises:
            DeviceError: the line cannot be opened.
        """

    @abstractmethod
    def stop(self) -> None:
        """Close the line, and stop what is behind it; nothing where it is stopped."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What it plays, and how much it has answered; units in the keys, types of JSON."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


#: Name -> function of (bench, settings after the colon, faults) that makes the emulator.
EMULATORS: Registry[Any] = Registry("emulator", "tissue_sim.emulators", {
    "rdt": "haptics.emulators.rdt:emulate_rdt",
    "ati-serial": "haptics.emulators.ati_serial:emulate_ati_serial",
    "tic": "haptics.emulators.tic:emulate_tic",
    "grbl": "haptics.emulators.grbl:emulate_grbl",
    "haply": "haptics.emulators.haply:emulate_haply",
})


def open_emulator(name: str, bench: Bench, faults: Faults | None = None) -> Emulator:
    """An emulator by name; it is not started.

    Args:
        name: of the protocol, and where it takes settings, a colon and those: ``rdt:port=49152``.
        bench: whose samples and motion it tells; what it speaks for is started and stopped with it.
        faults: on its line; those of the sensor and the motor belong to the bench.

    Raises:
        InputError: no such emulator (names the nearest), or settings that it refuses.
    """
    protocol, _, settings = name.partition(":")
    return EMULATORS.find(protocol)(bench, settings, faults or Faults())
