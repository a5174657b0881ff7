"""Manage the output folder of jobs: its campaigns, and the files written by earlier runs."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from calibration.campaign.campaign import Campaign
from tissue_sim.decode import read_json_value
from tissue_sim.errors import InputError
from tissue_sim.files import write_text
from tissue_sim.version import __version__

#: File that lists the campaigns of a folder and the files written for them.
CLAIM_FILE = "work.json"
#: Result file of a calibration, written last.
FIT_FILE = "fit.json"
#: Table of all laws of several campaigns.
SUMMARY_FILE = "summary.csv"
#: Result file of a diagnosis, written last.
DIAGNOSIS_FILE = "diagnosis.json"
#: Result file of a design, written last.
DESIGN_FILE = "design.json"
#: Folder of the stored simulations of an inverse fit.
SOLVES = "solves"
#: Report and tables of a calibration.
TABLES = ("report.html", "methods.txt", "curves.csv", "residuals.csv")
#: Report and tables of a diagnosis.
TABLES_OF_DIAGNOSIS = ("report.html", "residuals.csv")
#: Report of a design.
TABLES_OF_DESIGN = ("report.html",)
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
    return [*(folder / name for name in TABLES_OF_DIAGNOSIS), *_list_test_figure_paths(campaign, folder),
            *(folder / make_figure_file_name(name, kind) for name in PICTURES_OF_DIAGNOSIS for kind in PICTURE_FORMATS),
            folder / DIAGNOSIS_FILE]


def list_possible_design_result_paths(campaign: Campaign, folder: Path) -> list[Path]:
    """Return the paths of report, figures and result file of the design of a campaign."""
    return [*(folder / name for name in TABLES_OF_DESIGN), *_list_test_figure_paths(campaign, folder),
            folder / DESIGN_FILE]


def check_output_folder(output: Path, digests: Mapping[str, str], folders: Sequence[Path], files: Sequence[Path],
                        inputs: Sequence[Path], overwrite: bool) -> None:
    """Check that jobs may write to the output folder; nothing is written.

    Args:
        output: folder of all results.
        digests: name of the campaign -> digest of its job.
        folders: folder of each job.
        files: all files that the jobs may write, except stored simulations.
        inputs: files of the user, which must not be replaced.
        overwrite: whether results of other campaigns in `output` may be replaced.

    Raises:
        InputError: `output` is a file, contains other results, or contains a file of another origin with the name of a
            result.
    """
    if output.exists() and not output.is_dir():
        raise InputError("the output must be a folder, but this is a file; choose another path", file=output)
    planned = _list_planned_files(output, folders, files)
    for folder in folders:
        if (folder / SOLVES).exists() and not (folder / SOLVES).is_dir():
            raise InputError("the path of the folder for simulations must not be a file; move or rename this file",
                             file=folder / SOLVES)
    _require_inputs_not_replaced(planned, inputs)
    found = _read_valid_claim_or_empty(output)
    if not overwrite and _has_results(output, folders, planned):
        if found.get("campaigns") != digests:
            content = _describe_other_results(output, found) if found else "other files"
            raise InputError(f"the output folder must be empty or contain results of the same campaigns; it contains "
                             f"{content}. Choose an empty folder or add --overwrite", file=output)
        return
    earlier = [output / name for name in found.get("files", ())]
    for path in planned:
        if path.exists() and path not in earlier:
            raise InputError("a result would replace this file, which was not written by an earlier run in this "
                             "folder; move the file or choose another folder", file=path)


def remove_earlier_results_and_claim_folder(
        output: Path, digests: Mapping[str, str], folders: Sequence[Path], files: Sequence[Path],
        inputs: Sequence[Path], overwrite: bool) -> None:
    """Prepare the output folder for jobs: check it, remove earlier results, and write ``work.json``.

    Results of the same jobs stay. Files of an earlier run are removed if ``work.json`` lists them; other files are not
    changed. For the arguments see `check_output_folder`.

    Raises:
        InputError: see `check_output_folder`; nothing is changed.
    """
    check_output_folder(output, digests, folders, files, inputs, overwrite)
    planned = _list_planned_files(output, folders, files)
    unfinished = _list_unfinished_temporary_files(folders, planned)
    if not overwrite and _has_results(output, folders, planned):
        _remove_files_and_empty_folders(unfinished, output)
        return
    earlier = [output / name for name in _read_valid_claim_or_empty(output).get("files", ())]
    _remove_stored_simulations({path.parent for path in earlier})
    _remove_files_and_empty_folders([*unfinished, *earlier], output)
    claimed = {"schema": CLAIM_SCHEMA, "campaigns": dict(digests),
               "files": [path.relative_to(output).as_posix() for path in planned]}
    write_text(output / CLAIM_FILE, json.dumps(claimed, indent=2) + "\n")


def _list_planned_files(output: Path, folders: Sequence[Path], files: Sequence[Path]) -> list[Path]:
    """Return the paths of all files that jobs may write, with the claim and the table of several campaigns."""
    return [*files, output / CLAIM_FILE, *([output / SUMMARY_FILE] if len(folders) > 1 else [])]


def _has_results(output: Path, folders: Sequence[Path], planned: Sequence[Path]) -> bool:
    """Return whether the output folder contains anything else than temporary files of an unfinished run."""
    return output.exists() and bool({*output.iterdir()} - {*_list_unfinished_temporary_files(folders, planned)})


def make_numbered_test_figure_name(campaign: Campaign, number: int, what: str = "test") -> str:
    """Return the name of the figure of a test, such as ``test 1 NAME``; `number` is the index of the test from 0."""
    return f"{what} {number + 1} {campaign.tests[number].name}"


def make_figure_file_name(name: str, kind: str) -> str:
    """Return the file name of a figure; all characters except letters and digits become underscores."""
    return f"report_{re.sub(r'[^0-9A-Za-z]+', '_', name).strip('_')}.{kind}"


def list_test_figure_file_names(campaign: Campaign, kind: str | None, *, held_out: bool = True) -> list[str]:
    """Return the file names of the figures of the tests in a format; none without a format.

    Args:
        campaign: the campaign.
        kind: format of the files; None: no files.
        held_out: whether tests that are held out of the fits have figures, as in a calibration.
    """
    return [] if kind is None else [make_figure_file_name(make_numbered_test_figure_name(campaign, number), kind)
                                    for number, test in enumerate(campaign.tests) if held_out or not test.hold_out]


def _list_test_figure_paths(campaign: Campaign, folder: Path) -> list[Path]:
    """Return the paths of the figures of all tests in all formats."""
    return [folder / name for kind in PICTURE_FORMATS for name in list_test_figure_file_names(campaign, kind)]


def _list_possible_figure_names(campaign: Campaign) -> list[str]:
    """Return the names of all figures that the report of a campaign may have."""
    return [*(make_numbered_test_figure_name(campaign, number, what) for number in range(len(campaign.tests))
              for what in ("test", "segments")), *PICTURES,
            *(f"{name} {law}" for name in PICTURES_OF_LAW for law in campaign.fit.laws)]


def _describe_other_results(output: Path, claim: Mapping[str, Any]) -> str:
    """Describe the results that a folder contains, for a message: other campaigns, or another version of the program.

    Material files state the version that wrote them; `CLAIM_FILE` states none.
    """
    for name in claim["files"]:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            if name.endswith(".material.json"):
                version = read_json_value(output / name, "a material file")["provenance"]["version"]
                if version != __version__:
                    return f"results of tissue_sim {version}, and this is version {__version__}"
    return "results of other campaigns"


def _require_inputs_not_replaced(planned: Sequence[Path], inputs: Sequence[Path]) -> None:
    """Raise an `InputError` if a planned file would replace an input."""
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


def _list_unfinished_temporary_files(folders: Sequence[Path], planned: Sequence[Path]) -> list[Path]:
    """Return the temporary files of results and simulations whose writing was ended by `kill` or a power failure."""
    names = {re.escape(path.name) for path in planned} | {r"[0-9a-f]{40}\.msgpack"}
    return [file for folder in {*(path.parent for path in planned), *(folder / SOLVES for folder in folders)}
            for file in folder.glob(".*.tmp")
            if re.fullmatch(rf"\.({'|'.join(names)})\.[0-9a-f]{{8}}\.tmp", file.name)]


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
