"""Symmetries of a solid under its tool: images of strokes against solved ones, and none where there is no symmetry."""

import math
from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.reduced import training
from tissue_sim.fem.reduced.reduction import verify_and_get_report_and_factors
from tissue_sim.fem.reduced.settings import VERIFICATION
from tissue_sim.fem.reduced.symmetry import find_symmetries, split_into_involutions_and_cosets
from tissue_sim.fem.reduced.training import make_training_path
from tissue_sim.pose import compute_rigid_motion

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e3))
DEPTH = 2e-3
#: Flat needle.
NEEDLE = ts.Tool("flat", radius=8e-3)
BALL = ts.Tool("round", radius=8e-3)
CYLINDER = ts.Specimen(0.03, 0.02)
#: Tool, friction, approach, and how many symmetries.
SCENES = {"held": (NEEDLE, "bonded", None, 8), "touched": (BALL, 0.3, None, 8),
          "off the axis": (BALL, 0.3, ts.Approach(offset=4e-3), 2),
          "leaning": (ts.Tool("flat", radius=5e-3), "bonded", ts.Approach(offset=4e-3, angle=0.2), 2)}


def model(tool, friction, approach=None, specimen=CYLINDER, **more):
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=specimen, protocol=ts.Protocol.ramp(DEPTH, points=2), tool=tool, friction=friction,
        approach=approach, **more)
    return ts.Model(experiment, MATERIAL)


def scene(name):
    """A model, its box, the whole solid's solver, and the tool's first pose."""
    tool, friction, approach, _ = SCENES[name]
    whole = model(tool, friction, approach)
    box = ts.PoseBox(1e-3, DEPTH, 0.05 if friction == "bonded" else 0.0)
    solver = training.make_full_order_solver(whole, training.build_training_mesh(whole, box, "realtime"))
    return whole, box, solver, whole.experiment.tool_pose(0.0)


def map_wrench(matrix, wrench):
    """Return the image of a wrench under an orthogonal matrix; the torque is an axial vector."""
    force, torque = np.split(np.asarray(wrench), 2)
    return np.concatenate([matrix @ force, np.linalg.det(matrix) * matrix @ torque])


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_images_are_what_the_solid_does(name):
    """A stroke's image, against the same stroke reflected and solved."""
    whole, box, solver, start = scene(name)
    group = find_symmetries(solver, start)
    assert len(group) == SCENES[name][3] and group[0].is_identity
    poses = make_training_path(3, box, start, holds=whole.experiment.friction == "bonded", reach=8e-3)
    own = training.simulate_snapshots(solver, poses, tolerance=1e-10)
    assert np.abs(own.wrenches[:, :2]).max() > 0.02 * np.abs(own.wrenches[:, 2]).max()   # it is dragged
    for symmetry in group[1::3]:
        ways = [symmetry.map_pose(pose, start) for pose in poses]
        assert max(math.dist(one.position, other.position) for one, other in zip(ways, poses, strict=True)) > 1e-4
        assert all(box.contains_pose(pose, start) for pose in ways if pose.depth >= 0.0)
        solved = training.simulate_snapshots(solver, ways, tolerance=1e-10)
        images = np.array([map_wrench(symmetry.matrix, wrench) for wrench in own.wrenches])
        for part in (slice(3), slice(3, 6)):
            largest = np.abs(solved.wrenches[:, part]).max()
            np.testing.assert_allclose(images[:, part], solved.wrenches[:, part], rtol=0, atol=1e-7 * largest)
        np.testing.assert_allclose(symmetry.map_displacements(own.displacements), solved.displacements, rtol=0,
                                   atol=1e-6 * np.abs(solved.displacements).max())


def test_a_rotation_turns_as_poses_do():
    """An image of an image of a pose is the pose's under both, one after the other."""
    _, _, solver, start = scene("held")
    group = find_symmetries(solver, start)
    pose = make_training_path(5, ts.PoseBox(1e-3, DEPTH, 0.05), start, holds=True, reach=8e-3)[4]
    for one in group:
        for other in group:
            both = next(each for each in group if (each.matrix == other.matrix @ one.matrix).all())
            image = other.map_pose(one.map_pose(pose, start), start)
            np.testing.assert_allclose(compute_rigid_motion(both.map_pose(pose, start), image), 0.0, atol=1e-12)
            np.testing.assert_array_equal(both.nodes, other.nodes[one.nodes])


