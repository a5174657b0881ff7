"""Pictures of tools, force arrow and contact."""

import numpy as np
import pytest

import tissue_sim as ts
from scenes.viewer.revolution import PossibleContactBoundary, TriangulatedHalfSection, WedgeOpening
from scenes.viewer.tool_picture import (
    SETTINGS,
    compute_height_of_tool_with_longest_arrow,
    find_tool_contact,
    make_base_plate,
    make_drawn_tool_outline,
    make_drawn_tool_surface,
    make_force_arrow_or_none,
)
from tissue_sim.fem.axisymmetric.fields import build_half_section
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q9P1

SPECIMEN = ts.Specimen(0.04, 0.07)
TOOLS = {
    "plate": ts.Tool(), "flat": ts.Tool("flat", radius=0.008),
    "rounded": ts.Tool("flat", radius=0.008, edge_radius=2e-3), "round": ts.Tool("round", radius=0.008),
    "sphere": ts.Tool("sphere", radius=0.012),
    "cone": ts.Tool("cone", radius=0.006, half_angle=np.radians(40.0), tip_radius=1e-3),
}
NEEDLES = {name: tool for name, tool in TOOLS.items() if name != "plate"}


def volume(surface):
    a, b, c = np.moveaxis(surface.vertices[surface.faces].astype(float), 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0)


def revolved_volume(outline, opening):
    """Volume of a stack of frustums whose circles are replaced by polygons."""
    r, z = outline.T
    count = len(opening.segment_half_plane_azimuths) - (0 if opening.removes_nothing else 1)
    turn = (2.0 * np.pi - opening.cut) / count
    return float(count * 0.5 * np.sin(turn) * np.sum(np.diff(z) * (r[1:] ** 2 + r[1:] * r[:-1] + r[:-1] ** 2) / 3.0))


@pytest.mark.parametrize("cut", [0.0, 90.0, 180.0])
@pytest.mark.parametrize("name", TOOLS)
def test_a_tool_is_a_closed_surface_with_the_volume_of_its_profile(name, cut):
    tool, opening = TOOLS[name], WedgeOpening(np.radians(cut))
    outline = make_drawn_tool_outline(tool, SPECIMEN)
    # The recess of the section faces is all that is missing.
    mesh = make_drawn_tool_surface(tool, SPECIMEN, opening)
    assert volume(mesh) == pytest.approx(revolved_volume(outline, opening), rel=0.012)


def test_volumes_of_simple_tools_match_formulas():
    opening = WedgeOpening(0.0, segments=720)
    sphere, flat = (make_drawn_tool_surface(TOOLS[name], SPECIMEN, opening) for name in ("sphere", "flat"))
    assert volume(sphere) == pytest.approx(4 / 3 * np.pi * 0.012**3, rel=5e-3)
    height = make_drawn_tool_outline(TOOLS["flat"], SPECIMEN)[:, 1].max()
    assert volume(flat) == pytest.approx(np.pi * 0.008**2 * height, rel=5e-3)


@pytest.mark.parametrize("name", NEEDLES)
def test_the_drawn_tool_lies_inside_its_outline(name):
    tool = NEEDLES[name]
    outline = make_drawn_tool_outline(tool, SPECIMEN)
    below = outline[outline[:, 1] < (tool.radius if tool.shape == "sphere" else outline[:, 1].max())]
    gap = tool.profile.gap(below)
    assert gap.max() < 0.0 and gap.min() > -2e-3 * tool.radius
    assert 0.0 < outline[0, 1] < 2e-3 * tool.radius
    assert outline[0, 0] == outline[-1, 0] == 0.0


@pytest.mark.parametrize("name", NEEDLES)
def test_the_shaft_ends_above_the_specimen_and_the_tip_is_complete(name):
    tool = NEEDLES[name]
    outline = make_drawn_tool_outline(tool, SPECIMEN)
    assert outline[:, 0].max() == pytest.approx(tool.radius, rel=2e-3)
    top = outline[:, 1].max()
    assert top == pytest.approx(2 * tool.radius if name == "sphere" else 0.035, rel=1e-2)
    height = compute_height_of_tool_with_longest_arrow(tool, SPECIMEN)
    assert height == pytest.approx(top + SETTINGS.arrow_length * SPECIMEN.height)
    # On a flat specimen the whole tip is there, too.
    flat = make_drawn_tool_outline(tool, ts.Specimen(0.04, 0.002))
    assert flat[:, 0].max() == pytest.approx(tool.radius, rel=2e-3)


def test_plate_and_base_are_wider_than_the_specimen():
    plate, base = make_drawn_tool_surface(TOOLS["plate"], SPECIMEN, WedgeOpening()), make_base_plate(SPECIMEN,
                                                                                                     WedgeOpening())
    for surface in (plate, base):
        assert 1.1 * 0.04 < np.linalg.norm(surface.vertices[:, :2], axis=1).max() < 1.3 * 0.04
    assert 0.0 <= plate.vertices[:, 2].min() < 1e-4
    assert -0.07 - 1e-4 < base.vertices[:, 2].max() < -0.07
    # The base is whole, and its normals point outwards.
    angles = np.arctan2(base.vertices[:, 1], base.vertices[:, 0])
    assert np.abs(angles + np.pi / 2).min() < 0.1
    assert volume(base) == pytest.approx(np.pi * (1.2 * 0.04) ** 2 * 0.06 * 0.07, rel=0.01)


