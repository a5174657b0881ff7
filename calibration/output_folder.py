"""Manage the folder of a calibration or diagnosis: its campaigns, and the files written by earlier runs."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve
from tissue_sim.atomic_write import write_text
from tissue_sim.decode import read_json_value
from tissue_sim.errors import InputError

#: File that lists the campaigns of a folder and the files written for them.
CLAIM_FILE = "work.json"
#: Result file of a calibration, written last.
FIT_FILE = "fit.json"
#: Table of all laws of several campaigns.
SUMMARY_FILE = "summary.csv"
#: Result file of a diagnosis, written last.
DIAGNOSIS_FILE = "diagnosis.json"
#: Folder of the stored simulations of an inverse fit.
SOLVES = "solves"
#: Report and tables of a calibration.
TABLES = ("report.html", "methods.txt", "curves.csv", "residuals.csv")
#: Report and tables of a diagnosis.
TABLES_OF_DIAGNOSIS = ("report.html", "residuals.csv")
#: Formats of separate figure files.
PICTURE_FORMATS = ("svg", "pdf", "png")
#: Names of the figures of a calibration.
PICTURES = ("predictions", "regions", "specimens", "convergence")
#: Names of the figures of a diagnosis.
PICTURES_OF_DIAGNOSIS = ("regions", "candidates")
#: Names of the figures of each law.
PICTURES_OF_LAW = ("profiles", "windows", "correlation", "population")
#: Schema of `CLAIM_FILE`.
CLAIM_SCHEMA = "tissue_sim/calibration/2"


def list_possible_calibration_file_paths(campaign: Campaign, folder: Path) -> list[Path]:
    """Return the paths of all files that the calibration of a campaign may write."""
    return [*(folder / f"{law}.material.json" for law in campaign.fit.laws), *(folder / name for name in TABLES),
            *(folder / make_figure_file_name(name, kind) for name in _list_possible_figure_names(campaign)
              for kind in PICTURE_FORMATS),
            folder / FIT_FILE]


def list_possible_diagnosis_result_paths(campaign: Campaign, folder: Path) -> list[Path]:
    """Return the paths of report, tables, figures and result file of the diagnosis of a campaign."""
    pictures = [*(make_numbered_test_figure_name(campaign, number) for number in range(len(campaign.tests))),
                *PICTURES_OF_DIAGNOSIS]
    return [*(folder / name for name in TABLES_OF_DIAGNOSIS),
            *(folder / make_figure_file_name(name, kind) for name in pictures for kind in PICTURE_FORMATS),
            folder / DIAGNOSIS_FILE]


def remove_earlier_results_and_claim_folder(
        output: Path, folders: Mapping[str, Path], campaigns: Sequence[Campaign], recordings: Sequence[MeasuredCurve],
        digests: Mapping[str, str], overwrite: bool,
        files_of: Callable[[Campaign, Path], list[Path]] = list_possible_calibration_file_paths) -> None:
    """Prepare the output folder for these campaigns: check it, remove earlier results, and write ``work.json``.

    Results of the same campaigns stay. Files of an earlier calibration are removed if ``work.json`` lists them; other
    files are not changed.

    Args:
        output: folder of all results.
        folders: folder of each campaign by its name.
        campaigns: the campaigns, whose files must not be overwritten.
        recordings: the recordings, whose files must not be overwritten.
        digests: digest of each campaign by its name.
        overwrite: whether results of other campaigns in `output` may be replaced.
        files_of: returns the paths of all files that may be written for a campaign in its folder.

    Raises:
        InputError: `output` is a file, contains other results, or contains a file of another origin with the name of a
            result; nothing is changed.
    """
    if output.exists() and not output.is_dir():
        raise InputError("the output must be a folder, but this is a file; choose another path", file=output)
    planned = [path for campaign in campaigns for path in files_of(campaign, folders[campaign.name])]
    planned += [output / CLAIM_FILE, *([output / SUMMARY_FILE] if len(campaigns) > 1 else [])]
    for folder in folders.values():
        if (folder / SOLVES).exists() and not (folder / SOLVES).is_dir():
            raise InputError("the path of the folder for simulations must not be a file; move or rename this file",
                             file=folder / SOLVES)
    _require_inputs_not_replaced(planned, campaigns, recordings)
    found = _read_valid_claim_or_empty(output)
    if not overwrite and output.exists() and any(output.iterdir()):
        if found.get("campaigns") != digests:
            content = "results of other campaigns" if found else "other files"
            raise InputError(f"the output folder must be empty or contain results of the same campaigns; it contains "
                             f"{content}. Choose an empty folder or add --overwrite", file=output)
        return
    earlier = [output / name for name in found.get("files", ())]
    for path in planned:
        if path.exists() and path not in earlier:
            raise InputError("a result would replace this file, which was not written by an earlier run in this "
                             "folder; move the file or choose another folder", file=path)
    _remove_stored_simulations({path.parent for path in earlier})
    _remove_files_and_empty_folders(earlier, output)
    files = [path.relative_to(output).as_posix() for path in planned]
    claimed = {"schema": CLAIM_SCHEMA, "campaigns": dict(digests), "files": files}
    write_text(output / CLAIM_FILE, json.dumps(claimed, indent=2) + "\n")


def make_numbered_test_figure_name(campaign: Campaign, number: int, what: str = "test") -> str:
    """Return the name of the figure of a test, such as ``test 1 NAME``; `number` is the index of the test from 0."""
    return f"{what} {number + 1} {campaign.tests[number].name}"


def make_figure_file_name(name: str, kind: str) -> str:
    """Return the file name of a figure; all characters except letters and digits become underscores."""
    return f"report_{re.sub(r'[^0-9A-Za-z]+', '_', name).strip('_')}.{kind}"


def has_figure_files_of_all_tests(campaign: Campaign, folder: Path, kind: str) -> bool:
    """Return whether the figure files of all tests of a finished campaign exist in this format."""
    return all((folder / make_figure_file_name(make_numbered_test_figure_name(campaign, number), kind)).is_file()
               for number in range(len(campaign.tests)))


def _list_possible_figure_names(campaign: Campaign) -> list[str]:
    """Return the names of all figures that the report of a campaign may have."""
    return [*(make_numbered_test_figure_name(campaign, number, what) for number in range(len(campaign.tests))
              for what in ("test", "segments")), *PICTURES,
            *(f"{name} {law}" for name in PICTURES_OF_LAW for law in campaign.fit.laws)]


def _require_inputs_not_replaced(planned: Sequence[Path], campaigns: Sequence[Campaign],
                                 recordings: Sequence[MeasuredCurve]) -> None:
    """Raise an `InputError` if a planned file would replace a campaign or recording."""
    files = {recording.file for recording in recordings}
    inputs = [*(campaign.path for campaign in campaigns), *files, *(path.with_suffix(".json") for path in files)]
    existing = [path for path in inputs if path.exists()]
    for path in planned:
        # `samefile` also detects links and names that differ in case only on some file systems.
        if path.exists() and any(path.samefile(other) for other in existing):
            raise InputError("a result would replace this input file; choose another folder", file=path)


def _read_valid_claim_or_empty(output: Path) -> dict[str, Any]:
    """Return the content of ``work.json`` of an earlier run; an empty dictionary if the file is missing or invalid."""
    try:
        found = read_json_value(output / CLAIM_FILE, "the list of files of an earlier run")
        if found["schema"] != CLAIM_SCHEMA:
            return {}
        paths = [PurePosixPath(name) for name in found["files"]]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    # A list with paths outside the folder is invalid: its files must not be removed.
    inside = all(not path.is_absolute() and ".." not in path.parts and len(path.parts) <= 2 for path in paths)
    return found if inside else {}


def _remove_stored_simulations(folders: Iterable[Path]) -> None:
    """Remove the stored simulations of earlier campaigns from these folders."""
    for folder in folders:
        for file in (folder / SOLVES).glob("*.msgpack"):
            if re.fullmatch(r"[0-9a-f]{40}", file.stem):
                file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            (folder / SOLVES).rmdir()


def _remove_files_and_empty_folders(files: Sequence[Path], output: Path) -> None:
    """Remove these files, then their folders that have become empty, except `output`."""
    for path in files:
        path.unlink(missing_ok=True)
    for folder in {path.parent for path in files} - {output}:
        with contextlib.suppress(OSError):  # the folder is not empty or does not exist
            folder.rmdir()
