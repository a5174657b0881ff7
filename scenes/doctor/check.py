"""Result of one check of the computer, and formatting of its numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

Status = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class CheckResult:
    """Result of one check of the computer.

    Attributes:
        name: name of the checked requirement.
        status: ``ok``; ``warn``: an optional part is missing or slow; ``fail``: a requirement is not met.
        finding: result in words, with numbers.
        remedy: instruction for the user; empty if the status is ``ok``.
        values: numbers of the finding for other programs, of JSON types; None: no numbers.
    """

    name: str
    status: Status
    finding: str
    remedy: str = ""
    values: Mapping[str, object] | None = None

    def make_json_object(self) -> dict:
        """Return the fields as a JSON object."""
        return asdict(self)


def compute_folder_size(folder: Path) -> int:
    """Return the size of all files below a folder, bytes; 0 if the folder does not exist."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else 0


def format_size(size: int) -> str:
    """Return a size in bytes as a text with a decimal unit, such as ``1.5 MB``."""
    value = float(size)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"
