"""Workers of a dask cluster that somebody else started: the extra ``cluster``."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from tissue_sim.decode import read_json
from tissue_sim.errors import InputError
from tissue_sim.packing import pack, run_packed

#: s that a scheduler has to answer.
ANSWER_WITHIN = 10.0


class DaskCluster:
    """As `ProcessPool`, on a cluster whose scheduler and workers have this package installed; one thread per worker is
    best, because the finite elements of one process run one after the other.

    Args:
        address: such as ``tcp://127.0.0.1:8786``, or the scheduler file.

    Raises:
        InputError: the package distributed is missing, or no scheduler answers.
    """

    capacity = math.inf
    # The scheduler itself has tried several workers by then (its setting `allowed-failures`).
    most_deaths = 1

    def __init__(self, address: str):
        try:
            from distributed import Client, KilledWorker
            from distributed.comm import get_address_host
        except ImportError as error:
            raise InputError(f"a cluster needs the package distributed ({error}); install it with "
                             'pip install "tissue-sim[cluster]"', field="dask") from None
        self.death = KilledWorker
        if Path(address).is_file():
            address = _address_in(Path(address))
        try:
            # First the form: a client that fails at it cannot be closed.
            get_address_host(address)
            self._client = Client(address, timeout=ANSWER_WITHIN, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"no dask scheduler answers at {address!r} within {ANSWER_WITHIN:g} s ({error}); start "
                             "one with \"dask scheduler\" and give the address that it prints, such as "
                             "tcp://127.0.0.1:8786, or its scheduler file", field="dask") from error
        # No retries: dask counts them for tasks that raise, which would raise again; a death it retries by itself.
        self._executor = self._client.get_executor(pure=False)

    def submit(self, function: Callable[..., Any], arguments: tuple) -> Future:
        """Start a task."""
        # In one piece: dask looks into arguments that it is given, for tasks and futures of its own.
        return self._executor.submit(run_packed, pack(function, arguments))

    def stop(self) -> None:
        """Drop the tasks; what a worker is computing it finishes for nobody."""
        self._executor.shutdown(wait=False)
        self._executor = self._client.get_executor(pure=False)

    def close(self) -> None:
        """Leave the cluster."""
        self._client.close()


def _address_in(file: Path) -> str:
    try:
        return str(read_json(file, "a scheduler file")["address"])
    except (ValueError, LookupError, TypeError):
        raise InputError("is not a scheduler file, which is JSON with an address; let the scheduler write it with "
                         "\"dask scheduler --scheduler-file FILE\"", file=file, field="dask") from None
