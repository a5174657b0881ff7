"""Tables of storage and loss modulus in a campaign: fits, joint fits, readout of the instrument, errors, coverage."""

import re
from pathlib import Path

import numpy as np
import pytest

import tissue_sim as ts
from calibration import calibrate, diagnose, load_campaign, read_measured_curves
from calibration.campaign.modulus_tables import estimate_noise_of_moduli
from calibration.fit.problem import build_generalised_problem
from calibration.fit.trust_region import minimise_from_start
from calibration.fit.uncertainty import compute_marginal_uncertainty
from calibration.forward.simulation_cache import SimulationCache
from tissue_sim.rig.modulus_readout import ModulusReadout

TRUTH = {"C10": 1000.0, "viscoelastic.terms[0].g": 0.3, "viscoelastic.terms[0].tau": 0.02,
         "viscoelastic.terms[1].g": 0.25, "viscoelastic.terms[1].tau": 0.5}
GEL = ts.Material("neo_hooke", {"C10": 1000.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 0.02),
                                                                      ts.PronyTerm(0.25, 0.5))))
FREQUENCY = np.geomspace(0.05, 50.0, 25)
START = ('start = { "viscoelastic.terms[0].g" = 0.2, "viscoelastic.terms[0].tau_s" = 0.03, '
         '"viscoelastic.terms[1].g" = 0.2, "viscoelastic.terms[1].tau_s" = 0.3 }\n')
TABLE = """
[[test]]
name = "sweep"
kind = "{kind}"
recordings = ["{file}"]
{keys}
[test.columns]
frequency = "omega"
"storage modulus" = "G'"
"loss modulus" = "G''"
"""


def write_table(path: Path, modulus: np.ndarray, frequency: np.ndarray = FREQUENCY, noise=None) -> None:
    """Write moduli, Pa, over the angular frequency, rad/s; `noise` has the relative noise of both, shape (2, n)."""
    storage, loss = np.array([modulus.real, modulus.imag]) * (1.0 if noise is None else np.exp(noise))
    rows = [f"{float(2 * np.pi * f)!r},{float(a)!r},{float(b)!r}" for f, a, b in zip(frequency, storage, loss,
                                                                                    strict=True)]
    path.write_text("\n".join(["omega [rad/s],G' [Pa],G'' [Pa]", *rows]) + "\n", encoding="utf-8")


def make_campaign(folder: Path, modulus: np.ndarray, *, kind: str = "simple_shear", keys: str = "",
                  law: str = "neo_hooke", fit: str = START, noise: str = "", more: str = "", table=None):
    """Write a campaign with a table of moduli, and load it."""
    write_table(folder / "sweep.csv", modulus, noise=table)
    path = folder / "campaign.toml"
    path.write_text(TABLE.format(kind=kind, file="sweep.csv", keys=keys) + more + "[fit]\nmethod = 'inverse_fem'\n"
                    f"laws = ['{law}']\n" + fit + noise, encoding="utf-8")
    return load_campaign(path)


def fit(campaign, law: str = "neo_hooke", start: dict[str, float] | None = None):
    """Return the problem, the descent and the estimates by name; the moduli of the start are 1000 Pa."""
    problem = build_generalised_problem(law, campaign, read_measured_curves(campaign), SimulationCache())
    space = problem.space
    values = np.array([(start or {}).get(name, space.start.get(name, 1000.0)) for name in space.free])
    end = minimise_from_start(problem, values)
    return problem, end, dict(zip(space.free, end.theta.tolist(), strict=True))


def test_an_exact_table_gives_the_material(tmp_path):
    problem, end, found = fit(make_campaign(tmp_path, ts.complex_modulus(GEL, FREQUENCY, "simple_shear")))
    assert end.converged and found == pytest.approx(TRUTH, rel=1e-5)
    assert [test.name for test in problem.tests] == ["sweep storage modulus", "sweep loss modulus"]


@pytest.mark.parametrize(("kind", "strain"), [
    ("uniaxial_tension", 0.3), ("lubricated_compression", 0.2), ("torsion", 0.5), ("planar_tension", 0.0)])
