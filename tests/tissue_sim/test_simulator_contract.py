"""Contract of a simulator: refusals, statuses of its answers, copies, clones and threads."""

import copy
import math
import pickle
import threading
from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.taichi.launch import BusyError, CopyError
from tissue_sim.realtime.inertia_limits import LightToolWarning, ToolReversalDetector, minimum_stable_tool_mass
from tissue_sim.realtime.tissue import MotionLimits
from tissue_sim.tool_force import (
    ERROR_FLOOR,
    ERROR_SHARE,
    is_force_error_acceptable_or_unknown,
    make_axial_stiffness_matrix,
)

SOFT = ts.Material("neo_hooke", {"C10": 2000.0}, ts.Bulk("bulk_ratio", 1e3))
NAN = math.nan
INF = math.inf
SIXTH_TURN = (math.cos(math.pi / 6), 0.0, 0.0, math.sin(math.pi / 6))


def needle(material=SOFT, radius=8e-3, friction="bonded", **options):
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(6e-3, 2), friction=friction,
                               tool=ts.Tool("flat", radius=radius))
    return ts.Simulator(ts.Model(experiment, material), **{"resolution": "realtime_20", "inertia": "off", **options})


class TestInput:
    @pytest.mark.parametrize("pose, dt", [
        (ts.Pose((NAN, 0.0, -3e-3)), 1e-3), (ts.Pose((0.0, INF, -3e-3)), 1e-3),
        (ts.Pose((0.0, 0.0, -3e-3), (NAN,) * 4), 1e-3),
        (ts.Pose((0.0, 0.0, -3e-3), (1.0, 0.0, INF, 0.0)), 1e-3), (-INF, 1e-3), (3e-3, INF), (3e-3, -1e-9),
        (ts.Pose((11.0, 0.0, -3e-3)), 1e-3), (0.3, 1e-3), (3e-3, 1e5)])
    def test_numbers_beyond_the_limits_are_refused_and_change_nothing(self, pose, dt):
        sim = needle()
        before = sim.step(1e-3, 1e-3)
        refused = sim.step(pose, dt)
        assert refused.status is ts.ForceStatus.REFUSED and refused.wrench == before.wrench
        other = needle()
        other.step(1e-3, 1e-3)
        assert sim.step(1.1e-3, 1e-3).force == other.step(1.1e-3, 1e-3).force

    @pytest.mark.parametrize("pose, dt", [(None, 1e-3), ("1e-3", 1e-3), ([0.0, 0.0, -1e-3], 1e-3), (1e-3, None),
                                          (1e-3, "1"), (ts.Pose((None, 0.0, 0.0)), 1e-3)])
    def test_other_types_are_refused_in_a_sentence(self, pose, dt):
        sim = needle()
        with pytest.raises(ts.InputError, match="must"):
            sim.step(pose, dt)
        assert sim.step(1e-3, 1e-3).status is ts.ForceStatus.CONVERGED

    def test_limits_of_a_scene(self):
        sim = needle(limits=MotionLimits(deepest=2e-3))
        assert sim.step(3e-3, 1e-3).status is ts.ForceStatus.REFUSED and not sim.has_touched
        assert sim.step(1e-3, 1e-3).status is ts.ForceStatus.CONVERGED

    def test_other_settings_of_the_path_are_used_and_cloned(self):
        usual, fine = needle(), needle(path_settings=ts.PathSettings(largest_part=0.0625 / 4))
        cloned = fine.clone()
        forces = [sim.step(2e-3, 1e-3) for sim in (usual, fine, cloned)]
        assert forces[1].force == pytest.approx(forces[0].force, rel=1e-6)
        # Four times as many parts, each with at least one linear solve.
        assert forces[1].iterations > 2 * forces[0].iterations and forces[2].iterations == forces[1].iterations
        with pytest.raises(ts.InputError, match=r"most_solves must be positive; got 0"):
            ts.PathSettings(most_solves=0)

    @pytest.mark.parametrize("values", [(1.0, 2.0), "abc", None, 3.0])
    def test_a_position_is_three_numbers(self, values):
        with pytest.raises(ts.InputError, match="position: must be 3 numbers"):
            ts.Pose(values)
        assert ts.Pose(np.array([1.0, 2.0, 3.0]), [1, 0, 0, 0]).position == (1.0, 2.0, 3.0)

    @pytest.mark.parametrize("length", [1.0 - 9e-4, 1.0 - 4e-5, 1.0 + 4e-6, 1.0 + 9e-4])
    def test_quaternions_are_normalised(self, length):
        pose = ts.Pose((0.0, 0.0, 0.0), tuple(length * part for part in SIXTH_TURN))
        np.testing.assert_allclose(pose.orientation, SIXTH_TURN, rtol=1e-14)

    @pytest.mark.parametrize("length, text", [(1.001265, "1.001265"), (0.998, "0.998000"), (1.00100001, "1.001000"),
                                              (0.5, "0.5"), (3.0, "3")])
    def test_the_message_states_length_and_tolerance(self, length, text):
        with pytest.raises(ts.InputError, match=rf"length 1 within 0\.001; got length {text}\. "):
            ts.Pose((0.0, 0.0, 0.0), (length, 0.0, 0.0, 0.0))

    @pytest.mark.parametrize("part", [1e200, -1e160, 1e308])
    def test_a_length_that_overflows_is_refused(self, part):
        with pytest.raises(ts.InputError, match="length 1 within"):
            ts.Pose((0.0, 0.0, -1e-3), (0.0, part, part, 0.0))

    def test_an_experiment_has_one_tool(self):
        with pytest.raises(ts.InputError, match=r"tool: .*one Tool; got list of 2"):
            ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(6e-3, 2), tool=[ts.Tool(), ts.Tool()])


