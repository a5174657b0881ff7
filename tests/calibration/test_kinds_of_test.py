"""Calibration of planar and equibiaxial tension, confined compression and torsion from recordings."""

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration.campaign.campaign import load_campaign
from calibration.campaign.measured import read_measured_curves
from calibration.effects.effect import DiagnosisData
from tissue_sim.closed_form.torsion import compute_torque_and_axial_force

TRUTH = {"C10": 5000.0, "C01": 2000.0}
LAW = ts.find_law("mooney_rivlin")
#: Radius, m.
RADIUS = 0.010
#: Height, m.
HEIGHT = 0.012


def write_campaign(folder, tests, fit, specimen='shape = "cylinder"\nradius_mm = 10.0\nheight_mm = 12.0'):
    lines = [f"[[specimen]]\n{specimen}", *(
        f'[[test]]\nname = "{kind}"\nkind = "{kind}"\nrecordings = ["{kind}_*.csv"]' for kind in tests),
        f"[fit]\n{fit}"]
    (folder / "study.toml").write_text("\n\n".join(lines) + "\n", encoding="utf-8")
    return folder / "study.toml"


def write_recording(folder, kind, **channels):
    size = next(iter(channels.values())).size
    ts.write_recording(ts.Recording({"time": np.arange(float(size)), **channels}), folder / f"{kind}_1.csv")


def test_sheets_and_torsion_determine_both_parameters(tmp_path):
    noise = np.random.default_rng(3)
    stretch = np.linspace(1.0, 1.6, 61)
    for kind, mode in (("planar_tension", "planar"), ("equibiaxial_tension", "equibiaxial")):
        stress = LAW.nominal_stress(stretch, TRUTH, mode) + noise.normal(0.0, 5.0, stretch.size)
        write_recording(tmp_path, kind, displacement=(stretch - 1.0) * HEIGHT, force=stress * np.pi * RADIUS**2)
    angle = np.linspace(0.0, 1.0, 61)
    torque, _ = compute_torque_and_axial_force(LAW, TRUTH, angle / HEIGHT, RADIUS)
    write_recording(tmp_path, "torsion", angle=angle, torque=torque + noise.normal(0.0, 1e-5, angle.size))
    path = write_campaign(tmp_path, ("planar_tension", "equibiaxial_tension", "torsion"), 'laws = ["mooney_rivlin"]')
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert result.best.parameters == pytest.approx(TRUTH, rel=2e-3)
    for name, value in TRUTH.items():
        assert abs(result.best.parameters[name] - value) < 4 * result.best.standard_errors[name]


def test_torsion_alone_determines_the_sum(tmp_path):
    angle = np.linspace(0.0, 1.0, 61)
    torque, _ = compute_torque_and_axial_force(LAW, TRUTH, angle / HEIGHT, RADIUS)
    write_recording(tmp_path, "torsion", angle=angle, torque=torque)
    path = write_campaign(tmp_path, ("torsion",), 'laws = ["neo_hooke"]\n\n[noise]\nnominal_stress_Pa = 1.0')
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert result.best.parameters["C10"] == pytest.approx(sum(TRUTH.values()), rel=1e-6)


def test_torsion_has_no_noise_of_a_force(tmp_path):
    """The noise of a torque is that of the stress at the rim, 2 M / (pi a^3)."""
    angle = np.linspace(0.0, 1.0, 201)
    torque, _ = compute_torque_and_axial_force(LAW, TRUTH, angle / HEIGHT, RADIUS)
    noise = 2e-5
    write_recording(tmp_path, "torsion", angle=angle, torque=torque + np.random.default_rng(2).normal(0.0, noise, 201))
    path = write_campaign(tmp_path, ("torsion",), 'laws = ["neo_hooke"]\n\n[noise]\nforce_N = 0.01')
    with pytest.raises(ts.InputError, match=r"noise\.force_N: must be left out, because no test has a force; "
                                            r"got 0\.01 N.*State nominal_stress_Pa"):
        calibration.calibrate([path], tmp_path / "out", figures=False)
    stress = 2.0 * noise / (np.pi * RADIUS**3)
    path = write_campaign(tmp_path, ("torsion",), f'laws = ["neo_hooke"]\n\n[noise]\nnominal_stress_Pa = {stress}')
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    # 201 samples determine the ratio of the residuals to the noise to 5 %.
    assert 0.85 < result.best.noise_ratio < 1.15