def test_every_kind_and_pre_strain(tmp_path, kind, strain):
    """The exponent of a law is determined by the modulus about two pre-strains."""
    rubber = ts.Material("ogden_1", {"mu1": 2000.0, "alpha1": 6.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.4, 0.1),)))
    form, abscissa = ts.KINDS[kind].require_closed_form(), ts.KINDS[
        kind].convert_nominal_strain_to_stretch_or_shear_strain
    write_table(tmp_path / "rest.csv", form.complex_modulus(rubber, FREQUENCY))
    campaign = make_campaign(
        tmp_path, form.complex_modulus(rubber, FREQUENCY, abscissa(strain)), kind=kind, keys=f"pre_strain = {strain}",
        more=TABLE.format(kind=kind, file="rest.csv", keys="").replace('"sweep"', '"rest"'), law="ogden_1",
        fit=f"start = {{ mu1 = 1500.0, {'alpha1 = 5.5, ' if strain else ''}"
        '"viscoelastic.terms[0].g" = 0.2, "viscoelastic.terms[0].tau_s" = 0.3 }\n'
        + ("" if strain else "fixed = { alpha1 = 6.0 }\n"))
    _, end, found = fit(campaign, "ogden_1")
    expected = {"mu1": 2000.0, "alpha1": 6.0, "viscoelastic.terms[0].g": 0.4, "viscoelastic.terms[0].tau": 0.1}
    assert end.converged and found == pytest.approx({name: expected[name] for name in found}, rel=1e-3)


def test_joint_fit_of_a_modulus_table_and_a_relaxation_test(tmp_path):
    """The sweep determines the short time, the hold the long one."""
    time = np.concatenate([np.linspace(0.0, 1.0, 21), np.linspace(1.05, 30.0, 120)])
    stretch = 1.0 - 0.2 * np.minimum(time, 1.0)
    slow = ts.Material("neo_hooke", {"C10": 1000.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 0.02),
                                                                           ts.PronyTerm(0.25, 5.0))))
    stress = ts.nominal_stress_history(slow, time, stretch)
    hold = ts.Recording({"time": time, "stretch": stretch, "nominal stress": stress})
    ts.write_recording(hold, tmp_path / "hold.csv")
    fast = FREQUENCY[FREQUENCY > 1.0]
    write_table(tmp_path / "fast.csv", ts.complex_modulus(slow, fast, "simple_shear"), fast)
    campaign = make_campaign(
        tmp_path, ts.complex_modulus(slow, FREQUENCY, "simple_shear"), keys="hold_out = true",
        more=TABLE.format(kind="simple_shear", file="fast.csv", keys="").replace('"sweep"', '"fast"')
        + "[[test]]\nname = 'hold'\nkind = 'lubricated_compression'\nrecordings = ['hold.csv']\n",
        noise="[noise]\nnominal_stress_Pa = 2.0\nmodulus_relative = 0.02\ncontact_jitter_mm = 0.0\n"
              "zero_jitter_N = 0.0\n")
    problem, end, found = fit(campaign)
    assert end.converged and len(problem.tests) == 3
    assert found == pytest.approx(TRUTH | {"viscoelastic.terms[1].tau": 5.0}, rel=1e-3)


def test_fractional_zener_of_a_table(tmp_path):
    model = ts.FractionalZener(alpha=0.5, g=0.6, tau=0.1, shortest=1e-4, longest=1e2)
    gel = ts.Material("neo_hooke", {"C10": 1000.0}, viscoelastic=ts.FractionalRelaxation(model))
    name = "viscoelastic.fractional_zener"
    campaign = make_campaign(tmp_path, ts.complex_modulus(gel, FREQUENCY, "simple_shear"), fit=(
        f'fixed = {{ "{name}.from_s" = 1e-4, "{name}.to_s" = 1e2 }}\n'
        f'start = {{ "{name}.alpha" = 0.7, "{name}.g" = 0.4, "{name}.tau_s" = 0.3 }}\n'))
    _, end, found = fit(campaign)
    assert end.converged
    assert found == pytest.approx({"C10": 1000.0, f"{name}.alpha": 0.5, f"{name}.g": 0.6, f"{name}.tau": 0.1}, rel=1e-3)


