"""Flags that define a simulated test, and the construction of experiment, material and model from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.catalogue import SCENES, SIMULATED
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    make_integer_parser,
    make_open_interval_number_parser,
    parse_contact_interface_or_friction,
    parse_non_negative_number,
    parse_positive_number,
)
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.experiment.tools.tool import (
    TOOLS,
    Tool,
    convert_tool_sizes_to_si,
    interpret_shape_or_profile_path,
    list_all_tool_sizes_by_key,
    list_shapes_without_file,
)
from tissue_sim.specimen import SPECIMENS, STANDARD_GRAVITY, Specimen, specimen_sizes
from tissue_sim.specimen.specimen import make_specimen_from_keys

if TYPE_CHECKING:
    from tissue_sim import Experiment, Material, Model, Protocol, ReducedModel
    from tissue_sim.experiment.contact_law import ContactLaw
    from tissue_sim.parameters import Declaration


@dataclass(frozen=True)
class RampDepthAndPointDefaults:
    """Defaults and limits of the flags of the motion.

    Attributes:
        max_points: largest value of ``--points``; larger protocols would exhaust the memory.
        depth_mm: depth of the ramp without ``--depth-mm`` and ``--protocol``, mm.
        points: default of ``--points``.
        speed_mm_s: default of ``--speed-mm-s``, mm/s.
    """

    max_points: int = 100_000
    depth_mm: float = 10.0
    points: int = 21
    speed_mm_s: float = 0.248


#: Defaults of all commands with these flags.
MOTION_FLAGS = RampDepthAndPointDefaults()
#: Flags of tool and interfaces without default, besides the sizes of the tool.
TOOL_FLAGS = ("tool", "friction", "friction_base", "friction_wall", "offset_mm", "tilt_deg")
#: Other flags that have no meaning between grips.
_CONTACT_FLAGS = ("adhesion_N", "adhesion_length_mm", "contact_law", "tilt_mm", "slip", "gravity", "density_kg_m3",
                  "height_is")
#: Flags of the specimen without default, besides its sizes.
SPECIMEN_FLAGS = ("shape", "mesh", "mesh_unit", "mesh_base", "mesh_top", "gravity")
#: Sizes of the cylinder without flags: the silicone specimen of the reference study.
DEFAULT_CYLINDER_SIZES = {"radius_mm": 40.0, "height_mm": 70.0}
#: Meshes for real time, finest first; the number counts the elements of the mesh for the reference needle test.
_REALTIME_LEVELS = ("realtime_120", "realtime_63", "realtime_35", "realtime_20")
#: Resolution -> description in the help.
_RESOLUTIONS = {"realtime": f"realtime (the finest of {', '.join(_REALTIME_LEVELS)} that this computer solves within "
                "the time budget of a step; naming one of these selects it)",
                "fast": "fast (force error about 1 %%)", "accurate": "accurate (force error about 0.2 %%)"}


def add_scene_and_optional_material_flag(parser: InputErrorArgumentParser, *, purpose: str = "simulate") -> None:
    """Add the scene, by default the needle indentation, and ``--material``.

    Args:
        parser: parser of the command.
        purpose: verb of the command for the help.
    """
    parser.add_argument("scene", metavar="SCENE", nargs="?", default="needle_indentation",
                        help=f"test to {purpose}: {', '.join(SCENES)} (default: %(default)s)")
    parser.add_argument("--material", type=Path, metavar="FILE",
                        help="material file NAME.material.json (default: silicone of the reference study, law "
                        "reduced_polynomial_2)")


def add_resolution_and_solver_flags(parser: InputErrorArgumentParser,
                                    resolutions: Sequence[str] = tuple(_RESOLUTIONS)) -> None:
    """Add the flags of the solver and its resolution.

    Args:
        parser: parser of the command.
        resolutions: allowed resolutions, keys of `_RESOLUTIONS`; the first one is the default.
    """
    levels = _REALTIME_LEVELS if "realtime" in resolutions else ()
    parser.add_argument("--resolution", choices=(*resolutions, *levels), default=resolutions[0],
                        help=f"mesh: {', '.join(_RESOLUTIONS[name] for name in resolutions)} (default: %(default)s)")
    parser.add_argument("--solver", metavar="NAME", default="axisymmetric",
                        help="axisymmetric, solid (three-dimensional), or a solver of an installed package (default: "
                        "%(default)s)")
    parser.add_argument("--solid", dest="solver", action="store_const", const="solid",
                        help="same as --solver solid")


def add_reduced_flag(parser: InputErrorArgumentParser) -> None:
    """Add ``--reduced FILE``, a reduced model that replaces specimen, tool and solver of the other flags."""
    parser.add_argument("--reduced", type=Path, metavar="FILE",
                        help="reduced model from `tissue-sim reduce` (NAME.reduced.npz); it contains specimen, tool "
                        "and interfaces")


def add_experiment_flags(parser: InputErrorArgumentParser, *, motion: bool = True) -> None:
    """Add the flags of motion, specimen, and tool with interfaces, each in its argument group.

    Args:
        parser: parser of the command.
        motion: whether the command accepts flags of the motion. Without them the command always simulates in three
            dimensions and has no flag --solid.
    """
    if motion:
        _add_motion_flags(parser)
    needs = "; requires --solid" if motion else ""
    _add_specimen_mesh_and_weight_flags(parser, needs)
    _add_tool_and_interface_flags(parser, needs)


def _add_motion_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of the motion."""
    motion = parser.add_argument_group("motion")
    motion.add_argument("--depth-mm", type=parse_positive_number, metavar="N",
                        help=f"largest tool displacement of a single ramp (default: {MOTION_FLAGS.depth_mm:g})")
    motion.add_argument("--protocol", metavar="TEXT",
                        help="motion in segments instead of --depth-mm, such as 'approach 2mm; ramp 10mm @0.248mm/s; "
                        "hold 60s; unload; reload; retract 2mm' or 'repeat 3 (ramp 5mm; unload)'; with a prescribed "
                        "force, such as creep: 'ramp 2N @0.5N/s; hold 60s; unload'; in torsion 'ramp 30deg @1deg/s'")
    motion.add_argument("--points", type=make_integer_parser(2, MOTION_FLAGS.max_points), metavar="N",
                        default=MOTION_FLAGS.points,
                        help="number of samples of the ramp, or of each moving segment, its first one included "
                        "(default: 21)")
    motion.add_argument("--speed-mm-s", type=parse_positive_number, metavar="N",
                        help="speed of the tool where the protocol states none (default: "
                        f"{MOTION_FLAGS.speed_mm_s:g})")


