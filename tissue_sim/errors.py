"""Errors that a user can act on."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path


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
        super().__init__(": ".join([*place, problem]))

    def located(self, *, file: str | Path | None = None, field: str | None = None, part: str = "") -> InputError:
        """The same error with the file, an outer field, or a part of the file in words, that only the caller knows."""
        joined = ".".join(place for place in (field, self.field) if place) or None
        problem = f"{part}: {self.problem}" if part else self.problem
        return InputError(problem, file=self.file if self.file is not None else file, line=self.line, field=joined)


@contextmanager
def located(*, file: str | Path | None = None, field: str | None = None, part: str = "") -> Iterator[None]:
    """Input errors of the work inside are `InputError.located`."""
    try:
        yield
    except InputError as error:
        raise error.located(file=file, field=field, part=part) from None


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
