"""Files as test machines write them, made of one known compression or pull, in the orders, units, decimal marks and
encodings that laboratories have. The layouts are those of published exports and of the programs that read them; see
`tissue_sim.recording.formats.vocabulary`."""

import io
from dataclasses import dataclass

import numpy as np
import openpyxl
import xlwt

#: SI units in one of the file.
LENGTH = {"mm": 1e-3, "um": 1e-6, "µm": 1e-6, "cm": 1e-2, "m": 1.0, "in": 0.0254}
FORCE = {"N": 1.0, "kN": 1e3, "mN": 1e-3, "g": 9.80665e-3, "gf": 9.80665e-3, "lbf": 4.4482216152605}
TIME = {"s": 1.0, "sec": 1.0, "Sec": 1.0, "min": 60.0, "ms": 1e-3}


@dataclass(frozen=True)
class Export:
    """A file, and the truth: `curves` of (time, displacement, force), SI, positive under load."""

    machine: str
    name: str
    content: bytes
    kind: str | None
    curves: tuple


def curve(seed, hold=False, points=61):
    """A gel pressed at 0.5 mm/s to 3 mm, with noise, back again or held; time, displacement, force."""
    rng = np.random.default_rng(seed)
    time = 0.1 * np.arange(2 * points - 1)
    way = np.minimum(0.5e-3 * time, 3e-3)
    if not hold:
        way = np.where(time > time[points - 1], way[points - 1] - 0.5e-3 * (time - time[points - 1]), way)
    force = 2.0 * (way / 3e-3) ** 1.4 * (1 + 0.05 * seed) + rng.normal(0, 2e-3, time.size)
    return time, way, force


def number(value, comma, digits=7):
    return f"{value:.{digits}g}".replace(".", ",") if comma else f"{value:.{digits}g}"


def table(columns, delimiter, comma, quote=""):
    return "".join(delimiter.join(quote + number(v, comma) + quote for v in row) + "\n"
                   for row in zip(*columns, strict=True))


def ordered(order, *things):
    return [things[i] for i in order]


def bluehill(seed, order=(0, 1, 2), length="mm", force="N", comma=False, encoding="utf-8", words=False, newline="\n"):
    """Raw data of Bluehill: parameters, names, units in brackets below; negative under compression unless the columns
    say compressive."""
    time, way, load = curve(seed)
    sign = 1 if words else -1
    mark = ";" if comma else ","
    names = ordered(order, "Time", *(("Compressive extension", "Compressive load") if words else ("Extension", "Load")))
    units = ordered(order, "(s)", f"({length})", f"({force})")
    values = ordered(order, time, sign * way / LENGTH[length], sign * load / FORCE[force])
    text = (f"Bluehill RawData\n\"Specimen label : gel {seed}\"\nTest Method{mark}Compression.im_comp\n\n"
            + mark.join(f'"{name}"' for name in names) + "\n" + mark.join(f'"{unit}"' for unit in units) + "\n"
            + table(values, mark, comma, '"'))
    return Export("bluehill", f"Specimen_RawData_{seed}.csv", text.replace("\n", newline).encode(encoding),
                  "lubricated_compression", ((time, way, load),))


def mts(seed, order=(0, 1, 2), length="mm", force="N", comma=False, encoding="utf-8", parts=1):
    """MTS 793: its own first line with the decimal mark in it, then blocks of names, units and numbers."""
    time, way, load = curve(seed, hold=True)
    language = "DEU|1|2|,|.|:" if comma else "ENU|1|2|.|/|:"
    text = f"MTS793|MPT|{language}|1|0|0|A\n\n"
    for piece in np.array_split(np.arange(time.size), parts):
        text += f"Data Acquisition\t\t\tTime:\t{number(time[piece[-1]], comma)}\tSec\n"
        text += "\t".join(ordered(order, "Running Time", "Axial Displacement", "Axial Force")) + "\n"
        text += "\t".join(ordered(order, "Sec", length, force)) + "\n"
        text += table(ordered(order, time[piece], -way[piece] / LENGTH[length], -load[piece] / FORCE[force]), "\t",
                      comma) + "\n"
    return Export("mts", f"specimen_{seed}.dat", text.encode(encoding), "lubricated_compression", ((time, way, load),))