def _add_specimen_mesh_and_weight_flags(parser: InputErrorArgumentParser, needs: str) -> None:
    """Add the flags of the specimen: shape, sizes, mesh file and self-weight.

    Args:
        parser: parser of the command.
        needs: end of the help of flags that require a simulation in three dimensions.
    """
    others = needs.replace("requires", "all shapes but the cylinder require")
    specimen = parser.add_argument_group("specimen")
    specimen.add_argument("--shape", choices=tuple(SPECIMENS),
                          help=f"shape of the specimen (default: cylinder){others}")
    for key, (declaration, name, shapes) in specimen_sizes().items():
        size = DEFAULT_CYLINDER_SIZES.get(key)
        default = "" if size is None else f" (default of the cylinder: {size:g})"
        specimen.add_argument(f"--{key.replace('_', '-')}", type=_make_size_flag_parser(declaration), metavar="N",
                              help=f"{name.replace('_', ' ')} of a specimen of shape {' or '.join(shapes)}{default}")
    specimen.add_argument("--mesh", type=Path, metavar="FILE",
                          help="mesh of a specimen of any shape: .msh, .vtu, .vtk or .inp file of tetrahedra or "
                          f"hexahedra with z upwards{needs}")
    specimen.add_argument("--mesh-unit", choices=("m", "cm", "mm", "um", "in"),
                          help="length unit of the mesh file (default: mm)")
    specimen.add_argument("--mesh-base", metavar="NAME",
                          help="name of the faces in the mesh file that are fixed (default: the faces in its lowest "
                          "plane)")
    specimen.add_argument("--mesh-top", metavar="NAME",
                          help="name of the faces in the mesh file that the tool can touch (default: the faces in its "
                          "highest plane, or all faces that point upwards)")
    specimen.add_argument("--gravity", action="store_true",
                          help="apply self-weight; the specimen settles before the test")
    specimen.add_argument("--density-kg-m3", type=parse_positive_number, metavar="N",
                          help="density of the specimen with --gravity (default: density of the material file)")
    specimen.add_argument("--height-is", choices=("moulded", "placed"),
                          help="with --gravity: whether --height-mm is the height before (moulded) or after (placed) "
                          "the specimen settles (default: moulded)")


