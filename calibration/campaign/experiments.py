"""How a test of a campaign is done: its experiment and rig, and which of them its kind allows."""

from __future__ import annotations

from pathlib import Path

from calibration.campaign.schema import TestTable
from tissue_sim.errors import InputError, nearest
from tissue_sim.experiment.approach import Approach
from tissue_sim.experiment.contact_law import CONTACT_LAWS
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.interfaces import AS_TOOL, INTERFACES
from tissue_sim.experiment.kinds.kind import KINDS, TestKind
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.experiment.tools.tool import (
    TOOLS,
    Tool,
    read_shape,
    shapes_without_file,
    sizes_of_keys,
    tool_sizes,
)
from tissue_sim.fem.solver import SOLVERS
from tissue_sim.parameters import declared, from_keys
from tissue_sim.rig.file import load_rig
from tissue_sim.rig.rig import Rig
from tissue_sim.specimen import Specimen
from tissue_sim.specimen.specimen import with_article

#: Field of an experiment or a tool -> key of the campaign, beside those of the sizes of tools.
_KEYS = {"tool": "tool", "tool.profile_file": "tool", "friction": "friction", "friction_base": "friction_base",
         "friction_wall": "friction_wall", "tilt": "tilt_mm", "slip": "slip", "approach.offset": "offset_mm",
         "approach.angle": "tilt_deg"}
#: Keys of a tool's way that is not down the axis, see `Approach`, and of what else only a tool has.
_APPROACH = ("offset_mm", "tilt_deg")
#: Solver of round specimens, and that of all shapes, where a test states none.
ROUND_SOLVER, SPACE_SOLVER = "axisymmetric", "solid"
_OF_TOOL = ("contact_laws", "tilt_mm", "slip", *_APPROACH, "solver", "rig")


def read_experiment(entry: TestTable, specimen: Specimen | None, folder: Path, place: str) -> Experiment | None:
    """The experiment of a test, with a short motion in place of the recorded ones; None of a gripped specimen.

    Args:
        entry: of the campaign. specimen: that it names; None: one of 1 m. folder: that its files are relative to.
        place: its field.

    Raises:
        InputError: keys that do not fit the kind or each other, with the field of the campaign.
    """
    kind = KINDS[entry.kind]
    if kind.gripped:
        for key in (*entry.tool_sizes, *kind.faces, *_OF_TOOL):
            face = kind.faces.get(key)
            if getattr(entry, key) not in (None, face.usual if face is not None and face.fixed else None):
                raise InputError(f"a test of kind {entry.kind!r} is gripped on both sides and has none; leave it out",
                                 field=f"{place}.{key}")
        if entry.tool is not None and not TOOLS.find(read_shape(entry.tool)[0], f"{place}.tool").is_plate:
            raise InputError(f"a test of kind {entry.kind!r} has no tool; leave it out", field=f"{place}.tool")
        return None
    specimen = Specimen(1.0, 1.0) if specimen is None else specimen
    interfaces = {key: value for key in kind.faces if (value := _interface(entry, kind, key, place)) is not None}
    laws = [from_keys(CONTACT_LAWS.find(name, f"{place}.contact_laws.{name}"), content, f"{place}.contact_laws.{name}")
            for name, content in (entry.contact_laws or {}).items()]
    try:
        return kind.experiment(specimen=specimen, protocol=Protocol.ramp(1e-3 * specimen.height, 2),
                               tool=_tool(entry, kind, folder, place), contact_laws=laws,
                               tilt=1e-3 * (entry.tilt_mm or 0.0), slip=entry.slip,
                               approach=_approach(entry, specimen, place), **interfaces)
    except InputError as error:
        keys = _KEYS | {f"tool.{name}": key for key, (_, name, _) in tool_sizes().items()}
        if error.field not in keys:
            raise
        raise InputError(error.problem.replace("give the tool an edge radius", "give edge_radius_mm"),
                         field=f"{place}.{keys[error.field]}") from None


