"""The generator of motions (`benchmarks/motions`): its truths, its judge, and a few motions of each trap."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.pose import Pose

MODULES = ("course", "judge", "scenes", "traps", "truth", "coupling")
#: Motions of each trap that are played.
COUNT = 2


@pytest.fixture(scope="module")
def generator(benchmark_module):
    """The modules of the generator by their names; ``main`` is its command line."""
    return SimpleNamespace(**{name: benchmark_module(f"motions.{name}") for name in MODULES},
                           main=benchmark_module("motions.__main__"))


@pytest.fixture(scope="module")
def bonded(generator):
    """A needle that holds elastic tissue."""
    return generator.scenes.Scene("axisymmetric", "flat", 6e-3, "bonded")


def press(generator, scene, depths, dt=1e-3):
    """A motion along depths, m."""
    return generator.course.Motion("press", scene, tuple(
        generator.traps.moves([Pose.at_depth(depth) for depth in depths], dt)))


def true_forces(generator, motion):
    """Along z at each compared operation."""
    found = {}
    for path in generator.course.paths(motion.operations):
        found |= generator.truth.truths(motion.scene, path)
    return {index: truth.force[2] for index, truth in found.items()}


class TestTruth:
    def test_elastic_bonded_tissue_does_not_depend_on_the_path(self, generator, bonded):
        direct = true_forces(generator, press(generator, bonded, [2e-3]))
        detour = true_forces(generator, press(generator, bonded, [-1e-3, 3e-3, 1e-3, 2e-3]))
        assert detour[0] == 0.0
        assert detour[3] == pytest.approx(direct[0], rel=1e-5)

    def test_it_is_the_force_of_simulate(self, generator, bonded):
        """The whole test on the same mesh, which is stepped by a different program."""
        recording = ts.simulate(bonded.model(), resolution=bonded.resolution)
        force = true_forces(generator, press(generator, bonded, [bonded.depth]))
        assert force[0] == pytest.approx(float(recording.force[-1]), rel=1e-4)

    def test_a_factor_of_all_moduli_is_a_factor_of_the_force(self, generator, bonded):
        course = generator.course
        motion = press(generator, bonded, [2e-3, 2e-3])
        scaled = replace(motion, operations=(motion.operations[0], course.Scale(2.0), motion.operations[1]))
        force = true_forces(generator, scaled)
        stiffer = replace(bonded, parameters=(("C10", 4000.0),))
        assert force[2] == pytest.approx(2.0 * force[0], rel=1e-5)
        assert force[2] == pytest.approx(true_forces(generator, press(generator, stiffer, [2e-3]))[0], rel=1e-5)

    def test_reset_and_restore_begin_other_paths(self, generator, bonded):
        course, moves = generator.course, generator.traps.moves
        a, b, c = (moves([Pose.at_depth(depth)], 1e-3)[0] for depth in (1e-3, 2e-3, 3e-3))
        found = course.paths((a, course.Save(), b, course.Restore(), c, course.Reset(), b))
        assert [[(tick.pose.depth, tick.index) for tick in path] for path in found] == [
            [(1e-3, 0), (2e-3, 2)], [(1e-3, course.NOT_COMPARED), (3e-3, 4)], [(2e-3, 6)]]


class FaultyTissue:
    """A simulator with a fault.

    Args:
        tissue: a sound one.
        change: makes another answer of an answer.
    """

    def __init__(self, tissue, change):
        self._tissue, self._change = tissue, change

    def step(self, pose, dt):
        return self._change(self._tissue.step(pose, dt))


class TestJudge:
    @pytest.mark.parametrize(("change", "verdict"), [
        (lambda answer: answer, "right"),
        (lambda answer: answer.multiply_force_and_set_status(0.95, answer.status), "silently wrong"),
        (lambda answer: replace(
            answer.multiply_force_and_set_status(0.95, answer.status), force_error=0.1 * answer.force),
         "wrong, but within the error that the answer states"),
        (lambda answer: answer.multiply_force_and_set_status(0.95, ts.ForceStatus.LATE), "not converged"),
        (lambda answer: 1 / 0, "fault")])
    def test_faults_are_found(self, generator, bonded, monkeypatch, change, verdict):
        judge = generator.judge
        sound = judge.tissue_of
        monkeypatch.setattr(judge, "tissue_of", lambda scene: FaultyTissue(sound(scene), change))
        motion = press(generator, bonded, np.linspace(1e-3, 3e-3, 5))
        assert judge.judged(motion).outcome == verdict

    def test_an_accepted_nan_is_silently_wrong(self, generator, bonded, monkeypatch):
        judge, course = generator.judge, generator.course
        motion = press(generator, bonded, [1e-3, 2e-3])
        lost = course.Move(Pose.at_depth(float("nan")), 1e-3, None)
        motion = replace(motion, operations=(*motion.operations, lost))
        assert judge.judged(motion).outcome == "right"
        answer = ts.ToolForce.from_axial_force(1.0, 0.0, ts.ForceStatus.CONVERGED)
        sound = judge.tissue_of
        monkeypatch.setattr(judge, "tissue_of", lambda scene: FaultyTissue(
            sound(scene), lambda each: answer if each.status is ts.ForceStatus.REFUSED else each))
        assert judge.judged(motion).outcome == "silently wrong"

    def test_a_stale_stiffness_must_be_marked(self, generator, bonded, monkeypatch):
        judge = generator.judge
        motion = replace(press(generator, bonded, [1e-3, 2e-3, 3e-3]), checks_stiffness=True)
        sound, stale = judge.tissue_of, ts.ToolForce.from_axial_force(0.0, 1.0,
                                                                      ts.ForceStatus.CONVERGED).stiffness_matrix
        for age, outcome in ((0.0, "silently wrong"), (1e-3, "right")):
            monkeypatch.setattr(judge, "tissue_of", lambda scene, age=age: FaultyTissue(
                sound(scene), lambda answer: replace(answer, stiffness_matrix=stale, stiffness_age=age)))
            assert judge.judged(motion).outcome == outcome


#: Traps whose motions are played here: all of axisymmetric scenes except the most expensive one.
TRAPS = ("clean", "aside in the air", "off the axis in contact", "spin", "teleport", "start inside", "reset inside",
         "lift off and touch again", "long rest in the air", "not finite", "wild input", "rounded quaternions",
         "deepcopy", "copy", "pickle", "clone", "save and restore", "state of another model", "material changed",
         "refused parameters", "few solutions a step", "pauses and irregular ticks", "other simulators and threads",
         "light tool")


def test_every_trap_is_played(generator):
    assert {"clean", "light tool", *generator.traps.AXISYMMETRIC} == {"too deep", *TRAPS}


@pytest.mark.slow
@pytest.mark.parametrize("trap", TRAPS)
def test_no_answer_is_silently_wrong(generator, trap):
    motions = generator.main
    for index in range(COUNT):
        task = motions.Task("axisymmetric", index, 1, trap == "clean", None if trap == "clean" else trap)
        result = motions.play(task)
        assert result.outcome in ("right", "not converged"), (index, result.scene, result.notes)
