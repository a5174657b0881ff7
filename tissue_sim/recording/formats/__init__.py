"""Formats of recordings by name, one function and one short file each.

A reader takes a path and, by keyword, what only its format needs to know, and returns the recording, or a tuple of
those that the file holds. It stands in `FORMATS`, or a package adds it by an entry point of that group.
"""

from collections.abc import Callable
from typing import Any

from tissue_sim.recording.formats.vocabulary import MACHINES
from tissue_sim.registry import Registry

#: Name -> function (path, **options) -> `Recording`, or a tuple of them.
FORMATS: Registry[Callable[..., Any]] = Registry("format", "tissue_sim.formats", {
    **{name: f"tissue_sim.recording.formats.{name}:read_{name}"
       for name in ("native", "instron", "soft_robotics", "xlsx", "afm")},
    **dict.fromkeys(("jpk", "bruker"), "tissue_sim.recording.formats.afm:read_afm"),
    **{name: f"tissue_sim.recording.formats.machines:read_{name}"
       for name in ("table", *MACHINES)}}, accepts=callable, expected="a function of a path")
