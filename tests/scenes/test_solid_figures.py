"""Figures of three-dimensional simulations: geometry of tissue and tool, and colours of the field."""

import math

import numpy as np
import pytest
from matplotlib.figure import Figure

import tissue_sim as ts
from scenes.colour_scale import choose_colour_scale
from scenes.field_labels import LABELS
from scenes.solid_figures import (
    choose_drawn_tool_pose,
    draw_deformed_surface,
    draw_section_through_tool_axis,
    make_surface_of_revolution,
)
from tissue_sim.fem.solid.batches import ElementBatches
from tissue_sim.fem.solid.fields import SolidFields
from tissue_sim.mesh.solid import create_block_mesh_from_boundaries, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.pose import Pose

MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
TOOL = ts.Tool("round", radius=8e-3)
LEAN = math.radians(20.0)
POSE = ts.Approach(10e-3, LEAN).pose(5e-3)


def fields_of(mesh, displacement):
    """Return fields without a solver; the origin of the scene is 1 mm above that of the mesh."""
    batches, count = ElementBatches(mesh), len(mesh.connectivity)
    return SolidFields(mesh, MATERIAL, 3e6, displacement[None], np.zeros((1, count, mesh.element.pressure_modes)),
                       *batches.point_gradients_and_modes, batches.weights, np.ones(count), datum=1e-3)


def bent(mesh):
    return mesh.nodes[:, [2, 0, 1]] ** 2 * [0.8, 0.0, -0.6]


@pytest.fixture(params=(HEX8P0, HEX27P1), ids=lambda element: element.name)
def cylinder(request):
    mesh = create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, request.param, smallest=3e-3, growth=2.2, largest=20e-3,
                                             around=2,
                                             centre=(10e-3, 0.0))
    return fields_of(mesh, bent(mesh))


def drawn_triangles(collection):
    """Return the corners of a coloured triangulation, mm, shape (t, 3, 2)."""
    triangles = collection._triangulation
    return np.column_stack([triangles.x, triangles.y])[triangles.triangles]


def area(triangles):
    (a, b), (c, d) = np.moveaxis(triangles[:, 1:] - triangles[:, :1], 0, -1)
    return 0.5 * (a * d - b * c)


@pytest.mark.slow
@pytest.mark.parametrize("field", LABELS)
def test_a_cut_has_the_area_of_the_section_and_the_values_of_the_field(field, cylinder):
    axes = Figure().subplots()
    draw_section_through_tool_axis(axes, cylinder, field, -1, POSE, TOOL)
    section, = (each for each in axes.collections if hasattr(each, "_triangulation"))
    # At y = 0 the displacement is along x and depends on z only, so that the area is preserved.
    assert abs(area(drawn_triangles(section)).sum()) == pytest.approx(80.0 * 70.0, rel=1e-6)
    label, factor = LABELS[field]
    scale = choose_colour_scale(cylinder, field)
    assert (section.norm.vmin, section.norm.vmax) == (scale.low, scale.high) and scale.label.startswith(label)
    values = cylinder.at_nodes(field) * factor
    on_plane = np.abs(cylinder.mesh.nodes[:, 1]) < 1e-12
    assert values[on_plane].min() <= section.get_array().min() + 1e-9
    assert section.get_array().max() <= values[on_plane].max() + 1e-9


def test_the_tool_is_drawn_at_its_pose_and_angle(cylinder):
    axes = Figure().subplots()
    draw_section_through_tool_axis(axes, cylinder, "von_mises", -1, POSE, TOOL)
    outline = axes.patches[0].get_xy()
    tip = 1e3 * np.array([POSE.position[0], POSE.position[2]])
    assert np.linalg.norm(outline - tip, axis=1).min() < 1e-9
    axis = np.array([-math.sin(LEAN), math.cos(LEAN)])
    across = (outline - tip) @ [axis[1], -axis[0]]
    assert (across.min(), across.max()) == pytest.approx((-8.0, 8.0), abs=0.05)
    assert ((outline - tip) @ axis).min() == pytest.approx(0.0, abs=1e-9)


def test_only_faces_towards_the_camera_are_drawn(cylinder):
    axes = Figure().subplots()
    draw_deformed_surface(axes, cylinder, "displacement", -1, POSE, TOOL)
    mesh, = (each for each in axes.collections if hasattr(each, "_triangulation"))
    assert (area(drawn_triangles(mesh)) > -1e-9).all(), "no face is seen from behind"
    assert len(np.unique(mesh.get_facecolor().round(3), axis=0)) > 20


def test_a_tool_behind_a_compliant_load_train_is_drawn_on_the_tissue():
    line = np.linspace(-0.02, 0.02, 5)
    fields = fields_of(create_block_mesh_from_boundaries(line, line, line - 0.02, HEX8P0), np.zeros((125, 3)))
    upright = choose_drawn_tool_pose(fields, -1, Pose((0.0, 0.0, -6e-3)), ts.Tool("flat", radius=8e-3))
    assert upright.position == pytest.approx((0.0, 0.0, -1e-3)), "the top is 1 mm below the scene's origin"
    above = Pose((0.0, 0.0, 2e-3))
    assert choose_drawn_tool_pose(fields, -1, above, ts.Tool("flat", radius=8e-3)) == above


def test_a_body_of_revolution_has_its_volume():
    vertices, faces = make_surface_of_revolution(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0], [0.0, 3.0]]),
                                                 segments=400)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    assert np.einsum("ti,ti->", np.cross(a, b), c) / 6.0 == pytest.approx(12.0 * np.pi, rel=1e-4)


@pytest.mark.slow
def test_simulate_draws_a_solid(tmp_path, capsys):
    """The command draws a figure; the test uses the smallest number of samples."""
    from scenes.cli import main

    material, figure = tmp_path / "m.material.json", tmp_path / "f.png"
    ts.write_material_file(ts.MaterialFile.of(MATERIAL), material)
    assert main(["simulate", "lubricated_compression", "--solid", "--material", str(material), "--depth-mm", "5",
                 "--points", "2", "--figure", str(figure), "--field", "cauchy_zz"]) == 0
    assert "wrote" in capsys.readouterr().out and figure.read_bytes().startswith(b"\x89PNG")
