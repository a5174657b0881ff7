"""Views of a test: tangents, stress and strain, holds on a logarithmic axis; pictures as files; methods."""

from html import unescape

import numpy as np
import pytest

import tissue_sim as ts
from calibration import calibrate
from calibration.report.curve_figures import draw_test_figure
from calibration.report.drawing import distribute_panels_over_rows
from calibration.report.views import compute_positions_and_local_slopes
from tissue_sim.errors import InputError

#: Radius, m.
RADIUS = 0.020
#: Height, m.
HEIGHT = 0.020
CAMPAIGN = """
[[specimen]]
radius_mm = 20.0
height_mm = 20.0
[[test]]
name = "relaxation: 1"
kind = "lubricated_compression"
recordings = ["rec_*.csv"]
[fit]
laws = ["neo_hooke"]
start = { "viscoelastic.terms[0].g" = 0.3, "viscoelastic.terms[0].tau_s" = 3.0 }
[noise]
force_N = 0.01
"""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Ramp of 4 s to 4 mm and hold of 40 s, three times, of a modulus that relaxes by 0.4 within 5 s."""
    folder = tmp_path_factory.mktemp("holds")
    time = np.concatenate([np.linspace(0.0, 4.0, 41), np.linspace(4.4, 44.0, 100)])
    way = np.minimum(time, 4.0) * 1e-3
    relaxing = np.where(time <= 4.0, 5.0 / 4.0 * (1 - np.exp(-np.minimum(time, 4.0) / 5.0)) / np.maximum(
        np.minimum(time, 4.0) / 4.0, 1e-12), 5.0 / 4.0 * (np.exp(-(time - 4.0) / 5.0) - np.exp(-time / 5.0)))
    force = np.pi * RADIUS**2 * 9000.0 * way / HEIGHT * (0.6 + 0.4 * relaxing)
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(0.0, 0.01, time.size)
        ts.write_recording(ts.Recording({"time": time, "displacement": way, "force": force + noise}),
                           folder / f"rec_{seed}.csv")
    (folder / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")
    return folder / "campaign.toml"


def test_local_slopes_are_those_of_the_curve():
    x = np.linspace(0.0, 1.0, 401)
    places, slopes = compute_positions_and_local_slopes(x, x**2, 0.05)
    np.testing.assert_allclose(slopes, 2 * places, atol=1e-12)
    # Few and unevenly spaced: lines through the nearest five.
    places, slopes = compute_positions_and_local_slopes(np.geomspace(0.1, 10.0, 9), 3 * np.geomspace(0.1, 10.0, 9),
                                                        0.01)
    np.testing.assert_allclose(slopes, 3.0)


@pytest.mark.parametrize(("count", "rows"), [(1, [1]), (3, [3]), (4, [2, 2]), (5, [3, 2]), (7, [3, 2, 2])])
def test_panels_are_spread_evenly(count, rows):
    assert distribute_panels_over_rows(count) == rows


@pytest.mark.slow
def test_pictures_are_files_beside_the_report_and_are_made_when_asked_for_later(campaign, tmp_path, monkeypatch):
    drawn = []

    def draw(*arguments):
        drawn.append(draw_test_figure(*arguments))
        return drawn[-1]

    monkeypatch.setattr("calibration.report.sections.recordings.draw_test_figure", draw)
    out = tmp_path / "out"
    calibrate([campaign], out)
    assert not list(out.glob("report_*"))
    views = drawn[-1].axes
    assert [axes.get_title() or axes.get_title(loc="left") for axes in views[:5]] == [
        "Force and displacement", "Stress and strain", "Tangent modulus", "Load over time", "Relaxation in holds"]
    hold = views[4]
    assert hold.get_xscale() == "log" and hold.get_xlabel() == "time since the start of the hold [s]"
    law = next(line for line in hold.lines if line.get_label() == "Neo-Hooke")
    assert law.get_xdata()[0] == pytest.approx(0.4) and law.get_xdata()[-1] == pytest.approx(40.0)
    result, = calibrate([campaign], out, figures_format="svg")
    assert not result.resumed, "the pictures were missing"
    files = sorted(path.name for path in out.glob("report_*"))
    assert files == ["report_correlation_neo_hooke.svg", "report_segments_1_relaxation_1.svg",
                     "report_test_1_relaxation_1.svg"]
    text = (out / files[2]).read_text(encoding="utf-8")
    assert "<svg" in text and "nominal stress [kPa]" in text and "<dc:date>" not in text
    result, = calibrate([campaign], out, figures_format="svg")
    assert result.resumed
    calibrate([campaign], out, figures_format="pdf", overwrite=True)
    assert {path.suffix for path in out.glob("report_*")} == {".pdf"}, "those of the earlier call are removed"
    with pytest.raises(InputError, match="must be svg, pdf, png or None; got 'eps'"):
        calibrate([campaign], tmp_path / "other", figures_format="eps")
    assert not (tmp_path / "other").exists()


def test_the_methods_paragraph_says_what_was_done_with_what(campaign, tmp_path):
    calibrate([campaign], tmp_path / "out", figures=False)
    text = (tmp_path / "out" / "methods.txt").read_text(encoding="utf-8")
    for words in ("relaxation: 1 (lubricated compression", "3 recordings", "W = C10*(I1 - 3)", "Prony series of 1 term",
                  "0.01", f"tissue_sim {ts.__version__}", "taichi 1.", "numpy ", "scipy ", "Rivlin 1948a", "Simo 1987",
                  "Schwarz 1978", "C10 = ", " ± ", "[", "Virtanen P"):
        assert words in text
    cited = text[text.index("References\n"):].splitlines()[1:]
    assert cited == sorted(cited) and len(cited) == len(set(cited)) == 7
    assert text in unescape((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
