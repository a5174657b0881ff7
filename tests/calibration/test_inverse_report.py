"""The page of an inverse calibration: what it says first, what its pictures show, and that it stands alone."""

import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibration.campaign.campaign import Campaign, FitSettings, Noise
from calibration.campaign.campaign import Test as CampaignTest
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.curves import TestCurves as CurvesOfTest
from calibration.fit.fit import (
    DescentEvaluation,
    Fit,
    MeshCorrectionSummary,
    Nuisance,
    ParameterCovariance,
    Prediction,
    ProfileLikelihood,
    RegionMisfitTest,
    ReplicateJitterRecord,
    SensorNoiseRecord,
    SuggestedTest,
    WeakDirection,
)
from calibration.fit.result import CalibrationResult
from calibration.report import curve_figures, figures
from calibration.report.drawing import FigureEmbedder
from calibration.report.outputs import build_report_page
from calibration.report.png import render_png
from calibration.report.quantities import ReportUnits
from calibration.report.section import CalibrationReport
from calibration.report.sections.statements import make_plain_methods_text
from calibration.statistics.sensor_noise import SensorNoise
from tissue_sim import KINDS, Specimen, find_law

LEVEL = 3.8414588  # 95 % quantile of chi-square with one degree of freedom
JITTER = 0.03e-3
#: Jitter of the zero, N.
ZERO = 0.01
#: Standard deviation of the force, N.
NOISE = 0.02
TRUTH = {"C10": 1404.9, "C20": 699.4}
SPECIMEN = Specimen(0.04, 0.07, "phantom")


def make_test(name, kind, specimen=SPECIMEN, hold_out=False):
    return CampaignTest(name, KINDS[kind], specimen, (Path(f"{name}_1.csv"),), hold_out=hold_out)


PLATES = make_test("plates", "lubricated_compression")
NEEDLE = make_test("needle", "needle_indentation")
STRIP = make_test("strip", "uniaxial_tension", specimen=None)
BONDED = make_test("bonded", "bonded_compression", hold_out=True)
TESTS = (PLATES, NEEDLE, STRIP, BONDED)


def force_of(test, parameters, d):
    """Force, N (Pa of the strip), at displacements d: the law's uniaxial curve, times what a shape does."""
    law = find_law("mooney_rivlin" if "C01" in parameters else "reduced_polynomial_2")
    if test is STRIP:
        return law.nominal_stress(1 + d, parameters)
    area = {"plates": np.pi * 0.04**2, "needle": 2.2 * np.pi * 0.008**2, "bonded": 1.23 * np.pi * 0.04**2}[test.name]
    return -law.nominal_stress(1 - d / 0.07 * (2.0 if test is NEEDLE else 1.0), parameters) * area


def slope_of(test, parameters, d, by=None):
    """Derivative by displacement, or by a parameter."""
    if by is None:
        return (force_of(test, parameters, d + 1e-7) - force_of(test, parameters, d - 1e-7)) / 2e-7
    step = {**parameters, by: parameters[by] + 1.0}
    return force_of(test, step, d) - force_of(test, parameters, d)


def way_of(time):
    """Ramp of 40 s, hold of 60 s, unload of 40 s, as a share of the depth."""
    return np.clip(np.minimum(time / 40, (140 - time) / 40), 0.0, 1.0)


def record(test, seed):
    rng = np.random.default_rng([seed, TESTS.index(test)])
    stress = test is STRIP
    if test is NEEDLE:
        time = np.linspace(0.0, 140.0, 401)
        way = way_of(time)
        segment = np.where(time < 40, "ramp", np.where(time <= 100, "hold", "unload"))
    else:
        time, segment = np.linspace(0.0, 40.0, 401), None
        way = time / 40
    d = way * (0.3 if stress else 0.01)
    a = 0.0 if stress else rng.normal(0.0, JITTER)
    force = force_of(test, TRUTH, d - a) + rng.normal(0.0, 8.0 if stress else NOISE, d.size)
    if not stress:
        force += rng.normal(0.0, ZERO)
    if test is NEEDLE:
        # What the elastic model does not know: the force relaxes.
        held = np.clip(time - 40, 0.0, 60.0)
        force *= 1 - 0.06 * (1 - np.exp(-held / 8.0))
    name = f"{test.name}_{seed}"
    return MeasuredCurve(name=name, test=test, time=time, displacement=d, force=force, segment=segment,
                         file=Path(f"{name}.csv"), sha256=f"{seed:x}{test.name[:1].encode().hex()}" * 16,
                         noise=SensorNoise(8.0 if stress else NOISE))


