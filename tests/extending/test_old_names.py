"""Plug-ins and programs may use old names for one release; they get a `DeprecationWarning` that states the new name."""

from importlib import import_module

import pytest

import tissue_sim as ts
from tissue_sim.fem.solver import SOLVERS, ResolutionLevel
from tissue_sim.public_names import OldName, adopt_old_names
from tissue_sim.specimen.cylinder import Cylinder

MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))


def model() -> ts.Model:
    return ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(4e-3, 5)), MATERIAL)


@pytest.fixture
def old_solver(plugin, registers):
    """A solver whose class defines members of the contract by their old names only."""
    spring = plugin("spring_solver")
    with pytest.warns(DeprecationWarning) as caught:
        class OldSpring(spring.SpringSolver):
            poses = 0

            def doubts(self):
                return ["the spring is old"]

            def follow(self, pose):
                type(self).poses += 1
                return pose

            def takes(self, pose):
                return pose.depth <= 2e-3

            def surface(self):
                return spring.SpringSurface()

    assert {str(each.message) for each in caught} == {
        "OldSpring.doubts is renamed to warnings; define warnings",
        "OldSpring.follow is renamed to project_pose; define project_pose",
        "OldSpring.takes is renamed to accepts_pose; define accepts_pose",
        "OldSpring.surface is renamed to deformed_surface; define deformed_surface"}
    registers(SOLVERS, OldSpring, "old_spring")
    return OldSpring


def test_a_solver_with_old_names_is_used(old_solver):
    recording = ts.simulate(model(), solver="old_spring")
    assert recording.metadata["solver"]["warnings"] == ["the spring is old"] and old_solver.poses == 5
    simulator = ts.Simulator(model(), solver="old_spring", inertia="off")
    assert simulator.step(1e-3, 1e-3).status is ts.ForceStatus.CONVERGED
    assert simulator.step(3e-3, 1e-3).status is ts.ForceStatus.STOPPED


def test_old_members_of_a_solver_answer_with_a_warning(old_solver):
    solver = old_solver(model(), resolution="fast")
    with pytest.warns(DeprecationWarning, match=r"Solver\.doubts is renamed to warnings"):
        assert solver.doubts() == solver.warnings()
    with pytest.warns(DeprecationWarning, match=r"Solver\.realtime_rungs is renamed to realtime_levels"):
        assert old_solver.realtime_rungs(model()) == ()
    with pytest.warns(DeprecationWarning, match=r"Solver\.sample is renamed to field_sample"):
        assert solver.sample() == solver.field_sample()
    with pytest.warns(DeprecationWarning, match=r"Solver\.surface is renamed to deformed_surface"):
        assert len(solver.surface().triangles()[0]) == 4
    with pytest.warns(DeprecationWarning, match=r"Solver\.approach is renamed to move_to_next_touch"):
        assert solver.approach(ts.Pose.at_depth(0.0)) is False
    with pytest.warns(DeprecationWarning, match=r"Solver\.meet is renamed to bind_points_on_path"):
        assert solver.meet(ts.Pose.at_depth(1e-3)) is None
    with pytest.warns(DeprecationWarning, match=r"Solver\.unchanged is renamed to equilibria_since_contact_change"):
        assert solver.unchanged == solver.equilibria_since_contact_change
    with pytest.warns(DeprecationWarning, match=r"Solver\.relaxes is renamed to is_time_dependent"):
        assert solver.relaxes == solver.is_time_dependent
    with pytest.warns(DeprecationWarning, match=r"Solver\.creep is renamed to step_with_damping"):
        assert list(solver.creep(ts.Pose.at_depth(0.0))) == []
    with pytest.warns(DeprecationWarning, match=r"Solver\.follow_motion is renamed to enable_inertia"):
        assert solver.follow_motion(1e3) is False
    with pytest.warns(DeprecationWarning, match=r"Solver\.height_above is renamed to height_above_tissue"):
        assert solver.height_above(ts.Pose.at_depth(-1e-3)) == 1e-3


def test_the_old_name_of_the_thickness_answers_with_a_warning():
    with pytest.warns(DeprecationWarning, match="is renamed to vertical_thickness"):
        assert ts.Specimen(0.040, 0.070).depth_at() == 0.070
    with pytest.warns(DeprecationWarning, match="Old.depth_at is renamed to vertical_thickness"):
        class Old(Cylinder):
            def depth_at(self, x=0.0, y=0.0):
                return 0.5 * self.height
    assert Old(0.040, 0.070).vertical_thickness() == 0.035


