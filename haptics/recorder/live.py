"""Publish the progress of a run in ``live.json``, so that other programs can show it."""

from __future__ import annotations

import contextlib
import json
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from haptics.recorder.recorder import RunProgress
from tissue_sim.errors import InputError
from tissue_sim.files import write_text

#: Name of the file in the folder of the run.
LIVE_FILE = "live.json"
#: Time between two writes of the file, and between two updates of a page that shows the run, s.
UPDATE_INTERVAL = 0.2


class LiveProgressFile:
    """Write the newest progress of a run to ``live.json``, and delete the file at the end.

    A separate thread writes the file: the thread that controls the motor must not wait for a disk.

    Args:
        folder: folder of the run.
    """

    def __init__(self, folder: Path):
        self._path, self._progress = folder / LIVE_FILE, None
        self._ending = threading.Event()

    _progress: RunProgress | None

    def set_progress(self, progress: RunProgress) -> None:
        """Store the progress that the thread writes next, and return without waiting for the disk."""
        self._progress = progress

    @contextmanager
    def run_writing_thread(self) -> Iterator[None]:
        """Run the writing thread inside a ``with`` block; delete the file at the end of the block."""
        thread = threading.Thread(target=self._write_progress_until_end, name="live file", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._ending.set()
            thread.join()
            self._path.unlink(missing_ok=True)

    def _write_progress_until_end(self) -> None:
        """Write changed progress every `UPDATE_INTERVAL` s until the end of the block; the body of the thread."""
        written = None
        while not self._ending.wait(UPDATE_INTERVAL):
            progress = self._progress
            if progress is not None and progress is not written:
                # A failed display must not end a recording.
                with contextlib.suppress(InputError):
                    write_text(self._path, json.dumps(convert_progress_to_dict(progress)))
                written = progress


def convert_progress_to_dict(progress: RunProgress) -> dict[str, Any]:
    """Return a progress as a JSON object (dict): keys carry units, and unknown (NaN) numbers are omitted."""
    numbers = {"position_mm": 1e3 * progress.position, "depth_mm": 1e3 * progress.depth, "force_N": progress.force,
               "share": progress.fraction}
    return {"test": progress.test, "phase": progress.phase, "replicate": progress.replicate,
            **{key: value for key, value in numbers.items() if math.isfinite(value)}}
