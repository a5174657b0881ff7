"""Data of the live plots: ascending columns of equal length with the curves, and ranges that contain them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from scenes.viewer.measurement import build_measurement_from_replicates, compute_force_residual
from scenes.viewer.plots import (
    PLOTS,
    keep_or_round_axis_range_with_zero,
    make_depth_grid,
    make_force_depth_columns_and_range,
    make_force_depth_options,
    make_force_time_columns_and_range,
    make_force_time_options,
    make_residual_depth_columns_and_range,
    make_residual_depth_options,
    make_uplot_scales_option,
    plot_legend_html,
)


def there_and_back(factor=1.0, deepest=8e-3, **metadata):
    """Recording with 200 N/m in loading and 150 N/m in unloading, with a hold between them."""
    there = np.linspace(0, deepest, 81)
    depth = np.concatenate([there, there[::-1]])
    force = factor * np.concatenate([200 * there, 150 * there[::-1]])
    return ts.Recording({"time": np.arange(162) * 0.1, "displacement": depth, "force": force},
                        {"segment": ["ramp"] * 81 + ["unload"] * 81}, metadata)


@pytest.fixture(scope="module")
def measured():
    return build_measurement_from_replicates([there_and_back(factor) for factor in (0.9, 1.0, 1.1)])


def names(options):
    return [series["label"] for series in options["series"]]


def columns(data, options):
    """Return the column of each series by its label."""
    assert len(data) == len(options["series"])
    assert len({column.shape for column in data}) == 1 and all(column.dtype == float for column in data)
    assert (np.diff(data[0]) > 0).all()
    return dict(zip(names(options), data, strict=True))


def test_force_over_depth_has_measurement_model_and_live_curve(measured):
    grid = make_depth_grid(10e-3)
    load = np.where(grid <= 5e-3, 210 * grid, np.nan)
    data, extent = make_force_depth_columns_and_range(grid, measured=measured, model=(200 * grid, 150 * grid),
                                                      live=(load, 140 * grid),
                                                      now=(3.33e-3, 0.7))
    found = columns(data, make_force_depth_options((0, 10), extent))
    x = found["depth [mm]"]
    assert x.size == 202 and (x[0], x[-1]) == (0, 10)
    inside = x < 7.99
    np.testing.assert_allclose(found["measured load"][inside], 0.2 * x[inside], atol=1e-9)
    np.testing.assert_allclose(found["measured unload"][inside], 0.15 * x[inside], atol=1e-9)
    np.testing.assert_allclose(found["measured load, lowest"][inside], 0.18 * x[inside], atol=1e-9)
    np.testing.assert_allclose(found["measured load, highest"][inside], 0.22 * x[inside], atol=1e-9)
    np.testing.assert_allclose(found["measured unload, highest"][inside], 0.165 * x[inside], atol=1e-9)
    np.testing.assert_allclose(found["model load"], 0.2 * x, atol=1e-9)
    np.testing.assert_allclose(found["model unload"], 0.15 * x, atol=1e-9)
    np.testing.assert_allclose(found["live load"][x <= 5], 0.21 * x[x <= 5], atol=1e-9)
    assert np.isnan(found["live load"][x > 5.01]).all() and np.isnan(found["measured load"][x > 8.01]).all()
    assert np.isnan(found["compared load"]).all()
    point = np.isfinite(found["now"])
    assert (x[point], found["now"][point]) == (pytest.approx(3.33), 0.7)
    assert extent == pytest.approx((0, 2.0))


def test_the_band_has_zero_width_without_replicates(measured):
    """uPlot fills bands across NaN, so the edges contain none."""
    grid = make_depth_grid(10e-3)
    data, extent = make_force_depth_columns_and_range(grid, measured=measured)
    found = columns(data, make_force_depth_options((0, 10), extent))
    for way in ("load", "unload"):
        low, high = found[f"measured {way}, lowest"], found[f"measured {way}, highest"]
        assert np.isfinite(low).all() and np.isfinite(high).all()
        assert (high - low)[grid > 8.01e-3].max() == 0 and (high - low)[150] > 0.1


@pytest.mark.parametrize("depth", [-1e-3, 12e-3])
def test_a_present_point_outside_the_grid_is_not_drawn(depth):
    grid = make_depth_grid(10e-3)
    data, _ = make_force_depth_columns_and_range(grid, now=(depth, 0.3))
    assert data[0].size == grid.size and np.isnan(data[-1]).all()


@given(st.floats(0, 10e-3), st.floats(-5, 5))
def test_the_present_point_is_drawn_at_its_depth(depth, force):
    grid = make_depth_grid(10e-3)
    data, (low, high) = make_force_depth_columns_and_range(grid, model=(100 * grid, 100 * grid), now=(depth, force))
    point = np.flatnonzero(np.isfinite(data[-1]))
    assert (data[0][point[0]], data[-1][point[0]]) == (depth * 1e3, force) and point.size == 1
    assert (np.diff(data[0]) >= 0).all() and low <= force <= high
    np.testing.assert_allclose(data[7], 0.1 * data[0], atol=1e-12)


def test_residual_over_depth_has_band_and_branches(measured):
    grid = make_depth_grid(10e-3)
    data, extent = make_residual_depth_columns_and_range(compute_force_residual(there_and_back(1.05), measured),
                                                         measured, grid)
    found = columns(data, make_residual_depth_options((0, 10), extent))
    x = found["depth [mm]"]
    inside = x < 7.99
    np.testing.assert_allclose(found["load"][inside], 0.01 * x[inside], atol=1e-9)
    np.testing.assert_allclose(found["unload"][inside], 0.0075 * x[inside], atol=1e-9)
    np.testing.assert_allclose(found["lowest"][inside], -0.02 * x[inside], atol=1e-9)
    np.testing.assert_allclose(found["highest"][inside], 0.02 * x[inside], atol=1e-9)
    assert (found["zero"] == 0).all() and np.isnan(found["load"][x > 8.01]).all()
    assert (found["highest"][x > 8.01] == 0).all()
    assert extent == pytest.approx((-0.16, 0.16))


def test_empty_plots_have_a_range():
    grid = make_depth_grid(10e-3)
    for data, extent in (make_force_depth_columns_and_range(grid),
                         make_residual_depth_columns_and_range(None, None, grid),
                         make_force_time_columns_and_range(np.empty(0), np.empty(0), 3)):
        assert extent == (0, 0) and (np.diff(data[0]) > 0).all()
    assert keep_or_round_axis_range_with_zero((0, 0)) == (0, 1) \
        and keep_or_round_axis_range_with_zero((0, 0), about_zero=True) == (-1, 1)


def test_force_over_time_keeps_peaks():
    time = np.arange(0, 60, 5e-3) + 1.3e-3  # so that none falls on the edge of a part
    force, now = np.random.default_rng(0).normal(size=time.size), 60.0
    data, extent = make_force_time_columns_and_range(time, force, now)
    x, _, live, hand = columns(data, make_force_time_options(extent)).values()
    assert np.isnan(hand).all(), "no hand is there"
    assert (x[0], x[-1], x.size) == (-PLOTS.time_span, 0, 2 * PLOTS.intervals)
    assert extent == (force[time >= 40].min(), force[time >= 40].max())
    for i in range(PLOTS.intervals):
        part = force[(time >= 40 + 0.1 * i) & (time < 40.1 + 0.1 * i)]
        assert sorted(live[2 * i:2 * i + 2]) == [part.min(), part.max()]


def test_force_over_time_follows_a_slow_force():
    time = np.arange(0, 12, 0.1)
    data, _ = make_force_time_columns_and_range(time, 0.3 * time, 12.0, measured=(time, 0.2 * time))
    x, measured, live, _ = data
    known = x + 12 > 0.1
    np.testing.assert_allclose(live[known & (x < -0.2)], 0.3 * (x + 12)[known & (x < -0.2)],
                               atol=0.3 * PLOTS.time_span / PLOTS.intervals)
    np.testing.assert_allclose(measured[known & (x < -0.2)], 0.2 * (x + 12)[known & (x < -0.2)], atol=1e-9)
    assert np.isnan(live[x + 12 < -0.2]).all() and np.isnan(measured[x > -0.05]).all()


def test_force_on_the_hand_and_force_of_the_tissue_are_drawn():
    """The rendered force is limited to 1.5 N of 3 N."""
    time = np.arange(0, 12, 0.01)
    force = 0.3 * time
    data, extent = make_force_time_columns_and_range(time, force, 12.0, hand=np.minimum(force, 1.5))
    found = columns(data, make_force_time_options(extent))
    known = found["time [s]"] > -11.8
    np.testing.assert_allclose(found["on the hand"][known], np.minimum(found["live"], 1.5)[known], atol=0.05)
    assert extent == pytest.approx((0, force[-1])) and np.nanmax(found["on the hand"]) == 1.5
    assert "on the hand" in plot_legend_html(hand=True) and "on the hand" not in plot_legend_html()


extents = st.tuples(st.floats(-1e3, 0), st.floats(0, 1e3))


@settings(max_examples=300)
@given(extents, st.booleans())
def test_a_range_contains_the_data_with_a_small_margin(extent, about_zero):
    low, high = keep_or_round_axis_range_with_zero(extent, about_zero=about_zero)
    largest = max(extent[1], -extent[0])
    assert low - 1e-9 <= extent[0] <= extent[1] <= high + 1e-9 and low < high
    assert (low == -high) if about_zero else low <= 0 <= high
    if largest > 1e-9:
        assert max(high, -low) <= 1.05 * 1.34 * largest


@settings(max_examples=200)
@given(st.floats(1e-6, 1e3), st.floats(0.6, 1.0))
def test_a_suitable_range_is_kept(force, share):
    before = keep_or_round_axis_range_with_zero((0, force))
    assert keep_or_round_axis_range_with_zero((0, share * force), before) == before


def test_a_range_grows_immediately_and_shrinks_when_nearly_empty():
    assert keep_or_round_axis_range_with_zero((0, 1.9)) == (0, 2)
    assert keep_or_round_axis_range_with_zero((0, 1.0), (0, 2)) == (0, 2)
    assert keep_or_round_axis_range_with_zero((0, 2.1), (0, 2)) == (0, 2.5)
    assert keep_or_round_axis_range_with_zero((0, 0.7), (0, 2)) == (0, 0.8)
    assert keep_or_round_axis_range_with_zero((-0.3, 0.7), about_zero=True) == (-0.8, 0.8)


def test_viser_accepts_the_options(measured):
    """viser checks lengths and types when it creates the plots."""
    import viser

    grid = make_depth_grid(10e-3)
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        for (data, extent), make, x in (
                (make_force_depth_columns_and_range(grid, measured=measured), make_force_depth_options, [(0, 10)]),
                (make_residual_depth_columns_and_range(None, measured, grid), make_residual_depth_options, [(0, 10)]),
                (make_force_time_columns_and_range(np.arange(9.0), np.arange(9.0), 9.0), make_force_time_options, [])):
            options = make(*x, keep_or_round_axis_range_with_zero(extent), dark=True)
            handle = server.gui.add_uplot(data, **options)
            assert len(handle.data) == len(handle.series)
            for low, high in [each["series"] for each in options["bands"] or ()]:
                assert "highest" in options["series"][low]["label"] and "lowest" in options["series"][high]["label"]
            handle.scales = make_uplot_scales_option((0, 12), (0, 3))
    finally:
        server.stop()


def test_the_legend_names_the_drawn_curves():
    everything = plot_legend_html(measured=3, compared="<friction>")
    assert "measured (3)" in everything and "&lt;friction&gt;" in everything and "live" in everything
    assert "(1)" not in plot_legend_html(measured=1) and "measured" not in plot_legend_html()
    assert plot_legend_html() != plot_legend_html(dark=True)


def test_forces_of_late_ticks_are_a_separate_series():
    grid = make_depth_grid(10e-3, 11)
    late = np.where(np.arange(11) == 4, 0.7, np.nan)
    data, extent = make_force_depth_columns_and_range(grid, late=late)
    labels = [each["label"] for each in make_force_depth_options((0, 10), (0, 1))["series"]]
    assert data[labels.index("late")][4] == 0.7 and np.isfinite(data[labels.index("late")]).sum() == 1
    assert extent == (0.7, 0.7) and np.isnan(make_force_depth_columns_and_range(grid)[0][labels.index("late")]).all()
