"""The flags that state an experiment, and the experiment that they make."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.catalogue import SCENES
from scenes.commands.shared.parsing import Parser, at_least, between, interface, not_negative, positive
from tissue_sim.errors import InputError, nearest
from tissue_sim.experiment.tools.tool import (
    TOOLS,
    Tool,
    read_shape,
    shapes_without_file,
    sizes_of_keys,
    tool_sizes,
)
from tissue_sim.specimen import SPECIMENS, STANDARD_GRAVITY, Specimen, specimen_sizes
from tissue_sim.specimen.specimen import specimen_of_keys

if TYPE_CHECKING:
    from tissue_sim import Experiment, Material, Protocol
    from tissue_sim.experiment.contact_law import ContactLaw
    from tissue_sim.parameters import Declaration

MOST_POINTS = 100_000
DEPTH_MM = 10.0
#: Of the cylinder where nothing else is said.
USUAL_SIZES = {"radius_mm": 40.0, "height_mm": 70.0}


def add_experiment_flags(parser: Parser, *, motion: bool = True) -> None:
    """Motion (if wanted), specimen, tool and interfaces, each in a group of its own."""
    if motion:
        _add_motion(parser)
    _add_specimen(parser)
    _add_tool(parser)


def _add_motion(parser: Parser) -> None:
    motion = parser.add_argument_group("motion")
    motion.add_argument("--depth-mm", type=positive, metavar="N",
                        help=f"largest tool displacement of a plain ramp (default: {DEPTH_MM:g})")
    motion.add_argument("--protocol", metavar="TEXT",
                        help="segments in place of --depth-mm: 'approach 2mm; ramp 10mm @0.248mm/s; hold 60s; unload; "
                             "reload; retract 2mm', 'repeat 3 (ramp 5mm; unload)'")
    motion.add_argument("--points", type=at_least(2, MOST_POINTS), metavar="N", default=21,
                        help="points of the ramp, or of each segment that moves, its start included (default: 21)")
    motion.add_argument("--speed-mm-s", type=positive, metavar="N", default=0.248,
                        help="of the tool, until the protocol names one (default: 0.248)")


def _add_specimen(parser: Parser) -> None:
    specimen = parser.add_argument_group("specimen")
    specimen.add_argument("--shape", choices=tuple(SPECIMENS),
                          help="cylinder, or with --solid another (default: cylinder)")
    for key, (what, name, shapes) in specimen_sizes().items():
        usual = f" (of the cylinder by default: {USUAL_SIZES[key]:g})" if key in USUAL_SIZES else ""
        specimen.add_argument(f"--{key.replace('_', '-')}", type=_size(what), metavar="N",
                              help=f"{name.replace('_', ' ')} of the specimen: {', '.join(shapes)}{usual}")
    specimen.add_argument("--mesh", type=Path, metavar="FILE",
                          help="a specimen of any shape: .msh, .vtu, .vtk or .inp of tetrahedra or hexahedra, z "
                               "upwards; with --solid")
    specimen.add_argument("--mesh-unit", choices=("m", "cm", "mm", "um", "in"),
                          help="of the coordinates in that file (default: mm)")
    for flag, how, where in (("--mesh-base", "held", "in its lowest plane"),
                             ("--mesh-top", "met by the tool", "in its highest plane, or all that look up")):
        specimen.add_argument(flag, metavar="NAME",
                              help=f"name in that file of the sides that are {how} (default: those {where})")
    specimen.add_argument("--gravity", action="store_true", help="let the specimen weigh, and settle before the test")
    specimen.add_argument("--density-kg-m3", type=positive, metavar="N", help="default: that of the material file")
    specimen.add_argument("--height-is", choices=("moulded", "placed"),
                          help="--height-mm is that before (moulded) or after settling (placed; default: moulded)")


def _add_tool(parser: Parser) -> None:
    tool = parser.add_argument_group("tool and interfaces (defaults: those of the scene)")
    tool.add_argument("--tool", metavar="SHAPE",
                      help=f"{', '.join(shapes_without_file())}, or a file with two columns, r and z of its profile")
    for key, (what, name, shapes) in tool_sizes().items():
        tool.add_argument(f"--{key.replace('_', '-')}", type=_size(what), metavar="N",
                          help=f"{name.replace('_', ' ')} of the tool: {', '.join(shapes)}")
    for flag, face, usual in (("--friction", "tool's face", ""), ("--friction-wall", "shaft", ""),
                              ("--friction-base", "base", " (default between two plates: that of the tool's face)")):
        tool.add_argument(flag, type=interface, metavar="HOW",
                          help=f"{face}: bonded, stick (no slip, can lift off), frictionless or a friction coefficient"
                               f"{usual}")
    tool.add_argument("--adhesion-N", type=positive, metavar="N", help="pull-off force of the tool's face")
    tool.add_argument("--adhesion-length-mm", type=positive, metavar="N", help="gap over which the adhesion acts")
    tool.add_argument("--contact-law", action="append", default=[], metavar="NAME:KEY=N,...",
                      help="a law of the contact beside these, from an installed package; once for each")
    tool.add_argument("--tilt-mm", type=positive, metavar="N", help="height difference across the tool's face")
    tool.add_argument("--offset-mm", type=between(-1e3, 1e3), metavar="N",
                      help="how far from the axis the needle is; with --solid")
    tool.add_argument("--tilt-deg", type=between(-80.0, 80.0), metavar="N",
                      help="angle between the needle and the axis, along which it goes in; with --solid")
    tool.add_argument("--slip", type=between(0.0, 1.0), metavar="N", help="share of bonded faces that slips")


def check_scene(name: str) -> None:
    """Raises InputError: no such scene."""
    if name not in SCENES:
        raise InputError(f"unknown scene {name!r}{nearest(name, SCENES)}")


def make_protocol(arguments) -> Protocol:
    """The motion: a plain ramp, or the segments of ``--protocol``.

    Raises:
        InputError: both are stated, or a fault in the protocol.
    """
    from tissue_sim import Protocol

    speed = arguments.speed_mm_s * 1e-3
    if arguments.protocol is None:
        return Protocol.ramp((arguments.depth_mm or DEPTH_MM) * 1e-3, arguments.points, speed)
    if arguments.depth_mm is not None:
        raise InputError("--protocol states its own depths; leave one of the two out", field="--depth-mm")
    return Protocol.parse(arguments.protocol, arguments.points, speed)


def make_experiment(arguments, protocol: Protocol, material: Material) -> Experiment:
    """The scene with what the flags change in it.

    Raises:
        InputError: flags that do not fit the scene or each other, or what the experiment refuses.
    """
    import tissue_sim as ts

    scene = SCENES[arguments.scene]
    usual = scene.require_tool()
    shape, profile = read_shape(arguments.tool or usual.shape)
    kind = TOOLS.find(shape, field="--tool")
    if not scene.fits(kind):
        fitting = [name for name, other in SCENES.items() if other.fits(kind)]
        raise InputError(f"{scene.name} is not done with the tool {shape!r}; use scene {' or '.join(fitting)}",
                         field="--tool")
    weight: dict[str, Any] = {}
    if arguments.gravity:
        density = arguments.density_kg_m3 or material.density
        if density is None:
            raise InputError(f"the specimen's density is not known: {arguments.material} states none; add "
                             "--density-kg-m3", field="--gravity")
        weight = {"density": density, "gravity": STANDARD_GRAVITY, "height_is": arguments.height_is or "moulded"}
    for name in ("density_kg_m3", "height_is"):
        if getattr(arguments, name) is not None and not arguments.gravity:
            raise InputError("counts only where the specimen has weight; add --gravity or leave it out",
                             field=f"--{name.replace('_', '-')}")
    changes = {name: value for name in scene.faces
               if (value := getattr(arguments, name)) is not None}
    if (arguments.adhesion_N is None) != (arguments.adhesion_length_mm is None):
        raise InputError("adhesion needs a force and a length; give both or neither",
                         field="--adhesion-N" if arguments.adhesion_N is not None else "--adhesion-length-mm")
    if arguments.adhesion_N is not None:
        from tissue_sim.experiment.adhesion import Adhesion

        changes["adhesion"] = Adhesion(arguments.adhesion_N, arguments.adhesion_length_mm * 1e-3)
    if arguments.contact_law:
        changes["contact_laws"] = [_contact_law(text) for text in arguments.contact_law]
    if arguments.tilt_mm is not None:
        changes["tilt"] = arguments.tilt_mm * 1e-3
    if arguments.slip is not None:
        changes["slip"] = arguments.slip
    if arguments.offset_mm is not None or arguments.tilt_deg is not None:
        changes["approach"] = ts.Approach((arguments.offset_mm or 0.0) * 1e-3, math.radians(arguments.tilt_deg or 0.0))
    return scene.experiment(specimen=_specimen(arguments, weight), protocol=protocol,
                            tool=_tool(arguments, shape, profile, usual), **changes)


def _specimen(arguments, weight: dict[str, Any]) -> Specimen:
    stated = {key: value for key in specimen_sizes() if (value := getattr(arguments, key)) is not None}
    of_file = {name: value for name in ("mesh_unit", "mesh_base", "mesh_top")
               if (value := getattr(arguments, name)) is not None}
    if arguments.mesh is not None:
        if (other := next(iter(stated), None)) is not None or arguments.shape not in (None, "mesh"):
            raise InputError("a mesh states shape and sizes of the specimen itself; leave them out",
                             field=f"--{(other or 'shape').replace('_', '-')}")
        return Specimen(shape="mesh", mesh_file=arguments.mesh, **of_file, **weight)
    if of_file or arguments.shape == "mesh":
        raise InputError("a mesh of a file needs the file; add --mesh FILE",
                         field=f"--{next(iter(of_file), 'shape').replace('_', '-')}")
    shape = arguments.shape or "cylinder"
    usual = USUAL_SIZES if shape == "cylinder" else {}
    try:
        return specimen_of_keys(shape, usual | stated, **weight)
    except InputError as error:
        raise InputError(error.problem, field=f"--{(error.field or '').replace('_', '-')}") from None


def _contact_law(text: str) -> ContactLaw:
    """``tacky_film:tack_Pa=30,thickness_mm=0.3`` as a law of the contact."""
    from tissue_sim.experiment.contact_law import CONTACT_LAWS
    from tissue_sim.parameters import from_keys

    name, _, rest = text.partition(":")
    try:
        content = {key.strip(): float(number) for key, _, number in
                   (pair.partition("=") for pair in rest.split(",") if pair.strip())}
    except ValueError:
        raise InputError(f"{text!r} is not NAME:KEY=N,...; write it like adhesion:adhesion_N=0.02,"
                         "adhesion_length_mm=0.1", field="--contact-law") from None
    return from_keys(CONTACT_LAWS.find(name, "--contact-law"), content, f"--contact-law {name}")


def _size(what: Declaration):
    """What a size of a tool may be, in the unit of its flag."""
    low, high = (bound / what.factor for bound in what.bounds)
    return not_negative if what.absent == 0 else positive if what.unit == "m" else between(low, high)


def _tool(arguments, shape: str, profile: Path | None, usual: Tool) -> Tool:
    """The scene's `usual` tool with what the flags change in it; the measures of a profile are those of its file."""
    known = tool_sizes()
    stated = {key: value for key in known if (value := getattr(arguments, key)) is not None}
    kept = {name: getattr(usual, name) for _, name, shapes in known.values() if {usual.shape, shape} <= {*shapes}}
    changes = sizes_of_keys(stated)
    if profile is not None:
        return Tool(shape, profile_file=profile, **changes)
    return Tool(shape, **(kept | changes))
