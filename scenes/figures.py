"""Pictures of simulations: the deformed tissue coloured by a field, beside the force curve."""

from __future__ import annotations

import io
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from calibration.report.png import as_png
from scenes.colour_scale import colour_scale
from scenes.field_labels import LABELS
from scenes.solid_figures import RIGID, draw_cut, draw_surface, finish, tool_pose
from tissue_sim.atomic_write import write_bytes
from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.fem.axisymmetric.fields import Fields
from tissue_sim.fem.solid.fields import SolidFields
from tissue_sim.mesh import Mesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose
from tissue_sim.recording.recording import Recording

#: Forces across the axis below this share of that along it are not drawn.
_ASIDE = 0.01


def draw_simulation(recording: Recording, model: Model, path: Path, field: str = "von_mises", *,
                    segment: str | None = None, reference: Recording | None = None) -> None:
    """Draw the section at the deepest sample, and force against displacement, into an image file.

    A needle gets a third panel: the fold of the tissue at its edge. A solid in space is cut through the plane of the
    tool, and shown from above. A ring on the curve tells the sample that is drawn.

    Args:
        recording: of `simulate(..., fields=True)`.
        model: what was simulated.
        path: .png, .svg or .pdf.
        field: a name in `LABELS`.
        segment: draw the last sample of this segment instead.
        reference: another force curve to draw beside it, under its name.

    Raises:
        InputError: unknown field, a recording without fields or without this segment.
    """
    from matplotlib.figure import Figure

    if field not in LABELS:
        raise InputError(f"unknown field {field!r}; known: {', '.join(LABELS)}", field="field")
    if recording.fields is None:
        raise InputError("this recording carries no fields; simulate with fields=True", field="fields")
    sample = _drawn_sample(recording, segment)
    tool, fields = model.experiment.tool, recording.fields
    figure = Figure(layout="constrained")
    if fields.mesh.nodes.shape[1] == 3:
        axes = _draw_solid(figure, fields, field, sample, model.experiment.tool_pose(recording.displacement[sample]),
                           tool)
    else:
        axes = _draw_axisymmetric(figure, fields, field, sample, tool)
    curve = axes["curve"]
    if reference is not None:
        curve.plot(reference.displacement * 1e3, reference.force, color="0.25", linewidth=1, label=reference.name)
    depth = recording.displacement[sample] * 1e3
    across = {name: recording.channel(f"F{name}") for name in "xy" if f"F{name}" in recording}
    for (name, force), dashes in zip(across.items(), ("--", ":"), strict=False):
        if abs(force).max() > _ASIDE * abs(recording.force).max():
            curve.plot(recording.displacement * 1e3, force, color="#0072B2", linestyle=dashes, label=f"along {name}")
    curve.plot(recording.displacement * 1e3, recording.force, color="#0072B2", marker="o", markersize=3,
               linestyle="none" if reference else "-", label="simulated" if reference else "along the tool")
    if len(curve.lines) > 1:
        curve.legend(frameon=False)
    curve.plot(depth, recording.force[sample], color="#D55E00", marker="o", markersize=8, fillstyle="none")
    curve.set_xlabel("displacement [mm]")
    curve.set_ylabel("force [N]")
    curve.set_xlim(left=min(0.0, recording.displacement.min() * 1e3))
    curve.grid(alpha=0.3)
    curve.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{model.material.energy_law.title}: {recording.force[sample]:.4g} N at {depth:.3g} mm")
    warnings = recording.metadata.get("solver", {}).get("warnings", [])
    if warnings:
        curve.set_title("\n".join(textwrap.wrap("; ".join(warnings), 60)), fontsize=8, color="#a33c00")
    save(figure, path)


