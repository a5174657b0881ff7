"""Rigs in whole simulations: the tool's true place is found with its force, sample by sample."""

import numpy as np
import pytest
from scipy.integrate import trapezoid

import tissue_sim as ts

#: Name of the law.
LAW = "reduced_polynomial_2"
#: Parameters of the reference study, Pa.
STUDY = {"C10": 1404.9, "C20": 699.4}
CYCLE = ts.Protocol.parse("ramp 10mm @1mm/s; hold 5s; unload", points=21)
#: Plate.
PLATE = ts.Tool()
#: Flat needle.
NEEDLE = ts.Tool("flat", 8e-3)
SERIES = ts.Prony((ts.PronyTerm(0.3, 2.0),))
SOFT = ts.Softening(0.4, modulus=20.0, share=0.5)
ELASTIC = {"friction": "bonded"}
LOSSY = {"friction": 0.3, "viscoelastic": SERIES}


def simulated(protocol=CYCLE, rig=None, tool=PLATE, friction="bonded", **material) -> ts.Recording:
    base = friction if tool is PLATE else "bonded"
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), protocol, tool=tool, friction=friction, friction_base=base)
    stuff = ts.Material(LAW, STUDY, ts.Bulk("bulk_ratio", 1e4), **material)
    return ts.simulate(ts.Model(experiment, stuff, rig or ts.Rig()))


@pytest.fixture(scope="module")
def ideal():
    return {"elastic": simulated(**ELASTIC), "lossy": simulated(**LOSSY)}


class TestFullSolve:
    @pytest.mark.slow
    @pytest.mark.parametrize("rig", [
        ts.Rig(compliance=0.05e-3), ts.Rig(compliance=0.5e-3), ts.Rig(compliance=0.1e-3, displacement_gain=-0.01),
        ts.Rig(compliance=0.1e-3, backlash=0.1e-3), ts.Rig(compliance=0.1e-3, step_loss=0.2e-3, step_loss_depth=6e-3),
    ], ids=["stiff", "soft", "gain", "backlash", "step loss"])
    @pytest.mark.parametrize(("case", "tool"), [
        (ELASTIC, PLATE), (LOSSY, PLATE), (LOSSY | {"friction": "stick"}, NEEDLE),
    ], ids=["elastic", "friction and relaxing", "relaxing needle"])
    def test_tool_and_force_fit_each_other(self, rig, case, tool):
        """A simulation with an ideal rig, driven along the true places D' - cF, gives the same forces: every sample,
        hold and return included."""
        found = simulated(rig=rig, tool=tool, **case)
        np.testing.assert_array_equal(found.displacement, CYCLE.displacement)
        true = rig.compute_unloaded_tool_displacement(CYCLE.displacement) - rig.compliance * found.force
        driven = simulated(ts.Protocol(CYCLE.time, true), tool=tool, **case)
        np.testing.assert_allclose(found.force, driven.force, atol=2e-6 * found.force.max())

    def test_relaxing_specimen_creeps_behind_a_spring(self):
        """In the hold the force falls and the tool moves further into the specimen."""
        c = 0.5e-3
        found = simulated(rig=ts.Rig(compliance=c), **LOSSY)
        hold = CYCLE.segment == "hold"
        depth = CYCLE.displacement - c * found.force
        assert (np.diff(depth[hold]) > 0).all() and (np.diff(found.force[hold]) < 0).all()

    @pytest.mark.parametrize("offset", [0.4e-3, 0.5e-3])
    @pytest.mark.parametrize(("friction", "tool"), [("bonded", PLATE), ("bonded", NEEDLE), ("frictionless", PLATE),
                                                    (0.3, PLATE), ("stick", NEEDLE)])
    def test_late_touch(self, friction, tool, offset):
        """Nothing is felt before the tool truly touches, also by one that is bonded from then on."""
        ramp = ts.Protocol.ramp(5e-3, 26, 1e-3)  # steps of 0.2 mm
        found = simulated(ramp, ts.Rig(contact_offset=offset), tool, friction)
        before = ramp.displacement <= offset - 1e-9
        assert before.sum() >= 2 and (found.force[before] == 0.0).all()
        later = ramp.displacement > offset + 1e-9
        driven = simulated(ts.Protocol(ramp.time[later], ramp.displacement[later] - offset), tool=tool,
                           friction=friction)
        np.testing.assert_allclose(found.force[later], driven.force, rtol=2e-4)

    def test_labels_and_readings(self):
        rig = ts.Rig(compliance=0.05e-3, zero_offset=0.1, sensor_gain=0.02, seed=2, force_noise=0.01)
        found, quiet = (simulated(rig=r, **ELASTIC) for r in (rig, ts.Rig(compliance=0.05e-3)))
        np.testing.assert_array_equal(found.labels["segment"], CYCLE.segment)
        np.testing.assert_array_equal(found.labels["cycle"], CYCLE.cycle)
        noise = found.force - 1.02 * quiet.force - 0.1
        assert 0.005 < noise.std() < 0.02 and abs(noise.mean()) < 0.005


