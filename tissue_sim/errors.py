"""Errors that a user can act on."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

#: Characters of a sentence; of a piece of somebody's input that it quotes; at least of the file before it.
LONGEST_SENTENCE, _QUOTED, _PLACE = 300, 60, 50
_QUOTATION = re.compile(rf"""(?<!\w)(?:'[^']{{{_QUOTED},}}'|"[^"]{{{_QUOTED},}}")(?!\w)""")


_STRANGE = (ArithmeticError, LookupError, MemoryError, OSError, RecursionError, TypeError, ValueError)


class InputError(ValueError):
    """Bad input: one sentence that says where it is, what was expected and how to mend it.

    Args:
        problem: the sentence, without the place.
        file: file the input came from, if any.
        line: 1-based line in that file.
        field: dotted path of the field at fault, such as ``test[0].recordings`` or ``specimen.radius``.
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
        super().__init__(sentence(problem, place))

    def __reduce__(self):
        return _made_again, (type(self), self.problem, self.file, self.line, self.field)

    def located(self, *, file: str | Path | None = None, field: str | None = None, part: str = "") -> InputError:
        """The same error with the file, an outer field, or a part of the file in words, that only the caller knows."""
        joined = ".".join(place for place in (field, self.field) if place) or None
        problem = f"{part}: {self.problem}" if part else self.problem
        return InputError(problem, file=self.file if self.file is not None else file, line=self.line, field=joined)


def _made_again(kind, problem, file, line, field):
    return kind(problem, file=file, line=line, field=field)


def sentence(problem: str, place: Iterable[str] = ()) -> str:
    """A problem with its place before it: printable, on one line of at most `LONGEST_SENTENCE` characters. Where it is
    longer, what it quotes is shortened in the middle, then the place, then the whole."""
    parts = [_printable(part) for part in (*place, problem)]
    if len(": ".join(parts)) > LONGEST_SENTENCE:
        quoted = _QUOTATION.sub(lambda match: shortened(match[0], _QUOTED), parts.pop())
        # The sentence says what to do; the place is what somebody has just named.
        room = max(_PLACE, (LONGEST_SENTENCE - len(quoted)) // max(len(parts), 1) - 2)
        parts = [*(shortened(part, room) for part in parts), quoted]
    return shortened(": ".join(parts), LONGEST_SENTENCE)


def _printable(text: str) -> str:
    """Line ends as blanks; what moves a terminal's cursor, and halves of surrogate pairs, as escapes."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else " " if each.isspace() else each.encode("unicode_escape").decode()
                   for each in text)


def shortened(text: str, longest: int) -> str:
    """The text, its middle left out where it is longer."""
    if len(text) <= longest:
        return text
    front = (longest - 5) // 2
    return f"{text[:front]} ... {text[len(text) - (longest - 5 - front):]}"


@contextmanager
def located(*, file: str | Path | None = None, field: str | None = None, part: str = "") -> Iterator[None]:
    """Input errors of the work inside are `InputError.located`; where it is that of a file, whatever else a strange one
    makes of the work is an input error too."""
    try:
        yield
    except InputError as error:
        raise error.located(file=file, field=field, part=part) from None
    except _STRANGE as error:
        if file is None:
            raise
        reason = str(error) or "no reason is given"
        raise InputError(f"cannot be used ({type(error).__name__}: {reason}); look for odd names, numbers and nesting "
                         "in it", file=file, field=field) from error


class ConvergenceError(RuntimeError):
    """The solver came to the end of its means.

    Attributes:
        recording: the converged part of the test (a `Recording`), None where not even the first sample converged.
        depth: tool displacement of the last converged state, m.
    """

    def __init__(self, message: str, *, recording=None, depth: float = 0.0):
        super().__init__(message)
        self.recording, self.depth = recording, depth


class MissingBackendError(RuntimeError):
    """A package that this platform lacks is needed for what was asked."""


def nearest(word: str, known: Iterable[str]) -> str:
    """A hint such as ``; did you mean 'radius_mm'?`` or the list of known words when none is near."""
    known = list(known)
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known: {', '.join(known)}"


def require_length(value: float, field: str) -> None:
    """Refuse a length, m, that is not finite and above zero."""
    if not 0 < value < float("inf"):
        raise InputError(f"{value:g} is not positive; give a length in m above zero", field=field)
