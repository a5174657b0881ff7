"""Kinds of test: what each says, and that all of it can be used."""

import pickle
import subprocess
import sys

import numpy as np
import pytest

import tissue_sim as ts
from scenes import SCENES
from scenes.catalogue import SIMULATED
from tissue_sim.experiment.contact_law import validate_and_normalise_interface
from tissue_sim.recording.recording import CHANNELS

EVERY = pytest.mark.parametrize("name", ts.KINDS)
HOMOGENEOUS = [name for name, kind in ts.KINDS.items() if kind.closed_form is not None
               and not kind.closed_form.needs_bulk and not kind.has_several_motions]


def test_those_with_a_tool_are_the_scenes():
    assert set(SCENES) == {name for name, kind in ts.KINDS.items() if kind.tool is not None}
    assert set(SIMULATED) == set(SCENES) | {"uniaxial_tension", "simple_shear", "torsion", "planar_tension"}
    with pytest.raises(KeyError):
        SCENES["simple_shear"]


@EVERY
def test_a_kind_is_what_its_parts_know(name):
    kind = ts.KINDS[name]
    assert kind.name == name and pickle.loads(pickle.dumps(kind)) == kind
    assert {channel for pair in kind.channels for channel in pair} <= set(CHANNELS)
    for field, usual in kind.make_default_interfaces_by_field(kind.tool or ts.Tool()).items():
        assert validate_and_normalise_interface(usual, field) == usual


@EVERY
def test_its_experiment(name):
    kind, setting = ts.KINDS[name], {"specimen": ts.Specimen(0.04, 0.07), "protocol": ts.Protocol.ramp(0.01)}
    if not kind.is_simulated:
        with pytest.raises(ts.InputError, match="has no tool and is not simulated"):
            kind.experiment(**setting)
        return
    if kind.has_gripped_ends:
        if kind.specimen_shapes == ("block",):
            setting["specimen"] = ts.Block(0.04, 0.04, 0.07)
        if kind.grip.is_rotation:
            setting["protocol"] = ts.Protocol.parse("ramp 30deg @1deg/s")
        experiment = kind.experiment(**setting)
        assert experiment.tool.is_plate and experiment.friction == experiment.friction_base == "bonded"
        assert experiment.channels == kind.channels[0] and experiment.grip == kind.grip
        return
    experiment = kind.experiment(**setting)
    assert experiment.tool == kind.tool and kind.allows_tool(experiment.tool)
    if kind.has_lateral_wall:
        with pytest.raises(ts.InputError, match="must be 'bonded' on both faces"):
            kind.experiment(**setting, friction="stick")
        return
    assert kind.experiment(**setting, friction="stick").friction == "stick"


@pytest.mark.parametrize(("tool", "friction"), [
    (ts.Tool("flat", radius=8e-3), "bonded"), (ts.Tool("sphere", radius=8e-3), "stick"),
    (ts.Tool("cone", radius=8e-3, half_angle=0.7), "stick")])
def test_a_needle_without_a_flat_face_is_not_bonded(tool, friction):
    setting = {"specimen": ts.Specimen(0.04, 0.07), "protocol": ts.Protocol.ramp(5e-3), "tool": tool}
    assert ts.KINDS["needle_indentation"].experiment(**setting).friction == friction


@pytest.mark.parametrize(("name", "abscissa", "strain"), [
    ("lubricated_compression", 0.9, 0.1), ("uniaxial_tension", 1.2, 0.2), ("simple_shear", -0.3, -0.3)])
def test_strain_under_load(name, abscissa, strain):
    kind = ts.KINDS[name]
    assert kind.convert_abscissa_to_nominal_strain(np.array([abscissa])) == pytest.approx([strain])
    assert kind.convert_nominal_strain_to_stretch_or_shear_strain(kind.convert_abscissa_to_nominal_strain(abscissa)) \
        == pytest.approx(abscissa)


@pytest.mark.parametrize("name", HOMOGENEOUS)
def test_stress_is_against_the_strain(name):
    """Slope at small strain: 3 mu uniaxial, mu in shear and torsion, 4 mu at constant width, 6 mu equibiaxial."""
    kind, law, values = ts.KINDS[name], ts.find_law("neo_hooke"), {"C10": 500.0}
    small = kind.convert_nominal_strain_to_stretch_or_shear_strain(np.array([1e-6]))
    factors = {"simple_shear": 1.0, "torsion": 1.0, "torsion_axial_force": 1.0, "planar_tension": 4.0,
               "equibiaxial_tension": 6.0}
    modulus = 1000.0 * factors.get(name, 3.0)
    assert kind.sign * kind.closed_form.stress(law, small, values) == pytest.approx(modulus * 1e-6, rel=1e-4)
    assert kind.closed_form.slope(law, small, values) == pytest.approx(modulus, rel=1e-4)


@pytest.mark.parametrize(("name", "abscissa", "stretches"), [
    ("lubricated_compression", 0.25, (0.25, 2.0)), ("uniaxial_tension", 4.0, (0.5, 4.0)),
    # l - 1/l = 1.5 at l = 2.
    ("simple_shear", 1.5, (0.5, 2.0)), ("simple_shear", -1.5, (0.5, 2.0)),
    ("planar_tension", 2.0, (0.5, 2.0)), ("equibiaxial_tension", 2.0, (0.25, 2.0))])
def test_extreme_stretches(name, abscissa, stretches):
    assert ts.KINDS[name].closed_form.find_extreme_stretches(abscissa, abscissa) == pytest.approx(stretches)


def test_names_and_sizes_need_no_numpy():
    """Help lists kinds, shapes and sizes."""
    code = ("import sys; from scenes.catalogue import SCENES; "
            "from tissue_sim.experiment.tools.tool import list_all_tool_sizes_by_key; "
            "print(len(SCENES), len(list_all_tool_sizes_by_key()), 'numpy' in sys.modules)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, encoding="utf-8", check=True)
    assert done.stdout.split() == ["5", "4", "False"]
