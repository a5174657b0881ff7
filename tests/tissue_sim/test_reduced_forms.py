"""Effects that are stated and not solved for, in whole simulations: drainage, puncture, tilt, slip, a scale."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import quad

import tissue_sim as ts
from tissue_sim.simulation import compute_tilted_recording

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
        """At 5 mm there is no drop yet; from the next sample on 30 % are lost, in loading and unloading."""
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

    @pytest.mark.slow
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
        """A linear force becomes a toe region followed by a constant lag of half the tilt."""
        depth, stiffness = np.linspace(0.0, 0.01, 101), 760.0
        line = ts.Recording({"time": np.arange(101.0), "displacement": depth, "force": stiffness * depth})
        force = compute_tilted_recording(line, self.TILT, line.displacement).force

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
        assert compute_tilted_recording(line, 0.0, line.displacement) is line

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


class TestSlip:
    PROTOCOL = ts.Protocol.parse("ramp 6mm @1mm/s; unload", points=9)

    def slipping(self, share, rig=None, tool=PLATE, **material):
        experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), self.PROTOCOL, tool=tool, slip=share)
        return ts.simulate(ts.Model(experiment, ts.Material(LAW, STUDY, ts.Bulk("bulk_ratio", 1e4), **material),
                                    rig or ts.Rig()))

    @pytest.mark.parametrize("material", [{}, {"viscoelastic": ts.Prony((ts.PronyTerm(0.3, 2.0),))}],
                             ids=["elastic", "relaxing"])
    def test_between_bonded_and_frictionless(self, material):
        bonded, free = (simulated(self.PROTOCOL, friction=face, base=face, **material).force
                        for face in ("bonded", "frictionless"))
        assert bonded.max() > 1.1 * free.max()
        np.testing.assert_allclose(self.slipping(0.3, **material).force, 0.7 * bonded + 0.3 * free, rtol=1e-12)
        np.testing.assert_array_equal(self.slipping(0.0, **material).force, bonded)

    def test_the_sensor_reads_once(self):
        rig = ts.Rig(zero_offset=0.5, contact_offset=2e-4)
        plain = self.slipping(0.3, ts.Rig(contact_offset=2e-4)).force
        np.testing.assert_allclose(self.slipping(0.3, rig).force, plain + 0.5, rtol=1e-12)

    def test_a_needle_keeps_its_base(self):
        """Only its own face slips, round a rounded edge."""
        blunt = ts.Tool("flat", 8e-3, edge_radius=2e-3)
        bonded, free = (simulated(self.PROTOCOL, blunt, face).force for face in ("bonded", "frictionless"))
        np.testing.assert_allclose(self.slipping(0.5, tool=blunt).force, 0.5 * (bonded + free), rtol=1e-12)

    def test_derivative_with_the_share(self):
        experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), self.PROTOCOL, slip=0.2)
        model = ts.Model(experiment, ts.Material(LAW, STUDY, ts.Bulk("bulk_ratio", 1e4)))
        rates = ts.sensitivities(model, ["experiment.slip", "C10"])
        bonded, free = (simulated(self.PROTOCOL, friction=face, base=face).force for face in ("bonded", "frictionless"))
        np.testing.assert_allclose(rates.values[:, 0], free - bonded, atol=1e-6 * bonded.max())
        assert not rates.exact.any() and rates.values[8, 1] > 0

    @pytest.mark.parametrize(("changes", "field", "words"), [
        ({"slip": 0.1, "friction": "frictionless"}, "slip", "requires friction 'bonded'; got 'frictionless'"),
        ({"slip": 1.5}, "slip", "a fraction from 0 to 1; got 1.5"),
        ({"slip": 0.1, "tool": NEEDLE}, "tool.edge_radius", "sharp edge")])
    def test_what_does_not_fit_is_refused(self, changes, field, words):
        with pytest.raises(ts.InputError, match=words) as caught:
            ts.Experiment(ts.Specimen(RADIUS, HEIGHT), self.PROTOCOL, **changes)
        assert caught.value.field == field

    def test_only_bonded_faces_have_it(self):
        bonded = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), self.PROTOCOL)
        assert bonded.slip == 0.0 and dataclasses.replace(bonded, friction=0.3).slip is None
        assert dataclasses.replace(dataclasses.replace(bonded, friction=0.3), friction="bonded").slip == 0.0

    def test_not_in_real_time(self):
        experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), self.PROTOCOL, slip=0.1)
        with pytest.raises(ts.InputError, match="partial slip is a correction of whole recordings"):
            ts.Simulator(ts.Model(experiment, ts.Material(LAW, STUDY, ts.Bulk("bulk_ratio", 1e4))))


class TestStiffnessScale:
    def test_all_moduli_times_the_ratio(self, tmp_path):
        """The force is that of a material with moduli times the ratio, with and without machine compliance."""
        protocol, scale = ts.Protocol.ramp(6e-3, 9), ts.EFFECTS["stiffness_scale"](1.2)
        stiffer = {name: 1.2 * value for name, value in STUDY.items()}
        for rig in (ts.Rig(), ts.Rig(compliance=2e-4)):
            scaled = simulated(protocol, NEEDLE, rig=rig, effects=[scale])
            experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), protocol, tool=NEEDLE)
            same = ts.simulate(ts.Model(experiment, ts.Material(LAW, stiffer, ts.Bulk("bulk_ratio", 1e4)), rig))
            np.testing.assert_allclose(scaled.force, same.force, rtol=1e-6)
        file = ts.MaterialFile.of(ts.Material(LAW, STUDY, effects=[scale]))
        ts.write_material_file(file, tmp_path / "m.material.json")
        assert ts.load_material(tmp_path / "m.material.json").effects["stiffness_scale"].ratio == 1.2

    def test_no_ratio(self):
        with pytest.raises(ts.InputError, match="must be positive and finite"):
            ts.EFFECTS["stiffness_scale"](0.0)