def curves_of(test, parameters, covariance):
    measured = tuple(record(test, seed) for seed in (1, 2, 3))
    time = np.linspace(0.0, 140.0, 141) if test is NEEDLE else None
    path = np.linspace(0.0, measured[0].displacement.max(), 81) if time is None else 0.01 * way_of(time)
    slopes = np.stack([slope_of(test, parameters, path, name) for name in covariance])
    matrix = np.array([list(row) for row in covariance.values()])
    error = np.sqrt(np.einsum("ik,ij,jk->k", slopes, matrix, slopes) + (0.001 * force_of(test, parameters, path)) ** 2)
    stress = test is STRIP
    jitter = 0.0 if stress else (JITTER * slope_of(test, parameters, path)) ** 2 + ZERO**2
    band = 1.96 * np.sqrt(error**2 + jitter + measured[0].noise.deviation**2)
    fitted = []
    for m in measured:
        model, slope = force_of(test, parameters, m.displacement), slope_of(test, parameters, m.displacement)
        columns = np.stack([-slope, np.ones_like(slope)], axis=1)
        # Penalised by what offset and zero usually are.
        rows = np.concatenate([columns / m.noise.deviation, np.diag([1 / JITTER, 1 / ZERO])])
        data = np.concatenate([(m.force - model) / m.noise.deviation, np.zeros(2)])
        nuisance = np.zeros(2) if stress else np.linalg.lstsq(rows, data, rcond=None)[0]
        fitted.append(model + columns @ nuisance)
    return CurvesOfTest(test, measured, time, path, force_of(test, parameters, path), error, band, 1.5 * band,
                        tuple(fitted))


def profile_of(value, error, low=None, skew=0.0):
    values = [value + k * error for k in np.linspace(-2.6, 2.6, 13)]
    notes = []
    if low is not None and values[0] < low:
        values, notes = [low, *(v for v in values if v > low)], [f"low: bound {low:g}"]
    values = sorted({*values, value})
    rises = [((v - value) / error) ** 2 * (1 + skew * (v - value) / error) for v in values]
    return ProfileLikelihood(values=values, rises=rises, level=LEVEL, notes=notes)


def history_of(parameters, starts, rng):
    steps = []
    for start in range(1, starts + 1):
        away = {name: rng.uniform(-2.0, 2.0) for name in parameters}
        for run in range(1, int(rng.integers(4, 8)) + 1):
            left = {name: far * 0.25 ** (run - 1) for name, far in away.items()}
            error = 3610.0 * (1 + sum(far**2 for far in left.values()) * 30) + 0.1 * start
            steps.append(DescentEvaluation(start=start, run=run, parameters={
                name: value * np.exp(left[name]) if value else 900.0 * max(left[name], 0.0)
                for name, value in parameters.items()}, error=error,
                RMSE_N=0.02 * np.sqrt(error / 3610), corrected=run > 3 and start == 1))
    return steps


def regions(*rows):
    return [RegionMisfitTest(test=test, segment=segment, start=start, end=end, p=p, statistic=9.1, freedom=5,
                             misfit_N=misfit,
                             largest_N=-1.7 * misfit, at=end, adequate=p > 0.05)
            for (test, segment, start, end), (p, misfit) in zip(PLACES, rows, strict=True)]


PLACES = (("plates", "ramp", 0.0, 3.3), ("plates", "ramp", 3.3, 6.7), ("plates", "ramp", 6.7, 10.0),
          ("needle", "ramp", 0.0, 10.0), ("needle", "hold", 10.0, 10.0), ("needle", "unload", 0.0, 10.0),
          ("strip", "", 0.0, 0.3))


