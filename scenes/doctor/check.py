"""The answer to one question about this computer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

Status = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Check:
    """One line of the doctor.

    Attributes:
        name: what was looked at.
        status: ``ok``; ``warn``, where something works less well or is missing that not everybody needs; ``fail``.
        finding: what was found, with numbers.
        remedy: what to do; empty when ok.
        values: the numbers of the finding, for programs: JSON's types.
    """

    name: str
    status: Status
    finding: str
    remedy: str = ""
    values: Mapping[str, object] | None = None

    def as_json(self) -> dict:
        return asdict(self)


def folder_size(folder: Path) -> int:
    """Bytes of all files below a folder; 0 where there is none."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else 0


def readable_size(size: int) -> str:
    """``1.5 MB`` and the like, powers of 1000."""
    value = float(size)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"