class TestReadout:
    READOUT = ModulusReadout(inertia=0.004, compliance=4e-5, delay=5e-5)

    def test_formula(self):
        """In series with a spring 1/c, then in parallel with an inertia, then delayed."""
        omega = 2 * np.pi * FREQUENCY
        true = ts.complex_modulus(GEL, FREQUENCY, "simple_shear")
        expected = (1.0 / (1.0 / true + 4e-5) - 0.004 * omega**2) * (np.cos(omega * 5e-5) - 1j * np.sin(omega * 5e-5))
        np.testing.assert_allclose(self.READOUT.compute_reading(true, FREQUENCY), expected, rtol=1e-12)
        np.testing.assert_array_equal(ModulusReadout().compute_reading(true, FREQUENCY), true)

    @pytest.mark.parametrize(("key", "name", "value", "readout"), [
        ("inertia_Pa_s2", "inertia", 0.004, ModulusReadout(inertia=0.004)),
        ("delay_s", "delay", 5e-5, ModulusReadout(delay=5e-5))])
    def test_inertia_and_delay_are_fitted(self, tmp_path, key, name, value, readout):
        frequency = FREQUENCY
        modulus = readout.compute_reading(ts.complex_modulus(GEL, frequency, "simple_shear"), frequency)
        campaign = make_campaign(tmp_path, modulus, fit=START.replace("}", f', "readout.{key}" = 0.0 }}'))
        _, end, found = fit(campaign)
        assert end.converged and found == pytest.approx(TRUTH | {f"readout.{name}": value}, rel=1e-4)

    def test_fixed_readout(self, tmp_path):
        modulus = self.READOUT.compute_reading(ts.complex_modulus(GEL, FREQUENCY, "simple_shear"), FREQUENCY)
        campaign = make_campaign(tmp_path, modulus, fit=START + (
            'fixed = { "readout.inertia_Pa_s2" = 0.004, "readout.compliance_per_Pa" = 4e-5, '
            '"readout.delay_s" = 5e-5 }\n'))
        _, end, found = fit(campaign)
        assert end.converged and found == pytest.approx(TRUTH, rel=1e-5)


@pytest.mark.parametrize("columns", [
    ("storage modulus", "loss factor"), ("complex modulus", "loss factor"), ("loss modulus", "loss factor")])
def test_moduli_from_the_loss_factor(tmp_path, columns):
    modulus = ts.complex_modulus(GEL, FREQUENCY, "simple_shear")
    known = {"storage modulus": modulus.real, "loss modulus": modulus.imag, "complex modulus": np.abs(modulus),
             "loss factor": modulus.imag / modulus.real}
    recording = ts.Recording({"frequency": FREQUENCY, **{name: known[name] for name in columns}})
    ts.write_recording(recording, tmp_path / "sweep.csv")
    path = tmp_path / "campaign.toml"
    path.write_text("[[test]]\nkind = 'simple_shear'\nrecordings = ['sweep.csv']\n[test.columns]\n"
                    "frequency = 'frequency'\n" + "".join(f'"{name}" = "{name}"\n' for name in columns)
                    + "[fit]\nmethod = 'inverse_fem'\nlaws = ['neo_hooke']\n" + START, encoding="utf-8")
    curves = read_measured_curves(load_campaign(path))
    for name in ("storage modulus", "loss modulus"):
        np.testing.assert_allclose(np.exp(curves[f"simple_shear {name}"][0].force), known[name], rtol=1e-7)


