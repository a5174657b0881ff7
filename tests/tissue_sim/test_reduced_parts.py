"""Reduced solids of several parts: layers, regions, meshes and profiles from files."""

from dataclasses import replace

import numpy as np
import pytest
from solid_meshes import block, write_hexahedra, write_tetrahedra

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.fem.reduced import training
from tissue_sim.fem.reduced.elements import SampledElements
from tissue_sim.fem.reduced.reduction import verify_and_get_report_and_factors
from tissue_sim.fem.reduced.settings import VERIFICATION
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.reduced.symmetry import find_symmetries
from tissue_sim.fem.reduced.training import make_training_path
from tissue_sim.fem.solid.tissue import Tissue, find_element_layer_indices
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid_element import HEX8P0, TET8P0

SOFT = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e3))
STIFF = ts.Material("neo_hooke", {"C10": 6000.0}, ts.Bulk("bulk_ratio", 500.0))
SKIN = ts.Layer(2e-3, 4.0)
DEPTH = 2e-3


def experiment(specimen: ts.Specimen, tool: ts.Tool | None = None, **faces) -> ts.Experiment:
    """Return an experiment with a needle."""
    return ts.KINDS["needle_indentation"].experiment(
        specimen=specimen, protocol=ts.Protocol.ramp(DEPTH, points=2), tool=tool or ts.Tool("flat", radius=6e-3),
        **faces)


@pytest.fixture(scope="module")
def liver(tmp_path_factory):
    """A block of 40 x 30 x 20 mm in two regions, tetrahedra of four nodes; the file is gone when it has been read."""
    path = tmp_path_factory.mktemp("mesh") / "liver.vtu"
    write_tetrahedra(path, np.linspace(5.0, 45.0, 6), np.linspace(-3.0, 27.0, 5), np.linspace(80.0, 100.0, 3), 90.0)
    return path


@pytest.fixture(scope="module")
def organ(liver, tmp_path_factory):
    """A needle that holds the liver, whose lower half is stiffer: as it was made, and as its file says without the
    mesh's."""
    model = ts.Model(experiment(ts.Specimen(shape="mesh", mesh_file=liver), friction="bonded"),
                     replace(SOFT, regions={"part:1": STIFF}))
    made = ts.reduce_solid(model, ts.PoseBox(1e-3, DEPTH), strokes=8, modes=16, tried=1)
    path = tmp_path_factory.mktemp("reduced") / "liver.reduced.npz"
    ts.write_reduced(made, path)
    liver.rename(liver.with_name("elsewhere.vtu"))
    yield made, ts.load_reduced(path)
    liver.with_name("elsewhere.vtu").rename(liver)


@pytest.fixture(scope="module")
def skinned(coarse):
    """A needle that holds a cylinder with a skin."""
    model = ts.Model(experiment(ts.Specimen(0.025, 0.015), friction="bonded"), replace(SOFT, layers=(SKIN,)))
    return ts.reduce_solid(model, ts.PoseBox(1e-3, DEPTH), resolution=coarse, strokes=4, modes=16, tried=1)


def whole_forces(reduced, material, poses) -> np.ndarray:
    """Return the forces of the whole solid, N, shape (poses, 3)."""
    solver = training.make_full_order_solver(ts.Model(reduced.model.experiment, material), reduced.mesh)
    return training.simulate_snapshots(solver, poses).wrenches[:, :3]


def reduced_forces(reduced, material, poses) -> np.ndarray:
    solver, forces = ReducedSolver(reduced, material), []
    for pose in poses:
        step = solver.step(pose)
        assert step.status is StepStatus.CONVERGED
        forces.append(step.wrench[:3])
    return np.array(forces)


def off(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.sqrt(((found - expected) ** 2).sum() / (expected**2).sum()))


POSES = [ts.Pose((0.12e-3 * k, -0.05e-3 * k, -0.25e-3 * k)) for k in range(1, 9)]


