"""Position of the first touch of a tool on a solid, also between nodes."""

import math

import numpy as np
import pytest
from solid_meshes import block

import tissue_sim as ts
from tissue_sim.errors import InputError
from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.touch import FacePolynomialMaps, find_first_touch
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, TET8P0, TET15P1
from tissue_sim.pose import Pose, rotate_pose_about_its_position

RADIUS = 8e-3
LINE = np.linspace(-0.02, 0.02, 11)
ELEMENTS = pytest.mark.parametrize("element", [HEX8P0, HEX27P1, TET8P0, TET15P1], ids=lambda element: element.name)


def height(mesh, tool, pose, **more):
    return find_first_touch(mesh, mesh.nodes, [ContactPair(tool.profile, mesh.sets["top"], (0.0, 0.0), **more)],
                            pose).height


@ELEMENTS
def test_points_of_a_side_are_those_of_its_element(element):
    """Points at nodes and between them follow the shape functions of the element."""
    mesh = block([0.0, 1.0], [0.0, 1.5], [-1.0, 0.0], element)
    bent = mesh.nodes + 0.05 * np.cos(4.0 * mesh.nodes[:, [1, 2, 0]])
    sides = mesh.faces["top"]
    points = FacePolynomialMaps(element, bent[sides])
    rng = np.random.default_rng(0)
    places = rng.uniform(size=(len(sides), 6, 2))
    found = points.evaluate_face_positions(np.arange(len(sides)), places)
    for side, own in zip(sides, found, strict=True):
        of = next(each for each in mesh.connectivity if np.isin(side, each).all())
        face = next(each for each in element.local_face_node_indices if set(of[each]) == set(side))
        corners = element.reference_nodes[face[element.corner_indices_within_face]]
        # A point of the reference side that is as near to each corner as the point found is: by Newton's method.
        for point in own:
            guess, flat = np.full(2, 0.4), np.stack([corners[1] - corners[0], corners[-1] - corners[0]])
            for _ in range(30):
                values, slopes = element.evaluate_shape_functions_and_gradients((corners[0] + guess @ flat)[None])
                missed = values[0] @ bent[of] - point
                guess -= np.linalg.lstsq((flat @ slopes[0].T @ bent[of]).T, missed, rcond=None)[0]
            assert np.abs(missed).max() < 1e-12
    corner = bent[sides[:, element.corner_indices_within_face[0]]]
    assert np.abs(points.lattice[:, 0] - corner).max() < 1e-14


@pytest.mark.slow
@ELEMENTS
@pytest.mark.parametrize("place", [(0.0, 0.0), (2e-3, 2e-3), (1.1e-3, -0.7e-3), (-5.3e-3, 3.1e-3), (0.1e-3, 0.2e-3),
                                   (4.3e-3, -0.1e-3)])
def test_a_ball_touches_a_flat_top_wherever_it_stands(element, place):
    """With nodes alone the touch between nodes of linear elements is up to (0.5 h)^2 / R = 0.5 mm too late."""
    mesh = block(LINE, LINE, [-0.02, -0.01, 0.0], element)
    assert abs(height(mesh, ts.Tool("sphere", radius=RADIUS), Pose((*place, 0.0)))) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [5.0, 20.0, 45.0])
@pytest.mark.parametrize("tool", [ts.Tool("flat", radius=RADIUS), ts.Tool("flat", radius=RADIUS, edge_radius=1e-3)],
                         ids=["sharp", "rounded"])
