"""Words in titles, headers and names that say which test a file holds: a registered kind, or one of `UNKNOWN_TESTS`."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.formats.unknown_tests import UNKNOWN_TESTS, UnknownTest

#: Kind -> abbreviations that count in the name of a file only.
_SHORT = {"simple_shear": ("ss",), "uniaxial_tension": ("ut",), "lubricated_compression": ("uc",)}
#: Number of characters of a line that are searched.
_LONGEST_LINE = 2000
#: Entries above a table whose value is the name of a person, a company, a program or a machine.
_PEOPLE = re.compile(r"^\W*(operator|tester|user|author|customer|company|client|laboratory|lab|prufer|bearbeiter|kunde|"
                     r"firma|operateur|utilisateur|software|program|file|path|datei|machine|device|instrument|"
                     r"load frame|load cell|maschine|gerat|appareil)\b")
#: Entries above a table whose value is the name of the test.
_TEST_ENTRY = re.compile(r"^(?:(?:test|prufung|versuchs?|essai) (?:method|type|kind|mode|name|procedure|standard)|"
                         r"method|procedure|prufverfahren|prufart|versuchsart|methode|(?:type|nom) d essai)\b"
                         r"(?P<value>.*)$")


@dataclass(frozen=True)
class Hint:
    """A text in which the words for a test count.

    Attributes:
        text: may have several lines. where: for messages, such as ``above the numbers``.
        is_file_name: whether abbreviations count, too.
    """

    text: str
    where: str
    is_file_name: bool = False


@dataclass(frozen=True)
class NamedTest:
    """A test that a text names.

    Attributes:
        word: as it stands in the text, without accents. where: see `Hint`.
        kind: name in `KINDS`; None: the test is `unknown`.
        is_short: whether the word is an abbreviation.
    """

    word: str
    where: str
    kind: str | None = None
    unknown: UnknownTest | None = None
    is_short: bool = False

    @property
    def title(self) -> str:
        """Name of the test: a kind in `KINDS`, or the title of the unknown test."""
        return self.kind or (self.unknown.title if self.unknown else "")

    @property
    def is_explicit(self) -> bool:
        """Whether the word has two words or more, as ``uniaxial tension``; one word may name a direction only."""
        return " " in self.word

    def refusal(self) -> InputError:
        """Return the error for a test without a registered kind.

        Raises:
            ValueError: the test has a kind.
        """
        if self.unknown is None:
            raise ValueError(f"{self.kind} is a kind of test")
        return InputError(f"{self.unknown.title} ({self.word!r} {self.where}) is {self.unknown.difference}; there is "
                          "no such kind of test. --kind overrules the word", field="kind")


def plain_text(text: str) -> str:
    """Lower case without accents, words of letters or digits separated by one blank: ``PureShear_3pt`` is
    ``pure shear 3 pt``."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text[:_LONGEST_LINE])
    decomposed = unicodedata.normalize("NFKD", text.casefold())
    letters = "".join(each for each in decomposed if not unicodedata.combining(each))
    words = re.sub(r"[\W_]+", " ", letters)
    return re.sub(r"(?<=\d)(?=[a-z])|(?<=[a-z])(?=\d)", " ", words).strip()


def named_tests(hints: Iterable[Hint]) -> tuple[NamedTest, ...]:
    """Return the tests that texts name, in order; of overlapping words the longest, and registered kinds first."""
    return tuple(named for hint in hints for line in hint.text.splitlines() if not _PEOPLE.match(plain_text(line))
                 for named in _in_line(line, hint))


def _in_line(line: str, hint: Hint) -> Iterator[NamedTest]:
    text = plain_text(line)
    matches: list[tuple[int, int, bool, NamedTest]] = []
    for pattern, kind, unknown, is_short in _patterns(_kinds()):
        if is_short and not hint.is_file_name:
            continue
        for match in pattern.finditer(text):
            matches.append((*match.span(), unknown is not None,
                            NamedTest(match[0], hint.where, kind, unknown, is_short)))
    entry = None if matches else _TEST_ENTRY.match(text)
    if entry is not None:
        yield from (NamedTest(match[0], hint.where, unknown=unknown) for unknown in _unregistered(_kinds())
                    for word in unknown.alone if (match := re.search(rf"\b{word}\b", entry["value"])))
    # The longest first, and of equal ones that of a registered kind; a word inside a longer one is ignored.
    matches.sort(key=lambda each: (each[0] - each[1], each[2]))
    kept: list[tuple[int, int, bool, NamedTest]] = []
    for each in matches:
        if not any(each[0] < other[1] and other[0] < each[1] for other in kept):
            kept.append(each)
    yield from (named for *_, named in sorted(kept, key=lambda each: each[0]))


def _kinds() -> tuple[tuple[str, str, tuple[str, ...]], ...]:
    """(name, title, title words) of all registered kinds; a hashable key of the words."""
    return tuple((name, kind.title, kind.title_words) for name, kind in KINDS.items())


def _unregistered(kinds: tuple[tuple[str, str, tuple[str, ...]], ...]) -> tuple[UnknownTest, ...]:
    """Return the tests of `UNKNOWN_TESTS` under whose name no kind is registered."""
    names = {name for name, *_ in kinds}
    return tuple(test for test in UNKNOWN_TESTS if test.name not in names)


@lru_cache(maxsize=8)
def _patterns(kinds: tuple[tuple[str, str, tuple[str, ...]], ...]
              ) -> tuple[tuple[re.Pattern[str], str | None, UnknownTest | None, bool], ...]:
    """(pattern, kind, unknown test, whether an abbreviation) of all words."""
    words: list[tuple[str, str | None, UnknownTest | None, bool]] = []
    for name, title, own in kinds:
        words += [(rf"\b(?:{word})\b", name, None, False) for word in (*own, plain_text(name), plain_text(title))]
        words += [(rf"\b(?:{word})\b", name, None, True) for word in _SHORT.get(name, ())]
    without_kind = _unregistered(kinds)
    for test in UNKNOWN_TESTS:
        # A kind that is registered under this name takes the words over.
        kind, unknown = (None, test) if test in without_kind else (test.name, None)
        words += [(rf"\b(?:{word})\b", kind, unknown, False) for word in test.words]
        words += [(rf"\b(?:{word})\b", kind, unknown, True) for word in test.short]
        words += [(rf"^(?:{word})(?: \d+)*$", kind, unknown, False) for word in test.alone]
    return tuple((re.compile(pattern), kind, unknown, short) for pattern, kind, unknown, short in words)
