"""Flags and results of `tissue-sim material export --match`: constants that reproduce a calibrated test in a target."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.commands.shared.console import display_task, make_table_with_headings, print_sentence
from scenes.commands.shared.experiment_flags import (
    SPECIMEN_FLAGS,
    TOOL_FLAGS,
    add_experiment_flags,
    make_experiment_from_flags,
    make_protocol_from_flags,
    make_specimen_from_flags,
    require_known_scene,
)
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    make_integer_parser,
    make_open_interval_number_parser,
    parse_positive_number,
)
from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import list_all_tool_sizes_by_key
from tissue_sim.specimen import specimen_sizes

if TYPE_CHECKING:
    from rich.console import Console

    from calibration.targets.matching import TargetComparison
    from tissue_sim import Experiment, Material
    from tissue_sim.exports import ExportTarget
    from tissue_sim.exports.elastic_constants import ElasticConstants
    from tissue_sim.material.file import MaterialFile
    from tissue_sim.mesh.solid import SolidMesh


@dataclass(frozen=True)
class TargetMeshDefaults:
    """Mesh in the target without a mesh file.

    Attributes:
        smallest: smallest element under the tool, as a fraction of the radius of its contact, 1.
        growth: ratio of successive elements.
        largest: largest element, as a fraction of the radius of the contact, 1.
        around: number of elements along a quarter of the circle under the tool.
    """

    smallest: float = 0.3
    growth: float = 2.0
    largest: float = 2.0
    around: int = 3


_MESH = TargetMeshDefaults()


@dataclass(frozen=True)
class MatchOutcome:
    """Content of the exported file that follows from ``--match``, or from its absence.

    Attributes:
        materials: the calibrated material, then draws.
        constants: constants of each material; empty for targets with the law.
        remarks: sentences for the file.
        warnings: sentences for the terminal.
        mesh: mesh in the target; None: no mesh.
        comparison: forces in the target; None without ``--match``.
    """

    materials: tuple[Material, ...]
    constants: tuple[ElasticConstants, ...] = ()
    remarks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    mesh: SolidMesh | None = None
    comparison: TargetComparison | None = None


def add_match_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of the fit of constants to a test, and those of the test."""
    group = parser.add_argument_group("force error in the target")
    group.add_argument("--match", metavar="SCENE",
                       help="test, such as needle_indentation, whose calibrated force the target shall reproduce; for "
                       "programs with elastic constants these are fitted. The flags of motion, specimen and tool below "
                       "define the test. Exit code 1: the target does not reach all depths; the file states the depth")
    group.add_argument("--in-target", action="store_true",
                       help="run the test in the target itself, which compensates its mesh and its contact as well")
    group.add_argument("--poisson", type=make_open_interval_number_parser(0.0, 0.5), metavar="N",
                       help="Poisson's ratio of the constants (default: fitted with --in-target)")
    group.add_argument("--draws", type=make_integer_parser(1, 1000), metavar="N",
                       help="add N variants, drawn from the covariance of the material file")
    group.add_argument("--seed", type=make_integer_parser(0), metavar="N", default=0,
                       help="seed of the draws (default: %(default)s)")
    group.add_argument("--element-mm", type=parse_positive_number, metavar="N",
                       help="smallest element under the tool of the mesh in the target (default: 0.3 radii of the "
                       "contact); a mesh of --mesh is used as it is")
    group.add_argument("--resolution", choices=("fast", "accurate"), default="accurate",
                       help="mesh of the calibrated force (default: %(default)s)")
    group.add_argument("--max-seconds", type=parse_positive_number, metavar="N", default=60.0,
                       help="longest time of the target for a position (default: %(default)g)")
    group.add_argument("--figure", type=Path, metavar="F.png", help="draw forces and errors over depth")
    add_experiment_flags(parser)