class TestElements:
    @pytest.mark.slow
    @pytest.mark.parametrize("element", [HEX8P0, TET8P0], ids=lambda element: element.name)
    def test_forces_and_stiffness_are_those_of_the_whole_tissue(self, element):
        """Every element once, in two layers and two regions of other laws, on motions of the nodes."""
        mesh = block(np.linspace(0.0, 0.02, 4), np.linspace(0.0, 0.02, 4), np.linspace(-0.02, 0.0, 5), element)
        middle = mesh.nodes[mesh.connectivity].mean(axis=1)
        mesh = replace(mesh, regions={"lump": np.flatnonzero(middle[:, 0] > 0.012),
                                      "rest": np.flatnonzero(middle[:, 0] < 0.005)})
        material = replace(SOFT, layers=(ts.Layer(5e-3, 3.0), ts.Layer(5e-3, 0.5)), regions={"lump": STIFF})
        layers = find_element_layer_indices(mesh, material.layers)
        rng, count = np.random.default_rng(3), len(mesh.connectivity)
        basis = rng.normal(size=(mesh.nodes.size, 6))
        x = np.zeros(mesh.nodes.size)
        tissue = Tissue(mesh, x, 5e-3, layers)
        tissue.set_material(material)
        x[:] = basis @ (amplitudes := rng.normal(size=6) * 2e-5)
        tissue.assemble_and_get_least_volume_ratio()
        sampled = SampledElements(mesh, basis, np.arange(count), np.ones(count), layers=layers, groups=8)
        sampled.set_material(material, 1e9)
        sampled.evaluate_forces_and_stiffness(amplitudes, False, 1)
        np.testing.assert_allclose(sampled.modal_forces, basis.T @ tissue.batches.residual[:-1], rtol=1e-9)
        stiffness = basis.T @ (tissue.batches.matrix @ basis)
        np.testing.assert_allclose(sampled.modal_stiffness, stiffness, rtol=1e-5, atol=1e-6 * np.abs(stiffness).max())

    def test_each_material_has_its_own_limit_of_the_bulk(self):
        """At rest the bulk modulus of each region is limited to a multiple of its mu0, and pressures follow from it."""
        mesh = block(np.linspace(0.0, 0.02, 3), np.linspace(0.0, 0.02, 3), np.linspace(-0.02, 0.0, 3), HEX8P0)
        mesh = replace(mesh, regions={"lump": np.arange(4)})
        stretch = np.zeros((mesh.nodes.size, 1))
        stretch[2::3, 0] = mesh.nodes[:, 2]
        none = np.zeros(8, dtype=np.intp)

        def stiffness(ratio, *elements):
            chosen = np.array(elements)
            sampled = SampledElements(mesh, stretch, chosen, np.ones(chosen.size), layers=none)
            sampled.set_material(replace(SOFT, regions={"lump": STIFF}), ratio)
            sampled.evaluate_forces_and_stiffness(np.zeros(1), False, 1)
            return float(sampled.modal_stiffness[0, 0]) / chosen.size

        volume = 1e-6
        for number, mu in ((0, STIFF.mu0), (7, SOFT.mu0)):
            for ratio in (20.0, 100.0):
                assert stiffness(ratio, number) == pytest.approx((ratio + 4.0 / 3.0) * mu * volume, rel=1e-5)
        assert stiffness(1e9, 0) == pytest.approx((500.0 + 4.0 / 3.0) * STIFF.mu0 * volume, rel=1e-5)


