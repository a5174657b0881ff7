"""Errors with a remedy for the user, and errors of worker processes."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tissue_sim.public_names import OldName


class WorkerError(RuntimeError):
    """Worker processes ended without a result: they were killed, ran out of memory, or could not start.

    Attributes:
        tasks: indices of the tasks without a result.
    """

    def __init__(self, message: str, *, tasks: Sequence[int] = ()):
        super().__init__(message)
        self.tasks = tuple(tasks)


@dataclass(frozen=True)
class MessageLimits:
    """Lengths of the parts of a message, characters.

    Attributes:
        message: largest length of a message.
        quotation: largest length of a quotation from the input in a message that is too long.
        reason: largest length of the reason of another library's exception, which may quote a damaged file at length.
        place: length to which a place (file, field) is shortened at most.
    """

    message: int = 300
    quotation: int = 60
    reason: int = 80
    place: int = 50


#: Lengths of all messages.
MESSAGE_LIMITS = MessageLimits()
_LONG = f"{{{MESSAGE_LIMITS.quotation},}}"
_QUOTATION = re.compile(rf"""(?<!\w)(?:'[^']{_LONG}'|"[^"]{_LONG}")(?!\w)""")
#: Exceptions that a malformed file may cause in a reader.
_MALFORMED = (ArithmeticError, LookupError, MemoryError, OSError, RecursionError, TypeError, ValueError)


class InputError(ValueError):
    """Invalid input: one sentence with the place, the condition and the remedy.

    Args:
        problem: the sentence, without the place.
        file: file that the input came from.
        line: line in that file, from 1.
        field: dotted path of the invalid field, such as ``test[0].recordings`` or ``specimen.radius``.
    """

    def __init__(self, problem: str, *, file: str | Path | None = None, line: int | None = None,
                 field: str | None = None):
        self.problem, self.file, self.line, self.field = problem, file, line, field
        place = []
        if file is not None:
            place.append(f"{file}:{line}" if line is not None else str(file))
        elif line is not None:
            place.append(f"line {line}")
        if field is not None:
            place.append(field)
        super().__init__(join_location_and_problem(problem, place))

    def __reduce__(self):
        return _remake_error, (type(self), self.problem, self.file, self.line, self.field)

    located = OldName("with_location")

    def with_location(self, *, file: str | Path | None = None, field: str | None = None, part: str = "") -> InputError:
        """Return a copy of the error with a location that the caller knows.

        Args:
            file: file of the error, unless the error has one.
            field: outer field, which is written before the field of the error.
            part: description of a section of the file, such as ``sheet 2``, which is written before the problem.
        """
        joined = ".".join(place for place in (field, self.field) if place) or None
        problem = f"{part}: {self.problem}" if part else self.problem
        return InputError(problem, file=self.file if self.file is not None else file, line=self.line, field=joined)


def _remake_error(kind, problem, file, line, field):
    """Make an error from its pickled attributes."""
    return kind(problem, file=file, line=line, field=field)


def join_location_and_problem(problem: str, place: Iterable[str] = ()) -> str:
    """Join locations and problem to one printable line of at most `MessageLimits.message` characters.

    A longer sentence is shortened in the middle: first its quotations, then the place, then the whole.

    Examples:
        >>> join_location_and_problem("must be positive; got -1.", ["study.toml", "test[0].radius_mm"])
        'study.toml: test[0].radius_mm: must be positive; got -1.'
    """
    parts = [_escape_unprintable(part) for part in (*place, problem)]
    if len(": ".join(parts)) > MESSAGE_LIMITS.message:
        quoted = _QUOTATION.sub(lambda match: shorten_text_in_middle(match[0], MESSAGE_LIMITS.quotation), parts.pop())
        # The problem contains the remedy and keeps its length; the user knows the place.
        length = max(MESSAGE_LIMITS.place, (MESSAGE_LIMITS.message - len(quoted)) // max(len(parts), 1) - 2)
        parts = [*(shorten_text_in_middle(part, length) for part in parts), quoted]
    return shorten_text_in_middle(": ".join(parts), MESSAGE_LIMITS.message)


def _escape_unprintable(text: str) -> str:
    """Replace line ends by blanks, and control characters and halves of surrogate pairs by escapes."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else " " if each.isspace() else each.encode("unicode_escape").decode()
                   for each in text)


def shorten_text_in_middle(text: str, longest: int) -> str:
    """Return a text of at most `longest` characters; the middle of a longer text is left out.

    A kept part ends at a whole word if it has a blank in its half next to the gap.

    Examples:
        >>> shorten_text_in_middle("the first words, then many others, and the last words", 30)
        'the first ... last words'
        >>> shorten_text_in_middle("one_long_name_without_a_blank", 15)
        'one_l ... blank'
    """
    if len(text) <= longest:
        return text
    front = (longest - 5) // 2
    head, tail = text[:front], text[len(text) - (longest - 5 - front):]
    if text[front] != " " and (end := head.rfind(" ")) >= front // 2:
        head = head[:end]
    if text[-len(tail) - 1] != " " and 0 <= (start := tail.find(" ")) <= len(tail) // 2:
        tail = tail[start:]
    return f"{head.rstrip()} ... {tail.lstrip()}"


def format_foreign_exception_message(error: BaseException) -> str:
    """Return the message of another library's exception in one line, shortened; without a message, its type."""
    return shorten_text_in_middle(_escape_unprintable(" ".join(str(error).split())),
                                  MESSAGE_LIMITS.reason) or type(error).__name__


@contextmanager
def located_and_converted_errors(*, file: str | Path | None = None, field: str | None = None,
                                 part: str = "") -> Iterator[None]:
    """Context manager: add a location to input errors that are raised inside; see `InputError.with_location`.

    With a file, other exceptions that malformed files cause become input errors too.
    """
    try:
        yield
    except InputError as error:
        raise error.with_location(file=file, field=field, part=part) from None
    except _MALFORMED as error:
        if file is None:
            raise
        raise InputError(
            f"cannot be used ({type(error).__name__}: {format_foreign_exception_message(error)}); look for odd names, "
            "numbers and nesting in it", file=file, field=field) from error


class ConvergenceError(RuntimeError):
    """The solver found no equilibrium with its shortest steps.

    Attributes:
        recording: converged part of the test (a `Recording`); None if the first sample did not converge.
        depth: tool displacement of the last converged state, m.
    """

    def __init__(self, message: str, *, recording=None, depth: float = 0.0):
        super().__init__(message)
        self.recording, self.depth = recording, depth


class MissingBackendError(RuntimeError):
    """A required package is not available on this platform."""


def make_hint_with_similar_or_known_words(word: str, known: Iterable[str]) -> str:
    """Return a hint for an unknown word: ``; did you mean 'radius_mm'?``, or the known words if none is similar.

    Examples:
        >>> make_hint_with_similar_or_known_words("radius", ["radius_mm", "height_mm"])
        "; did you mean 'radius_mm'?"
    """
    known = list(known)
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known: {', '.join(known)}"


def require_positive_length(value: float, field: str) -> None:
    """Raise an `InputError` for `field` unless a length, m, is positive and finite."""
    if not 0 < value < float("inf"):
        raise InputError(f"must be a positive length in m; got {value:g}.", field=field)
