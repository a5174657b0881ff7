"""Shapes of specimens in space, and regions in their meshes, against closed forms and symmetry."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from scenes.cli import main
from tissue_sim.fem.solid.batches import ElementBatches
from tissue_sim.fem.solid.contact import ToolFrame
from tissue_sim.fem.solid.discretisation import build_mesh, make_solver
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import Grading, create_block_mesh_from_boundaries
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.pose import Pose

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
BLOCK = ts.Block(0.06, 0.03, 0.025)
SHELL = ts.EllipsoidShell(0.05, 0.04, 0.03, 0.012)
PLACES = {"block in the middle": (BLOCK, (0.0, 0.0)), "block near an edge": (BLOCK, (0.02, 0.0095)),
          "block near a corner": (BLOCK, (-0.0248, -0.0098)), "shell on its apex": (SHELL, (0.0, 0.0)),
          "shell far off it": (SHELL, (0.025, 0.015))}
CAMPAIGN = """
[[specimen]]
shape = "block"
length_mm = 30.0
width_mm = 20.0
height_mm = 15.0

[[test]]
kind = "lubricated_compression"
recordings = ["run.csv"]

[fit]
laws = ["neo_hooke"]

[noise]
force_N = 0.001
"""


def stepped(solver, *poses, **options):
    for pose in poses:
        step = solver.step(pose, **options)
        assert step.status is StepStatus.CONVERGED
    return step


@pytest.mark.slow
@pytest.mark.parametrize("element", [HEX8P0, HEX27P1], ids=["H8", "H27"])
@pytest.mark.parametrize("case", PLACES)
def test_mesh_is_closed_and_of_the_shape(case, element):
    specimen, centre = PLACES[case]
    mesh = specimen.solid_mesh(Grading(element, 1.5e-3, 1.8, 8e-3, 4, radius=5e-3, centre=centre))
    batches = ElementBatches(mesh)  # refuses what is turned inside out
    if specimen is BLOCK:
        volume, areas = BLOCK.area * BLOCK.height, {"top": BLOCK.area, "base": BLOCK.area,
                                                    "side": 2 * (BLOCK.length + BLOCK.width) * BLOCK.height}
    else:
        outer, inner = np.array(SHELL.semi_axes), np.array(SHELL.semi_axes) - SHELL.thickness
        volume, areas = 2 / 3 * np.pi * (outer.prod() - inner.prod()), {"side": np.pi * (
            outer[:2].prod() - inner[:2].prod())}
        above = mesh.nodes + np.array([0.0, 0.0, SHELL.semi_axis_z])
        for name, axes in (("top", outer), ("base", inner)):
            np.testing.assert_allclose((above[mesh.sets[name]] / axes) ** 2 @ np.ones(3), 1.0, atol=1e-12)
    # Straight edges on a curved surface lose some of it.
    loss = {True: 1e-12, False: 0.04 if element is HEX8P0 else 2e-3}[specimen is BLOCK]
    assert batches.volumes.sum() == pytest.approx(volume, rel=loss)
    for name, area in areas.items():
        assert mesh.compute_node_areas_of_named_faces(name).sum() \
            == pytest.approx(area, rel=max(loss, 0.03 * (specimen is SHELL)))
    # Two elements at most share a side, and the surface has no hole: its normals add up to nothing.
    corners = np.concatenate(list(mesh.faces.values()))[:, [0, element.order, -1, -element.order - 1]]
    a, b, c, d = np.moveaxis(mesh.nodes[corners], 1, 0)
    assert abs(np.cross(c - a, d - b).sum(axis=0)).max() < 1e-12
    # The circle under the needle.
    face = mesh.nodes[mesh.sets["face"], :2] - centre
    edge = mesh.nodes[np.intersect1d(mesh.sets["face"], mesh.sets["free"]), :2] - centre
    assert np.hypot(*face.T).max() <= 5e-3 * (1 + 1e-9) and len(edge) == 16 * element.order
    np.testing.assert_allclose(np.hypot(*edge.T), 5e-3, rtol=1e-9)


@pytest.mark.parametrize(("specimen", "place"), [(BLOCK, (0.026, 0.0)), (SHELL, (0.046, 0.0))])
def test_a_needle_that_reaches_beyond_is_refused(specimen, place):
    with pytest.raises(ts.InputError, match="must be inside the"):
        specimen.solid_mesh(Grading(HEX8P0, 1e-3, 1.8, 8e-3, 2, radius=5e-3, centre=place))
    with pytest.raises(ts.InputError, match=r"reaches beyond the specimen, (length 60|semi axis x 50) mm"):
        ts.KINDS["needle_indentation"].experiment(
            specimen=specimen, protocol=ts.Protocol.ramp(1e-3), tool=ts.Tool("flat", 5e-3),
            approach=ts.Approach(offset=place[0]))


@pytest.mark.slow
def test_a_block_between_plates_without_friction_is_the_closed_form():
    experiment = ts.KINDS["lubricated_compression"].experiment(specimen=BLOCK, protocol=ts.Protocol.ramp(3e-3, 2))
    line = np.linspace(-0.5, 0.5, 3)
    mesh = create_block_mesh_from_boundaries(BLOCK.length * line, BLOCK.width * line, BLOCK.height * (line - 0.5),
                                             HEX27P1)
    recording = ts.simulate(ts.Model(experiment, MATERIAL), mesh=mesh, solver="solid")
    stress = MATERIAL.energy_law.nominal_stress(1.0 - 3e-3 / BLOCK.height, MATERIAL.parameters)
    assert recording.force[-1] == pytest.approx(-stress * BLOCK.area, rel=2e-4)


def ball_on_shell(offset, depth=1e-3):
    """Steps of a ball on a spherical shell, off its apex along x."""
    specimen, ball = ts.EllipsoidShell(0.05, 0.05, 0.05, 0.015), ts.Tool("sphere", 0.01)
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=specimen, protocol=ts.Protocol.ramp(depth, 2), tool=ball, friction="frictionless",
        approach=ts.Approach(offset))
    mesh = specimen.solid_mesh(Grading(HEX27P1, 3e-3, 2.2, 20e-3, 2, radius=4e-3, centre=(offset, 0.0)))
    soft = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 50.0))
    solver = make_solver(ts.Model(experiment, soft), mesh=mesh)
    return solver, stepped(solver, experiment.tool_pose(0.0), experiment.tool_pose(depth))


@pytest.mark.slow
def test_a_ball_off_the_apex_is_pushed_along_the_line_of_centres():
    """The contact is at the contact of the spheres; without friction the force passes through both centres."""
    offset, outer, ball, depth = 0.02, 0.05, 0.01, 1e-3
    solver, step = ball_on_shell(offset)
    apart = math.sqrt((outer + ball) ** 2 - offset**2)
    # Nodes stand apart from the place where the spheres touch.
    assert solver.datum == pytest.approx(apart - outer - ball, abs=5e-5)
    (fx, fy, fz), (tx, ty, tz) = step.wrench[:3], step.wrench[3:]
    slopes = offset / apart, offset / (apart - depth)
    assert 0.97 * slopes[0] < fx / fz < 1.03 * slopes[1] and abs(fy) < 1e-9 * fz
    # About the deepest point, a radius below the ball's centre.
    assert ty == pytest.approx(ball * fx, rel=0.01) and max(abs(tx), abs(tz)) < 1e-9 * fz


@pytest.mark.slow
def test_a_shell_that_moves_as_a_whole_feels_nothing():
    mesh = SHELL.solid_mesh(Grading(HEX27P1, 6e-3, 2.2, 20e-3, 2, radius=6e-3, centre=(0.01, 0.0)))
    solver = SolidSolver(mesh, MATERIAL, {}, np.union1d(mesh.sets["top"], mesh.sets["base"]), start=Pose.at_depth(0.0))
    turn = Pose((2e-3, -1e-3, 3e-3), (math.cos(0.1), 0.6 * math.sin(0.1), 0.8 * math.sin(0.1), 0.0))
    # Relative to a load of zero, the residual of the equilibrium is rounding.
    step = stepped(solver, turn, tolerance=1e-5)
    assert np.abs(step.wrench).max() < 1e-9
    frame = ToolFrame(turn, 0.0)
    np.testing.assert_allclose(mesh.nodes + solver.x.reshape(-1, 3), frame.transform_to_mesh(mesh.nodes), atol=1e-10)


@pytest.mark.parametrize(("changes", "field", "words"), [
    ({"friction_base": "frictionless"}, "friction_base", "must be 'bonded' below an ellipsoid shell"),
    ({"tool": ts.Tool("plate"), "friction": "bonded"}, "friction",
     "must not be 'bonded' for a plate on the curved top")])
def test_what_a_curved_surface_cannot_be(changes, field, words):
    stated = {"tool": ts.Tool("round", 4e-3), "friction": "stick", "friction_base": "bonded"} | changes
    experiment = ts.Experiment(SHELL, ts.Protocol.ramp(1e-3), **stated)
    with pytest.raises(ts.InputError, match=words) as error:
        make_solver(ts.Model(experiment, MATERIAL))
    assert error.value.field == field
    with pytest.raises(ts.InputError, match="leaves no core"):
        replace(SHELL, thickness=0.03)


class TestRegions:
    PARTS = {"left": ts.Material("neo_hooke", {"C10": 3000.0}, ts.Bulk("bulk_ratio", 1e4)),
             "right": ts.Material("ogden_1", {"mu1": 2000.0, "alpha1": 8.0}, ts.Bulk("bulk_ratio", 1e4),
                                  viscoelastic=ts.Prony((ts.PronyTerm(0.4, 2.0),)))}

    def mesh(self):
        """Halves of a block, of seven elements and five, so that lanes are left over."""
        mesh = create_block_mesh_from_boundaries(np.array([-0.02, -0.01, 0.0, 0.02]), np.array([-0.01, 0.01]),
                                                 np.array([-0.02, -0.01, 0.0]),
                                                 HEX27P1)
        x = mesh.nodes[mesh.connectivity, 0].mean(axis=1)
        return replace(mesh, regions={"left": np.flatnonzero(x < 0), "right": np.flatnonzero(x > 0)})

    def model(self, regions, law=MATERIAL):
        experiment = ts.KINDS["lubricated_compression"].experiment(
            specimen=ts.Block(0.04, 0.02, 0.02), protocol=ts.Protocol.parse("ramp 3mm @1mm/s; hold 300s", 3))
        return ts.Model(experiment, replace(law, regions=regions))

    @pytest.mark.slow
    def test_side_by_side_they_add_up(self):
        """Both are incompressible and widen alike; each carries what its own law says, and the right one relaxes."""
        found = ts.simulate(self.model(self.PARTS), solver="solid", mesh=self.mesh()).force
        stretch, half = 1.0 - 3e-3 / 0.02, 0.02 * 0.02
        left, right = (-half * part.energy_law.nominal_stress(stretch, part.parameters) for part in self.PARTS.values())
        assert found[-1] == pytest.approx(left + 0.6 * right, rel=1e-3)
        assert left + 0.6 * right < found[2] < left + right

    def test_the_same_material_everywhere_is_no_region(self):
        mesh = self.mesh()
        alike = dict.fromkeys(mesh.regions, MATERIAL)
        found = ts.simulate(self.model(alike), solver="solid", mesh=mesh).force
        whole = ts.simulate(self.model({}), solver="solid", mesh=replace(mesh, regions={})).force
        np.testing.assert_allclose(found, whole, rtol=1e-9, atol=1e-9)

    def test_their_numbers_are_parameters(self):
        model = ts.with_values(self.model(self.PARTS), {"material.regions.left.C10": 500.0})
        assert model.material.regions["left"].parameters["C10"] == 500.0
        assert model.material.regions["right"] == self.PARTS["right"]

    def test_what_they_cannot_be(self):
        mesh = self.mesh()
        with pytest.raises(ts.InputError, match="the mesh has no region 'lift'; did you mean 'left'"):
            make_solver(self.model({"lift": MATERIAL}), mesh=mesh)
        twice = replace(mesh, regions={"left": np.arange(4), "right": np.arange(3, 6)})
        with pytest.raises(ts.InputError, match="must contain each element in at most one region"):
            make_solver(self.model(self.PARTS), mesh=twice)
        with pytest.raises(ts.InputError, match="a region has no layers"):
            replace(MATERIAL, regions={"left": replace(MATERIAL, layers=(ts.Layer(1e-3, 2.0),))})
        cylinder = replace(self.model(self.PARTS).experiment, specimen=ts.Specimen(0.02, 0.02))
        with pytest.raises(ts.InputError, match=r"must be empty for an axisymmetric solid.*--solid"):
            ts.simulate(ts.Model(cylinder, replace(MATERIAL, regions=self.PARTS)))


@pytest.mark.slow
def test_a_block_by_flags(tmp_path, capsys):
    path = tmp_path / "m.material.json"
    ts.write_material_file(ts.MaterialFile.of(MATERIAL), path)
    words = ["simulate", "lubricated_compression", "--solid", "--shape", "block", "--length-mm", "30", "--width-mm",
             "20", "--height-mm", "15", "--depth-mm", "1", "--points", "2", "--json", "--material", str(path)]
    assert main(words) == 0
    force = json.loads(capsys.readouterr().out)["force_N"][-1]
    stress = MATERIAL.energy_law.nominal_stress(14 / 15, MATERIAL.parameters)
    assert force == pytest.approx(-stress * 0.03 * 0.02, rel=2e-4)
    assert main([*words[:7], *words[9:]]) == 2
    assert "--width-mm: a block needs a width" in capsys.readouterr().err
    assert main([word for word in words if word != "--solid"]) == 2
    assert "the axisymmetric solver requires a cylinder; the specimen is a block" in capsys.readouterr().err


def test_a_block_in_a_campaign(tmp_path):
    """Its closed forms are those of its cross-section; an inverse fit simulates it in space."""
    depth = np.linspace(0.0, 3e-3, 40)
    force = 0.03 * 0.02 * 2 * 1500.0 * ((1 - depth / 0.015) ** -2 - (1 - depth / 0.015))
    rows = "\n".join(f"{1e3 * d:.9g},{f:.9g}" for d, f in zip(depth, force, strict=True))
    (tmp_path / "run.csv").write_text(f"displacement [mm],force [N]\n{rows}\n", encoding="utf-8")
    path = tmp_path / "study.toml"
    path.write_text(CAMPAIGN, encoding="utf-8")
    assert calibration.load_campaign(path).tests[0].specimen == ts.Block(0.03, 0.02, 0.015)
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert result.best.parameters["C10"] == pytest.approx(1500.0, rel=1e-3)
    for old, new, words in (
            ("width_mm = 20.0\n", "", r"specimen\[0\]\.width_mm: a block requires width_mm"),
            ("width_mm = 20.0", "width_mm = 20.0\nradius_mm = 3.0", "a block has length_mm, not radius_mm")):
        path.write_text(CAMPAIGN.replace(old, new), encoding="utf-8")
        with pytest.raises(ts.InputError, match=words):
            calibration.load_campaign(path)
    path.write_text(CAMPAIGN.replace("[fit]", '[fit]\nmethod = "inverse_fem"'), encoding="utf-8")
    assert calibration.load_campaign(path).tests[0].solver == "solid"


@pytest.mark.slow
def test_meshes_of_all_resolutions():
    """A needle on each of them, and plates."""
    for specimen in (BLOCK, SHELL, ts.Specimen(0.03, 0.03)):
        for tool in (ts.Tool("flat", 3e-3), ts.Tool()):
            experiment = ts.Experiment(specimen, ts.Protocol.ramp(1e-3), tool=tool, friction="stick",
                                       friction_base="bonded")
            for resolution in ("realtime", "fast"):
                mesh = build_mesh(experiment, resolution)
                assert (ElementBatches(mesh).weights > 0.0).all() and 3 * len(mesh.nodes) < 40_000


@pytest.mark.slow
@pytest.mark.parametrize(("face", "base"), [(0.3, 0.3), ("frictionless", 0.3), (1.0, 1.0)])
def test_plates_with_friction_on_both_sides(face, base):
    """Where nothing presses yet nothing holds the specimen either. The axisymmetric solver is the other; the section of
    these 16 sides is 2.6 % too small."""
    material = ts.Material("reduced_polynomial_2", {"C10": 400.0, "C20": 300.0}, ts.Bulk("bulk_ratio", 1e3))
    experiment = ts.Experiment(ts.Specimen(0.01, 0.015), ts.Protocol.ramp(1.5e-3, 4), friction=face, friction_base=base)
    model = ts.Model(experiment, material)
    force = ts.simulate(model, solver="solid", resolution="realtime").force
    exact = ts.simulate(model, estimate_error=False).force
    np.testing.assert_allclose(force[1:], 0.985 * exact[1:], rtol=0.015)


def test_what_nothing_holds_is_refused_off_its_middle():
    """A base without a node on the axis."""
    mesh = create_block_mesh_from_boundaries(np.linspace(-0.01, 0.01, 4), np.linspace(-0.01, 0.01, 4),
                                             np.linspace(-0.01, 0.0, 4), HEX8P0)
    experiment = ts.Experiment(ts.Block(0.02, 0.02, 0.01), ts.Protocol.ramp(1e-3, 2), friction=0.3, friction_base=0.3)
    with pytest.raises(ts.InputError, match=r"both slip, .*nothing carries the side force\. Use 'stick' for one"):
        make_solver(ts.Model(experiment, ts.Material("neo_hooke", {"C10": 400.0})), mesh=mesh)
