"""Reduced solids that weigh: they stand where the whole one has settled."""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.fem.reduced.elements import SampledElements
from tissue_sim.fem.reduced.model import SelfWeightEquilibriumFields
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.reduced.training import build_training_mesh
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.tissue import find_element_layer_indices
from tissue_sim.fem.solver import StepStatus
from tissue_sim.material.file import MaterialFile, write_material_file
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.pose import Pose

pytestmark = pytest.mark.slow

SOFT = ts.Material("neo_hooke", {"C10": 200.0}, ts.Bulk("bulk_ratio", 1e3))
CREEPING = replace(SOFT, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 0.5),), "long_term"))
BOX = ts.PoseBox(1e-3, 2e-3)


def model(material=SOFT, gravity=9.81, height_is="moulded", friction="bonded", tool="flat") -> ts.Model:
    specimen = ts.Specimen(0.025, 0.02, density=1040.0, gravity=gravity, height_is=height_is)
    return ts.Model(ts.KINDS["needle_indentation"].experiment(
        specimen=specimen, protocol=ts.Protocol.ramp(BOX.depth, points=2), tool=ts.Tool(tool, radius=6e-3),
        friction=friction), material)


def way(count: int) -> list[Pose]:
    shares = np.linspace(0.0, 1.0, count)
    aside = BOX.sideways * np.stack([np.sin(4.0 * shares), np.sin(2.3 * shares)], axis=-1)
    return [Pose((x, y, -z)) for (x, y), z in zip(aside.tolist(), (BOX.depth * np.sin(3.1 * shares)).tolist(),
                                                  strict=True)]


def forces(solver, poses, dt=0.1) -> np.ndarray:
    found = []
    for pose in poses:
        step = solver.step(pose, dt, max_iterations=40)
        assert step.status is StepStatus.CONVERGED
        found.append(step.wrench[:3])
    return np.array(found)


def off(found, expected) -> float:
    return float(np.sqrt(((found - expected) ** 2).sum() / (expected**2).sum()))


@pytest.fixture(scope="module")
def heavy(coarse):
    return ts.reduce_solid(model(CREEPING), BOX, resolution=coarse, strokes=6, modes=16, tried=1)


@pytest.mark.parametrize("element", [HEX8P0, HEX27P1], ids=lambda element: element.name)
@pytest.mark.parametrize("bulk_ratio", [1e3, 50.0], ids=["own bulk", "softer bulk"])
def test_elements_are_in_equilibrium_with_the_weight_where_it_stands(element, bulk_ratio):
    """All of them, with the tissue's own bulk modulus: forces on motions that spare the base are those of the whole
    solid, its weight among them. With a softer one the pressures that bear the weight stay what they are."""
    of, rng = model(), np.random.default_rng(0)
    mesh = create_cylinder_mesh_under_needle(0.025, 0.02, 6e-3, element, smallest=4e-3, growth=2.5, largest=15e-3,
                                             around=2)
    solver = make_solver(of, mesh=mesh)
    standing = solver.field_sample()
    basis = rng.normal(size=(*mesh.nodes.shape, 5)) * 1e-4
    basis[np.concatenate([mesh.sets["base"], mesh.sets["face"]])] = 0.0
    basis = basis.reshape(-1, 5)
    count = len(mesh.connectivity)
    found = SampledElements(mesh, basis, np.arange(count), np.ones(count), layers=find_element_layer_indices(mesh, ()),
                            rest=SelfWeightEquilibriumFields(standing.displacement.ravel(), standing.pressures))
    found.set_material(of.material, bulk_ratio)
    found.initialise_rest_state()
    found.evaluate_forces_and_stiffness(np.zeros(5), False, 1)
    assert np.abs(found.modal_forces).max() == 0.0
    amplitudes = rng.normal(size=5)
    found.evaluate_forces_and_stiffness(amplitudes, True, 1)
    found.evaluate_forces_and_stiffness(amplitudes, True, 1)  # the pressures are those of these volumes
    rest = solver.x.copy()
    weight = basis.T @ (solver.tissue.specific_weight * np.repeat(solver.batches.volumes, 3) * np.tile(
        [0.0, 0.0, 1.0], len(mesh.nodes)))
    stiff = solver.tissue.compute_element_forces_limiting_bulk(bulk_ratio, solver.batches.pressures.copy())
    solver.x[:] = rest + basis @ amplitudes
    expected = solver.tissue.compute_element_forces_limiting_bulk(
        bulk_ratio, solver.batches.arrange_in_lanes(standing.pressures))
    rows = basis.reshape(-1, 3, 5)[mesh.connectivity].reshape(count, -1, 5)
    on_modes = np.einsum("ei,eir->r", expected, rows)
    largest = np.abs(found.modal_forces).max()
    np.testing.assert_allclose(found.modal_forces, on_modes + weight, rtol=0, atol=1e-7 * largest)
    assert np.abs(np.einsum("ei,eir->r", stiff, rows) + weight).max() < 1e-7 * largest


