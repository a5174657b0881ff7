"""benchmarks/raw_files, small: its closed forms, its files and its judgement, and some files end to end."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tissue_sim.laws import find_law

MU = 7300.0
STRETCH = np.array([0.6, 0.9, 1.1, 1.7])


@pytest.fixture(scope="module")
def study(benchmark_module):
    """The modules of the generator: ``truth``, ``drafts``, ``run``, and ``main``, its command line."""
    return SimpleNamespace(**{name: benchmark_module(f"raw_files.{name}") for name in ("truth", "drafts", "run")},
                           main=benchmark_module("raw_files.__main__"))


@pytest.mark.parametrize(("function", "mode", "abscissa"), [
    ("uniaxial_stress", "uniaxial", STRETCH), ("planar_stress", "planar", STRETCH),
    ("equibiaxial_stress", "equibiaxial", STRETCH), ("shear_stress", "simple_shear", STRETCH - 1.0)])
def test_closed_forms_agree_with_the_laws_of_the_package(study, function, mode, abscissa):
    law = find_law("neo_hooke")
    expected = law.nominal_stress(abscissa, law.convert_parameters_to_array({"C10": MU / 2}), mode)
    assert getattr(study.truth, function)(MU, abscissa) == pytest.approx(expected, rel=1e-12)


def test_forces_are_stress_times_area(study):
    truth = study.truth
    press = truth.Test(truth.COMPRESSION, MU, truth.Specimen(diameter=0.02, length=0.012), np.zeros(1),
                       np.array([0.003]), np.zeros(1))
    # Stretch 0.75: mu (0.75 - 1 / 0.75^2) = -1.02778 mu over pi 10^2 mm2.
    assert press.elastic_force(press.motion) == pytest.approx(np.pi * 1e-4 * MU * 1.0277778, rel=1e-6)
    assert press.motion_at(press.elastic_force(press.motion)) == pytest.approx(press.motion, rel=1e-5)
    shear = truth.Test(truth.SHEAR, MU, truth.Specimen(width=0.02, length=0.03, thickness=0.005), np.zeros(1),
                       np.array([0.002]), np.zeros(1))
    assert shear.elastic_force(shear.motion) == pytest.approx(0.02 * 0.03 * MU * 0.4, rel=1e-12)


def test_relaxation_after_a_step_is_exponential(study):
    time = np.concatenate([[0.0, 1e-9], np.linspace(0.5, 20.0, 40)])
    elastic = np.concatenate([[0.0], np.full(41, 2.0)])
    expected = 2.0 * (1 - 0.3 * (1 - np.exp(-time[1:] / 4.0)))
    assert study.truth.relaxing_force(time, elastic, 0.3, 4.0)[1:] == pytest.approx(expected, rel=1e-6)


def test_every_trap_makes_a_file_that_is_the_same_each_time(study):
    for name in study.run.TRAPS:
        files = [study.run.draw_file(3, 0, only=name)[0].files() for _ in range(2)]
        assert files[0] == files[1] and all(len(content) > 200 for content in files[0].values()), name


def test_thousands_are_grouped_from_the_right(study):
    draft = replace(study.run.draw_file(1, 0, clean=True)[0], decimal=",", thousands=".")
    assert [draft.number(value, 1) for value in (12.34, -1234.56, 1234567.0)] == ["12,3", "-1.234,6", "1.234.567,0"]


def test_a_modulus_off_by_six_percent_is_counted_as_silently_wrong(study, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    draft, traps = study.run.draw_file(1, 0, clean=True)
    for name, content in draft.files().items():
        (tmp_path / name).write_bytes(content)
    outcomes = [study.run._judge(0, replace(draft, truths=(factor * draft.test.mu,)), traps, [*draft.files()]).outcome
                for factor in (1.0, 1.06)]
    assert outcomes == [study.run.RIGHT, study.run.WRONG]


@pytest.mark.slow
def test_clean_files_are_right(study):
    results = [study.run.run_file(2, index, clean=True) for index in range(16)]
    assert [study.main._line(each) for each in results if each.outcome != study.run.RIGHT] == []


@pytest.mark.slow
def test_files_with_traps_are_never_silently_wrong(study):
    results = [study.run.run_file(2, index) for index in range(30)]
    bad = (study.run.WRONG, study.run.CRASH)
    assert [study.main._line(each) for each in results if each.outcome in bad] == []
    assert sum(each.outcome == study.run.RIGHT for each in results) >= 5


def test_the_table_counts_files_of_several_traps_for_each(study, capsys):
    with pytest.raises(SystemExit):
        study.main.main(["--count", "3", "--seed", "4", "--clean"])
    rows = capsys.readouterr().out.splitlines()
    assert rows[2].startswith("| all | 3 |")