class TestErrors:
    MODULUS = ts.complex_modulus(GEL, FREQUENCY, "simple_shear")

    def require_error(self, folder, match: str, read: bool = False, replace=("", ""), **options):
        with pytest.raises(ts.InputError, match=match):
            campaign = make_campaign(folder, **({"modulus": self.MODULUS} | options))
            path = campaign.path
            if replace[0]:
                path.write_text(path.read_text(encoding="utf-8").replace(*replace), encoding="utf-8")
                load_campaign(path)
            if read:
                read_measured_curves(campaign)

    def test_analytical_method(self, tmp_path):
        self.require_error(tmp_path, r"columns.frequency: fit.method must be 'inverse_fem' for a table of moduli",
                           replace=("inverse_fem", "analytical"))

    @pytest.mark.parametrize("keys", ["max_strain = 0.1", "speed_mm_s = 1.0", "rig = 'a.toml'"])
    def test_keys_without_effect(self, tmp_path, keys):
        self.require_error(tmp_path, f"{keys.split()[0]} must not be given for a table", keys=keys)

    def test_kind_without_closed_form(self, tmp_path):
        self.require_error(tmp_path, "bonded_compression needs columns 'displacement' and 'force'",
                           kind="bonded_compression")

    def test_pre_strain(self, tmp_path):
        self.require_error(tmp_path, "pre_strain must be a nominal strain, positive under load and below 1",
                           kind="lubricated_compression", keys="pre_strain = 1.0")

    def test_pre_strain_of_a_motion(self, tmp_path):
        path = tmp_path / "a.toml"
        path.write_text("[[test]]\nkind = 'simple_shear'\nrecordings = []\npre_strain = 0.1\n[fit]\n"
                        "laws = ['neo_hooke']\n", encoding="utf-8")
        with pytest.raises(ts.InputError, match="pre_strain must be left out for a recording"):
            load_campaign(path)

    def test_a_material_that_does_not_relax(self, tmp_path):
        self.require_error(tmp_path, "fit.start: sweep.csv contains a loss modulus, which requires a material that "
                           "relaxes", read=True, fit="")

    def test_a_modulus_that_is_not_positive(self, tmp_path):
        modulus = self.MODULUS.copy()
        modulus[3] = modulus[3].real - 1j
        self.require_error(tmp_path, r"loss modulus must be positive, because .* in row 4. Leave rows out with "
                           r"leave_out = \[4\]", read=True, modulus=modulus)
        campaign = make_campaign(tmp_path, modulus, keys="leave_out = [4]")
        assert [curve.force.size for curves in read_measured_curves(campaign).values() for curve in curves] == [24, 24]


def test_noise_is_that_of_pseudo_residuals():
    """On curves of this shape, 2 % of noise and 25 frequencies: 2 % in the mean, with a scatter of a fifth."""
    rng = np.random.default_rng(2)
    modulus = ts.complex_modulus(GEL, FREQUENCY, "simple_shear")
    for part in (modulus.real, modulus.imag):
        found = [estimate_noise_of_moduli([(FREQUENCY, np.log(part) + 0.02 * rng.standard_normal(25))], None).deviation
                 for _ in range(200)]
        assert np.sqrt(np.mean(np.square(found))) == pytest.approx(0.02, rel=0.05)
        assert 0.1 < np.std(found) / 0.02 < 0.3
    assert estimate_noise_of_moduli([(FREQUENCY, np.log(modulus.real))], 0.03).deviation == 0.03


@pytest.mark.slow
@pytest.mark.parametrize(("name", "readout"), [
    ("readout_inertia", ModulusReadout(inertia=0.004)), ("readout_delay", ModulusReadout(delay=1e-4))])
def test_diagnosis_names_the_effect_of_the_instrument(tmp_path, name, readout):
    """1 % noise; the effects are far above it. A compliance is not separated from the tissue by one table."""
    modulus = readout.compute_reading(ts.complex_modulus(GEL, FREQUENCY, "simple_shear"), FREQUENCY)
    rng = np.random.default_rng(3)
    campaign = make_campaign(tmp_path, modulus, table=0.01 * rng.standard_normal((2, 25)),
                             noise="[noise]\nmodulus_relative = 0.01\n")
    result, = diagnose([campaign.path], tmp_path / "out", figures=False)
    diagnosis = result.diagnosis
    assert diagnosis.verdict == "NAMED" and [each.name for each in diagnosis.effects] == [name]
    parameter, = diagnosis.effects[0].parameters
    assert parameter.value == pytest.approx(getattr(readout, name.removeprefix("readout_")), rel=0.2)
    named = load_campaign(tmp_path / "out" / "diagnosed.toml")
    assert f"{name.replace('_', '.', 1)}" in named.fit.start


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["stated", "estimated"])
def test_intervals_of_200_campaigns_contain_the_truth(tmp_path, noise):
    """2 % noise of both moduli at 25 frequencies; 95 % intervals of all five parameters."""
    rng = np.random.default_rng(67)
    modulus, inside = ts.complex_modulus(GEL, FREQUENCY, "simple_shear"), []
    for _ in range(200):
        campaign = make_campaign(tmp_path, modulus, table=0.02 * rng.standard_normal((2, 25)),
                                 noise="[noise]\nmodulus_relative = 0.02\n" if noise == "stated" else "")
        problem, end, found = fit(campaign)
        assert end.converged
        errors = compute_marginal_uncertainty(problem, problem.evaluate(end.theta)).standard_errors
        inside.append([abs(found[name] - TRUTH[name]) <= 1.96 * error
                       for name, error in zip(problem.space.free, errors, strict=True)])
    covered = np.mean(inside, axis=0)
    print(noise, dict(zip(problem.space.free, covered.tolist(), strict=True)), np.mean(inside))
    assert 0.92 <= np.mean(inside) <= 0.98


