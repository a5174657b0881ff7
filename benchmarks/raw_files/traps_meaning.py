"""Traps in the meaning of columns: measures, units, signs, second sensors, flags, several tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.raw_files.drafts import FORCES, LENGTHS, Column, Draft, Table
from benchmarks.raw_files.trap import FREE, PLAIN, OnDraft, Trap, change_columns, in_unit
from benchmarks.raw_files.truth import COMPRESSION, SHEAR, TENSION, Test, with_noise

_MEASURE = frozenset({"names", "sizes", "numbers", "history"})
#: Aspects of a file that this kind of trap changes.
_NAMES = frozenset({"names"})
#: Aspects of a file that this kind of trap changes.
_UNITS = frozenset({"names", "units", "numbers"})
_BLOCKS = frozenset({"names", "blocks", "history"})


def _measures(strain_name: str, strain_of: Callable[[np.ndarray], np.ndarray], stress_name: str,
              power: float, strain_units: tuple[str, ...] = ("-", "%")) -> OnDraft:
    """Return strain and stress of a test: stress = nominal stress times stretch to a power."""
    def apply(draft: Draft, rng: np.random.Generator) -> None:
        unit = str(rng.choice(("kPa", "MPa", "Pa", "N/mm2")))
        for table in draft.tables:
            stretch, nominal = draft.test.stretch, draft.test.nominal_stress
            strain_unit = str(rng.choice(strain_units))
            factor = {"-": 1.0, "%": 0.01}[strain_unit]
            scale = {"kPa": 1e3, "MPa": 1e6, "Pa": 1.0, "N/mm2": 1e6}[unit]
            # Machines print compressive strains and stresses with either sign.
            turns = draft.test.kind == COMPRESSION and "tretch" not in strain_name and rng.random() < 0.5
            sign = -1.0 if turns else 1.0
            time = table.column("time")
            table.columns = [*([time] if time is not None and rng.random() < 0.7 else []),
                             Column.of("strain", strain_name, strain_unit, sign * strain_of(stretch) / factor, 6),
                             Column.of("stress", stress_name, unit, sign * nominal * stretch**power / scale, 6)]
        draft.units = "header"
        if rng.random() < 0.5:
            draft.sizes = []
    return apply


def _measure_trap(name: str, apply: OnDraft, reasons: tuple[str, ...]) -> Trap:
    return Trap(name, "meaning", _MEASURE, reasons, on_draft=apply, kinds=(TENSION, COMPRESSION), layouts=("table",))


_TRUE = ("true", "cauchy", "nominal", "hencky", "logarithmic", "green", "piola")


def _stretch(stretch: np.ndarray) -> np.ndarray:
    return stretch


def _engineering(stretch: np.ndarray) -> np.ndarray:
    return stretch - 1


def _green(stretch: np.ndarray) -> np.ndarray:
    return (stretch**2 - 1) / 2


MEASURE_TRAPS = (
    _measure_trap("true stress and true strain", _measures("True strain", np.log, "True stress", 1.0), _TRUE),
    _measure_trap("Cauchy stress over stretch", _measures("Stretch", _stretch, "Cauchy stress", 1.0, ("-",)), _TRUE),
    _measure_trap("Hencky strain", _measures("Hencky strain", np.log, "Engineering stress", 0.0), _TRUE),
    _measure_trap("logarithmic strain", _measures("Logarithmic strain", np.log, "Nominal stress", 0.0), _TRUE),
    _measure_trap("true stress over engineering strain", _measures("Engineering strain", _engineering, "True stress",
                                                                   1.0), _TRUE),
    _measure_trap("Green-Lagrange strain", _measures("Green-Lagrange strain", _green, "Nominal stress", 0.0), _TRUE),
    _measure_trap("second Piola-Kirchhoff stress", _measures("Green strain", _green, "2nd Piola-Kirchhoff stress",
                                                            -1.0), _TRUE),
    _measure_trap("German true measures", _measures("Wahre Dehnung", np.log, "Wahre Spannung", 1.0),
                  (*_TRUE, "wahre")),
    _measure_trap("engineering strain", _measures("Engineering strain", _engineering, "Engineering stress", 0.0),
                  _TRUE),
    _measure_trap("strain and stress", _measures("Strain", _engineering, "Stress", 0.0), _TRUE),
)


def _percent_displacement(draft: Draft, rng: np.random.Generator) -> None:
    """Write the displacement in percent of the height, with a force."""
    height = draft.test.specimen.height(draft.test.kind)

    def change(column: Column) -> Column:
        if column.role != "displacement":
            return column
        return Column.of("strain", column.name, "%", 100 * column.values * LENGTHS[column.unit] / height, 6)

    change_columns(draft, change)


def _percent_as_ratio(draft: Draft, rng: np.random.Generator) -> None:
    """Write a strain in percent under a unit of a ratio."""
    _measures("Strain", _engineering, "Stress", 0.0, ("%",))(draft, rng)
    change_columns(draft, lambda column: replace(column, unit="mm/mm") if column.role == "strain" else column)


def _title_against_stretch(draft: Draft, rng: np.random.Generator) -> None:
    """Add a title of another test than that of the stretches."""
    _measures("Stretch", _stretch, "Nominal stress", 0.0, ("-",))(draft, rng)
    draft.head = [["Tensile test" if draft.test.kind == COMPRESSION else "Compression test"]]


_DENIALS = {COMPRESSION: ("Compression test, not confined", "Compression test without confinement",
                          "Non-confined compression", "Compression test (no bending)"),
            TENSION: ("Uniaxial tension, not planar", "Tensile test without extensometer", "Tension test, not biaxial"),
            SHEAR: ("Simple shear test, not pure shear", "Simple shear test without torsion")}
_REMARKS = ("Remark: peel test of the same batch follows", "Note: specimens for bending are in box 3",
            "Fixture also used for biaxial tension", "Next: torsion series")


def _other_words(draft: Draft, rng: np.random.Generator) -> None:
    """Add words of another test in a denial or in a remark."""
    if rng.random() < 0.5:
        titles = _DENIALS[draft.test.kind]
        draft.head = [[titles[int(rng.integers(len(titles)))]]]
    else:
        draft.head = [*draft.head, [_REMARKS[int(rng.integers(len(_REMARKS)))]]]


def _second_sensor(name: str, unit: str) -> OnDraft:
    """Add a compliant frame to the crosshead displacement, and a second sensor on the specimen."""
    def apply(draft: Draft, rng: np.random.Generator) -> None:
        test, height = draft.test, draft.test.specimen.height(draft.test.kind)
        slack = float(rng.uniform(0.15, 0.5)) * test.motion.max() / np.abs(test.force).max()
        for table in draft.tables:
            own = table.column("displacement")
            values = 100 * test.motion / height if unit == "%" else test.motion / LENGTHS["mm"]
            crosshead = (test.motion + slack * test.force) / LENGTHS[own.unit]
            shown = str(rng.choice(("Crosshead displacement", "Crosshead", "Traverse", own.name)))
            table.columns = [replace(own, name=shown, values=crosshead) if column is own else column
                             for column in table.columns]
            table.columns.append(Column.of("strain" if unit == "%" else "displacement", name, unit, values, 6))
    return apply


def _sensor_trap(name: str, unit: str) -> Trap:
    return Trap(f"{name} and crosshead", "meaning", _MEASURE,
                ("extensometer", "video", "crosshead", "traverse", "two columns"), on_draft=_second_sensor(name, unit),
                kinds=(TENSION,), layouts=("table", "mecmesin"))


def _signs(draft: Draft, rng: np.random.Generator) -> None:
    """Reverse the sign of displacement, of force, or of both."""
    turned = [("displacement",), ("force",), ("displacement", "force")][int(rng.integers(3))]
    change_columns(draft, lambda column: replace(column, values=-column.values) if column.role in turned else column)


def _position(draft: Draft, rng: np.random.Generator) -> None:
    """Write positions of the crosshead, counted from the machine's zero."""
    start = float(rng.uniform(20, 300)) * 1e-3
    sign = float(rng.choice((-1.0, 1.0)))

    def change(column: Column) -> Column:
        if column.role != "displacement":
            return column
        values = start / LENGTHS[column.unit] + sign * (column.values - column.values[0])
        return Column.of("displacement", "Position", column.unit, values, 7)

    change_columns(draft, change)