def test_the_arrow_has_the_length_and_direction_of_the_force():
    tool = TOOLS["flat"]
    top = make_drawn_tool_outline(tool, SPECIMEN)[:, 1].max()
    half, full, pull = (make_force_arrow_or_none(force, 4.0, tool, SPECIMEN) for force in (2.0, 4.0, -2.0))
    assert half.tip[2] - half.start[2] == pytest.approx(0.5 * SETTINGS.arrow_length * 0.07)
    assert full.tip[2] - full.start[2] == pytest.approx(SETTINGS.arrow_length * 0.07)
    assert pull.tip[2] - pull.start[2] == pytest.approx(-0.5 * SETTINGS.arrow_length * 0.07)
    for arrow in (half, full, pull):
        z = arrow.surface.vertices[:, 2]
        assert z.min() == pytest.approx(min(arrow.start[2], arrow.tip[2])) and z.min() > top
        assert z.max() == pytest.approx(max(arrow.start[2], arrow.tip[2]))
        assert volume(arrow.surface) > 0.0
        # The widest ring is where the head begins.
        widest = z[np.argmax(np.linalg.norm(arrow.surface.vertices[:, :2], axis=1))]
        length = abs(arrow.tip[2] - arrow.start[2])
        head = min(SETTINGS.head_length * 0.07, SETTINGS.largest_head * length)
        assert abs(widest - arrow.tip[2]) == pytest.approx(head, rel=1e-4)
    assert make_force_arrow_or_none(40.0, 4.0, tool, SPECIMEN).tip == pytest.approx(full.tip)


@pytest.mark.parametrize("force", [0.0, 1e-3, -1e-3])
def test_a_zero_force_has_no_arrow(force):
    assert make_force_arrow_or_none(force, 4.0, TOOLS["flat"], SPECIMEN) is None


def surface_line(points):
    return PossibleContactBoundary(np.array(points), 0.5 * (np.array(points[1:]) + np.array(points[:-1])))


def test_contact_with_a_flat_punch():
    """The tissue is flat under the face and does not touch the shaft."""
    line = surface_line([[0.0, -0.01], [0.004, -0.01], [0.008, -0.01], [0.012, -0.006], [0.04, 0.0], [0.04, -0.07]])
    opening = WedgeOpening(np.radians(120.0))
    contact = find_tool_contact(line, TOOLS["flat"], 0.01, opening)
    assert contact.radius == pytest.approx(0.008) and contact.area == pytest.approx(np.pi * 0.008**2)
    # Two lines on each of the faces, in front of them, and the rim.
    on_faces, rim = contact.lines[:4], contact.lines[4:]
    assert on_faces[..., 2] == pytest.approx(-0.01)
    for lines, (way, outward) in zip(np.split(on_faces, 2), opening.section_face_vectors, strict=True):
        assert lines[..., :2] @ outward == pytest.approx(2e-3 * 0.04)
        assert (lines[..., :2] @ way).max() == pytest.approx(0.008)
    assert np.linalg.norm(rim[..., :2], axis=-1) == pytest.approx(0.008 + 2e-3 * 0.04)
    assert len(rim) == len(opening.segment_half_plane_azimuths) - 1
    assert len(find_tool_contact(line, TOOLS["flat"], 0.01, WedgeOpening(0.0)).lines) == 48


def test_contact_with_the_shaft_and_with_a_ring():
    """Tissue at the shaft is in contact; tissue that has separated in the middle is not."""
    line = surface_line([[0.0, -0.012], [0.004, -0.0101], [0.006, -0.01], [0.008, -0.01], [0.008, -0.008],
                         [0.02, 0.0], [0.04, 0.0]])
    contact = find_tool_contact(line, TOOLS["flat"], 0.01, WedgeOpening())
    assert contact.area == pytest.approx(np.pi * (0.008**2 - 0.006**2) + 2 * np.pi * 0.008 * 0.002)


@pytest.mark.parametrize("name", TOOLS)
def test_no_contact_above_the_tissue(name):
    line = surface_line([[0.0, 0.0], [0.01, 0.0], [0.04, 0.0], [0.04, -0.07]])
    assert find_tool_contact(line, TOOLS[name], -0.001, WedgeOpening()) is None


def test_contact_on_a_round_tip_is_one_patch_despite_oscillating_nodes():
    """As in solutions of the solver, the Gauss points lie on the tool, the end nodes of the elements 40 um outside and
    the middle nodes 20 um inside."""
    tool, depth, opening = TOOLS["round"], 0.010, WedgeOpening(np.pi)
    mesh = cylinder_mesh(0.04, 0.07, (40, 3), Q9P1)
    section, place = TriangulatedHalfSection(build_half_section(mesh)), mesh.nodes.copy()
    top = mesh.sets["top"]
    r = place[top, 0]
    touching = r < 0.0061
    polar = r[touching] / 0.008
    away = 0.008 + np.where(np.arange(touching.sum()) % 2, -20e-6, 40e-6)
    place[top[touching]] = np.stack([away * np.sin(polar), 0.008 - away * np.cos(polar) - depth], axis=-1)
    place[top[~touching], 1] = -0.0075
    gap = tool.profile.gap(place[top[touching]] + [0.0, depth])
    assert gap.min() == pytest.approx(-20e-6) and gap.max() == pytest.approx(40e-6)
    contact = find_tool_contact(section.compute_possible_contact_boundary(place), tool, depth, opening)
    assert contact.radius == pytest.approx(0.008 * np.sin(0.006 / 0.008), rel=0.01)
    # A cap of the ball.
    assert contact.area == pytest.approx(2 * np.pi * 0.008**2 * (1 - np.cos(0.006 / 0.008)), rel=0.02)
    on_one = contact.lines[:12]
    assert on_one[1:, 0] == pytest.approx(on_one[:-1, 1])
    assert find_tool_contact(section.compute_possible_contact_boundary(mesh.nodes), tool, -1e-4, opening) is None