class TestNone:
    """A transformation that is not a symmetry of mesh, sets, bonded faces or tool gives no images."""

    @staticmethod
    def count(solver, start=None):
        return len(find_symmetries(solver, start or ts.Pose.at_depth(0.0)))

    @pytest.mark.parametrize("moved", ["a node", "a set"])
    def test_of_a_mesh(self, moved):
        whole, box, _, _ = scene("touched")
        mesh = training.build_training_mesh(whole, box, "realtime")
        assert self.count(training.make_full_order_solver(whole, mesh)) == 8
        if moved == "a node":
            nodes = mesh.nodes.copy()
            # Off the axis and the mirrors: between the axes and their bisectors.
            inner = np.setdiff1d(np.arange(len(nodes)), np.concatenate(list(mesh.sets.values())))
            angle = np.arctan2(nodes[inner, 1], nodes[inner, 0])
            nodes[inner[np.argmin(np.abs(angle - math.pi / 8))]] += 1e-6
            mesh = replace(mesh, nodes=nodes)
        else:
            side = mesh.sets["side"]
            mesh = replace(mesh, sets={**mesh.sets, "side": side[mesh.nodes[side, 0] > 1e-3]})
        # The set that is left is that of x > 0, with its mirror y -> -y.
        assert self.count(training.make_full_order_solver(whole, mesh)) == {"a node": 1, "a set": 2}[moved]

    def test_of_what_keeps_a_loose_solid_where_it_is(self):
        """Between faces without friction a node of the base is held along y: of the mirrors only y -> -y keeps it."""
        whole = model(BALL, "frictionless", friction_base="frictionless")
        mesh = training.build_training_mesh(whole, ts.PoseBox(0.0, DEPTH), "realtime")
        assert self.count(training.make_full_order_solver(whole, mesh)) == 2

    def test_of_a_tool_that_leans(self):
        _, _, solver, start = scene("touched")
        leaning = replace(start, orientation=(math.cos(0.1), 0.0, math.sin(0.1), 0.0))
        assert self.count(solver, leaning) == 2
        assert self.count(solver, replace(start, orientation=(math.cos(0.1), *(math.sin(0.1) * np.array(
            [0.6, 0.8, 0.0])),))) == 1
        assert self.count(solver, replace(start, position=(1e-3, 0.5e-3, 0.0))) == 1


class TestModes:
    def test_they_are_those_of_the_images(self):
        """The modes of states and all their images, each even or odd under the mirrors; singular values as of all."""
        _, _, solver, start = scene("touched")
        group = find_symmetries(solver, start)
        commuting, cosets = split_into_involutions_and_cosets(group)
        assert len(commuting) == 2 and len(cosets) == 2
        states = np.random.default_rng(0).normal(size=(3, solver.x.size))
        found, singular = training.compute_modes_and_singular_values(states, group, 12)
        images = np.concatenate([each.map_displacements(states) for each in group])
        np.testing.assert_allclose(singular[:24], np.linalg.svd(images, compute_uv=False), rtol=1e-9)
        np.testing.assert_allclose(found.T @ found, np.eye(found.shape[1]), atol=1e-9)
        for mirror in commuting:
            moved = mirror.map_displacements(found.T)
            signs = np.einsum("if,if->i", moved, found.T)
            np.testing.assert_allclose(np.abs(signs), 1.0, atol=1e-9)

    def test_without_symmetries_they_are_those_of_the_states(self):
        _, _, solver, start = scene("touched")
        states = np.random.default_rng(1).normal(size=(5, solver.x.size))
        found, singular = training.compute_modes_and_singular_values(states, find_symmetries(solver, start)[:1], 4)
        _, values, vectors = np.linalg.svd(states, full_matrices=False)
        np.testing.assert_allclose(singular, values, rtol=1e-9)
        np.testing.assert_allclose(np.abs(np.einsum("fi,if->i", found, vectors[:4])), 1.0, atol=1e-9)


@pytest.mark.slow
def test_images_make_a_reduced_solid_better():
    """Three strokes with their images against the three alone, on one that neither was made of."""
    whole, box, solver, start = scene("held")
    group = find_symmetries(solver, start)
    poses = [make_training_path(number, box, start, holds=True, reach=8e-3) for number in range(3)]
    taken = [training.simulate_snapshots(solver, each) for each in poses]
    errors = []
    for own in (group[:1], group):
        reduced = training.build_reduced_model(whole, solver.mesh, box, taken, poses, count=16, tolerance=6e-3,
                                               softness=1e-3, bulk_ratio=300.0, group=own)
        assert reduced.report["symmetries"] == len(own)
        unseen = make_training_path(VERIFICATION.first_test_path, box, start, holds=True, reach=8e-3)
        report, _ = verify_and_get_report_and_factors(reduced, solver, [unseen])
        assert report["not_converged"] == 0.0
        errors.append(report["force_rms_error"])
    assert errors[1] < 0.6 * errors[0] and errors[1] < 0.01
