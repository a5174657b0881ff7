"""Small valid files for every reader of recordings, which `mutated_inputs` damages."""

from __future__ import annotations

import io
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from benchmarks import ROOT

sys.path.insert(0, str(ROOT / "tests" / "calibration"))
import machine_exports

POINTS = 8
TABLE = {name: np.linspace(0.0, end, 12) for name, end in (("time", 1.1), ("displacement", 3.0), ("force", 2.0))}
COLUMNS = {"time": {"name": "time", "unit": "s"}, "displacement": {"name": "displacement", "unit": "mm"},
           "force": {"name": "force", "unit": "N"}}


def short_curves() -> None:
    """Return small files, so that a mutation is likely to change a relevant part."""
    whole = machine_exports.curve
    machine_exports.curve = lambda seed, hold=False, points=POINTS: whole(seed, hold, points)


def columns(delimiter: str = ",", header: str = "") -> bytes:
    rows = zip(*(values.tolist() for values in TABLE.values()), strict=True)
    return (header + "".join(delimiter.join(f"{value:.5g}" for value in row) + "\n" for row in rows)).encode()


def ods() -> bytes:
    """Return the smallest OpenDocument spreadsheet."""
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


#: Those that `import` understands too.
IMPORTED = ("bluehill", "mts", "zwick", "exponent", "mach1", "mecmesin", "trios", "xlsx", "xls", "mat")


def recordings() -> dict[str, tuple[str, bytes, dict]]:
    """Return for each name the file name, its content, and options of `read_recordings`."""
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