@pytest.mark.slow
class TestLayers:
    def test_on_unseen_strokes(self, skinned):
        assert skinned.report["force_rms_error"] < 0.01 and skinned.report["not_converged"] == 0.0

    def test_a_skin_of_another_stiffness(self, skinned):
        """The moduli are those of now: softer and stiffer by half than the one that it was made of, and none."""
        materials = [replace(SOFT, layers=(replace(SKIN, ratio=ratio),)) for ratio in (3.0, 6.0)]
        expected = [whole_forces(skinned, material, POSES) for material in materials]
        for material, forces in zip(materials, expected, strict=True):
            assert off(reduced_forces(skinned, material, POSES), forces) < 0.02
        assert off(*expected) > 0.1
        none, one = SOFT, replace(SOFT, layers=(replace(SKIN, ratio=1.0),))
        np.testing.assert_allclose(reduced_forces(skinned, none, POSES), reduced_forces(skinned, one, POSES), rtol=1e-9,
                                   atol=1e-12)

    def test_made_for_several_materials(self, skinned, coarse, tmp_path):
        """Half and twice the stiffness of the skin among those that it is made for: good for what is between, too."""
        also = [replace(SOFT, layers=(replace(SKIN, ratio=ratio),)) for ratio in (2.0, 8.0)]
        made = ts.reduce_solid(skinned.model, skinned.box, resolution=coarse, strokes=9, modes=20, tried=1, also=also,
                               folder=tmp_path)
        assert made.report["materials"] == 3 and made.report["force_rms_error"] < 0.01
        for ratio in (2.0, 5.0, 8.0):
            material = replace(SOFT, layers=(replace(SKIN, ratio=ratio),))
            expected = whole_forces(skinned, material, POSES)
            assert off(reduced_forces(made, material, POSES), expected) < 0.008
        assert off(reduced_forces(skinned, material, POSES), expected) > 0.02
        with pytest.raises(ts.InputError, match="contains training paths of another model"):
            ts.reduce_solid(skinned.model, skinned.box, resolution=coarse, strokes=9, modes=20, folder=tmp_path)
        thicker = replace(SOFT, layers=(replace(SKIN, thickness=3e-3),))
        with pytest.raises(ts.InputError, match="must have the thicknesses of the reduced solid"):
            ts.reduce_solid(skinned.model, skinned.box, strokes=2, also=[thicker])

    def test_too_few_strokes_for_several_materials(self, skinned, tmp_path):
        with pytest.raises(ts.InputError, match="number of materials, 3; got 2") as refused:
            ts.reduce_solid(skinned.model, skinned.box, strokes=2, also=[SOFT, replace(SOFT, layers=(SKIN,))],
                            folder=tmp_path / "strokes")
        assert refused.value.field == "strokes" and not (tmp_path / "strokes").exists(), "what is mended may go on"
        with pytest.raises(ts.InputError) as refused:
            ts.reduce_solid(skinned.model, skinned.box, also=[SOFT, replace(SOFT, bulk=ts.Bulk("bulk_ratio", 5e6))])
        assert refused.value.field.startswith("also[1].")

    def test_a_soft_material_counts_as_much_as_a_stiff_one(self, skinned):
        """Evaluated elements, and the stated error."""
        soft = ts.with_values(skinned.model.material, {"C10": 14.049, "C20": 6.994})
        solver = training.make_full_order_solver(skinned.model, skinned.mesh)
        start, taken, ways = skinned.model.experiment.tool_pose(0.0), [], []
        materials = [skinned.model.material, soft]
        for material, number in zip(materials, (0, 1), strict=True):
            solver.set_material(material)
            way = make_training_path(number, skinned.box, start, holds=True, reach=6e-3)[::4]
            ways.append(way)
            taken.append(training.simulate_snapshots(solver, way))
        looked_at = list(training.iterate_sampling_states_of_changing_symmetry(taken, ways, materials,
                                                                               [find_symmetries(solver, start)[0]],
                                                                               start))
        assert sum(sample.material is soft for sample in looked_at) >= 0.3 * len(looked_at)
        unseen = make_training_path(VERIFICATION.first_test_path, skinned.box, start, holds=True, reach=6e-3)
        report, _ = verify_and_get_report_and_factors(skinned, solver, [unseen, unseen], materials=materials)
        of_soft, _ = verify_and_get_report_and_factors(skinned, solver, [unseen], materials=[soft])
        of_stiff, _ = verify_and_get_report_and_factors(skinned, solver, [unseen], materials=materials[:1])
        assert of_soft["force_rms_N"] < 0.02 * of_stiff["force_rms_N"]
        errors = np.array([each["force_rms_error"] for each in (of_soft, of_stiff)])
        assert report["force_rms_error"] == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-3)

    def test_a_material_that_is_refused_changes_nothing(self, skinned):
        solver = ReducedSolver(skinned, skinned.model.material)
        expected = [solver.step(pose).wrench for pose in POSES]
        solver = ReducedSolver(skinned, skinned.model.material)
        for pose in POSES[:4]:
            solver.step(pose)
        with pytest.raises(ts.InputError, match=r"K/mu0 must be 2 to .*; got 5e"):
            solver.set_material(replace(SOFT, layers=(replace(SKIN, ratio=1.0),), bulk=ts.Bulk("bulk_ratio", 5e6)))
        assert solver.material is skinned.model.material
        np.testing.assert_array_equal([solver.step(pose).wrench for pose in POSES[4:]], expected[4:])

    def test_the_layer_of_the_tool_is_as_stiff_as_what_it_touches(self, skinned):
        bare = ReducedSolver(skinned, SOFT).contact._springs
        for ratio in (0.25, 8.0):
            solver = ReducedSolver(skinned, replace(SOFT, layers=(replace(SKIN, ratio=ratio),)))
            np.testing.assert_allclose(solver.contact._springs, ratio * bare)

    def test_its_material_is_changed_on_the_way(self, skinned):
        stiffer = replace(SOFT, layers=(replace(SKIN, ratio=6.0),))
        solver = ReducedSolver(skinned, replace(SOFT, layers=(SKIN,)))
        for pose in POSES:
            solver.step(pose)
        solver.set_material(stiffer)
        found = np.array(solver.step(POSES[-1]).wrench[:3])
        assert off(found, reduced_forces(skinned, stiffer, POSES)[-1]) < 2e-3

    @pytest.mark.parametrize("layers", [(replace(SKIN, thickness=3e-3),), (SKIN, SKIN)], ids=["thicker", "two"])
    def test_layers_stay_where_they_are(self, layers, skinned):
        with pytest.raises(ts.InputError, match="thicknesses of the reduced solid, from the top down 2 mm"):
            ReducedSolver(skinned, replace(SOFT, layers=layers))

    def test_colours_know_the_skin(self, skinned):
        """Von Mises stress of one displacement goes with the skin's stiffness in the skin alone."""
        found = []
        for ratio in (4.0, 8.0):
            solver = ReducedSolver(skinned, replace(SOFT, layers=(replace(SKIN, ratio=ratio),)))
            modes = skinned.basis[:, skinned.lifting] * 1e-4
            found.append(solver.fields([modes.reshape(-1, 3)]).at_points("von_mises"))
        skin = find_element_layer_indices(skinned.mesh, (SKIN,)) == 0
        np.testing.assert_allclose(found[1][skin], 2.0 * found[0][skin], rtol=1e-6)
        np.testing.assert_allclose(found[1][~skin], found[0][~skin], rtol=1e-6)


