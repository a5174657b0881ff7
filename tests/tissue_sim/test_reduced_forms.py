"""Effects that are stated and not solved for, in whole simulations: drainage, puncture, tilt."""

import numpy as np
import pytest
from scipy.integrate import quad

import tissue_sim as ts
from tissue_sim.tilt import tilted

LAW, STUDY = "reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}
RADIUS, HEIGHT = 0.040, 0.070
PLATE, NEEDLE = ts.Tool(), ts.Tool("flat", 8e-3)


def simulated(protocol, tool=PLATE, friction="bonded", base="bonded", rig=None, tilt=0.0, **material) -> ts.Recording:
    experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), protocol, tool=tool, friction=friction, friction_base=base,
                               tilt=tilt)
    stuff = ts.Material(LAW, STUDY, ts.Bulk("bulk_ratio", 1e4), **material)
    return ts.simulate(ts.Model(experiment, stuff, rig or ts.Rig()))


class TestDrainage:
    @pytest.mark.parametrize(("tool", "radius"), [
        (PLATE, RADIUS), (NEEDLE, 8e-3), (ts.Tool("flat", 4e-3), 4e-3),
        # Of a ball at the largest depth, sqrt(R d).
        (ts.Tool("sphere", 8e-3), np.sqrt(8e-3 * 5e-3)),
    ], ids=["plate", "needle", "thin needle", "ball"])
    def test_time_in_a_hold_grows_with_the_square_of_the_contact(self, tool, radius):
        """After a sudden ramp the force falls by phi with tau = a^2 / D: 1600, 64, 16 and 40 s."""
        wet = ts.Poroelasticity(phi=0.3, diffusivity=1e-6)
        friction = "stick" if tool.shape == "sphere" else "bonded"
        protocol = ts.Protocol.parse("ramp 5mm @1m/s; hold 30000s", points=11)
        recording = simulated(protocol, tool, friction, poroelasticity=wet)
        hold = slice(10, None)
        force, since = recording.force[hold], recording.time[hold] - recording.time[10]
        assert force[-1] / force[0] == pytest.approx(0.7, rel=2e-3)
        left = (force - 0.7 * force[0]) / (0.3 * force[0])
        soon = left > 0.1
        assert soon.sum() > 5
        np.testing.assert_allclose(left[soon], np.exp(-since[soon] / (radius**2 / 1e-6)), atol=3e-3)

    def test_drains_beside_it_relaxes(self):
        """Undrained and unrelaxed in a sudden ramp; both shares are gone in the end."""
        both = {"poroelasticity": ts.Poroelasticity(0.2, 1e-6), "viscoelastic": ts.Prony((ts.PronyTerm(0.3, 1.0),))}
        protocol = ts.Protocol.parse("ramp 5mm @1m/s; hold 100000s", points=11)
        force = simulated(protocol, NEEDLE, **both).force
        assert force[-1] / force[10] == pytest.approx(0.5, rel=2e-3)
        assert force[10] == pytest.approx(simulated(ts.Protocol.ramp(5e-3, 11), NEEDLE).force[-1], rel=6e-3)