def make_fit(law, parameters, covariance, **changes):
    order = list(covariance)
    matrix = np.array(list(covariance.values()))
    deviation = np.sqrt(np.diag(matrix))
    whole = np.outer(deviation, deviation)
    base = {
        "law": law, "formula": find_law(law).formula(), "parameters": parameters,
        "symbols": {name: name for name in order}, "units": {name: find_law(law).units[name] for name in order},
        "standard_errors": {name: float(s) or None for name, s in zip(order, deviation, strict=True)},
        "covariance": ParameterCovariance(order=order, matrix=matrix.tolist()),
        "correlation": np.divide(matrix, whole, out=np.eye(len(order)), where=whole > 0).tolist(),
        "covariance_from": "noise", "not_identifiable": [], "on_bound": [],
        "intervals95": {name: (parameters[name] - 1.96 * s, parameters[name] + 1.96 * s) if s else None
                        for name, s in zip(order, deviation, strict=True)},
        "R2": 0.99993, "RMSE_N": 0.0214, "RMSE_Pa": None, "noise_ratio": 1.03, "AIC": -100.0, "BIC": -90.0,
        "E0": 8429.6, "mu0": 2809.8, "stable_from": 0.3, "stable_to": 3.0, "stability": "stable from 0.3 to 3",
        "stretch_range": (0.7, 1.3), "starts": 20, "status": "converged", "message": "converged in 6 solves",
        "iterations": 90, "fem_solves": 270, "cpu_s": 1.83}
    return Fit(**{**base, **changes})


@pytest.fixture(scope="module")
def campaign():
    """Two laws on four tests, one held out, one relaxing; the second law has a parameter on its bound."""
    rng = np.random.default_rng(5)
    polynomial = {"C10": 1406.2, "C20": 688.0}
    near = {"C10": (4.1**2, -0.82 * 4.1 * 24.0), "C20": (-0.82 * 4.1 * 24.0, 24.0**2)}
    mooney = {"C10": 1467.0, "C01": 0.0}
    bound = {"C10": (3.0**2, 0.0), "C01": (0.0, 0.0)}
    jitter = ReplicateJitterRecord(contact_mm=0.028, zero_N=0.0094, freedom=6)
    mesh = [MeshCorrectionSummary(test="needle", largest_percent=0.62, remainder_percent=0.06, refreshes=2)]
    best = make_fit(
        "reduced_polynomial_2", polynomial, near, not_identifiable=[], condition=38.0, left_out=1.31, jitter=jitter,
        mesh=mesh, profiles={"C10": profile_of(1406.2, 4.1, skew=0.02), "C20": profile_of(688.0, 24.0, skew=0.06)},
        directions=[WeakDirection(shares={"C10": -0.08, "C20": 0.997}, relative_error=0.035)],
        history=history_of(polynomial, 20, rng),
        regions=regions((0.62, 0.0021), (0.9, 0.0012), (0.31, 0.003), (0.21, 0.012), (3e-11, 0.047), (4e-7, 0.058),
                        (0.44, 1.1)),
        nuisances=[Nuisance(replicate=f"{test.name}_{seed}", contact_offset_mm=0.01 * seed,
                            contact_offset_error_mm=0.004, zero_offset_N=-0.002 * seed, zero_offset_error_N=0.003)
                   for test in (PLATES, NEEDLE) for seed in (1, 2, 3)])
    second = make_fit(
        "mooney_rivlin", mooney, bound, on_bound=["C01"], not_identifiable=["C01"], R2=0.9981, RMSE_N=0.061, BIC=3100.0,
        intervals95={"C10": (1461.0, 1473.0), "C01": (0.0, 55.0)}, interval_notes={"C01": "low: bound 0"},
        message="C01 on its bound", condition=4.1e6, left_out=6.4, history=history_of(mooney, 20, rng), jitter=jitter,
        profiles={"C10": profile_of(1467.0, 3.0), "C01": profile_of(0.0, 28.0, low=0.0)},
        regions=regions((1e-4, 0.011), (1e-9, 0.03), (0.0, 0.09), (1e-8, 0.03), (0.04, 0.021), (4e-7, 0.05),
                        (1e-5, 91.0)),
        suggestions=[SuggestedTest(test="bonded compression to 10 mm", standard_errors={"C10": 2.0, "C01": 6.5})])
    predictions = []
    for law, factor in (("reduced_polynomial_2", 1.0), ("mooney_rivlin", 4.6)):
        for name, percent, newton, pascal in (("plates", 0.9, 0.068, None), ("needle", 1.7, 0.036, None),
                                              ("strip", 1.1, None, 41.0), ("bonded", 0.8, 0.075, None)):
            left = [] if name == "bonded" else [t.name for t in TESTS[:3] if t.name != name]
            predictions.append(Prediction(
                test=name, law=law, RMSE_N=newton and newton * factor, RMSE_Pa=pascal and pascal * factor,
                percent=percent * factor, expected_N=newton and 0.031, fitted=left))
    settings = FitSettings(("reduced_polynomial_2", "mooney_rivlin"), method="inverse_fem", bounds={"C01": (0.0, 1e5)})
    told = Campaign(Path("study.toml"), {"phantom": SPECIMEN}, TESTS, settings, Noise(), "ab" * 32)
    noise = tuple(SensorNoiseRecord(test=t.name, deviation_N=8.0 if t is STRIP else NOISE, correlation_time_s=0.0,
                                    source="estimated") for t in TESTS)
    result = CalibrationResult(
        told, (best, second), tuple(predictions), "Best by prediction of the tests left out: reduced_polynomial_2.",
        Path("out"), "cd" * 32, noise=noise)
    curves = {best.law: [curves_of(t, polynomial, near) for t in TESTS],
              second.law: [curves_of(t, mooney, bound) for t in TESTS]}
    return result, curves


