"""Materials in input files of Abaqus and CalculiX: split a file into materials, and parse their data lines."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from tissue_sim.errors import InputError
from tissue_sim.mesh.formats.keyword_blocks import KeywordBlock, iterate_keyword_blocks, require_no_include

#: Number of an input file; Fortran's exponent D is allowed.
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][+-]?\d{1,4})?", re.ASCII)
#: Keywords of a model, which end the keywords of a material. Other keywords belong to the material and are refused
#: unless they are known, so that no part of a material is ignored.
_MODEL_KEYWORDS = frozenset((
    "MATERIAL", "HEADING", "PREPRINT", "RESTART", "PARAMETER", "PART", "END PART", "ASSEMBLY", "END ASSEMBLY",
    "INSTANCE", "END INSTANCE", "SYSTEM", "NODE", "NGEN", "NFILL", "NCOPY", "ELEMENT", "ELGEN", "ELCOPY", "NSET",
    "ELSET", "SURFACE", "ORIENTATION", "TRANSFORM", "SOLID SECTION", "SHELL SECTION", "MEMBRANE SECTION",
    "BEAM SECTION", "SECTION CONTROLS", "RIGID BODY", "EQUATION", "MPC", "TIE", "COUPLING", "KINEMATIC",
    "DISTRIBUTING", "MASS", "ROTARY INERTIA", "SPRING", "FLUID CAVITY", "CONNECTOR SECTION", "CONNECTOR BEHAVIOR",
    "EMBEDDED ELEMENT", "FILTER", "SUBMODEL", "AMPLITUDE", "TIME POINTS", "INITIAL CONDITIONS", "PHYSICAL CONSTANTS",
    "BOUNDARY", "SURFACE INTERACTION", "SURFACE BEHAVIOR", "FRICTION", "CONTACT", "CONTACT PAIR", "CONTACT INCLUSIONS",
    "CONTACT PROPERTY ASSIGNMENT", "CONTACT CONTROLS", "CLEARANCE", "STEP", "END STEP", "STATIC", "VISCO", "DYNAMIC",
    "NODE PRINT", "EL PRINT", "NODE FILE", "EL FILE", "OUTPUT", "INCLUDE"))


@dataclass(frozen=True)
class MaterialSection:
    """Keywords of one material.

    Attributes:
        name: name of the material.
        line: line of the keyword ``*MATERIAL``.
        blocks: keywords that follow it.
    """

    name: str
    line: int
    blocks: list[KeywordBlock] = field(default_factory=list)

    def index_blocks_by_name(self, known: Collection[str], title: str) -> dict[str, KeywordBlock]:
        """Return name -> keyword.

        Args:
            known: names of the keywords that can be read.
            title: name of the program, for messages.

        Raises:
            InputError: an unknown keyword, or a repeated one.
        """
        found: dict[str, KeywordBlock] = {}
        for block in self.blocks:
            if block.name not in known:
                raise InputError(f"*{block.name} in material {self.name} cannot be imported from {title}; known: "
                                 f"{', '.join(f'*{name}' for name in known)}. Delete it if it does not change the "
                                 "response", line=block.line)
            if block.name in found:
                raise InputError(f"*{block.name} occurs twice in material {self.name}. Delete one", line=block.line)
            found[block.name] = block
        return found


def split_into_sections(text: str, expected: str) -> dict[str, MaterialSection]:
    """Return name -> section of each material of an input file; all other keywords are skipped.

    Args:
        text: text of the file.
        expected: description of the expected file for messages.

    Raises:
        InputError: no material, a material without a name, two with the same name, or ``*INCLUDE``.
    """
    sections: dict[str, MaterialSection] = {}
    current: MaterialSection | None = None
    for block in iterate_keyword_blocks(text, expected):
        require_no_include(block)
        if block.name == "MATERIAL":
            require_options(block, {"NAME"})
            name = block.options.get("NAME", "")
            if not name:
                raise InputError("*MATERIAL must have a NAME.", line=block.line)
            if name in sections:
                raise InputError(f"material {name} is defined twice. Rename one", line=block.line)
            if block.rows:
                raise InputError("*MATERIAL must be followed by a keyword, not by data.", line=block.row_lines[0])
            current = sections[name] = MaterialSection(name, block.line)
        elif block.name in _MODEL_KEYWORDS:
            current = None
        elif current is not None:
            current.blocks.append(block)
    if not sections:
        raise InputError(f"the file contains no *MATERIAL; expected {expected}")
    return sections


def require_options(block: KeywordBlock, known: Collection[str]) -> None:
    """Raise an error if a keyword has an option that is not known; blanks within names are ignored.

    Raises:
        InputError: an unknown option.
    """
    for name in block.options:
        if name.replace(" ", "") not in known:
            raise InputError(f"the option {name} of *{block.name} cannot be imported. Delete it if it does not change "
                             "the response", line=block.line)


def parse_data_rows(block: KeywordBlock, counts: Sequence[int]) -> list[list[float]]:
    """Return the numbers of the data lines of a keyword; empty and missing fields are 0.

    Args:
        block: keyword.
        counts: number of values of each data line.

    Raises:
        InputError: a word that is no finite number, or another number of lines or values, such as data that depend on
            temperature.
    """
    if len(block.rows) != len(counts) or not counts:
        raise InputError(f"*{block.name} must have {max(len(counts), 1)} data lines; got {len(block.rows)}. Data that "
                         "depend on temperature cannot be imported", line=block.line)
    parsed = []
    for row, line, count in zip(block.rows, block.row_lines, counts, strict=True):
        words = list(row)
        while words and not words[-1]:
            words.pop()
        if len(words) > count:
            raise InputError(f"a data line of *{block.name} must have {count} values; got {len(words)}. Data that "
                             "depend on temperature cannot be imported", line=line)
        parsed.append([_parse_number(word, line) for word in words] + [0.0] * (count - len(words)))
    return parsed


def _parse_number(word: str, line: int) -> float:
    """Return the number of a data field; an empty field is 0."""
    number = float(re.sub("[Dd]", "e", word)) if _NUMBER.fullmatch(word) else 0.0 if not word else math.nan
    if not math.isfinite(number):
        raise InputError(f"must be a finite number; got {word!r}.", line=line)
    return number
