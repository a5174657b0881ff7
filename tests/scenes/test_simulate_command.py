"""`tissue-sim simulate`: JSON, files, figures, and a solver that does not converge."""

import json
from pathlib import Path

import numpy as np
import pytest

import tissue_sim as ts
from scenes.cli import main
from scenes.commands.material.summary import list_warnings_if_test_leaves_range
from scenes.field_labels import LABELS
from tissue_sim.errors import ConvergenceError

KEYS = {"displacement_mm", "time_s", "force_N", "status", "message", "warnings", "newton_iterations", "wall_s", "mesh",
        "resolution"}


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    path = tmp_path_factory.mktemp("material") / "m.material.json"
    assert main(["material", "new", "--law", "reduced_polynomial_2", "--set", "C10=1404.9", "--set", "C20=699.4",
                 "--bulk-ratio", "10000", "-o", str(path)]) == 0
    return str(path)


def test_field_names_are_those_of_the_fields():
    from tissue_sim.fem.elements.fields import FIELD_UNITS

    assert set(LABELS) == set(FIELD_UNITS)


def test_json_is_the_only_output_and_correct(material, capsys):
    """Bonded compression agrees with an independent reference curve: 1.5417 and 4.1035 N at 2 and 5 mm."""
    capsys.readouterr()
    assert main(["simulate", "bonded_compression", "--material", material, "--depth-mm", "5", "--points", "6",
                 "--json"]) == 0
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert err == "" and set(answer) == KEYS | {"penetration_mm", "penetration_tolerance_mm", "force_error"}
    np.testing.assert_allclose(answer["displacement_mm"], range(6), atol=1e-12)
    np.testing.assert_allclose(answer["time_s"], np.arange(6) / 0.248)
    assert answer["force_N"][2] == pytest.approx(1.5417, rel=0.01)
    assert answer["force_N"][5] == pytest.approx(4.1035, rel=0.01)
    assert answer["status"] == "converged" and answer["resolution"] == "fast"
    assert set(answer["mesh"]) == {"elements", "freedoms"} and answer["newton_iterations"] > 0


