"""Every reader of recordings, and `import`, on damaged files: an answer or one sentence, never anything else.

    python benchmarks/import_fuzz.py [--inputs 20000] [--readers zwick mach1 ...]

Prints a table in Markdown; the last one stands in docs/import.md. A fault ends the run with the file kept and its name.
"""

from __future__ import annotations

import argparse
import io
import random
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "calibration"))
import machine_exports
from test_import import mutated

import calibration
import tissue_sim as ts

POINTS = 8
TABLE = {name: np.linspace(0.0, end, 12) for name, end in (("time", 1.1), ("displacement", 3.0), ("force", 2.0))}
COLUMNS = {"time": {"name": "time", "unit": "s"}, "displacement": {"name": "displacement", "unit": "mm"},
           "force": {"name": "force", "unit": "N"}}


def short_curves() -> None:
    """Small files, so that a mutation meets what matters."""
    whole = machine_exports.curve
    machine_exports.curve = lambda seed, hold=False, points=POINTS: whole(seed, hold, points)


def columns(delimiter: str = ",", header: str = "") -> bytes:
    rows = zip(*(values.tolist() for values in TABLE.values()), strict=True)
    return (header + "".join(delimiter.join(f"{value:.5g}" for value in row) + "\n" for row in rows)).encode()


def ods() -> bytes:
    """The smallest OpenDocument spreadsheet."""
    def cell(value) -> str:
        if isinstance(value, str):
            return f'<table:table-cell office:value-type="string"><text:p>{value}</text:p></table:table-cell>'
        return (f'<table:table-cell office:value-type="float" office:value="{value}"><text:p>{value}</text:p>'
                "</table:table-cell>")

    rows = [list(TABLE), *map(list, zip(*(values.tolist() for values in TABLE.values()), strict=True))]
    body = "".join(f"<table:table-row>{''.join(map(cell, row))}</table:table-row>" for row in rows)
    spaces = " ".join(f'xmlns:{name}="urn:oasis:names:tc:opendocument:xmlns:{name}:1.0"'
                      for name in ("office", "table", "text"))
    content = (f'<?xml version="1.0" encoding="UTF-8"?><office:document-content {spaces}><office:body>'
               f'<office:spreadsheet><table:table table:name="run">{body}</table:table></office:spreadsheet>'
               "</office:body></office:document-content>")
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("mimetype", "application/vnd.oasis.opendocument.spreadsheet")
        archive.writestr("META-INF/manifest.xml", '<?xml version="1.0"?><manifest:manifest xmlns:manifest='
                         '"urn:oasis:names:tc:opendocument:xmlns:manifest:1.0"/>')
        archive.writestr("content.xml", content)
    return stream.getvalue()


def mat() -> bytes:
    from scipy.io import savemat

    stream = io.BytesIO()
    savemat(stream, {"run": TABLE})
    return stream.getvalue()


def hdf5() -> bytes:
    import h5py

    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        for name, values in TABLE.items():
            file[f"run/{name}"] = values
    return stream.getvalue()


def tdms() -> bytes:
    from nptdms import ChannelObject, TdmsWriter

    stream = io.BytesIO()
    with TdmsWriter(stream) as writer:
        writer.write_segment([ChannelObject("run", name, values) for name, values in TABLE.items()])
    return stream.getvalue()


def afm() -> bytes:
    import afmformats

    depth = np.concatenate([np.linspace(-4e-6, 3e-6, 40), np.linspace(3e-6, -4e-6, 40)])
    force = 4e-9 * (np.clip(depth, 0, None) / 3e-6) ** 1.5
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "curve.tab")
        afmformats.AFMForceDistance(
            {"force": force + 2.5e-9, "height (measured)": 50e-6 - depth - force / 0.05,
             "segment": np.repeat([0, 1], 40)},
            {"path": Path("made"), "enum": 1, "imaging mode": "force-distance", "spring constant": 0.05},
        ).export_data(path)
        return path.read_bytes()


