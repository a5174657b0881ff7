"""Keyword ``*HYPERFOAM`` of Abaqus and CalculiX: the laws `hyperfoam_1` to `hyperfoam_3`.

The data are mu_1, alpha_1, ..., mu_N, alpha_N, nu_1, ..., nu_N, in the convention of this package.

Source: Abaqus Keywords Reference Guide, ``*HYPERFOAM``; ``rubber.f`` of CalculiX 2.20.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.exports.keyword_materials import parse_data_rows, require_options
from tissue_sim.exports.unit_systems import UnitSystem
from tissue_sim.laws import Law, find_law
from tissue_sim.material.material import Material
from tissue_sim.mesh.formats.keyword_blocks import KeywordBlock

#: Number of terms -> law.
_LAWS = {1: "hyperfoam_1", 2: "hyperfoam_2", 3: "hyperfoam_3"}
#: Number of values on a data line.
_VALUES_PER_LINE = 8


def is_foam(law: Law) -> bool:
    """Whether the keyword states a law."""
    return law.name in _LAWS.values()


def list_foam_lines(material: Material, units: UnitSystem, fewest_terms: int, write: Callable[[float], str]
                    ) -> list[str]:
    """Return the lines of the keyword.

    Args:
        material: material whose law `is_foam`.
        units: unit system of the file.
        fewest_terms: smallest number of terms of the program; a law of fewer terms has its first term divided.
        write: function that returns the text of a number.
    """
    terms = material.values.reshape(-1, 3) / [units.stress, 1.0, 1.0]
    if (added := fewest_terms - len(terms)) > 0:
        terms = np.concatenate([terms[:1] / [1.0 + added, 1.0, 1.0]] * (1 + added) + [terms[1:]])
    numbers = [*terms[:, :2].ravel(), *terms[:, 2]]
    return [f"*HYPERFOAM, N={len(terms)}", *(", ".join(map(write, numbers[i:i + _VALUES_PER_LINE]))
                                             for i in range(0, len(numbers), _VALUES_PER_LINE))]


def read_foam(block: KeywordBlock, units: UnitSystem, fewest_terms: int, options: Sequence[str],
              title: str) -> tuple[Law, dict[str, float]]:
    """Return the law and its parameters, SI, of a keyword.

    Args:
        block: the keyword.
        units: unit system of the file.
        fewest_terms: see `list_foam_lines`; equal terms are combined if it is above 1.
        options: known options besides N.
        title: name of the program.

    Raises:
        InputError: an unknown option, another number of terms, or data that cannot be read.
    """
    require_options(block, {"N", *options})
    stated = block.options.get("N") or "1"
    count = int(stated) if stated in ("1", "2", "3") else 0
    if count < fewest_terms:
        raise InputError(f"the order N of HYPERFOAM must be {fewest_terms} to 3 in {title}; got {stated}. "
                         + ("CalculiX 2.20 computes no stress for N = 1: state the term twice, each with half of mu"
                            if stated == "1" else "Fit the law with fewer terms"), line=block.line)
    sizes = [min(_VALUES_PER_LINE, 3 * count - i) for i in range(0, 3 * count, _VALUES_PER_LINE)]
    numbers = np.array([number for row in parse_data_rows(block, sizes) for number in row])
    terms = np.column_stack([numbers[:2 * count].reshape(-1, 2) * [units.stress, 1.0], numbers[2 * count:]])
    if fewest_terms > 1 and (terms[:, 1:] == terms[0, 1:]).all():
        terms = np.array([[terms[:, 0].sum(), *terms[0, 1:]]])
    law = find_law(_LAWS[len(terms)])
    return law, dict(zip(law.parameters, terms.ravel().tolist(), strict=True))
