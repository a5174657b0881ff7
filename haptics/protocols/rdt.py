"""Raw data transfer (RDT) of ATI's Net F/T and Ethernet Axia: requests and records over UDP, settings as XML over HTTP.

Sources: ATI manuals 9610-05-1022 (Net F/T) and 9610-05-Ethernet Axia-09 (status codes in its section 4.8).
"""

from __future__ import annotations

import contextlib
import math
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass
from xml.sax.saxutils import escape

from haptics.protocols.ati_units import FORCE_UNITS, TORQUE_UNITS
from tissue_sim.errors import InputError

PORT, HTTP_PORT, SETTINGS_PATH = 49152, 80, "/netftapi2.xml"
STOP, REAL_TIME, BUFFERED, RESET_LATCH, BIAS = 0x0000, 0x0002, 0x0003, 0x0041, 0x0042
CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
#: Records in a datagram of the buffered mode, at most.
MOST_RECORDS = 40
_MAGIC = 0x1234
_REQUEST, _RECORD = struct.Struct(">HHI"), struct.Struct(">III6i")
RECORD_SIZE = _RECORD.size

#: Bits of the status word. Gages or wrench out of range (Axia 27 and 30, Net F/T 17); a threshold that was passed,
#: which says nothing against the sample.
_OUT_OF_RANGE = 1 << 27 | 1 << 30 | 1 << 17
_THRESHOLD = 1 << 16
#: Units that a configurations page offers.
_OFFERED = {"force": ("N", "kN", "lbf", "klbf", "kg"),
            "torque": ("N-m", "N-mm", "kN-m", "lbf-in", "lbf-ft", "kg-cm")}
#: What the status code of an Axia says, by bit.
_MEANINGS = {0: "its temperature is out of range", 1: "its supply voltage is out of range", 2: "a gage is broken",
             3: "it is busy with a change of its settings", 17: "it is saturated", 27: "a gage is out of range",
             28: "its error is simulated", 29: "its calibration has a wrong checksum",
             30: "force or torque is out of range"}


@dataclass(frozen=True, slots=True)
class Request:
    """What a client asks: a command, and how many samples (0: without end)."""

    command: int
    count: int = 0


#: Fx, Fy, Fz, Tx, Ty, Tz, in counts.
Wrench = tuple[int, int, int, int, int, int]


@dataclass(frozen=True, slots=True)
class Record:
    """One sample: number since the start of the transfer, number of the sensor's own sample, status word, counts."""

    sequence: int
    sample: int
    status: int
    counts: Wrench


def pack_request(request: Request) -> bytes:
    """8 bytes."""
    return _REQUEST.pack(_MAGIC, request.command, request.count)


def unpack_request(data: bytes) -> Request | None:
    """None: these bytes are no request."""
    if len(data) != _REQUEST.size:
        return None
    magic, command, count = _REQUEST.unpack(data)
    return Request(command, count) if magic == _MAGIC else None


def pack_records(records: Iterable[Record]) -> bytes:
    """36 bytes each."""
    return b"".join(_RECORD.pack(record.sequence, record.sample, record.status, *record.counts) for record in records)


def unpack_records(data: bytes) -> list[Record] | None:
    """The records of a datagram; None: it holds no whole number of them, or too many."""
    count, rest = divmod(len(data), RECORD_SIZE)
    if rest or not 0 < count <= MOST_RECORDS:
        return None
    return [Record(sequence, sample, status, (x, y, z, u, v, w))
            for sequence, sample, status, x, y, z, u, v, w in _RECORD.iter_unpack(data)]


def is_out_of_range(status: int) -> bool:
    """Whether the true wrench may be larger than what is told."""
    return bool(status & _OUT_OF_RANGE)


def is_fault(status: int) -> bool:
    """Whether the sample is not to be trusted: anything but a threshold that was passed."""
    return bool(status & ~_THRESHOLD)


