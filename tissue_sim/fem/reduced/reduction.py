"""A solid reduced from its model to its file, stroke by stroke, so that what was killed goes on where it was."""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from tissue_sim.atomic_write import write_bytes
from tissue_sim.errors import InputError, located
from tissue_sim.fem.reduced import training
from tissue_sim.fem.reduced.acceptance import with_compliance
from tissue_sim.fem.reduced.model import PoseBox, ReducedModel, require_reducible, require_same_parts
from tissue_sim.fem.reduced.strokes import boundary_strokes, stroke
from tissue_sim.fem.reduced.symmetry import symmetries
from tissue_sim.files import read_text
from tissue_sim.material.material import Material
from tissue_sim.model import Model

#: Strokes without images, and modes, of a tool that holds tissue and of one that touches it.
STROKES, MODES = {True: 24, False: 60}, {True: 24, False: 64}
#: Largest bulk modulus over mu0, of a tool that presses the same nodes all the time, and of one that slides: its modes
#: change the tissue's volume more.
BULK_RATIO = {True: 300.0, False: 50.0}
#: The smallest and the largest that may be asked for: with stiffer ones steps find no equilibrium.
BULK_RATIOS = (1.0, 1000.0)
#: Error of the sampled forces, share of the contact's reach by which the layer gives way, and unseen strokes on which
#: the result is tried.
SAMPLING, SOFTNESS, TRIED = 6e-3, 1e-3, 3
#: So many times fewer strokes at most do where each has images; what a tool that rubs does depends on its way, too.
_SPARED = {True: 4, False: 2}
#: Number of the first stroke along the boundary of the box, after those of any sequence.
_BOUNDARY = 8000
#: Fraction of the box along whose boundary the result is tried.
_UNSEEN_FRACTION = 0.93


class Progress(Protocol):
    """Who is told how far a reduction is."""

    def __call__(self, stage: str, done: int, of: int, *, note: str = "") -> None:
        """`done` of `of` parts of a stage are done."""


