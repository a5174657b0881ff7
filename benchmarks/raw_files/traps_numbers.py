"""Traps in number formats: thousands separators, decimal marks, encodings, unusual cells and lines."""

from __future__ import annotations

import re

import numpy as np

from benchmarks.raw_files.drafts import Column, Draft
from benchmarks.raw_files.trap import FREE, PLAIN, OnDraft, Trap, change_columns, in_unit, set_decimal

_NUMBERS = frozenset({"numbers"})
_SEPARATOR = ("thousand", "separator", "decimal (mark|point|comma)", "groups? of")
#: The largest value, N, up to which a force is counted in millinewtons.
_SMALL = 30.0
#: A force has thousands in a unit in which its largest value is at least this.
_THOUSANDS = 3000.0


def _large(column: Column, decimals: int, rng: np.random.Generator) -> Column:
    """Return the column in a unit in which its values exceed 1000; displacements with decimals may stay in mm."""
    if column.role == "time":
        return in_unit(column, "s" if decimals else "ms", 2 * decimals)
    if column.role == "displacement":
        return in_unit(column, "mm", 3) if decimals and rng.random() < 0.5 else in_unit(column, "um", decimals)
    if column.role == "force":
        units = [unit for unit in ("N", "mN", "uN")
                 if np.abs(in_unit(column, unit).values).max() >= _THOUSANDS] or ["uN"]
        return in_unit(column, str(rng.choice(units)), decimals)
    return column


def _thousands(mark: str, decimal: str, delimiters: tuple[str, ...], decimals: int) -> OnDraft:
    def apply(draft: Draft, rng: np.random.Generator) -> None:
        set_decimal(draft, decimal, str(rng.choice(delimiters)))
        change_columns(draft, lambda column: _large(column, decimals, rng))
        draft.thousands = mark
        if not mark.isascii():
            draft.encoding = str(rng.choice(("utf-8", "utf-16")))
            if mark == "\u00a0":
                draft.encoding = str(rng.choice(("utf-8", "cp1252")))
    return apply


def _three_decimals(draft: Draft, rng: np.random.Generator) -> None:
    """Write three decimals, which look like a group of thousands."""
    decimal = str(rng.choice((",", ".")))
    set_decimal(draft, decimal, str(rng.choice((";", "\t"))))

    def change(column: Column) -> Column:
        if column.role == "force":
            newtons = in_unit(column, "N")
            return in_unit(column, "mN" if np.abs(newtons.values).max() < _SMALL else "N", 3)
        return in_unit(column, {"time": "s", "displacement": "mm"}.get(column.role, ""), 3)

    change_columns(draft, change)


def _exponents(draft: Draft, rng: np.random.Generator) -> None:
    style = str(rng.choice(("E+", "e", "D+")))

    def change(text: str) -> str:
        number = re.compile(rf"(?<![\w.,])-?\d+[{re.escape(draft.decimal)}]\d+(?![\w.,])" if draft.delimiter != "," else
                            r"(?<![\w.])-?\d+\.\d+(?![\w.])")

        def written(match: re.Match[str]) -> str:
            made = f"{float(match[0].replace(',', '.')):.6e}".replace(".", draft.decimal)
            return made if style == "e" else made.upper() if style == "E+" else made.upper().replace("E", "D")

        lines = text.split("\n")
        start = len(draft.head) + len(draft.sizes)
        return "\n".join([*lines[:start], *(number.sub(written, line) for line in lines[start:])])

    draft.finish.append(change)


def _unicode_minus(draft: Draft, rng: np.random.Generator) -> None:
    draft.encoding = "utf-8"
    draft.finish.append(lambda text: re.sub(r"-(?=\d)", "\u2212", text))


def _units_in_cells(draft: Draft, rng: np.random.Generator) -> None:
    """Write the unit after every number."""
    places = [column.unit for column in draft.tables[0].columns]
    draft.units = "header"

    def change(text: str) -> str:
        made = []
        for line in text.split("\n"):
            cells = line.split(draft.delimiter)
            numeric = len(cells) == len(places) and all(re.fullmatch(r'"?-?[\d.,e+-]+"?', cell) for cell in cells)
            made.append(draft.delimiter.join(f"{cell.strip(chr(34))} {unit}" for cell, unit in zip(cells, places,
                                                                                           strict=True))
                        if numeric else line)
        return "\n".join(made)

    draft.finish.append(change)


def _data_lines(text: str, draft: Draft) -> tuple[list[str], list[int]]:
    """Return all lines, and the indices of the rows of the table."""
    lines = text.split("\n")
    width = len(draft.tables[0].columns)
    return lines, [i for i, line in enumerate(lines) if len(line.split(draft.delimiter)) >= width
                   and re.match(r'"?-?\d', line)]


def _footer(draft: Draft, rng: np.random.Generator) -> None:
    lines = [[["End of test"]], [[], ["Operator", "A. N."], ["Remarks", "no failure"]],
             [["Mean", *["1.0"] * (len(draft.tables[0].columns) - 1)]], [["-" * 20], ["file closed"]]]
    draft.below = lines[int(rng.integers(len(lines)))]


