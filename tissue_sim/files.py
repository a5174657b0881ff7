"""Reading of input files with limits and plain errors, atomic writing, and the folder of cached files."""

from __future__ import annotations

import codecs
import contextlib
import io
import itertools
import os
import secrets
import stat
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from tissue_sim.errors import InputError


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file atomically: a reader sees the old content or the new one, never a part.

    The parent folder is created if it is missing.

    Raises:
        InputError: the file cannot be written (a folder has the name, no permission, disk full); the old file stays.
    """
    path = Path(path)
    # The temporary file is in the same folder, because a rename is atomic only within one file system.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("xb") as stream:
                stream.write(data)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot be written ({reason}); choose another path or free this one", file=path) from error


def write_text(path: str | Path, text: str) -> None:
    """Write a text as UTF-8, with its line ends, atomically; errors as in `write_bytes`."""
    try:
        data = text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(f"must consist of whole characters; got half of a surrogate pair ({text[error.start]!r}). "
                         "Check the names of files", file=path) from None
    write_bytes(path, data)


#: First bytes of a zip archive; spreadsheets and many AFM files are archives.
ZIP_MAGIC = b"PK\x03\x04"
#: Byte order marks, the longer first.
_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"),
          (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
#: Control characters that no text contains; tab, line ends, form feed and the end-of-file sign of DOS are allowed.
_CONTROL = [chr(code) for code in range(32) if code not in (9, 10, 11, 12, 13, 26)]


@dataclass(frozen=True)
class FileLimits:
    """Largest sizes of input files, which bound memory and time of their readers.

    Attributes:
        recording: largest file of a recording, bytes.
        json: largest JSON file, bytes.
        toml: largest TOML file, bytes.
        matches: largest number of files that a pattern may match.
        unpacked: largest unpacked size of an archive, bytes.
    """

    recording: int = 300_000_000
    json: int = 8_000_000
    toml: int = 1_000_000
    matches: int = 10_000
    unpacked: int = 200_000_000


#: Limits of every reader.
LIMITS = FileLimits()


def open_input_file(path: str | Path, expected: str, largest: int = LIMITS.recording) -> io.BufferedReader:
    """Open an input file for reading bytes. All input files are opened here; the caller closes the file.

    Args:
        path: the file.
        expected: description of the expected file, for the message: ``"a recording (CSV)"``.
        largest: largest size, bytes.

    Raises:
        InputError: no such file, a folder, pipe or device, not readable, or too large.
    """
    path = Path(path)
    try:
        # O_NONBLOCK: open() must not wait for the writer of a pipe.
        file = os.fdopen(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)), "rb")
    except FileNotFoundError:
        raise InputError(f"no such file, expected {expected}; check the name and the folder", file=path) from None
    except (OSError, ValueError) as error:
        if isinstance(error, IsADirectoryError) or _is_existing_folder(path):
            raise _make_is_a_folder_error(path, expected) from None
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot be read ({reason}), expected {expected}; check the name and the permissions",
                         file=path) from error
    found = os.fstat(file.fileno())
    if stat.S_ISREG(found.st_mode) and found.st_size <= largest:
        return file
    file.close()
    if stat.S_ISDIR(found.st_mode):
        raise _make_is_a_folder_error(path, expected)
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"is a pipe, socket or device, expected {expected} in a file; save it as one", file=path)
    raise InputError(f"has {found.st_size / 1e6:.3g} MB, expected {expected} of at most {largest / 1e6:g} MB; use a "
                     "part of it", file=path)


def _is_existing_folder(path: Path) -> bool:
    """Return whether a path is a folder; False if this cannot be determined."""
    try:
        return path.is_dir()
    except OSError:
        return False


def _make_is_a_folder_error(path: Path, expected: str) -> InputError:
    """Make the error that a path is a folder where a file is expected."""
    return InputError(f"is a folder, expected {expected}; name a file in it", file=path)


def read_bytes(path: str | Path, expected: str, largest: int = LIMITS.recording, is_growing: bool = False) -> bytes:
    """Read the bytes of a file; `is_growing`: the bytes that it has now, because a program is writing it.

    The other arguments and the errors are those of `open_input_file`; also an `InputError` if the file grows and
    `is_growing` is False.
    """
    with open_input_file(path, expected, largest) as file:
        try:
            size = os.fstat(file.fileno()).st_size
            # At most one byte more than the stated size, because memory is reserved for the requested number.
            data = file.read(size if is_growing else size + 1)
            # Files of the operating system may state a size of 0.
            if not is_growing and (len(data) > largest or file.read(1)):
                raise InputError(f"grows while it is read, expected {expected}", file=path)
        except OSError as error:  # some files of the operating system, or a disk failure
            raise InputError(f"cannot be read ({error.strerror or error}), expected {expected}", file=path) from error
    return data or b""


def read_first_bytes_or_empty(path: str | Path, count: int) -> bytes:
    """Return at most `count` first bytes of a file; empty if the file cannot be read."""
    try:
        with open_input_file(path, "") as file:
            return file.read(count)
    except (InputError, OSError):
        return b""


def is_valid_and_existing_path(path: Path) -> bool:
    """Return whether a file or folder exists; False for a name that the operating system refuses."""
    try:
        return path.exists()
    except OSError:
        return False


def find_files(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a folder that match a pattern such as ``run_*.csv``, sorted.

    Raises:
        InputError: an invalid pattern, or one that matches more than `FileLimits.matches`.
    """
    try:
        found = list(itertools.islice((each for each in folder.glob(pattern) if not each.is_dir()), LIMITS.matches + 1))
    except (OSError, ValueError, NotImplementedError, IndexError) as error:
        raise InputError(f"{pattern!r} is not a valid pattern ({error}); use one such as 'run_*.csv'") from None
    if len(found) > LIMITS.matches:
        raise InputError(f"{pattern!r} matches more than {LIMITS.matches} files; use a narrower pattern")
    return sorted(found)


