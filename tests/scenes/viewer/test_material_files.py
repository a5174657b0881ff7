"""Material files of the page: list, upload, slider ranges, and saving of edited materials."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from scenes.viewer.material_files import (
    LARGEST_UPLOAD,
    compute_parameter_slider_ranges,
    format_parameter_values_by_path,
    list_material_files,
    read_uploaded_material,
    save_edited_material,
)
from tissue_sim.parameters import parameter_values, with_values

PHANTOM = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4),
                      name="phantom", viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0), ts.PronyTerm(0.2, 20.0))))
EVERYTHING = ts.Material(
    "ogden_2", {"mu1": 900.0, "alpha1": 4.0, "mu2": 300.0, "alpha2": -2.0}, ts.Bulk("K_Pa", 4e6),
    viscoelastic=ts.Prony((ts.PronyTerm(0.25, 0.5),)), softening=ts.Softening(0.3, 50.0, 0.2),
    layers=(ts.Layer(2e-3, 3.0),), poroelasticity=ts.Poroelasticity(0.2, 1e-8), puncture=ts.Puncture(6e-3, 0.4))
MATERIALS = {
    "phantom": PHANTOM, "everything": EVERYTHING,
    "incompressible": ts.Material("neo_hooke", {"C10": 80.0}),
    "stiff": ts.Material("neo_hooke", {"C10": 3e6}, ts.Bulk("D1_per_Pa", 1e-9)),
    "zero": ts.Material("mooney_rivlin", {"C10": 1000.0, "C01": 0.0}),
    "foam": ts.Material("hyperfoam_1", {"mu1": 1000.0, "alpha1": 4.0, "nu1": 0.2}),
    "negative": ts.Material("mooney_rivlin", {"C10": 1000.0, "C01": -200.0}),
}


def uploaded(material, **options) -> bytes:
    import msgspec

    return json.dumps(msgspec.to_builtins(ts.MaterialFile.of(material, **options))).encode()


def test_material_files_are_listed_by_name(tmp_path):
    for name in ("b", "a", "C"):
        ts.write_material_file(ts.MaterialFile.of(PHANTOM), tmp_path / f"{name}.material.json")
    (tmp_path / "notes.json").write_text("{}", encoding="utf-8")
    (tmp_path / "d.material.json").mkdir()
    assert [path.name for path in list_material_files(tmp_path)] == ["C.material.json", "a.material.json",
                                                                     "b.material.json"]
    with pytest.raises(ts.InputError, match="none: this folder does not exist"):
        list_material_files(tmp_path / "none")


def test_a_valid_upload_gives_its_material():
    assert read_uploaded_material("x.material.json", uploaded(EVERYTHING)) == EVERYTHING


@pytest.mark.parametrize(("change", "message"), [
    ({"law": "neo_hook"}, r"^x\.material\.json: law: .*neo_hooke"),
    ({"parameters": {"C10": {"value": "soft", "unit": "Pa"}, "C20": {"value": 1.0, "unit": "Pa"}}},
     r"^x\.material\.json: parameters\.C10\.value: .*a number"),
    ({"viscoelastic": {"terms": [{"g": 1.5, "tau_s": 1.0}]}},
     r"^x\.material\.json: viscoelastic\.terms\[0\]\.g: must be .*; got 1\.5\."),
    ({"schema": "tissue_sim/material/99"}, r"^x\.material\.json: schema: .*newer version"),
    ({"colour": "red"}, r"^x\.material\.json: colour: unknown key"),
])
def test_an_invalid_upload_names_the_field(change, message):
    content = json.dumps({**json.loads(uploaded(PHANTOM)), **change}).encode()
    with pytest.raises(ts.InputError, match=message) as caught:
        read_uploaded_material("x.material.json", content)
    assert "upload.material.json" not in str(caught.value)


@pytest.mark.parametrize(("content", "message"), [
    (b"{\n  \"schema\": ", r"^x\.json:2: damaged JSON"),
    (b"\x89PNG\r\n\x1a\n\x00\x00", r"^x\.json"),
    (b"[]", r"^x\.json: file must contain an object"),
    (b"", r"^x\.json"),
    (b" " * (LARGEST_UPLOAD + 1), r"^x\.json: must be at most 1 MB; got 1\.0 MB"),
])
def test_an_upload_of_another_file_is_refused(content, message):
    with pytest.raises(ts.InputError, match=message):
        read_uploaded_material("x.json", content)


@pytest.mark.parametrize("name", MATERIALS)
def test_the_material_accepts_the_ends_of_each_slider(name):
    material = MATERIALS[name]
    ranges, values = compute_parameter_slider_ranges(material), parameter_values(material)
    assert list(ranges) == list(values)
    for parameter, slider in ranges.items():
        shown = values[parameter] * slider.factor
        assert slider.low <= shown <= slider.high
        assert 0 < slider.step <= (slider.high - slider.low) / 100
        for end in (slider.low, slider.high):
            changed = with_values(material, {parameter: end / slider.factor})
            assert parameter_values(changed)[parameter] == pytest.approx(end / slider.factor)
            assert changed.is_bulk_ratio_verified
            if parameter.startswith("bulk."):
                assert 2 <= changed.bulk_modulus / changed.mu0 <= 1e6


@pytest.mark.parametrize("name", MATERIALS)
def test_exact_values_show_all_parameters(name):
    material = MATERIALS[name]
    texts = format_parameter_values_by_path(material)
    ranges, values = compute_parameter_slider_ranges(material), parameter_values(material)
    assert set(texts) == set(values)
    for path, text in texts.items():
        number, _, unit = text.partition(" ")
        assert float(number) / ranges[path].factor == pytest.approx(values[path], rel=1e-8)
        assert unit == ranges[path].unit
    assert format_parameter_values_by_path(PHANTOM)["C10"] == "1.4049 kPa"


def test_slider_ranges_follow_the_settings():
    ranges = compute_parameter_slider_ranges(PHANTOM)
    C20, C10, g = ranges["C20"], ranges["C10"], ranges["viscoelastic.terms[0].g"]
    assert (C20.low, C20.unit) == (0.0, "kPa") and C20.high == pytest.approx(5 * 0.6994, abs=C20.step)
    assert (C10.low, C10.high) == pytest.approx((1.4049 / 5, 5 * 1.4049), abs=C10.step)
    assert 0.79 < g.high < 0.8  # the other g is 0.2, and together they stay below 1
    assert ranges["viscoelastic.terms[1].tau"].unit == "s"
    zero = compute_parameter_slider_ranges(MATERIALS["zero"])["C01"]
    # At -1 kPa nothing of the shear modulus would be left; a hundredth is the least.
    assert (zero.low, zero.high) == pytest.approx((-0.99, 2.0), abs=zero.step)
    negative = compute_parameter_slider_ranges(MATERIALS["negative"])["C01"]
    assert (negative.low, negative.high) == pytest.approx((-0.992, 0.0), abs=negative.step)
    assert compute_parameter_slider_ranges(EVERYTHING)["layers[0].thickness"].unit == "mm"


def test_sliders_of_a_compressible_law_have_a_range():
    """The foam has K / mu0 = 4/3; nu1 = 0.45 gives 9.67 and 0.4523 gives 10, the largest ratio of such a law."""
    ranges = compute_parameter_slider_ranges(MATERIALS["foam"])
    assert (ranges["mu1"].low, ranges["mu1"].high) == pytest.approx((0.2, 5.0), abs=ranges["mu1"].step)
    assert 0.45 - ranges["nu1"].step <= ranges["nu1"].high <= 0.4523


@settings(max_examples=60, deadline=None)
@given(st.floats(1.0, 1e7), st.floats(-0.9, 50.0))
def test_sliders_of_any_size(C10, ratio):
    material = ts.Material("mooney_rivlin", {"C10": C10, "C01": ratio * C10})
    for name, slider in compute_parameter_slider_ranges(material).items():
        assert slider.low <= material.parameters[name] * slider.factor <= slider.high
        for end in (slider.low, slider.high):
            with_values(material, {name: end / slider.factor})


def test_several_parameters_change_together():
    """Changing the two g one after the other would exceed the allowed sum in one of the two orders."""
    changed = with_values(PHANTOM, {"viscoelastic.terms[0].g": 0.9, "viscoelastic.terms[1].g": 0.05, "C10": 900.0})
    assert changed.viscoelastic.g.tolist() == [0.9, 0.05] and changed.parameters["C10"] == 900.0
    assert PHANTOM.viscoelastic.g.tolist() == [0.3, 0.2]
    with pytest.raises(ts.InputError, match="no parameter 'C11'"):
        with_values(PHANTOM, {"C11": 1.0})
    with pytest.raises(ts.InputError, match="must be below 1"):
        with_values(PHANTOM, {"viscoelastic.terms[0].g": 0.9, "C10": 900.0})


def test_a_saved_file_has_the_values_and_their_source(tmp_path):
    content = uploaded(PHANTOM, covariance=[[4.0, 0.0], [0.0, 9.0]], valid_range={"stretch": [0.8, 1.0]},
                       provenance={"method": "analytical", "residual": {"RMSE_Pa": 3.0}})
    changed = with_values(read_uploaded_material("fit.material.json", content),
                          {"C10": 900.0, "viscoelastic.terms[1].tau": 33.0})
    path = save_edited_material(changed, tmp_path / "new", "softer phantom", source="fit.material.json")
    assert path == tmp_path / "new" / "softer phantom.material.json"
    file = ts.read_material_file(path)
    assert file.name == "softer phantom"
    assert parameter_values(file.material) == parameter_values(changed)
    assert file.covariance is None and file.valid_range is None and file.provenance.residual == {}
    assert all(entry.standard_error is None for entry in file.parameters.values())
    assert file.provenance.method == "edited by hand"
    assert file.provenance.settings == {"edited_from": "fit.material.json"}


def test_saving_does_not_overwrite(tmp_path):
    path = save_edited_material(PHANTOM, tmp_path, "one", source="a")
    before = path.read_bytes()
    for name in ("one", "one.material.json", " one "):
        with pytest.raises(ts.InputError, match=r"one\.material\.json: exists already and is not overwritten"):
            save_edited_material(EVERYTHING, tmp_path, name, source="a")
    assert path.read_bytes() == before and [each.name for each in tmp_path.iterdir()] == ["one.material.json"]


@pytest.mark.parametrize("name", ["", "  ", "../out", "a/b", "a\\b", ".hidden", "..", "tab\there", "nul\0", "c:x",
                                  "x" * 101])
def test_invalid_file_names_are_refused(tmp_path, name):
    with pytest.raises(ts.InputError, match=r"name: must be a name of a material file: 1 to 100 printable characters"):
        save_edited_material(PHANTOM, tmp_path / "folder", name, source="a")
    assert not (tmp_path / "folder").exists()
