"""Sizes of specimens in files with several tables: above all, above or below each, and contradictions."""

import numpy as np
import pytest

import calibration

#: Neo-Hooke of 20 kPa; displacement of strips, mm.
MODULUS_PA = 20e3
MOTION_MM = np.linspace(0.0, 20.0, 41)


def block(width_mm=5.0, thickness_mm=2.0, gauge_mm=40.0):
    """Rows of a tensile test of a strip, with a force in mN."""
    stretch = 1.0 + MOTION_MM / gauge_mm
    force = 1e3 * 1e-6 * width_mm * thickness_mm * MODULUS_PA * (stretch - stretch**-2)
    rows = (f"{number},{way:.3f},{load:.4f}" for number, (way, load) in enumerate(zip(MOTION_MM, force, strict=True)))
    return "\n".join(["Time (s),Extension (mm),Load (mN)", *rows, ""])


def sizes(width_mm=5.0, thickness_mm=2.0, gauge_mm=40.0):
    return f"Width,{width_mm:g},mm\nThickness,{thickness_mm:g},mm\nGauge length,{gauge_mm:g},mm\n"


def imported(folder, text, name="strips.csv"):
    (folder / name).write_text(text)
    return calibration.import_files([folder / name], folder / "c.toml",
                                    calibration.ImportOptions(laws=("neo_hooke",)))


def fitted_modulus(folder):
    """Shear modulus of the campaign, Pa."""
    result, = calibration.calibrate([folder / "c.toml"], folder / "r", figures=False)
    return result.best.mu0


@pytest.mark.parametrize("trailing", ["Gauge length,56,mm\n", "\nGauge length: 56 mm\n"])
def test_a_size_below_the_last_of_several_tables_that_contradicts_those_above_is_a_question(tmp_path, trailing):
    text = f"Tensile test\n{sizes()}\nSpecimen 1\n{block()}\nSpecimen 2\n{block()}\n{trailing}"
    assert any("40 mm" in each and "56 mm" in each for each in imported(tmp_path, text).questions)


def test_equal_sizes_above_and_below_several_tables_are_no_question(tmp_path):
    text = f"Tensile test\n{sizes()}\nSpecimen 1\n{block()}\nSpecimen 2\n{block()}\n{sizes()}"
    assert imported(tmp_path, text).is_complete
    assert fitted_modulus(tmp_path) == pytest.approx(MODULUS_PA, rel=1e-3)


def test_adjacent_tables_share_a_contradiction(tmp_path):
    left, right = (block().splitlines() for _ in range(2))
    rows = "\n".join(f"{first},{second}" for first, second in zip(left, right, strict=True))
    text = f"Tensile test\n{sizes()}\n{rows}\n\nGauge length,56,mm\n"
    assert any("56 mm" in each for each in imported(tmp_path, text).questions)


@pytest.mark.parametrize("below", [False, True])
def test_sizes_above_or_below_each_table_are_about_that_table(tmp_path, below):
    strips = ({"width_mm": 5.0}, {"width_mm": 7.5}, {"width_mm": 6.0, "gauge_mm": 30.0})
    parts = [(f"Specimen {i}\n{block(**strip)}\n", f"{sizes(**strip)}\n") for i, strip in enumerate(strips, start=1)]
    text = "Tensile test\n" + "".join(f"{rows}{size}" if below else f"{size}{rows}" for rows, size in parts)
    found = imported(tmp_path, text)
    assert found.is_complete, found.questions
    assert sorted(line.value for lines in found.specimens.values() for line in lines if line.key == "area_mm2") == [
        10.0, 12.0, 15.0]
    assert fitted_modulus(tmp_path) == pytest.approx(MODULUS_PA, rel=1e-3)


def test_files_of_strips_with_different_widths_are_no_replicates_of_one_specimen(tmp_path):
    for number, width in enumerate((5.0, 7.5), start=1):
        (tmp_path / f"strip_{number}.csv").write_text(f"Tensile test\n{sizes(width)}\n{block(width)}")
    found = calibration.import_files([tmp_path / "strip_1.csv", tmp_path / "strip_2.csv"], tmp_path / "c.toml",
                                     calibration.ImportOptions(laws=("neo_hooke",)))
    assert found.is_complete, found.questions
    assert fitted_modulus(tmp_path) == pytest.approx(MODULUS_PA, rel=1e-3)