def find_export_content(arguments: Namespace, target: ExportTarget, file: MaterialFile) -> MatchOutcome:
    """Return materials, constants and remarks of an exported file, after the runs of ``--match``.

    Args:
        arguments: parsed arguments of `add_match_flags`, with ``file``, ``to`` and ``json``.
        target: target of the export.
        file: material file.

    Raises:
        InputError: flags that contradict each other, or a test that the target cannot run.
        ConvergenceError: the calibrated test did not converge.
    """
    if arguments.match is None:
        return _linearise(arguments, target, file)
    require_known_scene(arguments.match)
    _refuse_impossible_match(arguments, target)
    from calibration.targets.matching import (
        compare_in_target,
        compute_calibrated_forces,
        draw_materials,
        match_constants,
        match_draws,
    )
    from calibration.targets.runner import RUNNERS
    from tissue_sim import Model

    material = file.material
    runner = RUNNERS.find(arguments.to, "--to") if arguments.in_target else None
    if runner is not None and (missing := runner.describe_missing_program()):
        raise InputError(missing, field="--in-target")
    drawn = [] if arguments.draws is None else draw_materials(file, arguments.draws, arguments.seed)
    arguments.scene, arguments.material = arguments.match, arguments.file
    experiment = make_experiment_from_flags(arguments, make_protocol_from_flags(arguments), material)
    model = Model(experiment, material)
    options = {"resolution": arguments.resolution, "solver": _choose_solver(experiment)}
    mesh = _make_target_mesh(experiment, arguments.element_mm) if runner else None
    with display_task("simulating the calibrated test", quiet=arguments.json) as status:
        calibrated = compute_calibrated_forces(model, **options)
        if not target.uses_elastic_constants:
            assert runner is not None and mesh is not None
            compared = compare_in_target(model, calibrated, runner, mesh, report=status.update,
                                         max_seconds=arguments.max_seconds)
            return MatchOutcome((material, *drawn), remarks=_describe_test(arguments, experiment, mesh)
                                + compared.list_remarks(), mesh=mesh, comparison=compared)
        matched = match_constants(model, calibrated, target.max_poisson, runner=runner, mesh=mesh,
                                  poisson=arguments.poisson, report=status.update,
                                  **({"max_seconds": arguments.max_seconds} if runner else {}))
        variants = match_draws(model, matched, drawn, report=status.update, **options)
    warnings = () if matched.is_in_target else (
        "The constants reproduce the force of the law alone. Errors of the mesh and the contact of "
        f"{target.title} are neither compensated nor stated. Add --in-target.",)
    return MatchOutcome((material, *drawn), (matched.constants, *variants),
                        _describe_test(arguments, experiment, mesh) + matched.list_remarks(), warnings, mesh, matched)


def _linearise(arguments: Namespace, target: ExportTarget, file: MaterialFile) -> MatchOutcome:
    """Return the content of a file without ``--match``; ``--mesh`` adds the mesh for targets that write one."""
    of_mesh = ("mesh", "mesh_unit", "mesh_base", "mesh_top") if target.writes_mesh else ()
    for name in ("in_target", "poisson", "draws", "element_mm", "figure", "depth_mm", "protocol", *TOOL_FLAGS,
                 *SPECIMEN_FLAGS, *list_all_tool_sizes_by_key(), *specimen_sizes()):
        if name not in of_mesh and getattr(arguments, name) not in (None, False):
            raise InputError("requires a test. Add --match needle_indentation", field=f"--{name.replace('_', '-')}")
    if not target.uses_elastic_constants:
        return MatchOutcome((file.material,))
    from tissue_sim.exports.elastic_constants import linearise_material
    from tissue_sim.mesh.solid import Grading
    from tissue_sim.mesh.solid_element import HEX8P0

    mesh = None
    if any(getattr(arguments, name) is not None for name in of_mesh):
        # The sizes of a grading have no effect on the mesh of a file.
        mesh = make_specimen_from_flags(arguments, {}).solid_mesh(Grading(HEX8P0, 1.0, 1.0, 1.0, 1))
    warning = (f"The force error in {target.title} is not stated: the constants are those of the material at small "
               "strains. Add --match SCENE --in-target.")
    return MatchOutcome((file.material,), (linearise_material(file.material, target.max_poisson),), (warning,),
                        (warning,), mesh)


def _refuse_impossible_match(arguments: Namespace, target: ExportTarget) -> None:
    """Raise an error for a target whose constants cannot be fitted in this way.

    Raises:
        InputError: with the remedy.
    """
    from calibration.targets.runner import RUNNERS

    if arguments.in_target and arguments.to not in RUNNERS:
        raise InputError(f"tests do not run in {target.title} here. Programs that run: {', '.join(sorted(RUNNERS))}",
                         field="--in-target")
    if arguments.in_target:
        if not target.uses_elastic_constants and arguments.poisson is not None:
            raise InputError(f"has no effect for {target.title}, which has the law of the material. Leave it out",
                             field="--poisson")
        return
    if not target.uses_elastic_constants:
        raise InputError(f"has no effect for {target.title} without --in-target: its constants are exact. Add "
                         "--in-target, or leave --match out", field="--match")
    if not target.has_neo_hookean_law:
        raise InputError(f"requires --in-target for {target.title}, whose law this program does not have. Add "
                         "--in-target", field="--match")
    if arguments.element_mm is not None:
        raise InputError("requires --in-target. Add it, or leave --element-mm out", field="--element-mm")