def _approach(entry: TestTable, specimen: Specimen, place: str) -> Approach | None:
    stated = {key: value for key in _APPROACH if (value := getattr(entry, key)) is not None}
    for key in stated:
        if KINDS[entry.kind].require_tool().is_plate:
            raise InputError("a plate covers the whole top and comes down its axis; leave it out",
                             field=f"{place}.{key}")
        if entry.solver is None and specimen.is_round:
            raise InputError("a needle off the axis or at an angle is simulated in space; give solver = 'solid' too",
                             field=f"{place}.{key}")
    return from_keys(Approach, stated, place) if stated else None


def read_solver(entry: TestTable, specimen: Specimen | None, place: str) -> str:
    """Name of the solver of a test; where none is stated, that in space of a specimen that is not round.

    Raises:
        InputError: there is none of that name, or it is that of round ones and the specimen is another.
    """
    round_ = specimen is None or specimen.is_round
    name = entry.solver or (ROUND_SOLVER if round_ else SPACE_SOLVER)
    if name not in SOLVERS:
        raise InputError(f"unknown solver {name!r}{nearest(name, SOLVERS)}", field=f"{place}.solver")
    if specimen is not None and not round_ and name == ROUND_SOLVER:
        raise InputError(f"the axisymmetric solver takes cylinders only, and {specimen.name!r} is "
                         f"{with_article(specimen.shape)}; leave it out, or give solver = {SPACE_SOLVER!r}",
                         field=f"{place}.solver")
    return name


def _interface(entry: TestTable, kind: TestKind, key: str, place: str) -> str | float | None:
    """What the campaign says of a face, if anything."""
    face, value = kind.faces[key], getattr(entry, key)
    if isinstance(value, str) and value not in (*INTERFACES, *([AS_TOOL] if key == "friction_base" else [])):
        raise InputError(f"unknown friction {value!r}{nearest(value, INTERFACES)}; or give a coefficient",
                         field=f"{place}.{key}")
    if face.fixed and value is not None and (value or "frictionless") != face.usual:
        other = " or ".join(repr(name) for name, one in KINDS.items()
                            if one.faces[key].stated and one.fits(kind.require_tool()))
        raise InputError(f"{value!r} contradicts kind = {entry.kind!r}, whose faces are {face.usual}; leave it out, or "
                         f"use kind = {other}", field=f"{place}.{key}")
    if value is None and face.stated:
        raise InputError(f"{entry.kind} needs the interface of the plates; give a coefficient of friction, 'stick', "
                         "'frictionless' or 'bonded'; friction_base is the same unless it is stated",
                         field=f"{place}.{key}")
    return value


def _tool(entry: TestTable, kind: TestKind, folder: Path, place: str) -> Tool:
    kinds_tool = kind.require_tool()
    shape, profile = read_shape(entry.tool or kinds_tool.shape, folder)
    fits = kind.fits(TOOLS.find(shape, f"{place}.tool"))
    if kind.tool_stated and (entry.tool is None or not fits):
        known = ", ".join(repr(name) for name in shapes_without_file() if kind.fits(TOOLS[name]))
        raise InputError(f"{entry.kind} needs the shape of its tool: tool = {known} or a profile file",
                         field=f"{place}.tool")
    if not fits:
        other = " or ".join(repr(name) for name, one in KINDS.items() if one.fits(TOOLS[shape]))
        raise InputError(f"{entry.kind} is not done with {entry.tool!r}; use kind = {other}", field=f"{place}.tool")
    usual = {} if entry.tool is not None else {name: getattr(kinds_tool, name) for name in declared(type(kinds_tool))}
    # A zero says that the tool has no such size.
    sizes = sizes_of_keys({key: value for key, value in entry.tool_sizes.items() if value})
    return Tool(shape, profile_file=profile, **(usual | sizes))


def read_rig(entry: TestTable, folder: Path, place: str) -> Rig:
    """The rig of the test's file; what it does to single samples is in the recording, not in the model.

    Raises:
        InputError: what `load_rig` refuses.
    """
    if entry.rig is None:
        return Rig()
    try:
        return load_rig(folder / entry.rig).without_noise
    except InputError as error:
        raise error.located(field=f"{place}.rig") from None