def closes(page):
    """Return whether every tag is closed in the right order."""
    opened = []
    for end, tag in re.findall(r"<(/?)([a-z][a-z0-9]*)[ >]", page):
        if end and (not opened or opened.pop() != tag):
            return False
        if not end and tag not in ("img", "meta", "br"):
            opened.append(tag)
    return not opened


def written(campaign, tmp_path, figures=True):
    result, curves = campaign
    measured = {c.test.name: c.measured for c in next(iter(curves.values()))}
    methods = make_plain_methods_text(result, measured, ReportUnits.choose_for_best_fit(result))
    return build_report_page(CalibrationReport(result, curves, methods,
                                               FigureEmbedder(tmp_path, "svg") if figures else None))


def texts_of(axes):
    return [text.get_text() for text in axes.texts]


def one_test(campaign, test):
    result, curves = campaign
    return result.fits, {law: several[TESTS.index(test)] for law,
                         several in curves.items()}, ReportUnits.choose_for_best_fit(result)


@pytest.mark.slow
def test_the_page_is_self_contained_and_begins_with_the_summary(campaign, tmp_path):
    page = written(campaign, tmp_path)
    assert not re.search(r"(src|href)=[\"']?https?:", page) and "<script" not in page
    # Four tests, predictions, regions, history; two profiles, one correlation; two formulas.
    assert page.count("data:image/png;base64,") == 4 + 3 + 3 + 2
    verdict = page[page.index('<dl class="verdict">'):page.index("<img")]
    for words in ("<i>C</i><sub>10</sub> = 1.406 ± 0.004 kPa", "<i>C</i><sub>20</sub> = 0.688 ± 0.024 kPa",
                  "fitted to plates, strip only: 0.036 N", "1.7\u00a0%",
                  "held out of every fit: 0.075 N", "expected by chance: 0.031 N", "0.041 kPa",
                  "determine every parameter of Reduced", "bonded compression to 10 mm would give C01 ± 0.006 kPa"):
        assert words in verdict
    # Misfits, the least probable first, and no region that is as noise.
    assert verdict.index("hold at 10 mm: 0.047 N") < verdict.index("unload from 0 to 10 mm: 0.058 N")
    assert "0.012 N" not in verdict
    for words in ("low: bound 0", "0.028 mm and the force zero by 0.0094 N", "6 degrees of freedom", "up to 0.62 %",
                  "1.00 C20 − 0.08 C10, known to ±\u00a03.5", "4.1e+06", record(PLATES, 1).sha256):
        assert words in page
    last = [step for fit in campaign[0].fits for step in fit.history if step.start == 20]
    assert page.count("<tr><td>20</td><td>") == len(last)
    assert closes(page)