def lopsided(path, middle=0.0):
    """Write a block of 30 x 30 x 12 mm in hexahedra that mirrors map onto itself, one half of which is a region."""
    side = np.linspace(-0.015, 0.015, 7)
    mesh = block(side, side, np.linspace(-0.012, 0.0, 4), HEX8P0)
    write_hexahedra(path, mesh, mesh.nodes[mesh.connectivity].mean(axis=1)[:, 0] > middle)
    return ts.Model(experiment(ts.Specimen(shape="mesh", mesh_file=path), friction="bonded"),
                    replace(SOFT, regions={"part:2": STIFF}))


class TestSides:
    @pytest.mark.slow
    def test_a_stiff_side_is_no_mirror_image_of_a_soft_one(self, tmp_path):
        model = lopsided(tmp_path / "organ.vtu")
        box = ts.PoseBox(1e-3, DEPTH)
        mesh = training.build_training_mesh(model, box, "realtime")
        start = model.experiment.tool_pose(0.0)
        found = find_symmetries(training.make_full_order_solver(model, mesh), start)
        assert len(found) == 2, "across the other axis alone"
        plain = replace(model, material=SOFT)
        assert len(find_symmetries(training.make_full_order_solver(plain, replace(mesh, regions={})), start)) == 8
        made = ts.reduce_solid(model, box, strokes=6, modes=16, tried=2)
        assert made.report["symmetries"] == 2 and made.report["force_rms_error"] < 0.01

    @pytest.mark.slow
    def test_strokes_of_another_file_of_that_name_are_not_gone_on_with(self, tmp_path):
        model, folder = lopsided(tmp_path / "organ.vtu"), tmp_path / "strokes"
        box = ts.PoseBox(0.0, 1e-3)
        ts.reduce_solid(model, box, strokes=2, modes=4, tried=1, folder=folder)
        again = lopsided(tmp_path / "organ.vtu", middle=0.006)
        with pytest.raises(ts.InputError, match="contains training paths of another model"):
            ts.reduce_solid(again, box, strokes=2, modes=4, tried=1, folder=folder)
        assert again.experiment.specimen != model.experiment.specimen
        moved = tmp_path / "elsewhere.vtu"
        (tmp_path / "organ.vtu").rename(moved)
        assert ts.Specimen(shape="mesh", mesh_file=moved) == again.experiment.specimen, "by what is in it"


