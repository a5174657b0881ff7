"""A haptic device: a handle that a hand pushes with a constant force, on a spring; it goes where the forces balance."""

from pathlib import Path

from haptics.devices.contracts import DeviceError, HapticDevice
from tissue_sim.pose import Pose

#: N/m of the spring, and N of the hand.
SPRING = 500.0
PUSH = 2.0


class StiffHandle(HapticDevice):
    """Writes in a file what happens to it.

    Args:
        diary: the file.
    """

    def __init__(self, diary: Path):
        self._diary, self._force, self._on = diary, 0.0, False

    def start(self):
        if self._diary.is_dir():
            raise DeviceError(f"{self._diary}: no handle is there; plug one in")
        self._on = True
        self._note("start")

    def pose(self, time):
        # Comes to its place slowly: a handle has mass.
        return Pose.at_depth(min(time / 0.1, 1.0) * (PUSH - self._force) / SPRING)

    def render(self, wrench):
        self._force = wrench[2]

    def stop(self):
        if self._on:
            self._on = False
            self._note("stop")

    def _note(self, word):
        with self._diary.open("a", encoding="utf-8") as stream:
            stream.write(f"{word}\n")


def open_handle(text):
    """``handle:FILE``."""
    return StiffHandle(Path(text))
