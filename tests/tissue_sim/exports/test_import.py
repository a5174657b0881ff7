"""Materials that are written and read again, and readers of damaged files."""

import pytest
from export_materials import (
    FOAMS,
    LAWS,
    MISSING,
    PARAMETERS,
    RELAXATIONS,
    list_materials,
    materials,
    read,
    require_same_after_round_trip,
    write,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.exports import EXPORTERS, ExportContent
from tissue_sim.exports.abaqus import ABAQUS
from tissue_sim.exports.calculix import CALCULIX
from tissue_sim.exports.febio import FEBIO
from tissue_sim.exports.target import MAX_LABEL_LENGTH, FunctionTarget
from tissue_sim.exports.unit_systems import SI, UNIT_SYSTEMS
from tissue_sim.laws import InvariantLaw

TARGETS = {"abaqus": ABAQUS, "calculix": CALCULIX, "febio": FEBIO}


@pytest.mark.parametrize(("name", "law"), [(name, law) for name in TARGETS for law in LAWS[name]])
def test_round_trip(name, law):
    for units in UNIT_SYSTEMS:
        for material in list_materials(law, RELAXATIONS if "viscoelastic" in TARGETS[name].parts else (None,)):
            require_same_after_round_trip(TARGETS[name], material, units)


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=200)
@given(st.data())
def test_round_trip_of_any_material(name, data):
    target = TARGETS[name]
    material = data.draw(materials(LAWS[name], "viscoelastic" in target.parts))
    require_same_after_round_trip(target, material, data.draw(st.sampled_from(tuple(UNIT_SYSTEMS))))


@pytest.mark.parametrize("name", TARGETS)
def test_several_materials_keep_their_order(name):
    gels = tuple(ts.Material("neo_hooke", {"C10": 1000.0 + i}, name="gel") for i in range(3))
    text = TARGETS[name].write(ExportContent(gels))
    assert list(TARGETS[name].split_materials(text)) == ["GEL", "GEL_1", "GEL_2"]
    assert [each.material.parameters["C10"] for each in TARGETS[name].read(text, SI)] == pytest.approx(
        [1000.0, 1001.0, 1002.0], rel=1e-12)


@pytest.mark.parametrize("name", ["abaqus", "calculix"])
@given(st.data())
def test_fields_have_at_most_20_characters(name, data):
    """CalculiX reads 20 characters of a number; the end of a longer one, its exponent, would be lost."""
    material = data.draw(materials(LAWS[name], relaxing=False))
    units = data.draw(st.sampled_from(tuple(UNIT_SYSTEMS)))
    for line in write(TARGETS[name], material, units).splitlines():
        if not line.startswith("*"):
            assert max(map(len, line.split(", "))) <= 20
    assert MAX_LABEL_LENGTH <= 80


#: Characters and words that a mutation inserts.
PIECES = ("*", "**", ",", "\n", "=", "<", ">", "/", '"', "nan", "inf", "1e999", "-", "0", "1e-320", "N=7", "*ELASTIC",
          "*INCLUDE, INPUT=x", "*MATERIAL, NAME=B", "MODULI=", "<k>", "</k>", "&lt;", "<!DOCTYPE a>", "\x00", "\u0131")


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=400)
@given(st.data())
def test_mutated_files_give_a_material_or_an_input_error(name, data):
    target = TARGETS[name]
    text = write(target, data.draw(materials(LAWS[name], "viscoelastic" in target.parts)))
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(text)))
        end = min(len(text), start + data.draw(st.integers(0, 20)))
        piece = data.draw(st.sampled_from(PIECES) | st.text(max_size=4) | st.just(text[start:end] * 2))
        text = text[:start] + piece + text[end:]
    try:
        for imported in target.read(text, UNIT_SYSTEMS[data.draw(st.sampled_from(tuple(UNIT_SYSTEMS)))]):
            assert imported.material.mu0 > 0
    except ts.InputError as error:
        assert str(error)


@pytest.mark.parametrize("name", TARGETS)
def test_a_law_without_equivalent_is_refused(name):
    class Plugin(InvariantLaw):
        name = "ogden_of_a_plugin"
        title = "Plug-in"
        units = {"mu1": "Pa"}

        def energy(self, I1, I2, mu1):
            return mu1 / 2 * (I1 - 3)

    ts.register_law(Plugin())
    try:
        with pytest.raises(ts.InputError, match="the law 'ogden_of_a_plugin'"):
            write(TARGETS[name], ts.Material("ogden_of_a_plugin", {"mu1": 1000.0}))
    finally:
        ts.LAWS.unregister("ogden_of_a_plugin")


@pytest.mark.parametrize(("name", "law"), [(name, law) for name in TARGETS for law in sorted(MISSING[name])])
def test_a_law_that_a_target_does_not_have_is_refused_by_name(name, law):
    with pytest.raises(ts.InputError, match=f"the law '{law}'.*fit another law"):
        write(TARGETS[name], ts.Material(law, PARAMETERS[law]))


def test_a_target_without_import_is_refused_by_name():
    with pytest.raises(ts.InputError, match="cannot be imported"):
        read(FunctionTarget("another program", str), "")


@pytest.mark.parametrize("name", ["abaqus", "calculix"])
@pytest.mark.parametrize("law", FOAMS)
def test_round_trip_of_foams(name, law):
    for units in UNIT_SYSTEMS:
        require_same_after_round_trip(TARGETS[name], ts.Material(law, FOAMS[law], density=30.0, name="GEL"), units)


def test_foams_of_abaqus_written_by_hand():
    """mu_1, alpha_1, ..., nu_1, ..., at most 8 on a line."""
    text = write(ABAQUS, ts.Material("hyperfoam_3", FOAMS["hyperfoam_3"], name="GEL"))
    rows = text[text.index("*HYPERFOAM"):].splitlines()
    assert rows[0] == "*HYPERFOAM, N=3"
    assert [[float(word) for word in row.split(",")] for row in rows[1:]] == [
        [1000.0, 4.0, 500.0, -2.0, 200.0, 8.0, 0.2, 0.35], [-0.1]]


@pytest.mark.parametrize(("name", "text", "message"), [
    ("abaqus", "*HYPERFOAM, N=4\n1, 2\n", "the order N of HYPERFOAM must be 1 to 3 in Abaqus; got 4"),
    ("calculix", "*HYPERFOAM, N=1\n1000, 4, 0.2\n", "state the term twice, each with half of mu"),
    ("abaqus", "*HYPERFOAM, N=1, TEST DATA INPUT\n", "the option TEST DATA INPUT"),
    ("abaqus", "*HYPERFOAM\n1000, 4, 0.5\n", "must be within"),
    ("abaqus", "*HYPERFOAM\n1000, 4, 0.2\n*VISCOELASTIC, TIME=PRONY\n0.2, 0.2, 1\n",
     r"\*VISCOELASTIC with \*HYPERFOAM cannot be imported"),
])
def test_foams_that_cannot_be_imported(name, text, message):
    with pytest.raises(ts.InputError, match=message):
        TARGETS[name].read(f"*MATERIAL, NAME=GEL\n{text}", SI)


def test_targets_without_foams():
    foam = ts.Material("hyperfoam_1", FOAMS["hyperfoam_1"])
    for target in ("febio", "sofa", "felupe"):
        with pytest.raises(ts.InputError, match="hyperfoam_1"):
            EXPORTERS[target].write(ExportContent((foam,)))