def zwick_rows(seed, order, length, force, comma):
    time, way, load = curve(seed)
    names = ordered(order, "Prüfzeit", "Standardweg", "Standardkraft")
    units = ordered(order, "s", length, force)
    return names, units, ordered(order, time, way / LENGTH[length], load / FORCE[force]), (time, way, load)


def zwick_text(seed, order=(0, 1, 2), length="mm", force="N", comma=True, encoding="cp1252"):
    names, units, values, truth = zwick_rows(seed, order, length, force, comma)
    text = ("testXpert III\nPrüfnorm;Druckversuch\nProbendurchmesser;20,0;mm\n"
            + ";".join(names) + "\n" + ";".join(units) + "\n" + table(values, ";", comma))
    return Export("zwick", f"Probe_{seed}.TRA", text.encode(encoding), "lubricated_compression", (truth,))


def zwick_book(seeds, order=(0, 1, 2), length="mm", force="N", old=False, title="Probe"):
    """A workbook: parameters, results, then a sheet a specimen with names and units; xls of old, else xlsx."""
    sheets = [("Parameter", [["Prüfer", "A. N."], ["Prüfart", "Druckversuch"]]),
              ("Ergebnisse", [["Probe", "Fmax"], ["", "N"], [1, 2.0], [2, 2.1]])]
    curves = []
    for seed in seeds:
        names, units, values, truth = zwick_rows(seed, order, length, force, False)
        sheets.append((f"{title} {seed}", [[f"{title} {seed}"], names, units, *map(list, zip(*values, strict=True))]))
        curves.append(truth)
    stream = io.BytesIO()
    if old:
        book = xlwt.Workbook()
        for name, rows in sheets:
            sheet = book.add_sheet(name)
            for i, row in enumerate(rows):
                for j, cell in enumerate(row):
                    sheet.write(i, j, cell if isinstance(cell, str) else float(cell))
    else:
        book = openpyxl.Workbook()
        book.remove(book.active)
        for name, rows in sheets:
            sheet = book.create_sheet(name)
            for row in rows:
                sheet.append([cell if isinstance(cell, str) else float(cell) for cell in row])
    book.save(stream)
    return Export("zwick", f"Druckversuch.xls{'' if old else 'x'}", stream.getvalue(), "lubricated_compression",
                  tuple(curves))


def exponent(seeds, order=(2, 1, 0), length="mm", force="g", comma=False, encoding="utf-8", delimiter="\t"):
    """Exponent: tests side by side, each below its name; no word states the kind of loading."""
    curves = [curve(seed) for seed in seeds]
    title = delimiter.join(f"gel_{seed}{2 * delimiter}" for seed in seeds)
    names = ordered(order, "Time (sec)", f"Distance ({length})", f"Force ({force})")
    columns = [column for time, way, load in curves
               for column in ordered(order, time, way / LENGTH[length], load / FORCE[force])]
    text = (f"Texture Exponent 32\n{title}\n" + delimiter.join(names * len(seeds)) + "\n"
            + table(columns, delimiter, comma))
    return Export("exponent", "batch.txt", text.encode(encoding), None, tuple(curves))


def mach1(seed, order=(0, 1, 2), force="gf", encoding="utf-8", start=12.3):
    """Mach-1: the position counts from a zero of the machine; the force is negative in compression."""
    time, way, load = curve(seed)
    names = ordered(order, "Time, s", "Position (z), mm", f"Fz, {force}")
    values = ordered(order, time, start + way / 1e-3, -load / FORCE[force])
    extra = np.full(time.size, 3.25)
    text = ("<Mach-1 File>\n<INFO>\nMach-1 Motion\tv4.4\n<END INFO>\n<Stress Relaxation>\nAmplitude, mm:\t3.0\n<DATA>\n"
            + "\t".join([*names, "Position (x), mm"]) + "\n" + table([*values, extra], "\t", False) + "<END DATA>\n")
    return Export("mach1", f"cartilage_{seed}.txt", text.encode(encoding), None, ((time, way, load),))


def mecmesin(seed, order=(2, 1, 0), length="mm", force="N", comma=False, encoding="utf-8", kind="Tensile test"):
    time, way, load = curve(seed)
    mark = ";" if comma else ","
    names = ordered(order, "Time (s)", f"Displacement ({length})", f"Load ({force})")
    text = (f"Mecmesin VectorPro\nTest{mark}{kind}\n\n" + mark.join(names) + "\n"
            + table(ordered(order, time, way / LENGTH[length], load / FORCE[force]), mark, comma))
    known = {"Tensile test": "uniaxial_tension", "Compression test": "lubricated_compression"}[kind]
    return Export("mecmesin", f"VectorPro_{seed}.csv", text.encode(encoding), known, ((time, way, load),))


