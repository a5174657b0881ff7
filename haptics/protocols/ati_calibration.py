"""Calibration files of ATI sensors for data acquisition systems, ``FT01234.cal``: conversion of volts to forces.

Source: the comment in these files, "use the UserAxis elements to construct the calibration matrix". Files of version
1.0 have no UserAxis rows; their matrix is built from the Axis rows, each divided by its scale, with the torques moved
by the BasicTransform. For two published files of version 1.1 (a Gamma and a Nano17) both methods agree within the
rounding of five decimals.

The names of ATI's units occur in calibration files and in configuration pages of network sensors.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

from haptics.protocols.ati_serial import CHANNELS
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.units import get_si_factor_and_offset

#: Forces, N.
FORCE_UNITS = {unit: get_si_factor_and_offset(unit, "force")[0]
               for unit in ("N", "kN", "lbf", "lb", "kg", "kgf", "g", "gf")}
FORCE_UNITS |= {"klbf": 1e3 * FORCE_UNITS["lbf"], "klb": 1e3 * FORCE_UNITS["lbf"]}
#: Lengths, m.
LENGTH_UNITS = {unit: get_si_factor_and_offset(unit, "length")[0] for unit in ("m", "cm", "mm", "in")}
LENGTH_UNITS |= {"ft": 12 * LENGTH_UNITS["in"]}
#: Torques, N m.
TORQUE_UNITS = {f"{force}-{length}": force_SI * length_SI for force, force_SI in FORCE_UNITS.items()
                for length, length_SI in LENGTH_UNITS.items()}
TORQUE_UNITS |= {f"{length}-{force}": TORQUE_UNITS[f"{force}-{length}"]
                 for force in ("lb", "lbf") for length in ("in", "ft")}


#: Largest size of a calibration file, bytes.
MAX_SIZE = 1_000_000
#: Output span of converters without ``OutputRange``, V.
_DEFAULT_SPAN = 20.0
#: A row of the calibration matrix, or six readings.
Row = tuple[float, ...]


@dataclass(frozen=True)
class AtiVoltageCalibration:
    """Calibration of a sensor with voltage outputs: wrench = matrix (volts - volts without load).

    Attributes:
        serial: Serial number of the sensor, such as ``FT7927``.
        part: Part number of the calibration, such as ``SI-40-2``.
        date: Date of the calibration.
        matrix: Rows Fx Fy Fz Tx Ty Tz of six numbers, N/V or N m/V.
        reach: Largest magnitude of each component, N or N m.
        volts: Lowest and highest output, V.
        rows: Elements from which the matrix was built, ``"UserAxis"`` or ``"Axis"``.
    """

    serial: str
    part: str
    date: str
    matrix: tuple[Row, ...]
    reach: Row
    volts: tuple[float, float]
    rows: str

    def compute_wrench_from_voltage_changes(self, volts: Row) -> Row:
        """Return Fx Fy Fz, N, and Tx Ty Tz, N m, for six voltages minus those without load, V."""
        return tuple(sum(factor * volt for factor, volt in zip(row, volts, strict=True)) for row in self.matrix)


def parse_ati_calibration(text: str | bytes, name: str = "the calibration file") -> AtiVoltageCalibration:
    """Parse the text of a ``.cal`` file, and return its calibration in SI units.

    Args:
        text: XML.
        name: Name of the file, for messages.

    Raises:
        InputError: The file is damaged, is no calibration file, or lacks an element; the message names the cause.
    """
    if len(text) > MAX_SIZE:
        raise InputError("a calibration file must be smaller than 1 MB; give the .cal file of the sensor",
                         file=name)
    data = text if isinstance(text, bytes) else text.encode("utf-8", "replace")
    if b"<!ENTITY" in data:
        raise InputError("a calibration file must not define XML entities; give the .cal file of the sensor",
                         file=name)
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"is not valid XML ({error}): it is incomplete or damaged; copy the .cal file from the "
                         "sensor's disc again", file=name) from None
    sensor = root if root.tag == "FTSensor" else root.find(".//FTSensor")
    if sensor is None:
        raise InputError(f"has no FTSensor (its root is {root.tag}); give the .cal file of the sensor", file=name)
    calibration = sensor.find("Calibration")
    if calibration is None:
        raise InputError("has no Calibration; copy the .cal file from the sensor's disc again", file=name)
    if sensor.get("NumGages", "6").strip() != "6":
        raise InputError(f"the calibration must be of a sensor with six gages; got {sensor.get('NumGages')} gages. "
                         "Give the file of another sensor", file=name)
    force = _read_unit(calibration, "ForceUnits", FORCE_UNITS, name)
    torque = _read_unit(calibration, "TorqueUnits", TORQUE_UNITS, name)
    rows = "UserAxis" if calibration.find("UserAxis") is not None else "Axis"
    matrix, reach = _read_matrix_rows_and_ranges(calibration, rows, name)
    if rows == "Axis":
        matrix = _move_torque_rows_to_origin(calibration, matrix, name)
    units = (force,) * 3 + (torque,) * 3
    return AtiVoltageCalibration(sensor.get("Serial", "unknown"), calibration.get("PartNumber", "unknown"),
                                 calibration.get("CalDate", "unknown"),
                                 tuple(tuple(unit * value for value in row) for unit,
                                       row in zip(units, matrix, strict=True)),
                                 tuple(unit * value for unit, value in zip(units, reach, strict=True)),
                                 _read_lowest_and_highest_volts(calibration, name), rows)


def _read_unit(calibration: ElementTree.Element, field: str, units: dict[str, float], name: str) -> float:
    """Return the value in SI units of the unit named by the attribute `field`; InputError if it is unknown."""
    text = calibration.get(field)
    if text is None:
        raise InputError(f"Calibration has no {field}; copy the .cal file from the sensor's disc again", file=name)
    unit = text.strip().replace("N m", "N-m")
    if unit not in units:
        raise InputError(f"unknown unit {text!r}{make_hint_with_similar_or_known_words(unit, units)}", file=name,
                         field=field)
    return units[unit]


def _parse_numbers(text: str | None, count: int, quantity: str, name: str) -> Row:
    """Return the numbers in the text of an attribute; InputError unless they are `count` finite numbers."""
    words = (text or "").split()
    try:
        numbers = tuple(float(word) for word in words)
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        found = "none" if text is None else repr(text.strip()[:60])
        raise InputError(f"{quantity} must be {count} finite number{'s' * (count > 1)}; got {found}. Copy the .cal "
                         "file from the sensor's disc again", file=name)
    return numbers


def _read_matrix_rows_and_ranges(calibration: ElementTree.Element, tag: str, name: str) -> tuple[tuple[Row, ...], Row]:
    """Return the matrix, six rows Fx to Tz, and the largest value of each component, in the file's units."""
    elements: dict[str, ElementTree.Element] = {}
    for element in calibration.findall(tag):
        axis = element.get("Name", "")
        if axis in elements:
            raise InputError(f"has two {tag} rows for {axis}; copy the .cal file from the sensor's disc again",
                             file=name)
        elements[axis] = element
    missing = [axis for axis in CHANNELS if axis not in elements]
    if missing:
        raise InputError(f"has no {tag} row for {', '.join(missing)}: it is incomplete or damaged; copy the .cal file "
                         "from the sensor's disc again", file=name)
    matrix, reach = [], []
    for axis in CHANNELS:
        element = elements[axis]
        row = _parse_numbers(element.get("values"), 6, f"the values of {tag} {axis}", name)
        largest, = _parse_numbers(element.get("max"), 1, f"the max of {tag} {axis}", name)
        if tag == "Axis":
            scale, = _parse_numbers(element.get("scale"), 1, f"the scale of {tag} {axis}", name)
            if not scale > 0:
                raise InputError(f"the scale of {tag} {axis} must be above 0; got {scale:g}. Copy the .cal file "
                                 "from the sensor's disc again", file=name)
            row = tuple(value / scale for value in row)
        if not largest > 0 or not any(row):
            raise InputError(f"{tag} {axis} must have a value and a max above 0; got a max of {largest:g}. Copy the "
                             ".cal file from the sensor's disc again", file=name)
        matrix.append(row)
        reach.append(largest)
    return tuple(matrix), tuple(reach)


