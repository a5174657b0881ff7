"""Calibration that the page starts; the functions run in the calibration process."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

import tissue_sim as ts
from tissue_sim.decode import read_json_value
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.experiment.tools.tool import list_all_tool_sizes_by_key
from tissue_sim.files import read_bytes, write_text
from tissue_sim.material.file import read_material_file, write_material_file
from tissue_sim.parameters import convert_to_file_values, parameters
from tissue_sim.rig.file import write_rig

if TYPE_CHECKING:
    from calibration.fit.fit import DescentEvaluation, Fit

#: Name of the file in the folder of a calibration to which the progress of the fit is written.
PROGRESS_FILE = "progress.json"
#: Name of the subfolder with the recordings.
RECORDINGS = "recordings"


@dataclass(frozen=True)
class CalibrationRequest:
    """Input of a calibration.

    Attributes:
        kind: Name of the kind of test.
        experiment: Specimen, tool and interfaces; the motion is taken from the recordings.
        rig: Measuring rig.
        material: Material whose law is fitted, starting from its parameters; its other parameters are fixed.
        tests: File names of the replicates of each test.
        origins: File name of a recording -> name and SHA-256 of the test-machine file from which it was converted.
    """

    kind: str
    experiment: ts.Experiment
    rig: ts.Rig
    material: ts.Material
    tests: tuple[tuple[str, ...], ...]
    origins: Mapping[str, Mapping[str, str]] = field(default_factory=dict)


@dataclass(frozen=True)
class FittedParameter:
    """Fitted parameter.

    Attributes:
        value: Fitted value, SI.
        interval: 95 % confidence interval, SI; None if it is not known.
        unit: SI unit.
        note: Limitation of the interval, such as "on its bound"; empty if there is none.
    """

    value: float
    interval: tuple[float, float] | None
    unit: str
    note: str = ""


@dataclass(frozen=True)
class CalibrationResult:
    """Result of a calibration.

    Attributes:
        material: Material with the fitted parameters.
        values: Parameter -> fitted value.
        rmse: Root mean square error over all samples, N; None if not known.
        warnings: Warnings, sentences.
        solves: Number of simulated tests.
        file: Content of the material file, with uncertainty and provenance.
        unusable: Why the material must not be used, a sentence that is also in `warnings`; empty for a usable fit.
    """

    material: ts.Material
    values: dict[str, FittedParameter]
    rmse: float | None
    warnings: tuple[str, ...]
    solves: int
    file: bytes
    unusable: str = ""


@dataclass(frozen=True)
class FitProgress:
    """Progress of a running fit; the fields are the keys of the progress file.

    Attributes:
        sentence: Present activity.
        solves: Number of simulations of the test so far.
        rmse: Root mean square misfit, N; None before the first iteration.
        parameters: Parameter -> present value, SI.
        units: Parameter -> SI unit.
    """

    sentence: str
    solves: int = 0
    rmse: float | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


class FitProgressFile:
    """Listener of a fit that writes each change of the progress to a file, for the process of the page.

    Args:
        path: Progress file.
        units: Parameter -> SI unit.
    """

    def __init__(self, path: Path, units: Mapping[str, str]):
        self._path, self._progress = path, FitProgress("loading the solver", units=units)
        self._write_change()

    def write_task(self, sentence: str, done: int = 0, of: int = 0) -> None:
        """Write the current task, without the name of its campaign; see `calibration.calibrate`, `progress`."""
        sentence = sentence.partition(": ")[2] or sentence
        self._write_change(sentence=f"{sentence}, {done} of {of}" if of else sentence)

    def write_iteration(self, _campaign: str, _law: str, iteration: DescentEvaluation) -> None:
        """Count one simulation, and write its misfit and parameters; see `calibration.calibrate`, `listen`."""
        self._write_change(solves=self._progress.solves + 1, rmse=iteration.RMSE_N, parameters=iteration.parameters)

    def _write_change(self, **changed: Any) -> None:
        """Change the progress and write it."""
        self._progress = replace(self._progress, **changed)
        write_text(self._path, json.dumps(asdict(self._progress)))


def read_fit_progress_or_none(path: Path) -> FitProgress | None:
    """Read the progress file of a fit; return None if the file does not exist or is incomplete."""
    try:
        return FitProgress(**read_json_value(path, "the progress of a calibration"))
    except (InputError, TypeError):
        return None


def calibrate_uploaded_files(folder: str, request: CalibrationRequest) -> CalibrationResult:
    """Calibrate a material as ``tissue-sim calibrate`` does, and write the progress to `PROGRESS_FILE`.

    Args:
        folder: Folder for all files of the calibration, with the recordings in its subfolder `RECORDINGS`.
        request: Input of the calibration.

    Raises:
        InputError: The calibration refuses the input, or the fit gives no material. The message names files without
            their folder.
        ConvergenceError: No test could be simulated.
    """
    # Imported here so that the page starts without loading SciPy.
    from calibration.pipeline import run_campaign_jobs

    root = Path(folder)
    campaign = root / "page.toml"
    try:
        progress = FitProgressFile(root / PROGRESS_FILE, {
            path: each.declaration.unit for path, each in parameters(request.material).items()})
        write_text(campaign, build_campaign_text_and_write_rig(request, root))
        # The report is deleted with the folder, so its figures are not drawn.
        result, = run_campaign_jobs("fit", [campaign], root / "results", progress=progress.write_task,
                                    listen=progress.write_iteration, options={"figures": False})
        fit = result.best
        if fit.material_file is None:
            raise InputError(f"The fit gives no material: {fit.unusable or fit.message}")
        file = root / "results" / fit.material_file
        if request.origins:
            _add_original_files_to_provenance(file, request.origins)
        return CalibrationResult(ts.load_material(file), _collect_fitted_parameters_by_name(fit), fit.RMSE_N,
                                 _collect_fit_warnings(fit),
                                 fit.fem_solves, read_bytes(file, "a calibrated material"), fit.unusable or "")
    except InputError as error:
        own = error.file is None or Path(error.file) == campaign
        # The temporary folder means nothing to the user.
        raise InputError(error.problem.replace(folder, "the upload"),
                         file=None if own else Path(str(error.file)).name, line=error.line) from None
    except ConvergenceError as error:
        raise ConvergenceError(str(error).removeprefix(f"{campaign}: ")) from None


def _add_original_files_to_provenance(file: Path, origins: Mapping[str, Mapping[str, str]]) -> None:
    """Add the names and SHA-256 of the original test-machine files to the provenance of a material file."""
    content = read_material_file(file)
    assert content.provenance is not None
    settings = {**content.provenance.settings, "made_from": origins}
    provenance = msgspec.structs.replace(content.provenance, settings=settings)
    write_material_file(msgspec.structs.replace(content, provenance=provenance), file)


def build_campaign_text_and_write_rig(request: CalibrationRequest, folder: Path) -> str:
    """Return the campaign file (TOML) of a request; also write ``rig.json`` into the folder if the rig is not ideal.

    Raises:
        InputError: The tool has an adhesion, which a campaign can state only as a contact law.
    """
    from calibration.importing.campaign_text import format_toml_value

    def format_toml_table(heading: str, lines: dict[str, Any]) -> str:
        """Return a TOML table: its heading, then one line for each key."""
        return "\n".join([heading, *(f"{key} = {format_toml_value(value)}" for key, value in lines.items())])

    experiment, material = request.experiment, request.material
    if experiment.adhesion is not None:
        raise InputError("The page cannot calibrate a scene with adhesion. Use tissue-sim calibrate with contact_laws.")
    specimen = experiment.specimen
    density = material.density if specimen.density is None else specimen.density
    body: dict[str, Any] = {"shape": specimen.shape, **_collect_specimen_values_by_key(specimen)}
    if density is not None:
        body |= {"density_kg_m3": density, "gravity": specimen.gravity > 0, "height_is": specimen.height_is}
    test = {"kind": request.kind, **_collect_experiment_values_by_key(request)}
    if request.rig != ts.Rig():
        write_rig(request.rig, folder / "rig.json")
        test["rig"] = "rig.json"
    start: dict[str, float] = {}
    fixed: dict[str, float] = {}
    for path, each in parameters(material).items():
        values = start if path in material.parameters else fixed
        values[each.path_in_file] = float(each.value / each.declaration.factor)
    fit = {"method": "inverse_fem", "laws": [material.law], "start": start, **({"fixed": fixed} if fixed else {})}
    tests = [format_toml_table("[[test]]", {"name": f"test {number}", **test,
                                            "recordings": [f"{RECORDINGS}/{name}" for name in names]})
             for number, names in enumerate(request.tests, start=1)]
    return "\n\n".join([format_toml_table("[[specimen]]", body), *tests, format_toml_table("[fit]", fit)]) + "\n"


def _collect_specimen_values_by_key(specimen: ts.Specimen) -> dict[str, float | str]:
    """Return the stated dimensions and files of a specimen, with absolute paths."""
    return {key: str(Path(str(value)).resolve()) if key in specimen.paths else value
            for key, value in specimen.values_by_file_key.items()}


def _collect_experiment_values_by_key(request: CalibrationRequest) -> dict[str, Any]:
    """Return the keys of a ``[[test]]`` table for tool and interfaces, without those that the kind of test fixes."""
    experiment, kind = request.experiment, KINDS[request.kind]
    tool = experiment.tool
    file = getattr(tool, "profile_file", None)
    keys: dict[str, Any] = {"tool": tool.shape if file is None else str(Path(file).resolve())}
    for key, (declaration, name, _) in list_all_tool_sizes_by_key().items():
        value = getattr(tool, name, None)
        if value:
            keys[key] = value / declaration.factor
    keys |= {key: getattr(experiment, key) for key, face in kind.face_interfaces_by_field.items()
             if not face.fixed and not (key == "friction_wall" and not tool.has_shaft)}
    if experiment.contact_laws:
        keys["contact_laws"] = {name: convert_to_file_values(law) for name, law in experiment.contact_laws.items()}
    if experiment.tilt:
        keys["tilt_mm"] = experiment.tilt * 1e3
    return keys | ({"slip": experiment.slip} if experiment.slip else {})


def _collect_fitted_parameters_by_name(fit: Fit) -> dict[str, FittedParameter]:
    """Return the parameters that were free in the fit."""
    free = [name for name, error in fit.standard_errors.items() if error != 0]
    return {name: FittedParameter(fit.parameters[name], fit.intervals95.get(name), fit.units.get(name, "1"),
                                  _describe_interval_limitation(name, fit.on_bound, fit.not_identifiable))
            for name in free}


def _describe_interval_limitation(name: str, on_bound: Sequence[str], not_identifiable: Sequence[str]) -> str:
    """Return the limitation of the confidence interval of a parameter in words; empty if there is none."""
    return "on its bound" if name in on_bound else "not identifiable" if name in not_identifiable else ""


def _collect_fit_warnings(fit: Fit) -> tuple[str, ...]:
    """Return why the fit is unusable, its warnings and its deviating recordings, one sentence each."""
    outliers = [f"{name} disagrees with the other recordings" for name in fit.odd_recordings]
    warnings = [fit.unusable, *fit.warnings, *outliers]
    return tuple(each for each in warnings if each)
