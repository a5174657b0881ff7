"""Find and rename the files that a campaign names besides its recordings, to copy the campaign to another folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tissue_sim.experiment.tools.tool import parse_shape_name
from tissue_sim.specimen import SPECIMENS


def absolute_path(path: Path) -> str:
    """Return the absolute path of a file."""
    return str(path.resolve())


def rename_files(content: Mapping[str, Any], folder: Path, name: Callable[[Path], str]) -> dict[str, Any]:
    """Return the content of a campaign with renamed files of specimen meshes, tool profiles and rigs.

    Args:
        content: parsed content of the campaign file.
        folder: folder of the campaign file.
        name: returns the new name of the file with this path.
    """
    of_specimens = {key for kind in SPECIMENS.values() for key in kind.paths}

    def rename_value(key: str, value: Any) -> Any:
        path = folder / value if key == "rig" else parse_shape_name(value, folder)[1] if key == "tool" else None
        return value if path is None else name(path)

    renamed = dict(content)
    if "specimen" in content:
        renamed["specimen"] = [{key: name(folder / value) if key in of_specimens else value
                                for key, value in table.items()} for table in content["specimen"]]
    if "defaults" in content:
        renamed["defaults"] = {key: rename_value(key, value) for key, value in content["defaults"].items()}
    renamed["test"] = [{key: rename_value(key, value) for key, value in table.items()} for table in content["test"]]
    return renamed


def list_named_files(content: Mapping[str, Any], folder: Path) -> list[Path]:
    """Return the paths of meshes, tool profiles and rigs that a campaign names; see `rename_files`."""
    found: list[Path] = []

    def collect_path(path: Path) -> str:
        found.append(path)
        return str(path)

    rename_files(content, folder, collect_path)
    return found
