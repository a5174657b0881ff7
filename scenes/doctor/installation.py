"""Python, the packages that we need, and where our own four packages come from."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import platform
import sys
from collections.abc import Iterator
from pathlib import Path

from scenes.doctor.check import Check, Status

OURS = ("tissue_sim", "calibration", "haptics", "scenes")
NEEDED = ("taichi", "numpy", "scipy", "sympy", "viser", "msgspec", "rich", "matplotlib")
#: Taichi publishes wheels for these only: (sys.platform, machine in lower case).
TAICHI_PLATFORMS = (("linux", "x86_64"), ("win32", "amd64"), ("darwin", "arm64"))
PYTHON_RANGE = ((3, 11), (3, 13))


def python() -> Check:
    """Version of Python and the platform."""
    version = ".".join(str(part) for part in sys.version_info[:3])
    finding = f"{version} on {platform.platform()}, {platform.machine()}"
    values = {"version": version, "platform": platform.platform(), "machine": platform.machine()}
    low, high = PYTHON_RANGE
    if not low <= sys.version_info[:2] <= high:
        return Check("Python", "fail", finding, "use Python 3.11, 3.12 or 3.13: Taichi has wheels for these", values)
    if not has_taichi_wheel():
        return Check("Python", "warn", finding, "Taichi has no wheel for this platform: the analytical calibration "
                     "works, the finite elements need Linux x86-64, Windows or an Apple-silicon Mac", values)
    return Check("Python", "ok", finding, values=values)


def has_taichi_wheel() -> bool:
    return (sys.platform, platform.machine().lower()) in TAICHI_PLATFORMS


def packages() -> Iterator[Check]:
    """One check for each package that we need."""
    for name in NEEDED:
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            status: Status = "warn" if name == "taichi" and not has_taichi_wheel() else "fail"
            yield Check(name, status, "not installed", f"python -m pip install {name}" if status == "fail" else
                        "the finite elements need a platform that Taichi has a wheel for")
        else:
            yield Check(name, "ok", version, values={"version": version})


def one_place() -> Check:
    """Whether the four packages come from one folder.

    Another distribution with a package called `calibration`, or a user's own `calibration.py` in the current folder,
    would shadow ours without a word.
    """
    places = {name: _folder(name) for name in OURS}
    values = {name: str(folder) if folder else None for name, folder in places.items()}
    ours = places["scenes"]
    strangers = [name for name, folder in places.items() if folder != ours]
    if not strangers:
        return Check("the four packages", "ok", f"all from {ours}", values=values)
    listed = ", ".join(f"{name} from {places[name] or 'nowhere'}" for name in strangers)
    return Check("the four packages", "fail", f"{listed}, the others from {ours}",
                 "rename or uninstall the one that is not ours, or start from another folder; "
                 "then: python -m pip install --force-reinstall --no-deps tissue-sim", values)


def _folder(name: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None:
        return None
    origin = Path(spec.origin).resolve()
    # A package lies in a folder of its own; a stray module such as calibration.py does not.
    return origin.parent.parent if spec.submodule_search_locations else origin
