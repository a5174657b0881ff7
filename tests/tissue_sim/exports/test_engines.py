"""Exports to MuJoCo and Newton: the numbers of a fit, which are NumPy's, give valid files."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.exports import ExportContent, find_export_target
from tissue_sim.exports.elastic_constants import ElasticConstants


@pytest.mark.parametrize("engine", ["mujoco", "newton"])
def test_numbers_of_a_fit_give_a_valid_file(engine):
    material = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3), density=1000.0)
    constants = ElasticConstants(np.float64(5000.0), np.float64(0.45), np.float64(0.02), np.float64(1000.0))
    assert type(constants.young) is float
    text = find_export_target(engine).write(ExportContent((material,), constants=(constants,)))
    if engine == "mujoco":
        assert "float64" not in text and ET.fromstring(text) is not None
        return
    names: dict = {}
    exec(compile(text, "exported.py", "exec"), names)
    (found,) = names["CONSTANTS"].values()
    assert found["k_mu"] == pytest.approx(5000.0 / 2.9, rel=1e-9) and found["density"] == 1000.0
