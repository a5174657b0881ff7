"""Flat sides under a round tool: what is said of the force is what it really lacks."""

import json
import re

import numpy as np
import pytest

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.mesh.hexahedra import HEX8P0, HEX27P1
from tissue_sim.mesh.solid import block_mesh, with_tool_sets

MATERIAL = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3))


def pressed(size, element, tool=None, friction="frictionless", depth=3e-3):
    """Largest force, N, and what is said of it, of a tool, a ball if none is said, in a block with
    elements of one size."""
    line = np.linspace(-0.02, 0.02, round(0.04 / size) + 1)
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.02, 0.02), protocol=ts.Protocol.ramp(depth, points=2),
        tool=tool or ts.Tool("round", radius=8e-3), friction=friction)
    mesh = block_mesh(line, line, np.linspace(-0.02, 0.0, round(0.02 / size) + 1), element)
    recording = ts.simulate(ts.Model(experiment, MATERIAL), solver="solid", mesh=with_tool_sets(mesh, 8e-3, (0.0, 0.0)))
    return recording.force[-1], recording.metadata["solver"]["warnings"]


@pytest.fixture(scope="module")
def truth():
    """Of quadratic elements, of which nothing is said."""
    force, warnings = pressed(0.04 / 10, HEX27P1)
    assert warnings == []
    return force


@pytest.mark.parametrize("elements", [8, 10, 12])
def test_the_share_that_is_named_is_missing(elements, truth):
    force, (warning,) = pressed(0.04 / elements, HEX8P0)
    named = float(re.search(r"takes some ([\d.]+) % of the force away", warning)[1]) / 100.0
    assert 0.6 * named < 1.0 - force / truth < 1.6 * named, warning
    assert f"{40 / elements:.2g} mm wide" in warning and "use elements of 1.5 mm there" in warning


@pytest.mark.parametrize("friction", ["stick", 0.5])
def test_what_sticks_is_told_the_same(friction):
    _, (warning,) = pressed(4e-3, HEX8P0, friction=friction)
    assert "takes some 17 % of the force away" in warning


def test_where_most_is_missing_there_is_no_figure():
    _, (warning,) = pressed(5e-3, HEX8P0, depth=3e-4)
    assert "takes most of the force away; use elements of 0.49 mm there" in warning


@pytest.mark.parametrize("tool", [ts.Tool("flat", radius=8e-3), ts.Tool("flat", radius=8e-3, edge_radius=1e-3)])
def test_nothing_is_said_of_a_flat_tool(tool):
    _, warnings = pressed(4e-3, HEX8P0, tool, "stick")
    assert warnings == []


def test_a_reduced_solid_says_it_of_the_whole_one(tmp_path, capsys):
    """Of the file of a mesh whose elements are too wide for the tool, whatever its own error is."""
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
    assert err == "" and "4 mm wide" in warning and "of the force away" in warning
    assert ts.load_reduced(tmp_path / "block.reduced.npz").report["warnings"] == [warning]
    assert main([*asked, "-o", str(tmp_path / "again.reduced.npz")]) == 0
    assert f"tissue-sim: warning: {warning}" in capsys.readouterr().err