def _repeated_header(draft: Draft, rng: np.random.Generator) -> None:
    """Repeat the header in the middle of the numbers, as after a page break."""
    def change(text: str) -> str:
        lines, rows = _data_lines(text, draft)
        head = lines[rows[0] - (2 if draft.units == "row" else 1):rows[0]]
        middle = rows[len(rows) // 2]
        return "\n".join([*lines[:middle], *head, *lines[middle:]])

    draft.finish.append(change)


def _lost_cells(draft: Draft, rng: np.random.Generator) -> None:
    """Remove the numbers of some cells."""
    word = str(rng.choice(("", "NaN", "---", "#N/A", "overload")))

    def change(text: str) -> str:
        lines, rows = _data_lines(text, draft)
        place = next(i for i, column in enumerate(draft.tables[0].columns) if column.role in ("force", "stress"))
        for row in rng.choice(rows[3:-3], int(rng.integers(1, 4)), replace=False):
            cells = lines[row].split(draft.delimiter)
            cells[place] = word
            lines[row] = draft.delimiter.join(cells)
        return "\n".join(lines)

    draft.finish.append(change)


def _blank_lines(draft: Draft, rng: np.random.Generator) -> None:
    def change(text: str) -> str:
        lines, rows = _data_lines(text, draft)
        for row in sorted(rng.choice(rows[3:-3], 2, replace=False), reverse=True):
            lines.insert(row, "")
        return "\n".join(lines)

    draft.finish.append(change)


def _comma_everywhere(draft: Draft, rng: np.random.Generator) -> None:
    """Write quoted decimal commas in a file delimited by commas."""
    set_decimal(draft, ",", ",")
    draft.quoted = True


def _mixed_marks(draft: Draft, rng: np.random.Generator) -> None:
    """Write sizes with a decimal comma above numbers with a decimal point, or the reverse."""
    draft.delimiter = str(rng.choice((";", "\t")))
    draft.decimal = str(rng.choice((",", ".")))
    other = "," if draft.decimal == "." else "."
    draft.sizes = [[row[0], row[1].replace(",", ".").replace(".", other), *row[2:]] for row in draft.sizes]


def _encoding(*names: str) -> OnDraft:
    def apply(draft: Draft, rng: np.random.Generator) -> None:
        draft.encoding = str(rng.choice(names))
        change_columns(draft, lambda column: in_unit(column, "µm") if column.role == "displacement" else column)
    return apply


def _trap(name: str, apply: OnDraft, reasons: tuple[str, ...] = _SEPARATOR, layouts: tuple[str, ...] = FREE) -> Trap:
    return Trap(name, "numbers", _NUMBERS, reasons, on_draft=apply, layouts=layouts)


#: A message that names the line.
_CELL = (r":\d+:", r"lines? \d+")
NUMBER_TRAPS = (
    _trap("thousands 1,234.5", _thousands(",", ".", ("\t", ";", ","), 1)),
    _trap("thousands 1.234,5", _thousands(".", ",", (";", "\t"), 1)),
    _trap("thousands 1 234,5", _thousands(" ", ",", (";", "\t"), 1)),
    _trap("thousands 1 234,5, no-break space", _thousands("\u00a0", ",", (";", "\t"), 1)),
    _trap("thousands 1 234.5, thin space", _thousands("\u202f", ".", (";", "\t", ","), 1)),
    _trap("thousands 1'234.5", _thousands("'", ".", (";", "\t", ","), 1)),
    _trap("thousands 1’234.5", _thousands("\u2019", ".", (";", "\t"), 1)),
    _trap("thousands 1,234, integers", _thousands(",", ".", ("\t", ";", ","), 0)),
    _trap("thousands 1.234, integers", _thousands(".", ",", (";", "\t"), 0)),
    _trap("thousands 1 234, integers", _thousands(" ", ",", (";", "\t"), 0)),
    _trap("three decimals", _three_decimals),
    _trap("decimal commas in quotes", _comma_everywhere),
    _trap("decimal marks of sizes and numbers differ", _mixed_marks),
    _trap("exponents", _exponents, (*_CELL, "exponent"), PLAIN),
    _trap("unicode minus", _unicode_minus, (*_CELL, "minus"), PLAIN),
    _trap("units in cells", _units_in_cells, (*_CELL, "unit"), PLAIN),
    _trap("footer", _footer, _CELL, PLAIN),
    _trap("repeated header", _repeated_header, _CELL, PLAIN),
    _trap("lost cells", _lost_cells, _CELL, PLAIN),
    _trap("blank lines", _blank_lines, _CELL, PLAIN),
    _trap("UTF-16 or byte order mark", _encoding("utf-16", "utf-16-le", "utf-16-be", "utf-8-sig"), ("encoding",)),
    _trap("8-bit encoding with µ", _encoding("cp1252", "latin-1"), ("encoding", "unit of")),
)
