"""Find words for tests in titles, headers and names: registered kinds, and tests of `UNKNOWN_TESTS`."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.formats.unknown_tests import UNKNOWN_TESTS, KnownTestWithoutKind

#: Kind -> abbreviations that are recognised only in the name of a file.
_SHORT = {"simple_shear": ("ss",), "uniaxial_tension": ("ut",), "lubricated_compression": ("uc",)}
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
        return InputError(f"{self.unknown.title} ({self.word!r} {self.where}) is {self.unknown.difference}; there is "
                          "no such kind of test. --kind overrules the word", field="kind")


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
    for pattern, kind, unknown, is_short in _compile_patterns_of_kinds_and_unregistered_tests(
        _list_names_titles_words_of_kinds()):
        if is_short and not hint.is_file_name:
            continue
        for match in pattern.finditer(text):
            matches.append((*match.span(), unknown is not None,
                            NamedTest(match[0], hint.where, kind, unknown, is_short)))
    entry = None if matches else _TEST_ENTRIES.match(text)
    if entry is not None:
        yield from (NamedTest(found[0], hint.where, unknown=unknown)
                    for unknown in _list_unregistered_tests(_list_names_titles_words_of_kinds())
                    for word in unknown.alone if (found := re.search(rf"\b{word}\b", entry["value"])))
    # Longest match first; of equal lengths, a registered kind first. A match that overlaps a longer one is ignored.
    matches.sort(key=lambda each: (each[0] - each[1], each[2]))
    kept: list[tuple[int, int, bool, NamedTest]] = []
    for each in matches:
        if not any(each[0] < other[1] and other[0] < each[1] for other in kept):
            kept.append(each)
    yield from (named for *_, named in sorted(kept, key=lambda each: each[0]))


def _list_names_titles_words_of_kinds() -> tuple[tuple[str, str, tuple[str, ...]], ...]:
    """Return (name, title, title words) of all registered kinds.

    They are the hashable key of `_compile_patterns_of_kinds_and_unregistered_tests`.
    """
    return tuple((name, kind.title, kind.title_words) for name, kind in KINDS.items())


def _list_unregistered_tests(
        kinds: tuple[tuple[str, str, tuple[str, ...]], ...]) -> tuple[KnownTestWithoutKind, ...]:
    """Return the tests of `UNKNOWN_TESTS` under whose name no kind is registered."""
    names = {name for name, *_ in kinds}
    return tuple(test for test in UNKNOWN_TESTS if test.name not in names)


@lru_cache(maxsize=8)
def _compile_patterns_of_kinds_and_unregistered_tests(kinds: tuple[tuple[str, str, tuple[str, ...]], ...]
                                                      ) -> tuple[tuple[re.Pattern[str], str | None,
                                                                       KnownTestWithoutKind | None, bool], ...]:
    """Return (pattern, kind, test without a kind, whether the word is an abbreviation) of all words."""
    words: list[tuple[str, str | None, KnownTestWithoutKind | None, bool]] = []
    for name, title, own in kinds:
        words += [(rf"\b(?:{word})\b", name, None, False)
                  for word in (*own, normalize_and_truncate_line(name), normalize_and_truncate_line(title))]
        words += [(rf"\b(?:{word})\b", name, None, True) for word in _SHORT.get(name, ())]
    without_kind = _list_unregistered_tests(kinds)
    for test in UNKNOWN_TESTS:
        # A registered kind with this name receives the words.
        kind, unknown = (None, test) if test in without_kind else (test.name, None)
        words += [(rf"\b(?:{word})\b", kind, unknown, False) for word in test.words]
        words += [(rf"\b(?:{word})\b", kind, unknown, True) for word in test.short]
        words += [(rf"^(?:{word})(?: \d+)*$", kind, unknown, False) for word in test.alone]
    return tuple((re.compile(pattern), kind, unknown, short) for pattern, kind, unknown, short in words)
