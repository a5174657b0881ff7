"""A kind of test from one file: its recordings are read, and calibrated by its closed form."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from scenes import SCENES
from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.recording.formats.kind_words import KindHint, find_named_tests
from tissue_sim.recording.formats.understanding import interpret_file

TRUTH = {"C10": 1200.0, "C01": 500.0}
#: Height, m.
HEIGHT = 0.020
#: Cross-section, m2.
AREA = 150e-6
CAMPAIGN = """
[[specimen]]
shape = "prism"
area_mm2 = 150.0
height_mm = 20.0

[[test]]
kind = "plane_strain_compression"
recordings = ["block_*.csv"]

[[test]]
kind = "uniaxial_tension"
recordings = ["strip_*.csv"]

[fit]
method = "METHOD"
laws = ["mooney_rivlin"]
start = { C10 = 1000.0, C01 = 400.0 }

[noise]
force_N = 0.001
nominal_stress_Pa = 5.0
"""


def stress(stretch):
    """Mooney-Rivlin written out: 2 (C10 + C01) (l - l^-3) at constant width, 2 (C10 + C01/l) (l - l^-2) uniaxial."""
    C10, C01 = TRUTH.values()
    return 2 * (C10 + C01) * (stretch - stretch**-3), 2 * (C10 + C01 / stretch) * (stretch - stretch**-2)


def write(folder):
    noise = np.random.default_rng(2)
    for number, (name, stretch) in enumerate({"block": np.linspace(1.0, 0.6, 61),
                                              "strip": np.linspace(1.0, 1.6, 61)}.items()):
        sign = np.sign(stretch[-1] - 1.0)
        force = sign * stress(stretch)[number] * AREA + noise.normal(0.0, 0.001, stretch.size)
        displacement = sign * (stretch - 1.0)
        channels = {"time": displacement, "displacement": displacement * HEIGHT, "force": force}
        ts.write_recording(ts.Recording(channels), folder / f"{name}_1.csv")


@pytest.fixture
def kind(plugin, registers):
    return registers(ts.KINDS, plugin("channel_die").KIND)


@pytest.mark.parametrize("method", ["analytical", "inverse_fem"])
def test_kind_of_one_file(kind, tmp_path, method):
    write(tmp_path)
    path = tmp_path / "study.toml"
    path.write_text(CAMPAIGN.replace("METHOD", method), encoding="utf-8")
    campaign = calibration.load_campaign(path)
    assert [test.kind.name for test in campaign.tests] == ["plane_strain_compression", "uniaxial_tension"]
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert result.best.parameters == pytest.approx(TRUTH, rel=0.03)
    # Plane strain determines the sum of both.
    assert sum(result.best.parameters.values()) == pytest.approx(sum(TRUTH.values()), rel=3e-3)


def test_it_takes_its_words_over_from_the_tests_without_a_kind(kind, tmp_path):
    stretch = np.linspace(1.0, 0.6, 21)
    path = tmp_path / "a.csv"
    path.write_text("Plane strain\nStretch [-],Nominal stress [Pa]\n" + "".join(
        f"{a:.4f},{b:.4f}\n" for a, b in zip(stretch, stress(stretch)[0], strict=True)), encoding="utf-8")
    for text in ("plane strain", "Channel die", "Plane strain compression"):
        assert [each.kind for each in find_named_tests([KindHint(text, "here")])] == ["plane_strain_compression"]
    reading, = interpret_file(path).readings
    assert reading.kind.kind == "plane_strain_compression"
    assert "'plane strain' above the numbers" in reading.kind.reason


def test_a_kind_has_words_of_its_own(registers):
    registers(ts.KINDS, ts.TestKind(name="wobble_test", title="Wobble test", tool=None, sign=1.0,
                                    title_words=(r"wobbl\w*",), closed_form=ts.KINDS["simple_shear"].closed_form))
    for text in ("Wobbling", "wobble test", "Wobbles"):
        assert [each.kind for each in find_named_tests([KindHint(text, "here")])] == ["wobble_test"]


def test_its_recordings_need_its_channels(kind, tmp_path):
    stretch = np.linspace(1.0, 0.6, 7)
    ts.write_recording(ts.Recording({"stretch": stretch, "nominal stress": stress(stretch)[0]}), tmp_path / "a.csv")
    assert len(ts.read_recording(tmp_path / "a.csv", kind="plane_strain_compression")) == 7
    ts.write_recording(ts.Recording({"shear strain": stretch, "nominal stress": stretch}), tmp_path / "b.csv")
    with pytest.raises(ts.InputError, match="plane_strain_compression needs columns 'displacement' and 'force' or "):
        ts.read_recording(tmp_path / "b.csv", kind="plane_strain_compression")


def test_a_kind_with_a_tool_is_a_scene(registers):
    sliding = registers(ts.KINDS, ts.TestKind(name="oiled_indentation", title="Oiled indentation", sign=-1.0,
                                              tool=ts.Tool("sphere", radius=5e-3), face=ts.KINDS[
                                                  "lubricated_compression"].face))
    assert "oiled_indentation" in SCENES and "simple_shear" not in SCENES
    experiment = SCENES["oiled_indentation"].experiment(specimen=ts.Specimen(0.04, 0.07),
                                                        protocol=ts.Protocol.ramp(2e-3, 3))
    assert (experiment.friction, experiment.tool) == ("frictionless", sliding.tool)


def test_what_nothing_can_answer_is_refused(kind):
    with pytest.raises(ts.InputError, match="the name 'simple_shear' is taken by another kind of test"):
        ts.KINDS.register(kind, "simple_shear")
    with pytest.raises(ts.InputError, match="neither a tool nor a closed form"):
        ts.KINDS.register(ts.TestKind(name="pulling", title="Pulling", tool=None, sign=1.0))
    with pytest.raises(ts.InputError, match="control must be left out; got 'force'"):
        ts.TestKind(name="creep", title="Creep", tool=ts.Tool(), sign=-1.0, control="force")


def test_control_is_that_of_the_protocol():
    """A kind of an older release that states its control is the kind without it."""
    with pytest.warns(DeprecationWarning, match="TestKind has no control; the protocol prescribes"):
        old = ts.TestKind(name="pressing", title="Pressing", tool=ts.Tool(), sign=-1.0, control="displacement")
    assert old == ts.TestKind(name="pressing", title="Pressing", tool=ts.Tool(), sign=-1.0)
    assert replace(old, sign=1.0).sign == 1.0
    creep = old.experiment(specimen=ts.Specimen(0.02, 0.02), protocol=ts.Protocol.parse("ramp 1N @1N/s; hold 5s"))
    assert creep.protocol.uses_force_control


@dataclass(frozen=True)
class SecondCell(ClosedForm):
    """Uniaxial tension whose second load cell carries half of the load."""

    fraction: float = 1.0

    def select_load(self, number):
        return replace(self, fraction=0.5**number)

    def stress(self, law, abscissa, values):
        return self.fraction * super().stress(law, abscissa, values)

    def stress_parameter_derivatives(self, law, abscissa, values):
        return self.fraction * super().stress_parameter_derivatives(law, abscissa, values)


@pytest.fixture
def two_loads(registers):
    return registers(ts.KINDS, ts.TestKind(
        name="two_cells", title="Two load cells", tool=None, sign=1.0, closed_form=SecondCell("uniaxial", "uniaxial"),
        load_names=("first cell", "second cell"),
        channels=(("displacement", "force", "displacement", "force 2"),
                  ("stretch", "nominal stress", "stretch", "nominal stress 2"))))


def test_a_kind_with_two_loads_fits_both(two_loads, tmp_path):
    """The test of each load sees its own channel: the second one has another modulus, and the fit is their mean."""
    stretch, law = np.linspace(1.0, 1.5, 41), ts.find_law("neo_hooke")
    ts.write_recording(ts.Recording({"stretch": stretch,
                                     "nominal stress": law.nominal_stress(stretch, {"C10": 1000.0}),
                                     "nominal stress 2": 0.5 * law.nominal_stress(stretch, {"C10": 1100.0})}),
                       tmp_path / "a.csv")
    path, text = tmp_path / "study.toml", '[[test]]\nkind = "two_cells"\nrecordings = ["a.csv"]\n{}\n[fit]\nlaws = ' \
        '["neo_hooke"]\n{}'
    path.write_text(text.format("", ""), encoding="utf-8")
    assert [test.name for test in calibration.load_campaign(path).tests] == ["two_cells first cell",
                                                                             "two_cells second cell"]
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    # Least squares with the factors 1 and 1/2 of the loads.
    assert result.best.parameters["C10"] == pytest.approx((1000.0 + 0.25 * 1100.0) / 1.25)
    path.write_text(text.format("", '[fit.scope]\nC10 = "per_test"\n'), encoding="utf-8")
    result, = calibration.calibrate([path], tmp_path / "both", figures=False)
    assert result.best.parameters == pytest.approx({"C10@two_cells": 1020.0})
    path.write_text(text.format('contact = "find"', ""), encoding="utf-8")
    with pytest.raises(ts.InputError, match="contact must be 'recorded' in two_cells, which has several loads"):
        calibration.load_campaign(path)


def test_channels_of_several_loads(two_loads, tmp_path):
    second = two_loads.select_load(1)
    assert second.channels[1] == ("stretch", "nominal stress 2", "stretch", "nominal stress")
    assert second.closed_form.fraction == 0.5 and not second.has_several_motions
    ts.write_recording(ts.Recording({"stretch": np.ones(6), "nominal stress": np.ones(6)}), tmp_path / "a.csv")
    with pytest.raises(ts.InputError, match="or 'stretch' and 'nominal stress' and 'nominal stress 2'; this"):
        ts.read_recording(tmp_path / "a.csv", kind="two_cells")
    with pytest.raises(ts.InputError, match="must list a motion and a load for each of 1 loads"):
        ts.TestKind(name="a", title="A", tool=ts.Tool(), sign=1.0, channels=two_loads.channels)
