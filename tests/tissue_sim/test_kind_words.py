"""Words for tests: those of registered kinds, and those of tests without a kind, which no kind may be taken for."""

import pytest

import tissue_sim as ts
from tissue_sim.recording.formats.guesses import InterpretationOverrides
from tissue_sim.recording.formats.kind_words import (
    UNKNOWN_TESTS,
    KindHint,
    find_named_tests,
    normalize_and_truncate_line,
)
from tissue_sim.recording.formats.understanding import interpret_file

ROWS = "".join(f"{0.5 * i:g},{0.1 * i:.3f},{0.2 * i:.3f}\n" for i in range(21))
TABLE = "Time (s),Travel (mm),Load (N)\n" + ROWS


def names(text):
    return list(dict.fromkeys(each.kind or each.unknown.name for each in find_named_tests([KindHint(text, "here")])))


@pytest.mark.parametrize(("text", "expected"), [
    ("hydrostatic compression", "volumetric_compression"),
    ("Dreipunktbiegung", "bending"), ("3-Punkt-Biegeversuch", "bending"),
    ("four-point bending", "bending"), ("3PB", "bending"), ("Schaelversuch", "peel"), ("Ermüdung", "fatigue"),
    ("Essai d'éclatement", "burst"), ("Zugscherversuch", "lap_shear"), ("compact tension", "fracture"),
    ("trouser tear", "tear"), ("Brazilian disc", "diametral_compression"), ("plane-strain compression",
                                                                            "plane_strain_compression"),
    ("surface tension", "surface_tension"), ("180 degree peel", "peel"),
    ("T-peel, 90°", "peel"), ("Test method: loop tack", "tack"), ("Prüfart; Burst, water", "burst")])
def test_words_of_tests_without_a_kind(text, expected):
    assert expected in {each.name for each in UNKNOWN_TESTS}
    assert names(text) == [expected]


@pytest.mark.parametrize(("text", "expected"), [
    ("Unconfined compression", "lubricated_compression"), ("un-confined compression test", "lubricated_compression"),
    ("Planar tension test", "planar_tension"), ("PureShear_1", "planar_tension"), ("reine Scherung", "planar_tension"),
    ("Essai de cisaillement pur", "planar_tension"), ("planar", "planar_tension"),
    ("Test method: planar", "planar_tension"), ("equi-biaxial", "equibiaxial_tension"),
    ("Äquibiaxialer Versuch", "equibiaxial_tension"),
    ("biaxial tension", "biaxial_tension"), ("Bi-axial test", "biaxial_tension"), ("Cruciform", "biaxial_tension"),
    ("Torsionsversuch", "torsion"), ("twist", "torsion"),
    ("Confined compression, porous platen", "confined_compression"), ("Compression confinée", "confined_compression"),
    ("Simple shear", "simple_shear"), ("Zugversuch", "uniaxial_tension"), ("Essai de traction", "uniaxial_tension"),
    ("Druckversuch", "lubricated_compression"), ("Kompressionsversuch", "lubricated_compression"),
    ("Scherversuch", "simple_shear"), ("needle_indentation", "needle_indentation"),
    ("bonded compression", "bonded_compression"), ("Test method: tension, die cut", "uniaxial_tension")])
def test_words_of_registered_kinds(text, expected):
    assert names(text) == [expected]


@pytest.mark.parametrize("text", ["Volumetric strain", "Operator: Peel", "planar sheet", "Load cell", "gel 3",
                                  "Test specimen: cut", "Peel off the film"])
def test_words_that_name_no_test(text):
    assert names(text) == []


def test_plain_text_has_no_accents_and_single_blanks():
    assert normalize_and_truncate_line("Ermüdung_PureShear-3pt") == "ermudung pure shear 3 pt"


@pytest.mark.parametrize(("name", "above", "header"), [
    ("a.csv", "Volumetric compression test\n", ""), ("bending_7.csv", "Tensile test\n", ""), ("a.csv", "", "Peel "),
    ("a.csv", "Uniaxial tension\nFatigue: 1000 cycles before\n", "")])
def test_a_file_of_such_a_test_is_refused_until_the_user_states_a_kind(tmp_path, name, above, header):
    path = tmp_path / name
    path.write_text(above + TABLE.replace("Load", f"{header}Load"), encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"there is no such kind of test\. --kind overrules the word"):
        interpret_file(path)
    reading, = interpret_file(path, InterpretationOverrides(kind="uniaxial_tension")).readings
    assert reading.kind.kind == "uniaxial_tension" and "names" in reading.kind.against[0]
    assert "as stated" in reading.remarks[0]


def test_two_words_in_the_file_overrule_its_name(tmp_path):
    path = tmp_path / "fatigue_control.csv"
    path.write_text("Uniaxial tension\n" + TABLE, encoding="utf-8")
    assert interpret_file(path).readings[0].kind.kind == "uniaxial_tension"


def test_rows_of_different_tests_are_refused(tmp_path):
    path = tmp_path / "a.csv"
    for other in ("bending", "planar"):
        rows = [f"{label},{1 + 0.1 * i:.2f},{i}" for label in ("uniaxial", other) for i in range(9)]
        path.write_text("test,stretch,stress (kPa)\n" + "\n".join(rows), encoding="utf-8")
        with pytest.raises(ts.InputError, match=rf"rows are of different tests \(uniaxial, {other} in column 'test'\)"):
            interpret_file(path)
