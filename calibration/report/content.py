"""Content of a report as plain data: marked text, tables, figures, lists and paragraphs, without any layout.

The page of a report (`calibration.report.outputs`) and the terminal tables of the commands show the same content.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

#: Text of an empty cell.
EMPTY = "-"


@dataclass(frozen=True)
class Span:
    """Part of a text with a mark.

    Attributes:
        text: plain text.
        mark: ``""``, ``"bad"`` (warning), ``"strong"``, ``"quiet"``, ``"small"``, ``"code"``, ``"symbol"`` or
            ``"bad_symbol"`` (symbol of a parameter, typeset on the page) or ``"line"`` (line break, no text).
        title: explanation that a page shows as a tooltip of a symbol.
        only: ``"page"`` or ``"terminal"`` if the other omits this part.
    """

    text: str
    mark: str = ""
    title: str = ""
    only: str = ""


@dataclass(frozen=True)
class Picture:
    """Image within a line of text, such as a formula; only pages show it.

    Attributes:
        source: data URI of the image.
        width: width on the page, CSS pixels.
        text: the same content as plain text.
    """

    source: str
    width: int
    text: str
    mark: ClassVar[str] = "picture"
    only: ClassVar[str] = "page"


#: Part of a text.
Part = str | Span | Picture
#: Text of a report: plain, or a sequence of plain and marked parts.
Text = Part | Sequence[Part]
#: Line break within a text.
LINE_BREAK = Span("", "line")


def get_parts(text: Text) -> list[Part]:
    """Return the parts of a text as a list."""
    return [text] if isinstance(text, str | Span | Picture) else list(text)


def join_texts(texts: Iterable[Text], separator: Part = ", ") -> list[Part]:
    """Return the texts as one text with this separator in between."""
    parts: list[Part] = []
    for text in texts:
        parts += [separator] if parts else []
        parts += get_parts(text)
    return parts


def make_text_of_page_or_terminal(page: str, terminal: str) -> Text:
    """Return a text that may be worded differently on the page and on the terminal."""
    return page if page == terminal else [Span(page, only="page"), Span(terminal, only="terminal")]


def get_page_parts(text: Text) -> list[Part]:
    """Return the parts of a text that a page shows."""
    return [part for part in get_parts(text) if isinstance(part, str) or part.only != "terminal"]


def get_terminal_text(text: Text | None) -> str:
    """Return a text as it is printed on a terminal, without marks; empty for None."""
    parts = [] if text is None else get_parts(text)
    words = [part if isinstance(part, str) else part.text for part in parts
             if isinstance(part, str) or part.only != "page"]
    return "".join(words).replace("\u00a0", " ")


@dataclass(frozen=True)
class Column:
    """Column of a table.

    Attributes:
        heading: heading on the page; None: the page omits the column.
        terminal: heading on the terminal; None: the terminal omits the column.
        text: whether the cells are text, which is left-aligned and may wrap; otherwise they are numbers.
        optional: whether the page omits the column if all its cells are empty.
    """

    heading: Text | None = None
    terminal: str | None = None
    text: bool = False
    optional: bool = False


@dataclass(frozen=True)
class Table:
    """Table of a report.

    Attributes:
        columns: the columns.
        rows: cells of each row in the order of `columns`. None: the cell above extends over this row; on the terminal
            the cell is blank.
        best_row: index of the highlighted row; None: no row is highlighted.
        narrow: whether the table is only as wide as its content.
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[Text | None]]
    best_row: int | None = None
    narrow: bool = False

    def select_page_columns(self) -> Table:
        """Return the table with the columns that a page shows: with a heading, and not optional and empty."""
        return self._select_columns([
            j for j, column in enumerate(self.columns) if column.heading is not None and not (
                column.optional and all(row[j] in (None, "", EMPTY) for row in self.rows))])

    def select_terminal_columns(self) -> Table:
        """Return the table with the columns that a terminal shows."""
        return self._select_columns([j for j, column in enumerate(self.columns) if column.terminal is not None])

    def _select_columns(self, kept: Sequence[int]) -> Table:
        """Return the table with the columns of these indices."""
        return Table([self.columns[j] for j in kept], [[row[j] for j in kept] for row in self.rows], self.best_row,
                     self.narrow)

    def count_rows_of_cell(self, row: int, column: int) -> int:
        """Return the number of rows over which a cell extends: 1 plus the number of None cells below."""
        below = (k for k, later in enumerate(self.rows[row + 1:], 1) if later[column] is not None)
        return next(below, len(self.rows) - row)


@dataclass(frozen=True)
class Figure:
    """Figure of a report, drawn when the page is made.

    Attributes:
        name: name, from which `calibration.output_folder.make_figure_file_name` makes the file name.
        draw: returns the matplotlib figure, or None if there is nothing to draw.
        alt: plain text for readers without images.
        caption: text below the figure.
    """

    name: str
    draw: Callable[[], Any]
    alt: str
    caption: Text = ""


@dataclass(frozen=True)
class DrawnFigure:
    """Figure as an image.

    Attributes:
        source: data URI of the image.
        percent: width, percent of the page.
        alt: plain text for readers without images.
        caption: text below the figure.
    """

    source: str
    percent: float
    alt: str
    caption: Text


@dataclass(frozen=True)
class Paragraph:
    """Paragraph; `quiet`: an explanation in a lighter colour."""

    text: Text
    quiet: bool = False


@dataclass(frozen=True)
class Heading:
    """Heading below the title of a section."""

    text: Text


@dataclass(frozen=True)
class Listing:
    """List of sentences, with bullets or, if `ordered`, with numbers."""

    sentences: Sequence[Text]
    ordered: bool = False


@dataclass(frozen=True)
class Summary:
    """Box at the beginning of a report: terms, each with its lines; a term without lines is omitted."""

    rows: Sequence[tuple[str, Sequence[Text]]]


@dataclass(frozen=True)
class Pasted:
    """Text with its line breaks, to be copied into another document."""

    text: str


@dataclass(frozen=True)
class Details:
    """Content that the reader opens by a click on its summary."""

    summary: Text
    blocks: Sequence[Block]


Block = Table | Figure | DrawnFigure | Paragraph | Heading | Listing | Summary | Pasted | Details