def calibrate_table(tmp_path, modulus, **keys):
    """Return the fit of a table of moduli."""
    make_campaign(tmp_path, modulus, **keys)
    result, = calibrate([tmp_path / "campaign.toml"], tmp_path / "out", figures=False, overwrite=True)
    return result.best


def test_residuals_are_relative_to_the_modulus(tmp_path):
    """A single relaxation cannot describe moduli that depend on the frequency by a power law."""
    modulus = 1e6 * (1j * FREQUENCY)**0.45
    found = calibrate_table(tmp_path, modulus, fit='start = { "viscoelastic.terms[0].g" = 0.9, '
                            '"viscoelastic.terms[0].tau_s" = 0.1 }\n', noise="[noise]\nmodulus_relative = 0.01\n")
    residuals, = [clause for clause in found.clauses if clause.name == "residuals"]
    percent = [float(each) for each in re.findall(r"are ([\d.]+) % of the modulus", residuals.reason)]
    assert not residuals.holds and max(percent) > 40.0, residuals.reason
    assert "stiffness" not in residuals.remedy


def test_sweeps_that_no_column_tells_apart_have_too_much_noise(tmp_path):
    factors = np.tile([1.0, 0.4], 25)[:FREQUENCY.size]
    found = calibrate_table(tmp_path, factors * ts.complex_modulus(GEL, FREQUENCY, "simple_shear"))
    assert found.status == "misfit" and "the estimated noise is" in found.message
    assert [clause.holds for clause in found.clauses if clause.name == "modulus_noise"] == [False]


def test_a_table_resolves_relaxations_that_a_slow_recording_does_not(tmp_path):
    """The relaxation time of 20 ms lies between 1 / omega of the table, 3 ms, and the sampling interval of 0.5 s."""
    time = np.linspace(0.0, 30.0, 61)
    stretch = 1.0 - 0.2 * np.minimum(time / 5.0, 1.0)
    stress = ts.nominal_stress_history(GEL, time, stretch) + np.random.default_rng(1).normal(0.0, 2.0, time.size)
    hold = ts.Recording({"time": time, "stretch": stretch, "nominal stress": stress})
    ts.write_recording(hold, tmp_path / "hold.csv")
    noise = 0.01 * np.random.default_rng(2).standard_normal((2, FREQUENCY.size))
    found = calibrate_table(
        tmp_path, ts.complex_modulus(GEL, FREQUENCY, "simple_shear"), table=noise,
        more="[[test]]\nname = 'hold'\nkind = 'lubricated_compression'\nrecordings = ['hold.csv']\n",
        noise="[noise]\nnominal_stress_Pa = 2.0\nmodulus_relative = 0.01\n")
    assert found.status == "converged", found.message


def test_a_relaxation_faster_than_the_table_is_not_determined(tmp_path):
    """The moduli of 2 to 20 Hz rise by a relaxation of 0.1 ms, below 1 / omega of the largest frequency, 3 ms."""
    fast = ts.Material("neo_hooke", {"C10": 1000.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.6, 1e-4),)))
    found = calibrate_table(tmp_path, ts.complex_modulus(fast, FREQUENCY, "simple_shear"),
                            fit='start = { "viscoelastic.terms[0].g" = 0.6, "viscoelastic.terms[0].tau_s" = 1e-4 }\n')
    assert found.status == "not_determined" and "shorter than 1 / omega of the largest frequency" in found.message, \
        found.message
