"""Reduced solids: sampled elements and modes against the whole solid, contact, files, and poses outside of the box."""

import math
from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.reduced import training
from tissue_sim.fem.reduced.reduction import reduce_solid, remove_training_path_files
from tissue_sim.fem.reduced.settings import VERIFICATION
from tissue_sim.fem.reduced.solver import TOLERANCE, ReducedSolver
from tissue_sim.fem.reduced.training import compute_sparse_weights, make_training_path
from tissue_sim.fem.solid.contact import ToolFrame
from tissue_sim.fem.solver import StepStatus
from tissue_sim.pose import interpolate_pose, rotate_pose_about_its_position

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e3))
DEPTH = 3e-3


def model(tool: ts.Tool, **faces) -> ts.Model:
    """A flat specimen under a needle."""
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.03, 0.02), protocol=ts.Protocol.ramp(DEPTH, points=2), tool=tool, **faces)
    return ts.Model(experiment, MATERIAL)


@pytest.fixture(scope="module")
def held(coarse):
    """Return a reduced model of a bonded flat needle that moves laterally and rotates."""
    box = ts.PoseBox(1.5e-3, DEPTH, 0.06)
    return reduce_solid(model(ts.Tool("flat", radius=8e-3), friction="bonded"), box, resolution=coarse, strokes=8,
                        modes=20, tried=3)


@pytest.fixture(scope="module")
def finely_held():
    """Return the model of `held` on the default mesh."""
    box = ts.PoseBox(1.5e-3, DEPTH, 0.06)
    return reduce_solid(model(ts.Tool("flat", radius=8e-3), friction="bonded"), box, strokes=8, modes=20, tried=3)


@pytest.fixture(scope="module")
def touched(coarse):
    """Return a reduced model of a ball with friction that comes down on the axis."""
    return reduce_solid(model(ts.Tool("round", radius=8e-3), friction=0.3), ts.PoseBox(0.0, DEPTH, 0.0),
                        resolution=coarse, strokes=3, modes=12, tried=1)


@pytest.mark.slow
def test_a_tool_that_presses_the_same_nodes_has_a_stiffer_bulk(held, touched):
    assert (held.bulk_ratio, touched.bulk_ratio) == (300.0, 300.0)


class TestSampling:
    def test_few_weights_that_add_up(self):
        rng = np.random.default_rng(0)
        # Twelve kinds of elements: one of each kind is enough.
        contributions = rng.normal(size=(12, 12))[:, rng.integers(0, 12, 300)]
        weights = compute_sparse_weights(contributions, 1e-3)
        assert (weights >= 0.0).all() and (weights > 0.0).sum() <= 12
        goal = contributions.sum(axis=1)
        assert np.linalg.norm(contributions @ weights - goal) <= 1.1e-3 * np.linalg.norm(goal)

    def test_all_where_nothing_acts(self):
        np.testing.assert_array_equal(compute_sparse_weights(np.zeros((3, 4)), 1e-3), np.ones(4))


class TestStrokes:
    @pytest.mark.parametrize("holds", [True, False])
    def test_they_stay_in_the_box(self, holds):
        box, start = ts.PoseBox(2e-3, DEPTH, 0.1), ts.Pose((1e-3, 0.0, 0.0))
        poses = [pose for number in range(20) for pose in make_training_path(number, box, start, holds=holds,
                                                                             reach=5e-3)]
        assert all(box.contains_pose(pose, start) for pose in poses if holds or pose.depth >= 0.0)
        assert np.ptp([pose.position[0] for pose in poses]) > 3e-3      # and fill it
        assert max(pose.depth for pose in poses) > 0.9 * DEPTH

    def test_the_same_on_every_call(self):
        box, start = ts.PoseBox(2e-3, DEPTH), ts.Pose((0.0, 0.0, 0.0))
        first, second = (make_training_path(7, box, start, holds=True, reach=5e-3) for _ in range(2))
        assert first == second

    @pytest.mark.slow
    def test_none_knows_of_those_before_it(self, touched):
        """A strong one does not make the next one coarser."""
        of, poses = touched.model, [ts.Pose.at_depth(depth) for depth in (-1e-4, 1e-4, 2e-4)]
        alone, after = (training.make_full_order_solver(of, touched.mesh) for _ in range(2))
        training.simulate_snapshots(after, [ts.Pose.at_depth(depth) for depth in (-1e-4, 1e-3, 2e-3)])
        first, second = (training.simulate_snapshots(solver, poses) for solver in (alone, after))
        np.testing.assert_allclose(second.displacements, first.displacements, rtol=0, atol=1e-17)


