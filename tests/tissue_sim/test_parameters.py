"""Parameters of a model: every path reaches its number and no other, in SI; files take key and factor from there."""

import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.experiment.tools.tool import TOOLS
from tissue_sim.material.material import (
    _make_component,
    find_parameter_path_and_declaration,
    make_material_from_numbers,
    with_changed_or_added_parameters,
)
from tissue_sim.parameters import (
    get_parameter_value,
    get_parameters_at_paths,
    list_field_declarations,
    parameter_values,
    parameters,
    with_values,
)

MATERIAL = ts.Material(
    "ogden_2", {"mu1": 1500.0, "alpha1": 3.0, "mu2": 800.0, "alpha2": -2.5}, ts.Bulk("bulk_ratio", 1e3), 1040.0,
    viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0), ts.PronyTerm(0.1, 40.0))), softening=ts.Softening(0.3, 50.0, 0.5),
    layers=(ts.Layer(2e-3, 3.0), ts.Layer(4e-3, 0.5)), poroelasticity=ts.Poroelasticity(0.2, 1e-8),
    puncture=ts.Puncture(5e-3, 0.2))
EXPERIMENT = ts.Experiment(ts.Specimen(0.04, 0.07, density=1040.0, gravity=9.81), ts.Protocol.ramp(5e-3, 5),
                           ts.Tool("flat", radius=8e-3, edge_radius=1e-3), friction=0.3, friction_base="bonded",
                           adhesion=ts.Adhesion(0.01, 1e-4))
MODEL = ts.Model(EXPERIMENT, MATERIAL, ts.Rig(compliance=2e-5, latency=0.01))
PATHS = sorted(parameters(MODEL))


def test_all_of_a_model_is_reached():
    known = parameters(MODEL)
    assert {"material.mu1", "material.bulk.bulk_ratio", "material.viscoelastic.terms[1].tau",
            "material.layers[1].thickness", "material.puncture.depth", "experiment.specimen.radius",
            "experiment.tool.edge_radius", "experiment.friction", "experiment.friction_wall",
            "experiment.adhesion.length", "rig.compliance", "rig.backlash"} <= set(known)
    # What is bonded slips at no coefficient; frictionless is one of 0.
    assert "experiment.friction_base" not in known and known["experiment.friction_wall"].value == 0.0
    assert known["material.viscoelastic.terms[1].tau"].symbol == "tau2"
    assert known["material.layers[1].thickness"].path_in_file == "material.layers[1].thickness_mm"
    assert known["experiment.tool.radius"].declaration.factor == pytest.approx(1e-3)


@settings(max_examples=60, deadline=None)
@given(path=st.sampled_from(PATHS), share=st.floats(1e-6, 1e-2))
def test_one_path_changes_one_number(path, share):
    before = parameter_values(MODEL)
    new = before[path] * (1 - share) or share
    try:
        after = parameter_values(with_values(MODEL, {path: new}))
    except ts.InputError:
        assert path == "rig.sampling_rate"  # which nothing states
        return
    assert after.pop(path) == new and get_parameter_value(with_values(MODEL, {path: new}), path) == new
    before.pop(path)
    assert after == before


def test_several_change_at_once():
    """One share may only rise where the other falls: together they are accepted in any order."""
    changed = with_values(MATERIAL.viscoelastic, {"terms[1].g": 0.9, "terms[0].g": 0.05})
    assert [term.g for term in changed.terms] == [0.05, 0.9]
    with pytest.raises(ts.InputError, match="the sum of all g must be below 1"):
        with_values(MATERIAL.viscoelastic, {"terms[1].g": 0.9})


def test_a_path_may_start_at_any_part():
    starts = ((MODEL, "experiment.tool.radius"), (EXPERIMENT, "tool.radius"), (EXPERIMENT.tool, "radius"))
    assert {get_parameter_value(part, path) for part, path in starts} == {8e-3}
    assert [each.path for each in get_parameters_at_paths(MODEL, ["layers[0].ratio"])] == ["material.layers[0].ratio"]
    for name, words in (("experiment.tool.raduis", "did you mean 'experiment.tool.radius'"),
                        ("experiment.friction_base", "must be a number to be changed; got 'bonded'"),
                        ("C10", "unknown parameter")):
        with pytest.raises(ts.InputError, match=words):
            get_parameters_at_paths(MODEL, [name])
    with pytest.raises(ts.InputError, match=r"did you mean 'rig\.latency'"):
        with_values(MODEL, {"rig.latncy": 1.0})


