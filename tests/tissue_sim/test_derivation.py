"""Functions that sympy derives are derived once, and come back from the cache folder as they were."""

import subprocess
import sys

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.laws import InvariantLaw, derivation
from tissue_sim.laws.polynomials import ReducedPolynomial

STRETCHES = np.linspace(0.5, 2.0, 7)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TISSUE_SIM_CACHE", str(tmp_path))
    return tmp_path / "formulas"


def stress(law) -> np.ndarray:
    return law.nominal_stress(STRETCHES, [1400.0, 700.0])


def test_the_second_function_is_the_first_ones_source_and_gives_the_same_numbers(folder, monkeypatch):
    first = stress(ReducedPolynomial(2))
    assert len(list(folder.iterdir())) == 1
    monkeypatch.setattr("tissue_sim.laws.law._derive_mode_stress_and_derivatives", None)  # deriving would need it
    assert np.array_equal(stress(ReducedPolynomial(2)), first)


def test_each_law_each_mode_and_each_state_of_the_source_has_a_function_of_its_own(folder, monkeypatch):
    two, three = ReducedPolynomial(2), ReducedPolynomial(3)
    stress(two)
    two.nominal_stress(STRETCHES, [1400.0, 700.0], "planar")
    three.nominal_stress(STRETCHES, [1400.0, 700.0, 10.0])
    assert len(list(folder.iterdir())) == 3
    monkeypatch.setattr(derivation, "_compute_source_digest", lambda files: "changed")
    stress(ReducedPolynomial(2))
    assert len(list(folder.iterdir())) == 4


@pytest.mark.parametrize("content", ["", "def _lambdifygenerated(", "\0", "other = 1"])
def test_a_damaged_source_is_derived_again(folder, content):
    first = stress(ReducedPolynomial(2))
    [path] = folder.iterdir()
    path.write_text(content)
    assert np.array_equal(stress(ReducedPolynomial(2)), first)
    assert path.read_text().startswith("def _lambdifygenerated(") and path.read_text().strip() != content


def test_a_printed_formula_is_kept_too(folder, monkeypatch):
    printed = ReducedPolynomial(2).formula(), ReducedPolynomial(2).latex()
    assert len(list(folder.iterdir())) == 2
    monkeypatch.setattr(ReducedPolynomial, "_format_in_parameter_order", None)  # printing would need it
    assert (ReducedPolynomial(2).formula(), ReducedPolynomial(2).latex()) == printed


def test_a_law_from_elsewhere_is_not_kept(folder):
    class Elsewhere(InvariantLaw):
        name, title, units = "elsewhere", "Elsewhere", {"A": "Pa", "B": "Pa"}

        def energy(self, I1, I2, A, B):
            return A * (I1 - 3) + B * (I1 - 3)**2

    assert np.array_equal(stress(Elsewhere()), stress(ReducedPolynomial(2)))
    assert len(list(folder.iterdir())) == 1


def test_a_folder_that_cannot_be_written_to_costs_time_alone(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("TISSUE_SIM_CACHE", str(blocked))
    assert np.isfinite(stress(ReducedPolynomial(2))).all()


@pytest.mark.slow
def test_once_derived_a_simulation_needs_neither_sympy_nor_scipy():
    code = ("import sys, tissue_sim as ts; "
            "material = ts.Material('neo_hooke', {'C10': 1404.9}, ts.Bulk('bulk_ratio', 1e4)); "
            "experiment = ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(1e-3, 2)); "
            "ts.simulate(ts.Model(experiment, material)); "
            "print(sorted({'sympy', 'scipy', 'matplotlib'} & set(sys.modules)))")
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_polynomial_laws_share_one_energy_and_others_have_their_own():
    energies = [ts.find_law(name).kernel_energy for name in ("neo_hooke", "mooney_rivlin", "biderman")]
    assert len(set(energies)) == 1
    assert energies[0].coefficient_count == len(energies[0].coefficients)
    assert ts.find_law("ogden_1").kernel_energy == ts.find_law("ogden_2").kernel_energy != energies[0]
