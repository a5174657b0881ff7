"""Figures of simulations: the deformed tissue coloured by a field, and force against displacement."""

from __future__ import annotations

import io
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from calibration.report.png import render_png
from calibration.targets.matching import MatchedConstants, TargetComparison
from scenes.colour_scale import choose_colour_scale
from scenes.field_labels import LABELS
from scenes.solid_figures import (
    RIGID,
    choose_drawn_tool_pose,
    draw_deformed_surface,
    draw_section_through_tool_axis,
    set_axis_scales_and_labels,
)
from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.fem.result_views import DrawableFields, HalfSectionGeometry, SolidGeometry, get_drawable_fields_or_none
from tissue_sim.files import write_bytes
from tissue_sim.model import Model
from tissue_sim.pose import Pose
from tissue_sim.recording.curve_units import UNITS_OF_LOAD
from tissue_sim.recording.recording import Recording

#: Lateral forces below this fraction of the axial force are not drawn.
_LEAST_LATERAL_FORCE = 0.01


def draw_simulation(recording: Recording, model: Model, path: Path, field: str | None = None, *,
                    segment: str | None = None, reference: Recording | None = None) -> None:
    """Draw the deformed section and force against displacement into an image file.

    An axisymmetric indentation has a third panel, the surface fold at the edge of the tool. A three-dimensional
    simulation shows a section through the axis of the tool and a view of the surface. With a prescribed force the
    displacement is also drawn against time. A ring on the curves marks the sample that is drawn.

    Args:
        recording: result of `simulate(..., fields=True)`.
        model: simulated model.
        path: image file; its suffix .png, .svg or .pdf selects the format.
        field: field of the colours, a key of `LABELS`; None: the first one of `LABELS` that the solver computes.
        segment: name of a segment of the protocol whose last sample is drawn; None draws the deepest sample.
        reference: second force curve for comparison, labelled with its name.

    Raises:
        InputError: the field is unknown or not computed, the recording has no fields that can be drawn, or no such
            segment.
    """
    from matplotlib.figure import Figure

    if field is not None and field not in LABELS:
        raise InputError(f"unknown field {field!r}; known: {', '.join(LABELS)}", field="field")
    if recording.fields is None:
        raise InputError("the recording has no fields. Simulate with fields=True", field="fields")
    motion, load_name = model.experiment.channels
    units = UNITS_OF_LOAD[load_name]
    displacement, force = (recording.channel(name) * factor for name, factor in (
        (motion, units.motion_factor), (load_name, units.load_factor)))
    sample = _find_segment_end_or_deepest_sample(recording, segment, displacement)
    tool, fields = model.experiment.tool, get_drawable_fields_or_none(recording.fields)
    if fields is None:
        raise InputError("the fields of this solver have no geometry and cannot be drawn", field="fields")
    names = [name for name in LABELS if name in fields.names]
    if field is None and names:
        field = names[0]
    if field is None or field not in names:
        raise InputError(f"the solver does not compute {field or 'a known field'}; it computes "
                         f"{', '.join(fields.names)}", field="field")
    figure = Figure(layout="constrained")
    curves = ("curve", "time") if model.experiment.protocol.uses_force_control else ("curve",)
    if isinstance(fields.geometry(), SolidGeometry):
        axes = _draw_solid_panels_and_get_axes(figure, fields, field, sample,
                                               model.experiment.tool_pose(recording.channel(motion)[sample]),
                                               tool, curves)
    else:
        axes = _draw_axisymmetric_panels_and_get_axes(figure, fields, field, sample, tool, curves)
    curve = axes["curve"]
    if "time" in axes:
        _draw_displacement_against_time(axes["time"], recording, sample)
    if reference is not None:
        curve.plot(reference.displacement * 1e3, reference.force, color="0.25", linewidth=1, label=reference.name)
    depth = displacement[sample]
    # Components of the force normal to the motion; of a torque none is drawn.
    axis = (0.0, 0.0, 1.0) if model.experiment.grip is None else model.experiment.grip.axis
    lateral = {name: recording.channel(f"F{name}") for name, part in zip("xyz", axis, strict=True)
               if not part and f"F{name}" in recording and load_name == "force"}
    for (name, aside), dashes in zip(lateral.items(), ("--", ":"), strict=False):
        if abs(aside).max() > _LEAST_LATERAL_FORCE * abs(force).max():
            curve.plot(displacement, aside, color="#0072B2", linestyle=dashes, label=f"along {name}")
    curve.plot(displacement, force, color="#0072B2", marker="o", markersize=3,
               linestyle="none" if reference else "-", label="simulated" if reference else "along the motion")
    if len(curve.lines) > 1:
        curve.legend(frameon=False)
    curve.plot(depth, force[sample], color="#D55E00", marker="o", markersize=8, fillstyle="none")
    curve.set_xlabel(units.motion_label)
    curve.set_ylabel(units.load_label)
    curve.set_xlim(left=min(0.0, displacement.min()))
    curve.grid(alpha=0.3)
    curve.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{model.material.energy_law.title}: {force[sample]:.4g} {units.load_unit} at "
                    f"{depth:.3g}{units.motion_unit}")
    warnings = recording.metadata.get("solver", {}).get("warnings", [])
    if warnings:
        curve.set_title("\n".join(textwrap.wrap("; ".join(warnings), 60)), fontsize=8, color="#a33c00")
    write_figure_file(figure, path)


