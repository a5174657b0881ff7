"""The .cal files of ATI: an artificial one, numbers of a published one, and invalid files."""

import math
import os
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haptics.protocols.ati_calibration import FORCE_UNITS, TORQUE_UNITS, parse_ati_calibration
from tissue_sim.errors import InputError

CASES = settings(max_examples=int(os.environ.get("TISSUE_SIM_FUZZ_CASES", "500")), deadline=None)
AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
MATRIX = ((0.5, 0.1, 0.0, -9.0, 0.2, 9.1), (0.0, 10.5, 0.1, -5.0, 0.2, -5.1), (16.0, -0.3, 16.5, -0.4, 16.2, -0.5),
          (0.01, 0.2, -0.7, -0.1, 0.7, -0.1), (0.8, 0.0, -0.4, 0.2, -0.4, -0.2), (0.0, -0.4, 0.0, -0.4, 0.0, -0.4))
MAXIMA = (40.0, 40.0, 120.0, 2.0, 2.0, 2.0)


def file_of(matrix=MATRIX, maxima=MAXIMA, tag="UserAxis", attributes='OutputRange="20" OutputBipolar="True"', inside="",
            force="N", torque="N-m"):
    """A calibration file in ATI's format."""
    rows = "".join(f'\t\t<{tag} Name="{axis}" values="{" ".join(format(value, "9.5f") for value in row)} " '
                   f'max="{largest:g}"{" scale=" + chr(34) + "2.5" + chr(34) if tag == "Axis" else ""}/>\n'
                   for axis, row, largest in zip(AXES, matrix, maxima, strict=True))
    return ('<?xml version="1.0" encoding="utf-8"?>\n<!-- NOTE: made up -->\n'
            '<FTSensor  Serial="FT00001" BodyStyle="Mini40" Family="DAQ" NumGages="6" CalFileVersion="1.1">\n'
            f'\t<Calibration  PartNumber="SI-40-2" CalDate="1/2/2003" ForceUnits="{force}" TorqueUnits="{torque}" '
            f'DistUnits="m" {attributes}>\n{inside}{rows}\t</Calibration>\n</FTSensor>\n')


def test_the_matrix_consists_of_the_rows():
    calibration = parse_ati_calibration(file_of())
    assert calibration.matrix == MATRIX and calibration.reach == MAXIMA and calibration.volts == (-10.0, 10.0)
    assert (calibration.serial, calibration.part, calibration.date) == ("FT00001", "SI-40-2", "1/2/2003")
    assert calibration.rows == "UserAxis"
    wrench = calibration.compute_wrench_from_voltage_changes((0.0, 0.0, 2.0, 0.0, 0.0, 1.0))
    assert wrench == pytest.approx((9.1, -4.9, 32.5, -1.5, -1.0, -0.4))
    assert parse_ati_calibration(file_of().encode()) == calibration


def test_axis_rows_are_ignored_if_there_are_user_axis_rows():
    inside = re.findall(r"\t\t<Axis.*\n", file_of(tuple(tuple(7.0 for _ in row) for row in MATRIX), tag="Axis"))
    assert len(inside) == 6
    assert parse_ati_calibration(file_of(inside="".join(inside))) == parse_ati_calibration(file_of())


@pytest.mark.parametrize(("force", "newtons"), [("N", 1.0), ("lbf", 4.4482216152605), ("klbf", 4448.2216152605),
                                                ("kN", 1000.0), ("kg", 9.80665)])
@pytest.mark.parametrize(("torque", "newton_metres"), [("N-m", 1.0), ("N-mm", 1e-3), ("lbf-in", 0.112984829027617),
                                                       ("lbf-ft", 1.35581794833140), ("kN-m", 1e3),
                                                       ("kg-cm", 0.0980665), ("in-lb", 0.112984829027617)])