INSTRON = (b"Gel\nCompression test;\nCylinder Diameter: 50mm;\nCylinder Height: 30mm;\nSpeed (mm/min): 10;\n"
           + columns(header="Time (s),Compression (mm),Load (N)\n"))
SOFT = (b"PARAMETER;INFO;URL\nMaterial;Gel;\n"
        + columns(";", "Time (s);Engineering Strain;Engineering Stress (MPa)\n"))


def readers() -> dict[str, tuple[str, bytes, dict]]:
    """Name -> (name of the file, its content, options of `read_recordings`)."""
    exports = {name: machine_exports.EXPORTS[name]() for name in (
        "bluehill", "mts", "zwick", "exponent", "mach1", "mecmesin", "trios")}
    books = {name: machine_exports.EXPORTS[name]() for name in ("zwick, xlsx", "zwick, xls")}
    names = {"displacement": "Standardweg", "force": "Standardkraft"}
    return {
        "native": ("run.csv", columns(header="time [s],displacement [mm],force [N]\n"), {}),
        "named columns": ("run.txt", columns("\t", "time\tdisplacement\tforce\n"), {"columns": COLUMNS}),
        "placed columns": ("run.txt", columns(";"), {"columns": {
            "displacement": {"column": 2, "unit": "mm"}, "force": {"column": "C", "unit": "gf"}}}),
        "instron": ("run.csv", INSTRON, {"format": "instron"}),
        "soft_robotics": ("run.csv", SOFT, {"format": "soft_robotics"}),
        **{name: (export.name, export.content, {"format": name}) for name, export in exports.items()},
        **{name.partition(", ")[2]: (export.name, export.content, {"columns": names, "sheet": "Probe 1"})
           for name, export in books.items()},
        "ods": ("run.ods", ods(), {"columns": COLUMNS}),
        "mat": ("run.mat", mat(), {"columns": COLUMNS}),
        "tdms": ("run.tdms", tdms(), {"columns": COLUMNS}),
        "hdf5": ("run.h5", hdf5(), {"columns": COLUMNS}),
        "afm": ("curve.tab", afm(), {"format": "afm"}),
    }


def run(name: str, file: str, content: bytes, inputs: int, folder: Path, read) -> str:
    """One row of the table."""
    chance, path, answers, slowest = random.Random(name), folder / file, 0, 0.0
    began = time.process_time()
    path.write_bytes(content)
    read(path)  # the file itself is sound
    for number in range(inputs):
        path.write_bytes(mutated(content, chance))
        start = time.process_time()
        try:
            read(path)
            answers += 1
        except ts.InputError as error:
            if "\n" in str(error):
                raise SystemExit(f"{name}, input {number}: more than a line: {error}; kept in {path}") from None
        except Exception as error:
            raise SystemExit(f"{name}, input {number}: {type(error).__name__}: {error}; kept in {path}") from error
        slowest = max(slowest, time.process_time() - start)
    return (f"| {name} | {inputs} | {answers} | {inputs - answers} | 0 | {time.process_time() - began:.0f} | "
            f"{slowest:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--readers", nargs="*")
    arguments = parser.parse_args()
    short_curves()
    wishes = calibration.Wishes(specimen={"radius_mm": 10.0, "height_mm": 12.0})
    folder = Path(tempfile.mkdtemp())
    print("| reader | inputs | answers | refused in a sentence | anything else | CPU s | slowest, s |")
    print("|---|---|---|---|---|---|---|")
    for name, (file, content, options) in readers().items():
        if not arguments.readers or name in arguments.readers:
            print(run(name, file, content, arguments.inputs, folder,
                      lambda path, options=options: ts.read_recordings(path, **options)), flush=True)
    sources = {name: each for name, each in readers().items() if name in (
        "bluehill", "mts", "zwick", "exponent", "mach1", "mecmesin", "trios", "xls", "mat")}
    if not arguments.readers or "import" in arguments.readers:
        for name, (file, content, _) in sources.items():
            print(run(f"import of {name}", file, content, max(1, arguments.inputs // len(sources)), folder,
                      lambda path: calibration.import_files([path], wishes=wishes)), flush=True)


if __name__ == "__main__":
    main()
