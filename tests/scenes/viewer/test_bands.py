"""Iso-bands: the pieces cover the triangles exactly once, and each piece lies in its band."""

import numpy as np
import pytest

from scenes.viewer.bands import (
    TriangleConnectivity,
    insert_polyline_points_at_levels,
    renumber_triangles_for_band_meshes,
)

LEVELS = np.linspace(-1.0, 1.0, 9)


def areas(points, triangles):
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def sheet(n=13, seed=0):
    """Distorted mesh of a square with anticlockwise triangles of different shapes."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    inside = ((points > 0) & (points < 1)).all(axis=1)
    points[inside] += rng.uniform(-0.2 / n, 0.2 / n, (inside.sum(), 2))
    number = np.arange(n * n).reshape(n, n)
    low, right, left, high = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    triangles = np.concatenate([np.stack([low, right, high], -1).reshape(-1, 3),
                                np.stack([low, high, left], -1).reshape(-1, 3)])
    return points, triangles


def interpolated(points, triangles, values, at):
    """Evaluate the piecewise linear field at points, shape (m, 2)."""
    found = np.full(len(at), np.nan)
    for corners in triangles:
        a, b, c = points[corners]
        u, v = np.linalg.solve(np.stack([b - a, c - a], axis=1), (at - a).T)
        here = (u > -1e-9) & (v > -1e-9) & (u + v < 1 + 1e-9)
        found[here] = (values[corners] @ np.stack([1 - u - v, u, v]))[here]
    return found


def clip_triangles_to_bands(points, triangles, values, levels):
    """For each band its vertices and its triangles."""
    pieces = TriangleConnectivity(np.asarray(triangles)).cut_at_levels(points, values, levels)
    kept, numbers, slices = renumber_triangles_for_band_meshes(pieces.triangles, pieces.band, len(pieces.points),
                                                               len(levels) - 1)
    return [(pieces.points[kept[points_of]], numbers[cut]) for points_of, cut in slices]


@pytest.mark.parametrize("seed", range(5))
def test_bands_cover_the_triangles_once_and_keep_the_orientation(seed):
    points, triangles = sheet(seed=seed)
    values = np.random.default_rng(seed).uniform(-1.5, 1.5, len(points))
    bands = clip_triangles_to_bands(points, triangles, values, LEVELS)
    assert len(bands) == 8
    pieces = [areas(*band) for band in bands]
    assert min(piece.min() for piece in pieces) > -1e-15
    assert sum(piece.sum() for piece in pieces) == pytest.approx(1.0, rel=1e-12)


def test_each_piece_lies_in_its_band():
    points, triangles = sheet(6)
    values = np.random.default_rng(3).uniform(-1.5, 1.5, len(points))
    for k, (vertices, pieces) in enumerate(clip_triangles_to_bands(points, triangles, values, LEVELS)):
        at = interpolated(points, triangles, values, vertices)
        low, high = (-np.inf if k == 0 else LEVELS[k]), (np.inf if k == 7 else LEVELS[k + 1])
        assert len(at) and (at >= low - 1e-9).all() and (at <= high + 1e-9).all()
        assert sorted(np.unique(pieces)) == list(range(len(vertices)))


def test_band_areas_of_a_linear_field_match_the_levels():
    points, triangles = sheet()
    bands = clip_triangles_to_bands(points, triangles, points @ [2.0, 0.0] - 1.0, LEVELS)
    assert [areas(*band).sum() for band in bands] == pytest.approx([0.125] * 8, rel=1e-12)


def test_values_equal_to_levels_give_no_degenerate_triangles():
    points, triangles = sheet(9)
    values = np.round(np.random.default_rng(1).uniform(-1.2, 1.2, len(points)) * 4) / 4
    bands = clip_triangles_to_bands(points, triangles, values, LEVELS)
    assert sum(areas(*band).sum() for band in bands) == pytest.approx(1.0, rel=1e-12)
    assert min(areas(*band).min() for band in bands if len(band[1])) > 1e-6


def test_uniform_fields_and_values_outside_the_levels_fall_into_one_band():
    points, triangles = sheet(4)
    for value, band in ((-7.0, 0), (7.0, 7), (0.1, 4), (0.25, 5), (-1.0, 0), (1.0, 7)):
        bands = clip_triangles_to_bands(points, triangles, np.full(len(points), value), LEVELS)
        assert [len(pieces) > 0 for _, pieces in bands] == [k == band for k in range(8)]
        assert all(vertices.shape == (0, 2) and pieces.shape == (0, 3)
                   for k, (vertices, pieces) in enumerate(bands) if k != band)


def test_neighbours_share_the_points_of_their_common_edge():
    points, triangles = sheet()
    values = np.random.default_rng(5).uniform(-1.5, 1.5, len(points))
    pieces = TriangleConnectivity(triangles).cut_at_levels(points, values, LEVELS)
    edges = np.sort(pieces.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    middle = pieces.points[edges].mean(axis=1)
    rim = (np.abs(middle - 0.5) > 0.5 - 1e-9).any(axis=1)
    assert (count[~rim] == 2).all() and (count[rim] == 1).all()
    assert (np.diff(pieces.band) >= 0).all()


def test_rising_and_falling_polylines_are_split_at_each_level():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [1.0, 3.0]])
    new, band = insert_polyline_points_at_levels(points, np.array([-1.0, 1.0, 0.0, 0.0]),
                                                 np.array([-1.0, -0.5, 0.0, 0.5, 1.0]))
    expected = [[0, 0], [0.25, 0], [0.5, 0], [0.75, 0], [1, 0], [1, 1], [1, 2], [1, 3]]
    assert new == pytest.approx(np.array(expected), abs=1e-15)
    assert band.tolist() == [0, 1, 2, 3, 3, 2, 2]


def test_a_polyline_on_the_boundary_has_the_crossings_of_the_triangles():
    points, triangles = sheet()
    values = np.random.default_rng(6).uniform(-1.5, 1.5, len(points))
    pieces = TriangleConnectivity(triangles).cut_at_levels(points, values, LEVELS)
    new, band = insert_polyline_points_at_levels(points[:13], values[:13], LEVELS)
    on_rim = np.sort(pieces.points[pieces.points[:, 1] == 0.0, 0])
    assert new[:, 0] == pytest.approx(on_rim, abs=1e-14)
    middle = np.interp(0.5 * (new[1:, 0] + new[:-1, 0]), points[:13, 0], values[:13])
    assert band.tolist() == np.clip(np.searchsorted(LEVELS, middle) - 1, 0, 7).tolist()