def _draw_solid(figure, fields: SolidFields, field: str, sample: int, pose: Pose, tool: Tool) -> dict[str, Any]:
    """A cut through the plane of the tool, and the surface."""
    place = tool_pose(fields, sample, pose, tool)
    figure.set_size_inches(14.5, 4.8)
    axes = figure.subplot_mosaic([["cut", "surface", "curve"]], width_ratios=[1.25, 1.1, 0.85])
    draw_cut(axes["cut"], fields, field, sample, place, tool)
    draw_surface(axes["surface"], fields, field, sample, place, tool)
    return axes


def _draw_axisymmetric(figure, fields: Fields, field: str, sample: int, tool: Tool) -> dict[str, Any]:
    """The section, and of a needle the fold."""
    panels = {"section": 1.25} | ({"fold": 0.75} if not tool.is_plate else {}) | {"curve": 1.0}
    radius, height = fields.mesh.nodes[:, 0].max(), np.ptp(fields.mesh.nodes[:, 1])
    if radius > 1.5 * height:
        figure.set_size_inches(10, 6.4)
        layout: list[Any] = [["section"] * (len(panels) - 1), list(panels)[1:]]
        axes = figure.subplot_mosaic(layout, height_ratios=[1, 1.6])
    else:
        figure.set_size_inches(10 if tool.is_plate else 13, 4.6)
        axes = figure.subplot_mosaic([list(panels)], width_ratios=list(panels.values()))
    draw_section(axes["section"], fields, field, sample, tool=tool)
    if "fold" in axes:
        draw_fold(axes["fold"], fields, field, tool, sample)
    return axes


def _drawn_sample(recording: Recording, segment: str | None) -> int:
    if segment is None:
        return int(np.argmax(recording.displacement))
    of_it = np.flatnonzero(recording.labels.get("segment", np.empty(0, str)) == segment)
    if not of_it.size:
        known = ", ".join(np.unique(recording.labels["segment"])) if "segment" in recording.labels else "none"
        raise InputError(f"this recording has no segment {segment!r}; it has: {known}", field="segment")
    return int(of_it[-1])


def draw_section(axes, fields: Fields, name: str, sample: int = -1, *, tool: Tool) -> None:
    """The whole deformed section, mirrored at the axis, with the undeformed outline, the element edges and the tool.

    The ends of the colour scale leave out 1 % of the volume at either side, where edges are singular.
    """
    mesh = fields.mesh
    place = (mesh.nodes + fields.displacement(sample)) * 1e3
    picture, scale = _paint(axes, fields, name, sample, (1, -1))
    radius, height = mesh.nodes[:, 0].max() * 1e3, -mesh.nodes[:, 1].min() * 1e3
    axes.plot(radius * np.array([-1, 1, 1, -1, -1]), height * np.array([-1, -1, 0, 0, -1]), color="0.4", linewidth=0.9,
              linestyle=(0, (4, 3)))
    width = 1.18 * max(radius, place[:, 0].max())
    base, plate = place[:, 1][mesh.sets["base"]].min(), 0.05 * max(height, 0.5 * radius)
    axes.fill_between([-width, width], base, base - plate, color=RIGID, linewidth=0)
    if tool.is_plate:
        tip = _contact_height(mesh, place, tool)
        axes.fill_between([-width, width], tip, tip + plate, color=RIGID, linewidth=0)
    else:
        _draw_needle(axes, mesh, place, tool, max(place[:, 1].max(), 0.0) + plate)
    finish(axes, "r [mm]")
    axes.figure.colorbar(picture, ax=axes, label=scale.label, extend=scale.extend, shrink=0.85)