def test_the_edge_of_a_leaning_face_touches_it(tool, degrees):
    mesh, rng, angle = block(LINE, LINE, [-0.02, 0.0], HEX8P0), np.random.default_rng(1), math.radians(degrees)
    rounding = tool.edge_radius
    for _ in range(4):
        way, place = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(-4e-3, 4e-3, 2)
        pose = rotate_pose_about_its_position(Pose((*place, 0.0)), (angle * math.cos(way), angle * math.sin(way), 0.0))
        expected = (RADIUS - rounding) * math.sin(angle) + rounding * (1.0 - math.cos(angle))
        assert height(mesh, tool, pose) == pytest.approx(expected, abs=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("tool", [ts.Tool("flat", radius=RADIUS), ts.Tool("flat", radius=RADIUS, edge_radius=1e-3)],
                         ids=["sharp", "rounded"])
def test_a_face_that_holds_the_tissue_touches_it_too(tool):
    """Nodes outside the face may meet the shaft alone; the first touch is that of the whole tool."""
    mesh = block(LINE, LINE, [-0.02, 0.0], TET8P0)
    mesh.nodes[:, 2] += 1e-3 * np.sin(400.0 * mesh.nodes[:, 0]) * np.sin(300.0 * mesh.nodes[:, 1] + 1.0)
    for pose in (Pose((0.3e-3, 0.2e-3, 0.0)),
                 rotate_pose_about_its_position(Pose((0.3e-3, 0.2e-3, 0.0)), (0.1, 0.05, 0.0))):
        assert height(mesh, tool, pose, first_line=1) == height(mesh, tool, pose)


@pytest.mark.slow
@pytest.mark.parametrize("tool", [ts.Tool("flat", radius=RADIUS), ts.Tool("sphere", radius=RADIUS)],
                         ids=["an edge", "a ball"])
def test_the_height_follows_the_nodes(tool):
    """Against differences, for nodes that go anywhere."""
    mesh, rng = block(LINE, LINE, [-0.02, 0.0], HEX27P1), np.random.default_rng(2)
    places = mesh.nodes.copy()
    places[:, 2] += 0.5e-3 * np.cos(90.0 * places[:, 0] + 0.4) * np.cos(70.0 * places[:, 1])
    ways = 1e-3 * np.sin(60.0 * places[:, [1, 2, 0]] + rng.uniform(0.0, 6.0, 3))
    bodies = [ContactPair(tool.profile, mesh.sets["top"], (0.0, 0.0))]
    pose = rotate_pose_about_its_position(Pose((1.1e-3, 0.4e-3, 0.0)), (0.2, 0.1, 0.0))
    high, low = (find_first_touch(mesh, places + side * 1e-4 * ways, bodies, pose).height for side in (1.0, -1.0))
    derivative = find_first_touch(mesh, places, bodies, pose).differentiate_height_by_mesh_parameter(mesh, ways)
    assert derivative == pytest.approx((high - low) / 2e-4, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("element", [HEX27P1, TET15P1], ids=lambda element: element.name)
def test_a_ball_touches_a_curved_top(element):
    """Compared with all points of a fine lattice."""
    def bent(nodes):
        return nodes + [0.0, 0.0, 1.0] * (2e-3 * np.cos(300.0 * nodes[:, :1]) * np.cos(200.0 * nodes[:, 1:2]))

    mesh = block(LINE, LINE, [-0.02, 0.0], element)
    mesh.nodes[:] = bent(mesh.nodes)
    tool, place = ts.Tool("sphere", radius=RADIUS), np.array([2.3e-3, 1.4e-3])
    sides = mesh.faces["top"]
    line = np.linspace(0.0, 1.0, 101)
    lattice = np.stack(np.meshgrid(line, line), axis=-1).reshape(1, -1, 2)
    faces = [FacePolynomialMaps(element, mesh.nodes[sides[[k]]]) for k in range(len(sides))]
    points = np.concatenate([face.evaluate_face_positions(np.array([0]), lattice)[0] for face in faces])
    squares = ((points[:, :2] - place) ** 2).sum(axis=1)
    points, squares = points[squares < RADIUS**2], squares[squares < RADIUS**2]
    expected = (points[:, 2] + np.sqrt(RADIUS**2 - squares)).max() - RADIUS
    assert 0.0 <= height(mesh, tool, Pose((*place, 0.0))) - expected < 1e-7


def test_beside_the_specimen_it_touches_nothing():
    mesh = block(LINE, LINE, [-0.02, 0.0], HEX8P0)
    for tool in (ts.Tool("sphere", radius=RADIUS), ts.Tool("flat", radius=RADIUS)):
        for place in (0.1, 0.02 + RADIUS + 1e-5):
            with pytest.raises(InputError, match="comes down outside of the specimen"):
                height(mesh, tool, Pose((place, 0.0, 0.0)))


@pytest.mark.slow
def test_the_force_does_not_tell_where_the_nodes_are():
    """A ball over a node and between two, 1 mm further: by nodes alone they were 3 % apart."""
    material = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3))
    mesh = block(LINE, LINE, np.cumsum([-0.02, 7e-3, 5e-3, 4e-3, 4e-3]), HEX27P1)

    def force(offset):
        experiment = ts.KINDS["needle_indentation"].experiment(
            specimen=ts.Block(0.04, 0.04, 0.02), protocol=ts.Protocol.ramp(depth=3e-3, points=4),
            tool=ts.Tool("sphere", radius=RADIUS), friction="frictionless",
            approach=ts.Approach(offset) if offset else None)
        return ts.simulate(ts.Model(experiment, material), solver="solid", mesh=mesh).force[-1]

    assert force(1e-3) == pytest.approx(force(0.0), rel=0.01)


def test_on_the_way_to_the_first_node_there_is_no_force():
    """Contact is at the nodes: a tool that has come down between them, and a leaning one, step without any."""
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Block(0.04, 0.04, 0.02), protocol=ts.Protocol.ramp(depth=1e-3, points=2),
        tool=ts.Tool("round", radius=RADIUS), friction=0.3, approach=ts.Approach(4.736e-3, math.radians(20.0)))
    material = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3))
    solver = make_solver(ts.Model(experiment, material), mesh=block(LINE, LINE, [-0.02, -0.01, 0.0], HEX8P0))
    forces = []  # between two nodes of an edge, whose middle the tool meets
    for depth in np.linspace(0.05e-3, 1e-3, 8):
        step = solver.step(experiment.tool_pose(depth), max_iterations=40)
        assert step.status is StepStatus.CONVERGED
        forces.append(step.force)
    assert forces[0] == 0.0 and forces[-1] > 0.0 and (np.diff(forces) >= 0.0).all()
