"""Section with the profile likelihoods, strain windows and correlations of the parameters."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from calibration.fit.fit import Fit
from calibration.report.content import Block, Column, Details, Figure, Table, Text
from calibration.report.estimate_figures import (
    draw_growing_window_parameters_or_none,
    draw_parameter_correlation_or_none,
    draw_profiles,
)
from calibration.report.fit_text import format_law_title, list_parameters_with_standard_errors, make_parameter_symbol
from calibration.report.section import CalibrationReport, Section


class ParameterDetermination(Section):
    """Accuracy of the parameters by law: figures of the best law and of laws with profiles, otherwise tables."""

    name = "parameter_determination"

    def make_title(self, report: CalibrationReport) -> str:
        """Return the title with the best law."""
        return f"How well {format_law_title(report.result.best.law)} is determined"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the content of the best law, then that of other laws as details."""
        for fit in report.fits:
            is_best = fit is report.result.best
            is_drawn = report.has_figures and (is_best or bool(fit.profiles))
            blocks = _iterate_estimate_figures(fit, report) if is_drawn else _iterate_correlation_tables(fit)
            if is_best:
                yield from blocks
            else:
                yield Details(f"How well {format_law_title(fit.law)} is determined", [*blocks])


def _iterate_estimate_figures(fit: Fit, report: CalibrationReport) -> Iterator[Figure]:
    """Yield the figures of the estimates of one law: profiles, strain windows and correlation."""
    if fit.profiles:
        yield Figure(f"profiles {fit.law}", partial(draw_profiles, fit, report.campaign.fit.bounds, report.units),
                     f"Profile likelihoods of {fit.law}",
                     "Increase of the sum of squares when one parameter is fixed and all others are fitted again. If "
                     "the profile differs from the dashed parabola, ± 2 standard errors are not a 95 % interval.")
    yield Figure(f"windows {fit.law}", partial(draw_growing_window_parameters_or_none, fit, report.units),
                 f"Parameters of {fit.law} from parts of the strain",
                 "Estimates from the first part of the strain of each test only, as with max_strain.")
    yield Figure(f"correlation {fit.law}", partial(draw_parameter_correlation_or_none, fit, report.units),
                 f"Correlation of the parameters of {fit.law}")


def _iterate_correlation_tables(fit: Fit) -> Iterator[Table]:
    """Yield the table of the correlations of the parameters of one law; nothing for fewer than two free parameters."""
    free = list_parameters_with_standard_errors(fit)
    if len(free) < 2:
        return
    indices = [fit.covariance.order.index(name) for name in free]
    symbols = [make_parameter_symbol(fit, name) for name in free]
    rows: list[list[Text]] = [[symbol, *(f"{fit.correlation[i][j]:.3f}" for j in indices)]
                              for symbol, i in zip(symbols, indices, strict=True)]
    yield Table([Column("Correlation"), *map(Column, symbols)], rows, narrow=True)