@pytest.mark.slow
class TestForces:
    @pytest.mark.slow
    def test_held_tissue_on_unseen_strokes(self, finely_held):
        report = finely_held.report
        assert report["force_rms_error"] < 0.01 and report["not_converged"] == 0.0
        assert report["elements"] < 0.5 * report["elements_of_all"]

    def test_touched_tissue_on_unseen_strokes(self, touched):
        assert touched.report["force_rms_error"] < 0.04 and touched.report["not_converged"] == 0.0

    def test_all_elements_and_all_states_give_back_the_whole_solid(self, coarse):
        """Three states in three modes, every element once: at these states the forces are those of the whole."""
        whole = model(ts.Tool("flat", radius=8e-3), friction="bonded")
        box = ts.PoseBox(0.0, DEPTH)
        mesh = training.build_training_mesh(whole, box, coarse)
        solver = training.make_full_order_solver(whole, mesh)
        poses = [ts.Pose.at_depth(depth) for depth in (1e-3, 2e-3, 3e-3)]
        taken = training.simulate_snapshots(solver, poses)
        reduced = training.build_reduced_model(whole, mesh, box, [taken], [poses], count=3, tolerance=0.5,
                                               softness=1e-3, bulk_ratio=1e9)
        count = len(mesh.connectivity)
        reduced = replace(reduced, elements=np.arange(count), shares=np.ones(count))
        small = ReducedSolver(reduced, MATERIAL)
        small.least_tolerance = 1e-9
        for pose, wrench in zip(poses, taken.wrenches, strict=True):
            for part in np.linspace(0.75e-3, 0.0, 4):
                step = small.step(ts.Pose.at_depth(pose.depth - part), tolerance=1e-9)
                assert step.status is StepStatus.CONVERGED
            assert step.force == pytest.approx(wrench[2], rel=2e-4)

    # Nodes at the limit of friction slip on one side of the difference and stick on the other.
    @pytest.mark.parametrize(("which", "bound"), [("held", 2e-3), ("touched", 0.02)], ids=["held", "touched"])
    def test_the_stiffness_is_the_derivative(self, which, bound, request):
        reduced = request.getfixturevalue(which)
        simulator = ReducedSolver(reduced, MATERIAL)
        simulator.least_tolerance = 1e-10
        simulator.enable_stiffness_output()
        for depth in (0.5e-3, 1e-3, 1.5e-3, 2e-3):
            step = simulator.step(ts.Pose.at_depth(depth), tolerance=1e-10)
        # Where nothing has moved since the last equilibrium, and with the stiffness of this state alone.
        for _ in range(10):
            step = simulator.step(ts.Pose.at_depth(2e-3), tolerance=1e-10)
        saved, width = simulator.save(), 1e-6
        wrenches = []
        for depth in (2e-3 + width, 2e-3 - width):
            simulator.restore(saved)
            wrenches.append(simulator.step(ts.Pose.at_depth(depth), tolerance=1e-10).force)
        assert step.stiffness == pytest.approx((wrenches[0] - wrenches[1]) / (2 * width), rel=bound)

    def test_the_age_of_the_stiffness_is_that_of_its_oldest_part(self, held):
        """A step computes one of eight parts of the stiffness; a tool at rest and a step without time get all of it."""
        simulator = ts.Simulator(held.model, solver="reduced", mesh=held, inertia="off")
        moving = [simulator.step(depth, 2e-3) for depth in np.linspace(0.0, 2.5e-3, 20).tolist()]
        assert 2e-3 <= moving[-1].stiffness_age <= 14e-3 + 1e-9
        resting = [simulator.step(2.5e-3, 2e-3) for _ in range(8)]
        assert resting[-1].stiffness_age == 0.0
        assert abs(resting[-1].stiffness - moving[-1].stiffness) > 0.01 * resting[-1].stiffness, "the old one was old"
        saved = simulator.save()
        nearby = [(simulator.restore(saved), simulator.step(depth, 0.0).force)[1] for depth in (2.52e-3, 2.48e-3)]
        assert resting[-1].stiffness == pytest.approx((nearby[0] - nearby[1]) / 4e-5, rel=0.01)
        simulator.restore(saved)
        sudden = simulator.step(0.5e-3, 0.0)
        assert sudden.stiffness_age == 0.0
        fresh = ts.Simulator(held.model, solver="reduced", mesh=held, inertia="off")
        assert sudden.stiffness == pytest.approx(fresh.step(0.5e-3, 0.0).stiffness, rel=0.01)

    def test_what_has_slipped_is_as_stiff_when_the_tool_stands(self, touched):
        """Nodes at the limit of friction would slip on, and do not hold the tissue as if it turned round."""
        solver = ReducedSolver(touched, MATERIAL)
        solver.enable_stiffness_output()
        for depth in np.linspace(0.0, 0.9 * DEPTH, 400):
            arriving = solver.step(ts.Pose.at_depth(depth))
        assert arriving.status is StepStatus.CONVERGED and solver.contact.slipping_count
        for _ in range(10):
            standing = solver.step(ts.Pose.at_depth(depth))
        assert standing.stiffness == pytest.approx(arriving.stiffness, rel=0.02)
        again = [solver.step(ts.Pose.at_depth(depth + way)) for way in np.linspace(0.0, 2e-5, 11)]
        assert standing.stiffness == pytest.approx((again[-1].force - again[0].force) / 2e-5, rel=0.02)

    def test_an_iteration_that_was_ended_goes_on(self, touched):
        """One linear solution at a time, as a budget leaves it, to the same equilibrium."""
        at_once, slowly = ReducedSolver(touched, MATERIAL), ReducedSolver(touched, MATERIAL)
        for depth in (0.5e-3, 1e-3, 1.5e-3, 2e-3):
            expected = at_once.step(ts.Pose.at_depth(depth), 1e-3)
            assert expected.status is StepStatus.CONVERGED
            step, ended = slowly.step(ts.Pose.at_depth(depth), 1e-3, max_iterations=1), 0
            while step.status is StepStatus.SLOW and ended < 20:
                step, ended = slowly.step(ts.Pose.at_depth(depth), 1e-3, max_iterations=1, resumes=True), ended + 1
            assert step.status is StepStatus.CONVERGED and ended > 0
            assert step.force == pytest.approx(expected.force, rel=1e-3)

    def test_another_material(self, held):
        """The law is evaluated again: twice the stiffness gives twice the force."""
        forces = []
        for factor in (1.0, 2.0):
            material = ts.with_values(MATERIAL, {name: factor * value for name, value in MATERIAL.parameters.items()})
            solver = ReducedSolver(held, material)
            forces.append([solver.step(ts.Pose.at_depth(depth)).force for depth in (1e-3, 2e-3)])
        np.testing.assert_allclose(forces[1], 2.0 * np.array(forces[0]), rtol=1e-3)

    def test_it_relaxes(self, held):
        relaxing = replace(MATERIAL, viscoelastic=ts.Prony((ts.PronyTerm(0.4, 0.1),)))
        solver = ReducedSolver(held, relaxing)
        first = solver.step(ts.Pose.at_depth(1e-3), 0.0).force
        for _ in range(20):
            last = solver.step(ts.Pose.at_depth(1e-3), 0.1).force
        assert last / first == pytest.approx(0.6, abs=0.01)


