"""Recordings of the hidden-effect study: true curves with jitter, noise and rounding, and their campaign."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.hidden_effects.sizes import CONTACT, CORRELATED, NOISE, REPLICATES, ZERO
from benchmarks.hidden_effects.truth import HEIGHT, NEEDLE, RADIUS, VirtualTest, moved, plain

#: Step of a sensor that rounds, N.
STEP = 0.02
_KINDS = {"A": "lubricated_compression", "B": "bonded_compression", "C": "needle_indentation"}


@dataclass(frozen=True)
class Scatter:
    """Differences between the recordings of a test.

    Attributes:
        coloured: whether the noise is correlated. rounded: whether the sensor rounds. jitter: ``normal``, ``skewed``
            (exponential) or ``outlier`` (one recording of a test in three is five times as far off).
    """

    coloured: bool = False
    rounded: bool = False
    jitter: str = "normal"


def draw_scatter(rng: np.random.Generator, other_form: bool, coloured: bool | None = None) -> Scatter:
    """Draw the scatter of a campaign: one third is rounded, one third has correlated noise.

    An effect in another form also has another distribution of the jitter.
    """
    rolled, colour = rng.uniform(size=2)
    jitter = str(rng.choice(["normal", "skewed", "outlier"])) if other_form else "normal"
    return Scatter(bool(colour < 1 / 3) if coloured is None else coloured, bool(rolled < 1 / 3), jitter)


def _shifts(rng: np.random.Generator, jitter: str) -> np.ndarray:
    """Draw the shifts of contact in standard deviations, shape (replicates,)."""
    if jitter == "skewed":
        return rng.exponential(size=REPLICATES) - 1.0
    shifts = rng.standard_normal(REPLICATES)
    if jitter == "outlier" and rng.uniform() < 1 / 3:
        shifts[rng.integers(REPLICATES)] *= 5.0
    return shifts


def noise(rng: np.random.Generator, time: np.ndarray, coloured: bool) -> np.ndarray:
    """Draw the noise of the sensor, N, shape of `time`.

    Correlated noise has the autocorrelation exp(-lag / `CORRELATED`).
    """
    white = rng.standard_normal(time.size)
    if coloured:
        kept = np.exp(-np.diff(time) / CORRELATED)
        for k, keep in enumerate(kept, start=1):
            white[k] = keep * white[k - 1] + np.sqrt(1 - keep**2) * white[k]
    return NOISE * white


def write_campaign(folder: Path, tests: Sequence[VirtualTest], forces: Callable[[VirtualTest], np.ndarray],
                   scatter: Scatter, rng: np.random.Generator) -> Path:
    """Write recordings and a campaign that does not state their noise.

    Args:
        folder: for all files. tests: of the protocol. forces: of a test, N, without scatter. rng: of the scatter.

    Returns:
        The campaign file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = [f'[[specimen]]\nname = "S{number + 1}"\nradius_mm = {RADIUS * 1e3}\nheight_mm = {HEIGHT * 1e3}\n'
            "density_kg_m3 = 1000.0\n" for number in dict.fromkeys(test.specimen for test in tests)]
    for test in tests:
        names = []
        for number, shift in enumerate(_shifts(rng, scatter.jitter), start=1):
            placed = replace(test, contact=CONTACT * shift)
            change = moved(placed, placed.depth) - plain(test.kind, test.displacement)
            force = forces(placed) + change + ZERO * rng.standard_normal() + noise(rng, test.time, scatter.coloured)
            if scatter.rounded:
                force = np.round(force / STEP) * STEP
            names.append(f"{test.name}_{number}.csv")
            table = np.column_stack([test.time, 1e3 * test.displacement, force])
            np.savetxt(folder / names[-1], table, fmt="%.6f", delimiter=",", comments="",
                       header="time [s],displacement [mm],force [N]")
        tip = f'tool = "flat"\ntool_radius_mm = {NEEDLE * 1e3}\nfriction = "bonded"\n' if test.kind == "C" else ""
        text.append(f'[[test]]\nname = "{test.name}"\nkind = "{_KINDS[test.kind]}"\nrecordings = {json.dumps(names)}\n'
                    f'specimen = "S{test.specimen + 1}"\n'
                    f"{tip}{'hold_out = true' if test.held_out else ''}\n")
    text.append('[fit]\nmethod = "inverse_fem"\nlaws = ["reduced_polynomial_2"]\nbulk_ratio = 10000.0\nstarts = 1\n'
                "start = {C10 = 1400.0, C20 = 600.0}\n"
                '[noise]\nforce_N = "estimate"\ncorrelation_time_s = "estimate"\ncontact_jitter_mm = "estimate"\n'
                'zero_jitter_N = "estimate"\n')
    path = folder / "campaign.toml"
    path.write_text("".join(text), encoding="utf-8")
    return path