def test_units_of_the_file(force, newtons, torque, newton_metres):
    """1 lbf, 1 lbf in and 1 lbf ft according to NIST SP 811, appendix B.8."""
    calibration = parse_ati_calibration(file_of(force=force, torque=torque))
    for row, wanted, unit in zip(calibration.matrix, MATRIX, (newtons,) * 3 + (newton_metres,) * 3, strict=True):
        assert row == pytest.approx([unit * value for value in wanted], rel=1e-12)
    assert calibration.reach[0] == pytest.approx(40.0 * newtons) and calibration.reach[5] == pytest.approx(
        2.0 * newton_metres)


def test_axis_rows_give_the_same_matrix_as_user_axis_rows():
    """The first gages of a Gamma (FT8578); a published program quotes both kinds of rows."""
    axes = ((-0.27053, -0.14278), (0.21616, 37.46357), (18.48980, -0.25078), (0.05325, 0.15667), (37.31421, -0.62445),
            (-0.13536, -18.46474))
    scales = (2.33993181642138, 2.33993181642138, 0.747981765296576, 44.8196831994584, 44.8196831994584,
              43.1398206760749)
    user_axes = ((-0.11562, -0.06102), (0.09238, 16.01054), (24.71959, -0.33527), (0.00230, 0.19585),
                 (0.83393, -0.01320), (-0.00314, -0.42802))
    text = file_of(tuple((*pair, 0.0, 0.0, 0.0, 0.0) for pair in axes), tag="Axis",
                   inside='<BasicTransform Dx="0" Dy="0" Dz="0.0120142" Rx="0" Ry="0" Rz="0"/>')
    for scale in scales:
        text = text.replace('scale="2.5"', f'scale="{scale}"', 1)
    calibration = parse_ati_calibration(text)
    assert calibration.rows == "Axis"
    for row, wanted in zip(calibration.matrix, user_axes, strict=True):
        assert row[:2] == pytest.approx(wanted, abs=1e-5) and not any(row[2:])


def test_a_transform_moves_the_torques_in_all_directions():
    """torque = torque of the rows - offset x force, with forces of 1 N/V, calculated by hand."""
    one = tuple(tuple(2.5 * (row == column) for column in range(6)) for row in range(6))
    text = file_of(one, tag="Axis", inside='<BasicTransform Dx="3" Dy="20" Dz="100"/>', torque="N-mm").replace(
        'DistUnits="m"', 'DistUnits="mm"')
    torques = parse_ati_calibration(text).matrix[3:]
    assert [row[:3] for row in torques] == [pytest.approx((0.0, 0.1, -0.02)), pytest.approx((-0.1, 0.0, 0.003)),
                                            pytest.approx((0.02, -0.003, 0.0))]


@pytest.mark.parametrize(("attributes", "volts"), [('OutputRange="10" OutputBipolar="True"', (-5.0, 5.0)),
                                                   ('OutputRange="10" OutputBipolar="False"', (0.0, 10.0)),
                                                   ("", (-10.0, 10.0))])
def test_the_output_range_is_read(attributes, volts):
    assert parse_ati_calibration(file_of(attributes=attributes)).volts == volts


