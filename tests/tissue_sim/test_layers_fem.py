"""Layers and real compressibility in whole simulations."""

import numpy as np
import pytest
from scipy.optimize import brentq

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, find_element_layer_indices
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q9P1

#: Name of the law.
LAW = "reduced_polynomial_2"
#: Parameters of the reference study, Pa.
STUDY = {"C10": 1404.9, "C20": 699.4}
#: Radius, m.
RADIUS = 0.040
#: Height, m.
HEIGHT = 0.070
#: Plate.
PLATE = ts.Tool()
#: Flat needle.
NEEDLE = ts.Tool("flat", 8e-3)


def simulated(layers=(), tool=PLATE, friction="bonded", *, radius=RADIUS, protocol=None, ratio=1e4, mesh=None,
              resolution="fast", **material) -> ts.Recording:
    experiment = ts.Experiment(ts.Specimen(radius, HEIGHT), protocol or ts.Protocol.ramp(10e-3, 6), tool=tool,
                               friction=friction, friction_base=friction if tool is PLATE else "bonded")
    stuff = ts.Material(LAW, STUDY, ts.Bulk("bulk_ratio", ratio), layers=layers, **material)
    return ts.simulate(ts.Model(experiment, stuff), mesh=mesh, resolution=resolution)


def force(*args, **options) -> np.ndarray:
    return simulated(*args, **options).force[1:]


def one_over_the_other(depth: float, thickness: float, ratio: float, radius: float) -> float:
    """Force of two incompressible cylinders without friction between them, the upper one `ratio` times as stiff: the
    same force in both, displacements add."""
    law, area = ts.find_law(LAW), np.pi * radius**2

    def of(stretch, stiffness):
        return -stiffness * law.nominal_stress(stretch, STUDY) * area

    def below(upper):
        return (HEIGHT - depth - thickness * upper) / (HEIGHT - thickness)

    # Neither part grows longer under a plate that presses.
    upper = brentq(lambda s: of(s, ratio) - of(below(s), 1.0), 1 - depth / thickness, 1.0, xtol=1e-14)
    return float(of(upper, ratio))


class TestLayers:
    @pytest.mark.parametrize(("tool", "friction", "precision"), [
        (PLATE, "frictionless", 1e-7), (PLATE, "bonded", 2e-3), (NEEDLE, "bonded", 3e-3)])
    def test_ratio_one_is_absent(self, tool, friction, precision):
        """The difference is the error of another mesh, and between frictionless plates the tolerance of the contact,
        which is closer for one material; on the same mesh nothing is left."""
        layers = (ts.Layer(2e-3, 1.0), ts.Layer(5e-3, 1.0))
        np.testing.assert_allclose(force(layers, tool, friction), force((), tool, friction), rtol=precision)
        mesh = simulated(layers, tool, friction).metadata["solver"]["mesh"]
        assert mesh["elements"] > simulated((), tool, friction).metadata["solver"]["mesh"]["elements"]
        same = cylinder_mesh(RADIUS, HEIGHT, (6, 14), Q9P1)
        np.testing.assert_array_equal(force(layers, PLATE, "bonded", mesh=same),
                                      force((), PLATE, "bonded", mesh=same))

    @pytest.mark.parametrize(("radius", "ratio", "precision"), [
        (RADIUS, 1.02, 5e-5), (RADIUS, 1.1, 1e-3), (4e-3, 1.5, 1e-3), (4e-3, 0.7, 1e-3)])
    @pytest.mark.parametrize("thickness", [35e-3, 20e-3])
    def test_in_series(self, radius, ratio, precision, thickness):
        """The parts widen differently and hinder each other where they are joined. That costs force with the square of
        what separates the ratio from 1, and near the joint only: a slender specimen does not notice."""
        found = simulated((ts.Layer(thickness, ratio),), friction="frictionless", radius=radius, ratio=1e5)
        expected = [one_over_the_other(depth, thickness, ratio, radius) for depth in found.displacement[1:]]
        np.testing.assert_allclose(found.force[1:], expected, rtol=precision)

    def test_skin_is_felt_by_the_needle(self):
        """Two millimetres, five times as stiff: a tenth more under the needle, 3 % between plates."""
        skin = (ts.Layer(2e-3, 5.0),)
        plate, needle = (force(skin, tool)[-1] / force((), tool)[-1] - 1 for tool in (PLATE, NEEDLE))
        assert 0.02 < plate < 0.04 and 0.10 < needle < 0.14

    def test_shallow_needle_feels_the_skin_only(self):
        """The thicker the skin relative to the needle's radius, the nearer is the force to that of a block of skin."""
        shallow, ratio = ts.Protocol.ramp(0.2e-3, 3), 3.0
        bare = force((), NEEDLE, protocol=shallow)[-1]
        shares = [force((ts.Layer(h, ratio),), NEEDLE, protocol=shallow)[-1] / bare for h in (1e-3, 4e-3, 16e-3, 69e-3)]
        assert (np.diff(shares) > 0).all() and 1 < shares[0] < 2 and shares[-1] == pytest.approx(ratio, rel=1e-2)

    @pytest.mark.parametrize("tool", [PLATE, NEEDLE], ids=["plate", "needle"])
    def test_two_ways_of_meshing(self, tool):
        """The same skin on the fast and on the accurate mesh, as one layer and as two."""
        coarse, fine = (force((ts.Layer(4e-3, 3.0),), tool, resolution=name) for name in ("fast", "accurate"))
        np.testing.assert_allclose(coarse, fine, rtol=1e-2)
        split = force((ts.Layer(3e-3, 3.0), ts.Layer(1e-3, 3.0)), tool)
        np.testing.assert_allclose(split, fine, rtol=1e-2)

    def test_own_mesh(self):
        """Elements belong to the layer in which their centres lie."""
        mesh = cylinder_mesh(RADIUS, HEIGHT, (10, 35), Q9P1, grading=(10.0, 1.0))
        layers = (ts.Layer(4e-3, 3.0), ts.Layer(6e-3, 0.5))
        assert np.bincount(find_element_layer_indices(mesh, layers)).tolist() == [20, 30, 300]
        np.testing.assert_allclose(force(layers, mesh=mesh), force(layers, resolution="accurate"), rtol=5e-3)

    def test_interfaces_are_lines_of_the_mesh(self):
        layers = (ts.Layer(0.7e-3, 3.0), ts.Layer(1.9e-3, 0.5), ts.Layer(20e-3, 2.0))
        for tool in (PLATE, NEEDLE):
            mesh = build_mesh(ts.Experiment(ts.Specimen(RADIUS, HEIGHT), ts.Protocol.ramp(1e-3), tool=tool), "fast",
                              layers=layers)
            z = np.unique(mesh.nodes[mesh.connectivity[:, :4], 1])
            for interface in (-0.7e-3, -2.6e-3, -22.6e-3):
                assert abs(z - interface).min() < 1e-12
            assert ((z > -0.7e-3 - 1e-12) & (z < 0)).sum() >= 2, "at least two elements in the thinnest layer"

    @pytest.mark.parametrize("thickness", [(70e-3,), (40e-3, 40e-3)])
    def test_thicker_than_the_specimen(self, thickness):
        with pytest.raises(ts.InputError, match="must be thinner in total than the specimen, 70 mm; got"):
            force(tuple(ts.Layer(h, 2.0) for h in thickness))

    @pytest.mark.parametrize("layer", [ts.Layer(1e-3, 5.0), ts.Layer(0.5e-3, 20.0)])
    @pytest.mark.parametrize("tool", [PLATE, NEEDLE], ids=["plate", "needle"])
    def test_thin_stiff_skin_of_an_incompressible_material(self, tool, layer):
        """Its bulk modulus is 1e5 times five or twenty: what rounding leaves of equilibrium grows with it."""
        assert np.diff(force((layer,), tool, ratio=1e5)).min() > 0

    def test_relaxing_layers_come_to_rest(self):
        layers, series = (ts.Layer(5e-3, 4.0),), ts.Prony((ts.PronyTerm(0.4, 3.0),))
        held = ts.Protocol.parse("ramp 8mm @1mm/s; hold 300s", points=9)
        found = force(layers, protocol=held, viscoelastic=series)[-1]
        soft = ts.Material(LAW, {name: 0.6 * value for name, value in STUDY.items()}, ts.Bulk("bulk_ratio", 1e4 / 0.6),
                           layers=layers)
        experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), ts.Protocol.ramp(8e-3, 9))
        assert found == pytest.approx(ts.simulate(ts.Model(experiment, soft)).force[-1], rel=1e-6)


