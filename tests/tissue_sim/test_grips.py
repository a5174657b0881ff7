"""Finite elements of gripped specimens: both solvers, force control, channels, closed forms, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.closed_form.torsion import compute_torque_and_axial_force
from tissue_sim.experiment.grip import AXIAL_PULL, LATERAL_SHIFT, TWIST, GripMotion
from tissue_sim.pose import Pose

MOONEY = ts.Material("mooney_rivlin", {"C10": 1000.0, "C01": 500.0}, ts.Bulk("bulk_ratio", 1e3))
#: Radius and height of a cylinder, m.
CYLINDER = ts.Specimen(0.010, 0.020)
CUBE = ts.Block(0.010, 0.010, 0.010)
#: Protocol of a twist.
TURN = "ramp 30deg @1deg/s"


def make_model(kind, specimen, protocol, material=MOONEY, rig=None):
    return ts.Model(ts.KINDS[kind].experiment(specimen=specimen, protocol=protocol), material, rig or ts.Rig())


def simulate(*arguments, **options):
    return ts.simulate(make_model(*arguments), **options)


@pytest.mark.parametrize("grip", [AXIAL_PULL, LATERAL_SHIFT, TWIST, GripMotion((0.0, 1.0, 0.0))])
def test_amount_is_the_inverse_of_the_pose(grip):
    for amount in (-0.3, 0.0, 0.4, 7.0):
        assert grip.compute_amount(grip.pose(amount), near=amount - 0.2) == pytest.approx(amount, abs=1e-12)
    load = grip.compute_force_against_motion((1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    assert load == -(6.0 if grip.is_rotation else np.dot(grip.axis, (1.0, 2.0, 3.0)))


class TestAxisymmetricTension:
    def test_force_lies_between_those_of_free_and_of_prevented_lateral_contraction(self):
        """Bonded ends stiffen the cylinder: uniaxial stress < F / A < the modulus of a disc with the same ends."""
        recording = simulate("uniaxial_tension", CYLINDER, ts.Protocol.ramp(0.010, 5))
        form, area = ts.KINDS["uniaxial_tension"].closed_form, CYLINDER.area
        closed = area * form.stress(MOONEY.energy_law, 1.0 + recording.displacement / CYLINDER.height, MOONEY.values)
        ratio = recording.force[1:] / closed[1:]
        assert ((ratio > 1.1) & (ratio < 1.25)).all()
        solver = recording.metadata["solver"]
        assert solver["ends"] == "bonded to rigid grips" and solver["force_error"] < 0.005
        assert not solver["warnings"] and "Fz" not in recording

    def test_a_slender_cylinder_approaches_the_closed_form(self):
        slender = ts.Specimen(0.002, 0.100)
        recording = simulate("uniaxial_tension", slender, ts.Protocol.ramp(0.030, 3), estimate_error=False)
        stress = ts.KINDS["uniaxial_tension"].closed_form.stress(MOONEY.energy_law, 1.3, MOONEY.values)
        assert recording.force[-1] == pytest.approx(slender.area * stress, rel=0.01)
        assert recording.force[-1] > slender.area * stress

    def test_both_solvers_agree(self):
        recordings = [simulate("uniaxial_tension", CYLINDER, ts.Protocol.ramp(0.008, 3), estimate_error=False,
                               solver=solver) for solver in ("axisymmetric", "solid")]
        assert recordings[1].force[1:] == pytest.approx(recordings[0].force[1:], rel=0.01)

    def test_force_control_is_the_inverse_of_displacement_control(self):
        reference = simulate("uniaxial_tension", CYLINDER, ts.Protocol.ramp(0.030, 4), estimate_error=False)
        protocol = ts.Protocol(reference.time, force=reference.force)
        found = simulate("uniaxial_tension", CYLINDER, protocol, estimate_error=False)
        # Beyond the stretch 2, which a tool in compression cannot reach.
        np.testing.assert_allclose(found.displacement, reference.displacement, rtol=1e-6, atol=1e-9)

    def test_creep_under_a_held_force(self):
        series = ts.Prony((ts.PronyTerm(0.4, 2.0),))
        material = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3), viscoelastic=series)
        protocol = ts.Protocol.parse("ramp 0.1N @1N/s; hold 20s", points=4)
        found = simulate("uniaxial_tension", CYLINDER, protocol, material, estimate_error=False)
        held = found.displacement[found.labels["segment"] == "hold"]
        assert (np.diff(held) > 0).all() and held[-1] > 1.3 * held[0]

    def test_compliant_load_train(self):
        rigid = simulate("uniaxial_tension", CYLINDER, ts.Protocol.ramp(0.008, 3), estimate_error=False)
        rig = ts.Rig(compliance=1e-3)
        protocol = ts.Protocol(rigid.time, rigid.displacement + rig.compliance * rigid.force)
        found = simulate("uniaxial_tension", CYLINDER, protocol, MOONEY, rig, estimate_error=False)
        np.testing.assert_allclose(found.force, rigid.force, rtol=1e-6, atol=1e-12)

    def test_reversed_motion_compresses(self):
        found = simulate("uniaxial_tension", CYLINDER, ts.Protocol([0.0, 1.0, 2.0], [0.0, -0.004, 0.004]),
                         estimate_error=False)
        bonded = ts.KINDS["bonded_compression"].experiment(specimen=CYLINDER, protocol=ts.Protocol.ramp(0.004, 2))
        pushed = ts.simulate(ts.Model(bonded, MOONEY), estimate_error=False)
        assert found.force[1] == pytest.approx(-pushed.force[1], rel=1e-3) and found.force[2] > 0


    def test_a_force_beyond_all_stretches_of_soft_matter_is_not_reached(self):
        protocol = ts.Protocol([0.0, 1.0, 2.0], force=[0.0, 0.1, 500.0])
        with pytest.raises(ts.ConvergenceError, match=r"force of 500 N \(sample 3\), no displacement of the tool gives "
                                                      r"this force; at 500 mm the force is") as error:
            simulate("uniaxial_tension", CYLINDER, protocol, estimate_error=False)
        np.testing.assert_allclose(error.value.recording.force, [0.0, 0.1], atol=2e-9)


class TestSolid:
    def test_simple_shear_of_a_flat_block(self):
        """The free ends of the block carry less shear stress than the closed form: F < tau A, within h / L."""
        block = ts.Block(0.040, 0.010, 0.004)
        recording = simulate("simple_shear", block, ts.Protocol.ramp(0.004, 3), solver="solid")
        closed = block.area * ts.KINDS["simple_shear"].closed_form.stress(
            MOONEY.energy_law, recording.displacement / block.height, MOONEY.values)
        ratio = recording.force[1:] / closed[1:]
        assert ((ratio > 0.95) & (ratio < 1.0)).all()
        np.testing.assert_allclose(recording.channel("Fx"), -recording.force, atol=1e-12)
        assert recording.metadata["solver"]["ends"] == "bonded to rigid grips"

    def test_simple_shear_with_a_prescribed_force_and_back(self):
        reference = simulate("simple_shear", CUBE, ts.Protocol([0.0, 1.0, 2.0], [0.0, 0.002, -0.002]), solver="solid")
        assert reference.force[2] == pytest.approx(-reference.force[1], rel=1e-6)
        protocol = ts.Protocol(reference.time, force=reference.force)
        found = simulate("simple_shear", CUBE, protocol, solver="solid")
        np.testing.assert_allclose(found.displacement, reference.displacement, rtol=1e-5, atol=1e-9)

    def test_torsion_has_angle_and_torque(self):
        recording = simulate("torsion", ts.Specimen(0.010, 0.012), ts.Protocol.parse(TURN, points=3), solver="solid")
        torque, force = compute_torque_and_axial_force(MOONEY.energy_law, MOONEY.values,
                                                       recording.channel("angle") / 0.012, 0.010)
        np.testing.assert_allclose(np.degrees(recording.channel("angle")), [0.0, 15.0, 30.0], rtol=1e-12)
        np.testing.assert_allclose(recording.channel("torque")[1:], torque[1:], rtol=0.005)
        np.testing.assert_allclose(recording.channel("Fz")[1:], -force[1:], rtol=0.005)
        assert "displacement" not in recording and "force" not in recording

    def test_planar_tension_of_a_wide_strip(self):
        """A strip ten times as wide as high carries 1 to 2 % less than in pure shear."""
        strip = ts.Block(0.100, 0.001, 0.010)
        recording = simulate("planar_tension", strip, ts.Protocol.ramp(0.010, 3), solver="solid")
        closed = strip.area * ts.KINDS["planar_tension"].closed_form.stress(
            MOONEY.energy_law, 1.0 + recording.displacement / strip.height, MOONEY.values)
        ratio = recording.force[1:] / closed[1:]
        assert ((ratio > 0.97) & (ratio < 1.0)).all()


@pytest.mark.parametrize(("kind", "specimen", "protocol", "message"), [
    ("torsion", CYLINDER, ts.Protocol.ramp(0.001), r"protocol: must prescribe the motion of the grip; got lengths"),
    ("torsion", CYLINDER, ts.Protocol.parse("ramp 1N @1N/s"),
     r"protocol: must prescribe the motion of the grip; got forces, and a torque cannot be prescribed\. State an"),
    ("uniaxial_tension", CYLINDER, ts.Protocol.parse(TURN), r"protocol: must prescribe the motion of the grip; got a"),
    ("uniaxial_tension", CYLINDER, ts.Protocol.parse("approach 2mm; ramp 4mm"),
     r"protocol: must not approach the specimen, which the grips hold from the start; got an approach\. Start with a"),
    ("lubricated_compression", CYLINDER, ts.Protocol.parse(TURN), r"protocol: must prescribe displacements or forces"),
    ("torsion", CUBE, ts.Protocol.parse(TURN), r"specimen: must be a cylinder in torsion; got"),
    ("planar_tension", CYLINDER, ts.Protocol.ramp(0.001), r"specimen: must be a block in planar tension; got"),
    ("uniaxial_tension", CYLINDER, ts.Protocol([0.0, 1.0], [0.0, -0.020]), r"protocol: must be above -20 mm, where"),
    ("uniaxial_tension", ts.Specimen(0.010, 0.020, density=1000.0, gravity=9.81), ts.Protocol.ramp(0.001),
     r"specimen.gravity: must be 0 for a gripped specimen"),
    ("equibiaxial_tension", CUBE, ts.Protocol.ramp(0.001), r"equibiaxial_tension has no tool and is not simulated"),
])
def test_refused_experiments(kind, specimen, protocol, message):
    with pytest.raises(ts.InputError, match=message):
        ts.KINDS[kind].experiment(specimen=specimen, protocol=protocol)


@pytest.mark.parametrize("changes", [{"friction": "frictionless"}, {"tilt": 1e-4}, {"slip": 0.5}])
def test_grips_hold_the_ends(changes):
    with pytest.raises(ts.InputError, match=r"both grips must be plates|must be 0 for a gripped specimen"):
        ts.KINDS["uniaxial_tension"].experiment(specimen=CYLINDER, protocol=ts.Protocol.ramp(0.001), **changes)


def test_lateral_motion_and_twist_need_the_solid():
    for kind, protocol in (("simple_shear", ts.Protocol.ramp(0.001, 3)), ("torsion", ts.Protocol.parse(TURN))):
        with pytest.raises(ts.InputError, match=r"grip: must move along the axis for an axisymmetric solid.*--solid"):
            simulate(kind, CYLINDER, protocol)


def test_a_rig_has_no_effects_on_angle_and_torque():
    with pytest.raises(ts.InputError, match=r"rig: must be ideal for angle and torque"):
        make_model("torsion", CYLINDER, ts.Protocol.parse(TURN), MOONEY, ts.Rig(compliance=1e-4))


def test_in_real_time_a_gripped_specimen_is_refused():
    with pytest.raises(ts.InputError, match="grip: must be None in real time"):
        ts.Simulator(make_model("uniaxial_tension", CYLINDER, ts.Protocol.ramp(0.001)))


def test_effects_that_scale_the_force():
    scaled = replace(MOONEY, effects=[ts.EFFECTS["stiffness_scale"](1.2)])
    forces = [simulate("uniaxial_tension", CYLINDER, ts.Protocol.ramp(0.004, 3), material, estimate_error=False).force
              for material in (MOONEY, scaled)]
    np.testing.assert_allclose(forces[1], 1.2 * forces[0], rtol=1e-9)
    with pytest.raises(ts.InputError, match="must not scale the force by a displacement in torsion"):
        simulate("torsion", ts.Specimen(0.010, 0.012), ts.Protocol.parse(TURN, points=3), scaled, solver="solid")


def test_pose_of_a_tool_is_not_changed():
    experiment = ts.KINDS["lubricated_compression"].experiment(specimen=CYLINDER, protocol=ts.Protocol.ramp(0.001))
    assert experiment.tool_pose(0.001) == Pose.at_depth(0.001) and experiment.channels == ("displacement", "force")
