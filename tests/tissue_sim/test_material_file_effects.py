"""Effects of time and loading in material files: round trip, refusals, and files of version 1."""

import dataclasses
import json

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.material.file import make_material_file_from_json_data
from tissue_sim.material.force_scaling import Puncture
from tissue_sim.material.material import Layer
from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import Poroelasticity, Prony, PronyTerm

YEOH = ts.Material("reduced_polynomial_3", {"C10": 7702.0, "C20": -63.0, "C30": 248.0}, ts.Bulk("bulk_ratio", 1e3))
LOSSY = dataclasses.replace(
    YEOH, viscoelastic=Prony((PronyTerm(0.25, 2.0), PronyTerm(0.125, 64.0)), "long_term"),
    softening=Softening(0.5, 32.0, 0.25), layers=(Layer(2e-3, 4.0), Layer(5e-3, 0.5)),
    poroelasticity=Poroelasticity(0.125, 2.5e-9), puncture=Puncture(6e-3, 0.25))


def test_what_time_and_loading_do_comes_back(tmp_path):
    errors = {"viscoelastic.terms[1].tau": 3.0, "softening.loss": 0.05, "layers[1].ratio": 0.1,
              "poroelasticity.phi": 0.01, "puncture.depth": 0.2e-3, "C10": 7.0}
    file = ts.MaterialFile.of(LOSSY, standard_errors=errors)
    path = tmp_path / "m.material.json"
    ts.write_material_file(file, path)
    again = ts.read_material_file(path)
    assert again == file and again.material == LOSSY
    assert again.parameters["C10"].standard_error == 7.0
    assert again.standard_errors == pytest.approx(errors, rel=1e-15)
    data = json.loads(path.read_text(encoding="utf-8"))
    assert data["viscoelastic"] == {
        "terms": [{"g": 0.25, "tau_s": 2.0}, {"standard_errors": {"tau_s": 3.0}, "g": 0.125, "tau_s": 64.0}],
        "moduli": "long_term", "form": "isochoric_second_piola"}
    assert data["poroelasticity"]["diffusivity_mm2_per_s"] == pytest.approx(2.5e-3)
    assert data["puncture"] == {"standard_errors": {"depth_mm": 0.2}, "depth_mm": 6.0, "drop": 0.25}
    assert data["layers"][0] == {"thickness_mm": 2.0, "modulus_ratio": 4.0}


def test_the_convention_is_written_where_it_is_the_default(tmp_path):
    material = dataclasses.replace(YEOH, viscoelastic=Prony((PronyTerm(0.25, 2.0),)))
    ts.write_material_file(ts.MaterialFile.of(material), tmp_path / "m.json")
    text = (tmp_path / "m.json").read_text(encoding="utf-8")
    assert '"moduli": "instantaneous"' in text and '"form": "isochoric_second_piola"' in text


def test_covariance_reaches_beyond_the_law(tmp_path):
    others = ("viscoelastic.terms[0].g", "layers[1].thickness")
    matrix = np.diag([4.0, 9.0, 16.0, 1e-4, 0.25e-6])
    matrix[0, 3] = matrix[3, 0] = 0.01
    file = ts.MaterialFile.of(LOSSY, covariance=matrix, others=others)
    ts.write_material_file(file, tmp_path / "m.json")
    again = ts.read_material_file(tmp_path / "m.json")
    assert again.covariance.order == ("C10", "C20", "C30", "viscoelastic.terms[0].g", "layers[1].thickness_mm")
    in_file = np.array(again.covariance.matrix)
    np.testing.assert_allclose(in_file[4, 4], matrix[4, 4] * 1e6, rtol=1e-15)  # mm2
    paths, back = again.paths_and_covariance_SI
    assert paths == ("C10", "C20", "C30", *others)
    np.testing.assert_allclose(back, matrix, rtol=1e-15)
    assert again.standard_errors["layers[1].thickness"] == pytest.approx(0.5e-3)


