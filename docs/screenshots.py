"""Make the screenshots of the viewer for the documentation: python docs/screenshots.py [NAME ...]

Needs Chromium (Debian: apt install chromium fonts-dejavu-core) and Playwright (part of tissue-sim[test]). The measured
curves in the pictures are simulations of another material with sensor noise.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import chromium

import tissue_sim as ts
from scenes import SCENES

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

PICTURES = Path(__file__).parent / "pictures"
#: Material of the virtual measurement; the viewer starts with the softer material of the reference study.
MEASURED = ts.Material("reduced_polynomial_2", {"C10": 1550.0, "C20": 650.0}, ts.Bulk("bulk_ratio", 1e4))
#: Number of replicates of the virtual measurement.
REPLICATES = 3
#: Standard deviation of the noise of the virtual load cell, N.
NOISE = 0.02
DEPTH = 0.010
_PHASE = "[data-testid=phase][data-phase={}]"


@dataclass(frozen=True)
class Screenshot:
    """State of the page for a screenshot: the tool was pressed in, unloaded to `depth` in mm, and is paused.

    Attributes:
        scene: scene name of `tissue-sim view`.
        flags: further flags of `tissue-sim view`.
        depth: depth of the paused tool, mm.
        tab: visible tab of the controls.
        size: width and height of the page, pixels.
        aside: lateral position y of the tool in a solid in space, mm, where sliders instead of a protocol move it.
    """

    scene: str
    flags: tuple[str, ...] = ()
    depth: float = 7.0
    tab: str = "Motion"
    size: tuple[int, int] = (1400, 860)
    aside: float | None = None


NEEDLE = Screenshot("needle_indentation")
SCREENSHOTS = {"viewer_needle": NEEDLE,
               "viewer_needle_dark": replace(NEEDLE, flags=("--dark",), tab="Material"),
               "viewer_compression": Screenshot("bonded_compression", tab="View"),
               "viewer_solid": Screenshot("needle_indentation", (
                   "--solid", "--offset-mm", "12", "--tilt-deg", "15", "--tool", "round", "--friction", "0.3",
                   "--points", "5"), depth=6.0, aside=-3.0),
               "viewer_shell": Screenshot("needle_indentation", (
                   "--solid", "--shape", "ellipsoid_shell", "--semi-axis-x-mm", "80", "--semi-axis-y-mm", "60",
                   "--semi-axis-z-mm", "50", "--thickness-mm", "15", "--offset-mm", "30", "--tool", "round",
                   "--tool-radius-mm", "5", "--friction", "0.3", "--points", "3"), depth=5.0, aside=-4.0)}


def main(names: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder, chromium.chromium() as browser:
        for name in names or SCREENSHOTS:
            take(browser, SCREENSHOTS[name], Path(folder), PICTURES / f"{name}.png")
            print(PICTURES / f"{name}.png")


def take(browser: Browser, shot: Screenshot, folder: Path, path: Path) -> None:
    """Start a viewer, press the tool in, unload it, and save the page as a picture."""
    measured = ("--measured", *measure(shot.scene, folder)) if shot.aside is None else ()
    with viewer(shot.scene, *measured, *shot.flags) as url:
        width, height = shot.size
        page = browser.new_page(viewport={"width": width, "height": height},
                                color_scheme="dark" if "--dark" in shot.flags else "light")
        chromium.open_viewer(page, url, pixel_ratio=1.0)
        page.locator(_PHASE.format("running")).wait_for(timeout=120e3)
        if shot.aside is None:
            page.get_by_test_id("rmse").wait_for(timeout=120e3)
            press(page, shot)
        else:
            press_aside(page, shot.depth, shot.aside)
        page.get_by_role("tab", name=shot.tab).click()
        chromium.save_picture(page, path)
        page.close()


def press(page: Page, shot: Screenshot) -> None:
    """Play a protocol that ends at the depth of the screenshot, and pause there."""
    protocol = f"ramp {DEPTH * 1e3:g}mm; hold 3s; unload {shot.depth:g}mm; hold 600s"
    chromium.text_field(page, "protocol").fill(protocol)
    page.get_by_role("button", name="Play").click()
    depth = page.get_by_test_id("depth")
    depth.filter(has_text=f"{DEPTH * 1e3:.2f}").wait_for(timeout=120e3)
    depth.filter(has_text=f"{shot.depth:.2f}").wait_for(timeout=120e3)
    page.get_by_role("button", name="Pause").click()
    page.locator(_PHASE.format("paused")).wait_for()


def press_aside(page: Page, depth: float, aside: float) -> None:
    """Move the tool of a solid in space with the sliders, mm, and wait for equilibrium."""
    for label, value in (("y [mm]", aside), ("depth [mm]", depth)):
        chromium.text_field(page, label).fill(f"{value:g}")
        chromium.text_field(page, label).press("Enter")
        page.wait_for_timeout(3000)  # until it is late, or has been: equilibria may come between two looks
        page.get_by_test_id("solution").filter(has_text="in equilibrium").wait_for(timeout=600e3)
    page.wait_for_timeout(2000)  # the curve of the model, where it is there


def measure(scene: str, folder: Path) -> list[str]:
    """Write virtual measurements of a scene and yield their files."""
    experiment = SCENES[scene].experiment(specimen=ts.Specimen(0.040, 0.070),
                                          protocol=ts.Protocol.ramp(depth=DEPTH, points=81))
    files = [folder / f"{scene}_{number + 1}.csv" for number in range(REPLICATES)]
    for number, file in enumerate(files):
        if not file.exists():
            model = ts.Model(experiment, MEASURED, ts.Rig(force_noise=NOISE, seed=number))
            ts.write_recording(ts.simulate(model), file)
    return [str(file) for file in files]


@contextmanager
def viewer(scene: str, *flags: str) -> Iterator[str]:
    """Start a viewer with simple graphics in a separate process and yield its address."""
    command = [sys.executable, "-m", "scenes.cli", "view", scene, "--depth-mm", f"{DEPTH * 1e3:g}", "--port", "0",
               "--json", "--low-graphics", *flags]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, encoding="utf-8") as process:
        try:
            line = process.stdout.readline()
            if not line:
                raise SystemExit(f"{' '.join(command)} ended with {process.wait()}")
            yield json.loads(line)["url"]
        finally:
            process.terminate()


if __name__ == "__main__":
    main(sys.argv[1:])
