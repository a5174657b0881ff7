"""Traps in the sizes of the specimen: their position in the file, their names, and contradictions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.raw_files.drafts import SIZE_WORDS, Column, Draft, size_rows
from benchmarks.raw_files.trap import PLAIN, OnDraft, Trap
from benchmarks.raw_files.truth import COMPRESSION, SHEAR, TENSION

_SIZES = frozenset({"sizes"})
#: That a size is missing is no true reason: the file states it.
_REASONS = ("unit of the", "without a unit", "ambiguous", "contradict", "read as", "states")
_CONTRADICTION = ("contradict", "disagree", "differs? from", "size of the specimen .* or ",
                  "two (diameters|heights|sizes|values|radii|lengths)", "twice")


def _mm(value: float, draft: Draft) -> str:
    return f"{1e3 * value:.4g}".replace(".", draft.decimal)


def _pairs(draft: Draft) -> list[tuple[str, str]]:
    """Return name and value of each size, mm."""
    return [(row[0], row[1]) for row in size_rows(draft)]


def _below(draft: Draft, rng: np.random.Generator) -> None:
    draft.below = [[], *size_rows(draft)]
    draft.sizes = []


def _second_table(above: bool) -> OnDraft:
    def apply(draft: Draft, rng: np.random.Generator) -> None:
        pairs = _pairs(draft)
        table = [["Specimen", *(f"{name} (mm)" for name, _ in pairs)], ["1", *(number for _, number in pairs)]]
        if above:
            draft.sizes = table
        else:
            draft.sizes, draft.below = [], [[], ["Results"], *table]
    return apply


def _constant_columns(draft: Draft, rng: np.random.Generator) -> None:
    for table in draft.tables:
        length = table.columns[0].values.size
        for name, number in _pairs(draft):
            value = float(number.replace(",", "."))
            table.columns.append(Column("size", name, "mm", np.full(length, value), 2))
    draft.sizes = []


def _sentence(draft: Draft, rng: np.random.Generator) -> None:
    start = str(rng.choice(("Specimen dimensions: ", "Specimen: ", "Sample geometry: ")))
    draft.sizes = [[start + ", ".join(f"{name.lower()} {number} mm" for name, number in _pairs(draft))]]


def _symbol(draft: Draft, rng: np.random.Generator) -> None:
    specimen = draft.test.specimen
    draft.encoding = "utf-8"
    draft.sizes = [[f"Specimen Ø {_mm(specimen.diameter, draft)} mm x {_mm(specimen.length, draft)} mm"]]


def _instead_of_diameter(name: str, factor: float, power: int = 1, unit: str = "mm") -> OnDraft:
    """State another size of the circle: factor times diameter to a power."""
    def apply(draft: Draft, rng: np.random.Generator) -> None:
        rows = size_rows(draft)
        value = factor * (1e3 * draft.test.specimen.diameter) ** power
        rows[0] = [name, f"{value:.6g}".replace(".", draft.decimal), unit]
        draft.sizes = rows
    return apply


def _area(draft: Draft, rng: np.random.Generator) -> None:
    """State the cross-section instead of width and thickness."""
    rows, specimen = size_rows(draft), draft.test.specimen
    area = f"{1e6 * specimen.width * specimen.thickness:.6g}".replace(".", draft.decimal)
    draft.sizes = [["Cross-sectional area", area, "mm²"], rows[2]]
    draft.encoding = str(rng.choice(("utf-8", "cp1252")))


def _unit_in_name(draft: Draft, rng: np.random.Generator) -> None:
    draft.sizes = [[f"{name} [mm]", number] for name, number in _pairs(draft)]


def _short_names(draft: Draft, rng: np.random.Generator) -> None:
    names = {"Diameter": "Diam.", "Height": "Initial height h0", "Durchmesser": "Probendurchmesser d0",
             "Höhe": "Probenhöhe h0"}
    draft.sizes = [[f"{names[name]} [mm]", number] for name, number in _pairs(draft)]


def _other_units(draft: Draft, rng: np.random.Generator) -> None:
    unit, factor = [("cm", 0.1), ("in", 1 / 25.4), ("µm", 1e3)][int(rng.integers(3))]
    draft.sizes = [[name, f"{float(number.replace(',', '.')) * factor:.6g}".replace(".", draft.decimal), unit]
                   for name, number in _pairs(draft)]
    draft.encoding = "utf-8"


def _no_unit(draft: Draft, rng: np.random.Generator) -> None:
    draft.sizes = [[name, number] for name, number in _pairs(draft)]


def _tool_decoy(draft: Draft, rng: np.random.Generator) -> None:
    """State sizes of the machine above those of the specimen."""
    rows = [["Probe diameter", f"{75}", "mm"], ["Platen diameter", f"{100}", "mm"], ["Load cell height", "40", "mm"]]
    draft.sizes = [rows[int(rng.integers(3))], *draft.sizes]


def _final_decoy(draft: Draft, rng: np.random.Generator) -> None:
    """State the size after the test below the size before it."""
    name, number = _pairs(draft)[-1]
    after = f"{0.7 * float(number.replace(',', '.')):.4g}".replace(".", draft.decimal)
    draft.sizes = [*draft.sizes, [f"Final {name.lower()}", after, "mm"]]


def _contradiction(draft: Draft, rng: np.random.Generator) -> None:
    """State another value of a size at a second position."""
    pairs = _pairs(draft)
    place = int(rng.integers(len(pairs)))
    name, number = pairs[place]
    other = f"{float(number.replace(',', '.')) * rng.uniform(1.3, 2.0):.4g}".replace(".", draft.decimal)
    draft.truths = ()
    if rng.random() < 0.5:
        draft.below = [[], [name, other, "mm"]]
    else:
        draft.sizes = [*draft.sizes, [name, other, "mm"]]


def _radius_contradiction(draft: Draft, rng: np.random.Generator) -> None:
    """State a radius that is not half of the diameter."""
    other = f"{1e3 * draft.test.specimen.diameter * rng.uniform(0.65, 0.9):.4g}".replace(".", draft.decimal)
    draft.sizes, draft.truths = [*draft.sizes, ["Radius", other, "mm"]], ()


def _several_specimens(draft: Draft, rng: np.random.Generator) -> None:
    """State the sizes of three specimens in a table; the file is the recording of one."""
    pairs = _pairs(draft)
    rows = [[str(i + 1), *(f"{float(number.replace(',', '.')) * factor:.4g}".replace(".", draft.decimal)
                           for _, number in pairs)] for i, factor in enumerate((1.0, 1.2, 0.85))]
    draft.sizes, draft.truths = [["Specimen", *(f"{name} (mm)" for name, _ in pairs)], *rows], ()


def _french(draft: Draft, rng: np.random.Generator) -> None:
    words = {"Diameter": "Diamètre", "Height": "Hauteur", "Width": "Largeur", "Thickness": "Épaisseur",
             "Gauge length": "Longueur initiale", "Length": "Longueur"}
    draft.sizes = [[words.get(name, name), number, "mm"] for name, number in _pairs(draft)]
    draft.encoding = str(rng.choice(("utf-8", "cp1252")))


def _german(draft: Draft, rng: np.random.Generator) -> None:
    other = replace(draft, language="de")
    draft.sizes = [[f"Proben{row[0].lower()}" if row[0] in SIZE_WORDS["de"].values() else row[0], *row[1:]]
                   for row in size_rows(other)]
    draft.encoding = str(rng.choice(("utf-8", "cp1252")))


#: Tests with a round cross-section.
_ROUND = (COMPRESSION,)
#: Tests with a rectangular cross-section.
_FLAT = (TENSION,)


def _trap(name: str, apply: OnDraft, kinds: tuple[str, ...] = (COMPRESSION, TENSION, SHEAR), *,
          wants_right: bool = True, reasons: tuple[str, ...] = _REASONS) -> Trap:
    return Trap(name, "sizes", _SIZES, reasons, wants_right, on_draft=apply, kinds=kinds, layouts=PLAIN)


SIZE_TRAPS = (
    _trap("sizes below the table", _below),
    _trap("sizes in a table above", _second_table(True)),
    _trap("sizes in a table below", _second_table(False)),
    _trap("sizes in constant columns", _constant_columns),
    _trap("sizes in a sentence", _sentence),
    _trap("sizes with the sign of a diameter", _symbol, _ROUND),
    _trap("radius", _instead_of_diameter("Radius", 0.5), _ROUND),
    _trap("circumference", _instead_of_diameter("Circumference", np.pi), _ROUND),
    _trap("area of a cylinder", _instead_of_diameter("Area", np.pi / 4, 2, "mm2"), _ROUND),
    _trap("cross-section of a strip", _area, _FLAT),
    _trap("units in the names of sizes", _unit_in_name),
    _trap("short names of sizes", _short_names, _ROUND),
    _trap("sizes in other units", _other_units),
    _trap("sizes without a unit", _no_unit, wants_right=False, reasons=(*_REASONS, "unit")),
    _trap("sizes of the machine", _tool_decoy, _ROUND),
    _trap("final size", _final_decoy),
    _trap("French names of sizes", _french),
    _trap("German names of sizes", _german),
    _trap("contradictory sizes", _contradiction, wants_right=False, reasons=_CONTRADICTION),
    _trap("contradictory radius", _radius_contradiction, _ROUND, wants_right=False, reasons=_CONTRADICTION),
    _trap("sizes of several specimens", _several_specimens, wants_right=False,
          reasons=(*_CONTRADICTION, "several", "the (radius|cross-section|height|gauge length|thickness)")),
)
