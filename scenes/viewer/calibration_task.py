"""A calibration that was asked for on the page, as the process that computes it does it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

import tissue_sim as ts
from tissue_sim.atomic_write import write_text
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.experiment.tools.tool import tool_sizes
from tissue_sim.files import read_bytes
from tissue_sim.material.file import read_material_file, write_material_file
from tissue_sim.parameters import parameters, to_keys
from tissue_sim.rig.file import write_rig

if TYPE_CHECKING:
    from calibration.fit.fit import Fit, Iteration

#: What is told of the fit, in its folder; and the folder of the recordings in that.
PROGRESS_FILE, RECORDINGS = "progress.json", "recordings"


@dataclass(frozen=True)
class Wanted:
    """What is to be fitted.

    Attributes:
        kind: of test, a name. experiment, rig: how it was done; the motion is that of the recordings.
        material: its law is fitted from its parameters on; all other numbers of it stay.
        tests: names of files of each test, replicates together.
        origins: name of a file -> file and SHA-256 of the one of a test machine from which it was made.
    """

    kind: str
    experiment: ts.Experiment
    rig: ts.Rig
    material: ts.Material
    tests: tuple[tuple[str, ...], ...]
    origins: Mapping[str, Mapping[str, str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Value:
    """A parameter that was fitted; SI. `interval` is that of 95 %, None where it has none, with `note` that says why
    it ends where it does."""

    value: float
    interval: tuple[float, float] | None
    unit: str
    note: str = ""


@dataclass(frozen=True)
class Calibrated:
    """What came out.

    Attributes:
        material: the law with what was fitted.
        values: parameter -> what was found. rmse: of all samples, N; None where no fit says one.
        warnings: sentences. solves: simulated tests. file: bytes of the material file, with uncertainty and provenance.
        unusable: why nobody should work with it, a sentence that is among the warnings, too; empty where one may.
    """

    material: ts.Material
    values: dict[str, Value]
    rmse: float | None
    warnings: tuple[str, ...]
    solves: int
    file: bytes
    unusable: str = ""


def calibrate_files(folder: str, wanted: Wanted) -> Calibrated:
    """Calibrate as ``tissue-sim calibrate`` does, with what is in a folder of its own.

    Args:
        folder: its folder `RECORDINGS` holds the files. What the fit does is written to `PROGRESS_FILE` beside it.
        wanted: what is to be fitted.

    Raises:
        InputError: what the calibration refuses, or a fit that gives no material; files go by their names.
        ConvergenceError: nothing could be fitted.
    """
    # Only here: the page starts without scipy.
    import calibration

    place = Path(folder)
    units = {path: each.declaration.unit for path, each in parameters(wanted.material).items()}
    said: dict[str, Any] = {"sentence": "loading the solver", "solves": 0, "rmse": None, "parameters": {},
                            "units": units}

    def tell() -> None:
        write_text(place / PROGRESS_FILE, json.dumps(said))

    def progress(sentence: str, done: int = 0, of: int = 0) -> None:
        sentence = sentence.partition(": ")[2] or sentence
        said["sentence"] = f"{sentence}, {done} of {of}" if of else sentence
        tell()

    def listen(_campaign: str, _law: str, iteration: Iteration) -> None:
        said.update(solves=said["solves"] + 1, rmse=iteration.RMSE_N, parameters=iteration.parameters)
        tell()

    campaign = place / "page.toml"
    try:
        tell()
        write_text(campaign, campaign_of(wanted, place))
        # Without pictures: nobody sees the report.
        result, = calibration.calibrate([campaign], place / "results", progress=progress, listen=listen, figures=False)
        fit = result.best
        if fit.material_file is None:
            raise InputError(f"the fit gives no material: {fit.unusable or fit.message}")
        file = place / "results" / fit.material_file
        if wanted.origins:
            _name_origins(file, wanted.origins)
        return Calibrated(ts.load_material(file), _values(fit), fit.RMSE_N, _warnings(fit), fit.fem_solves,
                          read_bytes(file, "a calibrated material"), fit.unusable or "")
    except InputError as error:
        own = error.file is None or Path(error.file) == campaign
        # Nobody knows the folder.
        raise InputError(error.problem.replace(folder, "the upload"),
                         file=None if own else Path(str(error.file)).name, line=error.line) from None
    except ConvergenceError as error:
        raise ConvergenceError(str(error).removeprefix(f"{campaign}: ")) from None


def _name_origins(file: Path, origins: Mapping[str, Mapping[str, str]]) -> None:
    """Let the provenance of a material file say from which files of test machines its recordings were made."""
    content = read_material_file(file)
    assert content.provenance is not None
    settings = {**content.provenance.settings, "made_from": origins}
    write_material_file(replace(content, provenance=replace(content.provenance, settings=settings)), file)


def campaign_of(wanted: Wanted, folder: Path) -> str:
    """The campaign (TOML) of what is wanted; a rig is written into the folder.

    Raises:
        InputError: an adhesion, which a campaign states as a law of the contact.
    """
    from calibration.importing.campaign_text import toml_value

    def table(heading: str, lines: dict[str, Any]) -> str:
        return "\n".join([heading, *(f"{key} = {toml_value(value)}" for key, value in lines.items())])

    experiment, material = wanted.experiment, wanted.material
    if experiment.adhesion is not None:
        raise InputError("the tool of this scene adheres, and that is not calibrated from the page; use tissue-sim "
                         "calibrate with contact_laws")
    specimen = experiment.specimen
    density = material.density if specimen.density is None else specimen.density
    body: dict[str, Any] = {"shape": specimen.shape, **_reachable(specimen)}
    if density is not None:
        body |= {"density_kg_m3": density, "gravity": specimen.gravity > 0, "height_is": specimen.height_is}
    how = {"kind": wanted.kind, **_experiment_keys(wanted)}
    if wanted.rig != ts.Rig():
        write_rig(wanted.rig, folder / "rig.json")
        how["rig"] = "rig.json"
    own: dict[str, float] = {}
    others: dict[str, float] = {}
    for path, each in parameters(material).items():
        (own if path in material.parameters else others)[each.file_path] = float(each.value / each.declaration.factor)
    fit = {"method": "inverse_fem", "laws": [material.law], "start": own, **({"fixed": others} if others else {})}
    tests = [table("[[test]]", {"name": f"test {number}", **how,
                                "recordings": [f"{RECORDINGS}/{name}" for name in names]})
             for number, names in enumerate(wanted.tests, start=1)]
    return "\n\n".join([table("[[specimen]]", body), *tests, table("[fit]", fit)]) + "\n"


def _reachable(specimen: ts.Specimen) -> dict[str, float | str]:
    """What makes a specimen, its files by paths that hold from any folder."""
    return {key: str(Path(str(value)).resolve()) if key in specimen.paths else value
            for key, value in specimen.stated.items()}


def _experiment_keys(wanted: Wanted) -> dict[str, Any]:
    """Keys of a ``[[test]]`` that say how it is done; what the kind says itself is left out."""
    experiment, kind = wanted.experiment, KINDS[wanted.kind]
    tool = experiment.tool
    file = getattr(tool, "profile_file", None)
    keys: dict[str, Any] = {"tool": tool.shape if file is None else str(Path(file).resolve())}
    for key, (declaration, name, _) in tool_sizes().items():
        value = getattr(tool, name, None)
        if value:
            keys[key] = value / declaration.factor
    keys |= {key: getattr(experiment, key) for key, face in kind.faces.items()
             if not face.fixed and not (key == "friction_wall" and not tool.has_shaft)}
    if experiment.contact_laws:
        keys["contact_laws"] = {name: to_keys(law) for name, law in experiment.contact_laws.items()}
    if experiment.tilt:
        keys["tilt_mm"] = experiment.tilt * 1e3
    return keys | ({"slip": experiment.slip} if experiment.slip else {})


def _values(fit: Fit) -> dict[str, Value]:
    free = [name for name, error in fit.standard_errors.items() if error != 0]
    return {name: Value(fit.parameters[name], fit.intervals95.get(name), fit.units.get(name, "1"),
                        _note(name, fit.on_bound, fit.not_identifiable)) for name in free}


def _note(name: str, on_bound: Sequence[str], not_identifiable: Sequence[str]) -> str:
    return "on its bound" if name in on_bound else "not identifiable" if name in not_identifiable else ""


def _warnings(fit: Fit) -> tuple[str, ...]:
    odd = [f"{name} disagrees with the other recordings" for name in fit.odd_recordings]
    said = [fit.unusable, *fit.warnings, *odd]
    return tuple(each for each in said if each)