@pytest.mark.parametrize("kind", [ts.PronyTerm, ts.Softening, ts.Layer, ts.Poroelasticity, ts.Puncture, ts.Specimen,
                                  ts.Adhesion, ts.Experiment, ts.Rig, *(TOOLS[name] for name in TOOLS)],
                         ids=lambda kind: kind.__name__)
def test_what_a_part_declares_is_sound(kind):
    names = {entry.name for entry in dataclasses.fields(kind)}
    for name, what in list_field_declarations(kind).items():
        low, high = what.bounds
        assert name in names and low < high and what.factor > 0 and what.key and what.symbol
        # A key says its unit: SI alone, or a smaller one with its factor.
        assert what.factor == 1.0 or any(f"_{unit}" in what.key for unit in ("mm", "deg"))
        assert what.absent is None or low <= what.absent <= high or math.isclose(what.absent, low, abs_tol=1e-5)


def test_a_material_is_made_of_its_numbers():
    values = parameter_values(MATERIAL)
    law = {name: values.pop(name) for name in MATERIAL.parameters}
    assert make_material_from_numbers("ogden_2", law, values, density=1040.0) == MATERIAL
    assert find_parameter_path_and_declaration("layers[3].thickness_mm") == (
        "layers[3].thickness", list_field_declarations(ts.Layer)["thickness"])
    for path, words in (("layers[0].thicknes", "did you mean"), ("viscoelastic.tau", "no material has"),
                        ("bulk.K", "no material has")):
        with pytest.raises(ts.InputError, match=words):
            find_parameter_path_and_declaration(path)
    with pytest.raises(ts.InputError, match=r"layers\[0\]\.thickness: is missing"):
        make_material_from_numbers("neo_hooke", {"C10": 1.0}, {"layers[0].ratio": 2.0})
    with pytest.raises(ts.InputError, match="numbered from 0 without gaps"):
        make_material_from_numbers("neo_hooke", {"C10": 1.0}, {"layers[1].ratio": 2.0, "layers[1].thickness": 1e-3})


def test_the_numbers_of_a_region_say_its_law():
    """And a region is of the bulk response of the whole."""
    bulk = ts.Bulk("bulk_ratio", 1e3)
    lump = {"regions.lump.C10": 900.0, "regions.lump.C20": 90.0, "regions.part:2.mu1": 500.0,
            "regions.part:2.alpha1": 3.0}
    made = make_material_from_numbers("neo_hooke", {"C10": 100.0}, lump, bulk)
    assert made.regions == {"lump": ts.Material("reduced_polynomial_2", {"C10": 900.0, "C20": 90.0}, bulk),
                            "part:2": ts.Material("ogden_1", {"mu1": 500.0, "alpha1": 3.0}, bulk)}
    values = {path: value for path, value in parameter_values(made).items() if path.startswith("regions.")}
    assert {path: value for path, value in values.items() if "bulk" not in path} == lump
    assert with_changed_or_added_parameters(ts.Material("neo_hooke", {"C10": 100.0}, bulk), lump) == made
    assert find_parameter_path_and_declaration("regions.lump.C20")[1].unit == "Pa"
    with pytest.raises(ts.InputError, match=r"regions.lump.C100: no law has a parameter 'C100'.*did you mean 'C10'"):
        find_parameter_path_and_declaration("regions.lump.C100")
    with pytest.raises(ts.InputError, match=r"regions.lump: no law has the parameters C20 and no others"):
        make_material_from_numbers("neo_hooke", {"C10": 100.0}, {"regions.lump.C20": 1.0})
    with pytest.raises(ts.InputError, match=r"regions.lump.parameters"):
        make_material_from_numbers("neo_hooke", {"C10": 100.0}, {"regions.lump.C10": -1.0})


def test_a_type_error_of_a_component_of_a_plug_in_is_raised_unchanged():
    @dataclasses.dataclass(frozen=True)
    class Faulty:
        size: float

        def __post_init__(self):
            raise TypeError("a fault of the plug-in")

    with pytest.raises(TypeError, match="a fault of the plug-in"):
        _make_component(Faulty, "effects.faulty", {"size": 1.0})


def test_a_component_without_a_number_names_the_number():
    with pytest.raises(ts.InputError, match="is missing") as refused:
        _make_component(ts.PronyTerm, "viscoelastic.terms[0]", {"g": 0.3})
    assert refused.value.field == "viscoelastic.terms[0].tau"
