"""Make the HTML page of a report from its sections, with the templates of this package."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

from calibration.report.content import Block, Details, Figure, Part, Table, Text, get_page_parts
from calibration.report.drawing import FigureEmbedder
from calibration.report.rounding import use_minus_signs
from calibration.report.section import CalibrationReport, DesignReport, DiagnosisReport, Section
from calibration.report.sections import SECTIONS
from calibration.report.symbols import get_symbol_letter_index_owner_and_slant
from tissue_sim.errors import InputError

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