@pytest.mark.parametrize(("old", "new"), [
    ("Rung", "ResolutionLevel"), ("Comparison", "ErrorEstimate"), ("OwnStiffness", "StaticStiffnessRequest"),
    ("Derivatives", "ForceDerivatives"), ("SpatialDerivatives", "ForceVectorDerivatives")])
def test_old_classes_answer_with_a_warning(old, new):
    module = import_module("tissue_sim.fem.solver")
    with pytest.warns(DeprecationWarning, match=rf"tissue_sim\.fem\.solver\.{old} is renamed to .*\.{new}"):
        assert getattr(module, old) is getattr(module, new)
    unknown = "Rang"
    with pytest.raises(AttributeError, match="has no attribute 'Rang'"):
        getattr(module, unknown)
    assert ResolutionLevel("fast", 0.01).force_error == 0.01


@pytest.mark.parametrize("part", [model(), model().experiment])
def test_old_properties_answer_with_a_warning(part):
    with pytest.warns(DeprecationWarning, match="depends_on_way is renamed to is_path_dependent"):
        assert part.depends_on_way == part.is_path_dependent


def test_the_new_name_wins_over_the_old_one():
    class Base:
        old = OldName("new")

    class Both(Base):
        def old(self):
            return "old"

        def new(self):
            return "new"

    adopt_old_names(Both, {"old": "new"})
    assert Both().new() == "new"
    with pytest.warns(DeprecationWarning, match=r"Base\.old is renamed to new"):
        assert Both().old() == "new"


@pytest.mark.parametrize(("old", "new"), [("Wishes", "ImportOptions"), ("Stated", "ColumnHints"),
                                          ("Imported", "ImportResult"), ("read_measured", "read_measured_curves")])
def test_old_names_of_calibration_give_the_new_members_and_warn(old, new):
    calibration = import_module("calibration")
    with pytest.warns(DeprecationWarning, match=rf"^calibration\.{old} is renamed to calibration\.{new}$"):
        assert getattr(calibration, old) is getattr(calibration, new)


@pytest.mark.parametrize(("module", "owner", "old", "new"), [
    ("calibration.importing.imported", "ImportResult", "complete", "is_complete"),
    ("calibration.effects.situation", "Situation", "curves", "fitted_curves"),
    ("tissue_sim", "Experiment", "with_free_faces", "with_slipping_faces_frictionless"),
    ("tissue_sim", "Experiment", "base_interface", "resolved_base_interface"),
    ("tissue_sim", "Material", "instantaneous_factor", "instantaneous_over_law_modulus_ratio"),
    ("tissue_sim", "Material", "reduced_effects", "list_acting_reduced_effects"),
    ("tissue_sim", "Prony", "instantaneous_factor", "instantaneous_over_law_modulus_ratio"),
    ("tissue_sim", "MeshSpecimen", "mesh_of_file", "loaded_file_mesh"),
    ("calibration.effects.situation", "Situation", "require_new", "require_unused_parameter"),
    ("calibration.effects.situation", "Situation", "step_and_duration", "sampling_interval_and_duration")])
def test_old_members_of_a_class_give_the_new_members_and_warn(module, owner, old, new):
    kind = getattr(import_module(module), owner)
    with pytest.warns(DeprecationWarning, match=rf"^{owner}\.{old} is renamed to {new}$"):
        assert getattr(kind, old) is getattr(kind, new)


@pytest.mark.parametrize("module", ["calibration.effects.effect", "calibration.effects.situation"])
def test_the_old_name_of_the_experiment_of_a_test_warns(module):
    effects = import_module(module)
    with pytest.warns(DeprecationWarning, match="experiment_of is renamed to .*get_experiment"):
        assert effects.experiment_of is effects.get_experiment


@pytest.mark.parametrize(("module", "name", "new"), [
    ("tissue_sim.simulator", "Simulator", "tissue_sim.realtime.simulator"),
    ("tissue_sim.simulator", "SimulatorState", "tissue_sim.realtime.simulator"),
    ("haptics.loop.local_model", "LocalModelBlend", "tissue_sim.realtime.local_model")])
def test_moved_classes_are_found_at_their_old_path(module, name, new):
    with pytest.warns(DeprecationWarning, match=rf"^{module}\.{name} is renamed to {new}\.{name}$"):
        assert getattr(import_module(module), name) is getattr(import_module(new), name)


def test_a_multirate_tissue_has_a_process_for_its_bulk_unless_a_link_is_given():
    from haptics.loop.multirate import MultiRateTissue
    from tissue_sim.realtime import multirate

    assert issubclass(MultiRateTissue, multirate.MultiRateTissue)
    with pytest.raises(TypeError, match="link"):
        multirate.MultiRateTissue(model())