def _draw_solid_panels_and_get_axes(figure, fields: DrawableFields, field: str, sample: int, pose: Pose,
                                    tool: Tool, curves: tuple[str, ...]) -> dict[str, Any]:
    """Draw section and surface of a three-dimensional simulation.

    Returns:
        Axes by name; the axes of `curves` are still empty.
    """
    pose = choose_drawn_tool_pose(fields, sample, pose, tool)
    figure.set_size_inches(14.5, 4.8)
    axes = figure.subplot_mosaic([["cut", "surface", _stack_in_one_column(curves)]], width_ratios=[1.25, 1.1, 0.85])
    draw_section_through_tool_axis(axes["cut"], fields, field, sample, pose, tool)
    draw_deformed_surface(axes["surface"], fields, field, sample, pose, tool)
    return axes


def _draw_axisymmetric_panels_and_get_axes(figure, fields: DrawableFields, field: str,
                                           sample: int, tool: Tool, curves: tuple[str, ...]) -> dict[str, Any]:
    """Draw the section of an axisymmetric simulation and, for an indentation, the fold at the tool's edge.

    Returns:
        Axes by name; the axes of `curves` are still empty.
    """
    panels = {"section": 1.25} | ({"fold": 0.75} if not tool.is_plate else {})
    radius, height = np.ptp(fields.geometry().nodes, axis=0)
    if radius > 1.5 * height:
        figure.set_size_inches(10, 6.4)
        layout: list[Any] = [["section"] * (len(panels) - 1 + len(curves)), [*list(panels)[1:], *curves]]
        axes = figure.subplot_mosaic(layout, height_ratios=[1, 1.6])
    else:
        figure.set_size_inches(10 if tool.is_plate else 13, 4.6)
        axes = figure.subplot_mosaic([[*panels, _stack_in_one_column(curves)]], width_ratios=[*panels.values(), 1.0])
    draw_section(axes["section"], fields, field, sample, tool=tool)
    if "fold" in axes:
        draw_tool_edge_closeup(axes["fold"], fields, field, tool, sample)
    return axes


def _stack_in_one_column(names: tuple[str, ...]) -> Any:
    """Return the cell of a mosaic with axes one below the other."""
    return [[name] for name in names] if len(names) > 1 else names[0]


def _draw_displacement_against_time(axes, recording: Recording, sample: int) -> None:
    """Draw the displacement against time, with a ring at the drawn sample."""
    displacement = recording.displacement * 1e3
    axes.plot(recording.time, displacement, color="#0072B2", marker="o", markersize=3)
    axes.plot(recording.time[sample], displacement[sample], color="#D55E00", marker="o", markersize=8, fillstyle="none")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("displacement [mm]")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def _find_segment_end_or_deepest_sample(recording: Recording, segment: str | None, displacement: np.ndarray) -> int:
    """Return the index of the last sample of the named segment; None as the name gives the deepest sample."""
    if segment is None:
        return int(np.argmax(displacement))
    samples = np.flatnonzero(recording.labels.get("segment", np.empty(0, str)) == segment)
    if not samples.size:
        known = ", ".join(np.unique(recording.labels["segment"])) if "segment" in recording.labels else "none"
        raise InputError(f"the recording has no segment {segment!r}; known: {known}", field="segment")
    return int(samples[-1])


