"""The content of an input file, or one sentence that says why there is none."""

from __future__ import annotations

from pathlib import Path

from tissue_sim.errors import InputError

#: Spreadsheets and many AFM files are zip archives.
ZIP_MAGIC = b"PK\x03\x04"


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
