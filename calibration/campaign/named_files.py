"""The files that a campaign names beside its recordings, for a copy of it in another folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tissue_sim.experiment.tools.tool import read_shape
from tissue_sim.specimen import SPECIMENS


def whole_path(path: Path) -> str:
    """The name of a file that is the same from every folder."""
    return str(path.resolve())


def with_files_named(content: Mapping[str, Any], folder: Path, name: Callable[[Path], str]) -> dict[str, Any]:
    """Content of a campaign with other names for meshes of specimens, profiles of tools and rigs.

    Args:
        content: as it stands in the file. folder: of the file. name: gives a file, by its path, its name in the copy.
    """
    of_specimens = {key for kind in SPECIMENS.values() for key in kind.paths}

    def of_test(key: str, value: Any) -> Any:
        path = folder / value if key == "rig" else read_shape(value, folder)[1] if key == "tool" else None
        return value if path is None else name(path)

    renamed = dict(content)
    if "specimen" in content:
        renamed["specimen"] = [{key: name(folder / value) if key in of_specimens else value
                                for key, value in table.items()} for table in content["specimen"]]
    if "defaults" in content:
        renamed["defaults"] = {key: of_test(key, value) for key, value in content["defaults"].items()}
    renamed["test"] = [{key: of_test(key, value) for key, value in table.items()} for table in content["test"]]
    return renamed


def files_named(content: Mapping[str, Any], folder: Path) -> list[Path]:
    """Meshes, profiles and rigs that a campaign names; arguments as those of `with_files_named`."""
    found: list[Path] = []

    def note(path: Path) -> str:
        found.append(path)
        return str(path)

    with_files_named(content, folder, note)
    return found