def draw_fold(axes, fields: Fields, name: str, tool: Tool, sample: int = -1) -> None:
    """The surroundings of a needle's edge, where the free surface folds onto the shaft, or of its tip where it has no
    flat face, in the colours of `draw_section`."""
    mesh = fields.mesh
    place = (mesh.nodes + fields.displacement(sample)) * 1e3
    _paint(axes, fields, name, sample, (1,))
    radius, tip = tool.require_radius() * 1e3, _contact_height(mesh, place, tool)
    top = max(place[mesh.sets["top"], 1].max(), tip) + 0.3 * radius
    _draw_needle(axes, mesh, place, tool, top + radius)
    top_nodes = mesh.sets["top"][np.argsort(mesh.nodes[mesh.sets["top"], 0])]
    axes.plot(*place[top_nodes].T, color="0.15", linewidth=1.1)
    part, nearest, below = ("edge", 0.45, 0.7) if tool.face_radius else ("tip", 0.0, 0.4)
    axes.set_xlim(nearest * radius, (nearest + 1.75) * radius)
    axes.set_ylim(tip - below * radius, top)
    finish(axes, "r [mm]")
    axes.set_title(f"at the {part} of the tool", loc="left", fontsize=10)


def _paint(axes, fields: Fields, name: str, sample: int, sides: tuple[int, ...]):
    """Colour the section on these sides of the axis; the picture, and its scale."""
    from matplotlib.collections import LineCollection
    from matplotlib.tri import Triangulation

    _, factor = LABELS[name]
    mesh, scale = fields.mesh, colour_scale(fields, name, sample)
    place = (mesh.nodes + fields.displacement(sample)) * 1e3
    values = fields.at_nodes(name, sample) * factor
    triangles = _triangles(mesh)
    edges = _outlines(mesh, place)
    for mirror in sides:
        side = np.array([mirror, 1])
        x, y = (place * side).T
        picture = axes.tripcolor(Triangulation(x, y, triangles), values, shading="gouraud", cmap="viridis",
                                 vmin=scale.low, vmax=scale.high)
        picture.set_in_layout(False)  # it stays inside the frame; its size is asked of each triangle
        thickness = min(0.35, 6.0 / np.sqrt(len(edges)))
        axes.add_collection(LineCollection(edges * side, colors="white", linewidths=thickness, alpha=0.5))
    return picture, scale


def _draw_needle(axes, mesh: Mesh, place: np.ndarray, tool: Tool, top: float) -> None:
    """A needle's outline from where it touches up to `top`, mm."""
    tip = _contact_height(mesh, place, tool)
    r, z = (tool.profile.outline((top - tip) * 1e-3) * 1e3).T
    axes.fill(np.concatenate([r, -r[::-1]]), tip + np.concatenate([z, z[::-1]]), color=RIGID, edgecolor="0.4",
              linewidth=0.6)


def _contact_height(mesh: Mesh, place: np.ndarray, tool: Tool) -> float:
    """Height of the tool's flat face, mm: tissue below it reaches up to it, and none is above."""
    surface = place[mesh.sets["top"]]
    # Not quite to the rim: tissue that leans on the shaft may enter it by the tolerance of the contact.
    below = surface[:, 0] <= (np.inf if tool.face_radius is None else 0.999e3 * tool.face_radius)
    return float(surface[below, 1].max())


def save(figure, path: Path) -> None:
    """Write a figure whole or not at all; the format is that of the file's ending."""
    kind = Path(path).suffix.lstrip(".").lower() or "png"
    if kind == "png":
        write_bytes(Path(path), as_png(figure))
        return
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=150)
    write_bytes(Path(path), buffer.getvalue())


def _triangles(mesh: Mesh) -> np.ndarray:
    """Every element as the triangles between its nodes."""
    square = [(0, 1, 2), (0, 2, 3)]
    nine = [(0, 4, 8), (0, 8, 7), (4, 1, 5), (4, 5, 8), (8, 5, 2), (8, 2, 6), (7, 8, 6), (7, 6, 3)]
    return np.concatenate([mesh.connectivity[:, list(corners)]
                           for corners in (square if mesh.element.order == 1 else nine)])


def _outlines(mesh: Mesh, place: np.ndarray) -> np.ndarray:
    """Element edges as polylines, shape (elements, points, 2)."""
    ring = [0, 1, 2, 3, 0] if mesh.element.order == 1 else [0, 4, 1, 5, 2, 6, 3, 7, 0]
    return place[mesh.connectivity[:, ring]]
