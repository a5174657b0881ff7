"""Files of reduced solids, ``NAME.reduced.npz``: arrays and a JSON description."""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from dataclasses import fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tissue_sim.bounded import run_in_sandbox
from tissue_sim.decode import parse_json_rejecting_duplicate_keys
from tissue_sim.errors import InputError, located_and_converted_errors
from tissue_sim.experiment.experiment import Approach, Experiment
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.experiment.tools.profile import ProfileTool
from tissue_sim.experiment.tools.tool import TOOLS, Tool
from tissue_sim.fem.reduced.model import (
    ContactNodeComplianceTable,
    PoseBox,
    ReducedModel,
    SelfWeightEquilibriumFields,
    require_reducible,
)
from tissue_sim.fem.reduced.settings import VERIFICATION
from tissue_sim.fem.solid.tissue import group_elements_by_region, require_mesh_regions
from tissue_sim.files import open_input_file, write_bytes
from tissue_sim.material.file import MaterialFile, make_material_file_from_json_data
from tissue_sim.mesh.solid import SOLID_ELEMENTS, SolidMesh
from tissue_sim.mesh.solid_file import file_mesh_from_arrays, file_mesh_to_arrays
from tissue_sim.model import Model
from tissue_sim.parameters import convert_to_file_values, make_from_file_values
from tissue_sim.specimen.mesh import MeshSpecimen
from tissue_sim.specimen.specimen import Specimen, make_specimen_from_keys

#: Version of the file format.
VERSION = 1
#: Number of samples of the experiment's protocol, a ramp to the depth of the box.
POINTS = 21
_EXPECTED = "a reduced solid (.npz of `tissue-sim reduce`)"
#: Prefix of the array names of a specimen mesh that was read from a file.
_OF_FILE = "of file "
#: Names of the arrays of the equilibrium under self-weight.
_REST = ("rest displacement", "rest pressures")
#: Fields of a specimen with self-weight.
_WEIGHT = ("density", "gravity", "height_is")
#: Prefix of the array names of the compliance table.
_COMPLIANCE = "compliance "
_TABLES = tuple(each.name for each in fields(ContactNodeComplianceTable))
_FACES = ("friction", "friction_base", "friction_wall")


def write_reduced(reduced: ReducedModel, path: str | Path) -> None:
    """Write a reduced solid to a file atomically.

    Raises:
        InputError: the path cannot be written.
    """
    mesh, specimen = reduced.mesh, reduced.model.experiment.specimen
    arrays = {"nodes": mesh.nodes, "connectivity": mesh.connectivity, "basis": reduced.basis,
              "elements": reduced.elements, "shares": reduced.shares}
    arrays |= {f"set {name}": each for name, each in mesh.sets.items()}
    arrays |= {f"faces {name}": each for name, each in mesh.faces.items()}
    arrays |= {f"region {name}": each for name, each in mesh.regions.items()}
    if mesh.depths is not None:
        arrays["depths"] = mesh.depths
    if reduced.rest is not None:
        arrays |= {_REST[0]: reduced.rest.displacement, _REST[1]: reduced.rest.pressures}
    if (table := reduced.compliance) is not None:
        arrays |= {f"{_COMPLIANCE}{name}": getattr(table, name) for name in _TABLES}
    if isinstance(specimen, MeshSpecimen):
        arrays |= {f"{_OF_FILE}{name}": each for name, each in file_mesh_to_arrays(specimen.loaded_file_mesh).items()}
    stream = io.BytesIO()
    named: dict[str, Any] = {"description": np.array(json.dumps(_describe_reduced_solid(reduced))), **arrays}
    np.savez_compressed(stream, **named)
    write_bytes(path, stream.getvalue())


def _describe_reduced_solid(reduced: ReducedModel) -> dict[str, Any]:
    """Return the JSON description of a reduced solid: everything except the arrays."""
    experiment = reduced.model.experiment
    specimen, tool, box = experiment.specimen, experiment.tool, reduced.box
    require_reducible(reduced.model)
    return {
        "schema": "tissue_sim.reduced", "version": VERSION, "element": reduced.mesh.element.name,
        "lifting": reduced.lifting, "softness": reduced.softness,
        "bulk_ratio": reduced.bulk_ratio, "watched": reduced.watched, "error_factors": reduced.error_factors,
        "report": reduced.report,
        "box": {"sideways": box.sideways, "depth": box.depth, "turn": box.turn},
        "material": msgspec.to_builtins(MaterialFile.of(reduced.model.material)),
        "experiment": {
            "specimen": {"shape": specimen.shape, "name": specimen.name, **_describe_specimen(specimen)},
            **({"weight": {name: getattr(specimen, name) for name in _WEIGHT}} if specimen.specific_weight else {}),
            "tool": {"shape": tool.shape, **_describe_tool(tool)},
            "approach": None if experiment.approach is None else convert_to_file_values(experiment.approach),
            **{name: getattr(experiment, name) for name in _FACES}}}


