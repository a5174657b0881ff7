"""Faceting error of a round tool on linear elements: the warning states the missing fraction of the force."""

import json
import re

import numpy as np
import pytest

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.mesh.solid import add_face_and_free_node_sets, create_block_mesh_from_boundaries
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1

MATERIAL = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3))


def pressed(size, element, tool=None, friction="frictionless", depth=3e-3):
    """Simulate an indentation of a block with elements of one size, m; the default tool is a ball.

    Returns:
        Largest force, N, and the warnings of the solver.
    """
    line = np.linspace(-0.02, 0.02, round(0.04 / size) + 1)
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.02, 0.02), protocol=ts.Protocol.ramp(depth, points=2),
        tool=tool or ts.Tool("round", radius=8e-3), friction=friction)
    mesh = create_block_mesh_from_boundaries(line, line, np.linspace(-0.02, 0.0, round(0.02 / size) + 1), element)
    recording = ts.simulate(ts.Model(experiment, MATERIAL), solver="solid",
                            mesh=add_face_and_free_node_sets(mesh, 8e-3, (0.0, 0.0)))
    return recording.force[-1], recording.metadata["solver"]["warnings"]


@pytest.fixture(scope="module")
def truth():
    """Force with quadratic elements, which have no faceting error, N."""
    force, warnings = pressed(0.04 / 10, HEX27P1)
    assert warnings == []
    return force


@pytest.mark.slow
@pytest.mark.parametrize("elements", [8, 10, 12])
def test_warning_states_the_missing_fraction(elements, truth):
    force, (warning,) = pressed(0.04 / elements, HEX8P0)
    named = float(re.search(r"that about ([\d.]+) % of the force is missing", warning)[1]) / 100.0
    assert 0.6 * named < 1.0 - force / truth < 1.6 * named, warning
    assert f"{40 / elements:.2g} mm wide" in warning and "use elements of 1.5 mm there" in warning


@pytest.mark.parametrize("friction", ["stick", 0.5])
def test_sticking_contact_gets_the_same_warning(friction):
    _, (warning,) = pressed(4e-3, HEX8P0, friction=friction)
    assert "that about 17 % of the force is missing" in warning


def test_warning_has_no_figure_if_most_of_the_force_is_missing():
    _, (warning,) = pressed(5e-3, HEX8P0, depth=3e-4)
    assert "that most of the force is missing; use elements of 0.49 mm there" in warning


@pytest.mark.parametrize("tool", [ts.Tool("flat", radius=8e-3), ts.Tool("flat", radius=8e-3, edge_radius=1e-3)])
def test_flat_tool_gets_no_warning(tool):
    _, warnings = pressed(4e-3, HEX8P0, tool, "stick")
    assert warnings == []


@pytest.mark.slow
def test_reduced_solid_reports_the_warning_of_the_full_solid(tmp_path, capsys):
    """The mesh comes from a file, and its elements are too wide for the tool."""
    line, numbers, text = np.arange(-20.0, 21.0, 4.0), {}, ["*NODE"]
    places = [(x, y, z) for z in (-12.0, -8.0, -4.0, 0.0) for y in line for x in line]
    for number, place in enumerate(places, start=1):
        numbers[place] = number
        text.append(", ".join(map(str, (number, *place))))
    text.append("*ELEMENT, TYPE=C3D8, ELSET=body")
    corners = [(x, y, z) for x, y, z in places if x < 20.0 and y < 20.0 and z < 0.0]
    for number, (x, y, z) in enumerate(corners, start=1):
        text.append(", ".join(map(str, (number, *(numbers[x + 4.0 * a, y + 4.0 * b, z + 4.0 * c] for a, b, c in (
            (0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)))))))
    (tmp_path / "block.inp").write_text("\n".join(text) + "\n", encoding="utf-8")
    asked = ["reduce", "needle_indentation", "--mesh", str(tmp_path / "block.inp"), "--tool", "round",
             "--tool-radius-mm", "8", "--friction", "frictionless", "--depth-mm", "3", "--strokes", "2", "--modes", "4",
             "--tried", "1"]
    assert main([*asked, "-o", str(tmp_path / "block.reduced.npz"), "--json"]) == 0
    out, err = capsys.readouterr()
    (warning,) = json.loads(out)["warnings"]
    assert err == "" and "4 mm wide" in warning and "of the force is missing" in warning
    assert ts.load_reduced(tmp_path / "block.reduced.npz").report["warnings"] == [warning]
    assert main([*asked, "-o", str(tmp_path / "again.reduced.npz")]) == 0
    assert f"tissue-sim: warning: {warning}" in capsys.readouterr().err
