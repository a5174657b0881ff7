"""Read the experiment, the solver and the rig of a test, and check them against the kind of test."""

from __future__ import annotations

from pathlib import Path

from calibration.campaign.schema import TestTable
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
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
from tissue_sim.parameters import list_field_declarations, make_from_file_values
from tissue_sim.rig.file import load_rig
from tissue_sim.rig.rig import Rig
from tissue_sim.specimen import Specimen
from tissue_sim.specimen.specimen import add_indefinite_article

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
