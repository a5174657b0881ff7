"""The results of a call of the calibration on the screen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from calibration.fit.result import agreement
from scenes.commands.calibrate.fits import print_fits
from scenes.commands.shared.text_table import print_sentence

if TYPE_CHECKING:
    from rich.console import Console

    from calibration.fit.result import CalibrationResult


def print_results(results: Sequence[CalibrationResult], output: Path, console: Console) -> None:
    """Print tables and remarks of each campaign, and what was written.

    Args:
        results: of one call.
        output: folder that was given in it.
        console: where to print.
    """
    for result in results:
        print_sentence(console, result.campaign.name)
        print_fits(result, console)
    for sentence in agreement(results):
        print_sentence(console, sentence)
    for result in results:
        if result.resumed:
            _print_place(console, f"read back from {result.output}, nothing was fitted")
        else:
            _print_place(console, f"wrote {result.output / 'report.html'}")
    if len(results) > 1:
        _print_place(console, f"wrote {output / 'summary.csv'}")


def _print_place(console: Console, text: str) -> None:
    """In one line, whatever its length: people copy paths."""
    console.print(text, markup=False, emoji=False, soft_wrap=True)