def _choose_solver(experiment: Experiment) -> str:
    """Return the solver of the calibrated force: the axisymmetric one for upright tools on the axis of a cylinder."""
    is_axisymmetric = experiment.specimen.shape == "cylinder" and experiment.approach is None
    return "axisymmetric" if is_axisymmetric else "solid"


def _make_target_mesh(experiment: Experiment, element_mm: float | None) -> SolidMesh:
    """Return the mesh in the target, whose smallest element under the tool is given in mm; None: the default."""
    from tissue_sim.mesh.solid import Grading
    from tissue_sim.mesh.solid_element import HEX8P0

    radius = None if experiment.tool.is_plate else experiment.tool.face_radius or experiment.contact_radius
    size = radius or experiment.specimen.margin()
    offset = 0.0 if experiment.approach is None else experiment.approach.offset
    smallest = _MESH.smallest * size if element_mm is None else 1e-3 * element_mm
    return experiment.specimen.solid_mesh(Grading(HEX8P0, smallest, _MESH.growth, _MESH.largest * size, _MESH.around,
                                                  radius=radius, centre=(offset, 0.0)))


def _describe_test(arguments: Namespace, experiment: Experiment, mesh: SolidMesh | None) -> tuple[str, ...]:
    """Return sentences that state the test, its mesh and its contact."""
    tool, protocol = experiment.tool, experiment.protocol
    size = "" if tool.radius is None else f", radius {1e3 * tool.radius:g} mm"
    lines = [f"Test: {arguments.match}, {experiment.specimen.in_words}; tool: {tool.shape}{size}; interface of its "
             f"face: {experiment.friction}; to {1e3 * protocol.depth:g} mm in {protocol.time[-1]:g} s."]
    if mesh is not None:
        lines.append(f"Mesh in the target: {len(mesh.nodes)} nodes, {len(mesh.connectivity)} elements "
                     f"({mesh.element.name}); programs with linear tetrahedra only use those between the corners.")
    return tuple(lines)


def make_comparison_json_object(outcome: MatchOutcome) -> dict[str, Any]:
    """Return constants, forces and errors as a JSON object."""
    content: dict[str, Any] = {"warnings": list(outcome.warnings)}
    if outcome.constants:
        content["constants"] = [{"young_Pa": one.young, "poisson": one.poisson, "damping_time_s": one.damping_time,
                                 "density_kg_m3": one.density} for one in outcome.constants]
    compared = outcome.comparison
    if compared is not None:
        content["match"] = {
            "in_target": compared.is_in_target, "program": compared.version, "runs": compared.runs,
            "calibrated_force_error": compared.calibrated.force_error, "valid_to_mm": 1e3 * compared.deepest,
            "reaches_all_depths": compared.reaches_all_depths, "ended": compared.ended,
            "depth_mm": (1e3 * compared.depths).tolist(), "calibrated_N": compared.calibrated_forces.tolist(),
            "target_N": compared.target_forces.tolist(), "error": compared.errors.tolist()}
    return content


def print_comparison(outcome: MatchOutcome, console: Console) -> None:
    """Print constants, the forces depth by depth, and warnings."""
    if outcome.constants:
        one = outcome.constants[0]
        console.print(f"E = {one.young:.5g} Pa, nu = {one.poisson:.4g}, damping time {one.damping_time:.3g} s")
    compared = outcome.comparison
    if compared is not None:
        table = make_table_with_headings("depth mm", "calibrated N", "target N", "error %", text=0)
        for row in zip(1e3 * compared.depths, compared.calibrated_forces, compared.target_forces,
                       100.0 * compared.errors, strict=True):
            table.add_row(*(f"{value:{form}}" for value, form in zip(row, (".4g", ".4f", ".4f", "+.1f"), strict=True)))
        console.print(table)
        if not compared.reaches_all_depths:
            print_sentence(console, f"valid to {1e3 * compared.deepest:.4g} mm: {compared.version} ended "
                           f"{compared.ended}")
    for warning in outcome.warnings:
        print_sentence(console, f"warning: {warning}")
