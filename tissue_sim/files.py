"""The content of an input file, or one sentence that says why there is none; and where files are kept."""

from __future__ import annotations

import codecs
import os
from pathlib import Path

from tissue_sim.errors import InputError

#: Spreadsheets and many AFM files are zip archives.
ZIP_MAGIC = b"PK\x03\x04"
#: Byte order marks, the longer first.
_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"),
          (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
#: What no text holds: control characters but for tab, line ends, form feed and the end-of-file sign of DOS.
_CONTROL = [chr(code) for code in range(32) if code not in (9, 10, 11, 12, 13, 26)]


def read_bytes(path: str | Path, expected: str) -> bytes:
    """The bytes of a file.

    Args:
        path: the file.
        expected: what the file should have been, for the message: ``"a recording (CSV)"``.

    Raises:
        InputError: no such file, a folder, not readable.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise InputError(f"is a folder, expected {expected}; name a file in it", file=path)
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"no such file, expected {expected}; check the name and the folder", file=path) from None
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot be read ({reason}), expected {expected}; check the name and the permissions",
                         file=path) from error


def read_text(path: str | Path, expected: str) -> str:
    """The UTF-8 text of a file, without its byte order mark.

    Args:
        path: the file.
        expected: what the file should have been, for the message: ``"a recording (CSV)"``.

    Raises:
        InputError: no such file, a folder, not readable, empty, binary, or not UTF-8.
    """
    path, data = Path(path), read_bytes(path, expected)
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


def decode_text(data: bytes, path: str | Path, expected: str) -> tuple[str, str]:
    """The text in the bytes of a file, as any program of a laboratory may have written it.

    By its byte order mark; else UTF-16 where every other byte is NUL; else UTF-8; else the western code page of
    Windows, cp1252, and latin-1 where it has bytes that cp1252 lacks.

    Returns:
        The text, and the name of its encoding in Python.

    Raises:
        InputError: empty or binary.
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
        raise InputError(f"has the byte order mark of {encoding} and is none, expected {expected}; save it as UTF-8 "
                         "text", file=path)
    if any(character in text for character in _CONTROL):
        raise InputError(f"is a binary file (it has control characters), expected {expected}", file=path)
    if not text.strip():
        raise InputError(f"is empty, expected {expected}", file=path)
    return text, {"utf-8-sig": "utf-8"}.get(name, name)


def cache_folder() -> Path:
    """Where compiled kernels and derived formulas are kept: `TISSUE_SIM_CACHE`, else a folder in the user's cache
    directory."""
    if "TISSUE_SIM_CACHE" in os.environ:
        return Path(os.environ["TISSUE_SIM_CACHE"])
    if os.name == "nt":
        base = os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")
    else:
        base = os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")
    return Path(base) / "tissue_sim" / "kernels"
