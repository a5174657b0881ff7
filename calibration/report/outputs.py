"""Make the HTML pages of reports from their sections, and write reports, tables and result files.

Reports are those of calibrations, diagnoses and designs. The pages are made with the templates of this package.
"""

from __future__ import annotations

import csv
import io
import json
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve
from calibration.diagnosis.design import Design
from calibration.diagnosis.diagnosis import DiagnosisResult, DiagnosisStage, diagnosis_to_json
from calibration.diagnosis.evidence import FitEvidence
from calibration.effects.effect import Effect
from calibration.fit.curves import TestCurves
from calibration.fit.result import CalibrationResult, to_json_dictionary
from calibration.output_folder import DIAGNOSIS_FILE, FIT_FILE, make_numbered_test_figure_name
from calibration.report.content import Block, Column, Details, Figure, Paragraph, Part, Table, Text, get_page_parts
from calibration.report.diagnosis_figures import build_fitted_curves_of_test
from calibration.report.drawing import FigureEmbedder
from calibration.report.fit_text import format_law_title
from calibration.report.quantities import ReportUnits, get_symbol_letter_index_owner_and_slant, use_minus_signs
from calibration.report.section import CalibrationReport, DesignReport, DiagnosisReport, Section
from calibration.report.sections import SECTIONS
from calibration.report.sections.statements import make_plain_methods_text
from tissue_sim.errors import InputError
from tissue_sim.files import write_text

if TYPE_CHECKING:
    from jinja2 import Template

def build_report_page(report: CalibrationReport | DiagnosisReport | DesignReport) -> str:
    """Return the HTML page of a report: its sections in the order of `SECTIONS`."""
    sections = [(section.make_title(report), [*section.iterate_blocks(report)])
                for section in list_sections_in_page_order()
                if report.kind in section.reports and (report.has_figures or not section.needs_figures)]
    return render_page(f"{report.kind.capitalize()} of {report.campaign_name}", sections, report.pictures)


def require_usable_sections() -> None:
    """Import all sections and the template, so that a faulty plug-in is reported before a long computation.

    Raises:
        InputError: a section cannot be imported, or it names an unknown section.
    """
    try:
        list_sections_in_page_order()
        _get_page_template()
    except ImportError as error:
        raise InputError(f"a section of the report cannot be imported ({error}). Install the missing package, or "
                         "remove the package that adds the section", field="tissue_sim.report_sections") from None


def list_sections_in_page_order() -> list[Section]:
    """Return all registered sections; a section with `before` precedes the section of this name."""
    sections = [kind() for kind in SECTIONS.values()]
    for section in [each for each in sections if each.before]:
        SECTIONS.find(section.before, "before")
        sections.remove(section)
        sections.insert([each.name for each in sections].index(section.before), section)
    return sections


def render_page(title: str, sections: Iterable[tuple[Text, Sequence[Block]]], pictures: FigureEmbedder | None) -> str:
    """Return a self-contained HTML page; sections without content are omitted.

    Args:
        title: title of the page.
        sections: title and content of each section.
        pictures: destination of the figures; None: figures are omitted.
    """
    shown = [(heading, [*_iterate_page_blocks(blocks, pictures)]) for heading, blocks in sections]
    return _get_page_template().render(title=title, sections=[each for each in shown if each[1]])


def _iterate_page_blocks(blocks: Iterable[Block], pictures: FigureEmbedder | None) -> Iterator[Block]:
    """Yield the content of a page: figures as images, tables without terminal columns, details only if not empty."""
    for block in blocks:
        if isinstance(block, Figure):
            drawn = None if pictures is None else pictures.draw_figure_or_none(block)
            if drawn is not None:
                yield drawn
        elif isinstance(block, Table):
            yield block.select_page_columns()
        elif isinstance(block, Details):
            inner = [*_iterate_page_blocks(block.blocks, pictures)]
            if inner:
                yield Details(block.summary, inner)
        else:
            yield block


