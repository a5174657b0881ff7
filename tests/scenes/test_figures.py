"""Pictures: written whole, of every field, and refused with a reason."""

import pytest

import tissue_sim as ts
from scenes import SCENES, draw_simulation
from scenes.figures import LABELS, draw_section
from tissue_sim.fem.fields import FIELD_UNITS


def simulated(scene="bonded_compression", radius=0.04, height=0.07, **options):
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    experiment = SCENES[scene].experiment(radius=radius, height=height, protocol=ts.Protocol.ramp(0.02 * height, 5))
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


def test_colour_bar_of_a_uniform_field_says_its_value():
    from matplotlib.figure import Figure

    recording, _ = simulated("lubricated_compression", fields=True)
    for field, words in (("cauchy_rz", "uniform 0"), ("von_mises", "uniform")):
        figure = Figure()
        draw_section(figure.subplots(), recording.fields, field)
        assert words in figure.axes[1].get_ylabel()


@pytest.mark.parametrize("suffix", [".svg", ".pdf"])
def test_flat_specimen_in_other_formats(suffix, tmp_path):
    recording, model = simulated(radius=0.05, height=0.01, fields=True)
    draw_simulation(recording, model, tmp_path / f"f{suffix}")
    assert (tmp_path / f"f{suffix}").stat().st_size > 1000


def test_refusals(bonded, tmp_path):
    recording, model = bonded
    with pytest.raises(ts.InputError, match="unknown field 'stress'"):
        draw_simulation(recording, model, tmp_path / "f.png", field="stress")
    plain, _ = simulated()
    with pytest.raises(ts.InputError, match="fields=True"):
        draw_simulation(plain, model, tmp_path / "f.png")
    assert not list(tmp_path.iterdir())