def _add_tool_and_interface_flags(parser: InputErrorArgumentParser, needs: str) -> None:
    """Add the flags of the tool and of the contact at its faces.

    Arguments as of `_add_specimen_mesh_and_weight_flags`.
    """
    tool = parser.add_argument_group("tool and interfaces (default: as the scene defines)")
    tool.add_argument("--tool", metavar="SHAPE",
                      help=f"{', '.join(list_shapes_without_file())}, or a file with the columns r and z of its "
                      "profile")
    for key, (declaration, name, shapes) in list_all_tool_sizes_by_key().items():
        tool.add_argument(f"--{key.replace('_', '-')}", type=_make_size_flag_parser(declaration), metavar="N",
                          help=f"{name.replace('_', ' ')} of a tool of shape {' or '.join(shapes)}")
    tool.add_argument("--friction", type=parse_contact_interface_or_friction, metavar="CONTACT",
                      help="contact at the face of the tool: bonded, stick (no slip, can lift off), frictionless or a "
                      "friction coefficient such as 0.7")
    tool.add_argument("--friction-wall", type=parse_contact_interface_or_friction, metavar="CONTACT",
                      help="contact at the shaft of the tool, as for --friction")
    tool.add_argument("--friction-base", type=parse_contact_interface_or_friction, metavar="CONTACT",
                      help="contact at the base of the specimen, as for --friction (default between two plates: the "
                      "contact at the face of the tool)")
    tool.add_argument("--adhesion-N", type=parse_positive_number, metavar="N",
                      help="pull-off force of the face of the tool")
    tool.add_argument("--adhesion-length-mm", type=parse_positive_number, metavar="N",
                      help="gap over which the adhesion acts")
    tool.add_argument("--contact-law", action="append", default=[], metavar="NAME:KEY=N,...",
                      help="additional contact law from an installed package; may be given several times")
    tool.add_argument("--tilt-mm", type=parse_positive_number, metavar="N",
                      help="height difference across the face of a tilted tool; corrects the force curve")
    tool.add_argument("--offset-mm", type=make_open_interval_number_parser(-1e3, 1e3), metavar="N",
                      help=f"distance of the needle from the axis of the specimen{needs}")
    tool.add_argument("--tilt-deg", type=make_open_interval_number_parser(-80.0, 80.0), metavar="N",
                      help="angle between the needle and the axis of the specimen; the needle moves along its own "
                      f"axis{needs}")
    tool.add_argument("--slip", type=make_open_interval_number_parser(0.0, 1.0), metavar="N",
                      help="fraction of the bonded faces that slips: interpolates between the bonded and the "
                      "frictionless test")


def require_known_scene(name: str, *, allows_grips: bool = False) -> None:
    """Raise an error if no scene has this name.

    Args:
        name: name of a kind of test.
        allows_grips: whether the command simulates a gripped specimen too.

    Raises:
        InputError: unknown scene; the message names the nearest one. Or a gripped specimen that cannot be simulated.
    """
    known = SIMULATED if allows_grips else SCENES
    if name in known:
        return
    if name in SIMULATED:
        raise InputError(f"must be a test with a tool in this command; the specimen of {name} is gripped. Use "
                         f"tissue-sim simulate {name}; --figure draws the deformed specimen", field="SCENE")
    if name in KINDS:
        KINDS[name].require_tool()
    raise InputError(f"unknown scene {name!r}{make_hint_with_similar_or_known_words(name, known)}")


def get_tool_speed(arguments) -> float:
    """Return the speed of the tool where the protocol states none, m/s: that of ``--speed-mm-s``, or its default."""
    return (arguments.speed_mm_s or MOTION_FLAGS.speed_mm_s) * 1e-3