@pytest.fixture(scope="module")
def followed(finely_held):
    """Poses of two strokes that it was neither made of nor calibrated on, and the whole solid's forces."""
    start = finely_held.model.experiment.tool_pose(0.0)
    first = VERIFICATION.first_test_path
    ways = [make_training_path(first + number, finely_held.box, start, holds=True, reach=8e-3) for number in (11, 12)]
    solver = training.make_full_order_solver(finely_held.model, finely_held.mesh)
    return [(way, training.simulate_snapshots(solver, way).wrenches[:, :3]) for way in ways]


class TestEstimate:
    """Error estimate of the force."""

    @staticmethod
    def errors(reduced, followed):
        """True and estimated ones, N."""
        solver, true, estimated = ReducedSolver(reduced, MATERIAL), [], []
        for poses, forces in followed:
            solver.reset_to_first_touch()
            here = poses[0]
            for pose, force in zip(poses, forces, strict=True):
                for k in range(8):
                    step = solver.step(interpolate_pose(here, pose, (k + 1) / 8))
                here = pose
                true.append(np.linalg.norm(np.subtract(step.wrench[:3], force)))
                estimated.append(step.force_error)
        return np.array(true), np.array(estimated)

    @pytest.mark.slow
    def test_it_follows_the_true_one(self, finely_held, followed):
        """Within a factor of 3 of its rms, and where it is larger."""
        true, estimated = self.errors(finely_held, followed)
        assert 1 / 3 < np.sqrt(np.mean(estimated**2) / np.mean(true**2)) < 3
        assert np.corrcoef(true, estimated)[0, 1] > 0.7

    @pytest.mark.slow
    def test_it_sees_that_modes_are_missing(self, finely_held, followed):
        """Eight modes that are watched and not made: an error twice as large, and still within that factor."""
        better, _ = self.errors(finely_held, followed)
        true, estimated = self.errors(replace(finely_held, watched=finely_held.watched + 8), followed)
        assert np.mean(true**2) > 3 * np.mean(better**2)
        assert 1 / 3 < np.sqrt(np.mean(estimated**2) / np.mean(true**2)) < 3
        assert np.corrcoef(true, estimated)[0, 1] > 0.7

    def test_a_simulator_tells_it(self, held):
        simulator = ts.Simulator(held.model, solver="reduced", mesh=held)
        assert simulator.error is None
        answer = simulator.step(2e-3, 0.0)
        assert 0.0 < simulator.error < 0.02 * answer.force
        simulator.reset()
        assert simulator.error is None

    def test_what_watches_nothing_has_none(self, held):
        blind = replace(held, basis=held.basis[:, : -held.watched], watched=0)
        solvers = [ReducedSolver(each, MATERIAL) for each in (held, blind)]
        steps = [solver.step(ts.Pose.at_depth(1e-3)) for solver in solvers]
        assert steps[1].force_error is None
        assert steps[1].force == pytest.approx(steps[0].force, rel=1e-4), "what is watched moves nothing"


