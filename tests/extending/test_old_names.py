"""Plug-ins and programs may use old names for one release; they get a `DeprecationWarning` that states the new name."""

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import ClassVar

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.solver import SOLVERS, ResolutionLevel
from tissue_sim.public_names import OldName, rename_old_members_of_subclass
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
                return plugin("plain_spring").Square()

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
    with pytest.warns(DeprecationWarning, match=r"Solver\.creep is renamed to iterate_steps_with_damping"):
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
    ("Rung", "ResolutionLevel"), ("Comparison", "ErrorEstimationRule"), ("OwnStiffness", "StaticStiffnessRequest"),
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

    rename_old_members_of_subclass(Both, {"old": "new"})
    assert Both().new() == "new"
    with pytest.warns(DeprecationWarning, match=r"Base\.old is renamed to new"):
        assert Both().old() == "new"


@pytest.mark.parametrize(("old", "new"), [("Wishes", "ImportOptions"), ("Stated", "InterpretationOverrides"),
                                          ("Imported", "ImportResult"), ("read_measured", "read_measured_curves"),
                                          ("ColumnHints", "InterpretationOverrides"), ("to_json", "to_json_dictionary"),
                                          ("design_experiments", "evaluate_planned_experiments")])
def test_old_names_of_calibration_give_the_new_members_and_warn(old, new):
    calibration = import_module("calibration")
    with pytest.warns(DeprecationWarning, match=rf"^calibration\.{old} is renamed to calibration\.{new}$"):
        assert getattr(calibration, old) is getattr(calibration, new)