def trios(seed, order=(0, 1, 2), length="um", encoding="utf-16", parts=2):
    """TRIOS: steps below each other, the gap of the plates falls under compression."""
    time, way, load = curve(seed, hold=True)
    text = "Filename\tgel.tri\nInstrument name\tDHR-3\nProcedure name\tAxial compression\n\n"
    for piece, name in zip(np.array_split(np.arange(time.size), parts), ("Axial - 1", "Hold - 2"), strict=False):
        text += f"[step]\n{name}\n"
        text += "\t".join(["Step time", *ordered(order, "Time", "Gap", "Axial force")]) + "\n"
        text += "\t".join(["s", *ordered(order, "s", length, "N")]) + "\n"
        text += table([time[piece] - time[piece[0]],
                       *ordered(order, time[piece], (0.01 - way[piece]) / LENGTH[length], load[piece])], "\t", False)
        text += "\n"
    return Export("trios", f"gel_{seed}.txt", text.encode(encoding), "lubricated_compression", ((time, way, load),))


EXPORTS = {
    "bluehill": lambda: bluehill(1),
    "bluehill, order": lambda: bluehill(2, (2, 0, 1)),
    "bluehill, kN and inches, Windows": lambda: bluehill(3, (1, 2, 0), "in", "kN", newline="\r\n"),
    "bluehill, decimal comma, cp1252": lambda: bluehill(4, comma=True, encoding="cp1252"),
    "bluehill, compressive, utf-16": lambda: bluehill(5, (0, 2, 1), force="lbf", encoding="utf-16", words=True),
    "mts": lambda: mts(1),
    "mts, German": lambda: mts(2, (1, 2, 0), force="kN", comma=True),
    "mts, three blocks of one test": lambda: mts(3, (2, 1, 0), parts=3),
    "mts, byte order mark": lambda: mts(4, length="cm", force="mN", encoding="utf-8-sig"),
    "zwick": lambda: zwick_text(1),
    "zwick, points and utf-8": lambda: zwick_text(2, (2, 1, 0), comma=False, encoding="utf-8"),
    "zwick, micrometres in latin-1": lambda: zwick_text(3, (1, 0, 2), "µm", "mN", encoding="latin-1"),
    "zwick, utf-16 without mark": lambda: zwick_text(4, encoding="utf-16-le"),
    "zwick, xlsx": lambda: zwick_book((1, 2, 3)),
    "zwick, xls": lambda: zwick_book((1, 2), (2, 1, 0), "mm", "mN", old=True),
    "zwick, one specimen in xlsx": lambda: zwick_book((4,), (1, 2, 0), "cm"),
    "exponent": lambda: exponent((1, 2, 3)),
    "exponent, commas": lambda: exponent((1, 2), (0, 2, 1), delimiter=","),
    "exponent, decimal comma, newtons": lambda: exponent((1, 2, 3, 4), force="N", comma=True, encoding="cp1252"),
    "exponent, one test": lambda: exponent((3,), (1, 2, 0), length="mm", delimiter=";", comma=True),
    "mach1": lambda: mach1(1),
    "mach1, newtons": lambda: mach1(2, (2, 1, 0), "N", start=-4.0),
    "mach1, utf-16": lambda: mach1(3, (1, 2, 0), encoding="utf-16"),
    "mecmesin": lambda: mecmesin(1),
    "mecmesin, compression": lambda: mecmesin(2, (0, 1, 2), kind="Compression test", force="mN"),
    "mecmesin, decimal comma": lambda: mecmesin(3, (1, 2, 0), length="cm", comma=True, encoding="latin-1"),
    "mecmesin, pounds and inches": lambda: mecmesin(4, length="in", force="lbf", encoding="utf-8-sig"),
    "trios": lambda: trios(1),
    "trios, utf-8, one step": lambda: trios(2, (2, 1, 0), encoding="utf-8", parts=1),
    "trios, millimetres": lambda: trios(3, (1, 0, 2), length="mm"),
}
