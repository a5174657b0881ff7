"""Recognise words for the sizes of a specimen in English, German, French, Spanish and Italian."""

from __future__ import annotations

import re

from tissue_sim.recording.formats.vocabulary import normalize_header_text

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
_PATTERNS = {name: re.compile(rf"\b({words})\b") for name, words in SIZE_WORDS.items()}
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
    return next((name for name, pattern in _PATTERNS.items() if pattern.search(words)), adjective)