def test_torsion_with_axial_force_determines_both_parameters(tmp_path):
    """The torque determines C10 + C01, the axial force C10 + 2 C01."""
    noise = np.random.default_rng(6)
    angle = np.linspace(0.0, 1.0, 61)
    torque, force = compute_torque_and_axial_force(LAW, TRUTH, angle / HEIGHT, RADIUS)
    write_recording(tmp_path, "torsion_axial_force", angle=angle, torque=torque + noise.normal(0.0, 1e-5, angle.size),
                    force=-force + noise.normal(0.0, 1e-3, angle.size))
    path = write_campaign(tmp_path, ("torsion_axial_force",), 'laws = ["mooney_rivlin"]')
    best = calibration.calibrate([path], tmp_path / "out", figures=False)[0].best
    assert best.status == "converged", best.message
    assert best.parameters == pytest.approx(TRUTH, rel=5e-3)
    for name, value in TRUTH.items():
        assert abs(best.parameters[name] - value) < 4 * best.standard_errors[name]


def test_torsion_with_axial_force_is_imported_by_named_columns(tmp_path):
    angle = np.linspace(0.0, 1.0, 21)
    torque, force = compute_torque_and_axial_force(LAW, TRUTH, angle / HEIGHT, RADIUS)
    path = tmp_path / "a.csv"
    path.write_text("Angle (rad),Torque (mN m),Normal force (N)\n" + "".join(
        f"{a:.6g},{1e3 * b:.6g},{-c:.6g}\n" for a, b, c in zip(angle, torque, force, strict=True)), encoding="utf-8")
    hints = calibration.InterpretationOverrides(
        kind="torsion_axial_force", columns={"angle": "Angle", "torque": "Torque", "force": "Normal force"})
    imported = calibration.import_files([path], tmp_path / "study.toml", calibration.ImportOptions(
        hints, specimen={"radius_mm": 10.0, "height_mm": 12.0}, laws=("mooney_rivlin",)))
    assert imported.is_complete, (imported.missing, imported.problem)
    result, = calibration.calibrate([tmp_path / "study.toml"], tmp_path / "out", figures=False)
    assert result.best.parameters == pytest.approx(TRUTH, rel=1e-4)


def test_axial_force_with_memory_is_refused(tmp_path):
    angle = np.linspace(0.0, 1.0, 61)
    torque, force = compute_torque_and_axial_force(LAW, TRUTH, angle / HEIGHT, RADIUS)
    write_recording(tmp_path, "torsion_axial_force", angle=angle, torque=torque, force=-force)
    path = write_campaign(tmp_path, ("torsion_axial_force",), 'laws = ["mooney_rivlin"]\nstart = { '
                          '"viscoelastic.terms[0].g" = 0.3, "viscoelastic.terms[0].tau" = 10.0 }')
    with pytest.raises(ts.InputError, match="torsion_axial_force axial force requires a material without memory"):
        calibration.calibrate([path], tmp_path / "out", figures=False)


def test_torsion_needs_a_cylinder(tmp_path):
    angle = np.linspace(0.0, 1.0, 61)
    write_recording(tmp_path, "torsion", angle=angle, torque=1e-3 * angle)
    path = write_campaign(tmp_path, ("torsion",), 'laws = ["neo_hooke"]',
                          'shape = "block"\nlength_mm = 10.0\nwidth_mm = 10.0\nheight_mm = 12.0')
    with pytest.raises(ts.InputError, match="must be a cylinder in torsion"):
        calibration.calibrate([path], tmp_path / "out", figures=False)


def test_torsion_refuses_a_prism(tmp_path):
    angle = np.linspace(0.0, 1.0, 61)
    write_recording(tmp_path, "torsion", angle=angle, torque=1e-3 * angle)
    path = write_campaign(tmp_path, ("torsion",), 'laws = ["neo_hooke"]',
                          'shape = "prism"\narea_mm2 = 314.16\nheight_mm = 12.0')
    with pytest.raises(ts.InputError, match="torsion requires a circular cross-section"):
        calibration.calibrate([path], tmp_path / "out", figures=False)