class TestPuncture:
    PROTOCOL = ts.Protocol.parse("ramp 8mm; unload 2mm; reload 9mm", points=17)
    PUNCTURE = ts.Puncture(depth=5e-3, drop=0.3)

    def test_drop_stays(self):
        """At 5 mm nothing has given way yet; from the next sample on 30 % are missing, out and in again."""
        whole = simulated(self.PROTOCOL, NEEDLE, "stick").force
        force = simulated(self.PROTOCOL, NEEDLE, "stick", puncture=self.PUNCTURE).force
        assert self.PROTOCOL.displacement[10] == pytest.approx(5e-3, abs=1e-12)
        np.testing.assert_allclose(force[:11], whole[:11], rtol=1e-12)
        np.testing.assert_allclose(force[11:], 0.7 * whole[11:], rtol=1e-12)
        assert force[11] < force[10]

    def test_not_reached(self):
        protocol = ts.Protocol.ramp(4.9e-3, 8)
        np.testing.assert_array_equal(simulated(protocol, NEEDLE, puncture=self.PUNCTURE).force,
                                      simulated(protocol, NEEDLE).force)

    def test_plates_do_not_puncture(self):
        np.testing.assert_array_equal(simulated(self.PROTOCOL, puncture=self.PUNCTURE).force,
                                      simulated(self.PROTOCOL).force)

    def test_behind_a_soft_load_train(self):
        """Tool and force fit each other on both sides of the drop, where the needle jumps ahead."""
        c = 1e-3
        force = simulated(self.PROTOCOL, NEEDLE, "stick", rig=ts.Rig(compliance=c), puncture=self.PUNCTURE).force
        true = ts.Protocol(self.PROTOCOL.time, self.PROTOCOL.displacement - c * force)
        assert true.displacement[17:].min() > 0 and np.diff(true.displacement[:17]).max() > 0.6e-3
        again = simulated(true, NEEDLE, "stick", puncture=self.PUNCTURE).force
        np.testing.assert_allclose(force, again, atol=1e-6)


class TestTilt:
    TILT = 1e-3

    def test_average_over_the_face(self):
        """Of a straight line: a toe, and beyond it a constant lag of half the tilt."""
        depth, stiffness = np.linspace(0.0, 0.01, 101), 760.0
        line = ts.Recording({"time": np.arange(101.0), "displacement": depth, "force": stiffness * depth})
        force = tilted(line, self.TILT, line.displacement).force

        def expected(d):
            def strip(x):
                return 2 / np.pi * np.sqrt(1 - x * x) * stiffness * max(d - 0.5 * self.TILT * (1 - x), 0.0)
            return quad(strip, -1, 1, points=[np.clip(1 - 2 * d / self.TILT, -1, 1)])[0]

        np.testing.assert_allclose(force, [expected(d) for d in depth], atol=2e-5 * force.max())
        beyond = depth > self.TILT * 1.001
        np.testing.assert_allclose(force[beyond], stiffness * (depth[beyond] - 0.5 * self.TILT), rtol=1e-9)
        toe = slice(1, 9)
        # Strips of a disc: nearly a square, steeper at the very rim.
        slopes = np.diff(np.log(force[toe])) / np.diff(np.log(depth[toe]))
        assert (slopes > 1.9).all() and (slopes < 2.7).all()
        assert tilted(line, 0.0, line.displacement) is line

    @pytest.mark.parametrize("friction", ["frictionless", "bonded"])
    def test_lag_of_a_simulated_plate(self, friction):
        protocol = ts.Protocol.ramp(10e-3, 41)
        straight, leaning = (simulated(protocol, friction=friction, base=friction, tilt=t) for t in (0.0, self.TILT))
        deep = protocol.displacement > 3e-3
        lag = protocol.displacement - np.interp(leaning.force, straight.force, protocol.displacement)
        np.testing.assert_allclose(lag[deep], 0.5 * self.TILT, rtol=1e-2)
        first = leaning.force[1] / straight.force[1]
        assert 0 < first < 0.2, "a toe at 0.25 mm"

    def test_in_the_air_and_on_the_way_back(self):
        """Nothing in the air; an elastic plate comes back along the same curve; relaxation stays in it."""
        protocol = ts.Protocol.parse("approach 1mm @1mm/s; ramp 4mm; unload; retract 1mm", points=17)
        for material in ({}, {"viscoelastic": ts.Prony((ts.PronyTerm(0.3, 2.0),))}):
            recording = simulated(protocol, friction="frictionless", base="frictionless", tilt=self.TILT, **material)
            assert (recording.force[protocol.displacement < 0] == 0).all()
            ramp, back = recording.force[17:33], recording.force[32:49][::-1][1:]
            if material:
                assert (back[1:-1] < 0.97 * ramp[1:-1]).all()
            else:
                np.testing.assert_allclose(back, ramp, rtol=1e-6, atol=1e-9)