@pytest.mark.parametrize(("old", "new", "sentence"), [
    ("FTSensor", "Sensor", r"^FT1\.cal: has no FTSensor \(its root is Sensor\); give the \.cal file of the sensor$"),
    ("Calibration ", "Calibratio ", "is not valid XML"),
    ('NumGages="6"', 'NumGages="8"', "must be of a sensor with six gages; got 8 gages"),
    ('ForceUnits="N" ', "", "Calibration has no ForceUnits; copy the .cal file from the sensor's disc again"),
    ('ForceUnits="N"', 'ForceUnits="stone"', "ForceUnits: unknown unit 'stone'; known: N, kN"),
    ('TorqueUnits="N-m"', 'TorqueUnits="lbf-inch"', "TorqueUnits: unknown unit 'lbf-inch'; did you mean 'lbf-in'"),
    ('Name="Tz"', 'Name="Fz"', "has two UserAxis rows for Fz"),
    ('Name="Tz"', 'Name="T"', "has no UserAxis row for Tz: it is incomplete or damaged"),
    ("UserAxis", "User", "has no Axis row for Fx, Fy, Fz, Tx, Ty, Tz"),
    ('values="  0.50000', 'values="', "the values of UserAxis Fx must be 6 finite numbers; got '0.10000.*'"),
    ("16.20000", "nan", "the values of UserAxis Fz must be 6 finite numbers; got .*"),
    ("16.20000", "1e999", "the values of UserAxis Fz must be 6 finite numbers; got .*"),
    ("16.20000", "16,2", "the values of UserAxis Fz must be 6 finite numbers; got .*"),
    ('max="120"', "", "the max of UserAxis Fz must be 1 finite number; got none"),
    ('max="120"', 'max="0"', "UserAxis Fz must have a value and a max above 0; got a max of 0"),
    ('OutputRange="20"', 'OutputRange="-20"', "OutputRange must be above 0 and at most 100 V; got -20 V"),
    ("<!-- NOTE: made up -->", '<!DOCTYPE a [<!ENTITY b "c">]>', "must not define XML entities"),
])
def test_invalid_files_are_refused_with_the_cause(old, new, sentence):
    text = file_of()
    assert old in text
    with pytest.raises(InputError, match=sentence) as caught:
        parse_ati_calibration(text.replace(old, new), "FT1.cal")
    assert str(caught.value).startswith("FT1.cal: ")


def test_invalid_axis_rows_are_refused_with_the_cause():
    transform = '<BasicTransform Dx="0" Dy="0" Dz="1" Rx="0" Ry="0" Rz="0"/>'
    text = file_of(tag="Axis", inside=transform)
    for old, new, sentence in ((transform, "", "has no UserAxis and no BasicTransform"),
                               ('Rz="0"', 'Rz="90"', "a BasicTransform with a rotation"),
                               ('Dz="1"', 'Dz="one"', "Dz of the BasicTransform must be 1 finite number; got 'one'"),
                               ('scale="2.5"', 'scale="0"', "the scale of Axis Fx must be above 0; got 0"),
                               ('DistUnits="m"', 'DistUnits="mile"', "DistUnits: unknown unit 'mile'")):
        with pytest.raises(InputError, match=sentence):
            parse_ati_calibration(text.replace(old, new))


def test_a_truncated_file_is_refused():
    text = file_of()
    for end in range(len(text.rstrip())):
        with pytest.raises(InputError, match=r"is not valid XML .*: it is incomplete or damaged; copy the \.cal file"):
            parse_ati_calibration(text[:end])


def test_a_large_file_is_refused():
    with pytest.raises(InputError, match="must be smaller than 1 MB"):
        parse_ati_calibration(b" " * 1_000_001)


def checked(data):
    """Check that the data are refused or give a complete calibration."""
    try:
        calibration = parse_ati_calibration(data)
    except InputError:
        return
    assert len(calibration.matrix) == 6 and all(len(row) == 6 for row in calibration.matrix)
    assert all(math.isfinite(value) for row in calibration.matrix for value in row)
    assert all(0 < value < math.inf for value in calibration.reach) and calibration.volts[0] < calibration.volts[1]


@CASES
@given(st.one_of(st.binary(max_size=200), st.text(max_size=200)))
def test_any_bytes_are_decoded_or_refused(data):
    checked(data)


@pytest.mark.slow
@CASES
@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), min_size=1, max_size=3), st.booleans())
def test_a_file_with_wrong_bytes_is_complete_or_refused(wrong, axis_rows):
    data = bytearray(file_of(tag="Axis", inside='<BasicTransform Dz="1"/>').encode() if axis_rows else
                     file_of().encode())
    for place, byte in wrong:
        data[place % len(data)] = byte
    checked(bytes(data))


def test_units_have_the_spelling_of_the_boxes():
    assert {"lbf", "N", "klbf", "kN", "kg"} <= set(FORCE_UNITS)
    assert {"lbf-in", "lbf-ft", "N-m", "N-mm", "kN-m", "kg-cm"} <= set(TORQUE_UNITS)
