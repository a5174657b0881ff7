"""The calibration file of an ATI sensor for data acquisition systems, ``FT01234.cal``: volts to forces and torques.

Source: the files' own comment, "use the UserAxis elements to construct the calibration matrix". Files of version 1.0
have none; theirs is built from the Axis rows as those of version 1.1 are: each row over its scale, and the torques
moved by the BasicTransform. On the two files of version 1.1 that a published program quotes
(a Gamma and a Nano17) both ways agree within the rounding of their five decimals.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

from haptics.protocols.ati_serial import CHANNELS
from haptics.protocols.ati_units import FORCE_UNITS, LENGTH_UNITS, TORQUE_UNITS
from tissue_sim.errors import InputError, nearest

#: Bytes of a calibration file.
LARGEST = 1_000_000
#: V, of converters in these systems.
_FULL_SPAN = 20.0
Row = tuple[float, ...]


@dataclass(frozen=True)
class AtiCalibration:
    """wrench = matrix (volts - volts without a load).

    Attributes:
        serial: of the sensor, such as ``FT7927``. part: of the calibration, such as ``SI-40-2``. date: of it.
        matrix: rows Fx Fy Fz Tx Ty Tz, of six numbers, N/V or N m/V.
        reach: largest magnitude of each, N or N m.
        volts: lowest and highest of the outputs, V.
        rows: the elements that it is built from: ``"UserAxis"`` or ``"Axis"``.
    """

    serial: str
    part: str
    date: str
    matrix: tuple[Row, ...]
    reach: Row
    volts: tuple[float, float]
    rows: str

    def wrench(self, volts: Row) -> Row:
        """Forces, N, and torques, N m, of six differences of volts."""
        return tuple(sum(factor * volt for factor, volt in zip(row, volts, strict=True)) for row in self.matrix)


def read_calibration(text: str | bytes, name: str = "the calibration file") -> AtiCalibration:
    """The calibration in the text of a ``.cal`` file.

    Args:
        text: XML. name: of the file, in messages.

    Raises:
        InputError: it is cut off or damaged, no such file, or something is missing in it; names what.
    """
    if len(text) > LARGEST:
        raise InputError("is too large for a calibration file (over 1 MB); give the .cal file of the sensor", file=name)
    data = text if isinstance(text, bytes) else text.encode("utf-8", "replace")
    if b"<!ENTITY" in data:
        raise InputError("defines entities, which no calibration file does; give the .cal file of the sensor",
                         file=name)
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"is no whole XML ({error}): it is cut off or damaged; copy the .cal file from the sensor's "
                         "disc again", file=name) from None
    sensor = root if root.tag == "FTSensor" else root.find(".//FTSensor")
    if sensor is None:
        raise InputError(f"has no FTSensor (it begins with {root.tag}); give the .cal file of the sensor", file=name)
    calibration = sensor.find("Calibration")
    if calibration is None:
        raise InputError("has no Calibration; copy the .cal file from the sensor's disc again", file=name)
    if sensor.get("NumGages", "6").strip() != "6":
        raise InputError(f"is of a sensor with {sensor.get('NumGages')} gages; give one of a sensor with six",
                         file=name)
    force = _unit(calibration, "ForceUnits", FORCE_UNITS, name)
    torque = _unit(calibration, "TorqueUnits", TORQUE_UNITS, name)
    rows = "UserAxis" if calibration.find("UserAxis") is not None else "Axis"
    matrix, reach = _rows(calibration, rows, name)
    if rows == "Axis":
        matrix = _moved(calibration, matrix, name)
    units = (force,) * 3 + (torque,) * 3
    return AtiCalibration(sensor.get("Serial", "unknown"), calibration.get("PartNumber", "unknown"),
                          calibration.get("CalDate", "unknown"),
                          tuple(tuple(unit * value for value in row) for unit, row in zip(units, matrix, strict=True)),
                          tuple(unit * value for unit, value in zip(units, reach, strict=True)),
                          _span(calibration, name), rows)


def _unit(calibration: ElementTree.Element, field: str, units: dict[str, float], name: str) -> float:
    text = calibration.get(field)
    if text is None:
        raise InputError(f"Calibration has no {field}; copy the .cal file from the sensor's disc again", file=name)
    unit = text.strip().replace("N m", "N-m")
    if unit not in units:
        raise InputError(f"unknown unit {text!r}{nearest(unit, units)}", file=name, field=field)
    return units[unit]


def _numbers(text: str | None, count: int, what: str, name: str) -> Row:
    """So many finite numbers in an attribute."""
    words = (text or "").split()
    try:
        numbers = tuple(float(word) for word in words)
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        wanted = f"{count} finite number{'s' * (count > 1)}"
        problem = "is missing" if text is None else f"is {text.strip()[:60]!r}, not {wanted}"
        raise InputError(f"{what} {problem}; copy the .cal file from the sensor's disc again", file=name)
    return numbers


def _rows(calibration: ElementTree.Element, tag: str, name: str) -> tuple[tuple[Row, ...], Row]:
    """The six rows, and the largest value of each, in the units of the file."""
    elements: dict[str, ElementTree.Element] = {}
    for element in calibration.findall(tag):
        axis = element.get("Name", "")
        if axis in elements:
            raise InputError(f"has two {tag} rows for {axis}; copy the .cal file from the sensor's disc again",
                             file=name)
        elements[axis] = element
    missing = [axis for axis in CHANNELS if axis not in elements]
    if missing:
        raise InputError(f"has no {tag} row for {', '.join(missing)}; it is cut off or damaged: copy the .cal file "
                         "from the sensor's disc again", file=name)
    matrix, reach = [], []
    for axis in CHANNELS:
        element = elements[axis]
        row = _numbers(element.get("values"), 6, f"the values of {tag} {axis}", name)
        largest, = _numbers(element.get("max"), 1, f"the max of {tag} {axis}", name)
        if tag == "Axis":
            scale, = _numbers(element.get("scale"), 1, f"the scale of {tag} {axis}", name)
            if not scale > 0:
                raise InputError(f"the scale of {tag} {axis} is {scale:g}, which is not above zero; copy the .cal file "
                                 "from the sensor's disc again", file=name)
            row = tuple(value / scale for value in row)
        if not largest > 0 or not any(row):
            raise InputError(f"{tag} {axis} is all zero or has a max of {largest:g}; copy the .cal file from the "
                             "sensor's disc again", file=name)
        matrix.append(row)
        reach.append(largest)
    return tuple(matrix), tuple(reach)


def _moved(calibration: ElementTree.Element, matrix: tuple[Row, ...], name: str) -> tuple[Row, ...]:
    """Torques about the origin that the BasicTransform gives: torque - offset x force."""
    transform = calibration.find("BasicTransform")
    if transform is None:
        raise InputError("has no UserAxis and no BasicTransform; copy the .cal file from the sensor's disc again",
                         file=name)
    x, y, z, *turns = (_numbers(transform.get(key, "0"), 1, f"{key} of the BasicTransform", name)[0]
                       for key in ("Dx", "Dy", "Dz", "Rx", "Ry", "Rz"))
    if any(turns):
        raise InputError("has no UserAxis rows and a BasicTransform that turns, which this program does not read; ask "
                         "ATI for a file of version 1.1", file=name)
    lengths, torque = calibration.get("DistUnits", ""), calibration.get("TorqueUnits", "").strip()
    force = calibration.get("ForceUnits", "").strip()
    if lengths.strip() not in LENGTH_UNITS:
        raise InputError(f"unknown unit {lengths!r}{nearest(lengths, LENGTH_UNITS)}", file=name, field="DistUnits")
    # An offset times a force, in the unit of the torques.
    lever = FORCE_UNITS[force] * LENGTH_UNITS[lengths.strip()] / TORQUE_UNITS[torque.replace("N m", "N-m")]
    fx, fy, fz, tx, ty, tz = matrix

    def less(torques: Row, one: float, first: Row, other: float, second: Row) -> Row:
        return tuple(value - lever * (one * a - other * b) for value, a, b in zip(torques, first, second, strict=True))

    return fx, fy, fz, less(tx, y, fz, z, fy), less(ty, z, fx, x, fz), less(tz, x, fy, y, fx)


def _span(calibration: ElementTree.Element, name: str) -> tuple[float, float]:
    """Lowest and highest output, V."""
    text = calibration.get("OutputRange")
    span = _FULL_SPAN if text is None else _numbers(text, 1, "OutputRange of the Calibration", name)[0]
    if not 0 < span <= 100.0:
        raise InputError(f"OutputRange is {span:g} V; copy the .cal file from the sensor's disc again", file=name)
    if calibration.get("OutputBipolar", "True").strip().lower() == "false":
        return 0.0, span
    return -0.5 * span, 0.5 * span