def draw_section(axes, fields: DrawableFields, name: str, sample: int = -1, *, tool: Tool) -> None:
    """Draw the deformed section of an axisymmetric simulation, mirrored at the axis.

    The panel also shows the undeformed outline (dashed), the element edges, the base, the tool and the colour bar.
    Colours follow `scenes.colour_scale.choose_colour_scale`.

    Args:
        axes: matplotlib axes.
        fields: fields of the simulation.
        name: field of the colours, a key of `LABELS`.
        sample: index of the sample.
        tool: tool of the experiment.
    """
    section, points = _get_section_and_deformed_points_mm(fields, sample)
    picture, scale = _draw_field_and_get_colour_scale(axes, fields, name, sample, (1, -1))
    radius, height = section.nodes[:, 0].max() * 1e3, -section.nodes[:, 1].min() * 1e3
    axes.plot(radius * np.array([-1, 1, 1, -1, -1]), height * np.array([-1, -1, 0, 0, -1]), color="0.4", linewidth=0.9,
              linestyle=(0, (4, 3)))
    width = 1.18 * max(radius, points[:, 0].max())
    base, plate = points[section.base, 1].min(), 0.05 * max(height, 0.5 * radius)
    axes.fill_between([-width, width], base, base - plate, color=RIGID, linewidth=0)
    if tool.is_plate:
        tip = _find_tool_face_height_mm(points[section.top], tool)
        axes.fill_between([-width, width], tip, tip + plate, color=RIGID, linewidth=0)
    else:
        _draw_needle_outline_above_contact(axes, points[section.top], tool, max(points[:, 1].max(), 0.0) + plate)
    set_axis_scales_and_labels(axes, "r [mm]")
    axes.figure.colorbar(picture, ax=axes, label=scale.label, extend=scale.colour_bar_extension, shrink=0.85)


def draw_tool_edge_closeup(axes, fields: DrawableFields, name: str, tool: Tool, sample: int = -1) -> None:
    """Draw the tissue near the edge of a needle, where the free surface folds onto the shaft.

    For a needle without a flat face, the panel shows the tip. The colours are those of `draw_section`.

    Args:
        axes: matplotlib axes.
        fields: fields of the simulation.
        name: field of the colours, a key of `LABELS`.
        tool: tool of the experiment.
        sample: index of the sample.
    """
    section, points = _get_section_and_deformed_points_mm(fields, sample)
    surface = points[section.top]
    _draw_field_and_get_colour_scale(axes, fields, name, sample, (1,))
    radius, tip = tool.require_radius() * 1e3, _find_tool_face_height_mm(surface, tool)
    top = max(surface[:, 1].max(), tip) + 0.3 * radius
    _draw_needle_outline_above_contact(axes, surface, tool, top + radius)
    axes.plot(*surface.T, color="0.15", linewidth=1.1)
    part, left, below = ("edge", 0.45, 0.7) if tool.face_radius else ("tip", 0.0, 0.4)
    axes.set_xlim(left * radius, (left + 1.75) * radius)
    axes.set_ylim(tip - below * radius, top)
    set_axis_scales_and_labels(axes, "r [mm]")
    axes.set_title(f"{part} of the tool", loc="left", fontsize=10)