class TestAxis:
    @pytest.mark.parametrize("pose, on_axis", [
        (ts.Pose((1e-3, 0.0, -1e-3)), False), (ts.Pose((5e-5, 5e-5, -1e-3)), True),
        (ts.Pose((0.0, 0.0, -1e-3), SIXTH_TURN), True), (ts.Pose((0.0, 0.0, -1e-3), (0.0, 0.0, 0.0, 1.0)), True),
        (ts.Pose((0.0, 0.0, -1e-3), (math.cos(2e-3), math.sin(2e-3), 0.0, 0.0)), False),
        (ts.Pose((0.0, 0.0, -1e-3), (math.cos(9e-4), 0.0, math.sin(9e-4), 0.0)), True)])
    def test_poses_away_from_the_axis_are_marked_or_refused(self, pose, on_axis):
        marked, strict = needle().step(pose, 1e-3), needle(strict_axis=True).step(pose, 1e-3)
        assert marked.status is ts.ForceStatus.CONVERGED and marked.is_on_axis is on_axis
        assert strict.is_on_axis is on_axis
        assert strict.status is (ts.ForceStatus.CONVERGED if on_axis else ts.ForceStatus.REFUSED)
        assert needle().step(1e-3, 1e-3).force == marked.force


def test_the_force_of_a_stopped_step_is_bounded():
    sim, largest = needle(), 0.0
    for depth in (1e-3, 5e-3, 20e-3, 40e-3):
        largest = max(largest, sim.step(depth, 1.0).force)
    for depth in (0.5, 5.0):
        answer = sim.step(depth, 1.0)
        assert answer.status is ts.ForceStatus.STOPPED
        largest = max(largest, sim._largest_force)
        assert answer.force <= largest + answer.stiffness * sim._largest_part * (1.0 + 1e-9)


