"""Words in the headers of test machines, and properties of single machines.

Sources: the vendors' manuals and the exports that people publish programs for: Bluehill raw data (``Time``,
``Extension``, ``Load`` with ``(s)``, ``(mm)``, ``(N)`` below; load and extension are negative in compression), MTS 793
(``MTS793|MPT|ENU|1|2|.|/|:|...``, ``Running Time``, ``Axial Displacement``, ``Axial Force``), testXpert (``Prüfzeit``,
``Standardkraft``, ``Standardweg``, a row of units), Mach-1 (``<DATA>``, ``Time, s``, ``Position (z), mm``, ``Fz, gf``),
Exponent (``Force (g)``, ``Distance (mm)``, ``Time (sec)``), TRIOS (``[step]``, a row of units), Emperor and VectorPro.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from tissue_sim.recording.measures import MEASURES, measure_of
from tissue_sim.units import quantity_of

#: Columns that are derived, commanded, amplitudes or of another direction: nothing that is fitted.
_OTHER = re.compile(
    r"\b(amplitude|oscillation|amplitudes|std|stdev|stddev|deviation|sd|error|rate|speed|velocity|geschwindigkeit|energy|work|"
    r"power|arbeit|modulus|modul|setpoint|command|target|demand|soll|torque|moment|index|points?|number|nr|no|frame|"
    r"cycles?|"
    r"zyklus|width|breite|area|querschnitt|angle|storage|loss|viscosity|position [xy]|f[xy]|transverse|"
    r"quer|axial counts)\b")
#: Role -> patterns, the surest first. Of two columns of a role the one with the earlier pattern is taken.
_WORDS: dict[str, tuple[str, ...]] = {
    "time": (r"test time|running time|prüfzeit|elapsed time|total time",
             r"time|zeit|temps|tiempo|tempo|tijd|timestamp|t|sec|seconds", r"step time|segment time"),
    "stretch": (r"stretch|stretch ratio|lambda|λ|streckung",),
    "shear strain": (r"shear strain|shr strain|gamma|γ|scherung|schiebung|scherdehnung",),
    "strain": (r"engineering strain|nominal strain|compressive strain|tensile strain|technische dehnung",
               r"strain|dehnung|umformgrad|stauchung|nominal deformation|déformation|deformación|eps|epsilon|ε"),
    "stress": (r"engineering stress|nominal stress|first piola|pk1",
               r"stress|spannung|contrainte|tensión|sigma|σ|tau|τ"),
    "displacement": (
        r"extensometer|extensometer extension|video extension|video displacement|feindehnungsaufnehmer|extensomètre|"
        r"compressive extension|compressive displacement|compression|standardweg|standard travel|indentation|"
        r"indentation depth|eindringtiefe|eindringung|depth|position z|tensile extension|tensile displacement",
        r"displacement|displ|disp|extension|distance|weg|prüfweg|travel|deformation|verformung|elongation|déplacement|"
        r"allongement|desplazamiento|spostamento|verschiebung|way|stroke|deflection|gap|längenänderung|strecke",
        r"crosshead|traverse|traversenweg|actuator|position|height|piezo|ram|lvdt|z"),
    "force": (r"compressive load|compressive force|standardkraft|standard force|axial force|axial load|normal force|fz|"
              r"tensile load|tensile force",
              r"force|load|kraft|prüfkraft|last|charge|carga|fuerza|forza|kracht|effort|f|p|fn",
              r"load cell|kraftsensor|weight|mass|masse"),
    "temperature": (r"temperature|temp|temperatur|température",),
}
_PATTERNS = {role: tuple(re.compile(rf"\b({words})\b") for words in patterns) for role, patterns in _WORDS.items()}
#: What a role is where the unit is of that quantity.
_BY_UNIT = {
    ("displacement", "ratio"): "strain", ("strain", "length"): "displacement", ("stretch", "length"): "displacement",
    ("force", "stress"): "stress", ("stress", "force"): "force"}
_QUANTITY = {"time": "time", "displacement": "length", "force": "force", "stress": "stress", "strain": "ratio",
             "stretch": "ratio", "shear strain": "ratio", "temperature": "temperature"}
#: Quantity -> role of a column whose name says nothing.
_NAMELESS = {"time": "time", "length": "displacement", "force": "force", "stress": "stress",
             "temperature": "temperature"}
#: Words of a column that is measured on the specimen, by the machine away from it, and after a correction. The surest
#: first: the specimen's own extension does not contain that of the machine and the grips.
_SOURCES = {"specimen": re.compile(r"\b(extensomet\w*|extensomètre|video\w*|vidéo|dic|optical|optisch\w*|optique|laser|"
                                   r"feindehn\w*|clip gauge|clip gage)\b"),
            "machine": re.compile(r"\b(crosshead|traverse|traversenweg|actuator|ram|grips?|machine|maschine|motor|"
                                  r"stage)\b")}
_CORRECTED = re.compile(r"\b(corrected|korrigiert\w*|corrigée?|tared|tarred|zeroed|net|compensated|kompensiert\w*)\b")


@dataclass(frozen=True)
class RankSettings:
    """Ranks of columns of the same role; the column with the lowest rank is read.

    Attributes:
        by_machine: addition to the rank of a column that the machine measures, including its own compliance.
        other_measure: addition to the rank of a column of a measure other than the nominal one.
    """

    by_machine: int = 1
    other_measure: int = 4


#: Settings that the functions of this module use.
_SETTINGS = RankSettings()
#: Words of measures that make no sense of a time, a force or a temperature.
_TRUE = re.compile(r"\b(true|cauchy|wahre[rn]?|vraie?s?)\b")
_SHEAR = re.compile(r"\b(shear|shr|scher\w*|schub\w*|cisaillement)\b")


@dataclass(frozen=True)
class Machine:
    """A machine and the program that writes its files.

    Attributes:
        name: of the format. title: for people.
        marks: what its files hold above the numbers, a pattern.
        roles: header, in lower case without unit -> role, where the general words would say another.
        units: role -> unit, where a file states none.
        compresses_negative: whether load and displacement of a compression are negative in it.
    """

    name: str
    title: str
    marks: str
    roles: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    compresses_negative: bool = False


MACHINES: dict[str, Machine] = {machine.name: machine for machine in (
    Machine("mts", "MTS 793, TestSuite, TestWorks", r"MTS793|MTS\b|TestSuite|TestWorks|Data Acquisition\b",
            roles={"axial count": "other", "axial strain": "strain"}, compresses_negative=True),
    Machine("bluehill", "Instron Bluehill", r"Bluehill|INSTRON|Results Table|Specimen_RawData",
            compresses_negative=True),
    Machine("zwick", "ZwickRoell testXpert", r"testXpert|Zwick|Standardkraft|Standardweg|Standard force|Prüfzeit",
            roles={"standardweg": "displacement", "dehnung": "strain"}),
    Machine("exponent", "Stable Micro Systems Exponent",
            r"Texture ?Expert|Exponent|Stable Micro|TA\.?XT|TA\.HD|Test ID",
            units={"force": "g", "displacement": "mm", "time": "s"}),
    Machine("mach1", "Biomomentum Mach-1", r"Mach-1|<DATA>|Position \(z\), mm", compresses_negative=True),
    Machine("mecmesin", "Mecmesin Emperor, VectorPro", r"Mecmesin|Emperor|VectorPro",
            units={"force": "N", "displacement": "mm", "time": "s"}),
    Machine("trios", "TA Instruments TRIOS", r"TRIOS|TA Instruments|^\[step\]",
            roles={"gap": "displacement", "axial force": "force", "stress": "stress", "strain": "shear strain"}),
)}


def find_machine(text: str) -> Machine | None:
    """The machine whose marks are in a text, that above the numbers and the names of the columns; None: none known."""
    return next((machine for machine in MACHINES.values() if re.search(machine.marks, text, re.MULTILINE)), None)


def plain(name: str) -> str:
    """A header in lower case, its words apart by single blanks."""
    return " ".join(re.sub(r"[^\w%]+|_", " ", name.casefold()).split())


def role_of(name: str, unit: str | None, machine: Machine | None = None) -> tuple[str, int] | None:
    """Role of a column, and its rank among columns of this role: the lowest is taken.

    The rank is 0 for the surest name, -1 where it is measured on the specimen or corrected, 4 and more for a measure of
    stress or strain that is not the nominal one, 9 where the unit alone says the role.

    Args:
        name: header without unit. unit: of it, None: not stated. machine: of the file.

    Returns:
        A role: ``time``, ``displacement``, ``force``, ``stretch``, ``strain``, ``shear strain``, ``stress`` or
        ``temperature``. None: none of them.
    """
    words, quantity = plain(name), quantity_of(unit)
    role = machine.roles.get(words) if machine else None
    rank = 0
    if role is None:
        if _OTHER.search(words):
            return None
        hits = [(rank, -_longest(pattern, words), role) for role, patterns in _PATTERNS.items()
                for rank, pattern in enumerate(patterns) if pattern.search(words)]
        # The longest words say most: "shear strain" is no strain, "strain (extension)" no extension.
        hits.sort(key=lambda hit: (hit[1], hit[0]))
        if hits and quantity not in (None, "signal"):
            fitting = [hit for hit in hits if _with_unit(hit[2], quantity)]
            hits = fitting[:1]
        rank, _, role = hits[0] if hits else (9, 0, _NAMELESS.get(quantity or "", ""))
    if quantity not in (None, "signal"):
        role = _with_unit(role, quantity)
    if role == "strain" and _SHEAR.search(words):
        role = "shear strain"
    if role not in _QUANTITY:
        return None
    if role in ("stress", "strain", "shear strain", "stretch"):
        rank += _SETTINGS.other_measure * (measure_of(words, role) in MEASURES)
    elif _TRUE.search(words):
        return None
    source = source_of(words)
    if source in ("specimen", "corrected"):
        rank = min(rank - 1, -1) if rank < _SETTINGS.other_measure else rank - 1
    return role, rank + _SETTINGS.by_machine * (source == "machine")


def source_of(words: str) -> str:
    """Return the source of a column by its header in lower case: ``specimen``, ``machine``, ``corrected`` or empty."""
    if _CORRECTED.search(words):
        return "corrected"
    return next((name for name, pattern in _SOURCES.items() if pattern.search(words)), "")


def _with_unit(role: str, quantity: str | None) -> str:
    """The role of a column with such a unit; empty: none."""
    role = _BY_UNIT.get((role, quantity or ""), role)
    return role if _QUANTITY.get(role) == quantity else ""


def _longest(pattern: re.Pattern[str], words: str) -> int:
    return max((len(match[0]) for match in pattern.finditer(words)), default=0)
