"""Printed results of `tissue-sim calibrate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from calibration.fit.result import list_method_agreement_sentences
from scenes.commands.calibrate.fits import print_fit_tables
from scenes.commands.shared.text_table import print_sentence

if TYPE_CHECKING:
    from rich.console import Console

    from calibration.fit.result import CalibrationResult


def print_calibration_results(results: Sequence[CalibrationResult], output: Path, console: Console) -> None:
    """Print tables and remarks of each campaign, and the written files.

    Args:
        results: results of one call of `calibration.calibrate`.
        output: result folder of this call.
        console: console of the results.
    """
    for result in results:
        print_sentence(console, result.campaign.name)
        print_fit_tables(result, console)
    for sentence in list_method_agreement_sentences(results):
        print_sentence(console, sentence)
    for result in results:
        if result.resumed:
            _print_sentence_with_path(console,
                                      f"read from {result.output}, where this calibration was already finished")
        else:
            _print_sentence_with_path(console, f"wrote {result.output / 'report.html'}")
    if len(results) > 1:
        _print_sentence_with_path(console, f"wrote {output / 'summary.csv'}")


def _print_sentence_with_path(console: Console, text: str) -> None:
    """Print a sentence with a path on one line of any length, so that the path can be copied."""
    console.print(text, markup=False, emoji=False, soft_wrap=True)