def describe_status(status: int) -> str:
    """What a status word says: ``"a gage is broken (0x80000004)"``."""
    said = [meaning for bit, meaning in _MEANINGS.items() if status >> bit & 1]
    return f"{', '.join(said) or 'it reports an error'} (0x{status:08x})"


@dataclass(frozen=True)
class Settings:
    """How a box counts.

    Attributes:
        counts_per_force, counts_per_torque: in the units below.
        force_unit, torque_unit: as the box names them: N, lbf, klbf, kN, kg; N-m, N-mm, lbf-in, lbf-ft, kN-m, kg-cm.
        rate: of the records, Hz; None: not told.
        product, calibration: name of the box, and of the calibration (its serial number).
    """

    counts_per_force: float
    counts_per_torque: float
    force_unit: str = "N"
    torque_unit: str = "N-m"
    rate: float | None = None
    product: str = ""
    calibration: str = ""

    @property
    def newtons(self) -> float:
        """Of a count, N.

        Raises:
            InputError: a unit that is not known.
        """
        return _unit(self.force_unit, "force") / self.counts_per_force

    @property
    def newton_metres(self) -> float:
        """Of a count, N m. Raises as `newtons`."""
        return _unit(self.torque_unit, "torque") / self.counts_per_torque


def _unit(name: str, quantity: str) -> float:
    """SI value of a unit."""
    known = FORCE_UNITS if quantity == "force" else TORQUE_UNITS
    try:
        return known[name.replace("·", "-")]
    except KeyError:
        raise InputError(f"the box counts in {name!r}, which is no known unit of {quantity}; set it to one of "
                         f"{', '.join(_OFFERED[quantity])} on its configurations page", field=f"{quantity}_unit"
                         ) from None


def read_settings_page(page: bytes) -> Settings:
    """Settings of a box from its page ``netftapi2.xml``.

    Raises:
        InputError: no XML, or a field that is missing or no positive number.
    """
    try:
        # Entities are refused: the page comes from whoever has the address.
        if b"<!" in page.split(b"?>", 1)[-1]:
            raise ElementTree.ParseError("declarations")
        root = ElementTree.fromstring(page)
    except (ElementTree.ParseError, ValueError, LookupError):
        raise InputError("the page is no settings page of an ATI box (no XML); check the address", field="settings"
                         ) from None
    texts = {element.tag.rpartition("}")[2].lower(): (element.text or "").strip() for element in root.iter()
             if isinstance(element.tag, str)}

    def positive(name: str) -> float:
        with contextlib.suppress(KeyError, ValueError):
            if 0 < (value := float(texts[name])) < math.inf:
                return value
        raise InputError(f"the settings page has no positive number {name!r} (found {texts.get(name)!r}); check that "
                         "the address is that of an ATI box", field=name)

    return Settings(positive("cfgcpf"), positive("cfgcpt"), texts.get("scfgfu") or "N", texts.get("scfgtu") or "N-m",
                    positive("comrdtrate") if "comrdtrate" in texts else None,
                    texts.get("prodname", ""), texts.get("cfgcalsn") or texts.get("setserial", ""))


def write_settings_page(settings: Settings) -> bytes:
    """The page of a box with these settings, as far as `read_settings_page` reads it."""
    entries = {"prodname": settings.product or "RDT", "runstat": "0x00000000", "cfgcalsn": settings.calibration,
               "scfgfu": settings.force_unit, "scfgtu": settings.torque_unit,
               "cfgcpf": f"{settings.counts_per_force:.10g}", "cfgcpt": f"{settings.counts_per_torque:.10g}",
               **({} if settings.rate is None else {"comrdtrate": f"{settings.rate:.10g}"}),
               "comrdtbsiz": str(MOST_RECORDS)}
    lines = "".join(f"<{name}>{escape(text)}</{name}>\n" for name, text in entries.items())
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<netft>\n{lines}</netft>\n'.encode()
