"""Group files: replicates of one test, and separate tests."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from calibration.campaign.measured import REPLICATE_TOLERANCE
from calibration.importing.imported import Part
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.formats.sizes import make_size_signature

#: The number at the end of a name: ``EF10_A3``, ``Specimen_RawData_1``, ``gel (2)``.
_NUMBER = re.compile(r"[ _.\-]*\(?\d+\)?$")


def group_into_tests(parts: Sequence[Part]) -> list[tuple[str, tuple[Part, ...], str]]:
    """Group files into tests, and return (name, replicates, reason) of each test.

    The names of replicates differ only in the number at their end. Replicates have equal columns, an equal kind of
    test, equal stated sizes, and equal motions within `REPLICATE_TOLERANCE`. A gripped specimen is pulled up to its
    failure, so that only the speed of its motion is compared.
    """
    alike: dict[tuple, list[list[Part]]] = {}
    counted = _names_without_numbers(list(dict.fromkeys(part.file for part in parts)))
    for part in parts:
        reading = part.reading
        stem = counted[part.file]
        key = (stem, reading.name, reading.kind.kind, repr(sorted(reading.options.items(), key=str)),
               make_size_signature(reading.stated, reading.kind.kind), repr(sorted(reading.specimen.items())),
               tuple((column.channel, column.header, column.unit) for column in reading.columns))
        clusters = alike.setdefault(key, [])
        cluster = next((each for each in clusters if has_same_motion(each[0], part)), None)
        if cluster is None:
            clusters.append([part])
        else:
            cluster.append(part)
    groups: list[tuple[str, tuple[Part, ...], str]] = []
    for (stem, name, *_), clusters in alike.items():
        for cluster in clusters:
            one = len(cluster) == 1
            parts_of_name = [cluster[0].file.stem if one else stem, name]
            title = _unique_name("_".join(filter(None, parts_of_name)), [each for each, *_ in groups])
            groups.append((title, tuple(cluster), _describe_replicates(cluster, len(clusters))))
    return groups


def _names_without_numbers(files: Sequence[Path]) -> dict[Path, str]:
    """Return file -> name without the number of the replicate.

    Numbers that differ widely, such as in ``gel_10`` and ``gel_50``, are part of the name of the specimen.
    """
    bases: dict[str, list[Path]] = {}
    for file in files:
        bases.setdefault(_NUMBER.sub("", file.stem), []).append(file)
    found: dict[Path, str] = {}
    for base, alike in bases.items():
        numbers = [int(match[1]) for file in alike if (match := re.search(r"(\d+)\)?$", file.stem))]
        close = bool(numbers) and max(numbers) - min(numbers) <= 2 * len(numbers) + 2
        found |= {file: base if base and close else file.stem for file in alike}
    return found


def has_same_motion(first: Part, second: Part) -> bool:
    """Return whether speed and reach of two motions are equal within `REPLICATE_TOLERANCE`."""
    kind = KINDS[first.reading.kind.kind] if first.reading.kind.kind else None
    pairs = []
    a, b = first.motions[0], second.motions[0]
    if a.speed and b.speed:
        pairs.append((a.speed, b.speed))
    if kind is None or not kind.has_gripped_ends:
        pairs.append((max(map(abs, a.reach)), max(map(abs, b.reach))))
    return all(max(pair) <= (1 + REPLICATE_TOLERANCE) * min(pair) for pair in pairs)


def _describe_replicates(cluster: Sequence[Part], clusters: int) -> str:
    """Return the evidence that the parts of a cluster are replicates, in one sentence."""
    replicates = sum(len(part.motions) for part in cluster)
    apart = "; files of the same name that move otherwise are tests of their own" if clusters > 1 else ""
    if len(cluster) > 1:
        return (f"replicates: {len(cluster)} files whose names differ in their number only, alike in columns and "
                f"motion{apart}")
    if replicates > 1:
        return f"replicates: {replicates} tables of one file with the same columns{apart}"
    return f"one recording{apart}"


def _unique_name(name: str, taken: Sequence[str]) -> str:
    """Return the name, with a number if other tests have the name."""
    number = 2
    found = name
    while found in taken:
        found, number = f"{name}_{number}", number + 1
    return found