@pytest.mark.parametrize(("module", "owner", "old", "new"), [
    ("calibration.importing.imported", "ImportResult", "complete", "is_complete"),
    ("calibration.effects.effect", "DiagnosisData", "curves", "list_recordings"),
    ("tissue_sim", "Experiment", "with_free_faces", "with_slipping_faces_frictionless"),
    ("tissue_sim", "Experiment", "base_interface", "resolved_base_interface"),
    ("tissue_sim", "Material", "instantaneous_factor", "instantaneous_over_law_modulus_ratio"),
    ("tissue_sim", "Material", "reduced_effects", "list_acting_force_scaling_effects"),
    ("tissue_sim", "Prony", "instantaneous_factor", "instantaneous_over_law_modulus_ratio"),
    ("tissue_sim", "MeshSpecimen", "mesh_of_file", "loaded_file_mesh"),
    ("calibration.effects.effect", "DiagnosisData", "require_new", "require_unused_parameter"),
    ("calibration.effects.effect", "DiagnosisData", "step_and_duration", "sampling_interval_and_duration"),
    ("calibration.effects.effect", "DiagnosisData", "fitted_curves", "list_recordings"),
    ("calibration.effects.effect", "DiagnosisData", "relaxation_times", "list_resolvable_relaxation_times"),
    ("tissue_sim", "Experiment", "resistance", "compute_force_against_motion"),
    ("tissue_sim", "Experiment", "homogeneous", "has_homogeneous_deformation"),
    ("tissue_sim", "TestKind", "can_pull", "allows_reversed_load"),
    ("tissue_sim", "Tool", "sharp_edge", "has_sharp_edge"),
    ("tissue_sim", "Specimen", "digest", "digest_of_files"),
    ("tissue_sim", "Specimen", "stated", "values_by_file_key"),
    ("tissue_sim", "Rig", "apply", "apply_motion_effects"),
    ("tissue_sim", "Rig", "tool_motion", "compute_unloaded_tool_displacement"),
    ("tissue_sim", "Rig", "motion_only", "with_motion_effects_only"),
    ("tissue_sim", "Rig", "reading_only", "with_reading_effects_only"),
    ("tissue_sim", "Rig", "without_noise", "without_sampling_effects"),
    ("tissue_sim", "Material", "ages", "is_time_dependent"),
    ("tissue_sim", "Material", "remembers", "is_history_dependent"),
    ("tissue_sim", "Material", "relaxation", "make_prony_series"),
    ("tissue_sim", "Material", "list_acting_reduced_effects", "list_acting_force_scaling_effects"),
    ("tissue_sim", "MaterialFile", "covariance_SI", "paths_and_covariance_SI"),
    ("tissue_sim", "Prony", "modulus", "compute_relative_relaxation_modulus"),
    ("tissue_sim", "Poroelasticity", "term", "make_prony_term"),
    ("tissue_sim", "Contact", "get_motion_and_force_from_contact", "subtract_contact_zero_and_drift"),
    ("tissue_sim", "Pose", "rotation", "rotation_matrix"),
    ("tissue_sim", "Simulator", "solve_time", "linear_solve_time"),
    ("tissue_sim", "Snapshot", "at", "with_pose_and_arrays"),
    ("tissue_sim", "ReducedModel", "require_material", "require_supported_material"),
    ("tissue_sim.laws.law", "Law", "nominal_stress_derivatives", "nominal_stress_parameter_derivatives"),
    ("tissue_sim.laws.law", "Law", "as_array", "convert_parameters_to_array"),
    ("tissue_sim.laws.law", "Law", "as_mapping", "convert_parameters_to_mapping"),
    ("tissue_sim.laws.stability", "StabilityRange", "stable", "is_stable_in_whole_range"),
    ("tissue_sim.fem.solver", "Solver", "error_estimate", "error_estimation_rule"),
    ("tissue_sim.fem.solver", "Solver", "lift_off", "reset_to_first_touch"),
    ("tissue_sim.fem.solver", "Solver", "ask_for_stiffness", "enable_stiffness_output"),
    ("tissue_sim.fem.solver", "Solver", "differentiate", "enable_force_derivatives"),
    ("tissue_sim.fem.solver", "Solver", "report", "get_recording_metadata"),
    ("tissue_sim.fem.solver", "Solver", "step_with_damping", "iterate_steps_with_damping"),
    ("haptics.safety.limits", "ForceLimiter", "message", "active_limits_description"),
    ("haptics.safety.passivity", "PassivityObserver", "compute_work_by_hand", "compute_hand_work"),
    ("haptics.safety.passivity", "PassivityObserver", "is_active", "is_port_active"),
    ("haptics.safety.rendering", "ForceRendering", "pose_for", "advance_proxy"),
    ("haptics.safety.rendering", "RenderedForce", "is_active", "is_port_active"),
    ("haptics.safety.rendering", "RenderedForce", "lost_pose", "is_faded_by_watchdog"),
    ("haptics.safety.rendering", "RenderedForce", "out_of_energy", "has_exceeded_energy_limit"),
    ("haptics.loop.process", "LoopProcess", "poll", "read_message_and_check_ready"),
    ("haptics.loop.process", "LoopProcess", "ring", "open_ring_reader"),
    ("haptics.loop.process", "LoopProcess", "snapshots", "open_snapshot_reader"),
    ("haptics.loop.ring", "RingReader", "since", "read_ticks_after"),
    ("haptics.loop.shared_slots", "SlotReader", "written", "written_count")])
def test_old_members_of_a_class_give_the_new_members_and_warn(module, owner, old, new):
    kind = getattr(import_module(module), owner)
    with pytest.warns(DeprecationWarning, match=rf"^{owner}\.{old} is renamed to {new}$"):
        assert getattr(kind, old) == getattr(kind, new)


def test_the_old_name_of_the_experiment_of_a_test_warns():
    effects = import_module("calibration.effects.effect")
    with pytest.warns(DeprecationWarning, match="experiment_of is renamed to .*get_experiment"):
        assert effects.experiment_of is effects.get_experiment


@pytest.mark.parametrize("owner", ["tissue_sim.fem.solver.Step", "tissue_sim.tool_force.ToolForce"])
def test_the_old_constructor_of_an_axial_force_warns(owner):
    module, _, name = owner.rpartition(".")
    kind = getattr(import_module(module), name)
    with pytest.warns(DeprecationWarning, match=rf"^{name}\.axial is renamed to from_axial_force$"):
        assert kind.axial == kind.from_axial_force


