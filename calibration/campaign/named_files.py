"""Find and rename the files that a campaign names besides its recordings, to copy the campaign to another folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tissue_sim.experiment.tools.tool import interpret_shape_or_profile_path
from tissue_sim.specimen import SPECIMENS


def resolve_path_to_text(path: Path) -> str:
    """Return the absolute path of a file as text, with symbolic links resolved."""
    return str(path.resolve())


def replace_mesh_profile_and_rig_paths(content: Mapping[str, Any], folder: Path,
                                       name: Callable[[Path], str]) -> dict[str, Any]:
    """Return the content of a campaign with other paths of its specimen meshes, tool profiles and rigs.

    Files on disk are not changed.

    Args:
        content: parsed content of the campaign file.
        folder: folder of the campaign file.
        name: returns the new path, as text, of the file with a given path.
    """
    of_specimens = {key for kind in SPECIMENS.values() for key in kind.paths}

    def replace_profile_or_rig_path(key: str, value: Any) -> Any:
        """Return the value of a key of ``[[test]]`` with the new path if the value names a file."""
        path = folder / value if key == "rig" else interpret_shape_or_profile_path(value, folder)[1] if key == "tool" \
            else None
        return value if path is None else name(path)

    renamed = dict(content)
    if "specimen" in content:
        renamed["specimen"] = [{key: name(folder / value) if key in of_specimens else value
                                for key, value in table.items()} for table in content["specimen"]]
    if "defaults" in content:
        renamed["defaults"] = {key: replace_profile_or_rig_path(key, value) for key,
                               value in content["defaults"].items()}
    renamed["test"] = [{key: replace_profile_or_rig_path(key, value) for key, value in table.items()}
                       for table in content["test"]]
    return renamed


def list_mesh_profile_and_rig_paths(content: Mapping[str, Any], folder: Path) -> list[Path]:
    """Return the paths of meshes, tool profiles and rigs that a campaign names.

    See `replace_mesh_profile_and_rig_paths`.
    """
    found: list[Path] = []

    def collect_path(path: Path) -> str:
        """Append a path to `found` and return the path unchanged."""
        found.append(path)
        return str(path)

    replace_mesh_profile_and_rig_paths(content, folder, collect_path)
    return found
