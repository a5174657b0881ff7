"""The inverse calibration on measured silicone (read where TISSUE_SIM_DATA points, see conftest).

Recordings of EcoFlex 00-10 in compression, two samples, and the same product in tension.
"""

import csv

import numpy as np
import pytest

import calibration

#: The model is allowed to miss 1 % of the largest force, correlated over a third of the ramp.
NOISE = "force_N = 0.17\ncorrelation_time_s = 8.0"


def fit(folder, data, laws, *, kind="lubricated_compression", face="", window=0.14, tension=False, noise=NOISE):
    """Calibrate samples A and B together, three recordings of each, and return the result."""
    files = {sample: [(data / "ecoflex_compression" / f"EF10_0T_{sample}{i}.csv").as_posix() for i in (2, 3, 4)]
             for sample in "AB"}
    text = '[[specimen]]\nname = "cylinder"\nradius_mm = 25.0\nheight_mm = 30.0\n'
    for sample, own in files.items():
        text += (f'[[test]]\nname = "{sample}"\nspecimen = "cylinder"\nkind = "{kind}"\n{face}\nrecordings = {own}\n'
                 f'format = "instron"\nmax_strain = {window}\n')
    if tension:
        strip = (data / "soro_tensile" / "Ecoflex 00-10.csv").as_posix()
        text += ('[[specimen]]\nname = "strip"\nshape = "prism"\narea_mm2 = 18.0\nheight_mm = 33.0\n'
                 '[[test]]\nname = "tension"\nspecimen = "strip"\nkind = "uniaxial_tension"\nhold_out = true\n'
                 f'recordings = ["{strip}"]\nformat = "soft_robotics"\nmax_strain = 1.0\n')
    text += f'[fit]\nmethod = "inverse_fem"\nlaws = {laws}\nbulk_ratio = 10000.0\nstarts = 1\n[noise]\n{noise}\n'
    folder.mkdir(exist_ok=True)
    path = folder / "silicone.toml"
    path.write_text(text, encoding="utf-8")
    result, = calibration.calibrate([path], folder / "out", figures=False)
    return result


@pytest.fixture(scope="module")
def frictionless(data_folder, tmp_path_factory):
    """Both samples between frictionless platens, tension held out."""
    return fit(tmp_path_factory.mktemp("frictionless"), data_folder, ["neo_hooke", "reduced_polynomial_2"],
               tension=True)


def law(result, name):
    return next(own for own in result.fits if own.law == name)


@pytest.mark.slow
def test_modulus_of_the_closed_form(frictionless, data_folder):
    """Between frictionless platens the inverse fit is linear regression of the closed form, but for offsets."""
    found = law(frictionless, "neo_hooke")
    slopes = []
    for sample in "AB":
        for i in (2, 3, 4):
            table = np.loadtxt(data_folder / "ecoflex_compression" / f"EF10_0T_{sample}{i}.csv", delimiter=",",
                               skiprows=8, usecols=(1, 2))
            displacement, force = table[(table[:, 0] > 1.0) & (table[:, 0] < 4.2)].T
            stretch = 1 - displacement / 30.0
            # A line of force over the law's own shape: its zero takes the offset up to first order.
            shape = 2 * np.pi * 0.025**2 * (stretch**-2 - stretch)
            slopes.append(np.polyfit(shape, force, 1)[0])
    assert found.status == "converged"
    assert found.parameters["C10"] == pytest.approx(np.mean(slopes), rel=0.04)
    low, high = found.intervals95["C10"]
    assert 0.002 < (high - low) / found.parameters["C10"] < 0.1


@pytest.mark.slow
def test_offsets_stay_where_the_eye_sees_them(frictionless):
    """The recordings touch within 0.3 mm of their zero, and no nuisance runs away from that."""
    for found in frictionless.fits:
        assert len(found.nuisances) == 6
        assert max(abs(own.contact_offset_mm) for own in found.nuisances) < 0.3
        assert max(abs(own.zero_offset_N) for own in found.nuisances) < 0.6


@pytest.mark.slow
def test_samples_differ_by_more_than_their_replicates(frictionless):
    """Each sample from the other: 1 to 6 % off, more than the replicates of one differ (0.6 % at 3 mm)."""
    own = {p.test: p for p in frictionless.predictions if p.law == "neo_hooke" and p.fitted}
    assert set(own) == {"A", "B"}
    assert own["A"].fitted == ["B"] and own["B"].fitted == ["A"]
    for prediction in own.values():
        assert 0.6 < prediction.percent < 6.0


@pytest.mark.slow
def test_tension_of_the_same_silicone_is_overpredicted(frictionless):
    """Another batch, rate and laboratory: the silicone in tension is half as stiff as compression says."""
    with (frictionless.output / "residuals.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file)
                if row["law"] == "neo_hooke" and row["replicate"].startswith("tension/")]
    displacement, measured, model = (np.array([float(row[name]) for row in rows])
                                     for name in ("displacement [mm]", "measured [N]", "model [N]"))
    at = np.searchsorted(displacement, 0.5 * 33.0)
    assert 1.5 < model[at] / measured[at] < 3.0
    error = next(p for p in frictionless.predictions if p.test == "tension" and p.law == "neo_hooke")
    assert error.percent == pytest.approx(100 * np.sqrt(np.mean((model - measured)**2)) / measured.max(), rel=1e-3)


@pytest.mark.slow
def test_no_friction_is_lubricated(frictionless, data_folder, tmp_path):
    """A coefficient of 0 is the same test as lubricated platens, to the last digit."""
    found = law(fit(tmp_path, data_folder, ["neo_hooke"], kind="friction_compression",
                    face="friction = 0.0\nfriction_base = 0.0"), "neo_hooke")
    assert found.parameters == law(frictionless, "neo_hooke").parameters
    assert found.intervals95 == law(frictionless, "neo_hooke").intervals95


@pytest.mark.slow
def test_friction_changes_the_modulus_and_not_the_misfit(frictionless, data_folder, tmp_path):
    """With bonded instead of frictionless platens C10 is a quarter smaller at the same misfit."""
    bonded = law(fit(tmp_path, data_folder, ["neo_hooke"], kind="bonded_compression"), "neo_hooke")
    free = law(frictionless, "neo_hooke")
    assert bonded.parameters["C10"] / free.parameters["C10"] == pytest.approx(0.72, abs=0.03)
    assert 0.8 < bonded.RMSE_N / free.RMSE_N < 1.2
    assert bonded.intervals95["C10"][1] < free.intervals95["C10"][0]
