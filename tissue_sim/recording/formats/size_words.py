"""Words for the sizes of a specimen, in English, German, French, Spanish and Italian."""

from __future__ import annotations

import re

from tissue_sim.recording.formats.vocabulary import plain

#: Size -> words for it, in the order in which they are searched.
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
_PATTERNS = {name: re.compile(rf"\b({words})\b") for name, words in SIZE_WORDS.items()}
#: Keys of one letter.
_LETTERS = {"d": "diameter", "r": "radius", "h": "height"}
#: Adjectives of sentences, such as "12 mm high".
_ADJECTIVES = {"high": "height", "tall": "height", "hoch": "height", "thick": "thickness", "dick": "thickness",
               "wide": "width", "breit": "width", "long": "length", "lang": "length"}
#: Words of the machine, of a result or of another time, not of the specimen at the start.
_NOT = re.compile(
    r"\b(probe|tool|punch|plate|plates|platen|platens|stempel|indenter|needle|cell|wave|step|data|path|pre|tip|ball|"
    r"anvil|jaw|camera|crosshead|final|end|after|failure|rupture|break|travel|displacement|surface area|edge|fillet|"
    r"sonde|kugel|wire|cable|nach|après|ende|target|trigger|stroke|indentation|maximum|max|minimum|limit|px)\b")
#: Words for a size in a sentence.
SENTENCE_WORDS = (
    r"diameter|diam\.|radius|circumference|thickness|gauge length|height|width|length|area|durchmesser|umfang|höhe|"
    r"dicke|breite|länge|diamètre|rayon|hauteur|épaisseur|largeur|longueur|Ø|⌀")


def size_class(key: str) -> str | None:
    """The size of a specimen that a key names, such as ``diameter``; None: it names none."""
    # What stands in brackets at the end is the place of the statement.
    words = plain(key.replace("⌀", "ø"))
    if not words or len(words) > 80 or _NOT.search(words):
        return None
    if words in _LETTERS:
        return _LETTERS[words]
    adjective = _ADJECTIVES.get(words.split()[0])
    return next((name for name, pattern in _PATTERNS.items() if pattern.search(words)), adjective)