def test_without_figures_the_correlation_is_a_table_and_names_cannot_break_the_page(campaign, tmp_path):
    result, curves = campaign
    odd = replace(PLATES, name="<u>&plates")
    tests = (odd, *TESTS[1:])
    rename = {PLATES.name: odd.name}
    fits = tuple(msgspec.structs.replace(fit, regions=[
        msgspec.structs.replace(r, test=rename.get(r.test, r.test)) for r in fit.regions]) for fit in result.fits)
    predictions = tuple(msgspec.structs.replace(p, test=rename.get(p.test, p.test), fitted=[
        rename.get(name, name) for name in p.fitted]) for p in result.predictions)
    changed = replace(result, campaign=replace(result.campaign, tests=tests), fits=fits, predictions=predictions,
                      noise=())
    curves = {law: [replace(c, test=test) for c, test in zip(several, tests, strict=True)]
              for law, several in curves.items()}
    page = written((changed, curves), tmp_path, figures=False)
    assert "<img" not in page
    assert "<td>−0.820</td>" in page
    assert "&lt;u&gt;&amp;plates" in page and "<u>" not in page
    assert closes(page)


@pytest.mark.slow
def test_the_report_of_a_single_test_states_that_there_is_no_prediction(campaign, tmp_path):
    result, curves = campaign
    bare = msgspec.structs.replace(result.best, regions=[], profiles={}, history=[], nuisances=[], left_out=None)
    alone = replace(result, campaign=replace(result.campaign, tests=(PLATES,)), fits=(bare,), predictions=(),
                    noise=result.noise[:1])
    page = written((alone, {bare.law: curves[bare.law][:1]}), tmp_path)
    assert "No prediction: all tests were fitted." in page
    # The test, the correlation and the formula.
    assert page.count("data:image/png;base64,") == 3


@pytest.mark.slow
def test_pictures_are_sharp_at_1200_pixels_and_thin_large_recordings(campaign):
    fits, curves, units = one_test(campaign, PLATES)
    png = render_png(curve_figures.draw_test_figure(fits, curves, units))
    assert png[:8] == b"\x89PNG\r\n\x1a\n" and int.from_bytes(png[16:20], "big") >= 1200

    def longer(c):
        many = [replace(m, time=np.repeat(m.time, 100), displacement=np.repeat(m.displacement, 100),
                        force=np.repeat(m.force, 100)) for m in c.measured]
        return replace(c, measured=tuple(many), fitted=tuple(np.repeat(f, 100) for f in c.fitted))

    many = render_png(curve_figures.draw_test_figure(fits, {law: longer(c) for law, c in curves.items()}, units))
    assert len(many) < 1.5 * len(png)


def test_band_and_residuals_of_a_ramp(campaign):
    fits, curves, units = one_test(campaign, PLATES)
    best = curves["reduced_polynomial_2"]
    shown = curve_figures.draw_test_figure(fits, curves, units)
    force, stress, tangent, band, residual = shown.axes
    assert force.get_xlabel() == "displacement [mm]" and force.get_ylabel() == "force [N]"
    assert [t.get_text() for t in shown.legends[0].get_texts()][:4] == [
        "measured (3 recordings)", "Reduced polynomial N = 2", "95 % of new recordings", "Mooney-Rivlin"]
    assert all(panel.get_legend() is None for panel in shown.axes)
    # The same samples in every view, in units of the law's modulus.
    assert stress.get_ylabel() == "nominal stress [kPa]" and tangent.get_ylabel() == "tangent modulus [kPa]"
    np.testing.assert_allclose(stress.lines[0].get_ydata(), force.lines[0].get_ydata() / SPECIMEN.area / 1e3)
    places, slopes = next(line for line in tangent.lines if line.get_label() == "Reduced polynomial N = 2").get_data()
    law = find_law("reduced_polynomial_2")
    slope = law.nominal_stress_slope(1 - places, fits[0].parameters) / 1e3
    np.testing.assert_allclose(slopes, slope, rtol=2e-3)
    edge = band.collections[0].get_paths()[0].vertices
    assert edge[:, 1].max() == pytest.approx(best.band.max()) and edge[:, 1].min() == pytest.approx(-best.band.max())
    cloud = next(line for line in band.lines if line.get_marker() == "o")
    m = best.measured[0]
    model = force_of(PLATES, fits[0].parameters, m.displacement)
    np.testing.assert_allclose(cloud.get_ydata(), model - m.force, atol=2e-3)
    mean = next(line for line in residual.lines if line.get_linewidth() == 2.2)
    inside = (m.displacement >= 0) & (m.displacement < 0.01 / 60)
    first = np.mean([np.mean((f - m.force)[inside]) for m, f in zip(best.measured, best.fitted, strict=True)])
    assert mean.get_ydata()[0] == pytest.approx(first)
    assert not texts_of(residual)