#: Written by version 0.1.0 which knew the law only; unchanged.
VERSION_1 = {
    "by the command line": ("""{
  "schema": "tissue_sim/material/1",
  "name": "phantom",
  "law": "reduced_polynomial_2",
  "parameters": {
    "C10": {
      "value": 1404.9,
      "unit": "Pa"
    },
    "C20": {
      "value": 699.4,
      "unit": "Pa"
    }
  },
  "bulk": {
    "bulk_ratio": 1000.0
  },
  "density_kg_m3": 1040.0,
  "stability": {
    "stable_from": 0.3,
    "stable_to": 3.0,
    "stretch_range": [0.3, 3.0],
    "text": "stable for stretches 0.3 to 3 in uniaxial, planar and equibiaxial loading"
  },
  "provenance": {
    "software": "tissue-sim",
    "version": "0.1.0",
    "date": "2026-11-21T15:51:40+00:00"
  }
}
""", ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1000.0), 1040.0,
                 "phantom")),
    "by hand, with what was planned left empty": ("""{
  "schema": "tissue_sim/material/1",
  "law": "ogden_1",
  "parameters": { "mu1": { "value": 2.729, "unit": "kPa", "standard_error": 0.01 },
                  "alpha1": { "value": -0.57, "unit": "1" } },
  "covariance": { "order": ["mu1", "alpha1"], "matrix": [[1e-4, 0.0], [0.0, 0.04]] },
  "bulk": { "incompressible": true },
  "viscoelastic": null, "softening": null, "layers": null,
  "valid_range": { "stretch": [0.86, 1.0] }
}
""", ts.Material("ogden_1", {"mu1": 2729.0, "alpha1": -0.57})),
}


@pytest.mark.parametrize("case", VERSION_1)
def test_version_1_loads_and_becomes_the_present_one(tmp_path, case):
    text, material = VERSION_1[case]
    path = tmp_path / "old.material.json"
    path.write_text(text, encoding="utf-8")
    file = ts.read_material_file(path)
    loaded = file.material
    assert dict(loaded.parameters) == pytest.approx(dict(material.parameters), rel=1e-15)
    assert loaded == dataclasses.replace(material, parameters=loaded.parameters)
    assert loaded.mu_long_term == loaded.mu0 == pytest.approx(material.mu0, rel=1e-15)
    ts.write_material_file(file, path)
    assert json.loads(path.read_text(encoding="utf-8"))["schema"] == "tissue_sim/material/2"
    assert ts.read_material_file(path) == file