class TestStates:
    def donor(self):
        donor = needle()
        for tick in range(1, 21):
            donor.step(tick * 1e-4, 1e-3)
        return donor.save()

    @pytest.mark.parametrize("other, what", [
        ({"radius": 6e-3}, "tool"), ({"friction": "stick"}, "interface"), ({"resolution": "realtime_35"}, "mesh"),
        ({"material": replace(SOFT, viscoelastic=ts.Prony((ts.PronyTerm(0.4, 0.5),)))}, "effects"),
        ({"material": ts.Material("reduced_polynomial_2", {"C10": 2000.0, "C20": 500.0}, SOFT.bulk)}, "law")])
    def test_one_of_another_model_is_refused_and_changes_nothing(self, other, what):
        state, sim, fresh = self.donor(), needle(**other), needle(**other)
        with pytest.raises(ts.InputError, match=f"^state: .* is of another .*{what}"):
            sim.restore(state)
        assert sim.step(1e-3, 1e-3).force == fresh.step(1e-3, 1e-3).force

    def test_one_of_other_parameters_is_taken(self):
        stiffer = needle(replace(SOFT, parameters={"C10": 4000.0}, bulk=ts.Bulk("bulk_ratio", 2e3)))
        stiffer.restore(self.donor())
        answer = stiffer.step(2e-3, 1e-3)
        assert answer.status is ts.ForceStatus.CONVERGED
        assert answer.force == pytest.approx(2.0 * needle().step(2e-3, 1e-3).force, rel=0.01)

    @pytest.mark.parametrize("state", [None, "state", 3])
    def test_something_else_is_refused(self, state):
        with pytest.raises(ts.InputError, match="state: must be a state that save"):
            needle().restore(state)


class TestOwnership:
    @pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
    def test_copies_are_refused(self, duplicate):
        sim = needle()
        for owner in (sim, sim._solver, sim._solver.equations._kernel):
            with pytest.raises(CopyError, match=r"clone\(\).*save\(\).*restore\(\)"):
                duplicate(owner)

    def test_a_clone_is_independent_at_the_same_state(self, monkeypatch):
        sim = needle(inertia="on", looks_ahead=True)
        for tick in range(1, 31):
            sim.step(tick * 5e-5, 1e-3)
        sim.set_parameters(C10=2500.0)
        # A new kernel would need this function.
        monkeypatch.setattr("tissue_sim.fem.axisymmetric.newton.make_element_assembly_functions", None)
        twin = sim.clone()
        tried = [twin.step(1.5e-3 + k * 1e-4, 1e-3) for k in range(10)]
        forces = [sim.step(1.5e-3 + k * 1e-4, 1e-3).force for k in range(10)]
        assert forces == [answer.force for answer in tried], "bit for bit, whatever the other one did"
        assert twin.model.material.parameters["C10"] == 2500.0 and twin.has_touched
        twin.reset()
        assert sim.has_touched and not twin.has_touched

    def test_simultaneous_calls_are_refused_and_another_thread_may_go_on(self):
        sim, caught, inside, leave = needle(), [], threading.Event(), threading.Event()

        class Pausing(MotionLimits):
            def require_valid_step(self, pose, before, dt):
                inside.set()
                leave.wait(30.0)

        sim.limits = Pausing()
        first = threading.Thread(target=lambda: caught.append(sim.step(1e-3, 1e-3)))
        first.start()
        assert inside.wait(30.0)
        for call in (lambda: sim.step(2e-3, 1e-3), sim.save, sim.reset, sim.clone, lambda: sim.set_parameters(C10=1e3)):
            with pytest.raises(BusyError, match="two threads"):
                call()
        leave.set()
        first.join()
        assert caught[0].status is ts.ForceStatus.CONVERGED
        assert sim.step(1e-3, 1e-3).force == pytest.approx(caught[0].force, rel=1e-9)


class TestAges:
    def test_a_stiffness_that_a_bound_leaves_old_says_so(self):
        bounded, free = (needle(inertia="on", max_solves=most) for most in (3, None))
        ages = []
        for tick in range(1, 201):
            answer, right = bounded.step(tick * 2e-5, 1e-3), free.step(tick * 2e-5, 1e-3)
            ages.append(answer.stiffness_age)
            if answer.stiffness_age == 0.0 and answer.status is ts.ForceStatus.CONVERGED:
                assert answer.stiffness == pytest.approx(right.stiffness, rel=0.05)
        assert min(ages) == 0.0 and max(ages[20:]) <= 0.0115, "renewed in every tenth tick"

    def test_a_late_answer_has_an_old_stiffness(self):
        sim = needle(max_solves=3)
        late = sim.step(4e-3, 1e-2)
        assert late.status is ts.ForceStatus.LATE and late.stiffness_age >= late.age > 0.0

    def test_an_error_that_is_not_known_is_none(self):
        assert needle(resolution="fast").step(1e-3, 1e-3).force_error is None
        known = needle()
        assert known.step(-1e-3, 1e-3).force_error is None, "nothing was learned in the air"
        answer = known.step(1e-3, 1e-3)
        assert answer.force_error == pytest.approx(known.force_error * answer.force) and answer.error_age == 0.0

    def test_an_error_decides_between_converged_and_late(self):
        wrench = (0.0, 0.6, 0.8, 0.0, 0.0, 0.0)
        assert is_force_error_acceptable_or_unknown(wrench, None)
        assert is_force_error_acceptable_or_unknown(wrench, ERROR_SHARE)
        assert not is_force_error_acceptable_or_unknown(wrench, 1.01 * ERROR_SHARE)
        assert is_force_error_acceptable_or_unknown((0.0,) * 6, ERROR_FLOOR)