@pytest.mark.slow
@pytest.mark.parametrize("base", ["bonded", "frictionless"])
def test_a_motion_along_the_axis_alone_has_few_modes(base):
    """Further modes would be rounding errors without stiffness, with which no step finds an equilibrium."""
    reduced = reduce_solid(model(ts.Tool("flat", radius=8e-3), friction="bonded", friction_base=base),
                           ts.PoseBox(0.0, DEPTH), strokes=3, modes=24, tried=1)
    assert reduced.report["modes"] < 12 and reduced.report["not_converged"] == 0.0
    assert reduced.report["force_rms_error"] < 0.01


class TestBox:
    def test_outside_is_said(self, held):
        solver = ReducedSolver(held, MATERIAL)
        for pose in (ts.Pose((2e-3, 0.0, -1e-3)), ts.Pose.at_depth(3.2e-3),
                     rotate_pose_about_its_position(ts.Pose.at_depth(1e-3), (0.1, 0.0, 0.0))):
            assert solver.step(pose).status is StepStatus.OUTSIDE
        assert solver.step(rotate_pose_about_its_position(ts.Pose.at_depth(1e-3),
                                                          (0.05, 0.0, 0.0))).status is StepStatus.CONVERGED

    def test_a_simulator_stops_there_and_goes_on_inside(self, held):
        simulator = ts.Simulator(held.model, solver="reduced", mesh=held)
        assert simulator.step(1e-3, 1e-3).status is ts.ForceStatus.CONVERGED
        inside = simulator.step(ts.Pose((1e-3, 0.0, -1e-3)), 1e-3)
        outside = simulator.step(ts.Pose((2e-3, 0.0, -1e-3)), 1e-3)
        assert outside.status is ts.ForceStatus.STOPPED
        # The last equilibrium's, however far the tool has gone.
        far = simulator.step(ts.Pose((8e-3, 0.0, -1e-3)), 1e-3)
        assert far.status is ts.ForceStatus.STOPPED and far.wrench == outside.wrench
        again = simulator.step(ts.Pose((1e-3, 0.0, -1e-3)), 1e-3)
        assert again.status is ts.ForceStatus.CONVERGED
        np.testing.assert_allclose(again.wrench[:3], inside.wrench[:3], rtol=1e-3, atol=1e-5)

    def test_a_tool_that_entered_elsewhere_does_not_begin_inside(self, held):
        """It holds the tissue where it entered, which the modes cannot represent, until it leaves the tissue."""
        simulator = ts.Simulator(held.model, solver="reduced", mesh=held)
        inside = [(1e-3, 0.0, -1e-4), (5e-4, 0.0, -1e-3), (0.0, 0.0, -1e-3), (0.0, 0.0, -2e-3)]
        simulator.step(ts.Pose((1e-3, 0.0, 1e-4)), 1e-3)
        for place in inside:
            answer = simulator.step(ts.Pose(place), 1e-3)
            assert answer.status is ts.ForceStatus.STOPPED and answer.wrench == (0.0,) * 6
        saved = simulator.save()
        simulator.reset()
        simulator.restore(saved)
        assert simulator.clone().step(ts.Pose.at_depth(1e-3), 1e-3).status is ts.ForceStatus.STOPPED
        for height in (1e-3, -1e-4, -1e-3):
            answer = simulator.step(ts.Pose((0.0, 0.0, height)), 1e-3)
            assert answer.status is ts.ForceStatus.CONVERGED
        assert answer.force > 0.1

    def test_without_time_it_stops_there_too(self, held):
        """A step whose time is over carries the force on, but to nowhere that the box does not hold."""
        simulator = ts.Simulator(held.model, solver="reduced", mesh=held)
        simulator.warm_up()
        for tick in range(1, 41):
            inside = simulator.step(ts.Pose.at_depth(tick * 5e-5), 1e-3)
        assert inside.status is ts.ForceStatus.CONVERGED
        simulator.budget = 1e-9
        late = simulator.step(ts.Pose.at_depth(2.2e-3), 1e-3)
        assert late.status is ts.ForceStatus.LATE and late.force > inside.force
        for place in ((0.0, 0.0, 0.02), (0.0, 0.0, -0.02), (0.05, 0.0, -2e-3)):
            outside = simulator.step(ts.Pose(place), 1e-3)
            assert outside.status is ts.ForceStatus.STOPPED and outside.wrench == inside.wrench
        simulator.budget = None
        assert simulator.step(ts.Pose.at_depth(2e-3), 1e-3).status is ts.ForceStatus.CONVERGED

    def test_in_the_air_a_tool_goes_where_it_likes(self, touched):
        solver = ReducedSolver(touched, MATERIAL)
        for depth in (0.5e-3, 1e-3, 1.5e-3, 2e-3):
            assert solver.step(ts.Pose.at_depth(depth)).force > 0.0
        assert solver.step(ts.Pose((5e-3, 0.0, -1e-3))).status is StepStatus.OUTSIDE
        step = solver.step(ts.Pose((5e-3, 0.0, 1e-3)))
        assert step.status is StepStatus.CONVERGED and step.force == pytest.approx(0.0, abs=1e-6)

    def test_a_tool_that_lifts_off_is_never_outside(self, touched):
        """Micrometre by micrometre through the layer, whose upper half is above the box."""
        solver, top = ReducedSolver(touched, MATERIAL), touched.softness * touched.model.experiment.contact_radius
        solver.step(ts.Pose.at_depth(0.2e-3))
        steps = [solver.step(ts.Pose.at_depth(depth)) for depth in np.linspace(3 * top, -3 * top, 25)]
        assert all(step.status is StepStatus.CONVERGED for step in steps)
        assert steps[0].force > steps[11].force > steps[-1].force == 0.0

    def test_in_the_air_nothing_is_computed(self, touched, monkeypatch):
        """But for the stiffness of tissue at rest, a part in each of the first ticks; the next touch is a first one."""
        solver, fresh = ReducedSolver(touched, MATERIAL), ReducedSolver(touched, MATERIAL)
        for depth in (1e-3, 2e-3):
            solver.step(ts.Pose.at_depth(depth))
        elements = type(solver.elements)
        evaluate, asked = elements.evaluate_forces_and_stiffness, []
        monkeypatch.setattr(elements, "evaluate_forces_and_stiffness",
                            lambda *how: (asked.append(how[-1]), evaluate(*how)))
        for k in range(30):
            step = solver.step(ts.Pose((1e-4 * k, 0.0, 1e-3)))
            assert step.status is StepStatus.CONVERGED and step.wrench == (0.0,) * 6
        assert asked == [1] * 8
        again, first = ([each.step(ts.Pose.at_depth(depth)) for depth in np.linspace(0.0, 2e-3, 9)]
                        for each in (solver, fresh))
        assert all(step.status is StepStatus.CONVERGED for step in (*again, *first))
        np.testing.assert_allclose([step.force for step in again], [step.force for step in first], rtol=1e-3, atol=1e-6)

    def test_held_tissue_cannot_be_pulled_out_of_it(self, held):
        assert ReducedSolver(held, MATERIAL).step(ts.Pose.at_depth(-1e-3)).status is StepStatus.OUTSIDE

    @pytest.mark.parametrize(("sizes", "field"), [((-1e-3, 1e-3), "box.sideways"), ((0.0, 0.0), "box.depth"),
                                                  ((0.0, 1e-3, math.nan), "box.turn")])
    def test_sizes_that_are_none(self, sizes, field):
        with pytest.raises(ts.InputError) as refused:
            ts.PoseBox(*sizes)
        assert refused.value.field == field