TERM = {"g": 0.3, "tau_s": 2.0}
#: Keys and value that are put into the file of `LOSSY`, the path of the refusal, words in it.
REFUSED = {
    "no terms": (("viscoelastic", {"terms": []}), "viscoelastic.terms", "must have 1 to 13 terms; got 0"),
    "fourteen terms": (("viscoelastic", {"terms": [{"g": 0.01, "tau_s": 1.0}] * 14}), "viscoelastic.terms",
                       "must have 1 to 13 terms; got 14"),
    "everything relaxes": (("viscoelastic", {"terms": [{"g": 0.5, "tau_s": 1.0}] * 2}), "viscoelastic.terms",
                           "the sum of all g must be below 1"),
    "negative g": (("viscoelastic", {"terms": [{"g": -0.1, "tau_s": 1.0}]}), "viscoelastic.terms[0].g",
                   "between 0 and 1; got -0.1"),
    "no time": (("viscoelastic", {"terms": [TERM, {"g": 0.1, "tau_s": 0.0}]}), "viscoelastic.terms[1].tau_s",
                "must be a positive relaxation time; got 0 s"),
    "tau without its unit": (("viscoelastic", {"terms": [{"g": 0.1, "tau": 1.0}]}), "viscoelastic.terms[0].tau",
                             "did you mean 'tau_s'"),
    "other moduli": (("viscoelastic", {"terms": [TERM], "moduli": "longterm"}), "viscoelastic.moduli",
                     "did you mean 'long_term'"),
    "other form": (("viscoelastic", {"terms": [TERM], "form": "cauchy_deviator"}), "viscoelastic.form",
                   "isochoric_second_piola"),
    "error of nothing": (("viscoelastic", {"terms": [{**TERM, "standard_errors": {"tau": 1.0}}]}),
                         "viscoelastic.terms[0].standard_errors.tau", "must be the key of a parameter: g, tau_s"),
    "negative error of tau": (("viscoelastic", {"terms": [{**TERM, "standard_errors": {"tau_s": -1.0}}]}),
                              "viscoelastic.terms[0].standard_errors.tau_s",
                              "must be a standard deviation of 0 or more; got -1"),
    "softening without loss": (("softening", {}), "softening.loss", "is missing"),
    "lost all": (("softening", {"loss": 1.0}), "softening.loss", "from 0 to below 1; got 1"),
    "softening without scale": (("softening", {"loss": 0.5, "share": 0.0}), "softening.modulus_Pa",
                                "must not both be 0"),
    "layer of nothing": (("layers", [{"thickness_mm": 0.0, "modulus_ratio": 2.0}]), "layers[0].thickness_mm",
                         "must be positive and finite; got 0 m"),
    "negative layer": (("layers", [{"thickness_mm": 1.0, "modulus_ratio": -2.0}]), "layers[0].modulus_ratio",
                       "must be a positive finite factor on the moduli of the material below"),
    "no diffusion": (("poroelasticity", {"phi": 0.2, "diffusivity_mm2_per_s": 0.0}),
                     "poroelasticity.diffusivity_mm2_per_s", "must be positive and finite"),
    "all drains": (("poroelasticity", {"phi": 1.0, "diffusivity_mm2_per_s": 1.0}), "poroelasticity.phi",
                   "from 0 to below 1; got 1"),
    "puncture in the air": (("puncture", {"depth_mm": -1.0, "drop": 0.2}), "puncture.depth_mm",
                            "must be positive and finite"),
    "all punctured": (("puncture", {"depth_mm": 1.0, "drop": 1.0}), "puncture.drop", "from 0 to below 1; got 1"),
    "covariance of what is not there": (
        ("covariance", {"order": ["C10", "C20", "C30", "puncture.dropp"], "matrix": np.eye(4).tolist()}),
        "covariance.order", "no parameter 'puncture.dropp'; did you mean 'puncture.drop'"),
    "covariance of the same twice": (
        ("covariance", {"order": ["C10", "C20", "C30", "C30"], "matrix": np.eye(4).tolist()}),
        "covariance.order", "then others, each once"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_by_its_path(case):
    (key, value), field, message = REFUSED[case]
    data = msgspec.to_builtins(ts.MaterialFile.of(LOSSY))
    with pytest.raises(ts.InputError, match=message) as caught:
        make_material_file_from_json_data({**data, key: value})
    assert caught.value.field == field


def test_fourteen_relaxing_terms_are_too_many():
    most = Prony(tuple(PronyTerm(0.01, 10.0**i) for i in range(13)))
    assert dataclasses.replace(YEOH, viscoelastic=most).make_prony_series(1e-2) == most
    with pytest.raises(ts.InputError, match="drainage is one of the at most 13 relaxing terms"):
        dataclasses.replace(LOSSY, viscoelastic=most)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(draw=st.data())
def test_any_value_in_any_place_of_an_effect_is_accepted_or_refused(draw):
    data = json.loads(json.dumps(msgspec.to_builtins(ts.MaterialFile.of(LOSSY))))
    node, key = data, draw.draw(st.sampled_from(["viscoelastic", "softening", "layers", "poroelasticity", "puncture"]))
    while isinstance(node[key], dict | list) and node[key] and draw.draw(st.booleans()):
        node = node[key]
        key = draw.draw(st.sampled_from(sorted(node)) if isinstance(node, dict) else st.integers(0, len(node) - 1))
    node[key] = draw.draw(
        st.none() | st.floats() | st.integers() | st.text(max_size=3) | st.lists(st.floats(), max_size=3)
        | st.dictionaries(st.text(max_size=3), st.floats(), max_size=2))
    try:
        material = make_material_file_from_json_data(data).material
    except ts.InputError as error:
        assert error.problem
    else:
        assert np.isfinite([material.mu0, material.mu_long_term]).all() and 0 < material.mu_long_term <= material.mu0
