"""A law of contact from one file: traction from gap, pressure and slip, through `simulate` and `Simulator`."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.errors import InputError
from tissue_sim.experiment.contact_law import CONTACT_LAWS, ContactLaw, Traction
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


def test_a_pull_is_that_of_the_built_in_adhesion(film):
    """The same pull, once as `Adhesion` and once as the film's: to the tolerance of the equilibrium."""
    area = np.pi * model().experiment.contact_radius**2
    built_in = force(model(adhesion=ts.Adhesion(0.02, 3e-4)))
    assert built_in.min() < -2e-3, "it holds the tool back"
    np.testing.assert_allclose(force(model(film(tack=0.02 / area, thickness=3e-4))), built_in, rtol=0,
                               atol=1e-8 * built_in.max())
    np.testing.assert_allclose(force(model(film(tack=0.015 / area, thickness=3e-4), adhesion=ts.Adhesion(0.005, 3e-4))),
                               built_in, rtol=0, atol=1e-8 * built_in.max())


def test_a_film_lies_between_no_friction_and_no_slip(film):
    """Elastic shear of the film: nothing where it is soft, a face without slip where it is stiff, in order between."""
    free, stuck = force(plates()), force(plates(friction="stick"))
    shears = (1.0, 3e4, 3e5, 1e9)
    films = np.array([force(plates(film(shear=shear))) for shear in shears])[:, -1]
    assert films[0] == pytest.approx(free[-1], rel=1e-4) and films[-1] == pytest.approx(stuck[-1], rel=2e-3)
    assert (np.diff(films) > 0.05 * (stuck[-1] - free[-1])).all()


def test_smooth_friction_is_nearly_coulombs(film):
    """Drag from pressure and slip: mu p tanh(s / s0) of a short s0 against the built-in friction of the same mu."""
    coulomb, free = force(plates(friction=0.2)), force(plates())
    smooth = force(plates(film(friction=0.2, slip=1e-5)))
    assert coulomb[-1] > 1.03 * free[-1]
    np.testing.assert_allclose(smooth[2:], coulomb[2:], rtol=2e-2)


def test_rates_help_the_iteration_and_change_nothing(film):
    recordings = [ts.simulate(plates(film(shear=3e4, with_rates=rates))) for rates in (True, False)]
    with_rates, without = (recording.metadata["solver"]["newton_iterations"] for recording in recordings)
    assert with_rates < without
    np.testing.assert_allclose(recordings[0].force, recordings[1].force, rtol=1e-7)


def test_its_parameters_are_those_of_the_model(film):
    tested = model(film(tack=30.0))
    known = parameters(tested)
    assert known["experiment.contact_laws.tacky_film.tack"].value == 30.0
    assert known["experiment.contact_laws.tacky_film.thickness"].declaration.unit == "m"
    changed = with_values(tested, {"experiment.contact_laws.tacky_film.tack": 60.0})
    assert force(changed).min() < 1.3 * force(tested).min() < 0.0
    rates = ts.sensitivities(tested, ["experiment.contact_laws.tacky_film.tack"])
    assert not rates.exact.any() and rates.values[3, 0] < 0.0


def test_simulator_takes_it(film):
    """Real time: the forces of `simulate` at its samples, with the pull on the way out."""
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
    with pytest.raises(InputError, match="no law of a contact"):
        CONTACT_LAWS.register(type("Loose", (ContactLaw,), {"name": "loose"}))

    class Branching(film):
        name = "branching"

        def traction(self, gap, pressure, slip, face):
            return Traction(self.tack if gap < 0 else 0.0)

    with pytest.raises(InputError, match=r"contact_laws\.branching: .*numpy\.where"):
        force(model(Branching(tack=1.0)))