def test_a_test_that_holds_is_drawn_against_time_with_its_misfits_where_they_are(campaign):
    residual = next(axes for axes in curve_figures.draw_test_figure(*one_test(campaign, NEEDLE)).axes if axes.texts)
    assert residual.get_xlabel() == "time [s]"
    assert texts_of(residual) == ["0.047 N", "0.058 N"]
    spans = [patch.get_extents().transformed(residual.transData.inverted()).intervalx
             for patch in residual.patches if patch.get_alpha() == 0.09]
    assert spans[0] == pytest.approx([40.0, 100.0], abs=0.4)
    assert spans[1] == pytest.approx([100.0, 140.0], abs=0.4)


def test_a_test_without_specimen_is_drawn_as_stress_and_strain(campaign):
    force, *_ = curve_figures.draw_test_figure(*one_test(campaign, STRIP)).axes
    assert force.get_xlabel() == "nominal strain" and force.get_ylabel() == "nominal stress [kPa]"
    law = next(line for line in force.lines if line.get_label() == "Reduced polynomial N = 2")
    assert law.get_ydata()[-1] == pytest.approx(1e-3 * force_of(STRIP, campaign[0].best.parameters, 0.3))


@pytest.mark.parametrize("correlation_time", [0.0, 0.3, 2.0])
def test_noise_of_a_mean_is_that_of_the_dense_covariance(correlation_time):
    step, counts = 0.1, np.array([1, 2, 7, 40])
    found = curve_figures.compute_standard_errors_at_unit_variance(counts, step, correlation_time)
    for n, deviation in zip(counts, found, strict=True):
        lag = step * np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        dense = np.exp(-lag / correlation_time) if correlation_time else np.eye(n)
        assert deviation == pytest.approx(np.sqrt(dense.sum()) / n)


def test_regions_turn_orange_where_the_misfit_is_significant(campaign):
    result, _ = campaign
    axes = figures.draw_region_misfit_map(result.fits, TESTS, ReportUnits.choose_for_best_fit(result)).axes[0]
    assert "0.0021 N,  p = 0.62" in texts_of(axes) and "0.091 kPa,  p = 1e-5" in texts_of(axes)
    assert {"plates", "needle", "strip", "hold at 10 mm", "ramp from 3.3 to 6.7 mm"} <= set(texts_of(axes))
    red, _, blue, _ = np.array([patch.get_facecolor()[0] for patch in axes.collections]).T
    cells = [r for name in ("plates", "needle", "strip") for fit in result.fits for r in fit.regions if r.test == name]
    assert [b > r for r, b in zip(red, blue, strict=True)] == [cell.adequate for cell in cells]


def test_predictions_are_as_long_as_their_error_and_marked_where_chance_ends(campaign):
    result, _ = campaign
    lost = Prediction(test="bonded", law="neo_hooke", RMSE_N=None, RMSE_Pa=None, percent=None,
                      note="stopped at 7 mm")
    axes = figures.draw_prediction_errors([*result.predictions, lost], TESTS,
                                          ReportUnits.choose_for_best_fit(result)).axes[0]
    assert [bar.get_width() for bar in axes.patches] == pytest.approx([p.percent for p in result.predictions])
    assert axes.lines[0].get_xdata()[0] == pytest.approx(0.9 * 0.031 / 0.068)
    assert any("none (stopped at 7 mm)" in words for words in texts_of(axes))
    far = msgspec.structs.replace(result.predictions[-1], percent=900.0)
    axes = figures.draw_prediction_errors([*result.predictions[:-1], far], TESTS,
                                          ReportUnits.choose_for_best_fit(result)).axes[0]
    assert axes.get_xlim()[1] < 20 and any(words.startswith("▸ 900\u00a0%") for words in texts_of(axes))


