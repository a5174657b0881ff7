"""Tables of storage and loss modulus of a rheometer or DMA are read, and give a campaign that calibrates."""

import json

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration import ImportOptions, InterpretationOverrides
from scenes.cli import main
from tissue_sim.errors import InputError

GEL = ts.Material("neo_hooke", {"C10": 1000.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 0.02),
                                                                      ts.PronyTerm(0.25, 0.5))))
FREQUENCY = np.geomspace(0.05, 20.0, 21)
OMEGA = 2 * np.pi * FREQUENCY
G = ts.complex_modulus(GEL, FREQUENCY, "simple_shear")
TAN = G.imag / G.real


def write(folder, header, *columns, above="", name="a.csv", mark=","):
    rows = "".join(mark.join(f"{value:.9g}" for value in row) + "\n" for row in zip(*columns, strict=True))
    path = folder / name
    path.write_text(f"{above}{header}\n{rows}", encoding="utf-8")
    return path


def load(path, **stated):
    return calibration.import_files([path], path.with_suffix(".toml"), ImportOptions(InterpretationOverrides(**stated)),
                                    overwrite=True)


#: Name -> title, header, columns, kind.
TABLES = {
    "hertz": ("", "Frequency (Hz),Storage modulus G' (Pa),Loss modulus G'' (kPa)", (FREQUENCY, G.real, G.imag / 1e3),
              "simple_shear"),
    "angular": ("", "Angular frequency (rad/s),G' (Pa),G'' (Pa)", (OMEGA, G.real, G.imag), "simple_shear"),
    "omega without unit": ("", "omega,G' [Pa],G\" [Pa]", (OMEGA, G.real, G.imag), "simple_shear"),
    "1/s": ("", "Kreisfrequenz [1/s];Speichermodul [Pa];Verlustmodul [Pa];Temperatur [°C]",
            (OMEGA, G.real, G.imag, 20 + 0 * OMEGA), "simple_shear"),
    "underscores": ("", "f_Hz,G_prime_Pa,G_double_prime_Pa", (FREQUENCY, G.real, G.imag), "simple_shear"),
    "loss factor": ("", "f (Hz),G' (Pa),tan delta", (FREQUENCY, G.real, TAN), "simple_shear"),
    "absolute value": ("", "Frequency (mHz),|G*| (Pa),tan(δ)", (1e3 * FREQUENCY, np.abs(G), TAN), "simple_shear"),
    "French": ("", "Fréquence (Hz);Module de conservation (kPa);Module de perte (kPa)",
               (FREQUENCY, 3e-3 * G.real, 3e-3 * G.imag), "stated"),
    "tension": ("", "Frequency (Hz),E' (MPa),E'' (MPa)", (FREQUENCY, 3e-6 * G.real, 3e-6 * G.imag), "uniaxial_tension"),
    "compression": ("Compression DMA\n\n", "Frequency (Hz),E' (kPa),E'' (kPa)",
                    (FREQUENCY, 3e-3 * G.real, 3e-3 * G.imag), "lubricated_compression"),
    "torsion": ("Torsion\n", "Frequency (Hz),Storage modulus (Pa),Loss modulus (Pa)", (FREQUENCY, G.real, G.imag),
                "torsion"),
    "words of shear": ("Rheometer\n",
                       "Frequency (Hz),Storage modulus (Pa),Loss modulus (Pa),Shear strain amplitude (%)",
                       (FREQUENCY, G.real, G.imag, 1 + 0 * OMEGA), "simple_shear"),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_read(tmp_path, name):
    title, header, columns, kind = TABLES[name]
    if name == "1/s":
        title = "Scherversuch\n"
    if kind == "stated":
        imported = load(write(tmp_path, header, *columns, above=title, mark=";"), kind="uniaxial_tension")
        kind = "uniaxial_tension"
    else:
        imported = load(write(tmp_path, header, *columns, above=title, mark=";" if ";" in header else ","))
    assert imported.is_complete, (imported.missing, imported.problem, imported.questions)
    test, = imported.tests
    assert test.kind == kind
    curves = calibration.read_measured_curves(calibration.load_campaign(imported.output))
    factor = 1.0 if kind in ("simple_shear", "torsion") else 3.0
    for modulus, expected in (("storage modulus", G.real), ("loss modulus", G.imag)):
        curve, = curves[f"a {modulus}"]
        np.testing.assert_allclose(curve.displacement, FREQUENCY, rtol=1e-8)
        np.testing.assert_allclose(np.exp(curve.force), factor * expected, rtol=1e-7)


@pytest.mark.slow
def test_from_file_to_material(tmp_path):
    imported = load(write(tmp_path, "Frequency (Hz),G' (Pa),G'' (Pa)", FREQUENCY, G.real, G.imag))
    result, = calibration.calibrate([imported.output], tmp_path / "out", overwrite=True)
    fit = result.best
    material = ts.load_material(tmp_path / "out" / f"{fit.law}.material.json")
    found = ts.complex_modulus(material, FREQUENCY, "simple_shear")
    assert np.abs(found / G - 1.0).max() < 1e-3
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "a storage modulus" in page and "a loss modulus" in page
    rows = (tmp_path / "out" / "residuals.csv").read_text(encoding="utf-8").splitlines()
    assert "frequency [Hz],0.05" in rows[1] and float(rows[1].split(",")[9]) == pytest.approx(G.real[0], rel=1e-6)


def test_the_unit_that_no_header_states_is_asked_for(tmp_path):
    imported = load(write(tmp_path, "Frequency,G' (Pa),G'' (Pa)", FREQUENCY, G.real, G.imag))
    assert imported.missing == ("the unit of column 'Frequency' (frequency) (--unit frequency=...)",)


def test_columns_and_units_that_the_user_states(tmp_path, capsys):
    path = write(tmp_path, "x,y,z,t", OMEGA, G.real / 1e3, G.imag / 1e3, 20.0 + 0 * OMEGA)
    stated = {"--column": ("frequency=1", "storage_modulus=y", "loss_modulus=C"),
              "--unit": ("frequency=rad/s", "storage_modulus=kPa", "loss_modulus=kPa"), "--kind": ("simple_shear",)}
    flags = [part for flag, values in stated.items() for value in values for part in (flag, value)]
    assert main(["import", str(path), "-o", str(tmp_path / "c.toml"), *flags]) == 0, capsys.readouterr()
    curve, = calibration.read_measured_curves(calibration.load_campaign(tmp_path / "c.toml"))["a loss modulus"]
    np.testing.assert_allclose(curve.displacement, FREQUENCY, rtol=1e-7)
    np.testing.assert_allclose(np.exp(curve.force), G.imag, rtol=1e-7)


def test_the_unit_of_an_angular_frequency_can_be_stated_alone(tmp_path, capsys):
    path = write(tmp_path, "Frequency,G' (Pa),G'' (Pa)", OMEGA, G.real, G.imag)
    assert main(["import", str(path), "-o", str(tmp_path / "c.toml"), "--unit", "frequency=rad/s"]) == 0, \
        capsys.readouterr()
    curve, = calibration.read_measured_curves(calibration.load_campaign(tmp_path / "c.toml"))["a loss modulus"]
    np.testing.assert_allclose(curve.displacement, FREQUENCY, rtol=1e-7)


#: Moduli of the sweeps relative to the first sweep.
FACTORS = np.repeat([1.0, 0.5, 0.2], FREQUENCY.size)


@pytest.mark.parametrize(("header", "values"), [
    ("Temperature (C)", (20.0, 30.0, 40.0)), ("T [K]", (293.15, 295.15, 297.15)), ("Strain (%)", (0.1, 0.2, 0.5)),
    ("Specimen", (1, 2, 3)), ("Pre-strain", (0.0, 0.1, 0.2))])
@pytest.mark.parametrize("order", ["one after another", "mixed"])
def test_several_sweeps_in_one_table_are_refused(tmp_path, header, values, order):
    scatter = 1e-3 * np.random.default_rng(1).standard_normal(FACTORS.size) * (header != "Specimen")
    table = np.array([np.repeat(values, FREQUENCY.size) * (1 + 0.1 * scatter), np.tile(FREQUENCY, 3),
                      FACTORS * np.tile(G.real, 3), FACTORS * np.tile(G.imag, 3)])
    if order == "mixed":
        table = table[:, np.argsort(table[1], kind="stable")]
    with pytest.raises(InputError, match=r"must have one sweep of the frequency; column '.*' has 3 values"):
        load(write(tmp_path, f"{header},Frequency (Hz),G' (Pa),G'' (Pa)", *table))


def test_sweeps_of_named_specimens_are_refused(tmp_path):
    rows = [f"{name},{f:.6g},{factor * g.real:.6g},{factor * g.imag:.6g}"
            for name, factor in (("left", 1), ("right", 2)) for f, g in zip(FREQUENCY, G, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["Kidney,Frequency (Hz),G' (Pa),G'' (Pa)", *rows]) + "\n")
    with pytest.raises(InputError, match="column 'Kidney' has 2 values over the same frequencies"):
        load(tmp_path / "a.csv")


def test_quantities_that_vary_during_one_sweep_are_no_sweeps(tmp_path):
    """Temperature scatters, stress follows the modulus; a sweep up and down has time and point numbers."""
    rng, there, back = np.random.default_rng(2), FREQUENCY, FREQUENCY[::-1]
    frequency, moduli = np.concatenate([there, back]), np.concatenate([G, G[::-1]])
    count = frequency.size
    imported = load(write(
        tmp_path, "Point,Time (s),Temperature (C),Strain (%),Stress (Pa),Phase (deg),Frequency (Hz),G' (Pa),G'' (Pa)",
        np.arange(count) + 1.0, np.cumsum(5.0 / frequency), (24.9 + 0.1 * rng.integers(0, 3, count)),
        1.0 + 0.005 * rng.standard_normal(count), 0.01 * np.abs(moduli), np.degrees(np.angle(moduli)), frequency,
        moduli.real, moduli.imag))
    assert [len(each) for part in imported.tests[0].parts for each in part.reading.recordings] == [count]


def test_a_master_curve_with_temperatures_is_one_sweep(tmp_path):
    temperature = 20.0 + 10.0 * (np.arange(FREQUENCY.size) // 7)
    imported = load(write(tmp_path, "Temperature (C),Frequency (Hz),G' (Pa),G'' (Pa)", temperature, FREQUENCY, G.real,
                          G.imag))
    assert imported.is_complete


def test_blocks_with_equal_headers_are_separate_tests(tmp_path):
    header = "Frequency (Hz),G' (Pa),G'' (Pa)"
    blocks = [write(tmp_path, header, FREQUENCY, k * G.real, k * G.imag, above=f"Temperature {t} C\n").read_text()
              for t, k in ((20, 1.0), (30, 0.5), (40, 0.2))]
    (tmp_path / "a.csv").write_text("\n\n".join(blocks))
    imported = load(tmp_path / "a.csv")
    curves = calibration.read_measured_curves(calibration.load_campaign(imported.output))
    for number, k in enumerate((1.0, 0.5, 0.2), 1):
        curve, = curves[f"a_{number} storage modulus"]
        np.testing.assert_allclose(np.exp(curve.force), k * G.real, rtol=1e-7)


@pytest.mark.parametrize(("header", "columns"), [
    ("log omega (rad/s),G' (Pa),G'' (Pa)", (np.log10(OMEGA), G.real, G.imag)),
    ("log frequency [Hz],G' (Pa),G'' (Pa)", (2 + np.log10(FREQUENCY), G.real, G.imag)),
    ("ln(f) (Hz),G' (Pa),G'' (Pa)", (9 + np.log(FREQUENCY), G.real, G.imag)),
    ("Frequency (Hz),Log storage modulus [Pa],log10 loss modulus [Pa]",
     (FREQUENCY, np.log10(G.real), np.log10(G.imag))),
    ("log f (Hz),log G' (Pa),log G'' (Pa)", (np.log10(FREQUENCY), np.log10(G.real), np.log10(G.imag)))])
def test_logarithms_are_refused(tmp_path, header, columns):
    with pytest.raises(InputError, match="got logarithms in"):
        load(write(tmp_path, header, *columns))


def test_logarithms_next_to_values_are_not_used(tmp_path):
    imported = load(write(tmp_path, "log f (Hz),Frequency (Hz),G' (Pa),G'' (Pa)", np.log10(FREQUENCY), FREQUENCY,
                          G.real, G.imag))
    curve, = calibration.read_measured_curves(calibration.load_campaign(imported.output))["a loss modulus"]
    np.testing.assert_allclose(curve.displacement, FREQUENCY, rtol=1e-8)


def test_a_frequency_that_is_not_positive_is_refused(tmp_path):
    with pytest.raises(InputError, match="frequency must be positive; got -"):
        load(write(tmp_path, "Frequency (Hz),G' (Pa),G'' (Pa)", np.log10(FREQUENCY), G.real, G.imag))


def test_moduli_without_a_letter_need_a_kind(tmp_path):
    imported = load(write(tmp_path, "Frequency (Hz),Storage modulus (Pa),Loss modulus (Pa)", FREQUENCY, G.real, G.imag))
    assert imported.missing == ("the kind of test (--kind)",)


def test_command_prints_the_frequencies(tmp_path, capsys):
    path = write(tmp_path, "Frequency (Hz),G' (Pa),G'' (Pa)", FREQUENCY, G.real, G.imag)
    assert main(["import", str(path), "-o", str(tmp_path / "c.toml")]) == 0
    assert "0.05 to 20 Hz" in capsys.readouterr().out and (tmp_path / "c.png").stat().st_size > 1000
    assert main(["import", str(path), "-o", str(tmp_path / "c.toml"), "--overwrite", "--json"]) == 0
    entry, = json.loads(capsys.readouterr().out)["files"]
    assert entry["recordings"][0]["frequency_Hz"] == pytest.approx([0.05, 20.0])