class TestFile:
    def test_what_is_written_is_read(self, held, tmp_path):
        path = tmp_path / "needle.reduced.npz"
        ts.write_reduced(held, path)
        read = ts.load_reduced(path)
        assert read.model.experiment.tool == held.model.experiment.tool and read.box == held.box
        assert read.report == held.report and read.watched == held.watched > 0
        assert read.error_factors == held.error_factors != (1.0, 0.0)
        forces = [ReducedSolver(each, MATERIAL).step(ts.Pose.at_depth(1e-3)).force for each in (held, read)]
        assert forces[0] == forces[1]

    @pytest.mark.parametrize("damage", ["cut", "text", "elements", "version"])
    def test_damaged_files_are_one_sentence(self, damage, held, tmp_path):
        path = tmp_path / "needle.reduced.npz"
        ts.write_reduced(replace(held, elements=held.elements + 10**6) if damage == "elements" else held, path)
        content = path.read_bytes()
        if damage == "cut":
            path.write_bytes(content[: len(content) // 2])
        elif damage == "text":
            path.write_text("nothing\n", encoding="utf-8")
        elif damage == "version":
            with np.load(path) as stored:
                arrays = dict(stored)
            arrays["description"] = np.array(str(arrays["description"]).replace('"version": 1', '"version": 99'))
            np.savez(path, **arrays)
        with pytest.raises(ts.InputError) as refused:
            ts.load_reduced(path)
        assert str(refused.value.file) == str(path) and "tissue-sim reduce" in str(refused.value)

    @pytest.mark.slow
    def test_what_was_killed_goes_on(self, held, coarse, tmp_path, monkeypatch):
        """The strokes that are done are not done again; the result is the same."""
        folder, done = tmp_path / "strokes", []

        def stop(stage, count, of, **_):
            done.append((stage, count))
            if (stage, count) == ("strokes", 3):
                raise KeyboardInterrupt

        options = {"resolution": coarse, "strokes": 8, "modes": 20, "tried": 1, "folder": folder}
        with pytest.raises(KeyboardInterrupt):
            reduce_solid(held.model, held.box, progress=stop, **options)
        assert len(list(folder.glob("stroke_*.npz"))) == 3
        made, simulate = [], training.simulate_snapshots

        def counted(solver, poses, **more):
            made.append(len(poses))
            return simulate(solver, poses, **more)

        for module in ("training", "reduction"):
            monkeypatch.setattr(f"tissue_sim.fem.reduced.{module}.simulate_snapshots", counted)
        again = reduce_solid(held.model, held.box, **options)
        along, tried_along = 2, 2
        assert len(made) == 5 + along + 1 + tried_along  # the other five, and one that it is tried on
        np.testing.assert_allclose(again.basis, held.basis, atol=1e-9)
        remove_training_path_files(folder)
        assert not folder.exists()


@pytest.mark.parametrize(("faces", "tool", "field"), [
    ({"friction": "bonded", "friction_base": 0.3}, "flat", "friction_base")])
def test_what_it_does_not_take(faces, tool, field):
    with pytest.raises(ts.InputError) as refused:
        reduce_solid(model(ts.Tool(tool, radius=8e-3), **faces), ts.PoseBox(0.0, DEPTH), strokes=2)
    assert refused.value.field == field


@pytest.mark.parametrize("changes", [{"tool": ts.Tool("flat", radius=5e-3)}, {"friction": "stick"},
                                     {"specimen": ts.Specimen(0.03, 0.025)}], ids=lambda changes: next(iter(changes)))
def test_another_experiment_is_refused(held, changes):
    other = replace(held.model, experiment=replace(held.model.experiment, **changes))
    with pytest.raises(ts.InputError) as refused:
        ts.Simulator(other, solver="reduced", mesh=held)
    assert refused.value.field == f"experiment.{next(iter(changes))}"


def test_layers_that_it_was_not_made_of_are_refused(held):
    layered = replace(MATERIAL, layers=(ts.Layer(1e-3, 10.0),))
    with pytest.raises(ts.InputError, match="the reduced solid has no layers"):
        ts.Simulator(replace(held.model, material=layered), solver="reduced", mesh=held)


@pytest.mark.slow
def test_a_smooth_motion_needs_few_further_looks(held):
    """What the last step left and what its prediction missed are in the next one, and go back with the state."""
    def pose(tick: int) -> ts.Pose:
        angle = 0.003 * tick
        place = 1e-3 * math.sin(angle), 0.8e-3 * math.sin(1.3 * angle), -1.5e-3 * (1.0 - math.cos(angle))
        return rotate_pose_about_its_position(ts.Pose(place),
                                              (0.02 * math.sin(angle), 0.02 * math.sin(0.7 * angle), 0.0))

    plain, close = ReducedSolver(held, MATERIAL), ReducedSolver(held, MATERIAL)
    close.least_tolerance = 1e-8
    further, missed = [], []
    for tick in range(1, 401):
        step = plain.step(pose(tick), 1e-3)
        exact = close.step(pose(tick), 1e-3, tolerance=1e-8, max_iterations=60)
        assert step.status is exact.status is StepStatus.CONVERGED
        further.append(step.iterations)
        missed.append(np.linalg.norm(np.subtract(step.wrench, exact.wrench)[:3]) / np.linalg.norm(exact.wrench[:3]))
    assert np.mean(further[50:]) < 0.1
    assert max(missed[50:]) < 1e-3
    saved = plain.save()
    first = [plain.step(pose(tick), 1e-3).wrench for tick in range(401, 404)]
    plain.restore(saved)
    assert np.array([plain.step(pose(tick), 1e-3).wrench for tick in range(401, 404)]) == pytest.approx(
        np.array(first), rel=1e-3, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("between_steps", "at_least"), [("nothing", 20), ("one that fails", 1), ("there and back", 1)])
def test_what_is_not_looked_at_again_is_in_equilibrium(held, between_steps, at_least):
    """A linear solution with a small residual is accepted; here a second solver checks each."""
    solver, checker = ReducedSolver(held, MATERIAL), ReducedSolver(held, MATERIAL)
    looks, evaluate = [], solver.elements.evaluate_forces_and_stiffness

    def looked(*asked):
        looks.append(asked)
        evaluate(*asked)

    solver.elements.evaluate_forces_and_stiffness = looked
    start = held.model.experiment.tool_pose(0.0)
    first = VERIFICATION.first_test_path
    ways = [make_training_path(first + number, held.box, start, holds=True, reach=8e-3)[:20] for number in (5, 6)]
    believed, off = [], []
    for pose, elsewhere in zip(*ways, strict=False):
        before = solver.pose
        for number, part in enumerate(np.linspace(0.05, 1.0, 20)):
            to = interpolate_pose(before, pose, part)
            if number % 7 == 0 and between_steps != "nothing":
                failed = solver.step(elsewhere, max_iterations=1 if between_steps == "one that fails" else 60)
                assert failed.status in (StepStatus.SLOW, StepStatus.INVERTED, StepStatus.CONVERGED)
                solver.step(interpolate_pose(before, to, 0.99), max_iterations=60)
            looks.clear()
            step = solver.step(to, max_iterations=60)
            if step.status is not StepStatus.CONVERGED:
                # After a jump across the box the stiffness is that of another place: some steps say that they fail.
                assert between_steps != "nothing"
                continue
            assert step.residual <= TOLERANCE
            if len(looks) > step.iterations:
                continue
            checker.restore(solver.save())
            # Pressures follow what the volumes there miss.
            checker.elements.evaluate_forces_and_stiffness(solver.amplitudes, True, 0)
            pushed, _ = checker._compute_modal_contact_forces_and_rates(solver.amplitudes,
                                                                        frame := ToolFrame(to, solver.datum), True)
            residual = checker.elements.modal_forces + pushed
            scale = solver._compute_reference_force(np.linalg.norm(residual[:held.lifting]) + np.linalg.norm(pushed))
            believed.append(np.linalg.norm(residual[held.lifting:len(residual) - held.watched]) / scale)
            rates = checker._tool_motion.compute_amplitude_rates(frame)
            wrench = checker.contact.wrench - rates.T @ residual[:held.lifting]
            off.append(np.linalg.norm(np.subtract(step.wrench, wrench)[:3]) / max(np.linalg.norm(wrench[:3]), scale))
    assert len(believed) >= at_least
    assert max(believed) <= TOLERANCE
    assert max(off) < 1e-3


@pytest.mark.parametrize("ratio", [0.5, 2e3, math.nan])
def test_a_bulk_that_no_modes_can_bear_is_refused(ratio):
    with pytest.raises(ts.InputError, match="1 to 1000") as refused:
        reduce_solid(model(ts.Tool("flat", radius=8e-3), friction="bonded"), ts.PoseBox(0.0, DEPTH), bulk_ratio=ratio)
    assert refused.value.field == "bulk_ratio"


def test_a_state_that_is_put_back_is_stepped_as_a_fresh_one(held):
    """Whatever was done between."""
    fresh, used = ReducedSolver(held, MATERIAL), ReducedSolver(held, MATERIAL)
    for each in (fresh, used):
        each.enable_stiffness_output()
    start = used.save()
    for depth in (1e-3, 2e-3, 3e-3):
        used.step(ts.Pose.at_depth(depth))
    used.restore(start)
    steps = [each.step(ts.Pose.at_depth(0.3e-3)) for each in (fresh, used)]
    assert steps[0].stiffness == pytest.approx(steps[1].stiffness, rel=1e-9)
    assert steps[0].force == pytest.approx(steps[1].force, rel=1e-9)


def test_where_the_box_has_no_size_no_stiffness_is_made_up(touched):
    solver = ReducedSolver(touched, MATERIAL)
    solver.enable_stiffness_output()
    step = solver.step(ts.Pose.at_depth(1e-3))
    assert step.stiffness > 0.0 and step.stiffness_matrix[0] == (0.0,) * 6


def test_a_solver_needs_its_file():
    with pytest.raises(ts.InputError) as refused:
        ts.Simulator(model(ts.Tool("flat", radius=8e-3)), solver="reduced")
    assert refused.value.field == "mesh"
