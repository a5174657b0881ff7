"""Sandboxed parsing of untrusted files: in a separate process with limits of time and memory.

Readers use libraries in C and Rust and may come from other packages. A damaged or malicious file may make them run
without end, allocate all memory, or crash the process. Here the result is an `InputError`.

A task is packed together with all additions to registries: a worker needs the laws, tools or kinds of test that
plug-ins have registered. Classes of installed packages are sent by name. Classes of other modules (a script or a
plug-in file) are sent by value, because a worker on another machine cannot import them.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import os
import pickle
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import cloudpickle

from tissue_sim.errors import InputError, format_foreign_exception_message
from tissue_sim.files import require_small_archive
from tissue_sim.registry import (
    get_modules_of_additions_by_name,
    list_registered_groups_names_objects,
    register_objects_of_other_process,
)


def pack_task(function: Callable[..., Any], arguments: tuple) -> bytes:
    """Pickle a function call, with all objects added to registries, for `run_packed_task` in another process."""
    things = list_registered_groups_names_objects()
    by_value = [module for name, module in get_modules_of_additions_by_name().items()
                if not _is_importable_by_workers(name)]
    for module in by_value:
        cloudpickle.register_pickle_by_value(module)
    try:
        # In two parts: the worker registers the additions before it unpickles the arguments, which may need them.
        return cloudpickle.dumps((cloudpickle.dumps(things) if things else b"", cloudpickle.dumps((function,
                                                                                                   arguments))))
    finally:
        for module in by_value:
            cloudpickle.unregister_pickle_by_value(module)


def run_packed_task(task: bytes) -> Any:
    """Execute a task of `pack_task` in this worker process, and return the result of the function."""
    things, call = cloudpickle.loads(task)
    if things:
        register_objects_of_other_process(cloudpickle.loads(things))
    function, arguments = cloudpickle.loads(call)
    return function(*arguments)


def _is_importable_by_workers(module: str) -> bool:
    """Return whether every worker can import the module with this name: standard library or installed package."""
    package = module.partition(".")[0]
    return package in sys.stdlib_module_names or package in _list_importable_packages()


@cache
def _list_importable_packages() -> frozenset[str]:
    """Return the names of the top-level packages of installed distributions and of this program."""
    # The packages of this program are importable also if they run from their sources.
    return frozenset(packages_distributions()) | {"tissue_sim", "calibration", "haptics", "scenes"}


try:
    import resource
except ImportError:  # Windows: only the wall time is limited
    resource = None  # type: ignore[assignment]


@dataclass(frozen=True)
class SandboxLimits:
    """Limits of the sandbox; larger values admit larger files and let a harmful file occupy the computer for longer.

    Attributes:
        seconds: CPU time for a small file, s.
        seconds_per_byte: additional CPU time for each byte of a file, s.
        memory: memory for a small file, bytes.
        memory_per_byte: additional memory for each byte of a file, bytes.
        wall_time: constant part of the limit of wall time, s; other programs may use the processor.
        wall_time_per_second: additional wall time for each second of CPU time, s/s.
        memory_growth: growth of its memory after which the process is replaced, bytes; numpy, scipy and the readers
            take up to 150 MB.
    """

    seconds: float = 2.0
    seconds_per_byte: float = 2e-6
    memory: int = 250_000_000
    memory_per_byte: int = 40
    wall_time: float = 60.0
    wall_time_per_second: float = 10.0
    memory_growth: int = 300_000_000


#: Limits of every sandbox.
LIMITS = SandboxLimits()
_CODE = "from tissue_sim.bounded import run_sandbox_loop; run_sandbox_loop()"
#: Length prefix of a message.
_LENGTH = struct.Struct("<Q")
#: Whether this process is the sandbox.
_inside = False


def run_in_sandbox(function: Callable[..., Any], *arguments: Any, file: str | Path, size: int | None = None) -> Any:
    """Call a function that reads a file in the sandbox process, and return its result.

    Within the sandbox process the function is called directly.

    The limits are 2 s of CPU time and 250 MB of memory, and 2 s and 40 MB more for each megabyte of input; the limit of
    wall time is a multiple of the CPU time.

    Args:
        function: reader; its arguments and its result must be picklable.
        arguments: arguments of the reader.
        file: file that is read, for messages.
        size: size of the input, bytes; None: that of the file, whose unpacked size is checked if it is an archive.

    Raises:
        InputError: an error of the reader, any other exception, a limit that is exceeded, or a crash.
    """
    if _inside:
        return function(*arguments)
    try:
        task = pack_task(_call_reader_within_limits, (function, arguments, str(Path.cwd()), str(file), size))
    except Exception as error:
            raise InputError(f"the reader cannot be sent to the process in which files are read ({error}); define it "
                             "in a module, and pass plain options", file=file) from error
    seconds = LIMITS.seconds + LIMITS.seconds_per_byte * (size if size is not None else _file_size_or_zero(file))
    return _PROCESS.execute_task(task, LIMITS.wall_time + LIMITS.wall_time_per_second * seconds, file)


def _file_size_or_zero(file: str | Path) -> int:
    """Return the size of a file, bytes; 0 for a file that cannot be examined."""
    try:
        return Path(file).stat().st_size
    except (OSError, ValueError):
        return 0


@contextlib.contextmanager
def exclude_cpu_time_from_limit() -> Iterator[None]:
    """Context manager: CPU time spent inside does not count for the limit of a reader, as for importing a library."""
    left = signal.setitimer(signal.ITIMER_PROF, 0.0)[0] if _inside and resource is not None else 0.0
    try:
        yield
    finally:
        if left:
            signal.setitimer(signal.ITIMER_PROF, left)


class _SandboxProcess:
    """Child process that executes tasks; it is started by the first task, and again after a task that ended it."""

    def __init__(self) -> None:
        self._lock, self._owner = threading.Lock(), 0
        self._child: subprocess.Popen[bytes] | None = None

    def execute_task(self, task: bytes, seconds: float, file: str | Path) -> Any:
        """Execute a pickled task in the child process within a limit of wall time, s, and return its result.

        Raises:
            InputError: an error of the reader, or the end of the process.
        """
        with self._lock:
            if self._child is None or self._owner != os.getpid():
                self._child, self._owner = self._start_and_return_process(), os.getpid()
            child = self._child
            late = threading.Timer(seconds, child.kill)
            late.daemon = True
            late.start()
            try:
                answer = self._exchange_message_or_none(child, task)
            except BaseException:
                self.close(kill=True)
                raise
            finally:
                late.cancel()
            if answer is None:
                code = child.wait()
                self.close()
                raise InputError(_explain_exit_code(code), file=file)
            done, value, grown = pickle.loads(answer)
            if grown:
                self.close()
        if done:
            return value
        raise value

    @staticmethod
    def _exchange_message_or_none(child: subprocess.Popen[bytes], task: bytes) -> bytes | None:
        """Send a pickled task to the child process and return its pickled result; None if the process has ended."""
        assert child.stdin is not None and child.stdout is not None
        try:
            child.stdin.write(_LENGTH.pack(len(task)) + task)
            child.stdin.flush()
            head = child.stdout.read(_LENGTH.size)
            answer = child.stdout.read(*_LENGTH.unpack(head)) if len(head) == _LENGTH.size else b""
        except BrokenPipeError:
            return None
        return answer or None

    @staticmethod
    def _start_and_return_process() -> subprocess.Popen[bytes]:
        """Start the child process; its messages are written to stdin and read from stdout."""
        # The same import path, without the working folder, in which an untrusted file may be named like a module.
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                       "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        # Ctrl-C is handled by the parent.
        apart: dict[str, Any] = {"start_new_session": True}
        if sys.platform == "win32":
            apart = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        return subprocess.Popen([sys.executable, "-P", "-c", _CODE], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                stderr=subprocess.DEVNULL, env=environment, **apart)

    def close(self, kill: bool = False) -> None:
        """End the child process, if this process started one; `kill` ends it at once."""
        child, self._child = self._child, None
        if child is None or self._owner != os.getpid():
            return
        if kill:
            child.kill()
        for stream in (child.stdin, child.stdout):
            with contextlib.suppress(OSError):
                stream.close()  # type: ignore[union-attr]
        child.wait()


_PROCESS = _SandboxProcess()
atexit.register(_PROCESS.close)


def _explain_exit_code(code: int) -> str:
    """Return the problem, for an `InputError`, of a file whose reader ended the process with an exit code."""
    if resource is not None and code == -signal.SIGPROF:
        return ("exceeds the CPU time for a file of its size (2 s, and 2 s for each megabyte); it is damaged or "
                "malicious")
    return "ends the process that reads it, or exceeds the time limit; it is damaged or malicious"


def run_sandbox_loop() -> None:
    """Run the main loop of the sandbox process: read tasks from stdin and write results to stdout until stdin ends."""
    global _inside
    _inside = True
    tasks, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    # Output of libraries to stdout is discarded, because stdout carries the answers.
    os.dup2(2, 1)
    sys.stdin = io.StringIO()
    first = _data_memory_or_zero()
    while len(head := tasks.read(_LENGTH.size)) == _LENGTH.size:
        answer = _execute_packed_task(tasks.read(*_LENGTH.unpack(head)), first)
        answers.write(_LENGTH.pack(len(answer)) + answer)
        answers.flush()


def _execute_packed_task(task: bytes, first: int) -> bytes:
    """Execute a pickled task in the sandbox process.

    Args:
        task: result of `tissue_sim.bounded.pack_task`.
        first: data memory of the process before its first task, bytes.

    Returns:
        Pickled tuple: success, result or error, and whether the memory has grown beyond `SandboxLimits.memory_growth`.
    """
    value: Any
    try:
        done, value = True, run_packed_task(task)
    except InputError as error:
        done, value = False, error
    except Exception as error:
        done, value = False, InputError(f"the reader cannot be used in the process in which files are read ({error})")
    return pickle.dumps((done, value, _data_memory_or_zero() > first + LIMITS.memory_growth))


def _call_reader_within_limits(function: Callable[..., Any], arguments: tuple, folder: str, file: str,
                               size: int | None) -> Any:
    """Call a reader in the sandbox process within the limits of CPU time and memory.

    Raises:
        InputError: an error of the reader or an exceeded limit.
    """
    os.chdir(folder)
    try:
        with _limited_cpu_time_and_memory(_file_size_or_zero(file) if size is None else size):
            if size is None:
                require_small_archive(file)
            return function(*arguments)
    except InputError as error:
        raise error.with_location(file=file) from None
    except MemoryError:
        raise InputError("exceeds the memory for a file of its size (250 MB, and 40 MB for each megabyte); it is "
                         "damaged or malicious", file=file) from None
    except RecursionError:
        raise InputError("is nested too deep; it is damaged or malicious", file=file) from None
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # exceptions of some libraries do not derive from Exception
        raise InputError(
            f"cannot be read ({type(error).__name__}: {format_foreign_exception_message(error)}); it is damaged, or "
            "its reader has an error", file=file) from error


@contextlib.contextmanager
def _limited_cpu_time_and_memory(size: int) -> Iterator[None]:
    """Context manager: limits of CPU time and memory of this process for an input of `size` bytes."""
    if resource is None:
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if used := _data_memory_or_zero():
        resource.setrlimit(resource.RLIMIT_DATA, (used + LIMITS.memory + LIMITS.memory_per_byte * size, hard))
    # The timer's signal ends the process also within a library.
    signal.setitimer(signal.ITIMER_PROF, LIMITS.seconds + LIMITS.seconds_per_byte * size)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _data_memory_or_zero() -> int:
    """Return the data memory (``VmData``) of this process, bytes; 0 if unknown."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmData:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return 0
