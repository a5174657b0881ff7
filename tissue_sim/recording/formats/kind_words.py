"""Find words for tests in titles, headers and names: registered kinds, and tests of `UNKNOWN_TESTS`.

`UNKNOWN_TESTS` is a table of tests without a registered kind, and of the words that name these tests in files. The
words are regular expressions for lower-case text without accents and with single blanks (see
`normalize_and_truncate_line`). A plug-in that registers a kind with a name or a title word of this table also receives
the words of the table.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS


@dataclass(frozen=True)
class KnownTestWithoutKind:
    """A test for which no kind is registered.

    Attributes:
        name: name of a kind for this test.
        title: name in sentences.
        words: regular expressions in English, German and French.
        difference: difference from the registered kinds; completes the sentence "<title> is ...".
        short: abbreviations that are recognised only in the name of a file.
        alone: words that are recognised only as the complete text, such as the name of a sheet, with or without a
            number, or in an entry for the test method that names no other test.
    """

    name: str
    title: str
    words: tuple[str, ...]
    difference: str
    short: tuple[str, ...] = ()
    alone: tuple[str, ...] = ()


#: Difference of tests with a deformation that varies in the specimen.
_NOT_HOMOGENEOUS = "not homogeneous: a modulus from total force and displacement would be wrong"

#: The table; each row completes the sentence "<title> is <difference>".
UNKNOWN_TESTS: tuple[KnownTestWithoutKind, ...] = (
    KnownTestWithoutKind("plane_strain_compression", "plane strain compression", (
        r"plane strain( compress\w*)?", r"channel die", r"eben\w* (dehnung\w*|stauch\w*|verzerrung\w*)",
        r"deformation plane"),
        "not uniaxial: the specimen widens in one direction only"),
    KnownTestWithoutKind("volumetric_compression", "volumetric compression", (
        r"volumetric (compress\w*|test\w*|loading|data)", r"hydrostat\w*( (compress\w*|druck\w*|test\w*))?",
        r"isostat\w*",
        r"volumetrisch\w* (druck\w*|kompress\w*|versuch\w*)", r"compress\w* (volum\w*|isostat\w*|hydrostat\w*)",
        r"kompressionsmodul"),
        "not compression between plates: the test measures the bulk modulus and not the shear modulus"),
    KnownTestWithoutKind("triaxial_compression", "triaxial compression",
                         (r"tri ?axial\w*", r"dreiachs\w*", r"triax"),
                         "not uniaxial: a pressure acts on the sides of the specimen"),
    KnownTestWithoutKind("bending", "bending", (
        r"bending( tests?)?", r"bend tests?", r"flexur\w*", r"flexion", r"\w*bieg(e|ung|ever)\w*",
        r"cantilever (bending|beam|tests?)",
        r"(three|four|3|4|drei|vier|trois|quatre) ?(pts?|points?|punkte?)( ?(bend|\w*bieg|flex|load|test)\w*)?",
        r"[34] ?pb"),
        "neither tension nor compression: one side is stretched and the other compressed"),
    KnownTestWithoutKind("peel", "a peel test", (
        r"(t )?peel(ing)? (tests?|force|load|strength|angle|resistance|\d+)", r"peeling",
        r"(\d+|degrees?|deg|grad|t|drum|roller|arm|wheel) peel",
        r"(ab)?schae?l(versuch|prufung|pruefung|test|kraft|festigkeit|widerstand)\w*",
        r"(de)?pelage"),
        "not tension: the force measures the adhesion at a moving front", alone=("peel",)),
    KnownTestWithoutKind("fatigue", "a fatigue test", (
        r"fatigue( tests?)?", r"ermudung\w*", r"ermuedung\w*", r"dauerschwing\w*", r"dauerfestigkeit\w*",
        r"w(o|oe)hler\w*",
        r"\w*schwellversuch\w*", r"endurance tests?"),
        "not a single loading: the material changes from cycle to cycle"),
    KnownTestWithoutKind("burst", "a burst test",
                         (r"burst(ing)? (tests?|pressure|strength)", r"berst\w*", r"eclatement"),
                         "neither tension nor compression: a pressure loads the specimen in two directions",
                         alone=("burst",)),
    KnownTestWithoutKind("inflation", "an inflation test", (
        r"inflat\w*", r"bulge( tests?)?", r"bubble (inflation|tests?)", r"aufbla(e|h)?s?\w*", r"gonfle?\w*"),
        "neither tension nor compression: a pressure loads the specimen in two directions"),
    KnownTestWithoutKind("lap_shear", "a lap shear test", (
        r"((single|double) )?lap ?(shear|joint)\w*", r"zugscher\w*", r"u(e)?berlapp\w*",
        r"(simple |double )?recouvrement"),
        "simple shear only if the specimen fills the overlap: then state --kind simple_shear"),
    KnownTestWithoutKind("tear", "a tear test", (
        r"(trouser|crescent|angle|graves) tear\w*", r"tear (tests?|strength|resistance|propagation|energy)",
        r"tearing( tests?)?", r"weiterrei(ss|sz)\w*", r"dechir\w*"),
        "not tension: the force measures the growth of a crack"),
    KnownTestWithoutKind("fracture", "a fracture test", (
        r"fracture (tests?|toughness|mechanics|energy)", r"compact tension",
        r"(single|double) edge (notch\w*|crack\w*)",
        r"notch\w* (tension|tensile|specimens?)", r"crack (growth|propagation)\w*", r"bruch(mechan|zah|zaeh)\w*",
        r"gekerbt\w*", r"kerb(zug|versuch|schlag|biege)\w*", r"entaill\w*"),
        "not tension of an intact specimen: a notch or crack determines the force"),
    KnownTestWithoutKind("ring_tension", "ring tension", (
        r"ring (tension|tensile|pull|tests?)", r"hoop (tension|tensile|tests?)", r"ringzug\w*",
        r"traction (sur |d )?anneau\w*"),
        "not uniaxial tension: pins bend the ring before they stretch it"),
    KnownTestWithoutKind("diametral_compression", "diametral compression", (
        r"diametr\w* (compress\w*|druck\w*)", r"compress\w* diametr\w*", r"brazilian\w*", r"indirect tens\w*",
        r"split(ting)? tens\w*", r"spaltzug\w*", r"scheiteldruck\w*"),
        "neither uniaxial compression nor tension: the disc is loaded along a line"),
    KnownTestWithoutKind("impact", "an impact test", (
        r"impact (tests?|strength|loading|compress\w*|tension|tensile)",
        r"drop (weight|tower|tests?)\w*", r"charpy", r"izod", r"(split )?hopkinson\w*", r"shpb",
        r"kolsky",
        r"schlag(zah|zaeh|versuch|pruf|pruef|biege)\w*", r"fallgewicht\w*", r"essai de choc"),
        "not a slow test: inertia is part of the force"),
    KnownTestWithoutKind("pull_out", "a pull-out test", (
        r"pull ?out\w*", r"suture (retention|pull\w*)", r"auszieh\w*", r"ausrei(ss|sz)\w*", r"arrachement"),
        "not tension of a specimen: the force measures the strength of an anchor"),
    KnownTestWithoutKind("tack", "a tack test",
                         (r"probe tack( tests?)?", r"tack tests?", r"adhesion tests?", r"debond\w*",
                          r"hafttest\w*", r"haft(zug|festigkeits?)\w*"),
                         "not tension: the force measures the adhesion of two faces", alone=("tack",)),
    KnownTestWithoutKind("aspiration", "an aspiration test", (
        r"aspirat\w*", r"suction (tests?|force)", r"cutometer", r"saug(versuch|napf|test)\w*", r"ventouse"),
                         "neither tension nor compression: suction draws the tissue into an opening"),
    KnownTestWithoutKind("buckling", "a buckling test",
                         (r"buckl\w*", r"knick(versuch|last|ung)\w*", r"flamb(age|ement)"),
                         "not compression: the specimen bends sideways"),
    KnownTestWithoutKind("cutting", "a cutting test", (
        r"cutting (tests?|force)", r"schneid(versuch|test|kraft)\w*", r"warner bratzler( shear)?", r"kramer( shear)?",
        r"decoupe"),
        f"a separation of the material, {_NOT_HOMOGENEOUS}", alone=("cutting", "cut")),
    KnownTestWithoutKind("extrusion", "an extrusion test",
                         (r"(back|forward) ?extrusion( tests?)?", r"extrusion (tests?|force)",
                          r"ruckextrusion\w*"),
                         "not compression: the material flows through a gap", alone=("extrusion",)),
    KnownTestWithoutKind("surface_tension", "surface tension", (
        r"(surface|interfacial) tension", r"(ober|grenz)flac?h?e?n?spannung", r"tension (superficielle|interfaciale)"),
        "not tension of a specimen"),
    KnownTestWithoutKind("scratch", "a scratch or friction test",
                         (r"scratch( tests?)?", r"tribo\w*", r"friction tests?",
                          r"reib(versuch|test|pruf|pruef)\w*"),
                         "not a loading of a specimen: the force measures friction"),
)


#: Number of characters of a line that are searched.
_LONGEST_LINE = 2000
#: Entries above a table whose value is the name of a person, a company, a program or a machine.
_NAME_ENTRIES = re.compile(
    r"^\W*(operator|tester|user|author|customer|company|client|laboratory|lab|prufer|bearbeiter|kunde|"
    r"firma|operateur|utilisateur|software|program|file|path|datei|machine|device|instrument|"
    r"load frame|load cell|maschine|gerat|appareil)\b")
#: Entries above a table whose value is the name of the test.
_TEST_ENTRIES = re.compile(
    r"^(?:(?:test|prufung|versuchs?|essai) (?:method|type|kind|mode|name|procedure|standard)|"
    r"method|procedure|prufverfahren|prufart|versuchsart|methode|(?:type|nom) d essai)\b(?P<value>.*)$")


@dataclass(frozen=True)
class KindHint:
    """A text that is searched for words for a test.

    Attributes:
        text: one or several lines.
        where: location for messages, such as ``above the numbers``.
        is_file_name: whether the text is the name of a file, in which abbreviations are recognised.
    """

    text: str
    where: str
    is_file_name: bool = False


@dataclass(frozen=True)
class NamedTest:
    """A test that a text names.

    Attributes:
        word: word in the text, without accents.
        where: location of the text; see `KindHint`.
        kind: name in `KINDS`; None: the test has no registered kind.
        unknown: test without a registered kind; None: the test has a kind.
        is_short: whether the word is an abbreviation.
    """

    word: str
    where: str
    kind: str | None = None
    unknown: KnownTestWithoutKind | None = None
    is_short: bool = False

    @property
    def kind_or_unregistered_title(self) -> str:
        """Name of the test: a kind in `KINDS`, or the title of the unknown test."""
        return self.kind or (self.unknown.title if self.unknown else "")

    @property
    def is_named_by_several_words(self) -> bool:
        """Whether the text names the test by several words, as ``uniaxial tension``; one may only name a direction."""
        return " " in self.word

    def make_refusal_error(self) -> InputError:
        """Return the error for a test without a registered kind.

        Raises:
            ValueError: the test has a kind.
        """
        if self.unknown is None:
            raise ValueError(f"only a test without a registered kind is refused; {self.kind!r} is registered")
        remedy = "--kind overrules the word" if self.unknown.name in KINDS else \
            "there is no such kind of test. --kind overrules the word"
        return InputError(f"{self.unknown.title} ({self.word!r} {self.where}) is {self.unknown.difference}; {remedy}",
                          field="kind")


def normalize_and_truncate_line(text: str) -> str:
    """Return a text in lower case without accents, with one blank between words and numbers.

    ``PureShear_3pt`` gives ``pure shear 3 pt``. The text is cut at `_LONGEST_LINE` characters.
    """
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text[:_LONGEST_LINE])
    decomposed = unicodedata.normalize("NFKD", text.casefold())
    letters = "".join(each for each in decomposed if not unicodedata.combining(each))
    words = re.sub(r"[\W_]+", " ", letters)
    return re.sub(r"(?<=\d)(?=[a-z])|(?<=[a-z])(?=\d)", " ", words).strip()


def find_named_tests(hints: Iterable[KindHint]) -> tuple[NamedTest, ...]:
    """Return the tests that texts name, in order; of overlapping words the longest, and registered kinds first."""
    return tuple(named for hint in hints for line in hint.text.splitlines()
                 if not _NAME_ENTRIES.match(normalize_and_truncate_line(line))
                 for named in _iterate_tests_in_line(line, hint))


def _iterate_tests_in_line(line: str, hint: KindHint) -> Iterator[NamedTest]:
    """Yield a `NamedTest` for each test that a line of a text names, in the order of the words.

    Tests without a registered kind are included. Abbreviations count in file names only.
    """
    text = normalize_and_truncate_line(line)
    matches: list[tuple[int, int, bool, NamedTest]] = []
    for pattern, kind, unknown, is_short in _compile_patterns_of_kinds_and_unregistered_tests(_list_words_of_kinds()):
        if is_short and not hint.is_file_name:
            continue
        for match in pattern.finditer(text):
            matches.append((*match.span(), unknown is not None,
                            NamedTest(match[0], hint.where, kind, unknown, is_short)))
    entry = None if matches else _TEST_ENTRIES.match(text)
    if entry is not None:
        kinds = _list_words_of_kinds()
        sole: list[tuple[str, str | None, KnownTestWithoutKind | None]] = [
            (word, each.name, None) for each in kinds for word in each.sole]
        sole += [(word, None, unknown) for unknown in _list_unregistered_tests(kinds) for word in unknown.alone]
        yield from (NamedTest(found[0], hint.where, kind, unknown) for word, kind, unknown in sole
                    if (found := re.search(rf"\b{word}\b", entry["value"])))
    # Longest match first; of equal lengths, a registered kind first. A match that overlaps a longer one is ignored.
    matches.sort(key=lambda each: (each[0] - each[1], each[2]))
    kept: list[tuple[int, int, bool, NamedTest]] = []
    for each in matches:
        if not any(each[0] < other[1] and other[0] < each[1] for other in kept):
            kept.append(each)
    yield from (named for *_, named in sorted(kept, key=lambda each: each[0]))


class _KindWords(NamedTuple):
    """Words that name a registered kind; see `TestKind`."""

    name: str
    title: str
    words: tuple[str, ...]
    short: tuple[str, ...]
    sole: tuple[str, ...]


def _list_words_of_kinds() -> tuple[_KindWords, ...]:
    """Return the words of all registered kinds, the hashable key of the compiled patterns."""
    return tuple(_KindWords(name, kind.title, kind.title_words, kind.file_words, kind.sole_words)
                 for name, kind in KINDS.items())


def _list_unregistered_tests(kinds: tuple[_KindWords, ...]) -> tuple[KnownTestWithoutKind, ...]:
    """Return the tests of `UNKNOWN_TESTS` under whose name no kind is registered."""
    names = {each.name for each in kinds}
    return tuple(test for test in UNKNOWN_TESTS if test.name not in names)


@lru_cache(maxsize=8)
def _compile_patterns_of_kinds_and_unregistered_tests(kinds: tuple[_KindWords, ...]
                                                      ) -> tuple[tuple[re.Pattern[str], str | None,
                                                                       KnownTestWithoutKind | None, bool], ...]:
    """Return (pattern, kind, test without a kind, whether the word is an abbreviation) of all words."""
    words: list[tuple[str, str | None, KnownTestWithoutKind | None, bool]] = []
    for each in kinds:
        words += [(rf"\b(?:{word})\b", each.name, None, False)
                  for word in (*each.words, normalize_and_truncate_line(each.name),
                               normalize_and_truncate_line(each.title))]
        words += [(rf"\b(?:{word})\b", each.name, None, True) for word in each.short]
        words += [(rf"^(?:{word})(?: \d+)*$", each.name, None, False) for word in each.sole]
    without_kind = _list_unregistered_tests(kinds)
    for test in UNKNOWN_TESTS:
        # A registered kind with this name receives the words.
        kind, unknown = (None, test) if test in without_kind else (test.name, None)
        words += [(rf"\b(?:{word})\b", kind, unknown, False) for word in test.words]
        words += [(rf"\b(?:{word})\b", kind, unknown, True) for word in test.short]
        words += [(rf"^(?:{word})(?: \d+)*$", kind, unknown, False) for word in test.alone]
    return tuple((re.compile(pattern), kind, unknown, short) for pattern, kind, unknown, short in words)
