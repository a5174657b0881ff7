"""Read and check the tables of a campaign file: specimens, experiments, solver, rig, and fit settings.

Each error states the field.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.campaign.parameters import ScopedCampaignParameter
from calibration.campaign.schema import (
    BY_PARAMETER,
    PRISM,
    CampaignTable,
    FitTable,
    NoiseTable,
    SpecimenTable,
    TestTable,
)
from tissue_sim.bounded import run_in_sandbox
from tissue_sim.errors import InputError, located_and_converted_errors, make_hint_with_similar_or_known_words
from tissue_sim.experiment.contact_law import AS_TOOL, CONTACT_LAWS, INTERFACES
from tissue_sim.experiment.experiment import Approach, Experiment
from tissue_sim.experiment.kinds.kind import KINDS, TestKind
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.experiment.tools.tool import (
    TOOLS,
    Tool,
    convert_tool_sizes_to_si,
    interpret_shape_or_profile_path,
    list_all_tool_sizes_by_key,
    list_shapes_without_file,
)
from tissue_sim.fem.solver import SOLVERS
from tissue_sim.files import find_files, is_valid_and_existing_path
from tissue_sim.laws import find_law
from tissue_sim.material.material import BULK_RATIOS
from tissue_sim.parameters import list_field_declarations, make_from_file_values
from tissue_sim.rig.file import load_rig
from tissue_sim.rig.rig import Rig
from tissue_sim.settings import make_shallow_read_only_copy
from tissue_sim.specimen import SPECIMENS, STANDARD_GRAVITY, Specimen
from tissue_sim.specimen.specimen import add_indefinite_article, make_specimen_from_keys, map_shape_keys_to_required


def require_positive_if_stated(value: float | None, field: str, unit: str = "") -> None:
    """Require a positive finite number or None.

    Args:
        value: the number.
        field: dotted field for the error message.
        unit: unit for the error message, with a leading space.

    Raises:
        InputError: the number is zero, negative or not finite.
    """
    if value is not None and not (np.isfinite(value) and value > 0):
        raise InputError(f"{field.rpartition('.')[2]} must be positive; got {value:g}{unit}", field=field)


def check_bulk_ratio(ratio: float | None) -> None:
    """Raise an `InputError` for a ratio K / mu0 outside the validated range of the finite elements; None is allowed."""
    if ratio is not None and not BULK_RATIOS[0] <= ratio <= BULK_RATIOS[1]:
        raise InputError(f"bulk_ratio must be {BULK_RATIOS[0]:g} to {BULK_RATIOS[1]:g}, the validated range of the "
                         f"finite elements; got {ratio:g}. Leave bulk_ratio out for an incompressible material",
                         field="fit.bulk_ratio")


def require_analytical_support_of_test_table(entry: TestTable, field: str) -> None:
    """Raise an `InputError` if a test table has a kind, tool or key that the analytical method does not support."""
    kind = KINDS[entry.kind]
    if kind.closed_form is None:
        known = ", ".join(name for name, other in KINDS.items() if other.closed_form is not None)
        raise InputError(f"kind must be one of {known} for the analytical method; got {entry.kind!r}. Set fit.method = "
                         "'inverse_fem' for other kinds", field=f"{field}.kind")
    if entry.tool is not None and not TOOLS.find(interpret_shape_or_profile_path(entry.tool)[0],
                                                 f"{field}.tool").is_plate:
        raise InputError(f"tool must be a plate in a homogeneous test; got {entry.tool!r}. Leave tool out",
                         field=f"{field}.tool")
    for key in ("protocol", "rig"):
        if getattr(entry, key) is not None:
            raise InputError(f"the analytical method does not use {key}; leave {key} out, or set fit.method = "
                             "'inverse_fem'", field=f"{field}.{key}")


def read_column_map_or_none(entry: TestTable, field: str) -> Mapping[str, Any] | None:
    """Check the key ``columns`` of a test table; return the columns of each channel, or None without the key."""
    if entry.columns is None:
        return None
    # Imported on use: most campaigns have recordings of this program, without a map of columns.
    from tissue_sim.recording.formats.columns import normalize_column_mapping

    try:
        columns = normalize_column_mapping(entry.columns)
    except InputError as error:
        raise error.with_location(field=field) from None
    present = {*columns, "displacement"} if entry.speed_mm_s is not None and {"time", "force"} <= columns.keys() \
        else columns
    KINDS[entry.kind].require_channels(present, f"columns has {', '.join(columns)}", field=f"{field}.columns")
    return make_shallow_read_only_copy(columns)


def find_recording_files(patterns: list[str], folder: Path, field: str) -> tuple[Path, ...]:
    """Return the sorted files that match paths or patterns, which are relative to the folder of the campaign.

    Raises:
        InputError: no pattern, a pattern without matching file, or a file that is listed twice.
    """
    if not patterns:
        raise InputError("recordings must contain at least one path or pattern; got none. Add the files of the test.",
                         field=field)
    found: list[Path] = []
    for i, pattern in enumerate(patterns):
        entry_field = f"{field}[{i}]"
        path = Path(pattern)
        base, relative = (Path(path.anchor), path.relative_to(path.anchor)) if path.is_absolute() else (folder, path)
        if not pattern.strip() or relative == Path():
            raise InputError(f"recording must be a path or a pattern such as 'run_*.csv'; got {pattern!r}. "
                             "Name a file.",
                             field=entry_field)
        # An existing file has priority over a pattern, because file names may contain brackets.
        plain = base / relative
        matches = [plain] if is_valid_and_existing_path(plain) else []
        if not matches and set("*?[") & set(pattern):
            # The search is limited: a pattern may match the whole disk.
            with located_and_converted_errors(field=entry_field):
                matches = run_in_sandbox(find_files, base, str(relative), file=base, size=0)
        if not matches:
            raise InputError(f"recording must be an existing file; no file matches {pattern!r} in {base}. Paths are "
                             "relative to the campaign file.", field=entry_field)
        for match in matches:
            if match.resolve() in {other.resolve() for other in found}:
                raise InputError(f"recording must be listed once; {match.name} is listed twice. List each replicate "
                                 "once.", field=entry_field)
            found.append(match)
    return tuple(sorted(found))


def reject_fit_and_noise_keys_without_effect(table: FitTable, noise: NoiseTable) -> None:
    """Raise an `InputError` for a key of ``[fit]`` or ``[noise]`` without effect with the other settings."""
    if table.method == "analytical":
        if table.starts is not None:
            raise InputError("the analytical method does not use starts; leave starts out", field="fit.starts")
    else:
        if table.strain_points is not None:
            raise InputError("an inverse fit does not interpolate the samples; leave strain_points out",
                             field="fit.strain_points")
        for key in ("offset_bounds_mm", "zero_bounds_N"):
            if getattr(table, key) is not None:
                raise InputError(f"an inverse fit limits offsets and zeros by priors, not by bounds; leave {key} out",
                                 field=f"fit.{key}")
    if table.offset == "none":
        for key in ("offset_bounds_mm", "offset_prior_mm", "zero_bounds_N", "zero_prior_N"):
            if getattr(table, key) is not None:
                raise InputError(f'{key} requires offset = "fit"; set offset, or leave {key} out', field=f"fit.{key}")
    elif table.method == "inverse_fem":
        for key in ("contact_jitter_mm", "zero_jitter_N"):
            if getattr(noise, key) == "estimate" or getattr(noise, key) == 0:
                raise InputError(f'{key} must be a positive standard deviation with offset = "fit"; got '
                                 f"{getattr(noise, key)!r}. State one, or leave offset out", field=f"noise.{key}")


def require_analytical_support_of_fit_table(table: FitTable, named: Mapping[str, ScopedCampaignParameter]) -> None:
    """Raise an `InputError` for parameters and settings that the closed forms do not support.

    Args:
        table: table ``[fit]`` with ``method = "analytical"``.
        named: parameters by their names in the file.
    """
    others = [name for name in named if not named[name].is_law_parameter]
    if others and table.strain_points is not None:
        raise InputError(f"strain_points removes the time history that {others[0]} requires; leave strain_points out",
                         field="fit.strain_points")
    for name, parameter in named.items():
        if not parameter.is_material_parameter:
            key = next(key for key in ("scope", *BY_PARAMETER) if name in getattr(table, key))
            raise InputError(f"the analytical method fits material parameters only; leave {name} out, or set "
                             "fit.method = 'inverse_fem'", field=f"fit.{key}.{name}")


def read_stable_stretches(table: FitTable) -> bool | tuple[float, float]:
    """Return ``fit.stable``: whether, or over which stretches, the law is kept stable.

    Raises:
        InputError: a range that does not contain 1, or another method than the analytical one.
    """
    if isinstance(table.stable, bool):
        stretches: bool | tuple[float, float] = table.stable
    else:
        low, high = stretches = (float(table.stable[0]), float(table.stable[1]))
        if not 0.0 < low <= 1.0 <= high < float("inf"):
            raise InputError(f"must be true, false or a range of stretches that contains 1; got [{low:g}, {high:g}]. "
                             "State a range such as [0.7, 1.5]", field="fit.stable")
    if stretches and table.method != "analytical":
        raise InputError(f"must be false with fit.method = {table.method!r}. Remove it and state fit.bounds, or set "
                         "fit.method = 'analytical'", field="fit.stable")
    return stretches


def check_compressible_laws(table: FitTable, named: Mapping[str, ScopedCampaignParameter],
                            kinds: Sequence[TestKind]) -> None:
    """Raise an `InputError` if a law with its own volumetric response is combined with what it does not support.

    Args:
        table: table ``[fit]``.
        named: parameters by their names in the file.
        kinds: kinds of the tests.
    """
    compressible = [name for name in table.laws if find_law(name).is_compressible]
    if not compressible:
        return
    name = compressible[0]
    if table.stable:
        raise InputError(f"must be false with {name}: the constrained fit takes minutes, because each step solves the "
                         "lateral equilibrium. Use hyperfoam_1, which is stable if mu1 > 0 and nu1 >= 0, or state "
                         "fit.bounds",
                         field="fit.stable")
    bulk = [key for key in named if named[key].path.startswith("bulk.")]
    if table.bulk_ratio is not None or bulk:
        raise InputError(f"must not be given with {name}, whose parameters state the volumetric response. Remove it; "
                         f"laws that need it are calibrated in another campaign",
                         field="fit.bulk_ratio" if table.bulk_ratio is not None
                         else f"fit.{'start' if bulk[0] in table.start else 'fixed'}.{bulk[0]}")
    others = [key for key, each in named.items() if each.is_material_parameter and not each.is_law_parameter
              and each.path.split(".")[0].split("[")[0] in ("viscoelastic", "softening", "poroelasticity")]
    if others:
        raise InputError(f"must not be fitted with {name}: relaxation, softening and drainage act on the isochoric "
                         "stress, which a compressible law does not separate. Leave it out, or use another law",
                         field=f"fit.{'start' if others[0] in table.start else 'fixed'}.{others[0]}")
    for kind in kinds:
        if kind.closed_form is not None and not kind.closed_form.includes_change_of_volume:
            raise InputError(f"must not contain {name}, because {kind.name} has a closed form of constant volume only. "
                             "Use another law, or leave the test out", field="fit.laws")


def check_bulk_of_confined_tests(table: FitTable, named: Mapping[str, ScopedCampaignParameter],
                                 kinds: Sequence[TestKind]) -> None:
    """Raise an `InputError` if a test between lateral walls has no bulk modulus, or another test ignores a fitted one.

    Args:
        table: table ``[fit]``.
        named: parameters by their names in the file.
        kinds: kinds of the tests.
    """
    confined = [kind.name for kind in kinds if kind.has_lateral_wall]
    bulk = [name for name in named if named[name].path.startswith("bulk.")]
    if not confined or all(find_law(name).is_compressible for name in table.laws):
        return
    if table.bulk_ratio is None and not bulk:
        raise InputError(f"must be given for {confined[0]}, whose force depends on the bulk modulus; got none. State "
                         "bulk_ratio, or bulk.K_Pa in [fit.start] and a test with free sides", field="fit.bulk_ratio")
    fitted = [name for name in bulk if name in table.start]
    incompressible = [kind.name for kind in kinds if not kind.has_lateral_wall]
    if table.method == "analytical" and incompressible and fitted:
        raise InputError(f"must be 'inverse_fem' to fit {fitted[0]}: the closed form of {incompressible[0]} assumes an "
                         "incompressible material", field="fit.method")
    gripped = [kind.name for kind in kinds if kind.has_gripped_ends]
    if gripped and fitted:
        raise InputError(f"must not be fitted with {gripped[0]}, whose closed form assumes an incompressible material. "
                         "Use a compression between plates instead", field=f"fit.start.{fitted[0]}")


def check_values_finite_and_consistent(table: FitTable) -> None:
    """Raise an `InputError` for invalid or contradictory numbers in ``start``, ``fixed``, ``prior`` and ``bounds``."""
    for key in BY_PARAMETER:
        for name, value in getattr(table, key).items():
            if np.isnan(value).any() or (key != "bounds" and not np.isfinite(value).all()):
                raise InputError(f"{key} must be finite; got {value}", field=f"fit.{key}.{name}")
    for name, (low, high) in table.bounds.items():
        if not low < high:
            raise InputError(f"bounds must be [low, high] with low < high; got [{low:g}, {high:g}]",
                             field=f"fit.bounds.{name}")
    for name, (_, deviation) in table.prior.items():
        if deviation <= 0:
            raise InputError("a prior must be [mean, standard deviation] with a positive standard deviation; got "
                             f"{deviation:g}", field=f"fit.prior.{name}")
    for name in table.fixed:
        for key in ("start", "prior"):
            if name in getattr(table, key):
                raise InputError(f"{name} is fixed and has a {key}; keep one of the two",
                                 field=f"fit.{key}.{name}")


#: Keys of a prism -> whether the key is required.
_PRISM_KEYS = {"area_mm2": True, "height_mm": True}


def read_specimens_by_name(table: CampaignTable, folder: Path) -> dict[str, Specimen]:
    """Return the specimens of a campaign by name.

    Args:
        table: tables of the campaign file.
        folder: folder to which files of specimens are relative.

    Raises:
        InputError: a missing or duplicate name, sizes that do not match the shape, or an invalid mesh.
    """
    specimens: dict[str, Specimen] = {}
    for i, entry in enumerate(table.specimen):
        field = f"specimen[{i}]"
        if entry.name is None and len(table.specimen) > 1:
            raise InputError("each specimen requires a name if there are several; add a name", field=f"{field}.name")
        name = entry.name if entry.name is not None else "specimen"
        if name in specimens:
            raise InputError(f"names of specimens must be unique; got {name!r} twice", field=f"{field}.name")
        specimens[name] = _read_specimen(entry, name, folder, field)
    return specimens


def _read_specimen(entry: SpecimenTable, name: str, folder: Path, field: str) -> Specimen:
    """Return the specimen of a table ``[[specimen]]``."""
    for key, value in entry.stated_sizes_in_file_units.items():
        require_positive_if_stated(value, f"{field}.{key}", " mm")
    require_positive_if_stated(entry.density_kg_m3, f"{field}.density_kg_m3", " kg/m3")
    if entry.gravity and entry.density_kg_m3 is None:
        raise InputError("gravity = true requires the density of the specimen; add density_kg_m3",
                         field=f"{field}.density_kg_m3")
    shape = entry.shape
    has = _PRISM_KEYS if shape == PRISM else map_shape_keys_to_required(shape)
    given: dict[str, float | str] = {**entry.stated_sizes_in_file_units, **entry.stated_text_values}
    if entry.area_mm2 is not None:
        given["area_mm2"] = entry.area_mm2
    if lacks := [key for key, needed in has.items() if needed and key not in given]:
        raise InputError(f"{add_indefinite_article(shape)} requires {lacks[0]}, which is missing",
                         field=f"{field}.{lacks[0]}")
    if others := [key for key in given if key not in has]:
        raise InputError(f"{add_indefinite_article(shape)} has {next(iter(has))}, not {others[0]}; leave {others[0]} "
                         f"out",
                         field=f"{field}.{others[0]}")
    if shape == PRISM:
        # Homogeneous tests depend on cross-section and height only: a cylinder of the same area is equivalent.
        require_positive_if_stated(area := float(given.pop("area_mm2")), f"{field}.area_mm2", " mm2")
        shape, given = "cylinder", given | {"radius_mm": 1e3 * math.sqrt(area * 1e-6 / math.pi)}
    elif entry.stated_text_values:
        given |= {key: str(folder / entry.stated_text_values[key]) for key in SPECIMENS[shape].paths
                  if key in entry.stated_text_values}
    if not SPECIMENS[shape].is_round:
        # The longest side sets the element size: a wrong unit would create millions of elements.
        for declaration in list_field_declarations(SPECIMENS[shape]).values():
            size = given.get(declaration.key)
            low, high = (end / declaration.factor for end in declaration.bounds)
            if isinstance(size, int | float) and not low <= size <= high:
                raise InputError(f"{declaration.key} must be {low:g} to {high:g}; got {size:g}. Check the unit",
                                 field=f"{field}.{declaration.key}")
    try:
        return make_specimen_from_keys(shape, given, name=name, density=entry.density_kg_m3, height_is=entry.height_is,
                                       gravity=STANDARD_GRAVITY if entry.gravity else 0.0)
    except InputError as error:
        raise error.with_location(field=field) from None


def find_and_check_specimen_or_none(entry: TestTable, specimens: Mapping[str, Specimen], table: CampaignTable,
                                    field: str) -> Specimen | None:
    """Return the specimen of a test; None if the test has no specimen and requires none.

    Args:
        entry: table of the test.
        specimens: specimens of the campaign by name.
        table: tables of the campaign file.
        field: field of the test for messages.

    Raises:
        InputError: the specimen does not exist or does not suit the kind of test and the method.
    """
    if entry.specimen is not None and entry.specimen not in specimens:
        hint = make_hint_with_similar_or_known_words(entry.specimen, specimens) if specimens \
            else "; the file has no [[specimen]]"
        raise InputError(f"no specimen is named {entry.specimen!r}{hint}", field=f"{field}.specimen")
    if entry.specimen is None and len(specimens) > 1:
        raise InputError(f"specimen must name one of {', '.join(specimens)}", field=f"{field}.specimen")
    found = next(iter(specimens.values()), None) if entry.specimen is None else specimens[entry.specimen]
    kind = KINDS[entry.kind]
    stands = kind.has_closed_form_with_weight if table.fit.method == "analytical" else not kind.has_gripped_ends
    if found is not None and found.specific_weight and not stands:
        if not kind.has_gripped_ends:
            raise InputError(f"gravity = true has no closed form in {entry.kind}. Set fit.method = 'inverse_fem', or "
                             "use a specimen with gravity = false for this test", field=f"{field}.specimen")
        raise InputError(f"gravity = true requires a specimen that stands under a plate; {entry.kind} does not define "
                         "the direction of gravity. Use a specimen with gravity = false for this test",
                         field=f"{field}.specimen")
    if found is None and kind.closed_form is None:
        raise InputError(f"{entry.kind} requires a specimen; add a [[specimen]] and state its name here",
                         field=f"{field}.specimen")
    if found is None:
        return None
    shape = table.specimen[list(specimens).index(found.name)].shape
    description = f"{found.name!r} is {add_indefinite_article(shape)}"
    if shape == PRISM and kind.closed_form is None:
        raise InputError(f"{entry.kind} requires the shape of the specimen; {description}, of which only the "
                         "cross-section is known. State the shape, such as 'cylinder' with radius_mm",
                         field=f"{field}.specimen")
    if shape == PRISM and kind.size_names.is_round:
        raise InputError(f"{entry.kind} requires a circular cross-section; {description}. Use shape = 'cylinder' with "
                         "radius_mm", field=f"{field}.specimen")
    if found.is_prism or (table.fit.method != "analytical" and not kind.has_gripped_ends):
        return found
    remedy = f"for {entry.kind} use a specimen such as shape = 'prism' with area_mm2 and height_mm" \
        if kind.has_gripped_ends else "set fit.method = 'inverse_fem'"
    raise InputError(f"{description} without constant cross-section, for which there is no closed form; {remedy}",
                     field=f"{field}.specimen")


#: Field of an experiment or a tool -> key of the campaign; the sizes of tools are added.
_KEYS = {"tool": "tool", "tool.profile_file": "tool", "friction": "friction", "friction_base": "friction_base",
         "friction_wall": "friction_wall", "tilt": "tilt_mm", "slip": "slip", "approach.offset": "offset_mm",
         "approach.angle": "tilt_deg"}
#: Keys of a tool path that is not along the axis, see `Approach`.
_APPROACH = ("offset_mm", "tilt_deg")
#: Default solver of round specimens.
ROUND_SOLVER = "axisymmetric"
#: Default solver of specimens of other shapes.
SPACE_SOLVER = "solid"
#: Keys of tests with a tool; a gripped test must not state them.
_TOOL_KEYS = ("contact_laws", "tilt_mm", "slip", *_APPROACH, "solver", "rig")


def read_experiment_or_none_if_gripped(entry: TestTable, specimen: Specimen | None, folder: Path,
                                       place: str) -> Experiment | None:
    """Return the experiment of a test with a short placeholder motion.

    Args:
        entry: table of the test.
        specimen: specimen of the test; None: a cylinder of 1 m height and radius.
        folder: folder of the campaign, to which file names are relative.
        place: field of the test in the campaign, such as ``test[0]``.

    Returns:
        The experiment; None for a gripped specimen.

    Raises:
        InputError: keys contradict the kind of test or each other; the error states the field.
    """
    kind = KINDS[entry.kind]
    if kind.has_gripped_ends:
        for key in (*entry.stated_tool_sizes_in_file_units, *kind.face_interfaces_by_field, *_TOOL_KEYS):
            face = kind.face_interfaces_by_field.get(key)
            if getattr(entry, key) not in (None, face.usual if face is not None and face.fixed else None):
                raise InputError(f"{key} does not apply to kind = {entry.kind!r}, which is gripped on both sides; "
                                 f"leave {key} out", field=f"{place}.{key}")
        if entry.tool is not None and not TOOLS.find(interpret_shape_or_profile_path(entry.tool)[0],
                                                     f"{place}.tool").is_plate:
            raise InputError(f"tool does not apply to kind = {entry.kind!r}; leave tool out", field=f"{place}.tool")
        return None
    specimen = Specimen(1.0, 1.0) if specimen is None else specimen
    interfaces = {key: value for key in kind.face_interfaces_by_field
                  if (value := _read_face_friction_or_none(entry, kind, key, place)) is not None}
    laws = [make_from_file_values(CONTACT_LAWS.find(name, f"{place}.contact_laws.{name}"), content,
                                  f"{place}.contact_laws.{name}")
            for name, content in (entry.contact_laws or {}).items()]
    try:
        return kind.experiment(specimen=specimen, protocol=Protocol.ramp(1e-3 * specimen.height, 2),
                               tool=_read_tool(entry, kind, folder, place), contact_laws=laws,
                               tilt=1e-3 * (entry.tilt_mm or 0.0), slip=entry.slip,
                               approach=_read_needle_offset_and_tilt_or_none(entry, specimen, place), **interfaces)
    except InputError as error:
        keys = _KEYS | {f"tool.{name}": key for key, (_, name, _) in list_all_tool_sizes_by_key().items()}
        if error.field not in keys:
            raise
        raise InputError(error.problem.replace("Give the tool an edge radius", "Give edge_radius_mm"),
                         field=f"{place}.{keys[error.field]}") from None


def _read_needle_offset_and_tilt_or_none(entry: TestTable, specimen: Specimen, place: str) -> Approach | None:
    """Return the stated lateral offset and tilt of the path of a needle; None if the test states neither."""
    stated = {key: value for key in _APPROACH if (value := getattr(entry, key)) is not None}
    for key in stated:
        if KINDS[entry.kind].require_tool().is_plate:
            raise InputError(f"{key} requires a needle; a plate covers the whole top and moves along the axis. Leave "
                             f"{key} out", field=f"{place}.{key}")
        if entry.solver is None and specimen.is_round:
            raise InputError(f"{key} requires solver = 'solid', because the test is not axisymmetric; add solver",
                             field=f"{place}.{key}")
    return make_from_file_values(Approach, stated, place) if stated else None


def read_solver_name(entry: TestTable, specimen: Specimen | None, place: str) -> str:
    """Return the name of the solver of a test; the default depends on whether the specimen is round.

    Raises:
        InputError: the solver is unknown, or it is axisymmetric and the specimen is not round.
    """
    round_ = specimen is None or specimen.is_round
    name = entry.solver or (ROUND_SOLVER if round_ else SPACE_SOLVER)
    if name not in SOLVERS:
        raise InputError(f"unknown solver {name!r}{make_hint_with_similar_or_known_words(name, SOLVERS)}",
                         field=f"{place}.solver")
    if specimen is not None and not round_ and name == ROUND_SOLVER:
        raise InputError(f"the axisymmetric solver requires a cylinder; {specimen.name!r} is "
                         f"{add_indefinite_article(specimen.shape)}. Leave solver out, or set solver = "
                         f"{SPACE_SOLVER!r}",
                         field=f"{place}.solver")
    return name


def _read_face_friction_or_none(entry: TestTable, kind: TestKind, key: str, place: str) -> str | float | None:
    """Return the stated friction of a face, or None if the campaign states nothing."""
    face, value = kind.face_interfaces_by_field[key], getattr(entry, key)
    if isinstance(value, str) and value not in (*INTERFACES, *([AS_TOOL] if key == "friction_base" else [])):
        raise InputError(
            f"unknown friction {value!r}{make_hint_with_similar_or_known_words(value, INTERFACES)}; or give a "
            "coefficient",
            field=f"{place}.{key}")
    if face.fixed and value is not None and (value or "frictionless") != face.usual:
        other = " or ".join(repr(name) for name, one in KINDS.items()
                            if one.face_interfaces_by_field[key].stated and one.allows_tool(kind.require_tool()))
        raise InputError(f"a test of kind = {entry.kind!r} must have {key} = {face.usual!r}; got {value!r}. Leave "
                         f"{key} out, or use kind = {other}", field=f"{place}.{key}")
    if value is None and face.stated:
        raise InputError(f"{entry.kind} requires the friction of the plates; state a coefficient, 'stick', "
                         "'frictionless' or 'bonded'. friction_base has the same value unless it is stated",
                         field=f"{place}.{key}")
    return value


def _read_tool(entry: TestTable, kind: TestKind, folder: Path, place: str) -> Tool:
    """Return the tool of a test: the usual tool of its kind, or the stated shape with the stated sizes."""
    kinds_tool = kind.require_tool()
    shape, profile = interpret_shape_or_profile_path(entry.tool or kinds_tool.shape, folder)
    fits = kind.allows_tool(TOOLS.find(shape, f"{place}.tool"))
    if kind.tool_stated and (entry.tool is None or not fits):
        known = ", ".join(repr(name) for name in list_shapes_without_file() if kind.allows_tool(TOOLS[name]))
        raise InputError(f"{entry.kind} requires the shape of the tool; state tool = {known} or a profile file",
                         field=f"{place}.tool")
    if not fits:
        other = " or ".join(repr(name) for name, one in KINDS.items() if one.allows_tool(TOOLS[shape]))
        raise InputError(f"{entry.kind} cannot use the tool {entry.tool!r}; use kind = {other}", field=f"{place}.tool")
    usual = {} if entry.tool is not None else {name: getattr(kinds_tool, name)
                                               for name in list_field_declarations(type(kinds_tool))}
    # Zero means that the tool has no such dimension.
    sizes = convert_tool_sizes_to_si({key: value for key,
                                      value in entry.stated_tool_sizes_in_file_units.items() if value})
    return Tool(shape, profile_file=profile, **(usual | sizes))


def read_rig_without_noise(entry: TestTable, folder: Path, place: str) -> Rig:
    """Return the rig of a test without noise and resolution, which affect the recording and not the model.

    Raises:
        InputError: the rig file is invalid, see `load_rig`.
    """
    if entry.rig is None:
        return Rig()
    try:
        return load_rig(folder / entry.rig).without_sampling_effects
    except InputError as error:
        raise error.with_location(field=f"{place}.rig") from None
