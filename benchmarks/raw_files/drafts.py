"""Drafts of raw files: tables of a test with lines, names, units, number formats, and their text."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.raw_files.truth import COMPRESSION, SHEAR, TENSION, Test

#: SI units in one of the file.
LENGTHS = {"mm": 1e-3, "um": 1e-6, "µm": 1e-6, "cm": 1e-2, "m": 1.0, "in": 0.0254, "-": 1.0}
FORCES = {"N": 1.0, "kN": 1e3, "mN": 1e-3, "uN": 1e-6, "g": 9.80665e-3, "gf": 9.80665e-3, "lbf": 4.4482216152605}
TIMES = {"s": 1.0, "sec": 1.0, "Sec": 1.0, "min": 60.0, "ms": 1e-3}
STRESSES = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "N/mm2": 1e6}
RATIOS = {"-": 1.0, "%": 0.01, "mm/mm": 1.0}

#: Words of a title by kind of test and language.
TITLES = {
    COMPRESSION: {"en": ("Compression test", "Unconfined compression", "Uniaxial compression test"),
                  "de": ("Druckversuch",)},
    TENSION: {"en": ("Tensile test", "Uniaxial tension", "Tension test"), "de": ("Zugversuch",)},
    SHEAR: {"en": ("Simple shear test", "Shear test"), "de": ("Scherversuch",)},
}
SIZE_WORDS = {
    "en": {"diameter": "Diameter", "length": "Height", "gauge": "Gauge length", "width": "Width",
           "thickness": "Thickness", "side": "Length"},
    "de": {"diameter": "Durchmesser", "length": "Höhe", "gauge": "Messlänge", "width": "Breite",
           "thickness": "Dicke", "side": "Länge"},
}


@dataclass
class Column:
    """One column: `values` in `unit`, printed with `decimals`; negative `decimals` are significant digits."""

    role: str
    name: str
    unit: str
    values: np.ndarray
    decimals: int = -7

    @classmethod
    def of(cls, role: str, name: str, unit: str, values: np.ndarray, digits: int = 5) -> Column:
        """Return a column with the number of decimals at which the largest value has `digits` digits."""
        largest = float(np.nanmax(np.abs(values))) or 1.0
        return cls(role, name, unit, values, max(digits - 1 - int(np.floor(np.log10(largest))), 0))


@dataclass
class Table:
    """Columns below one header, and the lines above it."""

    columns: list[Column]
    title: str = ""

    def column(self, role: str) -> Column | None:
        return next((column for column in self.columns if column.role == role), None)


@dataclass
class Draft:
    """Raw file before it becomes text; traps change the draft.

    Attributes:
        test: of the first table. tests: one for each table. layout: name. language: ``en`` or ``de``.
        head: rows of cells above the sizes. sizes: rows (name, number, unit). below: rows under the tables.
        delimiter, decimal, thousands, encoding, newline: of the text. quoted: whether all cells are.
        units: ``header``, ``row`` or ``none``.
        side_by_side: whether the columns of all tables are adjacent. split: whether each is a separate file.
        name: of the file. stated_kind, stated_sizes, stated_test: flags that the user gives.
        columns_stated, units_stated: columns and units that the user names.
        truths: moduli, Pa, that a sound program may report. finish: changes of the text, in order.
    """

    test: Test
    layout: str
    language: str
    head: list[list[str]]
    sizes: list[list[str]]
    tables: list[Table]
    delimiter: str
    decimal: str
    units: str
    below: list[list[str]] = field(default_factory=list)
    thousands: str = ""
    encoding: str = "utf-8"
    newline: str = "\n"
    quoted: bool = False
    side_by_side: bool = False
    split: bool = False
    name: str = "specimen.csv"
    stated_kind: str | None = None
    stated_sizes: bool = False
    stated_test: dict[str, float] = field(default_factory=dict)
    columns_stated: dict[str, str] = field(default_factory=dict)
    units_stated: dict[str, str] = field(default_factory=dict)
    truths: tuple[float, ...] = ()
    finish: list[Callable[[str], str]] = field(default_factory=list)

    def number(self, value: float, decimals: int) -> str:
        """Format a number; empty for a value that is not finite."""
        if not np.isfinite(value):
            return ""
        text = f"{value:.{decimals}f}" if decimals >= 0 else f"{value:.{-decimals}g}"
        if "e" in text:
            return text.replace(".", self.decimal)
        whole, point, rest = text.partition(".")
        if self.thousands:
            digits = whole.lstrip("-")
            start = len(digits) % 3
            groups = [digits[:start]] * bool(start) + [digits[i:i + 3] for i in range(start, len(digits), 3)]
            whole = "-" * whole.startswith("-") + self.thousands.join(groups)
        return whole + (self.decimal if point else "") + rest

    def row(self, cells: list[str]) -> str:
        """Format one line; cells that contain the delimiter are quoted."""
        return self.delimiter.join(f'"{cell}"' if cell and (self.quoted or self.delimiter in cell) else cell
                                   for cell in cells)

    def table_rows(self, tables: list[Table]) -> list[list[str]]:
        """Return names, units and numbers of tables with adjacent columns."""
        columns = [column for table in tables for column in table.columns]
        names = [f"{each.name} ({each.unit})" if self.units == "header" and each.unit else each.name
                 for each in columns]
        rows = [names]
        if self.units == "row":
            rows.append([f"({each.unit})" if self.quoted else each.unit for each in columns])
        longest = max(each.values.size for each in columns)
        for i in range(longest):
            rows.append([self.number(each.values[i], each.decimals) if i < each.values.size else ""
                         for each in columns])
        return rows

    def text(self, tables: list[Table]) -> str:
        rows = [*self.head, *self.sizes, []]
        if self.side_by_side:
            titles = [cell for table in tables for cell in [table.title, *[""] * (len(table.columns) - 1)]]
            rows += [titles, *self.table_rows(tables)]
        else:
            for table in tables:
                rows += [[table.title]] * bool(table.title) + self.table_rows([table]) + [[]] * (len(tables) > 1)
        text = "\n".join(self.row(row) for row in [*rows, *self.below]) + "\n"
        for change in self.finish:
            text = change(text)
        return text

    def files(self) -> dict[str, bytes]:
        """Return the content of all files by name."""
        groups = [[table] for table in self.tables] if self.split else [self.tables]
        found = {}
        for group in groups:
            _, dot, end = self.name.rpartition(".")
            name = f"{group[0].title.replace(' ', '_')}{dot}{end}" if self.split else self.name
            shown = [replace(table, title="") for table in group] if self.split else group
            text = self.text(shown).replace("\n", self.newline)
            found[name] = text.encode(self.encoding, errors="replace")
        return found

    def specimen_flags(self) -> dict[str, float]:
        """Return the sizes as the user states them, mm and mm2."""
        specimen, kind = self.test.specimen, self.test.kind
        across = {"radius_mm": 500 * specimen.diameter} if specimen.is_cylinder else {
            "area_mm2": 1e6 * specimen.area(kind)}
        return {key: round(value, 9) for key, value in (across | {"height_mm": 1e3 * specimen.height(kind)}).items()}


@dataclass(frozen=True)
class Layout:
    """File layout of a test machine.

    Attributes:
        head: rows, with ``{title}`` for the kind of test; none names it where ``{title}`` is absent.
        names: kind of test -> names of time, displacement and force.
        units: where they stand. delimiters, encodings: of which one is drawn. sign: of compression.
        forces, lengths, times: units that it may write. order: whether columns may change places.
        states_sizes: whether the file has lines with the sizes. suffix: of the file.
    """

    head: tuple[str, ...]
    names: dict[str, tuple[str, str, str]]
    units: str
    delimiters: tuple[str, ...]
    encodings: tuple[str, ...]
    forces: tuple[str, ...] = ("N", "mN")
    lengths: tuple[str, ...] = ("mm",)
    times: tuple[str, ...] = ("s",)
    sign: int = 1
    language: str = "en"
    states_sizes: bool = True
    quoted: bool = False
    suffix: str = "csv"


_PLAIN = ("Time", "Displacement", "Force")
LAYOUTS = {
    "table": Layout(("{title}",), {COMPRESSION: _PLAIN, TENSION: _PLAIN, SHEAR: _PLAIN}, "header",
                    (",", ";", "\t"), ("utf-8", "utf-8-sig", "cp1252", "utf-16"), ("N", "mN", "kN", "gf"),
                    ("mm", "um", "cm"), ("s", "ms", "min")),
    "bluehill": Layout(("Bluehill RawData", "Test Method|{title}.im"),
                       {COMPRESSION: ("Time", "Extension", "Load"), TENSION: ("Time", "Tensile extension", "Load"),
                        SHEAR: ("Time", "Extension", "Load")},
                       "row", (",", ";"), ("utf-8", "cp1252", "utf-16"), ("N", "kN", "lbf"), ("mm", "in"), sign=-1,
                       quoted=True),
    "mts": Layout(("MTS793|MPT|ENU|1|2|.|/|:|1|0|0|A", "{title}"),
                  dict.fromkeys((COMPRESSION, TENSION, SHEAR), ("Running Time", "Axial Displacement", "Axial Force")),
                  "row", ("\t",), ("utf-8", "utf-8-sig"), ("N", "kN", "mN"), ("mm", "cm"), ("Sec",), sign=-1,
                  suffix="dat"),
    "zwick": Layout(("testXpert III", "Prüfnorm|{title}"),
                    dict.fromkeys((COMPRESSION, TENSION, SHEAR), ("Prüfzeit", "Standardweg", "Standardkraft")),
                    "row", (";", "\t"), ("cp1252", "latin-1", "utf-8", "utf-16-le"), ("N", "mN"), ("mm", "µm"),
                    language="de", suffix="TRA"),
    "exponent": Layout(("Texture Exponent 32",),
                       dict.fromkeys((COMPRESSION, TENSION), ("Time", "Distance", "Force")), "header", ("\t", ","),
                       ("utf-8", "cp1252"), ("g", "N"), times=("sec",), states_sizes=False, suffix="txt"),
    "mach1": Layout(("<Mach-1 File>", "<Stress Relaxation>", "<DATA>"),
                    {COMPRESSION: ("Time, s", "Position (z), mm", "Fz, {force}")}, "none", ("\t",),
                    ("utf-8", "utf-16"), ("gf", "N"), sign=-1, states_sizes=False, suffix="txt"),
    "mecmesin": Layout(("Mecmesin VectorPro", "Test|{title}"),
                       dict.fromkeys((COMPRESSION, TENSION, SHEAR), ("Time", "Displacement", "Load")), "header",
                       (",", ";"), ("utf-8", "latin-1", "utf-8-sig"), ("N", "mN", "lbf"), ("mm", "cm", "in")),
    "trios": Layout(("Filename|gel.tri", "Instrument name|DHR-3", "Procedure name|Axial compression", "[step]",
                     "Axial - 1"), {COMPRESSION: ("Time", "Gap", "Axial force")}, "row", ("\t",),
                    ("utf-16", "utf-8"), ("N",), ("um", "mm"), states_sizes=False, suffix="txt"),
}


def size_rows(draft: Draft) -> list[list[str]]:
    """Return one row for each size: name, number, unit."""
    words, specimen, kind = SIZE_WORDS[draft.language], draft.test.specimen, draft.test.kind
    if specimen.is_cylinder:
        pairs = [("diameter", specimen.diameter), ("length", specimen.length)]
    elif kind == SHEAR:
        pairs = [("side", specimen.length), ("width", specimen.width), ("thickness", specimen.thickness)]
    else:
        pairs = [("width", specimen.width), ("thickness", specimen.thickness), ("gauge", specimen.length)]
    return [[words[key], f"{1e3 * value:.4g}".replace(".", draft.decimal), "mm"] for key, value in pairs]


def draw_layout(test: Test, rng: np.random.Generator) -> str:
    """Draw a layout that supports the kind of test."""
    return str(rng.choice([name for name, layout in LAYOUTS.items() if test.kind in layout.names]))


def make_draft(test: Test, name: str, rng: np.random.Generator) -> Draft:
    """Return the file of a test in a layout, with random unit, order, delimiter, decimal mark and encoding."""
    layout = LAYOUTS[name]
    delimiter = str(rng.choice(layout.delimiters))
    german = layout.language == "de" or delimiter == ";"
    decimal = "," if german and delimiter != "," and name != "mts" and rng.random() < 0.7 else "."
    title = str(rng.choice(TITLES[test.kind][layout.language]))
    head = [line.replace("{title}", title).split("|") if name != "mts" or "{" in line else [line]
            for line in layout.head]
    draft = Draft(test, name, layout.language, head, [], [], delimiter, decimal, layout.units,
                  encoding=str(rng.choice(layout.encodings)), quoted=layout.quoted, name=f"specimen.{layout.suffix}",
                  newline="\r\n" if rng.random() < 0.3 else "\n", truths=(test.mu,))
    draft.tables = [make_table(test, layout, rng)]
    draft.stated_kind = None if any("{title}" in line for line in layout.head) or name == "trios" else test.kind
    draft.stated_sizes = not layout.states_sizes
    if layout.states_sizes:
        draft.sizes = size_rows(draft)
    return draft


def make_table(test: Test, layout: Layout, rng: np.random.Generator) -> Table:
    """Return time, displacement and force in the layout of a machine."""
    time, length, force = (str(rng.choice(units)) for units in (layout.times, layout.lengths, layout.forces))
    sign = layout.sign if test.kind == COMPRESSION else 1
    names = [each.replace("{force}", force) for each in layout.names[test.kind]]
    motion = sign * test.motion
    if layout.names[test.kind][1] == "Gap":
        motion = 1.2 * test.specimen.length - test.motion
    elif "Position" in names[1]:
        motion = test.motion + 12.3e-3
    digits = int(rng.integers(5, 8))
    columns = [Column.of("time", names[0], time, test.time / TIMES[time], 6),
               Column.of("displacement", names[1], length, motion / LENGTHS[length], digits),
               Column.of("force", names[2], force, sign * test.force / FORCES[force], digits)]
    if layout.units == "none":
        columns = [replace(column, unit="") for column in columns]
    order = rng.permutation(3) if rng.random() < 0.3 else np.arange(3)
    return Table([columns[i] for i in order])
