"""Arrays of other programs as recordings: MATLAB, HDF5, LabVIEW; and encodings of text."""

import h5py
import numpy as np
import pytest
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat

from tissue_sim import InputError, read_recording, read_recordings
from tissue_sim.files import decode_text_and_find_encoding

TIME = np.linspace(0.0, 6.0, 31)
WAY = np.linspace(0.0, 3.0, 31)
FORCE = WAY**1.5


def check(recording):
    np.testing.assert_allclose(recording.time, TIME, atol=1e-12)
    np.testing.assert_allclose(recording.displacement, 1e-3 * WAY, atol=1e-15)
    np.testing.assert_allclose(recording.force, FORCE, atol=1e-12)


def test_matlab_struct_and_matrix(tmp_path):
    path = tmp_path / "run.mat"
    savemat(path, {"gel": {"time_s": TIME, "displacement_mm": WAY, "force_N": FORCE}, "operator": "J. Doe"})
    check(read_recording(path, format="table"))
    check(read_recording(path, columns={"time": "time_s", "displacement": "displacement_mm", "force": "force"}))
    savemat(path, {"data": np.column_stack([TIME, WAY, FORCE]).T})
    check(read_recording(path, columns={"time": {"column": 1, "unit": "s"}, "force": {"column": 3, "unit": "N"},
                                        "displacement": {"column": 2, "unit": "mm"}}))
    savemat(path, {"runs": [{"time_s": TIME, "displacement_mm": WAY, "force_N": FORCE}] * 2})
    assert len(read_recordings(path, format="table")) == 2


def test_hdf5_with_units_in_its_attributes(tmp_path):
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        for name, values, unit in (("Time", TIME, "s"), ("Position", WAY, "mm"), ("Load", FORCE, b"N")):
            file[f"run 1/{name}"] = values[:, None] if name == "Load" else values
            file[f"run 1/{name}"].attrs["units"] = unit
        file["run 1/picture"] = np.zeros((80, 90))
    check(read_recording(path, format="table"))


def test_tdms_with_units_and_a_clock_of_its_own(tmp_path):
    path = tmp_path / "run.tdms"
    clock = {"wf_increment": 0.2}
    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("run", "Displacement", WAY, {"unit_string": "mm", **clock}),
                              ChannelObject("run", "Force", FORCE, {"unit_string": "N", **clock})])
    check(read_recording(path, format="table"))


def test_which_table_of_a_container(tmp_path):
    path = tmp_path / "run.mat"
    savemat(path, {name: {"time_s": TIME, "displacement_mm": WAY, "force_N": factor * FORCE}
                   for name, factor in (("a", 1.0), ("b", 2.0))})
    assert [each.force[-1] / FORCE[-1] for each in read_recordings(path, format="table")] == [1.0, 2.0]
    assert read_recording(path, format="table", sheet="b").force[-1] == 2.0 * FORCE[-1]
    assert read_recording(path, format="table", curve=2).force[-1] == 2.0 * FORCE[-1]
    with pytest.raises(InputError, match="there is no table 'c'"):
        read_recording(path, format="table", sheet="c")


@pytest.mark.parametrize(("data", "name"), [
    ("Prüfzeit µm".encode(), "utf-8"), ("\ufeffPrüfzeit".encode(), "utf-8"), ("Prüfzeit".encode("utf-16"), "utf-16"),
    ("Prüfzeit in Sekunden".encode("utf-16-le"), "utf-16-le"),
    ("Prüfzeit in Sekunden".encode("utf-16-be"), "utf-16-be"),
    ("Prüfzeit €".encode("cp1252"), "cp1252"), (b"Pr\xfcfzeit \x81", "latin-1")])
def test_encodings(data, name):
    text, found = decode_text_and_find_encoding(data, "a.txt", "text")
    assert found == name and text.startswith("Prüfzeit")


@pytest.mark.parametrize("data", [b"", b"  \n", b"\x00\x01\x02\x03\x00\x00", b"abc\x05", b"\xff\xfea"])
def test_what_is_no_text(data):
    with pytest.raises(InputError, match=r"a\.txt"):
        decode_text_and_find_encoding(data, "a.txt", "text")