def _describe_specimen(specimen: Specimen) -> dict[str, Any]:
    """Return the keys from which `_make_experiment` makes the specimen, without the arrays of its mesh."""
    if not isinstance(specimen, MeshSpecimen):
        return dict(specimen.values_by_file_key)
    mesh = specimen.loaded_file_mesh
    return {**specimen.values_by_file_key, "mesh": Path(specimen.mesh_file).name, "kind": mesh.cells.kind,
            "digest": mesh.digest}


def _describe_tool(tool: Tool) -> dict[str, Any]:
    """Return the keys from which `_make_experiment` makes the tool."""
    if not isinstance(tool, ProfileTool):
        return dict(convert_to_file_values(tool))
    return {**convert_to_file_values(tool), "profile": Path(tool.profile_file or "").name,
            "points": tool.outline.tolist()}


def load_reduced(path: str | Path) -> ReducedModel:
    """Read a reduced solid and check it.

    Raises:
        InputError: the file is damaged, has another format or version, or contains inconsistent arrays.
    """
    path = Path(path)
    with open_input_file(path, _EXPECTED):
        pass
    description, arrays = run_in_sandbox(_read_unchecked_description_and_arrays, str(path), file=path)
    with located_and_converted_errors(file=path):
        return _build_checked_model(description, arrays)


def _read_unchecked_description_and_arrays(path: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the JSON description and the arrays of a file by their names, unchecked."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        return parse_json_rejecting_duplicate_keys(str(arrays.pop("description"))), arrays
    except (ValueError, KeyError, OSError, EOFError, AttributeError, zipfile.BadZipFile, zlib.error):
        raise InputError(f"must be {_EXPECTED}; the file is damaged or has another format. Make it again with "
                         "`tissue-sim reduce`", file=path) from None


def _build_checked_model(description: dict[str, Any], arrays: dict[str, np.ndarray]) -> ReducedModel:
    """Check description and arrays of a file, and make the reduced solid; InputError if they are inconsistent."""
    try:
        if description["schema"] != "tissue_sim.reduced":
            raise KeyError("schema")
        if description["version"] != VERSION:
            raise InputError(f"must be {VERSION}, the version that this program reads; got {description['version']}. "
                             "Make the file again with `tissue-sim reduce`", field="version")
        element = SOLID_ELEMENTS[description["element"]]
        nodes, connectivity, basis = arrays["nodes"], arrays["connectivity"], arrays["basis"]
        elements, shares = arrays["elements"], arrays["shares"]
        sets, faces, regions, of_file, tables = (
            {name.removeprefix(kind): each for name, each in arrays.items() if name.startswith(kind)}
            for kind in ("set ", "faces ", "region ", _OF_FILE, _COMPLIANCE))
        # Files of older versions have no compliance table.
        compliance = ContactNodeComplianceTable(**tables) if tables else None
        depths, rest = arrays.get("depths"), tuple(arrays[name] for name in _REST if name in arrays)
        lifting, report = description["lifting"], description["report"]
        softness, bulk_ratio = float(description["softness"]), float(description["bulk_ratio"])
        # Files of older versions have no error estimate.
        watched, (changed, own, *lateral) = description.get("watched", 0), description.get("error_factors", (1.0, 0.0))
        # Files of older versions have no lateral factor. A tool without friction ignores the factor.
        error_factors = float(changed), float(own), float(lateral[0] if lateral else VERIFICATION.absent_lateral_factor)
        box = PoseBox(**description["box"])
        material = make_material_file_from_json_data(description["material"]).material
        experiment = _make_experiment(description["experiment"], box, of_file)
        require_reducible(Model(experiment, material))
        require_mesh_regions(material, SolidMesh(element, nodes, connectivity, regions=regions))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"must be {_EXPECTED}; an entry is missing or has another type ({error}). Make the file "
                         "again with `tissue-sim reduce`") from None
    numbers = (connectivity, elements, *sets.values(), *faces.values(), *regions.values())
    reals = (nodes, basis, shares, *rest, *(() if depths is None else (depths,)))
    shapes = () if not experiment.specimen.specific_weight else (
        (nodes.size,), (len(connectivity), element.pressure_modes))
    fits = (all(each.dtype.kind == "f" for each in reals) and (lifting == 12) == (experiment.friction == "bonded")
            and all(each.dtype.kind in "iu" and each.size for each in numbers) and nodes.ndim == connectivity.ndim == 2
            and nodes.shape[1] == 3 and connectivity.shape[1] == element.node_count
            and all(each.min() >= 0 and each.max() < len(nodes)
                    for each in (connectivity, *sets.values(), *faces.values()))
            and all(each.ndim == 1 and each.min() >= 0 and each.max() < len(connectivity)
                    for each in (elements, *regions.values()))
            and (depths is None or depths.shape == (len(connectivity),))
            and tuple(each.shape for each in rest) == shapes
            and basis.ndim == 2 and len(basis) == nodes.size and elements.shape == shares.shape
            and lifting in (0, 12) and isinstance(watched, int) and 0 <= watched < basis.shape[1] - lifting
            and all(0.0 <= factor < math.inf for factor in error_factors)
            and {"top", "base", "side", "face", "free"} <= sets.keys()
            and all(np.isfinite(each).all() for each in reals) and bool((shares > 0.0).all())
            and 0.0 < softness < 1.0 and bulk_ratio >= 1.0 and isinstance(report, dict))
    if not (fits and (compliance is None or (lifting == 0 and _is_consistent_table(compliance, len(nodes))))):
        raise InputError("must contain arrays whose shapes, types and values agree with each other. Make the file "
                         "again with `tissue-sim reduce`")
    sets, faces, regions = ({name: each.astype(np.intp) for name, each in group.items()}
                            for group in (sets, faces, regions))
    mesh = SolidMesh(element, nodes, connectivity.astype(np.intp), sets, faces, regions, depths)
    group_elements_by_region(mesh)
    return ReducedModel(Model(experiment, material), mesh, basis, lifting, elements.astype(np.intp), shares, box,
                        softness, bulk_ratio, report, watched, error_factors,
                        SelfWeightEquilibriumFields(*rest) if rest else None, compliance)