def make_confined_force(material, stretch):
    from tissue_sim.closed_form.confined import CONFINED

    return -np.pi * RADIUS**2 * CONFINED.stress_history(material, np.arange(float(stretch.size)), stretch, RADIUS)


def test_confined_compression_alone_with_a_stated_ratio(tmp_path):
    material = ts.Material("neo_hooke", {"C10": 5000.0}, ts.Bulk("bulk_ratio", 8.0))
    stretch = np.linspace(1.0, 0.8, 41)
    write_recording(tmp_path, "confined_compression", displacement=(1.0 - stretch) * HEIGHT,
                    force=make_confined_force(material, stretch))
    path = write_campaign(tmp_path, ("confined_compression",), 'laws = ["neo_hooke"]')
    with pytest.raises(ts.InputError, match=r"fit\.bulk_ratio: must be given for confined_compression"):
        calibration.calibrate([path], tmp_path / "out", figures=False)
    path = write_campaign(tmp_path, ("confined_compression",), 'laws = ["neo_hooke"]\nbulk_ratio = 8.0\n\n[noise]\n'
                          "force_N = 0.001")
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert result.best.parameters["C10"] == pytest.approx(5000.0, rel=1e-6)
    assert calibration.fit.result.compute_aggregate_modulus_or_none(result.campaign, result.best) == pytest.approx(
        8e4 + 4e4 / 3, rel=1e-6)


@pytest.mark.parametrize("reading", ["without time", "strain_points = 20", "two long recordings"])
def test_confined_compression_without_history(tmp_path, reading):
    material = ts.Material("neo_hooke", {"C10": 5000.0}, ts.Bulk("bulk_ratio", 8.0))
    stretch = np.linspace(1.0, 0.8, 6000 if reading.startswith("two") else 41)
    channels = {"displacement": (1.0 - stretch) * HEIGHT, "force": make_confined_force(material, stretch)}
    noise = np.random.default_rng(4)
    for number in range(2 if reading.startswith("two") else 1):
        noisy = channels | {"force": channels["force"] + noise.normal(0.0, 1e-3, stretch.size)}
        if reading != "without time":
            noisy = {"time": np.arange(float(stretch.size))} | noisy
        ts.write_recording(ts.Recording(noisy), tmp_path / f"confined_compression_{number}.csv")
    fit = reading if reading.startswith("strain") else ""
    path = write_campaign(tmp_path, ("confined_compression",),
                          f'laws = ["neo_hooke"]\nbulk_ratio = 8.0\n{fit}\n\n[noise]\nforce_N = 0.001')
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert result.best.parameters["C10"] == pytest.approx(5000.0, rel=1e-3)


@pytest.mark.parametrize(("kind", "fit"), [
    ("confined_compression", "bulk_ratio = 8.0"),
    ("confined_compression", 'method = "inverse_fem"\nstart = { C10 = 5000.0, "bulk.K_Pa" = 8e4 }'),
    ("simple_shear", ""), ("planar_tension", ""), ("equibiaxial_tension", ""), ("torsion", ""),
    ("torsion_axial_force", "")])
def test_the_estimated_modulus_of_a_diagnosis_is_that_of_the_kind(tmp_path, kind, fit):
    """Trial values of effects follow from the modulus 10 kPa, which linear elasticity gives for each kind."""
    material = ts.Material("neo_hooke", {"C10": 5000.0}, ts.Bulk("bulk_ratio", 8.0))
    strain = np.linspace(0.0, 1e-3, 41)
    area = np.pi * RADIUS**2
    slopes = {"simple_shear": 1e4, "planar_tension": 4e4, "equibiaxial_tension": 6e4}
    if kind.startswith("torsion"):
        torque, axial = compute_torque_and_axial_force(ts.find_law("neo_hooke"), {"C10": 5000.0}, strain / RADIUS,
                                                       RADIUS)
        loads = {"torque": torque} if kind == "torsion" else {"torque": torque, "force": -axial}
        write_recording(tmp_path, kind, angle=strain / RADIUS * HEIGHT, **loads)
    else:
        force = make_confined_force(material, 1.0 - strain) if kind == "confined_compression" \
            else slopes[kind] * strain * area
        write_recording(tmp_path, kind, displacement=strain * HEIGHT, force=force)
    path = write_campaign(tmp_path, (kind,), f'laws = ["neo_hooke"]\n{fit}\n\n[noise]\nforce_N = 1e-6'
                          if not kind.startswith("torsion") else 'laws = ["neo_hooke"]')
    campaign = load_campaign(path)
    data = DiagnosisData(campaign, read_measured_curves(campaign), "neo_hooke")
    assert data.estimated_shear_modulus == pytest.approx(1e4, rel=5e-3)


