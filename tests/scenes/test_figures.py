"""Figures of axisymmetric simulations: every field, every format, and errors."""

import pytest

import tissue_sim as ts
from scenes import SCENES, draw_simulation
from scenes.field_labels import LABELS
from scenes.figures import RIGID, draw_section, draw_tool_edge_closeup
from tissue_sim.fem.elements.fields import FIELD_UNITS

STUDY = ts.Specimen(0.04, 0.07)


def simulated(scene="bonded_compression", specimen=STUDY, depth=0.02, overrides=None, **options):
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    protocol = ts.Protocol.ramp(depth * specimen.height, 5)
    experiment = SCENES[scene].experiment(specimen=specimen, protocol=protocol, **(overrides or {}))
    model = ts.Model(experiment, material)
    return ts.simulate(model, **options), model


@pytest.fixture(scope="module")
def bonded():
    return simulated(fields=True)


def test_every_field_has_a_label():
    assert set(LABELS) == set(FIELD_UNITS)


@pytest.mark.parametrize("field", LABELS)
def test_every_field_is_drawn(bonded, field, tmp_path):
    recording, model = bonded
    draw_simulation(recording, model, tmp_path / "f.png", field=field)
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")


def test_colour_bar_of_a_uniform_field_shows_its_value():
    from matplotlib.figure import Figure

    recording, _ = simulated("lubricated_compression", fields=True)
    for field, words in (("cauchy_rz", "uniform 0"), ("von_mises", "uniform")):
        figure = Figure()
        draw_section(figure.subplots(), recording.fields, field, tool=ts.Tool())
        assert words in figure.axes[1].get_ylabel()


@pytest.mark.parametrize("suffix", [".svg", ".pdf"])
def test_flat_specimen_in_other_formats(suffix, tmp_path):
    recording, model = simulated(specimen=ts.Specimen(0.05, 0.01), fields=True)
    draw_simulation(recording, model, tmp_path / f"f{suffix}")
    assert (tmp_path / f"f{suffix}").stat().st_size > 1000


@pytest.mark.parametrize(("weight", "overrides"), [
    ({}, {}),
    ({"density": 1040.0, "gravity": 9.81}, {"tool": ts.Tool("flat", 0.008, 0.002), "friction": "frictionless"}),
], ids=["sharp and bonded", "rounded, frictionless, settled"])
def test_needle_is_drawn_on_the_surface(weight, overrides):
    """The face of the needle is at its depth below the settled surface, and no tissue is inside the shaft."""
    from matplotlib.colors import to_rgba
    from matplotlib.figure import Figure

    recording, model = simulated("needle_indentation", ts.Specimen(0.04, 0.07, **weight), 0.1, overrides, fields=True)
    tool, fields = model.experiment.tool, recording.fields
    figure = Figure()
    section, fold = figure.subplots(1, 2)
    draw_section(section, fields, "von_mises", tool=tool)
    draw_tool_edge_closeup(fold, fields, "von_mises", tool)
    face = [node for node in fields.mesh.sets["top"] if fields.mesh.nodes[node, 0] <= tool.face_radius]
    settled = fields.displacement(0)[face, 1].max() * 1e3
    assert (settled < -1) == bool(weight)
    for axes in (section, fold):
        (needle,) = [patch for patch in axes.patches if patch.get_facecolor() == to_rgba(RIGID)]
        low, high = needle.get_path().vertices.min(axis=0), needle.get_path().vertices.max(axis=0)
        # Contact is enforced at Gauss points; nodes of the coarse mesh may penetrate the tool slightly.
        assert low[1] == pytest.approx(settled - 7.0, abs=0.03)
        assert (low[0], high[0]) == pytest.approx((-8.0, 8.0))
    surface = fold.lines[0].get_xydata()
    at_shaft = surface[surface[:, 1] > low[1] + 1e3 * tool.edge_radius + 0.1]
    assert len(at_shaft) and at_shaft[:, 0].min() > 7.98


@pytest.mark.slow
@pytest.mark.parametrize("specimen", [ts.Specimen(0.04, 0.07), ts.Specimen(0.05, 0.03)], ids=["tall", "flat"])
def test_needle_and_its_reference_are_drawn(specimen, tmp_path):
    recording, model = simulated("needle_indentation", specimen, fields=True)
    draw_simulation(recording, model, tmp_path / "f.svg", "J", reference=recording.with_metadata(name="a reference"))
    assert "a reference" in (tmp_path / "f.svg").read_text(encoding="utf-8")


def test_refusals(bonded, tmp_path):
    recording, model = bonded
    with pytest.raises(ts.InputError, match="unknown field 'stress'"):
        draw_simulation(recording, model, tmp_path / "f.png", field="stress")
    plain, _ = simulated()
    with pytest.raises(ts.InputError, match="fields=True"):
        draw_simulation(plain, model, tmp_path / "f.png")
    assert not list(tmp_path.iterdir())