@pytest.mark.slow
def test_a_needle_off_the_axis_is_simulated_in_space(material, tmp_path, capsys):
    curve = tmp_path / "curve.csv"
    words = ["simulate", "needle_indentation", "--material", material, "--depth-mm", "1", "--points", "5",
             "--offset-mm", "15"]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "must be None for an axisymmetric solid" in error and "Use the solver \"solid\" (--solid)" in error
    assert main([*words, "--solid", "--json", "-o", str(curve)]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert set(answer) >= KEYS | {"force_vector_N", "torque_vector_Nm"}
    forces = np.array(answer["force_vector_N"])
    np.testing.assert_allclose(forces[:, 2], answer["force_N"])
    # 0.1794 N on the axis; nearer to the side it is softer.
    assert 0.9 * 0.1794 < forces[-1, 2] < 0.1794 and np.array(answer["torque_vector_Nm"]).shape == (5, 3)
    written = ts.read_recording(curve)
    assert written.metadata["approach"] == {"offset_mm": 15.0, "tilt_deg": 0.0}
    np.testing.assert_allclose(written.channel("Fx"), forces[:, 0], atol=1e-9)


def test_writes_a_recording_and_a_figure(material, tmp_path, capsys):
    curve, figure = tmp_path / "curve.csv", tmp_path / "f.png"
    words = ["simulate", "lubricated_compression", "--material", material, "--depth-mm", "2", "--points", "5",
             "-o", str(curve), "--figure", str(figure)]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "displacement [mm]" in text and "2.000" in text and f"wrote {curve}" in text and f"wrote {figure}" in text
    recording = ts.read_recording(curve)
    assert recording.metadata["kind"] == "lubricated_compression" and recording.metadata["tool"] == {"shape": "plate"}
    assert recording.metadata["specimen"] == {"shape": "cylinder", "radius_mm": 40.0, "height_mm": 70.0}
    # Closed form of the incompressible cylinder at 2 mm; K/mu0 = 1e4 lowers it by less than 1e-4.
    assert recording.force[-1] == pytest.approx(1.24965, rel=2e-4)
    assert figure.read_bytes().startswith(b"\x89PNG")
    before = curve.read_bytes()
    assert main(words) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    assert curve.read_bytes() == before, "equal input gives equal output"


@pytest.mark.parametrize(("words", "expected"), [
    (["--depth-mm", "70"], "deeper than the specimen is high"),
    (["-o", "curve.csv", "--points", "4"], "needs at least 5 samples; got 4"),
    (["--points", "100001"], "must be at most 100000; got '100001'"),
    (["-o", "curve.txt"], "must end in .csv"),
    (["--figure", "f.bmp"], "must end in .png"),
    (["-o", "."], "must be a file; got a directory"),
])
def test_bad_input_writes_nothing(material, words, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "bonded_compression", "--material", material, *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and expected in err and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_json_file_of_the_same_name_is_kept(material, tmp_path, capsys):
    """The sidecar of m.csv would be m.json, which may be the material itself."""
    mine = tmp_path / "m.json"
    mine.write_bytes(Path(material).read_bytes())
    words = ["simulate", "lubricated_compression", "--material", str(mine), "--points", "5",
             "-o", str(tmp_path / "m.csv")]
    assert main(words) == 2
    assert "m.json: -o: exists already" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 2
    assert "is not the sidecar of a recording" in capsys.readouterr().err
    assert mine.read_bytes() == Path(material).read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["m.json"]


@pytest.fixture
def gives_up(monkeypatch):
    """Solver that stops after half of the protocol."""
    def simulate(model, **options):
        protocol = model.experiment.protocol
        half = ts.Recording({"time": protocol.time[:6], "displacement": protocol.displacement[:6],
                             "force": np.arange(6.0)})
        raise ConvergenceError("no convergence beyond 5 mm", recording=half, depth=5e-3)

    monkeypatch.setattr(ts, "simulate", simulate, raising=False)


def test_partial_curve_is_kept(material, gives_up, tmp_path, capsys):
    curve = tmp_path / "curve.csv"
    assert main(["simulate", "bonded_compression", "--material", material, "--points", "11", "-o", str(curve)]) == 1
    err = capsys.readouterr().err
    assert err == f"tissue-sim: no convergence beyond 5 mm; the curve up to this point is in {curve}\n"
    np.testing.assert_allclose(ts.read_recording(curve).force, np.arange(6.0))


def test_partial_curve_in_json(material, gives_up, capsys):
    capsys.readouterr()
    assert main(["simulate", "bonded_compression", "--material", material, "--points", "11", "--json"]) == 1
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert set(answer) == KEYS and answer["status"] != "converged"
    assert answer["message"] == "no convergence beyond 5 mm" and answer["force_N"] == [0, 1, 2, 3, 4, 5]
    assert err.count("\n") == 1


def test_the_bulging_specimen_touches_the_plates(material, capsys):
    """An independent solution with this contact has 31.96 N at 21 mm; without it the force is 6 % smaller."""
    words = ["simulate", "bonded_compression", "--material", material, "--depth-mm", "21", "--points", "22", "--json"]
    assert main(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["force_N"][-1] == pytest.approx(31.96, rel=0.01) and answer["warnings"] == []


@pytest.mark.slow
def test_a_large_force_error_gives_a_warning_in_both_outputs(tmp_path, capsys):
    ts.write_material_file(ts.MaterialFile.of(ts.Material("neo_hooke", {"C10": 13989.0}, ts.Bulk("bulk_ratio", 740.0))),
                           tmp_path / "m.material.json")
    words = ["simulate", "needle_indentation", "--material", str(tmp_path / "m.material.json"), "--radius-mm", "37.9",
             "--height-mm", "10.5", "--tool", "flat", "--tool-radius-mm", "1.968", "--edge-radius-mm", "0.984",
             "--friction", "stick", "--friction-wall", "0.3", "--depth-mm", "2.7315", "--points", "16"]
    assert main([*words, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    warning, = answer["warnings"]
    assert warning.startswith("the force may err by about ") and answer["force_error"] > 0.03
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert err == f"tissue-sim: warning: {warning}\n"
    assert "of the largest force, from a comparison" in " ".join(out.split())
    assert main([*words, "--json", "--no-force-error"]) == 0
    without = json.loads(capsys.readouterr().out)
    assert "force_error" not in without and without["warnings"] == [] and without["force_N"] == answer["force_N"]


def test_leaving_the_valid_and_stable_range_gives_warnings(tmp_path, capsys):
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": -100.0}, ts.Bulk("bulk_ratio", 1e4))
    ts.write_material_file(ts.MaterialFile.of(material, valid_range={"stretch": (0.9, 1.0)}),
                           tmp_path / "m.material.json")
    main(["simulate", "lubricated_compression", "--material", str(tmp_path / "m.material.json"), "--depth-mm", "28"])
    err = capsys.readouterr().err
    assert "fitted to stretches from 0.9 to 1 only" in err and "unstable within the mean stretches" in err


@pytest.mark.parametrize(("kind", "text", "low", "high"), [
    ("uniaxial_tension", "ramp 1mm; retract 4mm", 0.8, 1.05), ("simple_shear", "ramp 1mm; retract 4mm", 0.905, 1.105),
    ("bonded_compression", "ramp 1mm; retract 4mm", 0.95, 1.2),
    ("friction_compression", "ramp 1mm; retract 4mm", 0.95, 1.0),
    ("bonded_compression", "approach 4mm; ramp 1mm", 0.95, 1.0)])
def test_both_directions_of_a_motion_are_compared_with_the_valid_range(kind, text, low, high):
    """The stretches of a mean deformation: 1 + d/h in tension; of shear by 0.2 sqrt(1.01) -+ 0.1."""
    material = ts.Material("neo_hooke", {"C10": 1e3}, ts.Bulk("bulk_ratio", 1e3))
    protocol = ts.Protocol.parse(text, points=3)
    needed = {"friction": 0.5} if kind == "friction_compression" else {}
    experiment = ts.KINDS[kind].experiment(specimen=ts.Block(0.02, 0.02, 0.02), protocol=protocol, **needed)
    recording = ts.Recording({"displacement": protocol.displacement, "force": 0.0 * protocol.displacement})

    def warn(*valid):
        file = ts.MaterialFile.of(material, valid_range={"stretch": valid})
        return list_warnings_if_test_leaves_range(file, recording, experiment)

    assert warn(low, high) == []
    if low < 1.0:
        assert f"stretches of the tissue are {low:.3g} to {high:.3g}, but" in warn(low + 0.02, high)[0]
    if high > 1.0:
        assert f"stretches of the tissue are {low:.3g} to {high:.3g}, but" in warn(low, high - 0.02)[0]


def test_confined_compression_compares_isochoric_stretches(tmp_path, capsys):
    """A fit to confined compression to a stretch of 0.9 is valid from 0.9^(2/3) = 0.932 to 0.9^(-1/3) = 1.036."""
    material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 8.0))
    ts.write_material_file(ts.MaterialFile.of(material, valid_range={"stretch": (0.932, 1.036)}),
                           tmp_path / "m.material.json")
    words = ["simulate", "confined_compression", "--material", str(tmp_path / "m.material.json"), "--radius-mm", "10",
             "--height-mm", "10", "--points", "5", "--json", "--depth-mm"]
    assert main([*words, "1"]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == []
    assert main([*words, "2"]) == 0
    warning, = json.loads(capsys.readouterr().out)["warnings"]
    # 0.8^(2/3) and 0.8^(-1/3).
    assert warning.startswith("the stretches of the tissue are 0.862 to 1.08, but the material was fitted")


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_the_fitted_test_is_in_the_valid_range(tmp_path, capsys):
    """A thin needle stretches only a small part of a large specimen; the mean stretch would be misleading."""
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(5e-3, 9), tool=ts.Tool("sphere", radius=4e-3),
        friction="frictionless")
    material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e4))
    ts.write_recording(ts.simulate(ts.Model(experiment, material)), tmp_path / "needle.csv")
    (tmp_path / "c.toml").write_text("""
[[specimen]]
radius_mm = 40.0
height_mm = 70.0
[[test]]
kind = "needle_indentation"
recordings = ["needle.csv"]
tool = "sphere"
tool_radius_mm = 4.0
friction = "frictionless"
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 10000.0
starts = 1
[noise]
force_N = 0.001
contact_jitter_mm = 0.0
zero_jitter_N = 0.0
""", encoding="utf-8")
    assert main(["calibrate", str(tmp_path / "c.toml"), "-o", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    words = ["simulate", "needle_indentation", "--material", str(tmp_path / "out" / "neo_hooke.material.json"),
             "--tool", "sphere", "--tool-radius-mm", "4", "--friction", "frictionless", "--points", "9", "--json",
             "--depth-mm"]
    assert main([*words, "5"]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == []
    assert main([*words, "9"]) == 0
    warning, = json.loads(capsys.readouterr().out)["warnings"]
    assert warning.startswith("the stretches of the tissue are") and "fitted to stretches from" in warning


def test_small_forces_keep_their_digits(material, capsys):
    assert main(["simulate", "lubricated_compression", "--material", material, "--radius-mm", "0.5", "--height-mm", "1",
                 "--depth-mm", "0.1", "--points", "3"]) == 0
    out = capsys.readouterr().out
    assert "force [mN]" in out and "-0.0000" not in out
    # Closed form: 0.7854 mm2 x nominal stress at stretch 0.9.
    stress = ts.find_law("reduced_polynomial_2").nominal_stress(0.9, [1404.9, 699.4])
    assert f"{-stress * 0.7854e-6 * 1e3:.2f}"[:4] in out


def test_field_without_figure_is_refused(material, capsys):
    assert main(["simulate", "lubricated_compression", "--material", material, "--field", "J"]) == 2
    assert "Add --figure" in capsys.readouterr().err


def simulate_json(capsys, material, *words) -> dict:
    capsys.readouterr()
    assert main(["simulate", *words, "--material", material, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_needle(material, capsys):
    """The independent reference: 0.3601, 0.9363 and 2.078 N at 2, 5 and 10 mm; `fast` within 1 %."""
    answer = simulate_json(capsys, material, "needle_indentation", "--points", "11")
    assert set(answer) == KEYS | {"penetration_mm", "penetration_tolerance_mm", "force_error"}
    np.testing.assert_allclose(np.array(answer["force_N"])[[2, 5, 10]], [0.3601, 0.9363, 2.078], rtol=0.01)
    assert 0 <= answer["penetration_mm"] <= answer["penetration_tolerance_mm"] < 0.01


def test_needle_flags(material, capsys):
    words = ["needle_indentation", "--depth-mm", "4", "--points", "3"]
    forces = [simulate_json(capsys, material, *words, *more)["force_N"][-1] for more in (
        [], ["--tool-radius-mm", "4"], ["--tool", "flat", "--edge-radius-mm", "1", "--friction", "frictionless"],
        ["--friction-base", "frictionless"])]
    # A punch of half the radius on a half space meets half the force; the cylinder is not quite one.
    assert forces[1] == pytest.approx(0.5 * forces[0], rel=0.15)
    assert forces[2] < 0.97 * forces[0] and forces[3] < forces[0]


def test_flags_reach_the_experiment_in_si_units(material, monkeypatch):
    """Every flag of tool, contact and tilt arrives in the model that the solver receives."""
    seen = []

    def record_model(model, **options):
        seen.append(model.experiment)
        raise ConvergenceError("seen")

    monkeypatch.setattr(ts, "simulate", record_model, raising=False)
    words = ["simulate", "needle_indentation", "--material", material, "--tool", "cone", "--tool-radius-mm", "6",
             "--half-angle-deg", "30", "--tip-radius-mm", "0.5", "--friction", "0.7", "--friction-base", "stick",
             "--friction-wall", "0.2", "--adhesion-N", "0.05", "--adhesion-length-mm", "0.4", "--tilt-mm", "0.3"]
    assert main(words) == 1
    (experiment,) = seen
    tool = experiment.tool
    assert (tool.shape, tool.radius, tool.tip_radius) == ("cone", pytest.approx(0.006), pytest.approx(0.0005))
    assert tool.half_angle == pytest.approx(np.pi / 6)
    assert (experiment.friction, experiment.friction_base, experiment.friction_wall) == (0.7, "stick", 0.2)
    assert (experiment.adhesion.force, experiment.adhesion.length) == (0.05, pytest.approx(0.0004))
    assert experiment.tilt == pytest.approx(0.0003) and experiment.slip is None
    assert main(["simulate", "bonded_compression", "--material", material, "--slip", "0.2"]) == 1
    assert seen[-1].slip == 0.2


@pytest.mark.slow
def test_profile_of_a_file(material, tmp_path, capsys):
    """A profile of 40 lines along a flat needle of 8 mm with an edge radius of 1 mm gives the force of this needle."""
    angle = np.linspace(0, np.pi / 2, 40)
    outline = [(0.0, 0.0), *zip(7 + np.sin(angle), 1 - np.cos(angle), strict=True), (8.0, 60.0)]
    path = tmp_path / "tool.csv"
    path.write_text("r [mm],z [mm]\n" + "".join(f"{r:.6f},{z:.6f}\n" for r, z in outline), encoding="utf-8")
    words = ["needle_indentation", "--depth-mm", "4", "--points", "5", "--friction", "0.7", "--resolution", "accurate"]
    drawn = simulate_json(capsys, material, *words, "--tool", str(path))["force_N"]
    assert drawn == pytest.approx(simulate_json(capsys, material, *words, "--edge-radius-mm", "1")["force_N"], rel=5e-3)


def test_pointed_needles_press_less(material, capsys):
    """Sneddon: at equal depth a cone and a sphere have smaller contact areas and forces than a flat face."""
    words = ["needle_indentation", "--depth-mm", "2", "--points", "3", "--friction", "0.7"]
    flat, sphere, cone = (simulate_json(capsys, material, *words, *tool)["force_N"][-1] for tool in (
        ["--edge-radius-mm", "0.25"], ["--tool", "sphere"],
        ["--tool", "cone", "--half-angle-deg", "60", "--tip-radius-mm", "0.5"]))
    assert 0 < cone < sphere < flat


def test_self_weight(material, capsys):
    """One-dimensional solution of a lubricated column: sag 2.780 mm, 1.3979 and 3.7793 N at 2 and 5 mm.

    This solution neglects the shear between layers that widen differently.
    """
    words = ["lubricated_compression", "--depth-mm", "5", "--points", "6", "--gravity", "--density-kg-m3", "1040"]
    answer = simulate_json(capsys, material, *words)
    assert answer["self_weight"]["sag_mm"] == pytest.approx(2.780, rel=5e-3)
    np.testing.assert_allclose([answer["force_N"][2], answer["force_N"][5]], [1.3979, 3.7793], rtol=1e-3)
    placed = simulate_json(capsys, material, *words, "--height-is", "placed")["self_weight"]
    assert placed["height_is"] == "placed" and placed["moulded_height_mm"] == pytest.approx(70 + placed["sag_mm"])


def test_density_is_that_of_the_material_file(material, tmp_path, capsys):
    path = tmp_path / "dense.material.json"
    content = json.loads(Path(material).read_text(encoding="utf-8")) | {"density_kg_m3": 1000.0}
    path.write_text(json.dumps(content), encoding="utf-8")
    words = ["needle_indentation", "--depth-mm", "1", "--points", "2", "--gravity"]
    assert simulate_json(capsys, str(path), *words)["self_weight"]["density_kg_m3"] == 1000
    own = simulate_json(capsys, str(path), *words, "--density-kg-m3", "1100")
    assert own["self_weight"]["density_kg_m3"] == 1100


def test_contact_and_self_weight_are_printed(material, capsys):
    assert main(["simulate", "needle_indentation", "--material", material, "--depth-mm", "1", "--points", "2",
                 "--gravity", "--density-kg-m3", "1040"]) == 0
    out = capsys.readouterr().out
    assert "largest penetration of tool and tissue: " in out and "(tolerance 0.0008 mm)" in out
    assert "self-weight: the specimen settles by 2." in out and "density 1040 kg/m3, g 9.81 m/s2" in out


@pytest.mark.parametrize(("words", "expected"), [
    (["bonded_compression", "--tool", "flat"],
     "--tool: the scene bonded_compression does not allow the tool 'flat'. Use the scene needle_indentation"),
    (["needle_indentation", "--tool", "plate"], "Use the scene lubricated_compression or bonded_compression"),
    (["needle_indentation", "--tool", "wedge"], "'wedge'"),
    (["bonded_compression", "--tool-radius-mm", "8"], "a plate covers the whole top face and has no radius"),
    (["bonded_compression", "--edge-radius-mm", "1"], "a plate covers the whole top face and has no radius"),
    (["bonded_compression", "--friction-wall", "stick"], "friction_wall: requires a tool with a shaft; got a plate"),
    (["needle_indentation", "--friction", "frictionless"], "tissue slides around the sharp edge"),
    (["needle_indentation", "--friction-wall", "bonded"], "Use 'stick', 'frictionless'"),
    (["needle_indentation", "--edge-radius-mm", "8"], "must be 0 or more and less than the radius"),
    (["needle_indentation", "--tool-radius-mm", "40"], "must be smaller than the specimen's"),
    (["needle_indentation", "--adhesion-N", "0.1"],
     "--adhesion-N: adhesion requires --adhesion-N and --adhesion-length-mm"),
    (["needle_indentation", "--adhesion-length-mm", "1"],
     "--adhesion-length-mm: adhesion requires --adhesion-N and --adhesion-length-mm"),
    (["needle_indentation", "--gravity"], "states none. Add --density-kg-m3"),
    (["needle_indentation", "--density-kg-m3", "1040"], "--density-kg-m3: has an effect only with --gravity"),
    (["needle_indentation", "--height-is", "placed"], "--height-is: has an effect only with --gravity"),
])
def test_contradictory_flags_are_refused(material, words, expected, capsys):
    capsys.readouterr()
    assert main(["simulate", *words, "--material", material]) == 2
    out, err = capsys.readouterr()
    assert out == "" and expected in err and err.count("\n") == 1


@pytest.fixture(scope="module")
def elastic(tmp_path_factory):
    path = tmp_path_factory.mktemp("elastic") / "elastic.material.json"
    assert main(["material", "new", "--law", "neo_hooke", "--set", "C10=1000", "--bulk-ratio", "1000",
                 "-o", str(path)]) == 0
    return str(path)


class TestGrips:
    def test_tension_reports_the_grip_factor(self, elastic, tmp_path, capsys):
        curve, figure = tmp_path / "pull.csv", tmp_path / "pull.png"
        code = main(["simulate", "uniaxial_tension", "--material", elastic, "--radius-mm", "10", "--height-mm", "20",
                     "--protocol", "ramp 10mm", "--points", "5", "-o", str(curve), "--figure", str(figure)])
        out = capsys.readouterr().out.replace("\n", " ")
        assert code == 0 and "ends of the specimen: bonded to rigid grips" in out
        assert "load over that of the closed form: 1.1" in out and "estimated force error" in out
        written = ts.read_recording(curve)
        assert written.metadata["kind"] == "uniaxial_tension" and "tool" not in written.metadata
        assert written.force[-1] > 0 and figure.stat().st_size > 1000

    def test_torsion_has_angle_and_torque(self, elastic, capsys):
        code = main(["simulate", "torsion", "--solid", "--material", elastic, "--radius-mm", "10", "--height-mm", "10",
                     "--protocol", "ramp 20deg @1deg/s", "--points", "2", "--json"])
        answer = json.loads(capsys.readouterr().out)
        assert code == 0 and answer["angle_deg"] == pytest.approx([0.0, 20.0])
        # M = pi psi a^4 C10 for C01 = 0.
        assert answer["torque_Nm"][1] == pytest.approx(np.pi * np.radians(20.0) / 0.010 * 1e-8 * 1000.0, rel=0.005)
        assert answer["grip_factor"][0] is None and answer["grip_factor"][1] == pytest.approx(1.0, abs=0.005)
        assert "force_N" not in answer

    @pytest.mark.parametrize(("words", "expected"), [
        (["simulate", "simple_shear", "--depth-mm", "2"], "grip: must move along the axis for an axisymmetric solid"),
        (["simulate", "torsion", "--solid"], "--protocol: is required for torsion. State an angle, such as"),
        (["simulate", "torsion", "--solid", "--protocol", "ramp 2mm"], "must prescribe the motion of the grip; got"),
        (["simulate", "torsion", "--solid", "--protocol", "ramp 9deg @1deg/s", "--noise-N", "0.1"],
         "rig: must be ideal for angle and torque"),
        (["simulate", "uniaxial_tension", "--friction", "0.3"], "--friction: does not apply to uniaxial_tension"),
        (["simulate", "uniaxial_tension", "--gravity"], "--gravity: does not apply to uniaxial_tension"),
        (["simulate", "uniaxial_tension", "--density-kg-m3", "9"], "--density-kg-m3: does not apply to uniaxial"),
        (["simulate", "uniaxial_tension", "--height-is", "placed"], "--height-is: does not apply to uniaxial_tension"),
        (["simulate", "torsion", "--solid", "--protocol", "ramp 9deg @1deg/s", "--speed-mm-s", "2"],
         "--speed-mm-s: does not apply to a protocol of angles. State the angular speed in --protocol"),
        (["simulate", "torsion", "--solid", "--protocol", "ramp 0.1rad"],
         "needs an angular speed, such as ramp 30deg @1deg/s; for example 'ramp 30deg @1deg/s; hold 60s; unload'"),
        (["simulate", "planar_tension", "--solid"], "specimen: must be a block in planar tension; got"),
        (["simulate", "equibiaxial_tension"], "equibiaxial_tension has no tool and is not simulated; use its closed"),
        (["view", "uniaxial_tension"], "SCENE: must be a test with a tool in this command; the specimen of "
         "uniaxial_tension is gripped. Use tissue-sim simulate uniaxial_tension; --figure draws"),
        (["loop", "torsion"], "SCENE: must be a test with a tool in this command; the specimen of torsion is gripped"),
    ])
    def test_refusals_name_the_remedy(self, words, expected, elastic, capsys):
        code = main([*words, "--material", elastic])
        err = capsys.readouterr().err
        assert code == 2 and expected in err and err.count("\n") == 1