def make_protocol_from_flags(arguments, *, allows_force: bool = False) -> Protocol:
    """Return the protocol: the ramp of ``--depth-mm`` or the segments of ``--protocol``.

    Args:
        arguments: parsed arguments of `add_experiment_flags`.
        allows_force: whether the command accepts a prescribed force.

    Raises:
        InputError: both flags are given, the protocol is invalid, or it prescribes a force; or a speed in mm/s is given
            for a protocol of angles.
    """
    from tissue_sim import Protocol

    speed = get_tool_speed(arguments)
    if arguments.protocol is None:
        return Protocol.ramp((arguments.depth_mm or MOTION_FLAGS.depth_mm) * 1e-3, arguments.points, speed)
    if arguments.depth_mm is not None:
        raise InputError("cannot be combined with --protocol, which states its own depths. Leave one of them out",
                         field="--depth-mm")
    protocol = Protocol.parse(arguments.protocol, arguments.points, speed)
    if protocol.prescribes_angle and arguments.speed_mm_s is not None:
        raise InputError("does not apply to a protocol of angles. State the angular speed in --protocol, such as 'ramp "
                         "30deg @1deg/s'", field="--speed-mm-s")
    if not allows_force:
        protocol.require_displacement_control("this command", "--protocol")
    return protocol


def refuse_tilt_and_slip_correction_flags(arguments) -> None:
    """Refuse the flags of corrections of whole force curves, which do not exist in real time.

    Args:
        arguments: parsed arguments of `add_experiment_flags`.

    Raises:
        InputError: ``--tilt-mm`` or ``--slip`` was given.
    """
    for name, remedy in (("tilt_mm", ""), ("slip", ", or use --friction")):
        if getattr(arguments, name) is not None:
            raise InputError("corrects whole force curves and is not available in real time. Leave this flag out"
                             f"{remedy}", field=f"--{name.replace('_', '-')}")


def make_experiment_from_flags(arguments, protocol: Protocol, material: Material) -> Experiment:
    """Return the experiment of a scene with the changes of the flags.

    Args:
        arguments: parsed arguments of `add_experiment_flags`, with ``scene`` and ``material``.
        protocol: motion of the tool.
        material: material of the specimen; its density is the default with ``--gravity``.

    Raises:
        InputError: flags that contradict the scene or each other, or values that the experiment does not accept.
    """
    import tissue_sim as ts

    scene = SIMULATED[arguments.scene]
    if scene.has_gripped_ends:
        for name in (*TOOL_FLAGS, *_CONTACT_FLAGS, *list_all_tool_sizes_by_key()):
            if getattr(arguments, name):
                raise InputError(f"does not apply to {scene.name}, whose specimen is gripped. Leave this flag out",
                                 field=f"--{name.replace('_', '-')}")
        if arguments.protocol is None and scene.grip is not None and scene.grip.is_rotation:
            raise InputError(f"is required for {scene.name}. State an angle, such as 'ramp 30deg @1deg/s'",
                             field="--protocol")
        return scene.experiment(specimen=make_specimen_from_flags(arguments, {}), protocol=protocol)
    scene_tool = scene.require_tool()
    shape, profile = interpret_shape_or_profile_path(arguments.tool or scene_tool.shape)
    kind = TOOLS.find(shape, field="--tool")
    if not scene.allows_tool(kind):
        fitting = [name for name, other in SCENES.items() if other.allows_tool(kind)]
        raise InputError(f"the scene {scene.name} does not allow the tool {shape!r}. Use the scene "
                         f"{' or '.join(fitting)}", field="--tool")
    weight: dict[str, Any] = {}
    if arguments.gravity:
        density = arguments.density_kg_m3 or material.density
        if density is None:
            raise InputError(f"the density of the specimen is unknown, because {arguments.material} states none. Add "
                             "--density-kg-m3", field="--gravity")
        weight = {"density": density, "gravity": STANDARD_GRAVITY, "height_is": arguments.height_is or "moulded"}
    for name in ("density_kg_m3", "height_is"):
        if getattr(arguments, name) is not None and not arguments.gravity:
            raise InputError("has an effect only with --gravity. Add --gravity, or leave this flag out",
                             field=f"--{name.replace('_', '-')}")
    changes = {name: value for name in scene.face_interfaces_by_field
               if (value := getattr(arguments, name)) is not None}
    if (arguments.adhesion_N is None) != (arguments.adhesion_length_mm is None):
        raise InputError("adhesion requires --adhesion-N and --adhesion-length-mm. Give both or neither",
                         field="--adhesion-N" if arguments.adhesion_N is not None else "--adhesion-length-mm")
    if arguments.adhesion_N is not None:
        from tissue_sim.experiment.adhesion import Adhesion

        changes["adhesion"] = Adhesion(arguments.adhesion_N, arguments.adhesion_length_mm * 1e-3)
    if arguments.contact_law:
        changes["contact_laws"] = [_parse_contact_law_name_and_keys(text) for text in arguments.contact_law]
    if arguments.tilt_mm is not None:
        changes["tilt"] = arguments.tilt_mm * 1e-3
    if arguments.slip is not None:
        changes["slip"] = arguments.slip
    if arguments.offset_mm is not None or arguments.tilt_deg is not None:
        changes["approach"] = ts.Approach((arguments.offset_mm or 0.0) * 1e-3, math.radians(arguments.tilt_deg or 0.0))
    return scene.experiment(specimen=make_specimen_from_flags(arguments, weight), protocol=protocol,
                            tool=_make_tool_from_flags(arguments, shape, profile, scene_tool), **changes)