@pytest.mark.slow
class TestMeshesOfFiles:
    def test_on_an_unseen_stroke(self, organ):
        made, _ = organ
        assert made.report["force_rms_error"] < 0.01 and made.report["not_converged"] == 0.0

    def test_the_file_of_the_mesh_is_not_needed(self, organ):
        made, read = organ
        assert read.model.experiment.specimen.digest_of_files == made.model.experiment.specimen.digest_of_files
        assert read.model.experiment.specimen.in_words == "liver.vtu of 40 x 30 x 20 mm"
        np.testing.assert_array_equal(reduced_forces(read, read.model.material, POSES),
                                      reduced_forces(made, made.model.material, POSES))
        simulator = ts.Simulator(read.model, solver="reduced", mesh=read)
        assert simulator.step(1e-3, 1e-3).status is ts.ForceStatus.CONVERGED

    def test_a_mesh_is_that_of_a_file_or_given(self, organ):
        with pytest.raises(ts.InputError, match="the mesh would be defined twice"):
            replace(organ[1].model.experiment.specimen, mesh_file="/nowhere/other.vtu")

    def test_regions_that_overlap_are_one_sentence(self, organ, tmp_path):
        path = tmp_path / "liver.reduced.npz"
        regions = organ[1].mesh.regions
        ts.write_reduced(replace(organ[1], mesh=replace(organ[1].mesh, regions={**regions, "x": regions["part:1"]})),
                         path)
        with pytest.raises(ts.InputError, match="must contain each element in at most one region") as refused:
            ts.load_reduced(path)
        assert str(refused.value.file) == str(path)

    def test_a_region_of_another_law(self, organ):
        """Also one that relaxes where the rest does not."""
        _, read = organ
        relaxing = replace(STIFF, parameters={"C10": 7000.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 0.1),)))
        material = replace(SOFT, regions={"part:1": relaxing})
        expected = whole_forces(read, material, POSES)
        assert off(reduced_forces(read, material, POSES), expected) < 0.02
        small = ReducedSolver(read, material)
        whole = training.make_full_order_solver(ts.Model(read.model.experiment, material), read.mesh)
        for solver in (small, whole):
            for pose in POSES:
                solver.step(pose)
        fell = []
        for _ in range(10):
            fell.append([solver.step(POSES[-1], 0.05).force for solver in (small, whole)])
        np.testing.assert_allclose(*np.transpose(fell), rtol=0.02)
        assert fell[-1][1] < 0.97 * expected[-1, 2]

    def test_a_region_that_it_does_not_have(self, organ):
        with pytest.raises(ts.InputError, match="the mesh has no region 'part:3'"):
            ReducedSolver(organ[1], replace(SOFT, regions={"part:3": STIFF}))

    @pytest.mark.parametrize("name", ["points", "cells", "sides", "region part:1"])
    def test_a_damaged_mesh_is_one_sentence(self, name, organ, tmp_path):
        path = tmp_path / "liver.reduced.npz"
        ts.write_reduced(organ[1], path)
        with np.load(path) as stored:
            arrays = dict(stored)
        arrays[f"of file {name}"] = arrays[f"of file {name}"][:-1] if name in ("points",) else (
            arrays[f"of file {name}"] + 10**6)
        np.savez(path, **arrays)
        with pytest.raises(ts.InputError) as refused:
            ts.load_reduced(path)
        assert str(refused.value.file) == str(path)


