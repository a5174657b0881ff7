"""Closest points of outlines: the function of the kernels and that for arrays, against a dense sampling."""

import numpy as np
import pytest

from tissue_sim import Tool
from tissue_sim.fem.contact.surface_geometry import make_closest_point_function
from tissue_sim.fem.taichi.runtime import get_initialised_taichi

#: Outlines of tools with a sharp edge, a rounded edge, a tip and a sphere.
TOOLS = {"sharp": Tool("flat", radius=4e-3), "rounded": Tool("flat", radius=4e-3, edge_radius=1e-3),
         "cone": Tool("cone", radius=4e-3, half_angle=np.radians(30.0)),
         "sphere": Tool("sphere", radius=3e-3), "round": Tool("round", radius=3e-3)}


@pytest.fixture(scope="module")
def find_in_kernel():
    """Function with the results of the Taichi function for many points, one row for each."""
    ti = get_initialised_taichi()
    find = make_closest_point_function()
    reals = ti.types.ndarray(dtype=ti.f64, ndim=2)

    @ti.kernel
    def run(first: ti.i32, is_endless: ti.i32, points: reals, lines: reals, found: reals):
        ti.loop_config(serialize=True)
        for i in range(points.shape[0]):
            line, distance, n_r, n_z, curvature = find(points[i, 0], points[i, 1], first, lines.shape[0], is_endless,
                                                       lines)
            found[i, 0], found[i, 1], found[i, 2], found[i, 3], found[i, 4] = line, distance, n_r, n_z, curvature

    def find_all(profile, points, first, is_endless):
        found = np.zeros((len(points), 5))
        run(first, int(is_endless), points, profile.lines, found)
        return found

    return find_all


def make_points(seed):
    random = np.random.default_rng(seed)
    return random.uniform((0.0, -5e-3), (10e-3, 10e-3), (3000, 2))


@pytest.mark.parametrize("is_endless", [False, True])
@pytest.mark.parametrize("name", TOOLS)
def test_kernels_and_arrays_have_the_same_closest_points(find_in_kernel, name, is_endless):
    profile = TOOLS[name].profile
    for first in {0, min(profile.shaft, len(profile.lines) - 1)}:
        points = make_points(first)
        # Points at vertices, at which two line segments are equally close.
        points[: len(profile.vertices)] = profile.vertices
        line, distance, normal, curvature = profile.compute_distances_to_polyline(points, first, is_endless)
        found = find_in_kernel(profile, points, first, is_endless)
        np.testing.assert_allclose(found[:, 1], distance, rtol=1e-13, atol=1e-16)
        clear = np.abs(distance) > 1e-12
        np.testing.assert_array_equal(found[clear, 0], line[clear])
        np.testing.assert_allclose(found[clear, 2:4], normal[clear], atol=1e-9)
        np.testing.assert_allclose(found[clear, 4], curvature[clear], rtol=1e-9)


@pytest.mark.parametrize("name", TOOLS)
def test_distance_and_normal_are_those_of_the_closest_sampled_point(name):
    profile = TOOLS[name].profile
    points = make_points(7)
    positions = np.linspace(0.0, 1.0, 20001)[:, None]
    # Points above the sampled part of the shaft are left out.
    ends = [(a, np.minimum(b, 40e-3)) for a, b in zip(profile.vertices[:-1], profile.vertices[1:], strict=True)]
    samples = np.concatenate([a + positions * (b - a) for a, b in ends])
    spacing = 0.5 * max(np.linalg.norm(b - a) for a, b in ends) / (len(positions) - 1)
    line, distance, normal, _ = profile.compute_distances_to_polyline(points)
    for point, d, n in zip(points[:200], distance[:200], normal[:200], strict=True):
        nearest = samples[np.argmin(np.linalg.norm(samples - point, axis=1))]
        # The closest sample is at most half a spacing from the closest point.
        assert abs(d) - 1e-12 <= np.linalg.norm(nearest - point) <= np.hypot(d, spacing) + 1e-12
        np.testing.assert_allclose(point - d * n, nearest, atol=spacing + 1e-12)
    assert set(line.tolist()) <= set(range(len(profile.lines)))
    # The body is to the left of its outline: the axis above the tip is inside, points below the tip are outside.
    inside = profile.compute_distances_to_polyline(np.array([[0.0, 2e-3], [0.0, -1e-3]])).distance
    assert inside[0] - profile.rounding < 0.0 < inside[1]