def _draw_field_and_get_colour_scale(axes, fields: DrawableFields, name: str, sample: int, sides: tuple[int, ...]):
    """Colour the section on the given sides of the axis (1: right, -1: left).

    Returns:
        The matplotlib artist for the colour bar, and the colour scale.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.tri import Triangulation

    _, factor = LABELS[name]
    scale = choose_colour_scale(fields, name, sample)
    section, points = _get_section_and_deformed_points_mm(fields, sample)
    values = section.interpolate_at_points(fields.at_nodes(name, sample)) * factor
    edges = points[section.edges]
    for mirror in sides:
        side = np.array([mirror, 1])
        x, y = (points * side).T
        picture = axes.tripcolor(Triangulation(x, y, section.triangles), values, shading="gouraud", cmap="viridis",
                                 vmin=scale.low, vmax=scale.high)
        picture.set_in_layout(False)  # faster: the layout would measure each triangle
        thickness = min(0.35, 12.0 / np.sqrt(len(edges) + 1))
        axes.add_collection(LineCollection(edges * side, colors="white", linewidths=thickness, alpha=0.5))
    return picture, scale


def _get_section_and_deformed_points_mm(fields: DrawableFields, sample: int) -> tuple[HalfSectionGeometry, np.ndarray]:
    """Return the half section of axisymmetric fields, and its deformed points (r, z), mm, shape (points, 2).

    Raises:
        InputError: the fields belong to a three-dimensional solid.
    """
    section = fields.geometry()
    if not isinstance(section, HalfSectionGeometry):
        raise InputError("a section is drawn of an axisymmetric simulation; use draw_simulation for a solid in 3D",
                         field="fields")
    return section, 1e3 * section.interpolate_at_points(section.nodes + fields.displacement(sample))


def _draw_needle_outline_above_contact(axes, surface: np.ndarray, tool: Tool, top: float) -> None:
    """Draw the outline of a needle from its contact with the deformed top, (r, z), mm, up to the height `top`, mm."""
    tip = _find_tool_face_height_mm(surface, tool)
    r, z = (tool.profile.sample_outline_up_to_height((top - tip) * 1e-3) * 1e3).T
    axes.fill(np.concatenate([r, -r[::-1]]), tip + np.concatenate([z, z[::-1]]), color=RIGID, edgecolor="0.4",
              linewidth=0.6)


def _find_tool_face_height_mm(surface: np.ndarray, tool: Tool) -> float:
    """Return the height of the tool's flat face, mm: the highest point of the deformed top below the face.

    Args:
        surface: deformed points (r, z) of the top, mm, shape (points, 2).
        tool: tool of the experiment.
    """
    # Points at the rim are left out: tissue on the shaft may penetrate the tool by the contact tolerance.
    below = surface[:, 0] <= (np.inf if tool.face_radius is None else 0.999e3 * tool.face_radius)
    return float(surface[below, 1].max())


def draw_target_comparison(comparison: TargetComparison, title: str, path: Path) -> None:
    """Draw forces of a test in another program over depth with the calibrated ones, and their errors.

    Args:
        comparison: forces in the program, with fitted constants or with the law of the material.
        title: name of the program.
        path: image file; its suffix .png, .svg or .pdf selects the format.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    forces, errors = figure.subplots(1, 2)
    calibrated = comparison.calibrated
    forces.plot(1e3 * calibrated.depths, calibrated.forces, color="black", linewidth=2, label="calibrated")
    curves = [("o-", "#0072B2", title, comparison.depths, comparison.target_forces, comparison.errors)]
    if isinstance(comparison, MatchedConstants):
        curves = [("v--", "#D55E00", f"{title}, before compensation", comparison.uncompensated_depths,
                   comparison.uncompensated_forces, comparison.uncompensated_errors),
                  ("o-", "#0072B2", f"{title}, after compensation", *curves[0][3:])]
    for style, colour, label, depths, force, error in curves:
        forces.plot(1e3 * depths, force, style, color=colour, markersize=4, label=label)
        errors.plot(1e3 * depths, 100.0 * error, style, color=colour, markersize=4, label=label)
    errors.axhline(0.0, color="black", linewidth=1)
    end = 1.05e3 * float(calibrated.depths.max())
    forces.set(xlabel="depth [mm]", ylabel="force [N]", xlim=(0.0, end), ylim=(0.0, None))
    errors.set(xlabel="depth [mm]", ylabel="force error [%]", xlim=(0.0, end))
    for axes in (forces, errors):
        axes.grid(alpha=0.3)
        if not comparison.reaches_all_depths:
            axes.axvspan(1e3 * comparison.deepest, end, color="0.9", label=f"not reached in {title}")
    forces.legend(fontsize=8)
    write_figure_file(figure, path)


def write_figure_file(figure, path: Path) -> None:
    """Write a matplotlib figure atomically, in the format of the file's suffix (png without a suffix)."""
    kind = Path(path).suffix.lstrip(".").lower() or "png"
    if kind == "png":
        write_bytes(Path(path), render_png(figure))
        return
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=150)
    write_bytes(Path(path), buffer.getvalue())