def make_specimen_from_flags(arguments, weight: dict[str, Any]) -> Specimen:
    """Return the specimen of the flags; `weight` holds its arguments of self-weight.

    Raises:
        InputError: flags that contradict each other, or values that the specimen does not accept.
    """
    stated = {key: value for key in specimen_sizes() if (value := getattr(arguments, key)) is not None}
    mesh_options = {name: value for name in ("mesh_unit", "mesh_base", "mesh_top")
                    if (value := getattr(arguments, name)) is not None}
    if arguments.mesh is not None:
        if (other := next(iter(stated), None)) is not None or arguments.shape not in (None, "mesh"):
            raise InputError("cannot be combined with --mesh, whose file defines shape and size of the specimen. Leave "
                             "this flag out", field=f"--{(other or 'shape').replace('_', '-')}")
        return Specimen(shape="mesh", mesh_file=arguments.mesh, **mesh_options, **weight)
    if mesh_options or arguments.shape == "mesh":
        raise InputError("requires a mesh file. Add --mesh FILE",
                         field=f"--{next(iter(mesh_options), 'shape').replace('_', '-')}")
    shape = arguments.shape or "cylinder"
    defaults = DEFAULT_CYLINDER_SIZES if shape == "cylinder" else {}
    try:
        return make_specimen_from_keys(shape, defaults | stated, **weight)
    except InputError as error:
        raise InputError(error.problem, field=f"--{(error.field or '').replace('_', '-')}") from None


def _parse_contact_law_name_and_keys(text: str) -> ContactLaw:
    """Read a contact law from text such as ``tacky_film:tack_Pa=30,thickness_mm=0.3``.

    Raises:
        InputError: another form, an unknown law, or a key or value that the law does not accept.
    """
    from tissue_sim.experiment.contact_law import CONTACT_LAWS
    from tissue_sim.parameters import make_from_file_values

    name, _, rest = text.partition(":")
    try:
        content = {key.strip(): float(number) for key, _, number in
                   (pair.partition("=") for pair in rest.split(",") if pair.strip())}
    except ValueError:
        raise InputError(f"must have the form NAME:KEY=N,...; got {text!r}. Example: adhesion:adhesion_N=0.02,"
                         "adhesion_length_mm=0.1", field="--contact-law") from None
    return make_from_file_values(CONTACT_LAWS.find(name, "--contact-law"), content, f"--contact-law {name}")


def _make_size_flag_parser(declaration: Declaration):
    """Return a function for argparse's ``type`` that checks a size of a specimen or a tool, in the unit of its flag."""
    low, high = (bound / declaration.factor for bound in declaration.bounds)
    if declaration.absent == 0:
        return parse_non_negative_number
    return parse_positive_number if declaration.unit == "m" else make_open_interval_number_parser(low, high)


