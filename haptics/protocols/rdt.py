"""Raw data transfer (RDT) of ATI's Net F/T and Ethernet Axia: requests and records on UDP, settings page (XML) on HTTP.

Sources: ATI manuals 9610-05-1022 (Net F/T) and 9610-05-Ethernet Axia-09 (status codes in its section 4.8).
"""

from __future__ import annotations

import contextlib
import math
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from xml.sax.saxutils import escape

from haptics.protocols.ati_calibration import FORCE_UNITS, TORQUE_UNITS
from tissue_sim.errors import InputError


@dataclass(frozen=True)
class DefaultPorts:
    """Default ports of a box.

    Attributes:
        records: UDP port of the requests and records.
        settings: TCP port of the settings page.
    """

    records: int = 49152
    settings: int = 80


#: Ports of a box in its factory settings.
PORTS = DefaultPorts()
#: Path of the settings page.
SETTINGS_PATH = "/netftapi2.xml"
#: Names of the six counts of a record.
CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


@dataclass(frozen=True)
class DatagramFormat:
    """Numbers of the format of datagrams.

    Attributes:
        max_records: Largest number of records in one datagram of the buffered mode.
        magic: First two bytes of a request.
    """

    max_records: int = 40
    magic: int = 0x1234


#: Format of every box.
DATAGRAM = DatagramFormat()
#: Request: magic number, command, number of samples.
_REQUEST = struct.Struct(">HHI")
#: Record: sequence number, sample number, status, six counts.
_RECORD = struct.Struct(">III6i")
#: Length of a record, bytes.
RECORD_SIZE = _RECORD.size


class StatusWordBit(IntFlag):
    """Bits of the status word of a record; the other bits are in `describe_status`."""

    #: A threshold was passed; the sample is valid.
    THRESHOLD = 1 << 16
    #: Net F/T: a gage is saturated.
    SATURATED = 1 << 17
    #: Axia: a gage is out of range.
    GAGE_RANGE = 1 << 27
    #: Axia: force or torque is out of range.
    WRENCH_RANGE = 1 << 30


#: Status bits for gages or wrench out of range.
_OUT_OF_RANGE = int(StatusWordBit.SATURATED | StatusWordBit.GAGE_RANGE | StatusWordBit.WRENCH_RANGE)
#: Mask of the status bits that mark an unreliable sample.
_FAULTS = ~int(StatusWordBit.THRESHOLD)
#: Units that the configurations page of a box offers.
_OFFERED = {"force": ("N", "kN", "lbf", "klbf", "kg"),
            "torque": ("N-m", "N-mm", "kN-m", "lbf-in", "lbf-ft", "kg-cm")}
#: Meaning of the status bits of an Axia.
_MEANINGS = {0: "its temperature is out of range", 1: "its supply voltage is out of range", 2: "a gage is broken",
             3: "it is busy with a change of its settings", 17: "it is saturated", 27: "a gage is out of range",
             28: "its error is simulated", 29: "its calibration has a wrong checksum",
             30: "force or torque is out of range"}


class RdtCommand(IntEnum):
    """Numbers of the commands that a request sends to the box."""

    STOP = 0x0000
    REAL_TIME = 0x0002
    BUFFERED = 0x0003
    RESET_LATCH = 0x0041
    BIAS = 0x0042


@dataclass(frozen=True, slots=True)
class RdtRequest:
    """A request of a client.

    Attributes:
        command: Number of the command, see `RdtCommand`.
        count: Number of samples to send; 0: without end.
    """

    command: int
    count: int = 0


#: Fx, Fy, Fz, Tx, Ty, Tz, in counts.
Wrench = tuple[int, int, int, int, int, int]


@dataclass(frozen=True, slots=True)
class RdtRecord:
    """One sample.

    Attributes:
        sequence: Number since the start of the transfer.
        sample: Number of the sensor's own sample.
        status: Status word.
        counts: Fx, Fy, Fz, Tx, Ty, Tz, in counts.
    """

    sequence: int
    sample: int
    status: int
    counts: Wrench


def pack_request(request: RdtRequest) -> bytes:
    """Return the 8 bytes of a request datagram."""
    return _REQUEST.pack(DATAGRAM.magic, request.command, request.count)


def unpack_request_or_none(data: bytes) -> RdtRequest | None:
    """Return the request in a datagram; None: the bytes are no request."""
    if len(data) != _REQUEST.size:
        return None
    magic, command, count = _REQUEST.unpack(data)
    return RdtRequest(command, count) if magic == DATAGRAM.magic else None


def pack_records(records: Iterable[RdtRecord]) -> bytes:
    """Return the bytes of one datagram with these records, 36 bytes each."""
    return b"".join(_RECORD.pack(record.sequence, record.sample, record.status, *record.counts) for record in records)