def test_air_before_confined_compression_carries_no_force(tmp_path):
    material = ts.Material("neo_hooke", {"C10": 5000.0}, ts.Bulk("bulk_ratio", 8.0))
    displacement = np.linspace(-0.5e-3, 2e-3, 101)
    force = make_confined_force(material, 1.0 - np.maximum(displacement, 0.0) / HEIGHT)
    noise = np.random.default_rng(4).normal(0.0, 1e-3, force.size)
    write_recording(tmp_path, "confined_compression", displacement=displacement + 0.5e-3, force=force + noise)
    path = write_campaign(tmp_path, ("confined_compression",),
                          'laws = ["neo_hooke"]\nbulk_ratio = 8.0\noffset = "fit"\noffset_prior_mm = 1.0\n'
                          "offset_bounds_mm = 1.0\n\n[noise]\nforce_N = 0.001")
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert abs(result.best.parameters["C10"] - 5000.0) < 4 * result.best.standard_errors["C10"]
    assert result.best.standard_errors["C10"] < 50.0


def test_a_fitted_bulk_modulus_is_not_combined_with_a_gripped_test(tmp_path):
    for kind in ("confined_compression", "uniaxial_tension"):
        write_recording(tmp_path, kind, displacement=np.linspace(0.0, 1e-3, 21), force=np.linspace(0.0, 1.0, 21))
    path = write_campaign(tmp_path, ("confined_compression", "uniaxial_tension"),
                          'method = "inverse_fem"\nlaws = ["neo_hooke"]\nstart = { C10 = 4000.0, "bulk.K_Pa" = 5e4 }')
    with pytest.raises(ts.InputError, match=r"fit\.start\.bulk\.K_Pa: must not be fitted with uniaxial_tension"):
        calibration.calibrate([path], tmp_path / "out", figures=False)


def test_a_fitted_bulk_modulus_needs_finite_elements_for_free_sides(tmp_path):
    for kind in ("confined_compression", "lubricated_compression"):
        write_recording(tmp_path, kind, displacement=np.linspace(0.0, 1e-3, 21), force=np.linspace(0.0, 1.0, 21))
    path = write_campaign(tmp_path, ("confined_compression", "lubricated_compression"),
                          'laws = ["neo_hooke"]\nstart = { C10 = 4000.0, "bulk.K_Pa" = 5e4 }')
    with pytest.raises(ts.InputError, match=r"fit\.method: must be 'inverse_fem' to fit bulk\.K_Pa"):
        calibration.calibrate([path], tmp_path / "out", figures=False)


@pytest.mark.slow
def test_bulk_modulus_is_identified_with_a_test_with_free_sides(tmp_path):
    truth = ts.Material("neo_hooke", {"C10": 5000.0}, ts.Bulk("K_Pa", 80e3))
    noise = np.random.default_rng(5)
    for kind in ("confined_compression", "lubricated_compression"):
        experiment = ts.KINDS[kind].experiment(specimen=ts.Specimen(RADIUS, HEIGHT),
                                               protocol=ts.Protocol.ramp(0.1 * HEIGHT, 41))
        found = ts.simulate(ts.Model(experiment, truth))
        force = found.force + noise.normal(0.0, 2e-3, len(found))
        ts.write_recording(found.with_channels(force=force), tmp_path / f"{kind}_1.csv")
    path = write_campaign(tmp_path, ("confined_compression", "lubricated_compression"),
                          'method = "inverse_fem"\nlaws = ["neo_hooke"]\n'
                          'start = { C10 = 4000.0, "bulk.K_Pa" = 5e4 }\n\n[noise]\nforce_N = 0.002')
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert result.best.parameters["C10"] == pytest.approx(5000.0, rel=5e-3)
    assert result.best.parameters["bulk.K_Pa"] == pytest.approx(80e3, rel=5e-3)
    assert abs(result.best.parameters["bulk.K_Pa"] - 80e3) < 4 * result.best.standard_errors["bulk.K_Pa"]
