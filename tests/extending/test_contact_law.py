"""A law of contact from one file: traction from gap, pressure and slip, through `simulate` and `Simulator`."""

import json
from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.errors import InputError
from tissue_sim.experiment.contact_law import CONTACT_LAWS, ContactLaw, Traction
from tissue_sim.fem.condensed.model import LINEARISATIONS
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX27P1
from tissue_sim.parameters import parameters, with_values

MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
SPHERE = ts.Tool("sphere", radius=8e-3)
#: In and out again, and a little into the air.
WAY = ts.Protocol(np.arange(13.0), 1e-3 * np.array([0, 0.5, 1, 1.5, 2, 1.5, 1, 0.5, 0.2, 0, -0.05, -0.1, -0.2]))


@pytest.fixture
def film(plugin, registers):
    return registers(CONTACT_LAWS, plugin("tacky_film").TackyFilm)


def model(*laws, friction="frictionless", tool=SPHERE, protocol=WAY, **options):
    return ts.Model(ts.Experiment(ts.Specimen(0.03, 0.03), protocol, tool=tool, friction=friction, contact_laws=laws,
                                  **options), MATERIAL)


def plates(*laws, friction="frictionless"):
    return model(*laws, friction=friction, tool=ts.Tool(), protocol=ts.Protocol.ramp(3e-3, 7), friction_base="bonded")


def force(tested) -> np.ndarray:
    return ts.simulate(tested).force


@pytest.mark.slow
def test_a_pull_is_that_of_the_built_in_adhesion(film):
    """The same pull, once as `Adhesion` and once as the film's: to the tolerance of the equilibrium."""
    area = np.pi * model().experiment.contact_radius**2
    built_in = force(model(adhesion=ts.Adhesion(0.02, 3e-4)))
    assert built_in.min() < -2e-3, "it holds the tool back"
    np.testing.assert_allclose(force(model(film(tack=0.02 / area, thickness=3e-4))), built_in, rtol=0,
                               atol=1e-8 * built_in.max())
    np.testing.assert_allclose(force(model(film(tack=0.015 / area, thickness=3e-4), adhesion=ts.Adhesion(0.005, 3e-4))),
                               built_in, rtol=0, atol=1e-8 * built_in.max())


@pytest.mark.slow
def test_a_film_lies_between_no_friction_and_no_slip(film):
    """Elastic shear of the film: nothing where it is soft, a face without slip where it is stiff, in order between."""
    free, stuck = force(plates()), force(plates(friction="stick"))
    shears = (1.0, 3e4, 3e5, 1e9)
    films = np.array([force(plates(film(shear=shear))) for shear in shears])[:, -1]
    assert films[0] == pytest.approx(free[-1], rel=1e-4) and films[-1] == pytest.approx(stuck[-1], rel=2e-3)
    assert (np.diff(films) > 0.05 * (stuck[-1] - free[-1])).all()


@pytest.mark.slow
def test_smooth_friction_is_nearly_coulombs(film):
    """Drag from pressure and slip: mu p tanh(s / s0) of a short s0 against the built-in friction of the same mu."""
    coulomb, free = force(plates(friction=0.2)), force(plates())
    smooth = force(plates(film(friction=0.2, slip=1e-5)))
    assert coulomb[-1] > 1.03 * free[-1]
    np.testing.assert_allclose(smooth[2:], coulomb[2:], rtol=2e-2)


@pytest.mark.slow
def test_rates_help_the_iteration_and_change_nothing(film):
    recordings = [ts.simulate(plates(film(shear=3e4, with_rates=rates))) for rates in (True, False)]
    with_rates, without = (recording.metadata["solver"]["newton_iterations"] for recording in recordings)
    assert with_rates < without
    np.testing.assert_allclose(recordings[0].force, recordings[1].force, rtol=1e-7)


@pytest.mark.slow
def test_its_parameters_are_those_of_the_model(film):
    tested = model(film(tack=30.0))
    known = parameters(tested)
    assert known["experiment.contact_laws.tacky_film.tack"].value == 30.0
    assert known["experiment.contact_laws.tacky_film.thickness"].declaration.unit == "m"
    changed = with_values(tested, {"experiment.contact_laws.tacky_film.tack": 60.0})
    assert force(changed).min() < 1.3 * force(tested).min() < 0.0
    rates = ts.sensitivities(tested, ["experiment.contact_laws.tacky_film.tack"])
    assert not rates.exact.any() and (rates.values[5:11, 0] < 0.0).all(), "during unloading, where the contact pulls"


def test_the_way_out_counts(film):
    """The contact pulls at separation, so a calibration uses the unloading as well."""
    assert model(film(tack=30.0)).experiment.is_path_dependent and not model().experiment.is_path_dependent
    plate = ts.Experiment(ts.Specimen(0.03, 0.03), WAY, friction="frictionless", friction_base="frictionless")
    assert plate.has_homogeneous_deformation and not replace(plate,
                                                             contact_laws=[film(tack=30.0)]).has_homogeneous_deformation


