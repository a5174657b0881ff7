"""Split input files of Abaqus and CalculiX into keywords with their data lines."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tissue_sim.errors import InputError


class KeywordBlock:
    """Keyword line (``*NAME, OPTION=VALUE``) with its data lines.

    Attributes:
        line: number of the keyword line in the file; of its last line if it is continued.
        name: name in upper case.
        options: options by name in upper case.
        rows: words of the data lines.
        row_lines: number in the file of each data line.
    """

    def __init__(self, line: int, text: str):
        self.line = line
        self.rows: list[list[str]] = []
        self.row_lines: list[int] = []
        name, *options = [part.strip() for part in text[1:].split(",")]
        self.name = " ".join(name.upper().split())
        self.options = {key.strip().upper(): value.strip().strip('"')
                        for key, _, value in (option.partition("=") for option in options if option)}

    def parse_integers(self) -> np.ndarray:
        """Return all data of the keyword as one array of integers.

        Raises:
            InputError: a word is not an integer.
        """
        flat = [word for row in self.rows for word in row if word]
        try:
            return np.array(list(map(int, flat)), dtype=np.int64)
        except (ValueError, OverflowError):
            raise InputError(f"the data of *{self.name} must be integers", line=self.line) from None


def iterate_keyword_blocks(text: str, expected: str) -> Iterator[KeywordBlock]:
    """Yield the keywords of a file with their data lines; comments are skipped.

    Args:
        text: text of the file.
        expected: description of the expected file for the message.

    Raises:
        InputError: the file begins with data, or ends within a keyword line.
    """
    current: KeywordBlock | None = None
    number, waiting = 0, ""
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("**"):
            continue
        if waiting or line.startswith("*"):
            waiting += line
            if line.endswith(","):  # the keyword line continues on the next line
                continue
            if current is not None:
                yield current
            current, waiting = KeywordBlock(number, waiting), ""
        elif current is None:
            raise InputError(f"the file must begin with a keyword such as *NODE; expected {expected}", line=number)
        else:
            current.rows.append([word.strip() for word in line.split(",")])
            current.row_lines.append(number)
    if waiting:
        raise InputError("a keyword line that ends with a comma continues on the next line; got the end of the file",
                         line=number)
    if current is not None:
        yield current


def require_no_include(block: KeywordBlock) -> None:
    """Raise an error if a block is ``*INCLUDE``, because other files are not opened.

    Raises:
        InputError: the block includes another file.
    """
    if block.name == "INCLUDE":
        raise InputError("*INCLUDE is not supported; write the whole content into one file", line=block.line)