def reduce_solid(model: Model, box: PoseBox, *, resolution: str = "realtime", strokes: int | None = None,
                 modes: int | None = None, sampling: float = SAMPLING, bulk_ratio: float | None = None,
                 softness: float = SOFTNESS, also: Sequence[Material] = (), tried: int = TRIED,
                 folder: Path | None = None,
                 progress: Progress | None = None) -> ReducedModel:
    """Make a solid that is stepped a thousand times a second for a tool that stays in a box.

    Args:
        model: experiment and material.
        box: of poses, beside the first one of the experiment's approach.
        resolution: of the whole solid.
        strokes: motions on which the whole solid is followed, those of all materials together; each counts with its
            images by the symmetries of the solid under its tool.
        modes: motions of the tissue that are kept.
        sampling: error of the forces of the sampled elements.
        bulk_ratio: most that the bulk modulus may be, over mu0. A softer one than the tissue's makes forces too small,
            a stiffer one than what the modes can represent too large.
        softness: see `ReducedModel`.
        also: materials that may be put under it and that it shall be good for, too; strokes are followed with each in
            turn. Layers and regions are those of the model's.
        tried: strokes that it was not made of, on which it is tried; at least one with each material.
        folder: where the strokes are kept; one that holds strokes of the same model is gone on with. `forget_strokes`
            removes them, when what was made of them is safe.
        progress: told of the stages ``"strokes"``, ``"elements"`` and ``"trial"``.

    Raises:
        InputError: what a reduced solid does not take, a bulk modulus outside of `BULK_RATIOS`, or a folder of another
            model.
        ConvergenceError: the whole solid did not come through a stroke.
    """
    experiment = model.experiment
    holds = experiment.friction == "bonded"
    slides = not holds and box.sideways + box.turn > 0.0
    bulk_ratio = BULK_RATIO[not slides] if bulk_ratio is None else bulk_ratio
    low, high = BULK_RATIOS
    if not low <= bulk_ratio <= high:
        raise InputError(f"{bulk_ratio:g} is no bulk modulus over mu0 of a reduced solid; give {low:g} to {high:g}",
                         field="bulk_ratio")
    tell: Callable[..., None] = progress or (lambda *_, **__: None)
    require_reducible(model)
    mesh = training.training_mesh(model, box, resolution)
    solver = training.whole_solver(model, mesh)
    memory = training.settled_memory(solver)
    if also and experiment.specimen.specific_weight:
        raise InputError("a solid that weighs stands as its own material lets it, and is of one material; leave the "
                         "others out, or gravity", field="also")
    materials = (model.material, *also)
    for number, each in enumerate(also):
        with located(field=f"also[{number}]"):
            require_same_parts(each, model.material, mesh)
            solver.set_material(each)
    solver.set_material(model.material)
    # Before the folder is labelled, which would refuse what is asked for next.
    if strokes is not None and strokes < len(materials):
        raise InputError(f"{strokes} strokes are too few for {len(materials)} materials, each of which is followed on "
                         "some; give more strokes", field="strokes")
    # Files may have changed under their names.
    digests = f" {experiment.specimen.digest}" if experiment.specimen.from_file else ""
    if experiment.tool.from_file:
        digests += f" {hashlib.sha256(experiment.tool.profile.vertices.tobytes()).hexdigest()}"
    label = f"{model!r} {box!r} {resolution} {len(mesh.nodes)}{digests} from {solver.datum:.12g} m"
    store = _Store(folder, f"{label} {tuple(also)!r}" if also else label)
    start, reach = experiment.tool_pose(0.0), experiment.contact_radius
    group = symmetries(solver, start)
    usual = len(materials) * math.ceil(STROKES[holds] / min(len(group), _SPARED[holds]))
    strokes, modes, tried = strokes or usual, modes or MODES[holds], max(tried, len(materials))
    images = [each.matrix for each in group]
    poses = [stroke(number, box, start, holds=holds, reach=reach) for number in range(strokes)]
    poses += boundary_strokes(box, start, holds=holds, reach=reach, images=images)
    taken, count = [], len(poses)
    numbers = [*range(strokes), *range(_BOUNDARY, _BOUNDARY + count - strokes)]
    # The material of each stroke: each in turn, in the box and along its boundary.
    of_stroke = [materials[number % len(materials)] for number in numbers]
    tell("strokes", 0, count)
    for number, way, material in zip(numbers, poses, of_stroke, strict=True):
        done = store.read(number)
        if done is None or len(done.wrenches) != len(way):
            solver.set_material(material)
            done = training.snapshots(solver, way, memory=memory)
            store.write(number, done)
        taken.append(done)
        tell("strokes", len(taken), count)
    elements_of_all = len(mesh.connectivity)
    reduced = training.assemble(
        model, mesh, box, taken, poses, count=modes, tolerance=sampling, softness=softness,
        bulk_ratio=bulk_ratio, group=group, materials=of_stroke,
        progress=lambda elements, error: tell("elements", elements, elements_of_all,
                                              note=f"error {100 * error:.2g} %"))
    solver.set_material(model.material)
    reduced = with_compliance(reduced, solver, poses, taken, of_stroke)
    unseen = [stroke(training.UNSEEN + number, box, start, holds=holds, reach=reach) for number in range(tried)]
    along = boundary_strokes(box, start, holds=holds, reach=reach, images=images, fraction=_UNSEEN_FRACTION)
    unseen += along[:: max(1, len(along) // 2)]  # a corner and an edge
    report, factors = training.verify(reduced, solver, unseen, lambda done, of: tell("trial", done, of),
                                      materials=materials, memory=memory)
    return training.with_report(reduced, factors, strokes=strokes, boundary_strokes=count - strokes,
                                materials=len(materials), tried=tried, **report)


class _Store:
    """Strokes that are done, a file each; of one model."""

    def __init__(self, folder: Path | None, model: str):
        self._folder = folder
        if folder is None:
            return
        label = folder / "model.txt"
        if label.exists() and read_text(label, "the model of strokes") != model:
            raise InputError("holds strokes of another model; remove it, or choose another output", file=folder)
        write_bytes(label, model.encode())

    def read(self, number: int) -> training.Snapshots | None:
        path = self._path(number)
        if path is None or not path.exists():
            return None
        try:
            with np.load(path, allow_pickle=False) as stored:
                return training.Snapshots(stored["displacements"], stored["wrenches"])
        except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile, zlib.error):
            return None  # a file that is none of ours is made again

    def write(self, number: int, snapshots: training.Snapshots) -> None:
        path = self._path(number)
        if path is not None:
            stream = io.BytesIO()
            np.savez(stream, displacements=snapshots.displacements, wrenches=snapshots.wrenches)
            write_bytes(path, stream.getvalue())

    def _path(self, number: int) -> Path | None:
        return None if self._folder is None else self._folder / f"stroke_{number:04d}.npz"


def forget_strokes(folder: Path) -> None:
    """Remove the strokes that `reduce_solid` has kept in a folder, and the folder where nothing else is in it."""
    for path in [*folder.glob("stroke_*.npz"), folder / "model.txt"]:
        path.unlink(missing_ok=True)
    if folder.exists() and not any(folder.iterdir()):
        folder.rmdir()