def test_it_does_what_the_whole_one_does(heavy, coarse):
    """Soft tissue that sinks in by 1.5 mm, and creeps; its weight changes the forces by several percent."""
    mesh, poses = build_training_mesh(model(), BOX, coarse), way(16)
    expected, light = (forces(make_solver(model(CREEPING, gravity), mesh=mesh), poses) for gravity in (9.81, 0.0))
    solver = ReducedSolver(heavy, heavy.model.material)
    found = forces(solver, poses)
    assert off(light, expected) > 0.05
    assert off(found, expected) < 0.01 and heavy.report["force_rms_error"] < 0.01
    assert np.abs(found[0]).max() < 1e-9
    # The solid was not touched again.
    solver.reset_to_rest()
    np.testing.assert_allclose(forces(solver, poses), found, rtol=0, atol=1e-3 * np.abs(found).max())


def test_layers_lie_where_they_are_stated_in_a_specimen_as_placed():
    """It was moulded a tenth higher, and its elements reach deeper there."""
    of = model(replace(SOFT, layers=(ts.Layer(10e-3, 0.4),)), height_is="placed")
    reduced = ts.reduce_solid(of, BOX, strokes=4, modes=16, tried=1)
    assert np.ptp(reduced.mesh.nodes[:, 2]) > 1.05 * of.experiment.specimen.height
    mesh = build_training_mesh(of, BOX, "realtime")
    np.testing.assert_array_equal(reduced.element_layers, find_element_layer_indices(mesh, of.material.layers))
    poses = way(12)
    assert off(forces(ReducedSolver(reduced, of.material), poses), forces(make_solver(of, mesh=mesh), poses)) < 0.02


def test_a_height_as_placed_and_a_tool_that_slides(tmp_path):
    of = model(height_is="placed", friction=0.3, tool="round")
    reduced = ts.reduce_solid(of, ts.PoseBox(0.0, 2e-3), strokes=4, modes=16, tried=1)
    moulded, stands = np.ptp(reduced.mesh.nodes[:, 2]), of.experiment.specimen.height
    assert moulded - reduced.sag == pytest.approx(stands, rel=1e-9) and reduced.sag > 0.02 * stands
    # To the full depth of the box: a ring of nodes is touched at 1.9 mm.
    poses = [Pose.at_depth(depth) for depth in (*np.linspace(0.1e-3, 2e-3, 20), *np.linspace(1.9e-3, 0.1e-3, 19))]
    mesh = build_training_mesh(of, ts.PoseBox(0.0, 2e-3), "realtime")
    found = forces(ReducedSolver(reduced, of.material), poses)
    assert off(found, forces(make_solver(of, mesh=mesh), poses)) < 0.03
    assert (found[:, 2] >= 0.0).all() and found[19, 2] > 0.0


def test_its_file_says_how_it_stands(heavy, coarse, tmp_path):
    path = tmp_path / "heavy.reduced.npz"
    ts.write_reduced(heavy, path)
    again = ts.load_reduced(path)
    assert again.model.experiment.specimen == heavy.model.experiment.specimen
    assert again.model.material == heavy.model.material
    poses = way(16)
    np.testing.assert_array_equal(forces(ReducedSolver(again, again.model.material), poses),
                                  forces(ReducedSolver(heavy, heavy.model.material), poses))
    recording = ts.simulate(again.model, solver="reduced", mesh=again)
    sag = make_solver(again.model, resolution=coarse).sag
    assert recording.metadata["solver"]["self_weight"]["sag_mm"] == pytest.approx(1e3 * sag, rel=1e-6)


@pytest.mark.parametrize("lost", ["rest pressures", "rest displacement"])
def test_a_file_without_it_is_refused(heavy, tmp_path, lost):
    path = tmp_path / "heavy.reduced.npz"
    ts.write_reduced(heavy, path)
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files if name != lost}
    np.savez(path, **arrays)
    with pytest.raises(ts.InputError, match="must contain arrays whose shapes, types and values agree with each other"):
        ts.load_reduced(path)


def test_it_keeps_its_material(heavy, tmp_path, capsys):
    """Another one would let it stand elsewhere."""
    simulator = ts.Simulator(heavy.model, solver="reduced", mesh=heavy)
    simulator.warm_up()
    heavy.require_supported_material(replace(CREEPING, name="of another file", density=900.0))
    with pytest.raises(ts.InputError, match="must equal the material of the training"):
        simulator.set_parameters(C10=300.0)
    answer = simulator.step(Pose.at_depth(0.5e-3), 1e-3)
    assert answer.status is ts.ForceStatus.CONVERGED and answer.force > 0.0
    with pytest.raises(ts.InputError, match="must be empty for a solid with self-weight"):
        ts.reduce_solid(model(), BOX, also=[CREEPING], strokes=6)
    ts.write_reduced(heavy, tmp_path / "heavy.reduced.npz")
    other = replace(CREEPING, parameters={"C10": 300.0})
    write_material_file(MaterialFile.of(other), tmp_path / "other.material.json")
    assert main(["loop", "--reduced", str(tmp_path / "heavy.reduced.npz"), "--seconds", "0.2", "--material",
                 str(tmp_path / "other.material.json")]) == 2
    assert "must equal the material of the training" in capsys.readouterr().err
