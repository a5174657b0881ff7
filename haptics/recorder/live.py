"""What a run shows of itself to other programs, in a file beside its recordings."""

from __future__ import annotations

import contextlib
import json
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from haptics.recorder.recorder import Moment
from tissue_sim.atomic_write import write_text
from tissue_sim.errors import InputError

LIVE_FILE = "live.json"
#: s between two writings.
_EVERY = 0.2


class LiveFile:
    """Keeps ``live.json`` at the newest moment of a run. A thread writes: who moves a motor must not wait for a disk.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path):
        self._path, self._moment = folder / LIVE_FILE, None
        self._ending = threading.Event()

    _moment: Moment | None

    def show(self, moment: Moment) -> None:
        """Take the newest moment; returns at once."""
        self._moment = moment

    @contextmanager
    def shown(self) -> Iterator[None]:
        """While the run goes; afterwards the file is gone."""
        thread = threading.Thread(target=self._write, name="live file", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._ending.set()
            thread.join()
            self._path.unlink(missing_ok=True)

    def _write(self) -> None:
        written = None
        while not self._ending.wait(_EVERY):
            moment = self._moment
            if moment is not None and moment is not written:
                with contextlib.suppress(InputError):  # who watches is less than what is recorded
                    write_text(self._path, json.dumps(as_json(moment)))
                written = moment


def as_json(moment: Moment) -> dict[str, Any]:
    """Units in the keys; what is not known is left out."""
    numbers = {"position_mm": 1e3 * moment.position, "depth_mm": 1e3 * moment.depth, "force_N": moment.force,
               "share": moment.share}
    return {"test": moment.test, "phase": moment.phase, "replicate": moment.replicate,
            **{key: value for key, value in numbers.items() if math.isfinite(value)}}
