"""Words in the headers of test machines, properties of single machines, and words for sizes of a specimen.

Sources: the vendors' manuals and the exports that people publish programs for: Bluehill raw data (``Time``,
``Extension``, ``Load`` with ``(s)``, ``(mm)``, ``(N)`` below; load and extension are negative in compression), MTS 793
(``MTS793|MPT|ENU|1|2|.|/|:|...``, ``Running Time``, ``Axial Displacement``, ``Axial Force``), testXpert (``Prüfzeit``,
``Standardkraft``, ``Standardweg``, a row of units), Mach-1 (``<DATA>``, ``Time, s``, ``Position (z), mm``, ``Fz, gf``),
Exponent (``Force (g)``, ``Distance (mm)``, ``Time (sec)``), TRIOS (``[step]``, a row of units), Emperor and VectorPro.

Sizes are recognised in English, German, French, Spanish and Italian.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from tissue_sim.recording.measures import MEASURES, find_measure_name_in_header_or_none
from tissue_sim.units import find_quantity_of_unit_or_none

#: Words of columns that are not fitted: derived or commanded quantities, amplitudes, other directions.
_OTHER = re.compile(
    r"\b(amplitude|oscillation|amplitudes|std|stdev|stddev|deviation|sd|error|rate|speed|velocity|geschwindigkeit|energy|work|"
    r"power|arbeit|modulus|modul|setpoint|command|target|demand|soll|index|points?|number|nr|no|frame|"
    r"cycles?|"
    r"zyklus|width|breite|area|querschnitt|phase|storage|loss|viscosity|position [xy]|f[xy]|transverse|"
    r"quer|axial counts)\b")
#: Role -> patterns in the order of preference; the column of a role with the earliest pattern is read.
_WORDS: dict[str, tuple[str, ...]] = {
    "time": (r"test time|running time|prüfzeit|elapsed time|total time",
             r"time|zeit|temps|tiempo|tempo|tijd|timestamp|t|sec|seconds", r"step time|segment time"),
    "stretch": (r"stretch|stretch ratio|lambda|λ|streckung",),
    "shear strain": (r"shear strain|shr strain|gamma|γ|scherung|schiebung|scherdehnung|^shear$",),
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
    "angle": (r"angle of twist|twist angle|twist|verdrehwinkel|torsionswinkel|drehwinkel",
              r"angle|rotation|rotation angle|angular displacement|angular position|winkel"),
    "torque": (r"torque|torsional moment|drehmoment|torsionsmoment|couple", r"moment"),
    "temperature": (r"temperature|temp|temperatur|température",),
}
_PATTERNS = {role: tuple(re.compile(rf"\b({words})\b") for words in patterns) for role, patterns in _WORDS.items()}
#: (Role by the words, quantity of the unit) -> role of the column.
_BY_UNIT = {
    ("displacement", "ratio"): "strain", ("strain", "length"): "displacement", ("stretch", "length"): "displacement",
    ("force", "stress"): "stress", ("stress", "force"): "force"}
#: Role -> quantity of its unit.
_QUANTITY = {"time": "time", "displacement": "length", "force": "force", "stress": "stress", "strain": "ratio",
             "stretch": "ratio", "shear strain": "ratio", "angle": "angle", "torque": "torque",
             "temperature": "temperature"}
#: Quantity of the unit -> role of a column without a known word.
_NAMELESS = {"time": "time", "length": "displacement", "force": "force", "stress": "stress", "angle": "angle",
             "torque": "torque", "temperature": "temperature"}
#: Source of a column -> its words: measured on the specimen, or by the machine. The extension of the specimen is
#: preferred, because it does not include the compliance of the machine and the grips.
_SOURCES = {"specimen": re.compile(r"\b(extensomet\w*|extensomètre|video\w*|vidéo|dic|optical|optisch\w*|optique|laser|"
                                   r"feindehn\w*|clip gauge|clip gage)\b"),
            "machine": re.compile(r"\b(crosshead|traverse|traversenweg|actuator|ram|grips?|machine|maschine|motor|"
                                  r"stage)\b")}
#: Words of a corrected column.
_CORRECTED = re.compile(r"\b(corrected|korrigiert\w*|corrigée?|tared|tarred|zeroed|net|compensated|kompensiert\w*)\b")


@dataclass(frozen=True)
class ColumnRankSettings:
    """Ranks of columns of the same role; the column with the lowest rank is read.

    Attributes:
        by_machine: addition to the rank of a column that the machine measures, including its own compliance.
        other_measure: addition to the rank of a column of a measure other than the nominal one.
    """

    by_machine: int = 1
    other_measure: int = 4


#: Settings that the functions of this module use.
_SETTINGS = ColumnRankSettings()
#: Words of measures that a time, a force or a temperature cannot have.
_TRUE = re.compile(r"\b(true|cauchy|wahre[rn]?|vraie?s?)\b")
_SHEAR = re.compile(r"\b(shear|shr|scher\w*|schub\w*|cisaillement)\b")


@dataclass(frozen=True)
class MachineFormat:
    """A machine and the program that writes its files.

    Attributes:
        name: name of the format.
        title: name in sentences.
        marks: pattern of words above the numbers of its files.
        roles: header (lower case, without unit) -> role, if the general words give another role.
        units: role -> unit, for a file without units.
        compresses_negative: whether load and displacement of a compression are negative in its files.
    """

    name: str
    title: str
    marks: str
    roles: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    compresses_negative: bool = False


MACHINES: dict[str, MachineFormat] = {machine.name: machine for machine in (
    MachineFormat("mts", "MTS 793, TestSuite, TestWorks", r"MTS793|MTS\b|TestSuite|TestWorks|Data Acquisition\b",
                  roles={"axial count": "other", "axial strain": "strain"}, compresses_negative=True),
    MachineFormat("bluehill", "Instron Bluehill", r"Bluehill|INSTRON|Results Table|Specimen_RawData",
                  compresses_negative=True),
    MachineFormat("zwick", "ZwickRoell testXpert", r"testXpert|Zwick|Standardkraft|Standardweg|Standard force|Prüfzeit",
                  roles={"standardweg": "displacement", "dehnung": "strain"}),
    MachineFormat("exponent", "Stable Micro Systems Exponent",
                  r"Texture ?Expert|Exponent|Stable Micro|TA\.?XT|TA\.HD|Test ID",
                  units={"force": "g", "displacement": "mm", "time": "s"}),
    MachineFormat("mach1", "Biomomentum Mach-1", r"Mach-1|<DATA>|Position \(z\), mm", compresses_negative=True),
    MachineFormat("mecmesin", "Mecmesin Emperor, VectorPro", r"Mecmesin|Emperor|VectorPro",
                  units={"force": "N", "displacement": "mm", "time": "s"}),
    MachineFormat("trios", "TA Instruments TRIOS", r"TRIOS|TA Instruments|^\[step\]",
                  roles={"gap": "displacement", "axial force": "force", "stress": "stress", "strain": "shear strain"}),
)}


def identify_machine(text: str) -> MachineFormat | None:
    """Return the machine whose marks are in the text above the numbers or in the headers; None: unknown machine."""
    return next((machine for machine in MACHINES.values() if re.search(machine.marks, text, re.MULTILINE)), None)


def normalize_header_text(name: str) -> str:
    """Return a header in lower case with single blanks between the words."""
    return " ".join(re.sub(r"[^\w%]+|_", " ", name.casefold()).split())


def find_role_and_rank_or_none(name: str, unit: str | None,
                               machine: MachineFormat | None = None) -> tuple[str, int] | None:
    """Return the role of a column, and its rank among columns of this role; the column with the lowest rank is read.

    The rank is 0 for the preferred name, -1 for a column that is measured on the specimen or corrected, 4 and more for
    a measure of stress or strain other than the nominal one, and 9 if the unit alone determines the role.

    Args:
        name: header without unit.
        unit: unit of the column; None: not stated.
        machine: machine that wrote the file; None: unknown.

    Returns:
        A role: ``time``, ``displacement``, ``force``, ``stretch``, ``strain``, ``shear strain``, ``stress``, ``angle``,
        ``torque`` or ``temperature``. None: none of them.
    """
    words, quantity = normalize_header_text(name), find_quantity_of_unit_or_none(unit)
    role = machine.roles.get(words) if machine else None
    rank = 0
    if role is None:
        if _OTHER.search(words):
            return None
        hits = [(rank, -_compute_longest_match_length(pattern, words), role) for role, patterns in _PATTERNS.items()
                for rank, pattern in enumerate(patterns) if pattern.search(words)]
        # The longest words are the most specific: "shear strain" is no strain, "strain (extension)" no extension.
        hits.sort(key=lambda hit: (hit[1], hit[0]))
        if hits and quantity not in (None, "signal"):
            fitting = [hit for hit in hits if _get_role_fitting_unit_or_empty(hit[2], quantity)]
            hits = fitting[:1]
        rank, _, role = hits[0] if hits else (9, 0, _NAMELESS.get(quantity or "", ""))
    if quantity not in (None, "signal"):
        role = _get_role_fitting_unit_or_empty(role, quantity)
    if role == "strain" and _SHEAR.search(words):
        role = "shear strain"
    if role not in _QUANTITY:
        return None
    if role in ("stress", "strain", "shear strain", "stretch"):
        rank += _SETTINGS.other_measure * (find_measure_name_in_header_or_none(words, role) in MEASURES)
    elif _TRUE.search(words):
        return None
    source = classify_column_source_or_empty(words)
    if source in ("specimen", "corrected"):
        rank = min(rank - 1, -1) if rank < _SETTINGS.other_measure else rank - 1
    return role, rank + _SETTINGS.by_machine * (source == "machine")


def classify_column_source_or_empty(words: str) -> str:
    """Return the source of a column by its header in lower case: ``specimen``, ``machine``, ``corrected`` or empty."""
    if _CORRECTED.search(words):
        return "corrected"
    return next((name for name, pattern in _SOURCES.items() if pattern.search(words)), "")


def _get_role_fitting_unit_or_empty(role: str, quantity: str | None) -> str:
    """Return the role of a column with a unit of this quantity; empty without a role."""
    role = _BY_UNIT.get((role, quantity or ""), role)
    return role if _QUANTITY.get(role) == quantity else ""


def _compute_longest_match_length(pattern: re.Pattern[str], words: str) -> int:
    """Return the length of the longest match, characters; 0 without a match."""
    return max((len(match[0]) for match in pattern.finditer(words)), default=0)


#: Size -> pattern of its words; the first matching size is used.
SIZE_WORDS: dict[str, str] = {
    "circumference": r"circumference|perimeter|\w*umfang|circonférence|perímetro|circonferenza",
    "radius": r"radius|\w*radius|rayon|raggio|radio|halbmesser|r0",
    "diameter": r"diameter|diam|dia|\w*durchmesser|diamètre|diametre|diámetro|diametro|ø|d0",
    "area": r"area|cross section|cross sectional area|\w*querschnitt|\w*querschnittsfläche|section|aire|s0",
    "width": r"width|breadth|\w*breite|largeur|ancho|larghezza|b0",
    "thickness": r"thickness|\w*dicke|épaisseur|epaisseur|espesor|spessore|a0",
    "gauge length": r"gauge length|gage length|grip separation|grip distance|\w*einspannlänge|\w*messlänge|l0",
    "height": r"height|\w*höhe|\w*hoehe|hauteur|altura|altezza|h0",
    "length": r"length|\w*länge|longueur|longitud|lunghezza",
    "gap": r"gap",
    "depth": r"depth|tiefe|profondeur",
}
#: Size -> compiled pattern of its words.
_SIZE_PATTERNS = {name: re.compile(rf"\b({words})\b") for name, words in SIZE_WORDS.items()}
#: Key of one letter -> size.
_ONE_LETTER_KEYS = {"d": "diameter", "r": "radius", "h": "height"}
#: Adjective in a sentence, such as "12 mm high" -> size.
_ADJECTIVES = {"high": "height", "tall": "height", "hoch": "height", "thick": "thickness", "dick": "thickness",
               "wide": "width", "breit": "width", "long": "length", "lang": "length"}
#: Words for a size of a tool or machine, for a result, or for a size after the test.
_OTHER_OBJECTS = re.compile(
    r"\b(probe|tool|punch|plate|plates|platen|platens|stempel|indenter|needle|cell|wave|step|data|path|pre|tip|ball|"
    r"anvil|jaw|camera|crosshead|final|end|after|failure|rupture|break|travel|displacement|surface area|edge|fillet|"
    r"sonde|kugel|wire|cable|nach|après|ende|target|trigger|stroke|indentation|maximum|max|minimum|limit|px)\b")
#: Pattern of words for a size in a sentence.
SENTENCE_WORDS = (
    r"diameter|diam\.|radius|circumference|thickness|gauge length|height|width|length|area|durchmesser|umfang|höhe|"
    r"dicke|breite|länge|diamètre|rayon|hauteur|épaisseur|largeur|longueur|Ø|⌀")


def classify_size_name(key: str) -> str | None:
    """Return the size of a specimen that a key names, such as ``diameter``; None: the key names no size."""
    words = normalize_header_text(key.replace("⌀", "ø"))
    if not words or len(words) > 80 or _OTHER_OBJECTS.search(words):
        return None
    if words in _ONE_LETTER_KEYS:
        return _ONE_LETTER_KEYS[words]
    adjective = _ADJECTIVES.get(words.split()[0])
    return next((name for name, pattern in _SIZE_PATTERNS.items() if pattern.search(words)), adjective)