def _make_tool_from_flags(arguments, shape: str, profile: Path | None, scene_tool: Tool) -> Tool:
    """Return the tool of the scene with the changes of the flags.

    Args:
        arguments: parsed arguments.
        shape: shape of the tool.
        profile: file of a profile, which defines the sizes of the tool; None otherwise.
        scene_tool: tool of the scene without flags; its sizes are kept where the new shape has them too.
    """
    known = list_all_tool_sizes_by_key()
    stated = {key: value for key in known if (value := getattr(arguments, key)) is not None}
    kept = {name: getattr(scene_tool, name) for _, name, shapes in known.values()
            if {scene_tool.shape, shape} <= {*shapes}}
    changes = convert_tool_sizes_to_si(stated)
    if profile is not None:
        return Tool(shape, profile_file=profile, **changes)
    return Tool(shape, **(kept | changes))


def load_reduced_model_and_set_flags(arguments) -> ReducedModel | None:
    """Check ``--solver`` and load the reduced model of ``--reduced``.

    With a reduced model this sets ``solver`` and the default ``depth_mm`` of the arguments.

    Returns:
        The reduced model; None without ``--reduced``.

    Raises:
        InputError: an unknown solver, a flag of specimen, tool or solver is given too, or the file is invalid.
    """
    require_known_solver(arguments.solver)
    if arguments.reduced is None:
        return None
    if arguments.solver != "axisymmetric":
        raise InputError("cannot be combined with --reduced, which selects its solver. Leave this flag out",
                         field="--solver")
    for name in (*TOOL_FLAGS, *SPECIMEN_FLAGS, *list_all_tool_sizes_by_key(), *specimen_sizes()):
        if getattr(arguments, name, None) not in (None, False):
            raise InputError("cannot be combined with --reduced, whose file defines it. Leave this flag out, or "
                             "make another reduced model", field=f"--{name.replace('_', '-')}")
    from tissue_sim import load_reduced

    reduced = load_reduced(arguments.reduced)
    arguments.solver = "reduced"
    if arguments.protocol is None and arguments.depth_mm is None:
        # The default motion stays inside the box of poses of the reduced model.
        arguments.depth_mm = reduced.box.depth * 1e3
    return reduced


def make_model_from_flags(arguments, material: Material, reduced: ReducedModel | None) -> Model:
    """Return the model of a simulation in real time.

    Args:
        arguments: parsed arguments of `add_experiment_flags`, with ``scene`` and ``material``.
        material: material of the specimen.
        reduced: reduced model, whose experiment replaces that of the flags; None: no reduced model.

    Raises:
        InputError: flags that contradict the scene or each other, or values that the experiment does not accept.
    """
    from tissue_sim import Model

    return Model(reduced.model.experiment if reduced else
                 make_experiment_from_flags(arguments, make_protocol_from_flags(arguments), material), material)


def require_known_solver(name: str) -> None:
    """Raise an error if no solver has this name; solvers are not imported.

    Raises:
        InputError: unknown solver; the message names the nearest one.
    """
    from tissue_sim.fem.solver import SOLVERS

    if name not in SOLVERS:
        raise InputError(f"unknown solver {name!r}{make_hint_with_similar_or_known_words(name, SOLVERS)}",
                         field="--solver")


def load_scene_material(path: Path | None, reduced: ReducedModel | None) -> Material:
    """Return the material of a file, or for None that of the reduced model, or without one that of the study."""
    return reduced.model.material if reduced and path is None else load_material_or_study_silicone(path)


def load_material_or_study_silicone(path: Path | None) -> Material:
    """Return the material of a file, or for None the silicone of the reference study."""
    import tissue_sim as ts

    if path is not None:
        return ts.load_material(path)
    from scenes.demo.specimen import BULK_RATIO, PHANTOM

    return ts.Material("reduced_polynomial_2", PHANTOM, ts.Bulk("bulk_ratio", BULK_RATIO), name="silicone of the study",
                       density=1040.0)