@pytest.mark.parametrize(("module", "old", "new"), [
    ("tissue_sim", "register", "register_law"), ("tissue_sim", "check_stability", "find_stability_range"),
    ("tissue_sim", "ReducedEffect", "ForceScalingEffect"), ("tissue_sim.laws", "register", "register_law"),
    ("tissue_sim.pose", "between", "interpolate_pose"), ("tissue_sim.pose", "motion", "compute_rigid_motion"),
    ("tissue_sim.fem.solver", "ErrorEstimate", "ErrorEstimationRule"),
    ("calibration.effects.effect", "Situation", "DiagnosisData"),
    ("calibration.effects.candidates", "rig_parameter_candidates", "make_experiment_or_rig_candidates"),
    ("haptics", "open_sensor", "make_sensor"), ("haptics", "open_stage", "make_stage"),
    ("haptics", "open_motion", "make_motion"), ("haptics", "open_haptic", "make_haptic_device"),
    ("haptics", "HandMotion", "TargetFollowingMotion"), ("haptics", "ForceLimits", "ForceLimiter"),
    ("haptics.devices.settings", "read_settings", "parse_number_settings"),
    ("haptics.emulators.emulator", "TerminalEmulator", "SerialDeviceEmulator"),
    ("haptics.safety.limits", "ForceRelease", "tissue_sim.realtime.force_fading:ForceFader"),
    ("haptics.safety.limits", "ForceFader", "tissue_sim.realtime.force_fading:ForceFader"),
    ("haptics.safety.limits", "Watchdog", "tissue_sim.realtime.force_fading:Watchdog"),
    ("haptics.recorder.plan", "IndentationPlan", "BenchTestPlan"),
    ("haptics.emulators.haply", "emulate_haply", "make_haply_emulator"),
    ("haptics.server.steps", "SceneLimits", "ServerLimits"),
    ("tissue_sim.mesh", "graded_line", "divide_into_graded_intervals"),
    ("tissue_sim.mesh", "growing_line", "divide_into_growing_intervals"),
    ("tissue_sim.mesh", "needle_mesh", "cylinder_mesh_refined_under_needle"),
    ("tissue_sim.mesh", "with_lines", "insert_interfaces_and_refine_layers"),
    ("tissue_sim.mesh.solid", "block_under_tool", "create_block_mesh_under_tool"),
    ("tissue_sim.fem.solver", "FreeTool", "ToolInAirInterface")])
def test_old_names_of_a_module_give_the_new_members_and_warn(module, old, new):
    home, _, name = new.rpartition(":")
    home = home or module
    with pytest.warns(DeprecationWarning, match=rf"{module}\.{old} is renamed to {home}\.{name}$"):
        assert getattr(import_module(module), old) is getattr(import_module(home), name)


def test_an_effect_that_defines_old_names_is_used_by_the_new_ones():
    with pytest.warns(DeprecationWarning) as caught:
        @dataclass(frozen=True)
        class Halved(ts.ForceScalingEffect):
            name: ClassVar[str] = "halved"
            ages: ClassVar[bool] = True

            def share(self, history):
                return 0.5

    assert {str(each.message) for each in caught} == {
        "Halved.ages is renamed to is_time_dependent; define is_time_dependent",
        "Halved.share is renamed to compute_force_factor; define compute_force_factor"}
    history = ts.ToolHistory(1e-3, 1e-3)
    assert Halved().is_time_dependent and Halved().compute_force_factor(history) == 0.5
    with pytest.warns(DeprecationWarning, match=r"ForceScalingEffect\.share is renamed to compute_force_factor"):
        assert Halved().share(history) == 0.5


def test_an_overriding_method_with_an_old_name_reaches_the_base_class():
    """``super().old()`` gives the member of the base class, not the method itself again."""
    with pytest.warns(DeprecationWarning):
        class Half(type(ts.find_law("ogden_1"))):
            def as_array(self, values):
                return 0.5 * super().as_array(values)

        class Digested(Cylinder):
            @property
            def digest(self):
                return "own " + super().digest

    with pytest.warns(DeprecationWarning, match=r"Law\.as_array is renamed"):
        array = Half(1).convert_parameters_to_array([1000.0, 2.0])
    np.testing.assert_array_equal(array, [500.0, 1.0])
    with pytest.warns(DeprecationWarning, match=r"Specimen\.digest is renamed"):
        assert Digested(0.04, 0.07).digest_of_files == "own "


