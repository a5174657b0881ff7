"""Reduced solids at the boundary of their box: strokes along it, and the error by compliance that the modes lack."""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.reduced import training
from tissue_sim.fem.reduced.model import ContactNodeComplianceTable, calibrate_accepted_missing_forces
from tissue_sim.fem.reduced.reduction import with_calibrated_compliance_table
from tissue_sim.fem.reduced.symmetry import find_symmetries
from tissue_sim.fem.reduced.training import make_boundary_training_paths, make_training_path
from tissue_sim.pose import compute_rigid_motion

pytestmark = pytest.mark.slow

MATERIAL = ts.Material("neo_hooke", {"C10": 2000.0}, ts.Bulk("bulk_ratio", 1e3))
BOX = ts.PoseBox(1.5e-3, 1.6e-3)
START = ts.Pose((0.0, 0.0, 0.0))
#: Places that the strokes of a sequence do not press, and one that they do, m.
PLACES = ((1.4e-3, 1.4e-3), (1.4e-3, 0.0), (0.0, 0.0))
DEPTHS = np.linspace(0.0, BOX.depth, 9)


@pytest.fixture(scope="module")
def ball(coarse):
    """Return a reduced model of a sliding ball, trained on two strokes and on those along the boundary."""
    experiment = ts.Experiment(ts.Specimen(0.030, 0.020), ts.Protocol.ramp(BOX.depth, 2),
                               tool=ts.Tool("round", radius=8e-3), friction=0.3)
    return ts.reduce_solid(ts.Model(experiment, MATERIAL), BOX, resolution=coarse, strokes=2, modes=12, tried=1)


@pytest.fixture(scope="module")
def fine_ball(ball):
    """Return the model of `ball` on the default mesh, with more strokes and modes."""
    return ts.reduce_solid(ball.model, BOX, strokes=6, modes=20, tried=1)


@pytest.fixture(scope="module")
def central(fine_ball):
    """The same solid of strokes near the middle of the box, as one whose strokes do not reach the corners."""
    reach = fine_ball.model.experiment.contact_radius
    small = ts.PoseBox(0.5e-3, BOX.depth)
    poses = [make_training_path(number, small, START, holds=False, reach=reach) for number in range(4)]
    solver = training.make_full_order_solver(fine_ball.model, fine_ball.mesh)
    taken = [training.simulate_snapshots(solver, each) for each in poses]
    made = training.build_reduced_model(fine_ball.model, fine_ball.mesh, BOX, taken, poses, count=20, tolerance=6e-3,
                                        softness=fine_ball.softness, bulk_ratio=fine_ball.bulk_ratio)
    return with_calibrated_compliance_table(made, solver, poses, taken, [MATERIAL] * len(poses))


@pytest.fixture(scope="module")
def truth(fine_ball):
    """Forces of the whole solid, straight down at each of the places, N, shape (places, depths, 3)."""
    solver = training.make_full_order_solver(fine_ball.model, fine_ball.mesh)
    paths = ([ts.Pose((x, y, -z)) for z in DEPTHS] for x, y in PLACES)
    return np.array([training.simulate_snapshots(solver, path, tolerance=1e-5).wrenches[:, :3] for path in paths])


def answers(reduced, place):
    """Of a simulator, straight down at a place, at the depths."""
    simulator = ts.Simulator(reduced.model, solver="reduced", mesh=reduced, inertia="off")
    simulator.step(ts.Pose((*place, 1e-4)), 1e-3)
    found = []
    for shallow, deep in zip([0.0, *DEPTHS], DEPTHS, strict=False):
        for z in np.linspace(shallow, deep, 6)[1:]:
            answer = simulator.step(ts.Pose((*place, -z)), 1e-3)
        found.append(answer)
    return found


def off(answer, force):
    """Error of the force, N."""
    return float(np.linalg.norm(np.subtract(answer.force_vector, force)))


class TestStrokes:
    @pytest.mark.parametrize("holds", [True, False])
    def test_they_reach_each_corner_and_edge_at_full_depth(self, holds):
        box = ts.PoseBox(2e-3, 1e-3, 0.1)
        strokes = make_boundary_training_paths(box, START, holds=holds, reach=5e-3)
        poses = [pose for each in strokes for pose in each]
        assert len(strokes) == 8 and all(box.contains_pose(pose, START) for pose in poses if pose.depth >= 0.0)
        deepest = {tuple(np.round(pose.position, 6)) for pose in poses if pose.depth > 0.999e-3}
        assert {(x, y, -1e-3) for x in (-2e-3, 0.0, 2e-3) for y in (-2e-3, 0.0, 2e-3)} <= deepest
        assert max(np.linalg.norm(compute_rigid_motion(START, pose)[3:]) for pose in poses) == pytest.approx(0.1)

    def test_images_are_not_followed(self, ball):
        solver = training.make_full_order_solver(ball.model, ball.mesh)
        images = [each.matrix for each in find_symmetries(solver, START)]
        assert len(make_boundary_training_paths(BOX, START, holds=False, reach=5e-3, images=images)) == 2

    def test_a_box_without_width_has_one(self):
        (only,) = make_boundary_training_paths(ts.PoseBox(0.0, 1e-3), START, holds=False, reach=5e-3)
        assert max(pose.depth for pose in only) == 1e-3

    def test_a_fraction_stays_inside(self):
        small = ts.PoseBox(0.9 * BOX.sideways, 0.9 * BOX.depth)
        for each in make_boundary_training_paths(BOX, START, holds=False, reach=5e-3, fraction=0.9):
            assert all(small.contains_pose(pose, START) for pose in each if pose.depth >= 0.0)


