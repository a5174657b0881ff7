"""Fits that keep the law Drucker-stable, against a search along the limit of stability."""

import numpy as np
import pytest
from scipy.optimize import brentq

import tissue_sim as ts
from calibration import calibrate
from tissue_sim.laws.modes import MODES
from tissue_sim.laws.stability import compute_stability_margins

#: Stretches of the test, 1.
STRETCH = np.linspace(1.0, 0.6, 40)
#: Mooney-Rivlin parameters of the data, Pa: unstable in equibiaxial compression.
EXACT = {"C10": 1500.0, "C01": -400.0}


def fit(folder, stress, lines, law="mooney_rivlin"):
    """Fit of one law to a lubricated compression."""
    folder.mkdir()
    ts.write_recording(ts.Recording({"stretch": STRETCH, "nominal stress": stress}), folder / "test.csv")
    (folder / "study.toml").write_text("\n".join([
        "[[test]]", 'name = "test"', 'kind = "lubricated_compression"', 'recordings = ["test.csv"]', "[fit]",
        f'laws = ["{law}"]', *lines]) + "\n", encoding="utf-8")
    return calibrate([folder / "study.toml"], folder / "out", figures=False)[0].fits[0]


def is_stable(law, values, stretches):
    return ts.find_stability_range(ts.find_law(law), values, stretches).is_stable_in_whole_range


@pytest.mark.parametrize(("line", "stretches"), [("stable = true", (0.6, 1.0)), ("stable = [0.7, 1.5]", (0.7, 1.5))])
def test_constrained_minimum(line, stretches, tmp_path):
    """Stability depends on C01/C10 only: the minimum is at the critical ratio, with C10 by linear least squares."""
    law = ts.find_law("mooney_rivlin")
    stress = law.nominal_stress(STRETCH, EXACT)
    free = fit(tmp_path / "free", stress, [])
    assert free.parameters == pytest.approx(EXACT, rel=1e-6)
    assert not is_stable(law.name, EXACT, stretches)
    ratio = brentq(lambda ratio: is_stable(law.name, [1.0, ratio], stretches) - 0.5, -0.9, 0.0, xtol=1e-10)
    unit = law.nominal_stress(STRETCH, [1.0, ratio])
    expected = float(unit @ stress) / float(unit @ unit)
    found = fit(tmp_path / "stable", stress, [line])
    assert is_stable(law.name, found.parameters, stretches)
    assert (found.parameters["C10"], found.parameters["C01"]) == pytest.approx((expected, ratio * expected), rel=5e-3)
    residual = law.nominal_stress(STRETCH, found.parameters) - stress
    assert residual @ residual <= 1.01 * float(np.sum((expected * unit - stress)**2))
    assert any("fit.stable is active" in warning for warning in found.warnings) and "fit.stable" in found.message


def test_stable_minimum_is_not_changed(tmp_path):
    law = ts.find_law("ogden_1")
    stress = law.nominal_stress(STRETCH, [2000.0, 4.0]) * (1.0 + 0.01 * np.sin(40.0 * STRETCH))
    free, stable = (fit(tmp_path / name, stress, lines, "ogden_1") for name, lines in
                    (("free", []), ("stable", ["stable = true"])))
    assert dict(stable.parameters) == dict(free.parameters) and stable.warnings == free.warnings


@pytest.mark.parametrize(("law", "values"), [
    ("reduced_polynomial_2", [1000.0, -300.0]), ("ogden_2", [2000.0, 3.0, -500.0, 8.0]), ("gent", [1000.0, 0.5]),
    ("hyperfoam_2", [1000.0, 2.0, 0.3, -800.0, 12.0, 0.3])])
def test_margins_change_sign_at_the_limits(law, values):
    limits = ts.find_stability_range(ts.find_law(law), values).limits
    for row, mode in enumerate(MODES):
        for limit, inwards in zip(limits[mode], (1.001, 0.999), strict=True):
            if limit not in (0.3, 3.0):
                inside, outside = compute_stability_margins(ts.find_law(law), values, [limit * inwards,
                                                                                       limit / inwards])[row]
                assert outside <= 0 < inside < 0.1 or (law == "gent" and outside == -1)
    at_rest = compute_stability_margins(ts.find_law(law), values, [1.0])
    assert (at_rest > 0).all() and (ts.find_law(law).is_compressible or at_rest == pytest.approx(1.0, rel=1e-9))


@pytest.mark.parametrize(("lines", "message"), [
    (["stable = [0.7, 0.9]"], r"fit\.stable.*contains 1; got \[0.7, 0.9\]"),
    (["stable = true", 'method = "inverse_fem"'], r"fit\.stable.*must be false with fit.method = 'inverse_fem'")])
def test_refusals(lines, message, tmp_path):
    with pytest.raises(ts.InputError, match=message):
        fit(tmp_path / "refused", -1e3 * (1.0 - STRETCH), lines)