def _no_units(draft: Draft, rng: np.random.Generator) -> None:
    """Remove all units; in every second file the user states unusual units."""
    units = [{"displacement": "mm", "force": "N", "time": "s"}, {"displacement": "um", "force": "mN", "time": "ms"}][
        int(rng.integers(2))]
    change_columns(draft, lambda column: in_unit(column, units.get(column.role, "")))
    change_columns(draft, lambda column: replace(column, unit=""))


def _contradictory_units(draft: Draft, rng: np.random.Generator) -> None:
    """State one unit in the name of a column and another one in the row of units."""
    draft.units, draft.truths = "row", ()
    role = str(rng.choice(("force", "displacement")))
    wrong = {"force": ("N", "kN"), "displacement": ("mm", "cm")}[role]

    def change(column: Column) -> Column:
        if column.role != role:
            return column
        unit = wrong[1] if column.unit == wrong[0] else wrong[0]
        return replace(column, name=f"{column.name} [{unit}]")

    change_columns(draft, change)


def _impossible_unit(draft: Draft, rng: np.random.Generator) -> None:
    """Write displacements beyond the height of the specimen: micrometres labelled as millimetres."""
    draft.truths = ()
    change_columns(draft, lambda column: replace(in_unit(column, "um"), unit="mm") if column.role == "displacement"
                   else column)


