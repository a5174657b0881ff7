"""Run tasks on an existing dask cluster; requires the extra ``cluster``."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from calibration.tasks.executors import Workers
from tissue_sim.bounded import pack_task, run_packed_task
from tissue_sim.decode import read_json_value
from tissue_sim.errors import InputError

#: Timeout for the connection to a scheduler, s.
CONNECT_TIMEOUT = 10.0


class DaskExecutor:
    """Executor on a dask cluster with the interface of `ProcessPool`.

    This package must be installed on the scheduler and on all workers. Workers should have one thread each, because the
    finite element solver runs serially within a process.

    Args:
        address: address of the scheduler such as ``tcp://127.0.0.1:8786``, or path of the scheduler file.

    Attributes:
        capacity: number of tasks that the cluster accepts at a time.
        most_deaths: number of worker failures during a task after which the task is given up.

    Raises:
        InputError: the package ``distributed`` is missing, or no scheduler answers.
    """

    capacity = math.inf
    # The scheduler has already tried several workers (its setting `allowed-failures`).
    most_deaths = 1

    def __init__(self, address: str):
        try:
            from distributed import Client, KilledWorker
            from distributed.comm import get_address_host
        except ImportError as error:
            raise InputError(f"dask requires the package distributed ({error}); install it with "
                             'pip install "tissue-sim[cluster]"', field="dask") from None
        self.death = KilledWorker
        if Path(address).is_file():
            address = _read_scheduler_file_address(Path(address))
        try:
            # Check the form of the address first: a client that fails because of it cannot be closed.
            get_address_host(address)
            self._client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"no dask scheduler answers at {address!r} within {CONNECT_TIMEOUT:g} s ({error}); start "
                             "one with \"dask scheduler\" and state the printed address, such as "
                             "tcp://127.0.0.1:8786, or the scheduler file", field="dask") from error
        # No retries: dask would repeat tasks that raise an exception; it restarts tasks of failed workers anyway.
        self._executor = self._client.get_executor(pure=False)

    def submit(self, function: Callable[..., Any], arguments: tuple) -> Future:
        """Send a task to the cluster and return its future."""
        # Packed as bytes: dask searches plain arguments for its tasks and futures.
        return self._executor.submit(run_packed_task, pack_task(function, arguments))

    def abandon_tasks(self) -> None:
        """Cancel all tasks; running tasks finish on their workers, and their results are discarded.

        New tasks can be submitted afterwards.
        """
        self._executor.shutdown(wait=False)
        self._executor = self._client.get_executor(pure=False)

    def close(self) -> None:
        """Close the connection to the cluster; the workers of the cluster keep running."""
        self._client.close()


def connect_to_dask_cluster(workers: Workers) -> DaskExecutor:
    """Return an executor on the cluster with the address ``workers.dask``.

    Raises:
        InputError: there is no address, the package ``distributed`` is missing, or no scheduler answers.
    """
    if workers.dask is None:
        raise InputError("the executor dask needs the address of a scheduler; state it as dask", field="dask")
    return DaskExecutor(workers.dask)


def _read_scheduler_file_address(file: Path) -> str:
    """Return the address of the scheduler that the scheduler file (JSON) contains.

    Raises:
        InputError: the file has no address.
    """
    try:
        return str(read_json_value(file, "a scheduler file")["address"])
    except (ValueError, LookupError, TypeError):
        raise InputError("a scheduler file must be JSON with an address; create one with \"dask scheduler "
                         "--scheduler-file FILE\"", file=file, field="dask") from None