@cache
def _get_page_template() -> Template:
    """Return the template of all pages, which escapes all text."""
    # Imported on use: commands that write no report start faster.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("calibration.report"), autoescape=True, undefined=StrictUndefined,
                              keep_trailing_newline=True)
    environment.filters |= {"kind": lambda block: type(block).__name__, "parts": get_page_parts,
                            "minus_signs": _use_minus_signs_in_page_parts,
                            "symbol_parts": get_symbol_letter_index_owner_and_slant}
    return environment.get_template("page.html")


def _use_minus_signs_in_page_parts(text: Text) -> list[Part]:
    """Return the parts of a text that a page shows, with minus signs in place of the hyphens before numbers."""
    return [use_minus_signs(part) if isinstance(part, str) else replace(part, text=use_minus_signs(part.text))
            for part in get_page_parts(text)]


#: Law -> recorded and fitted curves of each test.
Curves = Mapping[str, Sequence[TestCurves]]


def write_calibration_files(result: CalibrationResult, curves: Curves,
                            measured: Mapping[str, Sequence[MeasuredCurve]], *, figures: bool = True,
                            figures_format: str | None = None) -> None:
    """Write tables, methods text, report and result file of a calibration.

    ``fit.json`` is written last, because its existence marks the campaign as finished.

    Args:
        result: result of the calibration, fits best first.
        curves: recorded and fitted curves of each test, by law.
        measured: recordings of each test.
        figures: whether the report includes figures.
        figures_format: ``svg``, ``pdf`` or ``png`` to write each figure also as a file; None: no figure files.
    """
    write_text(result.output / "curves.csv", _format_csv_of_all_fitted_curves(curves))
    write_text(result.output / "residuals.csv", _format_residual_table(curves))
    methods = make_plain_methods_text(result, measured, ReportUnits.choose_for_best_fit(result))
    write_text(result.output / "methods.txt", methods)
    pictures = FigureEmbedder(result.output, figures_format) if figures else None
    write_text(result.output / "report.html", build_report_page(CalibrationReport(result, curves, methods, pictures)))
    text = json.dumps(to_json_dictionary([result]), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(result.output / FIT_FILE, text + "\n")


def write_diagnosis_and_get_result(result: DiagnosisResult, before: FitEvidence, after: FitEvidence | None,
                                   effects: Mapping[str, Effect],
                                   measured: Mapping[str, Sequence[MeasuredCurve]], *, figures: bool = True,
                                   figures_format: str | None = None) -> DiagnosisResult:
    """Write table, report and result file of a diagnosis.

    ``diagnosis.json`` is written last, because its existence marks the campaign as finished.

    Args:
        result: the result of the diagnosis.
        before: the fit without the added effects.
        after: the fit with the added effects; None if no effect was added.
        effects: catalogue of effects by name.
        measured: all recordings of each test.
        figures: whether the report includes figures.
        figures_format: ``svg``, ``pdf`` or ``png`` to write each figure also as a file; None: no figure files.

    Returns:
        The result with the time of this step.
    """
    began = time.monotonic()
    diagnosis = result.diagnosis
    write_text(result.output / "residuals.csv", _format_before_and_after_residual_table(before, after))
    pictures = FigureEmbedder(result.output, figures_format) if figures else None
    report = DiagnosisReport(diagnosis, before, after, effects, measured, pictures)
    write_text(result.output / "report.html", build_report_page(report))
    stages = [*diagnosis.stages, DiagnosisStage(name="report", wall_s=time.monotonic() - began)]
    result = DiagnosisResult(result.campaign, msgspec.structs.replace(diagnosis, stages=stages), result.output,
                             result.digest)
    text = json.dumps(diagnosis_to_json([result]), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(result.output / DIAGNOSIS_FILE, text + "\n")
    return result


def write_design_report(design: Design, evidence: FitEvidence, folder: Path, *, figures: bool = True,
                        figures_format: str | None = None) -> None:
    """Write the report of a design.

    Args:
        design: the result of the design.
        evidence: noise-free recordings of the planned tests.
        folder: folder of the report.
        figures: whether the report includes figures.
        figures_format: ``svg``, ``pdf`` or ``png`` to write each figure also as a file; None: no figure files.
    """
    campaign = evidence.campaign
    curves = {make_numbered_test_figure_name(campaign, number): build_fitted_curves_of_test(evidence, test.name)
              for number, test in enumerate(campaign.tests) if not test.hold_out}
    pictures = FigureEmbedder(folder, figures_format) if figures else None
    write_text(folder / "report.html", build_report_page(DesignReport(design, curves, pictures)))


def write_failure_report(campaign: Campaign, failures: Mapping[str, str], folder: Path) -> None:
    """Write the report of a campaign in which no law could be fitted, with the reason for each law."""
    reasons = Table([Column("Law"), Column("Reason", text=True)],
                    [[format_law_title(law), reason] for law, reason in failures.items()])
    write_text(folder / "report.html", render_page(f"Calibration of {campaign.name}",
                                                   [("", [Paragraph("No law has a fit."), reasons])], None))


def write_summary_table(results: Sequence[CalibrationResult], path: Path) -> None:
    """Write ``summary.csv`` with one row per law and campaign; cells without a value are empty."""
    units = {name: fit.get_unit_or_empty_if_dimensionless(name) or "-" for result in results for fit in result.fits
             for name in fit.parameters}
    header = ["campaign", "rank", "law", "status", "E0 [Pa]", "mu0 [Pa]", "R2", "RMSE [N]", "RMSE [Pa]", "AIC", "BIC",
              "left_out [%]", "noise_ratio", "stable_from", "stable_to", "not_identifiable", "fem_solves", "cpu [s]"]
    for name, unit in units.items():
        header += [f"{name} [{unit}]", f"{name} standard error [{unit}]", f"{name} low95 [{unit}]",
                   f"{name} high95 [{unit}]"]
    rows = []
    for result in results:
        for rank, fit in enumerate(result.fits, start=1):
            row = [result.campaign.name, rank, fit.law, fit.status, fit.E0, fit.mu0, fit.R2, fit.RMSE_N, fit.RMSE_Pa,
                   fit.AIC, fit.BIC, fit.left_out, fit.noise_ratio, fit.stable_from, fit.stable_to,
                   " ".join(fit.not_identifiable), fit.fem_solves, fit.cpu_s]
            for name in units:
                low, high = fit.intervals95.get(name) or (None, None)
                row += [fit.parameters.get(name), fit.standard_errors.get(name), low, high]
            rows.append(row)
    write_text(path, format_csv_table(header, rows))


def _format_csv_of_all_fitted_curves(curves: Curves) -> str:
    """Return a CSV table of the fitted curves of all laws and tests, with standard errors and prediction bands.

    The half widths of the 95 % bands are for single samples of a new recording and for its entire curve.
    """
    rows = []
    for law, tests in curves.items():
        for test in tests:
            time = [None] * test.force.size if test.time is None else test.time.tolist()
            columns = (test.displacement, test.force, test.force_error, test.band, test.whole_band)
            rows += [[law, test.test.name, t, *_make_cells_of_abscissa_force_and_stress(test, d, (f,), (e, b, w))]
                     for t, d, f, e, b, w in zip(time, *(column.tolist() for column in columns), strict=True)]
    return format_csv_table(["law", "test", "time [s]", "abscissa", "value", "displacement [mm]", "force [N]",
                             "standard error [N]", "band95 [N]", "whole band95 [N]", "nominal stress [Pa]",
                             "standard error [Pa]", "band95 [Pa]", "whole band95 [Pa]"], rows)


def _format_residual_table(curves: Curves) -> str:
    """Return a CSV table of all samples of all laws and tests: measured force, model and residual.

    The model includes the contact offset and the force zero of each recording.
    """
    rows = []
    for law, tests in curves.items():
        for test in tests:
            for curve, model in zip(test.measured, test.fitted, strict=True):
                time = [None] * model.size if curve.time is None else curve.time.tolist()
                rows += [[law, curve.name, t, *_make_cells_of_abscissa_force_and_stress(test, d, (f, m, m - f))] for t,
                         d, f, m in zip(
                    time, curve.displacement.tolist(), curve.force.tolist(), model.tolist(), strict=True)]
    return format_csv_table(["law", "replicate", "time [s]", "abscissa", "value", "displacement [mm]", "measured [N]",
                             "model [N]", "residual [N]", "measured [Pa]", "model [Pa]", "residual [Pa]"], rows)


def _format_before_and_after_residual_table(before: FitEvidence, after: FitEvidence | None) -> str:
    """Return a CSV table of all samples: measured force, and forces of the models without and with the added effects.

    The model forces include the contact offset and the force zero of each recording.

    Forces are in N; for recordings of stress the values are in Pa and the displacement is a strain.
    """
    rows = []
    forces = [before.evaluation.force, before.evaluation.force if after is None else after.evaluation.force]
    for curve, samples in zip(before.problem.measured, before.problem.rows, strict=True):
        factor = 1.0 if curve.test.states_stress else 1e3
        for i, force in enumerate(curve.force):
            models = [float(force_of[samples][i]) for force_of in forces]
            rows.append([curve.name, None if curve.segment is None else str(curve.segment[i]),
                         None if curve.time is None else float(curve.time[i]), factor * float(curve.displacement[i]),
                         float(force), models[0], None if after is None else models[1], curve.noise.deviation])
    return format_csv_table(["replicate", "segment", "time [s]", "displacement [mm]", "measured [N]",
                             "model before [N]", "model after [N]", "noise [N]"], rows)


def _make_cells_of_abscissa_force_and_stress(test: TestCurves, displacement: float, forces: Sequence[float],
                                             errors: Sequence[float] = ()) -> list[float | str | None]:
    """Return the cells of a row: abscissa (name, value), displacement in mm, forces in N and stresses in Pa.

    Cells that the test does not define are None. A nominal stress is negative in compression, its errors are positive.
    For a table of moduli the abscissa is the frequency, and the stress is the modulus.
    """
    setup, empty = test.test, [None] * (len(forces) + len(errors))
    if setup.modulus:
        # The fit compares logarithms; a third force is the difference of the first two.
        moduli = [math.exp(force) for force in forces[:2]]
        differences = [moduli[1] - moduli[0]] if len(forces) > 2 else []
        return ["frequency [Hz]", displacement, None, *empty, *moduli, *differences,
                *(error * moduli[0] for error in errors)]
    mechanical = [None, *empty] if setup.states_stress else [displacement * 1e3, *forces, *errors]
    if test.area is None:
        return [None, None, *mechanical, *empty]
    sign, height = setup.kind.sign, setup.reference_height
    name = setup.kind.require_closed_form().label
    value = setup.kind.convert_nominal_strain_to_stretch_or_shear_strain(displacement / height)
    if setup.specimen is not None and setup.specimen.specific_weight:
        name = "1 - displacement/height [-]"
    return [name, value, *mechanical, *(sign * force / test.area for force in forces),
            *(error / test.area for error in errors)]


def format_csv_table(header: Sequence[str], rows: Iterable[Sequence]) -> str:
    """Return a CSV table; floats have eight significant digits, None and NaN are empty cells."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    # NaN marks states beyond the largest load that a law can carry.
    writer.writerows(["" if cell is None or cell != cell else f"{cell:.8g}" if isinstance(cell, float) else cell
                      for cell in row] for row in rows)
    return stream.getvalue()