def test_renamed_annotations_keep_their_order_and_other_classes_keep_their_names():
    class Base:
        new = OldName("newer")

    class Record(Base):
        first: int
        old: int
        last: int = 2

    with pytest.warns(DeprecationWarning, match=r"Record\.old is renamed to new; define new"):
        rename_old_members_of_subclass(Record, {"old": "new"})
    assert list(Record.__annotations__) == ["first", "new", "last"]

    class Loss(ts.PointEffect):
        name = "loss"

        def share(self):
            return 0.25

    assert Loss.share(None) == 0.25


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


@pytest.mark.parametrize(("module", "member"), [
    ("calibration.diagnosis.decision_limits", "DecisionLimits"),
    ("calibration.diagnosis.refit_settings", "RefitSettings"), ("calibration.diagnosis.result", "DiagnosisResult"),
    ("calibration.effects.backlash", "Backlash"), ("calibration.effects.catalogue", "Effect"),
    ("calibration.effects.situation", "DiagnosisData"), ("calibration.effects.situation", "Situation"),
    ("calibration.fit.hold", "HoldFit"), ("calibration.fit.usability_settings", "UsabilitySettings"),
    ("calibration.report.units", "ReportUnits"), ("calibration.tasks.errors", "WorkerError"),
    ("haptics.emulators.terminal", "SerialDeviceEmulator"), ("haptics.loop.real_time", "RealTimeFeature"),
    ("haptics.loop.snapshot_board", "SnapshotWriter"), ("haptics.loop.tissue_factory", "make_real_time_tissue_factory"),
    ("haptics.safety.force_release", "ForceRelease"), ("haptics.safety.watchdog", "Watchdog"),
    ("haptics.server.scene_limits", "SceneLimits"), ("scenes.viewer.wedge", "Wedge"),
    ("scenes.commands.shared.text_table", "print_sentence"), ("tissue_sim.experiment.kinds.gripped", "TestKind"),
    ("tissue_sim.experiment.tools.flat", "Flat"), ("tissue_sim.laws.neo_hooke", "NeoHooke"),
    ("tissue_sim.material.puncture", "Puncture"), ("tissue_sim.rig.inertia", "Inertia"),
    ("tissue_sim.atomic_write", "write_text"), ("tissue_sim.experiment.approach", "Approach"),
    ("tissue_sim.experiment.tools.sizes", "edge_radius"),
    ("tissue_sim.fem.free_tool", "FreeTool"), ("tissue_sim.force_error", "RelativeForceErrorEstimate"),
    ("tissue_sim.kernel_owner", "CopyError"), ("tissue_sim.material.layer", "Layer"),
    ("tissue_sim.mesh.block", "create_block_mesh_under_plate"),
    ("tissue_sim.mesh.element_conversion", "number_nodes_by_shared_corners"),
    ("tissue_sim.mesh.hexahedra", "Hexahedron"), ("tissue_sim.motion_limits", "LimitError"),
    ("tissue_sim.packing", "pack_task"), ("tissue_sim.realtime.bulk_link", "BulkLink"),
    ("tissue_sim.realtime.path_settings", "PathSettings"), ("tissue_sim.simulator", "Simulator")])
def test_a_moved_module_is_imported_by_its_old_name_with_a_warning(module, member):
    moved = import_module(module)
    with pytest.warns(DeprecationWarning, match=rf"{module}\.{member} is renamed to"):
        assert callable(getattr(moved, member))


def test_all_moved_modules_exist():
    for package in ("calibration", "haptics", "scenes", "tissue_sim"):
        for old, new in import_module(package)._MOVED.items():
            assert import_module(new) and find_spec(old) is not None
