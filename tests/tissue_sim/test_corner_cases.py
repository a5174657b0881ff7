"""Combinations of features: profiles of every kind, parameters at the limits of their range, rigs and tilt."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.discretisation import build_mesh
from tissue_sim.mesh import structured_mesh
from tissue_sim.mesh.elements import Q9P1

STUDY = {"C10": 1404.9, "C20": 699.4}
MATERIAL = ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4))
SPECIMEN = ts.Specimen(0.040, 0.070)


def experiment(tool=None, text="ramp 2mm", points=5, **options):
    return ts.Experiment(SPECIMEN, ts.Protocol.parse(text, points), tool or ts.Tool(), **options)


def force(*arguments, material=MATERIAL, resolution="fast", **options):
    return ts.simulate(ts.Model(experiment(*arguments, **options), material), resolution=resolution).force


def profile(tmp_path, *points, **options):
    path = tmp_path / "tool.csv"
    path.write_text("".join(f"{r},{z}\n" for r, z in points), encoding="utf-8")
    return ts.Tool("profile", profile_file=path, **options)


class TestProfiles:
    @pytest.mark.parametrize("points", [[(0, 0), (8, 0)], [(0, 0), (8, 0), (8, 30)], [(0, 0), (4, 0), (8, 4)],
                                        [(0, 0), (7.95, 0), (8, 0.05), (8, 20)], [(0, 0), (8, 5)]])
    def test_surface_lies_on_the_file(self, tmp_path, points):
        """As wide as the file says far above its last point; the lines stay where they are."""
        tool = profile(tmp_path, *points)
        shape = tool.profile
        assert shape.gap(np.array([[8e-3 + 1e-4, 0.5]]))[0] == pytest.approx(1e-4, abs=1e-12)
        assert shape.gap(np.array([[0.0, 0.0]]))[0] == pytest.approx(0.0, abs=1e-12)

        assert np.diff(shape.vertices[:, 0]).min() >= 0 and np.diff(shape.vertices[:, 1]).min() >= 0

    def test_a_rounding_without_room_is_refused(self, tmp_path):
        with pytest.raises(ts.InputError, match="too short for corners rounded"):
            _ = profile(tmp_path, (0, 0), (7.95, 0), (8, 0.05), (8, 20), edge_radius=2e-3).profile

    def test_bonded_face_meets_the_chamfer_too(self, tmp_path):
        chamfer = profile(tmp_path, (0, 0), (4, 0), (8, 4))
        bonded, stick = (force(chamfer, "ramp 6mm", 7, friction=friction)[-1] for friction in ("bonded", "stick"))
        assert bonded == pytest.approx(stick, rel=0.05)

    @pytest.mark.slow
    def test_friction_of_a_side_in_the_file(self, tmp_path):
        """A straight side of the file is the shaft, as the one above the file is."""
        written, implied = (profile(tmp_path / name, *points) for name, points in (
            ("a", [(0, 0), (8, 0), (8, 30)]), ("b", [(0, 0), (8, 0)])) if (tmp_path / name).mkdir() is None)
        slides, sticks, same = (force(tool, "ramp 6mm", 7, friction="stick", friction_wall=wall)[-1]
                                for tool, wall in ((written, 0.0), (written, 2.0), (implied, 2.0)))
        assert sticks == pytest.approx(same, rel=1e-9) and abs(sticks / slides - 1) > 1e-6

    def test_a_pointed_one_has_the_contact_of_its_cone(self, tmp_path):
        cone = ts.Tool("cone", 8e-3, half_angle=np.radians(45))
        pointed = profile(tmp_path, (0, 0), (8, 8))
        assert pointed.contact_radius(2e-3) == pytest.approx(cone.contact_radius(2e-3))
        assert (build_mesh(experiment(pointed, friction="stick")).nodes.shape
                == build_mesh(experiment(cone, friction="stick")).nodes.shape)


class TestSensitivitiesAtTheEndOfTheRange:
    @pytest.mark.slow
    def test_friction_at_none(self):
        """One-sided, and not half of it."""
        slope = ts.sensitivities(ts.Model(experiment(friction="frictionless", friction_base="frictionless"), MATERIAL),
                                 ["experiment.friction"]).values[-1, 0]
        none, some = (force(friction=mu, friction_base="frictionless")[-1] for mu in (0.0, 0.01))
        assert slope == pytest.approx((some - none) / 0.01, rel=0.02)

    @pytest.mark.slow
    def test_the_sensor_is_left_out(self):
        names = ["experiment.friction", "C10"]
        plain, read = (ts.sensitivities(ts.Model(experiment(friction=0.1), MATERIAL, rig), names)
                       for rig in (ts.Rig(), ts.Rig(sensor_gain=0.5, force_resolution=0.01, sampling_rate=10.0)))
        np.testing.assert_allclose(read.values, plain.values, rtol=1e-12)
        np.testing.assert_array_equal(read.recording.force, plain.recording.force)

    def test_drop_of_nothing_and_pores_that_are_none(self):
        material = ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4),
                               poroelasticity=ts.Poroelasticity(0.0, 1e-4), puncture=ts.Puncture(1e-3, 0.0))
        answer = ts.sensitivities(ts.Model(experiment(ts.Tool("flat", 8e-3)), material),
                                  ["puncture.drop", "poroelasticity.phi"])
        assert answer.values[-1, 0] == pytest.approx(-answer.recording.force[-1], rel=1e-6)
        assert answer.values[-1, 1] < 0

    def test_geometry_moves_a_given_mesh(self):
        given = ts.sensitivities(ts.Model(experiment(), MATERIAL), ["experiment.specimen.radius"],
                                 mesh=build_mesh(experiment()))
        named = ts.sensitivities(ts.Model(experiment(), MATERIAL), ["experiment.specimen.radius"])
        np.testing.assert_array_equal(given.values, named.values)


def test_layered_lubricated_specimen_is_not_homogeneous():
    """A stiff layer spreads less than the rest: the meshes by name resolve that as a uniform fine one does."""
    material = ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4), layers=(ts.Layer(5e-3, 10.0),))
    test = experiment(text="ramp 7mm", points=8, friction="frictionless", friction_base="frictionless")
    z = np.concatenate([np.linspace(-0.070, -5e-3, 29), np.linspace(-5e-3, 0.0, 9)[1:]])
    fine = structured_mesh(np.linspace(0.0, 0.040, 21), z, Q9P1)
    expected = ts.simulate(ts.Model(test, material), mesh=fine).force[-1]
    for resolution, precision in (("fast", 1e-2), ("accurate", 2e-3)):
        found = ts.simulate(ts.Model(test, material), resolution=resolution).force[-1]
        assert found == pytest.approx(expected, rel=precision)


def test_tilt_counts_from_the_touch_not_from_the_reported_zero():
    curves = [ts.simulate(ts.Model(experiment(text="ramp 3mm", points=31, tilt=1e-3), MATERIAL,
                                   ts.Rig(contact_offset=offset))) for offset in (0.0, -0.5e-3)]
    early = np.interp(curves[0].displacement[:25] + 0.5e-3, curves[0].displacement, curves[0].force)
    np.testing.assert_allclose(curves[1].force[1:25], early[1:], rtol=0.02, atol=2e-3)


@pytest.mark.parametrize(("tool", "words"), [(ts.Tool(), "tool with a shaft; got a plate"),
                                             (ts.Tool("sphere", 8e-3), "tool with a shaft; got a sphere")])
def test_no_shaft_no_friction_of_it(tool, words):
    with pytest.raises(ts.InputError, match=words):
        experiment(tool, friction="stick", friction_wall=0.3)


@pytest.mark.slow
def test_adhesion_in_the_air():
    air = experiment(ts.Tool("sphere", 8e-3), "approach 1mm", friction="stick", adhesion=ts.Adhesion(0.1, 1e-4))
    assert abs(ts.simulate(ts.Model(air, MATERIAL)).force).max() < 1e-9


def test_fields_of_a_settled_specimen_before_the_touch():
    """A specimen that weighs and softens is stressed before the tool comes."""
    heavy = ts.Specimen(0.040, 0.070, density=1040.0, gravity=9.81)
    material = ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4), softening=ts.Softening(0.3))
    test = ts.Experiment(heavy, ts.Protocol.parse("approach 1mm; ramp 1mm", 3))
    fields = ts.simulate(ts.Model(test, material), fields=True).fields
    before, touch = (fields.at_points("von_mises", sample).max() for sample in (0, 2))
    assert before == pytest.approx(touch, rel=1e-6) and before > 100.0