class TestWithoutANewSolve:
    """`Rig.apply_motion_effects` against full solves, in shares of what the rig changes at most."""

    @pytest.mark.parametrize(("rig", "share"), [
        (ts.Rig(compliance=0.05e-3), 1e-4), (ts.Rig(compliance=0.5e-3), 1e-4), (ts.Rig(displacement_gain=-0.01), 1e-3),
        (ts.Rig(contact_offset=0.1e-3), 1e-3), (ts.Rig(backlash=0.05e-3), 1e-3),
    ], ids=["stiff", "soft", "gain", "offset", "backlash"])
    def test_elastic(self, ideal, rig, share):
        """Exact but for the interpolation; the last sample, where a bonded plate pulls above the touch, was not
        computed."""
        full, found = simulated(rig=rig, **ELASTIC).force, rig.apply_motion_effects(ideal["elastic"]).force
        size = abs(full - ideal["elastic"].force).max()
        assert size > 0.05
        assert abs(found - full)[:-1].max() < share * size

    @pytest.mark.parametrize(("rig", "ramp", "hold", "unload"), [
        (ts.Rig(compliance=0.05e-3), 0.07, 0.06, 0.05), (ts.Rig(compliance=0.5e-3), 0.05, 0.05, 0.04),
        (ts.Rig(displacement_gain=-0.01), 0.06, 0.06, 0.03), (ts.Rig(contact_offset=0.1e-3), 0.21, 0.05, 0.28),
        (ts.Rig(backlash=0.05e-3), 1e-6, 1e-6, 0.09),
    ], ids=["stiff", "soft", "gain", "offset", "backlash"])
    def test_first_order_with_history(self, ideal, rig, ramp, hold, unload):
        """Friction 0.3 at both plates and a relaxing specimen."""
        full, found = simulated(rig=rig, **LOSSY).force, rig.apply_motion_effects(ideal["lossy"]).force
        size = abs(full - ideal["lossy"].force).max()
        assert size > 0.05
        for name, share in (("ramp", ramp), ("hold", hold), ("unload", unload)):
            assert abs(found - full)[CYCLE.segment == name].max() < share * size


class TestCyclesAndAir:
    AIR = ts.Protocol.parse("approach 2mm @1mm/s; ramp 5mm; unload; retract 2mm; approach; ramp 5mm; retract 1mm",
                            points=9)

    @pytest.mark.slow
    @pytest.mark.parametrize(("tool", "friction"), [
        (PLATE, "frictionless"), (PLATE, 0.3), (PLATE, "stick"), (NEEDLE, "stick"), (ts.Tool("flat", 8e-3, 2e-3), 0.3),
        (ts.Tool("round", 8e-3), "frictionless"),
    ], ids=["frictionless", "friction", "stick", "needle", "needle with friction", "round tip"])
    @pytest.mark.parametrize("material", [{}, {"viscoelastic": SERIES, "softening": SOFT}], ids=["elastic", "lossy"])
    def test_nothing_is_felt_in_the_air(self, tool, friction, material):
        recording = simulated(self.AIR, tool=tool, friction=friction, **material)
        air = self.AIR.displacement < 0
        assert air.sum() > 20 and (recording.force[air] == 0.0).all()
        assert recording.force.min() > -1e-9 and recording.force[16] > 0.3

    @pytest.mark.parametrize("tool", [PLATE, NEEDLE], ids=["plate", "needle"])
    def test_bonded_tool_pulls_once_it_has_touched(self, tool):
        recording = simulated(self.AIR, tool=tool)
        cycle, air = self.AIR.cycle, self.AIR.displacement < 0
        first = np.arange(air.size) < 8
        assert (recording.force[air & first] == 0.0).all() and (recording.force[air & ~first] < 0).all()
        assert cycle.max() == 2 and recording.force[48] == pytest.approx(recording.force[16], rel=1e-6)

    @pytest.mark.parametrize("friction", ["bonded", 0.3, "frictionless"])
    def test_time_counts_from_the_touch(self, friction):
        """Samples every 0.2 mm from 0.35 mm above on: a relaxing specimen has been loaded for 0.05 s at the first one
        inside."""
        depth = 1e-4 * (np.arange(0.0, 40.0, 2.0) - 3.5)
        time = np.arange(depth.size) * 0.2
        fast = ts.Prony((ts.PronyTerm(0.5, 0.1),))
        found = simulated(ts.Protocol(time, depth), friction=friction, viscoelastic=fast).force
        inside = depth > 0
        touched = ts.Protocol(np.append(0.35, time[inside]), np.append(0.0, depth[inside]))
        expected = simulated(touched, friction=friction, viscoelastic=fast).force
        assert (found[~inside] == 0.0).all()
        np.testing.assert_allclose(found[inside], expected[1:], rtol=1e-6)

    def test_cycles_with_friction_and_softening(self):
        """Softening costs in the first cycle, friction in every one: by the area of the loops, in the work of the
        first loading."""
        protocol = ts.Protocol.parse("repeat 3 (ramp 6mm @1mm/s; unload)", points=25)

        def loops(**case):
            force, depth = simulated(protocol, **case).force, protocol.displacement
            starts = [max(np.flatnonzero(protocol.cycle == n)[0] - 1, 0) for n in (1, 2, 3)]
            areas = [trapezoid(force[s:s + 49], depth[s:s + 49]) for s in starts]
            return np.array(areas) / trapezoid(force[:25], depth[:25])

        friction, both = loops(friction=0.1), loops(friction=0.1, softening=SOFT)
        assert (friction > 0.02).all() and friction[2] == pytest.approx(friction[1], rel=1e-2)
        assert both[0] > friction[0] + 0.1
        assert (both[1:] > 0.01).all() and both[2] == pytest.approx(both[1], rel=2e-2)