class TestCompressible:
    """Poisson's ratio of 0.3 is K = 2.167 mu0."""

    @staticmethod
    def closed_form(depth: float, ratio: float) -> float:
        """Uniaxial compression of the compressible solid, from principal stresses and U(J) = K/2 (J - 1)^2."""
        stuff, stretch = ts.Material(LAW, STUDY, ts.Bulk("bulk_ratio", ratio)), 1 - depth / HEIGHT

        def tau(lateral):
            J = stretch * lateral**2
            _, isochoric = stuff.energy_law.compute_energy_and_kirchhoff_stresses([stretch, lateral, lateral], STUDY)
            return isochoric + stuff.bulk_modulus * (J - 1) * J

        lateral = brentq(lambda x: tau(x)[1], 1.0, stretch**-0.5, xtol=1e-15)
        return -tau(lateral)[0] / stretch * np.pi * RADIUS**2

    @pytest.mark.parametrize("ratio", [13 / 6, 5.0])
    def test_lubricated(self, ratio):
        recording = simulated(friction="frictionless", ratio=ratio, protocol=ts.Protocol.ramp(20e-3, 6))
        expected = [self.closed_form(depth, ratio) for depth in recording.displacement[1:]]
        np.testing.assert_allclose(recording.force[1:], expected, rtol=1e-9)

    def test_small_strain(self):
        """E = 9 K mu / (3 K + mu), which is 2 mu (1 + 0.3) here."""
        shallow = simulated(friction="frictionless", ratio=13 / 6, protocol=ts.Protocol([0.0, 1.0], [0.0, 1e-7]))
        young = shallow.force[-1] / (np.pi * RADIUS**2) / (1e-7 / HEIGHT)
        assert young == pytest.approx(2 * 1.3 * 2 * STUDY["C10"], rel=1e-4)

    @pytest.mark.parametrize("tool", [PLATE, NEEDLE], ids=["plate", "needle"])
    def test_softer_the_more_compressible(self, tool):
        forces = [force((), tool, ratio=ratio)[-1] for ratio in (13 / 6, 5.0, 50.0, 1e4)]
        assert (np.diff(forces) > 0).all() and forces[0] < 0.9 * forces[-1]

    @pytest.mark.slow
    def test_halving_the_mesh(self):
        """The element of nearly incompressible solids is as good here."""
        forces = [force((), NEEDLE, ratio=13 / 6, resolution=name) for name in ("fast", "accurate")]
        np.testing.assert_allclose(*forces, rtol=1e-2)
