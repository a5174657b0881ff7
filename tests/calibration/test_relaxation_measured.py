"""Relaxation of measured materials: VHB adhesive in shear and tension, cells under an AFM tip."""

import re

import numpy as np
import pytest

from calibration import fit_hold

CELLS = "10.1002_btm2.10294_fig5d-cell1.zip"


@pytest.fixture(scope="module")
def adhesive(data_folder):
    """Recordings of the folder by file name, from sheets without a header: time s, strain, nominal stress kPa."""
    from tissue_sim.recording.formats.xlsx import read_xlsx

    def read(name, strain, column, stress):
        columns = {"time": {"column": 1, "unit": "s"}, strain: {"column": column, "unit": "-"},
                   "nominal stress": {"column": stress, "unit": "kPa"}}
        return read_xlsx(data_folder / "oca_vhb_viscoelastic" / f"{name}.xlsx", columns=columns)
    return read


def stepped(adhesive, name):
    """Ramp to shear strain 2 and hold; the later steps lead to 10."""
    whole = adhesive(f"cyclic-shear-relaxation-test__{name}", "shear strain", 5, 4)
    return whole, whole.select(slice(0, int(np.argmax(whole.channel("shear strain") > 2.5))))


def tension(adhesive, *names):
    return [adhesive(f"uniaxial-loading-unloading-test__loading_{name}", "stretch", 2, 3) for name in names]


def relative(fit, recordings):
    largest = max(np.abs(recording.channel("nominal stress")).max() for recording in recordings)
    return fit.RMSE_Pa / largest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["shear_relaxation_0d1", "shear_relaxation_1", "shear_relaxation_2",
                                  "shear_relaxation_5"])
def test_ramp_and_hold_in_shear(adhesive, name, fit_relaxation):
    _, first = stepped(adhesive, name)
    found = fit_relaxation(first, "reduced_polynomial_2", 2, kinds="simple_shear")
    assert relative(found.fit, [first]) < 0.01 and found.fit.R2 > 0.997
    assert 0.5 < found.prony.relaxing_fraction < 0.9 and 4.0 < found.prony.tau[0] < 40.0
    assert 10e3 < found.material.mu0 < 40e3


@pytest.mark.slow
def test_form_b_does_not_follow_five_steps_to_shear_10(adhesive, fit_relaxation):
    """The overstress of form b is too stiff at shear 10, so that a fit of all steps misses by several per cent."""
    whole, first = stepped(adhesive, "shear_relaxation_1")
    fit = fit_relaxation(whole, "reduced_polynomial_2", 2, kinds="simple_shear").fit
    correlation = float(re.search(r"neighbours correlate by ([\d.]+)", fit.message)[1])
    assert relative(fit, [whole]) > 0.04 and correlation > 0.95 and "they are a model error" in fit.message
    window = fit_relaxation(whole, "reduced_polynomial_2", 2, kinds="simple_shear", test="max_strain = 2.5").fit
    assert relative(window, [first]) < 0.01


@pytest.mark.slow
def test_loading_and_unloading_in_tension(adhesive, fit_relaxation):
    one = tension(adhesive, "1d5_unloading_0d01")
    assert relative(fit_relaxation(one, "ogden_1", 1, kinds="uniaxial_tension").fit, one) < 0.006
    rates = tension(adhesive, "1d5_unloading_0d01", "1d5_unloading_0d03", "1d5_unloading_0d05")
    fit = fit_relaxation(rates, "reduced_polynomial_2", 2, kinds="uniaxial_tension").fit
    assert relative(fit, rates) < 0.02 and fit.R2 > 0.995


@pytest.mark.slow
def test_cells_under_a_tip(data_folder):
    from tissue_sim.recording.formats.afm import read_afm

    found = []
    for curve in read_afm(data_folder / "afm_formats" / CELLS):
        segment = curve.labels["segment"]
        approach = curve.select(segment == "approach")
        pressed = approach.time[approach.displacement > 0]
        held = curve.select(np.flatnonzero(segment == "hold")[::20])
        fit = fit_hold(held, 2, ramp=float(np.ptp(pressed)))
        assert fit.status == "converged" and fit.RMSE / held.force.max() < 0.005
        assert fit.prony.relaxing_fraction > 0.5
        found.append([*fit.prony.g, *fit.prony.tau])
    # The same place fifteen times: the times repeat.
    assert len(found) == 15
    scatter = np.std(found, axis=0) / np.mean(found, axis=0)
    assert (scatter < 0.25).all()