def _move_torque_rows_to_origin(calibration: ElementTree.Element,
                                matrix: tuple[Row, ...], name: str) -> tuple[Row, ...]:
    """Return the matrix with its torque rows moved to the origin of the BasicTransform: torque - offset x force."""
    transform = calibration.find("BasicTransform")
    if transform is None:
        raise InputError("has no UserAxis and no BasicTransform; copy the .cal file from the sensor's disc again",
                         file=name)
    x, y, z, *rotations = (_parse_numbers(transform.get(key, "0"), 1, f"{key} of the BasicTransform", name)[0]
                           for key in ("Dx", "Dy", "Dz", "Rx", "Ry", "Rz"))
    if any(rotations):
        raise InputError("has no UserAxis rows and a BasicTransform with a rotation, which is not supported; ask "
                         "ATI for a file of version 1.1", file=name)
    lengths, torque = calibration.get("DistUnits", ""), calibration.get("TorqueUnits", "").strip()
    force = calibration.get("ForceUnits", "").strip()
    if lengths.strip() not in LENGTH_UNITS:
        raise InputError(f"unknown unit {lengths!r}{make_hint_with_similar_or_known_words(lengths, LENGTH_UNITS)}",
                         file=name, field="DistUnits")
    # Unit of offset times force, in units of torque.
    lever = FORCE_UNITS[force] * LENGTH_UNITS[lengths.strip()] / TORQUE_UNITS[torque.replace("N m", "N-m")]
    fx, fy, fz, tx, ty, tz = matrix

    def subtract_lever_torque(torques: Row, offset_1: float, force_1: Row, offset_2: float, force_2: Row) -> Row:
        """Return torques minus the moment of two forces: torques - lever (offset_1 force_1 - offset_2 force_2)."""
        return tuple(value - lever * (offset_1 * a - offset_2 * b)
                     for value, a, b in zip(torques, force_1, force_2, strict=True))

    return (fx, fy, fz, subtract_lever_torque(tx, y, fz, z, fy), subtract_lever_torque(ty, z, fx, x, fz),
            subtract_lever_torque(tz, x, fy, y, fx))


def _read_lowest_and_highest_volts(calibration: ElementTree.Element, name: str) -> tuple[float, float]:
    """Return the lowest and the highest output voltage of the sensor, V, from the span and the polarity."""
    text = calibration.get("OutputRange")
    span = _DEFAULT_SPAN if text is None else _parse_numbers(text, 1, "OutputRange of the Calibration", name)[0]
    if not 0 < span <= 100.0:
        raise InputError(f"OutputRange must be above 0 and at most 100 V; got {span:g} V. Copy the .cal file from the "
                         "sensor's disc again", file=name)

    if calibration.get("OutputBipolar", "True").strip().lower() == "false":
        return 0.0, span
    return -0.5 * span, 0.5 * span
