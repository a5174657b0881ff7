"""Laws of contact of the solid in space: pulls and films against closed forms, and the axisymmetric solid."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.experiment.contact_law import ContactLaw, Traction
from tissue_sim.fem.condensed.model import LINEARISATIONS
from tissue_sim.fem.reduced.model import require_reducible
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import create_block_mesh_from_boundaries, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.parameters import parameter
from tissue_sim.pose import Pose

SOFT = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
BALL = ts.Tool("sphere", radius=8e-3)


@dataclass(frozen=True)
class Film(ContactLaw):
    """Resists slip by a shear stiffness, and pulls evenly up to its thickness."""

    name = "film"
    shear: float = parameter("k", "Pa/m", key="shear_Pa_per_m", default=0.0)
    tack: float = parameter("s", "Pa", key="tack_Pa", default=0.0)
    thickness: float = parameter("h", "m", key="thickness_mm", factor=1e-3, default=1e-3)

    @property
    def reach(self):
        return self.thickness

    def traction(self, gap, pressure, slip, face):
        return Traction(self.tack + 0.0 * gap, (self.shear * slip[0], self.shear * slip[1]),
                        drag_rates=((self.shear, 0.0), (0.0, self.shear)))


def model(places, *, tool=None, friction="frictionless", base=None, specimen=None, **laws):
    protocol = ts.Protocol(np.arange(float(len(places))), np.array(places))
    return ts.Model(ts.Experiment(specimen or ts.Specimen(0.03, 0.03), protocol, tool=tool or ts.Tool(),
                                  friction=friction, friction_base=base or friction, **laws), SOFT)


def force(tested, mesh=None, solver="solid", resolution="realtime"):
    recording = ts.simulate(tested, solver=solver, mesh=mesh, resolution=resolution)
    assert recording.metadata["solver"]["cuts"] == 0
    return recording.force


@pytest.mark.slow
@pytest.mark.parametrize("tack", [0.0, 8.0])
def test_a_plate_pulls_at_a_block_until_it_lets_go(tack):
    """Tissue follows the plate by F H / (E A): F (1 - F0 H / (E A L)) = F0 (1 - gap / L) + t A, for the pull F0 on the
    block and another one, t, that does not fall."""
    length, block = 0.5e-3, ts.Block(0.02, 0.03, 0.02)
    places = 1e-3 * np.array([0.0, 0.2, 0.0, -0.05, -0.1, -0.2, -0.3, -0.4, -0.49, -0.6, -0.3])
    found = force(model(places, specimen=block, adhesion=ts.Adhesion(0.01, length), contact_laws=[
        Film(tack=tack, thickness=0.55e-3)]))
    pull = 0.01 / (math.pi * 0.01**2) * 0.02 * 0.03  # the law counts on the circle in the block
    gap = -places[3:9] / length
    expected = -(pull * (1.0 - gap) + tack * 0.02 * 0.03) / (1.0 - pull * 0.02 / (SOFT.E0 * 0.02 * 0.03 * length))
    np.testing.assert_allclose(found[4:9], expected[1:], rtol=2e-3)
    assert found[3] == pytest.approx(-SOFT.E0 * 0.02 * 0.03 * 0.05 / 20, rel=5e-3), "still in touch, and stretched"
    assert found[1] > 0.0 and abs(found[9]) < 1e-9 and abs(found[10]) < 1e-9, "it has to touch again"


@pytest.mark.slow
@pytest.mark.parametrize(("laws", "precision"), [
    ({"adhesion": ts.Adhesion(0.02, 0.5e-3)}, 2e-3), ({"contact_laws": [Film(3e5)]}, 0.01)], ids=["adhesion", "film"])
def test_plates_are_those_of_the_axisymmetric_solid(laws, precision):
    """Forces are equal in loading, unloading and separation; with a film the base is bonded and the top slips."""
    places = 1e-3 * np.array([0.0, 1.0, 0.3, 0.0, -0.1, -0.3, -1.1])
    tested = model(places, base="bonded" if "contact_laws" in laws else None, **laws)
    mesh = create_cylinder_mesh_under_needle(0.03, 0.03, 0.018, HEX27P1, smallest=3.5e-3, growth=1.8, largest=10e-3,
                                             around=2)
    expected, found = force(tested, solver="axisymmetric", resolution="fast"), force(tested, mesh)
    np.testing.assert_allclose(found, expected, rtol=precision, atol=precision * 0.02)
    assert expected.min() < -2e-3 or "adhesion" not in laws


@pytest.mark.parametrize("way", [(1.0, 0.0), (0.0, 1.0), (0.6, -0.8)])
def test_a_film_drags_against_slip_in_any_direction(way):
    """A soft one: F = k A s, less what the tissue gives way."""
    film = Film(shear=2e3, tack=5.0)
    tested = model([0.0, 1e-3], base="bonded", specimen=ts.Block(0.02, 0.02, 0.01), contact_laws=[film])
    solver = make_solver(tested, resolution="realtime")
    for place in (Pose((0.0, 0.0, -0.1e-3)), Pose((0.2e-3 * way[0], 0.2e-3 * way[1], -0.1e-3))):
        step = solver.step(place)
        assert step.status is StepStatus.CONVERGED
    drag = np.array(step.wrench[:2])
    stiff = film.shear * 0.02**2
    gives = stiff / (stiff + SOFT.mu0 * 0.02**2 / 0.01)
    np.testing.assert_allclose(drag, -0.2e-3 * stiff * (1.0 - gives) * np.array(way), rtol=0.01, atol=1e-9)


def ball_on_a_block(tack, length=3e-4):
    """Largest pull of a ball that is taken off, N."""
    inner, outer = np.linspace(-3e-3, 3e-3, 11), np.array([4.2e-3, 6.5e-3, 10e-3, 15e-3])
    line = np.concatenate([-outer[::-1], inner, outer])
    down = np.concatenate([[0.0], np.cumsum(0.6e-3 * 1.6 ** np.arange(5)), [15e-3]])
    places = 1e-3 * np.array([0.0, 0.6, 0.7, 0.1, 0.01, 0.0, -0.01, -0.02, -0.03, -0.35])
    block = ts.Block(0.03, 0.03, 0.015)
    radius = model(places, tool=BALL, base="bonded", specimen=block).experiment.contact_radius
    tested = model(places, tool=BALL, base="bonded", specimen=block,
                   adhesion=ts.Adhesion(tack * math.pi * radius**2, length))
    found = force(tested, create_block_mesh_from_boundaries(line, line, -down[::-1], HEX8P0))
    assert abs(found[-1]) < 1e-9
    return -found.min()


@pytest.mark.slow
def test_a_ball_lets_go_at_the_force_of_maugis():
    """Weak pull over a short way on soft tissue: nearly that of Derjaguin, Muller and Toporov, 2 pi w R.

    Maugis (J. Colloid Interface Sci. 150 (1992) 243), by the formula of Carpick, Ogletree and Salmeron (J. Colloid
    Interface Sci. 211 (1999) 395); his pull does not fall with the gap, ours does, which matters little here.
    """
    tack, length, radius, modulus = 30.0, 3e-4, 8e-3, SOFT.E0 / (1.0 - 0.25)
    work = 0.5 * tack * length
    x = 4.04 * (tack * (9 * radius / (2 * math.pi * work * modulus**2)) ** (1 / 3)) ** 1.4
    expected = (1.75 - 0.25 * (x - 1) / (x + 1)) * math.pi * work * radius
    assert ball_on_a_block(tack, length) == pytest.approx(expected, rel=0.03)
    assert 1.94 < expected / (math.pi * work * radius) < 2.0


@pytest.mark.slow
def test_a_stickier_ball_is_between_the_limits():
    """1.5 pi w R of Johnson, Kendall and Roberts, and 2 pi w R."""
    work = 0.5 * 300.0 * 3e-4
    assert 1.5 < ball_on_a_block(300.0) / (math.pi * work * 8e-3) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("friction", ["frictionless", 0.3, "stick"])
def test_stiffness_knows_the_pull(friction):
    """The stiffness of a ball during separation, along and across the axis, predicts the next steps."""
    mesh = create_cylinder_mesh_under_needle(0.03, 0.03, 5e-3, HEX8P0, smallest=1.2e-3, growth=1.8, largest=8e-3,
                                             around=3)
    solver = make_solver(model([0.0, 2e-3], tool=BALL, friction=friction, base="bonded",
                               adhesion=ts.Adhesion(0.02, 3e-4)), mesh=mesh)
    solver.enable_stiffness_output()
    for depth in (0.1e-3, 0.5e-3, 1e-3, 0.5e-3, 0.06e-3):  # on a way on which nothing slips at the end
        step = solver.step(Pose.at_depth(depth), tolerance=1e-11)
        assert step.status is StepStatus.CONVERGED
    assert step.force < -2e-3
    saved = solver.save()
    for axis in (0, 2):
        moved = []
        for sign in (1.0, -1.0):
            solver.restore(saved)
            place = [0.0, 0.0, -depth]
            place[axis] += sign * 1e-7
            moved.append(solver.step(Pose(tuple(place)), tolerance=1e-11).wrench[axis])
        slope = -(moved[0] - moved[1]) / 2e-7
        assert step.stiffness_matrix[axis][axis] == pytest.approx(slope, rel=2e-3, abs=1e-3)


def test_what_takes_none_says_so():
    tested = model([0.0, 1e-3], tool=BALL, friction=0.3, base="bonded", adhesion=ts.Adhesion(0.02, 3e-4))
    with pytest.raises(ts.InputError, match="which supports no adhesion"):
        LINEARISATIONS.find("solid")(tested, resolution="realtime")
    with pytest.raises(ts.InputError, match="reduced solid does not support adhesion"):
        require_reducible(tested)
    with pytest.raises(ts.InputError, match=r"contact_laws.film: traction\(\) must return a tissue_sim.Traction"):
        class Odd(Film):
            def traction(self, gap, pressure, slip, face):
                return 0.0 if np.ndim(gap) else Traction()

        force(model([0.0, 1e-3], base="bonded", contact_laws=[Odd()]))