def require_small_archive(path: str | Path) -> None:
    """Require that a zip archive unpacks to at most `FileLimits.unpacked` bytes; other files are not checked.

    The archive is unpacked to count its bytes, because the sizes that it states may be wrong.

    Raises:
        InputError: the archive is too large; or see `open_input_file`.
    """
    size = 0
    with open_input_file(path, "a file") as file:
        if not zipfile.is_zipfile(file):
            return
        try:
            with zipfile.ZipFile(file) as archive:
                for member in archive.infolist():
                    # Some readers read no more than the stated size; the true size may be larger.
                    member.file_size = 2**62
                    with contextlib.suppress(zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError,
                                             RuntimeError), archive.open(member) as content:
                        while piece := content.read(1 << 20):
                            size += len(piece)
                            if size > LIMITS.unpacked:
                                raise InputError(f"unpacks to more than {LIMITS.unpacked / 1e6:g} MB, expected "
                                                 "recordings; use a part of it", file=path)
        except (zipfile.BadZipFile, OSError, NotImplementedError, ValueError) as error:
            if isinstance(error, InputError):
                raise


def read_text(path: str | Path, expected: str, largest: int = LIMITS.recording, is_growing: bool = False) -> str:
    """Read the UTF-8 text of a file, without its byte order mark; arguments as in `read_bytes`.

    Raises:
        InputError: see `open_input_file`; or the file is empty, binary, or not UTF-8.
    """
    path, data = Path(path), read_bytes(path, expected, largest, is_growing)
    if data.startswith(ZIP_MAGIC):
        raise InputError(f"is a binary file (a zip archive, as spreadsheets are), expected {expected}; recordings in "
                         "such files are read with format = 'xlsx' or 'afm'", file=path)
    if b"\0" in data:
        raise InputError(f"is a binary or UTF-16 file (NUL at byte {data.index(0)}), expected {expected}; "
                         "save it as UTF-8 text", file=path)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"byte 0x{data[error.start]:02x} is not UTF-8, expected {expected}; save it as UTF-8 text",
                         file=path, line=data[:error.start].count(b"\n") + 1) from None
    if not text.strip():
        raise InputError(f"is empty, expected {expected}", file=path)
    return text


def decode_text_and_find_encoding(data: bytes, path: str | Path, expected: str) -> tuple[str, str]:
    """Decode the text of a file in one of the encodings that laboratory programs use.

    The encoding is that of the byte order mark; else UTF-16 if every other byte is NUL; else UTF-8; else cp1252
    (Windows western), and latin-1 if the file has bytes that cp1252 lacks.

    Returns:
        The text, and Python's name of its encoding.

    Raises:
        InputError: an empty or binary file.
    """
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), None)
    if encoding is None and b"\0" in data[:4096]:
        head = data[:4096]
        odd, even = head[1::2].count(0) / (len(head) // 2 or 1), head[::2].count(0) / (len(head) // 2 or 1)
        encoding = "utf-16-le" if odd > 0.5 > even else "utf-16-be" if even > 0.5 > odd else None
        if encoding is None:
            raise InputError(f"is a binary file (NUL at byte {data.index(0)}), expected {expected}", file=path)
    for name in ([encoding] if encoding else ["utf-8", "cp1252", "latin-1"]):
        try:
            text = data.decode(name)
            break
        except UnicodeDecodeError:
            continue
    else:
        raise InputError(f"has the byte order mark of {encoding} but another encoding, expected {expected}; save it as "
                         "UTF-8 text", file=path)
    if any(character in text for character in _CONTROL):
        raise InputError(f"is a binary file (it has control characters), expected {expected}", file=path)
    if not text.strip():
        raise InputError(f"is empty, expected {expected}", file=path)
    return text, {"utf-8-sig": "utf-8"}.get(name, name)


def get_cache_folder() -> Path:
    """Return the folder of compiled kernels and derived formulas; this function does not create the folder.

    It is the environment variable `TISSUE_SIM_CACHE`, or ``tissue_sim/kernels`` in the cache folder of the user.
    """
    if "TISSUE_SIM_CACHE" in os.environ:
        return Path(os.environ["TISSUE_SIM_CACHE"])
    if os.name == "nt":
        base = os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")
    else:
        base = os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")
    return Path(base) / "tissue_sim" / "kernels"