@pytest.mark.slow
def test_a_shell_with_a_skin_is_kept_with_its_depths(tmp_path):
    shell = ts.EllipsoidShell(0.030, 0.024, 0.018, 0.008)
    model = ts.Model(experiment(shell, ts.Tool("flat", radius=4e-3), friction="bonded"), replace(SOFT, layers=(SKIN,)))
    made = ts.reduce_solid(model, ts.PoseBox(0.0, 1e-3), strokes=2, modes=4, tried=1)
    ts.write_reduced(made, path := tmp_path / "shell.reduced.npz")
    read = ts.load_reduced(path)
    np.testing.assert_array_equal(read.mesh.element_depths, made.mesh.element_depths)
    poses = [ts.Pose.at_depth(0.5e-3)]
    np.testing.assert_array_equal(*(reduced_forces(each, model.material, poses) for each in (made, read)))


@pytest.mark.slow
def test_a_tool_of_a_file_is_kept_in_it(tmp_path):
    profile = tmp_path / "cone.csv"
    profile.write_text("0, 0\n2, 0.3\n6, 2\n6, 9\n", encoding="utf-8")
    cone = ts.Tool("profile", profile_file=profile)
    model = ts.Model(experiment(ts.Specimen(0.025, 0.015), cone, friction=0.3), SOFT)
    made = ts.reduce_solid(model, ts.PoseBox(0.0, DEPTH), strokes=4, modes=8, tried=1)
    ts.write_reduced(made, path := tmp_path / "cone.reduced.npz")
    profile.unlink()
    read = ts.load_reduced(path)
    poses = [ts.Pose.at_depth(depth) for depth in (0.5e-3, 1e-3, 1.5e-3)]
    found = reduced_forces(read, SOFT, poses)
    np.testing.assert_array_equal(found, reduced_forces(made, SOFT, poses))
    assert off(found, whole_forces(made, SOFT, poses)) < 0.05
    assert read.model.experiment.tool.edge_radius == made.model.experiment.tool.edge_radius
    with pytest.raises(ts.InputError, match="at least two points"):
        replace(read.model.experiment.tool, points=((0.0, 0.0), (np.inf, 1.0)))


@pytest.mark.slow
def test_the_command_takes_a_skin_and_another_one(tmp_path, capsys):
    files = tmp_path / "skin.material.json", tmp_path / "stiffer.material.json"
    for file, ratio in zip(files, (4.0, 6.0), strict=True):
        ts.write_material_file(ts.MaterialFile.of(replace(SOFT, layers=(replace(SKIN, ratio=ratio),))), file)
    output = tmp_path / "skin.reduced.npz"
    assert main(["reduce", "needle_indentation", "--material", str(files[0]), "--also", str(files[1]), "--radius-mm",
                 "25", "--height-mm", "15", "--tool", "flat", "--tool-radius-mm", "6", "--friction", "bonded",
                 "--depth-mm", "2", "--strokes", "2", "--modes", "8", "--tried", "1", "-o", str(output)]) == 0
    assert "force error on 2 test paths with 2 materials: " in capsys.readouterr().out
    read = ts.load_reduced(output)
    assert read.model.material.layers == (SKIN,) and read.report["materials"] == 2