@pytest.mark.slow
def test_the_solid_has_the_force_of_the_axisymmetric_solver(film):
    """Loading, unloading and separation between plates, with tack and shear; the base is bonded and the top slips."""
    displacement = 1e-3 * np.array([0.0, 1.0, 0.3, 0.0, -0.02, -0.05, -0.2])
    tested = model(film(tack=40.0, shear=3e5), tool=ts.Tool(), friction_base="bonded",
                   protocol=ts.Protocol(np.arange(7.0), displacement))
    mesh = create_cylinder_mesh_under_needle(0.03, 0.03, 0.018, HEX27P1, smallest=3.5e-3, growth=1.8, largest=10e-3,
                                             around=2)
    expected, found = force(tested), ts.simulate(tested, solver="solid", mesh=mesh).force
    assert expected.max() > 0.3 and expected.min() < -0.02 and expected[-1] == 0.0
    np.testing.assert_allclose(found, expected, rtol=0.01, atol=0.01 * abs(expected.min()))


def test_reduced_and_multirate_solids_refuse_it(film):
    """Both state their limit before they compute."""
    tested = model(film(tack=40.0), friction=0.3, friction_base="bonded", protocol=ts.Protocol.ramp(2e-3, 3))
    with pytest.raises(InputError, match="contact_laws: a reduced solid does not support adhesion or other"):
        ts.reduce_solid(tested, ts.PoseBox(0.0, 2e-3, 0.0))
    with pytest.raises(InputError, match="contact_laws: must be left out for a multirate solid"):
        LINEARISATIONS.find("solid")(tested, resolution="realtime")


def test_simulator_takes_it(film):
    """Real time: the forces of `simulate` at its samples, with the adhesive force during unloading."""
    tested = model(film(tack=60.0, thickness=3e-4))
    sim = ts.Simulator(tested, resolution="fast", inertia="off", tolerance=1e-9)
    forces = [sim.step(float(depth), 1.0).force for depth in WAY.displacement]
    np.testing.assert_allclose(forces, force(tested), rtol=0, atol=2e-4 * max(forces))
    assert min(forces) < 0.0


def test_what_cannot_be_is_refused(film):
    with pytest.raises(InputError, match=r"never lifts off; use .* with tacky_film"):
        plates(film(), friction="bonded")
    with pytest.raises(InputError, match="taken by another law of a contact"):
        CONTACT_LAWS.register(type("Other", (film,), {}))
    with pytest.raises(InputError, match="is not a valid law of a contact"):
        CONTACT_LAWS.register(type("Loose", (ContactLaw,), {"name": "loose"}))

    class Branching(film):
        name = "branching"

        def traction(self, gap, pressure, slip, face):
            return Traction(self.tack if gap < 0 else 0.0)

    with pytest.raises(InputError, match=r"contact_laws\.branching: .*numpy\.where"):
        force(model(Branching(tack=1.0)))


def test_command_line_takes_it(film, tmp_path, capsys):
    ts.write_material_file(ts.MaterialFile.of(MATERIAL), tmp_path / "m.material.json")
    command = ["simulate", "needle_indentation", "--material", str(tmp_path / "m.material.json"), "--tool", "sphere",
               "--friction", "frictionless", "--depth-mm", "2", "--points", "3", "--json"]
    assert main([*command, "--contact-law", "tacky_film:tack_Pa=60,thickness_mm=0.3"]) == 0
    tacky = json.loads(capsys.readouterr().out)["force_N"]
    assert main(command) == 0
    assert tacky[-1] < json.loads(capsys.readouterr().out)["force_N"][-1]
    assert main([*command, "--contact-law", "tacky_film:tuck_Pa=60"]) == 2
    assert "did you mean 'tack_Pa'" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_campaign_states_and_fits_it(film, tmp_path):
    """Data with the film's elastic shear between plates; the campaign finds its stiffness."""
    recording = ts.simulate(model(film(shear=1e5), tool=ts.Tool(), protocol=ts.Protocol.ramp(4e-3, 41),
                                  friction_base="bonded"))
    noise = np.random.default_rng(3).normal(0.0, 1e-3, len(recording))
    ts.write_recording(ts.Recording({"time": recording.time, "displacement": recording.displacement,
                                     "force": recording.force + noise}), tmp_path / "plates.csv")
    campaign = tmp_path / "c.toml"
    campaign.write_text("""
[[specimen]]
radius_mm = 30.0
height_mm = 30.0
[[test]]
kind = "friction_compression"
recordings = ["plates.csv"]
friction = "frictionless"
friction_base = "bonded"
contact_laws = { tacky_film = { shear_Pa_per_m = 2e4 } }
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 1000.0
starts = 1
fixed = { C10 = 1500.0 }
start = { "experiment.contact_laws.tacky_film.shear" = 3e4 }
[noise]
force_N = 0.001
contact_jitter_mm = 0.0
zero_jitter_N = 0.0
""", encoding="utf-8")
    assert main(["calibrate", str(campaign), "-o", str(tmp_path / "out")]) == 0
    fit, = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))["fits"]
    name = "experiment.contact_laws.tacky_film.shear"
    assert fit["parameters"][name] == pytest.approx(1e5, rel=0.1)
    assert fit["derivatives"][name] == "difference"


@pytest.mark.parametrize("solver", ["axisymmetric", "solid"])
def test_a_law_without_a_traction_is_refused(film, registers, solver):
    class Broken(film):
        name = "broken_film"

        def traction(self, gap, pressure, slip, face):
            return 3.0

    registers(CONTACT_LAWS, Broken)
    with pytest.raises(InputError, match=r"contact_laws.broken_film: traction\(\) must return a tissue_sim.Traction"):
        ts.simulate(model(Broken(tack=100.0)), solver=solver, resolution="realtime")