def test_profiles_show_interval_quadratic_and_bound(campaign):
    result, _ = campaign
    free, bound = figures.draw_profiles(result.fits[1], result.campaign.fit.bounds,
                                                 ReportUnits.choose_for_best_fit(result)).axes
    lines = {line.get_label(): line for line in free.lines}
    x, y = lines["quadratic"].get_data()
    assert np.interp(1.467 + 1.959964 * 0.003, x, y) == pytest.approx(LEVEL, rel=1e-3)
    assert lines["95 % interval"].get_xdata() == pytest.approx([1.461, 1.473])
    lines = {line.get_label(): line for line in bound.lines}
    assert "quadratic" not in lines and lines["95 % interval"].get_xdata() == pytest.approx([0.0, 0.055])
    assert free.get_title().endswith("95 %: 1.4610 to 1.4730") and not texts_of(free)
    assert "beyond a bound" in {patch.get_label() for patch in bound.patches} and not free.patches
    hatched = next(patch for patch in bound.patches if patch.get_hatch())
    assert hatched.get_x() + hatched.get_width() == pytest.approx(0.0) and hatched.get_x() < 0
    # The curve passes through the points of the profile.
    curve, points = lines["profile"], result.fits[1].profiles["C01"]
    assert np.interp(points.values[4] / 1e3, *curve.get_data()) == pytest.approx(points.rises[4], rel=1e-2)


def test_correlation_of_two_has_an_ellipse_and_of_three_its_weak_directions(campaign):
    (best, second), units = campaign[0].fits, ReportUnits.choose_for_best_fit(campaign[0])
    matrix, region, _ = figures.draw_parameter_correlation_or_none(best, units).axes
    assert texts_of(matrix) == ["1", "−0.82", "−0.82", "1"]
    outer = region.patches[0].get_xy()
    reach = np.sqrt(5.991465)  # 95 % quantile of chi-square with two degrees of freedom
    assert outer.max(axis=0) == pytest.approx([1.4062 + reach * 4.1e-3, 0.688 + reach * 24e-3], rel=1e-4)
    assert figures.draw_parameter_correlation_or_none(second, units) is None
    three = make_fit("reduced_polynomial_3", {"C10": 1.0, "C20": 2.0, "C30": 3.0},
                     {name: tuple(row) for name, row in zip(("C10", "C20", "C30"), np.eye(3), strict=True)},
                     directions=[WeakDirection(shares={"C10": 0.1, "C20": -0.7, "C30": 0.7}, relative_error=0.6)])
    weak = figures.draw_parameter_correlation_or_none(three, units)
    bars = weak.axes[1]
    assert [bar.get_width() for bar in bars.patches] == pytest.approx([0.1, -0.7, 0.7])
    assert weak.legends[0].get_texts()[0].get_text() == "known to ± 60 %"


def test_history_has_every_start_and_the_chosen_one_is_bold(campaign):
    result, _ = campaign
    assert figures.find_best_start_preferring_corrected(result.best) == 1
    lower = msgspec.structs.replace(result.best.history[-1], start=21, run=1, error=1.0)
    uncorrected = msgspec.structs.replace(result.best, history=[*result.best.history, lower])
    assert figures.find_best_start_preferring_corrected(uncorrected) == 1
    shown = figures.draw_descent_history(result.fits)
    above = next(ax for ax in shown.axes if ax.get_title() == "Reduced polynomial N = 2")
    assert above.get_yscale() == "log"
    bold = [line for line in above.lines if line.get_linewidth() == 2.4]
    assert len(bold) == 1
    assert list(bold[0].get_ydata()) == [step.error for step in result.best.history if step.start == 1]
    assert sum(line.get_linewidth() == 0.8 and line.get_xdata().size > 0 for line in above.lines) == 19
