"""Write files atomically: a reader sees the old or the new content, never a part."""

from __future__ import annotations

import secrets
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
