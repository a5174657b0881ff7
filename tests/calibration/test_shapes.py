"""Campaigns of specimens that are no cylinders: how they are stated, what is refused, and that the solid fits them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from solid_meshes import write_hexahedra

import calibration
import tissue_sim as ts
from calibration.campaign.measured import compute_input_and_version_digest
from calibration.campaign.parameter_space import ParameterSpace
from calibration.campaign.schema import replace_mesh_profile_and_rig_paths, resolve_path_to_text
from calibration.forward.forms import build_forward_test_of_inverse_fit, compute_mesh_uncertainty
from calibration.forward.meshes import ACCURATE_MESH_ERRORS, MESHES, SolverFitResolutions, make_exact_block_mesh_or_none
from calibration.forward.simulation_cache import hash_content_and_source_code, simulate_force_or_record_failure
from scenes.cli import main
from tissue_sim.fem.solid.discretisation import RESOLUTIONS, Resolution, build_mesh
from tissue_sim.mesh.solid import Grading, create_block_mesh_from_boundaries
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1

CAMPAIGN = """
[[specimen]]
name = "cube"
{specimen}

[[test]]
kind = "{kind}"
recordings = ["run_*.csv"]
{test}

[fit]
method = "{method}"
laws = ["neo_hooke"]
bulk_ratio = 1000.0
starts = 1