def unpack_records_or_none(data: bytes) -> list[RdtRecord] | None:
    """Return the records in a datagram; None: the bytes are no whole number of records, or too many."""
    count, rest = divmod(len(data), RECORD_SIZE)
    if rest or not 0 < count <= DATAGRAM.max_records:
        return None
    return [RdtRecord(sequence, sample, status, (x, y, z, u, v, w))
            for sequence, sample, status, x, y, z, u, v, w in _RECORD.iter_unpack(data)]


def has_exceeded_range(status: int) -> bool:
    """Return True if the status word reports a range that was exceeded: the true wrench may be larger."""
    return bool(status & _OUT_OF_RANGE)


def is_sample_unreliable(status: int) -> bool:
    """Return True if the status word reports a saturation or any other error: the sample is unreliable."""
    return bool(status & _FAULTS)


def describe_status(status: int) -> str:
    """Return the meaning of a status word, such as ``"a gage is broken (0x80000004)"``."""
    meanings = [meaning for bit, meaning in _MEANINGS.items() if status >> bit & 1]
    return f"{', '.join(meanings) or 'it reports an error'} (0x{status:08x})"


@dataclass(frozen=True)
class BoxSettings:
    """Units, scale and rate of a box.

    Attributes:
        counts_per_force: Counts per `force_unit`.
        counts_per_torque: Counts per `torque_unit`.
        force_unit: Unit as the box names it: N, lbf, klbf, kN or kg.
        torque_unit: Unit as the box names it: N-m, N-mm, lbf-in, lbf-ft, kN-m or kg-cm.
        rate: Rate of the records, Hz; None: not reported.
        product: Name of the box.
        calibration: Serial number of the calibration.
    """

    counts_per_force: float
    counts_per_torque: float
    force_unit: str = "N"
    torque_unit: str = "N-m"
    rate: float | None = None
    product: str = ""
    calibration: str = ""

    @property
    def newtons_per_count(self) -> float:
        """Force of one count, N.

        Raises:
            InputError: The unit is unknown.
        """
        return _find_unit_value(self.force_unit, "force") / self.counts_per_force

    @property
    def newton_metres_per_count(self) -> float:
        """Torque of one count, N m. Raises as `newtons_per_count`."""
        return _find_unit_value(self.torque_unit, "torque") / self.counts_per_torque


def _find_unit_value(name: str, quantity: str) -> float:
    """Return the size of a unit of force, N, or of torque, N m, by its name; `quantity` is "force" or "torque"."""
    known = FORCE_UNITS if quantity == "force" else TORQUE_UNITS
    try:
        return known[name.replace("·", "-")]
    except KeyError:
        raise InputError(f"the unit of {quantity} must be a known unit; got {name!r} from the box. Set the unit to "
                         f"one of {', '.join(_OFFERED[quantity])} on the configurations page of the box",
                         field=f"{quantity}_unit") from None


def parse_settings_page(page: bytes) -> BoxSettings:
    """Parse the bytes of the page ``netftapi2.xml`` of a box, and return its settings.

    Raises:
        InputError: The page is no XML, or a field is missing or no positive number.
    """
    try:
        # Entities are refused, because any server at the address can send the page.
        if b"<!" in page.split(b"?>", 1)[-1]:
            raise ElementTree.ParseError("declarations")
        root = ElementTree.fromstring(page)
    except (ElementTree.ParseError, ValueError, LookupError):
        raise InputError("the settings page must be the XML page of an ATI box; the page is no valid XML. Check the "
                         "address",
                         field="settings") from None
    texts = {element.tag.rpartition("}")[2].lower(): (element.text or "").strip() for element in root.iter()
             if isinstance(element.tag, str)}

    def read_positive_number(name: str) -> float:
        """Return the positive number in the element `name` of the page."""
        with contextlib.suppress(KeyError, ValueError):
            if 0 < (value := float(texts[name])) < math.inf:
                return value
        raise InputError(f"must be a positive number on the settings page; got {texts.get(name)!r}. Check that the "
                         "address is that of an ATI box", field=name)

    return BoxSettings(read_positive_number("cfgcpf"), read_positive_number("cfgcpt"), texts.get("scfgfu") or "N",
                       texts.get("scfgtu") or "N-m",
                       read_positive_number("comrdtrate") if "comrdtrate" in texts else None,
                       texts.get("prodname", ""), texts.get("cfgcalsn") or texts.get("setserial", ""))


def encode_settings_page(settings: BoxSettings) -> bytes:
    """Return the bytes of a settings page (XML) with the fields that `parse_settings_page` reads."""
    entries = {"prodname": settings.product or "RDT", "runstat": "0x00000000", "cfgcalsn": settings.calibration,
               "scfgfu": settings.force_unit, "scfgtu": settings.torque_unit,
               "cfgcpf": f"{settings.counts_per_force:.10g}", "cfgcpt": f"{settings.counts_per_torque:.10g}",
               **({} if settings.rate is None else {"comrdtrate": f"{settings.rate:.10g}"}),
               "comrdtbsiz": str(DATAGRAM.max_records)}
    lines = "".join(f"<{name}>{escape(text)}</{name}>\n" for name, text in entries.items())
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<netft>\n{lines}</netft>\n'.encode()
