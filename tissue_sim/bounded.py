"""Where files of strangers are understood: in a process of its own, whose time and memory are bounded.

Readers call libraries in C and Rust, and may come from anybody's package; a file that is damaged, or made to do harm,
may let any of them compute for ever, ask for all memory, or end the process. Here that is one sentence.
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
from pathlib import Path
from typing import Any

from tissue_sim.errors import InputError
from tissue_sim.files import require_small_archive
from tissue_sim.packing import pack, run_packed

try:
    import resource
except ImportError:  # Windows: only the time is bounded, by the wall clock
    resource = None  # type: ignore[assignment]

#: CPU time, s, and memory, bytes, for a small file; and more of both for each byte of a large one.
SECONDS, SECONDS_PER_BYTE = 2.0, 2e-6
MEMORY, MEMORY_PER_BYTE = 250_000_000, 40
#: The wall clock may show so much more, s: the computer has other work.
_WALL, _WALL_PER_SECOND = 60.0, 10.0
#: A process that holds so much more than at first is replaced, bytes: numpy, scipy and the readers take up to 150 MB.
_GROWN = 300_000_000
_CODE = "from tissue_sim.bounded import serve; serve()"
_LENGTH = struct.Struct("<Q")
#: Whether this is such a process.
_inside = False


def bounded(function: Callable[..., Any], *arguments: Any, file: str | Path, size: int | None = None) -> Any:
    """What `function` makes of a file, computed in the process for it.

    It gets 2 s of CPU time and 250 MB, and 2 s and 40 MB more for each megabyte; by the wall clock a generous multiple.

    Args:
        function: with all its arguments, and what it returns, of things that can be pickled.
        file: what is read, for messages.
        size: of the input, bytes; None: that of the file, which must not be an archive that unpacks to far more.

    Raises:
        InputError: of the function; any other exception, too much time or memory, or a crash, in a sentence.
    """
    if _inside:
        return function(*arguments)
    try:
        task = pack(_run, (function, arguments, str(Path.cwd()), str(file), size))
    except Exception as error:
        raise InputError(f"the reader cannot be handed to the process in which files are read ({error}); define it in "
                         "a module, and give it plain options", file=file) from error
    seconds = SECONDS + SECONDS_PER_BYTE * (size if size is not None else _size(file))
    return _PROCESS.answer(task, _WALL + _WALL_PER_SECOND * seconds, file)


def _size(file: str | Path) -> int:
    try:
        return Path(file).stat().st_size
    except (OSError, ValueError):
        return 0


@contextlib.contextmanager
def uncounted() -> Iterator[None]:
    """What happens inside does not count as CPU time of a reader: the import of a large library."""
    left = signal.setitimer(signal.ITIMER_PROF, 0.0)[0] if _inside and resource is not None else 0.0
    try:
        yield
    finally:
        if left:
            signal.setitimer(signal.ITIMER_PROF, left)


class _Process:
    """The process, which starts with the first task, and anew after one that ended it."""

    def __init__(self) -> None:
        self._lock, self._owner = threading.Lock(), 0
        self._child: subprocess.Popen[bytes] | None = None

    def answer(self, task: bytes, seconds: float, file: str | Path) -> Any:
        with self._lock:
            if self._child is None or self._owner != os.getpid():
                self._child, self._owner = self._start(), os.getpid()
            child = self._child
            late = threading.Timer(seconds, child.kill)
            late.daemon = True
            late.start()
            try:
                answer = self._talk(child, task)
            except BaseException:
                self.close(kill=True)
                raise
            finally:
                late.cancel()
            if answer is None:
                code = child.wait()
                self.close()
                raise InputError(_why(code), file=file)
            done, value, grown = pickle.loads(answer)
            if grown:
                self.close()
        if done:
            return value
        raise value

    @staticmethod
    def _talk(child: subprocess.Popen[bytes], task: bytes) -> bytes | None:
        """The answer; None: the process has ended."""
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
    def _start() -> subprocess.Popen[bytes]:
        # What this process finds is found there; the folder of work is on no path: a stranger's xlrd.py may lie in it.
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                       "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        # Ctrl-C is its parent's.
        apart: dict[str, Any] = {"start_new_session": True}
        if sys.platform == "win32":
            apart = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        return subprocess.Popen([sys.executable, "-P", "-c", _CODE], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                stderr=subprocess.DEVNULL, env=environment, **apart)

    def close(self, kill: bool = False) -> None:
        """End the process; it also ends with this one."""
        child, self._child = self._child, None
        if child is None or self._owner != os.getpid():
            return
        if kill:
            child.kill()
        for stream in (child.stdin, child.stdout):
            with contextlib.suppress(OSError):
                stream.close()  # type: ignore[union-attr]
        child.wait()


_PROCESS = _Process()
atexit.register(_PROCESS.close)


def _why(code: int) -> str:
    if resource is not None and code == -signal.SIGPROF:
        return ("takes more computing than a file of its size may (2 s, and 2 s for each megabyte); it is damaged, or "
                "made to do harm")
    return "ends the process that reads it, or keeps it waiting; it is damaged, or made to do harm"


def serve() -> None:
    """What the process does: tasks in, answers out, until nobody asks."""
    global _inside
    _inside = True
    tasks, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    # What a library prints goes nowhere.
    os.dup2(2, 1)
    sys.stdin = io.StringIO()
    first = _memory()
    while len(head := tasks.read(_LENGTH.size)) == _LENGTH.size:
        answer = _carry_out(tasks.read(*_LENGTH.unpack(head)), first)
        answers.write(_LENGTH.pack(len(answer)) + answer)
        answers.flush()


def _carry_out(task: bytes, first: int) -> bytes:
    value: Any
    try:
        done, value = True, run_packed(task)
    except InputError as error:
        done, value = False, error
    except Exception as error:
        done, value = False, InputError(f"the reader cannot be used in the process in which files are read ({error})")
    return pickle.dumps((done, value, _memory() > first + _GROWN))


def _run(function: Callable[..., Any], arguments: tuple, folder: str, file: str, size: int | None) -> Any:
    """`function` within its bounds."""
    os.chdir(folder)
    try:
        with _bounds(_size(file) if size is None else size):
            if size is None:
                require_small_archive(file)
            return function(*arguments)
    except InputError as error:
        raise error.located(file=file) from None
    except MemoryError:
        raise InputError("asks for more memory than a file of its size may (250 MB, and 40 MB for each megabyte); it "
                         "is damaged, or made to do harm", file=file) from None
    except RecursionError:
        raise InputError("is nested too deep; it is damaged, or made to do harm", file=file) from None
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # some libraries derive theirs from it
        reason = str(error) or "no reason is given"
        raise InputError(f"cannot be read ({type(error).__name__}: {reason}); it is damaged, or its reader has a "
                         "fault", file=file) from error


@contextlib.contextmanager
def _bounds(size: int) -> Iterator[None]:
    if resource is None:
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if used := _memory():
        resource.setrlimit(resource.RLIMIT_DATA, (used + MEMORY + MEMORY_PER_BYTE * size, hard))
    # The kernel ends the process, whatever it is in.
    signal.setitimer(signal.ITIMER_PROF, SECONDS + SECONDS_PER_BYTE * size)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _memory() -> int:
    """Bytes of data of this process, as Linux bounds them; 0: not known."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmData:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return 0