[noise]
force_N = 0.001
contact_jitter_mm = 0.0
zero_jitter_N = 0.0
"""
BLOCK = 'shape = "block"\nlength_mm = 20.0\nwidth_mm = 20.0\nheight_mm = 20.0'
SHELL = ('shape = "ellipsoid_shell"\nsemi_axis_x_mm = 50.0\nsemi_axis_y_mm = 40.0\nsemi_axis_z_mm = 30.0\n'
         'thickness_mm = 12.0')
MESH = 'shape = "mesh"\nmesh = "cube.vtu"'
NEEDLE = 'tool = "flat"\ntool_radius_mm = 4.0'
MATERIAL = ts.Material("neo_hooke", {"C10": 450.0}, ts.Bulk("bulk_ratio", 1e3))


def write_mesh(path, specimen, scale=1.0):
    """Its mesh between plates."""
    write_hexahedra(path, specimen.solid_mesh(Grading(HEX8P0, 6e-3, 2.5, 0.04, 2)), scale=scale)


def pressed(specimen, depth=2e-3, points=9, kind="bonded_compression"):
    return ts.KINDS[kind].experiment(specimen=specimen, protocol=ts.Protocol.ramp(depth, points))


def write_run(folder, depth, force, seed=1, **metadata):
    """A recording with noise along a force that is known at some depths, N and m."""
    way = np.linspace(0.0, depth[-1], 81)
    noise = 0.001 * np.random.default_rng(seed).normal(size=way.size)
    ts.write_recording(ts.Recording({"time": way / 1e-4, "displacement": way, "force": CubicSpline(depth, force)(way)
                                     + noise}, metadata=metadata), folder / f"run_{seed}.csv")


@pytest.fixture
def coarse(monkeypatch):
    """Two orders of one mesh of 64 elements between plates."""
    monkeypatch.setitem(RESOLUTIONS, "coarse", Resolution(HEX8P0, 0.6, 2.5, 3.8, 2))
    monkeypatch.setitem(RESOLUTIONS, "coarse, second order", Resolution(HEX27P1, 0.6, 2.5, 3.8, 2))
    monkeypatch.setitem(MESHES, "solid", SolverFitResolutions("coarse", "coarse, second order", error_factor=3.0))


@pytest.fixture
def folder(tmp_path):
    write_run(tmp_path, np.linspace(0.0, 2e-3, 9), np.linspace(0.0, 0.2, 9))
    write_mesh(tmp_path / "cube.vtu", ts.Block(0.02, 0.02, 0.02))
    return tmp_path


def load(folder, specimen=BLOCK, kind="bonded_compression", test="", method="inverse_fem"):
    (folder / "study.toml").write_text(CAMPAIGN.format(specimen=specimen, kind=kind, test=test, method=method),
                                       encoding="utf-8")
    return calibration.load_campaign(folder / "study.toml")


def calibrated(folder, **stated):
    load(folder, **stated)
    result, = calibration.calibrate([folder / "study.toml"], folder / "out", figures=False, overwrite=True)
    return result.best


@pytest.mark.parametrize(("stated", "shape", "kind", "test"), [
    (BLOCK, "block", "bonded_compression", ""), (MESH, "mesh", "lubricated_compression", ""),
    (SHELL, "ellipsoid_shell", "needle_indentation", NEEDLE + "\noffset_mm = 10.0")])
def test_every_shape_is_one_of_the_solid_in_space(folder, stated, shape, kind, test):
    campaign = load(folder, stated, kind, test)
    asked, = campaign.tests
    assert (asked.solver, asked.specimen.shape, asked.experiment.specimen) == ("solid", shape, asked.specimen)
    forward = build_forward_test_of_inverse_fit(asked, calibration.read_measured_curves(campaign)[asked.name],
                                                campaign.fit, 0.0)
    assert forward.solver == "solid" and forward.specimen is asked.specimen
    assert forward.is_homogeneous == (shape == "block" and kind == "lubricated_compression")


@pytest.mark.parametrize(("stated", "kind", "method", "field", "words"), [
    (MESH, "lubricated_compression", "analytical", "test[0].specimen",
     "no closed form; set fit.method = 'inverse_fem'"),
    (SHELL, "uniaxial_tension", "inverse_fem", "test[0].specimen", "use a specimen such as shape = 'prism'"),
    (BLOCK, "bonded_compression", "analytical", "test[0].kind",
     "Set fit.method = 'inverse_fem'"),
    ('shape = "mesh"', "bonded_compression", "inverse_fem", "specimen[0].mesh", "a mesh requires mesh"),
    (MESH.replace("cube", "none"), "bonded_compression", "inverse_fem", "specimen[0]", "no such file"),
    (MESH + '\nmesh_unit = "ell"', "bonded_compression", "inverse_fem", "specimen[0].mesh_unit", "unknown unit 'ell'"),
    (MESH + '\nmesh_top = "skull"', "bonded_compression", "inverse_fem", "specimen[0].mesh_top", "are named 'skull'"),
    (MESH + "\nradius_mm = 3.0", "bonded_compression", "inverse_fem", "specimen[0].radius_mm", "leave radius_mm out"),
    (BLOCK + '\nmesh_unit = "mm"', "bonded_compression", "inverse_fem", "specimen[0].mesh_unit", "leave mesh_unit out"),
    ('shape = "prism"\narea_mm2 = 400.0\nheight_mm = 20.0', "bonded_compression", "inverse_fem", "test[0].specimen",
     "requires the shape of the specimen")])
def test_what_does_not_fit_is_refused_with_its_field(folder, stated, kind, method, field, words):
    with pytest.raises(ts.InputError) as caught:
        load(folder, stated, kind, method=method)
    assert caught.value.field == field and words in str(caught.value)


def test_the_axisymmetric_solver_takes_no_block(folder, capsys):
    with pytest.raises(ts.InputError, match=r"requires a cylinder; 'cube' is a block\. Leave solver out"):
        load(folder, test='solver = "axisymmetric"')
    assert main(["calibrate", str(folder / "study.toml"), "-o", str(folder / "out")]) == 2
    assert "test[0].solver" in capsys.readouterr().err and not (folder / "out").exists()


def test_a_mesh_counts_by_what_is_in_its_file(folder, tmp_path_factory):
    """Another folder is the same specimen, another content another: solutions and results are found again by that."""
    def keys():
        campaign = load(folder, MESH)
        return (hash_content_and_source_code(campaign.tests[0].experiment),
                compute_input_and_version_digest(campaign, []))

    first = keys()
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "other.vtu"
    elsewhere.write_bytes((folder / "cube.vtu").read_bytes())
    other = replace(load(folder, MESH).tests[0].experiment.specimen, mesh_file=elsewhere)
    assert hash_content_and_source_code(replace(load(folder, MESH).tests[0].experiment, specimen=other)) == first[0]
    write_mesh(folder / "cube.vtu", ts.Block(0.02, 0.02, 0.02), scale=1.1)
    assert all(one != two for one, two in zip(keys(), first, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("flags", "stated"), [
    (["--shape", "block", "--length-mm", "20", "--width-mm", "20", "--height-mm", "20"], BLOCK),
    (["--mesh", "cube.vtu"], MESH)])
def test_recordings_know_the_specimen_that_they_are_of(folder, monkeypatch, coarse, flags, stated):
    monkeypatch.chdir(folder)
    monkeypatch.setitem(RESOLUTIONS, "fast", RESOLUTIONS["coarse"])
    ts.write_material_file(ts.MaterialFile.of(MATERIAL), folder / "m.material.json")
    assert main(["simulate", "bonded_compression", "--solid", *flags, "--depth-mm", "1", "--points", "6",
                 "--material", "m.material.json", "-o", "run_1.csv", "--overwrite"]) == 0
    said = ts.read_recording(folder / "run_1.csv").metadata["specimen"]
    sizes = "".join(f"\n{key} = {json.dumps(value)}" for key, value in said.items() if key != "shape")
    assert load(folder, f'shape = "{said["shape"]}"{sizes}').specimens == load(folder, stated).specimens
    calibration.read_measured_curves(load(folder, stated))
    other = BLOCK if stated == MESH else MESH
    with pytest.raises(ts.InputError, match=rf"specimen\[0\].shape: .* states a {said['shape']}"):
        calibration.read_measured_curves(load(folder, other))


@pytest.mark.slow
def test_the_force_on_a_block_follows_its_sizes():
    """Between plates that slip: proportional to length and width; a mesh that is moved has the sizes of the new one."""
    block = ts.Block(0.03, 0.02, 0.015)
    model = ts.Model(pressed(block, points=3, kind="lubricated_compression"), MATERIAL)
    names = [f"experiment.specimen.{name}" for name in ("length", "width", "height")]
    answer = ts.sensitivities(model, names, solver="solid", resolution="realtime")
    force, stretch = answer.recording.force[-1], 1.0 - 2.0 / 15.0
    np.testing.assert_allclose(answer.values[-1, :2], [force / 0.03, force / 0.02], rtol=1e-4)
    # F = 2 C10 A (1 / l^2 - l), l = 1 - d / H
    slope = 2.0 * 450.0 * block.area * (-2.0 / stretch**3 - 1.0) * (2e-3 / 0.015**2)
    assert answer.values[-1, 2] == pytest.approx(slope, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("more", [{}, {"viscoelastic": ts.Prony((ts.PronyTerm(0.3, 5.0),))},
                                  {"softening": ts.Softening(loss=0.3, modulus=10.0)}])
def test_where_any_mesh_is_exact_eight_elements_are_enough(more):
    """A block between plates without friction: force and derivatives of the mesh that a fit would take else."""
    time = np.array([0.0, 5.0, 10.0, 20.0, 25.0])
    experiment = ts.KINDS["lubricated_compression"].experiment(
        specimen=ts.Block(0.020, 0.030, 0.015), protocol=ts.Protocol(time, 1e-3 * np.array([0.0, 1.0, 2.0, 2.0, 0.5])))
    model = ts.Model(experiment, replace(MATERIAL, **more))
    assert make_exact_block_mesh_or_none(model, "solid").connectivity.shape[0] == 8
    few = simulate_force_or_record_failure(model, None, ["C10"], "realtime", "solid")
    many = ts.sensitivities(model, ["C10"], resolution="realtime", solver="solid")
    # Steps end where forces balance to 1e-6.
    for found, expected in ((few.force, many.recording.force), (few.rates, many.values)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())


@pytest.mark.parametrize("change", [
    {"friction": 0.1}, {"specimen": ts.Cylinder(0.020, 0.015)}, {"tilt": 1e-4}, {"friction": "bonded"},
    {"specimen": ts.Block(0.020, 0.030, 0.015, density=1000.0, gravity=9.81)}])
def test_where_a_mesh_matters_it_is_that_of_the_resolution(change):
    experiment = replace(pressed(ts.Block(0.020, 0.030, 0.015), kind="lubricated_compression"), **change)
    assert make_exact_block_mesh_or_none(ts.Model(experiment, MATERIAL), "solid") is None


def test_a_moved_block_keeps_its_circle_and_its_sides():
    needle = ts.Experiment(ts.Block(0.03, 0.02, 0.015), ts.Protocol.ramp(1e-3, 2), tool=ts.Tool("flat", radius=3e-3),
                           approach=ts.Approach(5e-3))
    mesh, other = build_mesh(needle, "realtime"), ts.Block(0.032, 0.024, 0.012)
    from tissue_sim.mesh.mesh_mapping import Circle

    circles = Circle(3e-3, (5e-3, 0.0)), Circle(4e-3, (4e-3, 0.0))
    moved = other.moved_mesh(mesh, needle.specimen, circles)
    edge = np.intersect1d(mesh.sets["face"], mesh.sets["free"])
    np.testing.assert_allclose(np.hypot(*(moved.nodes[edge, :2] - [4e-3, 0.0]).T), 4e-3, rtol=1e-9)
    np.testing.assert_allclose(np.ptp(moved.nodes, axis=0), [0.032, 0.024, 0.012])
    with pytest.raises(ts.InputError, match="the mesh of an ellipsoid shell cannot be moved"):
        ts.EllipsoidShell(0.05, 0.04, 0.03, 0.012).moved_mesh(mesh, needle.specimen, circles)


def write_lumpy_mesh(path):
    """A block of 30 x 30 x 20 mm in hexahedra, with a lump in its middle that a region names."""
    side = np.linspace(-0.015, 0.015, 6)
    mesh = create_block_mesh_from_boundaries(side, side, np.linspace(-0.020, 0.0, 5), HEX8P0)
    middle = mesh.nodes[mesh.connectivity].mean(axis=1)
    lump = (np.abs(middle[:, :2]).max(axis=1) < 0.01) & (middle[:, 2] > -0.015)
    write_hexahedra(path, mesh, lump)


LUMPY = """
[[specimen]]
name = "organ"
shape = "mesh"
mesh = "organ.vtu"

