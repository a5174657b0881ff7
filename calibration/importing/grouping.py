"""Group files: replicates of one test, and separate tests."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from calibration.campaign.measured import REPLICATE_TOLERANCE
from calibration.importing.imported import ReplicateFile
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.formats.sizes import make_size_signature

#: The number at the end of a name: ``EF10_A3``, ``Specimen_RawData_1``, ``gel (2)``.
_NUMBER = re.compile(r"[ _.\-]*\(?\d+\)?$")


def group_into_tests(parts: Sequence[ReplicateFile]) -> list[tuple[str, tuple[ReplicateFile, ...], str]]:
    """Group files into tests, and return (name, replicates, reason) of each test.

    The names of replicates differ only in the number at their end. Replicates have equal columns, an equal kind of
    test, equal stated sizes, and equal motions within `REPLICATE_TOLERANCE`. A gripped specimen is pulled up to its
    failure, so that only the speed of its motion is compared.
    """
    alike: dict[tuple, list[list[ReplicateFile]]] = {}
    counted = _find_replicate_stem_by_file(list(dict.fromkeys(part.file for part in parts)))
    for part in parts:
        reading = part.reading
        stem = counted[part.file]
        key = (stem, reading.name, reading.kind.kind, repr(sorted(reading.options.items(), key=str)),
               make_size_signature(reading.stated, reading.kind.kind), repr(sorted(reading.specimen.items())),
               tuple((column.channel, column.header, column.unit) for column in reading.columns))
        clusters = alike.setdefault(key, [])
        cluster = next((each for each in clusters if have_same_speed_and_travel(each[0], part)), None)
        if cluster is None:
            clusters.append([part])
        else:
            cluster.append(part)
    groups: list[tuple[str, tuple[ReplicateFile, ...], str]] = []
    for (stem, name, *_), clusters in alike.items():
        for cluster in clusters:
            one = len(cluster) == 1
            parts_of_name = [cluster[0].file.stem if one else stem, name]
            title = _make_unique_test_name("_".join(filter(None, parts_of_name)), [each for each, *_ in groups])
            groups.append((title, tuple(cluster), _describe_replicates(cluster, len(clusters))))
    return groups


def _find_replicate_stem_by_file(files: Sequence[Path]) -> dict[Path, str]:
    """Return file -> name that replicates have in common: the name of the file without the number at its end.

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


def have_same_speed_and_travel(first: ReplicateFile, second: ReplicateFile) -> bool:
    """Return whether speed and largest displacement of two files agree within `REPLICATE_TOLERANCE`, relative.

    The displacements of a gripped specimen are not compared, because the specimen is pulled up to its failure.
    """
    kind = KINDS[first.reading.kind.kind] if first.reading.kind.kind else None
    pairs = []
    a, b = first.motions[0], second.motions[0]
    if a.speed and b.speed:
        pairs.append((a.speed, b.speed))
    if kind is None or not kind.has_gripped_ends:
        pairs.append((max(map(abs, a.reach)), max(map(abs, b.reach))))
    return all(max(pair) <= (1 + REPLICATE_TOLERANCE) * min(pair) for pair in pairs)


def _describe_replicates(cluster: Sequence[ReplicateFile], clusters: int) -> str:
    """Return one sentence that explains why the files of a cluster form one test.

    Args:
        cluster: files with equal motions.
        clusters: number of clusters with the same name.
    """
    replicates = sum(len(part.motions) for part in cluster)
    apart = "; files of the same name that move otherwise are tests of their own" if clusters > 1 else ""
    if len(cluster) > 1:
        return (f"replicates: {len(cluster)} files whose names differ in their number only, alike in columns and "
                f"motion{apart}")
    if replicates > 1:
        return f"replicates: {replicates} tables of one file with the same columns{apart}"
    return f"one recording{apart}"


def _make_unique_test_name(name: str, taken: Sequence[str]) -> str:
    """Return the name of a test; a number is appended if another test already has this name."""
    number = 2
    found = name
    while found in taken:
        found, number = f"{name}_{number}", number + 1
    return found
