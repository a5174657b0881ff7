"""The folder of a calibration or a diagnosis: which campaigns it holds, and which of its files were written before."""

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
from tissue_sim.decode import read_json
from tissue_sim.errors import InputError

CLAIM_FILE, FIT_FILE, SUMMARY_FILE = "work.json", "fit.json", "summary.csv"
#: Says that a diagnosis is finished.
DIAGNOSIS_FILE = "diagnosis.json"
#: Folder of the simulations of an inverse fit, beside its results.
SOLVES = "solves"
TABLES = ("report.html", "methods.txt", "curves.csv", "residuals.csv")
TABLES_OF_DIAGNOSIS = ("report.html", "residuals.csv")
#: Formats in which the pictures of a report are written as files beside it.
PICTURE_FORMATS = ("svg", "pdf", "png")
#: Names of the pictures of a campaign, and of those of each law in it.
PICTURES = ("predictions", "regions", "specimens", "convergence")
PICTURES_OF_DIAGNOSIS = ("regions", "candidates")
PICTURES_OF_LAW = ("profiles", "windows", "correlation", "population")
CLAIM_SCHEMA = "tissue_sim/calibration/2"


def result_files(campaign: Campaign, folder: Path) -> list[Path]:
    """Every file that the calibration of a campaign may write."""
    return [*(folder / f"{law}.material.json" for law in campaign.fit.laws), *(folder / name for name in TABLES),
            *(folder / picture_file(name, kind) for name in _pictures(campaign) for kind in PICTURE_FORMATS),
            folder / FIT_FILE]


def diagnosis_files(campaign: Campaign, folder: Path) -> list[Path]:
    """Every file that the diagnosis of a campaign may write."""
    pictures = [*(picture_of_test(campaign, number) for number in range(len(campaign.tests))), *PICTURES_OF_DIAGNOSIS]
    return [*(folder / name for name in TABLES_OF_DIAGNOSIS),
            *(folder / picture_file(name, kind) for name in pictures for kind in PICTURE_FORMATS),
            folder / DIAGNOSIS_FILE]


def claim(output: Path, folders: Mapping[str, Path], campaigns: Sequence[Campaign], recordings: Sequence[MeasuredCurve],
          digests: Mapping[str, str], overwrite: bool,
          files_of: Callable[[Campaign, Path], list[Path]] = result_files) -> None:
    """Make `output` ready for these campaigns; what it holds of these very ones stays.

    Files of an earlier calibration are removed, by the list that it left in ``work.json``; no other file is touched.

    Args:
        output: folder of all results. folders: of each campaign, by its name.
        campaigns, recordings: what is read, which no result may replace.
        digests: of each campaign, by its name.
        overwrite: whether other work in `output` may be replaced.
        files_of: every file that may be written for a campaign, in its folder.

    Raises:
        InputError: `output` is a file, holds other work, or holds a file at the place of a result that no calibration
            wrote; nothing is changed then.
    """
    if output.exists() and not output.is_dir():
        raise InputError("is a file; give a folder for the results", file=output)
    planned = [path for campaign in campaigns for path in files_of(campaign, folders[campaign.name])]
    planned += [output / CLAIM_FILE, *([output / SUMMARY_FILE] if len(campaigns) > 1 else [])]
    for folder in folders.values():
        if (folder / SOLVES).exists() and not (folder / SOLVES).is_dir():
            raise InputError("is in the way: simulations are kept in a folder of that name; move it away",
                             file=folder / SOLVES)
    _protect_inputs(planned, campaigns, recordings)
    found = _read_claim(output)
    if not overwrite and output.exists() and any(output.iterdir()):
        if found.get("campaigns") != digests:
            what = "the results of other work" if found else "other files"
            raise InputError(f"the folder holds {what}; choose an empty one or add --overwrite", file=output)
        return
    earlier = [output / name for name in found.get("files", ())]
    for path in planned:
        if path.exists() and path not in earlier:
            raise InputError("is in the way: no earlier work in this folder wrote it; move it away or choose "
                             "another folder", file=path)
    _clear_solves({path.parent for path in earlier})
    _remove(earlier, output)
    files = [path.relative_to(output).as_posix() for path in planned]
    content = {"schema": CLAIM_SCHEMA, "campaigns": dict(digests), "files": files}
    write_text(output / CLAIM_FILE, json.dumps(content, indent=2) + "\n")


def picture_of_test(campaign: Campaign, number: int, what: str = "test") -> str:
    """Name of the picture of a test, or of its ``segments``, by its place in the campaign."""
    return f"{what} {number + 1} {campaign.tests[number].name}"


def picture_file(name: str, kind: str) -> str:
    """File of a picture beside the report: words, digits and underscores only, whatever a test is called."""
    return f"report_{re.sub(r'[^0-9A-Za-z]+', '_', name).strip('_')}.{kind}"


def pictures_written(campaign: Campaign, folder: Path, kind: str) -> bool:
    """Whether the pictures of a finished campaign are there as files."""
    return all((folder / picture_file(picture_of_test(campaign, number), kind)).is_file()
               for number in range(len(campaign.tests)))


def _pictures(campaign: Campaign) -> list[str]:
    """Every picture that a report may have."""
    return [*(picture_of_test(campaign, number, what) for number in range(len(campaign.tests))
              for what in ("test", "segments")), *PICTURES,
            *(f"{name} {law}" for name in PICTURES_OF_LAW for law in campaign.fit.laws)]


def _protect_inputs(planned: Sequence[Path], campaigns: Sequence[Campaign],
                    recordings: Sequence[MeasuredCurve]) -> None:
    files = {recording.file for recording in recordings}
    inputs = [*(campaign.path for campaign in campaigns), *files, *(path.with_suffix(".json") for path in files)]
    existing = [path for path in inputs if path.exists()]
    for path in planned:
        # By identity: links, and names that a file system does not tell apart, are the same file.
        if path.exists() and any(path.samefile(other) for other in existing):
            raise InputError("is read here and would be replaced by the results; choose another folder",
                             file=path)


def _read_claim(output: Path) -> dict[str, Any]:
    """The ``work.json`` of an earlier calibration; empty where there is none that can be trusted."""
    try:
        found = read_json(output / CLAIM_FILE, "what an earlier calibration left")
        if found["schema"] != CLAIM_SCHEMA:
            return {}
        places = [PurePosixPath(name) for name in found["files"]]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    # Nothing outside the folder is ours, whatever the file says.
    inside = all(not place.is_absolute() and ".." not in place.parts and len(place.parts) <= 2 for place in places)
    return found if inside else {}


def _clear_solves(folders: Iterable[Path]) -> None:
    """Remove the simulations that earlier work kept, so that other work begins with none."""
    for folder in folders:
        for file in (folder / SOLVES).glob("*.msgpack"):
            if re.fullmatch(r"[0-9a-f]{40}", file.stem):
                file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            (folder / SOLVES).rmdir()


def _remove(files: Sequence[Path], output: Path) -> None:
    """Remove these files, and the folders of campaigns that are empty then."""
    for path in files:
        path.unlink(missing_ok=True)
    for folder in {path.parent for path in files} - {output}:
        with contextlib.suppress(OSError):  # it holds something else, or was never made
            folder.rmdir()