def _is_consistent_table(table: ContactNodeComplianceTable, nodes: int) -> bool:
    """Whether shapes and values of a compliance table agree with each other and with the number of nodes."""
    count = table.nodes.size
    reals = (table.axis, table.whole, table.missing, table.forces, table.accepted)
    return (table.nodes.dtype.kind in "iu" and table.nodes.shape == (count,) and count > 0
            and bool((np.diff(table.nodes) > 0).all()) and table.nodes[0] >= 0 and table.nodes[-1] < nodes
            and all(each.dtype.kind == "f" and np.isfinite(each).all() for each in reals)
            and table.axis.shape == (3,) and table.whole.shape == table.missing.shape == (count, count)
            and table.forces.ndim == 1 and table.forces.size > 0 and table.forces.shape == table.accepted.shape
            and bool((np.diff(table.forces) >= 0.0).all()) and bool((table.accepted >= 0.0).all())
            and np.linalg.eigvalsh(table.whole)[0] > 0.0)


def _make_experiment(stated: dict[str, Any], box: PoseBox, of_file: dict[str, np.ndarray]) -> Experiment:
    """Make the experiment from its description in the file and the arrays of a specimen mesh that was read."""
    specimen, tool = dict(stated["specimen"]), dict(stated["tool"])
    shape, name, kind = specimen.pop("shape"), specimen.pop("name"), TOOLS.find(tool.pop("shape"), field="tool.shape")
    more: dict[str, Any] = {name: stated["weight"][name] for name in (_WEIGHT if "weight" in stated else ())}
    if of_file:
        more["content"] = file_mesh_from_arrays(of_file, specimen.pop("kind"), str(specimen.pop("digest")))
    outline = {} if "points" not in tool else {
        "points": tuple((float(r), float(z)) for r, z in tool.pop("points")), "profile_file": tool.pop("profile")}
    return Experiment(
        make_specimen_from_keys(shape, specimen, name=name, **more), Protocol.ramp(box.depth, points=POINTS),
        make_from_file_values(kind, tool, "tool", **outline), **{face: stated[face] for face in _FACES},
        approach=(None if stated["approach"] is None
                  else make_from_file_values(Approach, stated["approach"], "approach")))