def _time_and_force(draft: Draft, rng: np.random.Generator) -> None:
    """Remove the displacement; the file or a flag states a constant speed."""
    test = draft.test
    for table in draft.tables:
        table.columns = [column for column in table.columns if column.role != "displacement"]
    speed = 1e3 * (test.motion[1] - test.motion[0]) / (test.time[1] - test.time[0])
    if rng.random() < 0.5:
        draft.stated_test["speed_mm_s"] = float(f"{speed:.6g}")
        return
    name, factor, unit = [("Test speed", 60, "mm/min"), ("Speed", 1, "mm/s"), ("Prüfgeschwindigkeit", 60, "mm/min")][
        int(rng.integers(3))]
    draft.sizes = [*draft.sizes, [name, f"{factor * speed:.6g}".replace(".", draft.decimal), unit]]


def _ramp(test: Test, rng: np.random.Generator) -> Test:
    """Return a ramp at a constant speed."""
    depth = test.motion.max()
    points = int(rng.integers(60, 141))
    return test.with_motion(np.linspace(0, depth / float(rng.uniform(0.1e-3, 2e-3)), points),
                            np.linspace(0, depth, points))


def _spare_flag(draft: Draft, rng: np.random.Generator) -> None:
    """State a speed that contradicts time and displacement in the file."""
    draft.stated_test["speed_mm_s"] = round(float(rng.uniform(5, 50)), 2)


def _no_names(draft: Draft, rng: np.random.Generator) -> None:
    """Write numbers only; the user names the columns and their units."""
    draft.head, draft.units = [], "none"
    channels = [column.role for column in draft.tables[0].columns]
    draft.columns_stated = {role: str(i + 1) for i, role in enumerate(channels)}
    draft.units_stated = {column.role: column.unit for column in draft.tables[0].columns}
    draft.stated_kind, draft.stated_sizes, draft.sizes = draft.test.kind, True, []
    names = draft.delimiter.join(column.name for column in draft.tables[0].columns)
    draft.finish.append(lambda text: text.replace('"', "").replace(names + "\n", "").lstrip("\n"))


def _decoys(draft: Draft, rng: np.random.Generator) -> None:
    """Add columns similar to those of the test: set points, peak values, temperature, sample number."""
    own = draft.tables[0].column("displacement")
    force = draft.tables[0].column("force")
    size = own.values.size
    reach = np.abs(own.values).max()
    choices = [Column.of("size", "Command displacement", own.unit, own.values + 0.05 * reach, 6),
               Column.of("size", "Displacement set point", own.unit, np.full(size, reach), 6),
               Column.of("size", "Peak force", force.unit, np.maximum.accumulate(np.abs(force.values)), 6),
               Column.of("size", "Temperature", "°C", 21 + 0.1 * rng.normal(size=size), 4),
               Column("size", "Sample", "", np.arange(size, dtype=float), 0)]
    draft.encoding = "utf-8"
    for table in draft.tables:
        picked = [choices[i] for i in rng.choice(len(choices), 2, replace=False)]
        table.columns = [picked[0], *table.columns, picked[1]]


def _clock(draft: Draft, rng: np.random.Generator) -> None:
    """Write times of day."""
    seconds = draft.test.time + float(rng.uniform(3e4, 8e4))
    place = [column.role for column in draft.tables[0].columns].index("time")

    def change(text: str) -> str:
        lines, written = [], {}
        column = draft.tables[0].columns[place]
        for value, second in zip(column.values, seconds, strict=True):
            hours, rest = divmod(second, 3600)
            minutes, left = divmod(rest, 60)
            written[draft.number(value, column.decimals)] = f"{int(hours):02d}:{int(minutes):02d}:{left:06.3f}"
        for line in text.split("\n"):
            cells = line.split(draft.delimiter)
            if len(cells) == len(draft.tables[0].columns) and cells[place].strip('"') in written:
                cells[place] = written[cells[place].strip('"')]
            lines.append(draft.delimiter.join(cells))
        return "\n".join(lines)

    draft.finish.append(change)


def _more_tables(draft: Draft, rng: np.random.Generator, factors: list[float], titles: list[str]) -> None:
    """Add tables of further specimens of the same sizes with other moduli."""
    first, tests = draft.tables[0], []
    noise = 2e-3
    for factor in factors:
        stiff = replace(draft.test, mu=draft.test.mu * factor)
        tests.append(with_noise(stiff.with_motion(draft.test.time, draft.test.motion), rng, noise))
    own = first.column("force")
    sign = -1.0 if np.sum(own.values * draft.test.force) < 0 else 1.0
    draft.tables = [Table([replace(column, values=sign * test.force / FORCES[column.unit]) if column is own else column
                           for column in first.columns], title) for test, title in zip(tests, titles, strict=True)]


