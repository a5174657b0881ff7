"""Section with the convergence of all starts."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from calibration.fit.fit import Fit
from calibration.report.content import EMPTY, Block, Column, Details, Figure, Table
from calibration.report.drawing import format_count
from calibration.report.figures import draw_descent_history
from calibration.report.fit_text import format_law_title, make_parameter_symbol
from calibration.report.section import CalibrationReport, Section
from calibration.report.units import ReportUnits


class Convergence(Section):
    """Error and parameters at every solve of every start."""

    name = "convergence"
    title = "Convergence"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the figure and, as details, a table for each law; nothing without a history of solves."""
        if any(fit.history for fit in report.fits):
            yield Figure("convergence", partial(draw_descent_history, report.fits),
                         "Error and parameters at every solve of every start",
                         "Error: sum of squares of the whitened residuals and priors. One line per start; one solve "
                         "simulates all tests. At the change to the accurate mesh the error may rise, because the "
                         "covariance of the fast mesh includes a larger mesh error.")
        for fit in report.fits:
            if fit.history:
                yield Details(f"{format_law_title(fit.law)}: {_format_effort(fit)}",
                              [_make_table_of_all_solves(fit, report.units)])


def _format_effort(fit: Fit) -> str:
    """Return the effort as text: ``106 solves from 20 starts, 270 simulated tests, 1.8 s of processor time``."""
    starts = len({step.start for step in fit.history})
    return (f"{format_count(len(fit.history), 'solve')} from {format_count(starts, 'start')}, "
            f"{format_count(fit.fem_solves, 'simulated test')}, {fit.cpu_s:.3g} s of processor time")


def _make_table_of_all_solves(fit: Fit, units: ReportUnits) -> Table:
    """Return the table of all solves of all starts of a fit: parameters, error and RMSE, one row per solve."""
    names = list(fit.history[0].parameters)
    scales = [units.choose_display_unit_of_si_unit(fit.units[name]) for name in names]
    labels = [(make_parameter_symbol(fit, name), unit.format_axis_label(""))
              for name, unit in zip(names, scales, strict=True)]
    return Table([*map(Column, ("Start", "Run", *labels, "Error", units.force.format_axis_label("RMSE"),
                                "Accurate mesh"))],
                 [[f"{step.start}", f"{step.run}", *(f"{step.parameters[name] / unit.size:.5g}"
                                                     for name, unit in zip(names, scales, strict=True)),
                   f"{step.error:.5g}", f"{step.RMSE_N / units.force.size:.3g}", "yes" if step.corrected else EMPTY]
                  for step in fit.history])
