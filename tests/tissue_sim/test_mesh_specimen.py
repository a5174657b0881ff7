"""A specimen from a file of its mesh: its sizes seen from above, its simulation, and the command line."""

import json
import pickle

import numpy as np
import pytest
from solid_meshes import write_tetrahedra

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.fem.solid.discretisation import build_mesh, make_solver
from tissue_sim.mesh.solid_element import TET8P0, TET15P1

MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A block of 40 x 30 x 20 mm that stands anywhere, in two regions: 288 tetrahedra of four nodes."""
    path = tmp_path_factory.mktemp("mesh") / "liver.vtu"
    write_tetrahedra(path, np.linspace(5.0, 45.0, 5), np.linspace(-3.0, 27.0, 5), np.linspace(80.0, 100.0, 4), 90.0)
    return path


@pytest.fixture(scope="module")
def specimen(file):
    return ts.Specimen(shape="mesh", mesh_file=file)


def test_its_sizes_are_those_of_the_file(specimen):
    assert specimen.height == pytest.approx(0.02) and specimen.outer_radius == pytest.approx(0.025)
    assert specimen.margin() == pytest.approx(0.015) and specimen.margin(0.013, -0.002) == pytest.approx(0.007)
    assert specimen.margin(0.024) == pytest.approx(-0.004)
    assert specimen.vertical_thickness(0.003, 0.004) == pytest.approx(0.02) and specimen.vertical_thickness(0.03) == 0.0
    assert specimen.is_flat and not specimen.is_prism and specimen.in_words == "liver.vtu of 40 x 30 x 20 mm"
    again = pickle.loads(pickle.dumps(specimen))
    assert again == specimen and again.height == specimen.height


def test_the_resolution_chooses_the_element(specimen):
    def experiment(**changes):
        return ts.Experiment(specimen, ts.Protocol.ramp(1e-3, 2), tool=ts.Tool("flat", radius=8e-3), **changes)

    for resolution, element in (("realtime", TET8P0), ("fast", TET15P1), ("accurate", TET15P1)):
        mesh = build_mesh(experiment(friction="bonded"), resolution)
        assert mesh.element is element and len(mesh.connectivity) == 288
    radii = np.hypot(*mesh.nodes[mesh.sets["face"], :2].T)
    assert radii.max() <= 8e-3 < np.hypot(*mesh.nodes[np.setdiff1d(mesh.sets["free"], mesh.sets["face"]), :2].T).min()
    with pytest.raises(ts.InputError, match="only 1 nodes of the top lie within 1 mm of the tool's axis"):
        build_mesh(ts.Experiment(specimen, ts.Protocol.ramp(1e-4, 2), tool=ts.Tool("flat", radius=1e-3)))
    layered = ts.Material("neo_hooke", {"C10": 1500.0}, layers=(ts.Layer(2e-3, 3.0),))
    with pytest.raises(ts.InputError, match="must be left out for a mesh from a file"):
        make_solver(ts.Model(experiment(), layered))


@pytest.mark.slow
def test_it_is_pressed_as_the_block_that_it_is(specimen):
    """Between bonded plates: the same block in elements of our own, coarse ones; and its soft half is felt."""
    kind = ts.KINDS["bonded_compression"]
    own = ts.Specimen(shape="block", length=0.04, width=0.03, height=0.02)

    def force(body, material=MATERIAL):
        experiment = kind.experiment(specimen=body, protocol=ts.Protocol.ramp(1e-3, 2))
        return ts.simulate(ts.Model(experiment, material), solver="solid").force[-1]

    found, expected = force(specimen), force(own)
    assert found == pytest.approx(expected, rel=0.03)
    soft = ts.Material("neo_hooke", {"C10": 750.0}, ts.Bulk("bulk_ratio", 1e3))
    halves = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3), regions={"part:1": soft})
    assert 0.5 * found < force(specimen, halves) < 0.85 * found


@pytest.mark.slow
def test_the_command_line_takes_a_mesh(file, tmp_path, capsys):
    path = tmp_path / "m.material.json"
    ts.write_material_file(ts.MaterialFile.of(MATERIAL), path)
    words = ["simulate", "needle_indentation", "--material", str(path), "--mesh", str(file), "--tool", "sphere",
             "--tool-radius-mm", "8", "--friction", "0.3", "--offset-mm", "5", "--depth-mm", "3", "--points", "2",
             "--json"]
    assert main([*words, "--solid"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "converged" and answer["mesh"]["elements"] == 288
    assert answer["force_vector_N"][-1][2] == pytest.approx(answer["force_N"][-1]) and answer["force_N"][-1] > 0.0

    def refused(*more):
        assert main([*words, *more]) == 2
        return capsys.readouterr().err

    on_axis = [*words[: words.index("--offset-mm")], "--depth-mm", "3", "--points", "2"]
    assert main(on_axis) == 2
    assert "requires a cylinder; the specimen is a mesh; take the solver \"solid\" (--solid)" in (
        capsys.readouterr().err)
    assert "liver.vtu: the extent must be 0.0001 m to 1 m; got 40 m with the unit m" in refused(
        "--solid", "--mesh-unit", "m")
    assert "no sides on the surface of the mesh are named 'skull'" in refused("--solid", "--mesh-top", "skull")
    assert "--radius-mm: cannot be combined with --mesh" in refused("--radius-mm", "30")
    assert "reaches beyond the specimen, liver.vtu of 40 x 30 x 20 mm" in refused("--solid", "--offset-mm", "15")
    assert main(["simulate", "needle_indentation", "--material", str(path), "--mesh-unit", "cm"]) == 2
    assert "--mesh-unit: requires a mesh file. Add --mesh FILE" in capsys.readouterr().err