def _blocks(titles: tuple[tuple[str, ...], ...], alike: bool, split: bool) -> OnDraft:
    def apply(draft: Draft, rng: np.random.Generator) -> None:
        names = list(titles[int(rng.integers(len(titles)))])
        stiffer = float(rng.uniform(1.3, 4.0))
        factors = [1.0 + 0.01 * float(rng.normal()) if alike else stiffer**i for i in range(len(names))]
        _more_tables(draft, rng, factors, names)
        draft.truths = (draft.test.mu,) if alike else ()
        draft.split, draft.side_by_side = split, not split and bool(rng.random() < 0.5)
    return apply


_REPLICATES = (("Specimen 1", "Specimen 2", "Specimen 3"), ("gel 1", "gel 2"), ("Probe 1", "Probe 2", "Probe 3"),
               ("sample A rep 1", "sample A rep 2"))
_MATERIALS = (("soft gel", "stiff gel"), ("Ecoflex 00-10", "Ecoflex 00-30", "Dragon Skin 10"), ("liver", "kidney"),
              ("agar 1 %", "agar 2 %"), ("control", "treated"))
_BLOCK_REASONS = ("(different|several|two|three|\\d) (material|specimen)s?", "replicate", "one by one", "disagree",
                  "titled")

MEANING_TRAPS = (
    *MEASURE_TRAPS,
    Trap("displacement in percent", "meaning", _NAMES, ("percent", "in %", "relative to the height"),
         on_draft=_percent_displacement, kinds=(COMPRESSION, TENSION), layouts=("table",)),
    Trap("percent under mm/mm", "meaning", _MEASURE, ("percent", "unit of", "in %", "strain of"), False,
         on_draft=_percent_as_ratio, kinds=(TENSION, COMPRESSION), layouts=("table",)),
    Trap("title against the stretch", "meaning", _MEASURE, ("kind of test", "compression", "tension"),
         on_draft=_title_against_stretch, kinds=(TENSION, COMPRESSION), layouts=("table",)),
    Trap("words of other tests", "meaning", frozenset({"title"}),
         ("kind of test", "confine", "bend", "planar", "pure shear", "biaxial", "peel", "torsion"),
         on_draft=_other_words, layouts=("table",)),
    _sensor_trap("Extensometer", "mm"), _sensor_trap("Video strain", "%"), _sensor_trap("Extensometer strain", "%"),
    Trap("turned signs", "meaning", _NAMES, ("sign",), on_draft=_signs),
    Trap("positions of the machine", "meaning", _NAMES | {"zero"}, ("sign", "zero", "position"), on_draft=_position,
         layouts=("table", "mecmesin")),
    Trap("no units", "meaning", _UNITS, ("unit",), False, on_draft=_no_units, layouts=("table", "mts", "bluehill")),
    Trap("contradictory units", "meaning", _UNITS, ("unit",), False, on_draft=_contradictory_units, layouts=FREE),
    Trap("displacements beyond the specimen", "meaning", _UNITS, ("unit", "deeper", "beyond", "higher than"), False,
         on_draft=_impossible_unit, kinds=(COMPRESSION,), layouts=FREE),
    Trap("time and force at a stated speed", "meaning", frozenset({"names", "history", "blocks", "flags"}),
         ("speed",), on_test=_ramp, on_draft=_time_and_force, layouts=PLAIN),
    Trap("a flag that is not needed", "meaning", frozenset({"flags"}), ("speed",), False, note="speed",
         on_draft=_spare_flag),
    Trap("no names of columns", "meaning", _MEASURE, ("column",), on_draft=_no_names, layouts=("table",)),
    Trap("columns that look alike", "meaning", _NAMES, ("which column", "two columns", "set point", "command"),
         on_draft=_decoys, layouts=FREE),
    Trap("times of the day", "meaning", frozenset({"names", "numbers"}), ("time of day", "times of the day", "clock"),
         on_draft=_clock, layouts=PLAIN),
    Trap("replicates in one file", "meaning", _BLOCKS, _BLOCK_REASONS, on_draft=_blocks(_REPLICATES, True, False),
         layouts=PLAIN),
    Trap("replicates in several files", "meaning", _BLOCKS, _BLOCK_REASONS, on_draft=_blocks(_REPLICATES, True, True),
         layouts=PLAIN),
    Trap("materials in one file", "meaning", _BLOCKS, _BLOCK_REASONS, False,
         on_draft=_blocks(_MATERIALS, False, False), layouts=PLAIN),
    Trap("materials in several files", "meaning", _BLOCKS, _BLOCK_REASONS, False,
         on_draft=_blocks(_MATERIALS, False, True), layouts=PLAIN),
)
