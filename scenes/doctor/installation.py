"""Check the version of Python, the required packages, and the folders of the four packages of this program."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import platform
import sys
from collections.abc import Iterator
from pathlib import Path

from scenes.doctor.check import CheckResult, Status

#: Packages of this program.
OWN_PACKAGES = ("tissue_sim", "calibration", "haptics", "scenes")
#: Distributions that this program requires.
REQUIRED_PACKAGES = ("taichi", "numpy", "scipy", "sympy", "viser", "msgspec", "rich", "matplotlib")
#: Platforms with Taichi wheels: (sys.platform, machine in lower case).
TAICHI_PLATFORMS = (("linux", "x86_64"), ("win32", "amd64"), ("darwin", "arm64"))
#: Lowest and highest supported version of Python.
PYTHON_RANGE = ((3, 11), (3, 13))


def check_python_version_and_platform() -> CheckResult:
    """Check the version of Python and the platform."""
    version = ".".join(str(part) for part in sys.version_info[:3])
    finding = f"{version} on {platform.platform()}, {platform.machine()}"
    values = {"version": version, "platform": platform.platform(), "machine": platform.machine()}
    low, high = PYTHON_RANGE
    if not low <= sys.version_info[:2] <= high:
        return CheckResult("Python", "fail", finding, "use Python 3.11, 3.12 or 3.13, for which Taichi has wheels",
                           values)
    if not has_taichi_wheel_for_platform():
        return CheckResult("Python", "warn", finding, "Taichi has no wheel for this platform: analytical calibration "
                           "works, finite elements need Linux x86-64, Windows or a Mac with Apple silicon", values)
    return CheckResult("Python", "ok", finding, values=values)


def has_taichi_wheel_for_platform() -> bool:
    """Return whether Taichi has a wheel for this platform."""
    return (sys.platform, platform.machine().lower()) in TAICHI_PLATFORMS


def iterate_required_package_checks() -> Iterator[CheckResult]:
    """Check whether each required package is installed; yield one result per package."""
    for name in REQUIRED_PACKAGES:
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            status: Status = "warn" if name == "taichi" and not has_taichi_wheel_for_platform() else "fail"
            yield CheckResult(name, status, "not installed", f"python -m pip install {name}" if status == "fail" else
                              "finite elements need a platform with a Taichi wheel")
        else:
            yield CheckResult(name, "ok", version, values={"version": version})


def check_common_package_folder() -> CheckResult:
    """Return whether the four packages of this program are imported from the same folder, as a check result.

    Another distribution with a package `calibration`, or a file `calibration.py` in the current folder, would replace
    the package of this program without a message.
    """
    folders = {name: _find_folder_containing_package(name) for name in OWN_PACKAGES}
    values = {name: str(folder) if folder else None for name, folder in folders.items()}
    own_folder = folders["scenes"]
    foreign = [name for name, folder in folders.items() if folder != own_folder]
    if not foreign:
        return CheckResult("the four packages", "ok", f"all from {own_folder}", values=values)
    listed = ", ".join(f"{name} from {folders[name]}" if folders[name] else f"{name} not found" for name in foreign)
    return CheckResult("the four packages", "fail", f"{listed}, the others from {own_folder}",
                       "rename or uninstall the package with the same name, or start from another folder; "
                       "then: python -m pip install --force-reinstall --no-deps tissue-sim", values)


def _find_folder_containing_package(name: str) -> Path | None:
    """Return the folder that contains a package, the path of a single-file module, or None if neither exists."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None:
        return None
    origin = Path(spec.origin).resolve()
    # A single file such as calibration.py has no search locations: its path differs from the folder of the packages.
    return origin.parent.parent if spec.submodule_search_locations else origin