class TestLightTool:
    @pytest.mark.parametrize("added, stiffness", [(1e-3, 0.0), (0.0, 500.0), (2e-3, 300.0)])
    def test_the_least_mass_is_where_the_coupling_becomes_unstable(self, added, stiffness):
        """The stated smallest mass is the stability limit of the linear recursion in the docstring of the module."""
        dt = 1e-3
        least = minimum_stable_tool_mass(make_axial_stiffness_matrix(stiffness),
                                         make_axial_stiffness_matrix(stiffness + 2.25 * added / dt**2), dt)
        backward = np.convolve([1.5, -2.0, 0.5], [1.5, -2.0, 0.5])

        def growth(mass):
            polynomial = np.array([1.0, -2.0, 1.0, 0.0, 0.0, 0.0])
            polynomial[1:] += added / mass * backward
            polynomial[1] += stiffness * dt**2 / mass
            return max(abs(np.roots(polynomial)))

        assert growth(1.001 * least) < 1.0 + 1e-6 < growth(0.999 * least)

    def test_an_answer_states_it(self):
        sim = needle(inertia="on")
        answers = [sim.step(tick * 5e-5, 1e-3) for tick in range(4)]
        assert answers[0].least_tool_mass < 1e-4, "without the mass of the tissue nearly every tool is stable"
        expected = 1e-6 * (answers[3].stiffness / 4 + 16 / 9 * (answers[3].step_stiffness - answers[3].stiffness))
        assert answers[3].least_tool_mass == pytest.approx(expected) and expected > 1e-3

    @pytest.mark.parametrize(("looks_ahead", "remedy"), [
        (False, "Use looks_ahead=True with an implicit coupling"), (True, "Use a smaller step")])
    def test_a_light_tool_comes_to_rest(self, looks_ahead, remedy):
        """2 g on a servo of 500 N/m, coupled explicitly."""
        sim, mass, rate, dt, depth, speed = needle(
            inertia="auto", looks_ahead=looks_ahead), 0.002, 500.0, 1e-3, -1e-3, 0.0
        damping, felt = 2.0 * math.sqrt(rate * mass), []
        with pytest.warns(LightToolWarning, match=rf"tool lighter than [4-7]\.?\d* g .*{remedy}") as warned:
            for tick in range(400):
                felt.append(sim.step(depth, dt).force)
                aim = min(-1e-3 + 0.05 * tick * dt, 3e-3)
                speed = (mass * speed / dt + rate * (aim - depth) - felt[-1]) / (mass / dt + rate * dt + damping)
                depth += speed * dt
        assert len(warned) == 1
        assert np.ptp(felt[-50:]) < 0.02 * felt[-1]

    def test_a_motion_that_turns_in_every_step_is_not_resolved(self):
        check = ToolReversalDetector()
        for tick in range(20):
            check.register_translation_and_detect_oscillation(0.0, 0.0, 1e-4 * math.cos(2.0 * math.pi * tick / 8), 1e-3,
                                                              True)
        assert math.isinf(check.quiet)
        for tick in range(6):
            check.register_translation_and_detect_oscillation(0.0, 0.0, 1e-4 * (-1) ** tick, 1e-3, True)
        assert check.quiet == 0.0
        check.register_translation_and_detect_oscillation(0.0, 0.0, 1e-6, 0.2, False)
        assert check.quiet == pytest.approx(0.2)