class TestForce:
    def test_it_is_right_within_its_stated_error_in_the_whole_box(self, fine_ball, truth):
        peak = np.linalg.norm(truth, axis=2).max()
        for place, forces in zip(PLACES, truth, strict=True):
            found = answers(fine_ball, place)
            assert all(off(a, f) <= (a.force_error or 0.0) + 0.03 * peak for a, f in zip(found, forces, strict=True))
            loaded = [a for a, f in zip(found, forces, strict=True)
                      if off(a, f) <= 0.03 * peak and np.linalg.norm(f) >= 0.2 * peak]
            assert loaded and all(a.status is ts.ForceStatus.CONVERGED for a in loaded), "no alarm where it is right"

    def test_nodes_that_no_stroke_pressed_are_in_the_estimate(self, central, truth):
        """Outside the training strokes the force is far too large, and the status reports it."""
        peak = np.linalg.norm(truth, axis=2).max()
        corner = answers(central, PLACES[0])
        assert off(corner[-1], truth[0][-1]) > 0.3 * peak, "the fault that must be stated"
        assert corner[-1].status is ts.ForceStatus.LATE
        for answer, force in zip(corner, truth[0], strict=True):
            assert off(answer, force) <= (answer.force_error or 0.0) + 0.03 * peak
        middle = list(zip(answers(central, PLACES[2]), truth[2], strict=True))
        right = [answer for answer, force in middle if off(answer, force) <= 0.03 * peak]
        assert len(right) >= 8 and all(a.status is ts.ForceStatus.CONVERGED for a in right), "no alarm where they did"

    def test_the_estimate_scales_with_the_moduli(self, central):
        errors = []
        for factor in (1.0, 3.0):
            material = ts.with_values(MATERIAL, {"C10": 2000.0 * factor})
            simulator = ts.Simulator(replace(central.model, material=material), solver="reduced", mesh=central,
                                     inertia="off")
            for z in np.linspace(0.0, BOX.depth, 30):
                answer = simulator.step(ts.Pose((1.4e-3, 1.4e-3, -z)), 1e-3)
            errors.append(answer.force_error / answer.force)
        assert errors[1] == pytest.approx(errors[0], rel=0.05)


class TestFile:
    def test_the_table_is_kept(self, ball, tmp_path):
        ts.write_reduced(ball, path := tmp_path / "ball.reduced.npz")
        again = ts.load_reduced(path)
        for name in ("nodes", "axis", "whole", "missing", "forces", "accepted"):
            np.testing.assert_array_equal(getattr(again.compliance, name), getattr(ball.compliance, name))
        last = [answers(each, PLACES[0])[-1] for each in (ball, again)]
        assert last[1].force_error == pytest.approx(last[0].force_error)

    def test_a_damaged_table_is_refused(self, ball, tmp_path):
        table = replace(ball.compliance, whole=ball.compliance.whole[:-1])
        ts.write_reduced(replace(ball, compliance=table), path := tmp_path / "ball.reduced.npz")
        with pytest.raises(ts.InputError, match="agree with each other"):
            ts.load_reduced(path)

    def test_a_file_of_an_older_version_states_all_of_the_missing_force(self, central, tmp_path):
        """It has no table; what was right on its strokes is not known, so that the estimate is larger."""
        ts.write_reduced(replace(central, compliance=None), path := tmp_path / "old.reduced.npz")
        old = ts.load_reduced(path)
        assert old.compliance is None
        for place in PLACES:
            before, now = answers(old, place), answers(central, place)
            for a, b in zip(before, now, strict=True):
                assert (a.force_error or 0.0) >= (b.force_error or 0.0) - 1e-6
        assert before[-1].force == pytest.approx(now[-1].force, rel=1e-4), "the force is the same"
        assert answers(old, PLACES[0])[-1].status is ts.ForceStatus.LATE


def test_accepted_missing_force_grows_with_the_force():
    table = ContactNodeComplianceTable(np.arange(1), np.array([0.0, 0.0, 1.0]), np.eye(1), np.eye(1), np.zeros(1),
                                       np.zeros(1))
    assert table.get_accepted_missing_force_at_tool_force(1.0) == 0.0
    known = calibrate_accepted_missing_forces(table, [2.0, 1.0, 3.0], [0.3, 0.2, 0.4], [0.1, 0.0, 0.5])
    np.testing.assert_allclose(known.accepted, [0.0, 0.2, 0.2, 0.2])
    assert known.get_accepted_missing_force_at_tool_force(0.5) == pytest.approx(0.1)
    assert known.get_accepted_missing_force_at_tool_force(6.0) == pytest.approx(0.4)
    assert known.unlimited_acceptance_copy.get_accepted_missing_force_at_tool_force(5.0) == np.inf