[[specimen]]
name = "strip"
shape = "prism"
area_mm2 = 100.0
height_mm = 20.0

[[test]]
name = "organ"
specimen = "organ"
kind = "needle_indentation"
tool = "flat"
tool_radius_mm = 7.0
recordings = ["run_*.csv"]

[[test]]
name = "sample"
specimen = "strip"
kind = "uniaxial_tension"
recordings = ["sample.csv"]

[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 1000.0
starts = 1
start = { "regions.part:2.C10" = 1500.0 }

[noise]
force_N = 0.001
contact_jitter_mm = 0.0
zero_jitter_N = 0.0
"""


@pytest.mark.slow
def test_a_lump_is_fitted_beside_a_sample_of_what_is_around_it(tmp_path, coarse):
    """Its stiffness comes out with its interval, and stands in the region of the material file; the sample has none."""
    write_lumpy_mesh(tmp_path / "organ.vtu")
    lump = ts.Material("neo_hooke", {"C10": 1800.0}, ts.Bulk("bulk_ratio", 1e3))
    organ = ts.Specimen(shape="mesh", mesh_file=tmp_path / "organ.vtu")
    assert organ.region_names == ("part:1", "part:2")
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=organ, protocol=ts.Protocol.ramp(2e-3, 9), tool=ts.Tool("flat", radius=7e-3))
    true = replace(MATERIAL, regions={"part:2": lump})
    run = ts.simulate(ts.Model(experiment, true), solver="solid", resolution="coarse, second order")
    write_run(tmp_path, run.displacement, run.force)
    stretch = np.linspace(1.0, 1.2, 41)
    force = 2.0 * 450.0 * (stretch - stretch**-2) * 1e-4 + 0.0001 * np.random.default_rng(3).normal(size=41)
    ts.write_recording(ts.Recording({"time": np.arange(41.0), "displacement": 0.02 * (stretch - 1.0), "force": force}),
                       tmp_path / "sample.csv")
    (tmp_path / "study.toml").write_text(LUMPY, encoding="utf-8")
    space = ParameterSpace.from_campaign("neo_hooke", calibration.load_campaign(tmp_path / "study.toml"))
    start = {"C10": 450.0, "regions.part:2.C10": 1500.0}
    assert space.build_material(start, test="organ").regions.keys() == {"part:2"}
    assert not space.build_material(start, test="sample").regions
    result, = calibration.calibrate([tmp_path / "study.toml"], tmp_path / "out", figures=False)
    fit = result.best
    low, high = fit.intervals95["regions.part:2.C10"]
    assert low < 1800.0 < high < 1.5 * low
    assert fit.parameters["C10"] == pytest.approx(450.0, rel=0.01)
    written = ts.load_material(tmp_path / "out" / "neo_hooke.material.json")
    assert written.regions["part:2"].parameters["C10"] == pytest.approx(1800.0, rel=0.1)
    (tmp_path / "study.toml").write_text(LUMPY.replace("part:2", "part:3"), encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"fit.start.*no specimen has a region 'part:3'; did you mean"):
        calibration.load_campaign(tmp_path / "study.toml")


def felupe_forces(depths):
    """Return the forces on a bonded cube of 20 mm in FElupe, N: one eighth, 8-node hexahedra with mean dilatation."""
    import felupe

    cube = felupe.Cube(n=8)
    fine = 10e-3 * (1.0 - (1.0 - cube.points) ** 2.2)  # towards the faces
    field = felupe.FieldsMixed(felupe.RegionHexahedron(felupe.Mesh(fine, cube.cells, "hexahedron")), n=3)
    body = felupe.SolidBody(felupe.ThreeFieldVariation(felupe.NeoHooke(mu=900.0, bulk=900e3)), field)
    planes = {axis: felupe.Boundary(field[0], **{f"f{axis}": 0.0}, skip=skip) for axis, skip in (
        ("x", (0, 1, 1)), ("y", (1, 0, 1)), ("z", (1, 1, 0)))}
    tool = felupe.Boundary(field[0], fz=10e-3, skip=(1, 1, 0))
    bounds = planes | {"glue": felupe.Boundary(field[0], fz=10e-3, skip=(0, 0, 1)), "tool": tool}
    top, forces, last = np.isclose(fine[:, 2], 10e-3), [], 0.0
    for depth in depths:
        for way in np.linspace(last, depth, 4)[1:] if depth else [0.0]:
            tool.update(-0.5 * way)
            dof0, dof1 = felupe.dof.partition(field, bounds)
            felupe.newtonrhapson(items=[body], dof0=dof0, dof1=dof1, ext0=felupe.dof.apply(field, bounds, dof0),
                                 tol=1e-7, verbose=0)
        last = depth
        forces.append(-4.0 * body.assemble.vector(field).toarray()[: fine.size].reshape(-1, 3)[top, 2].sum())
    return np.array(forces)


@pytest.mark.slow
def test_a_glued_cube_of_another_program(tmp_path, coarse):
    """FElupe's cube has C10 = 450 Pa, and its mesh is 0.7 % too stiff; ours of 64 elements errs by less than 2 %. From
    the same file of a mesh the answer is that of the block, and its interval allows for the mesh."""
    depths = np.linspace(0.0, 2e-3, 5)
    forces = felupe_forces(depths)
    for seed in (1, 2):
        write_run(tmp_path, depths, forces, seed)
    write_mesh(tmp_path / "cube.vtu", ts.Block(0.02, 0.02, 0.02))
    block, mesh = (calibrated(tmp_path, specimen=stated) for stated in (BLOCK, MESH))
    assert block.parameters["C10"] == pytest.approx(450.0, rel=0.02)
    assert mesh.parameters["C10"] == pytest.approx(block.parameters["C10"], rel=1e-3)
    assert mesh.standard_errors["C10"] > block.standard_errors["C10"]
    assert abs(mesh.parameters["C10"] - 450.0) < 3.0 * mesh.standard_errors["C10"]


@pytest.mark.slow
def test_a_block_that_weighs_is_fitted_with_exact_derivatives(tmp_path, coarse, monkeypatch):
    """No simulation is done for a difference; those of the start, which depends on the modulus, would be many."""
    weight = {"density": 1040.0, "gravity": 9.81, "height_is": "placed"}
    block = ts.Block(0.02, 0.02, 0.02, **weight)
    recording = ts.simulate(ts.Model(pressed(block), MATERIAL), solver="solid", resolution="coarse, second order")
    write_run(tmp_path, recording.displacement, recording.force)
    differences = []
    monkeypatch.setattr("tissue_sim.differentiation._compute_force_derivative_by_differences",
                        lambda *asked: differences.append(asked))
    stated = BLOCK + '\nheight_is = "placed"\ngravity = true\ndensity_kg_m3 = 1040.0'
    best = calibrated(tmp_path, specimen=stated)
    assert best.parameters["C10"] == pytest.approx(450.0, abs=3.0 * best.standard_errors["C10"])
    assert best.standard_errors["C10"] < 2.0 and not differences


def test_what_a_mesh_of_a_file_errs_by_is_told_from_two_orders(folder, coarse):
    campaign = load(folder, MESH)
    curves = calibration.read_measured_curves(campaign)["bonded_compression"]
    forward = build_forward_test_of_inverse_fit(campaign.tests[0], curves, campaign.fit, 0.0)
    assert compute_mesh_uncertainty(forward, ACCURATE_MESH_ERRORS) == 0.1
    forward.correction = [np.array([0.0, -0.004])]
    largest = np.abs(forward.measured[0].force).max()
    assert compute_mesh_uncertainty(forward, ACCURATE_MESH_ERRORS) == pytest.approx(0.1 * 0.004 / largest)


@pytest.mark.slow
def test_import_writes_a_campaign_of_a_stated_shape(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    words = ["import", "run_1.csv", "-o", "study.toml", "--kind", "bonded_compression"]
    sizes = ["--shape", "block", "--length-mm", "20", "--width-mm", "20", "--height-mm", "20"]
    assert main([*words, *sizes]) == 0
    test, = calibration.load_campaign(folder / "study.toml").tests
    assert test.solver == "solid" and test.specimen == ts.Block(0.02, 0.02, 0.02)
    assert main([*words, "--overwrite", *sizes[:4]]) == 1
    assert "the width of the specimen (--width-mm)" in " ".join(capsys.readouterr().out.split())
    assert main([*words, "--overwrite", "--length-mm", "20"]) == 2
    assert "--length-mm: is not a size of a cylinder. Add --shape block" in capsys.readouterr().err


def test_a_campaign_that_is_written_elsewhere_finds_its_mesh(folder):
    content = {"specimen": [{"shape": "mesh", "mesh": "cube.vtu", "mesh_unit": "mm"}], "test": []}
    table, = replace_mesh_profile_and_rig_paths(content, folder, resolve_path_to_text)["specimen"]
    assert table == {"shape": "mesh", "mesh": str((folder / "cube.vtu").resolve()), "mesh_unit": "mm"}


@pytest.mark.slow
def test_design_asks_for_the_sizes_that_a_specimen_has(tmp_path, coarse):
    text = CAMPAIGN.format(specimen=BLOCK, kind="bonded_compression", test='protocol = "ramp 2mm @0.1mm/s"',
                           method="inverse_fem").replace('recordings = ["run_*.csv"]\n', "")
    (tmp_path / "plan.toml").write_text(text.replace("starts = 1", "start = { C10 = 450.0 }"), encoding="utf-8")
    found = calibration.evaluate_planned_experiments(tmp_path / "plan.toml", replicates=1, samples=40)
    reasons = {each.name: each.reason for each in found.candidates}
    assert reasons["radius_error"] == "no specimen has a radius" and "has a height" not in reasons["height_error"]
    assert 0.1 < found.standard_errors["C10"] < 20.0


@pytest.mark.parametrize(("stated", "kind", "test", "words"), [
    (SHELL, "bonded_compression", "", "must not be 'bonded' for a plate on the curved top"),
    (SHELL, "needle_indentation", NEEDLE + "\noffset_mm = 45.0", "outside of the specimen")])
def test_what_a_solid_cannot_be_made_of_is_said_of_its_test(folder, coarse, capsys, stated, kind, test, words):
    load(folder, stated, kind, test)
    assert main(["calibrate", str(folder / "study.toml"), "-o", str(folder / "out")]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "test[0]" in said and words in said and "fit.start" not in said


def test_a_needle_beyond_a_shell_is_refused(folder):
    with pytest.raises(ts.InputError, match="the specimen has no tissue 60 mm off the axis") as caught:
        load(folder, SHELL, "needle_indentation", NEEDLE + "\noffset_mm = 60.0")
    assert caught.value.field == "test[0].offset_mm"


def test_a_size_in_another_unit_is_refused(folder):
    with pytest.raises(ts.InputError, match=r"length_mm must be .* got 20000. Check the unit") as caught:
        load(folder, BLOCK.replace("length_mm = 20.0", "length_mm = 20000.0"))
    assert caught.value.field == "specimen[0].length_mm"


@pytest.mark.parametrize(("said", "taken"), [
    ({"radius_mm": 10.0, "height_mm": 20.0}, False), ({"shape": "cylinder", "height_mm": 20.0}, False),
    ({"height_mm": 20.0}, True), ({"shape": "prism", "area_mm2": 400.0, "height_mm": 20.0}, True)])
def test_recordings_of_cylinders_are_none_of_blocks(folder, said, taken):
    """Older ones have the sizes of a cylinder and no shape; some have no more than a height."""
    write_run(folder, np.linspace(0.0, 2e-3, 9), np.linspace(0.0, 0.2, 9), specimen=said)
    if taken:
        assert len(calibration.read_measured_curves(load(folder))["bonded_compression"]) == 1
    else:
        with pytest.raises(ts.InputError, match="states a cylinder") as caught:
            calibration.read_measured_curves(load(folder))
        assert caught.value.field == "specimen[0].shape"
    cylinder = 'shape = "cylinder"\nradius_mm = 10.0\nheight_mm = 20.0'
    assert len(calibration.read_measured_curves(load(folder, cylinder))["bonded_compression"]) == 1


def test_a_prism_may_be_any_shape(folder):
    """Known by its cross-section and height alone."""
    write_run(folder, np.linspace(0.0, 2e-3, 9), np.linspace(0.0, 0.2, 9),
              specimen={"shape": "block", "length_mm": 20.0, "width_mm": 20.0, "height_mm": 20.0})
    prism = 'shape = "prism"\narea_mm2 = 400.0\nheight_mm = 20.0'
    measured = calibration.read_measured_curves(load(folder, prism, "lubricated_compression"))
    assert [len(curves) for curves in measured.values()] == [1]
