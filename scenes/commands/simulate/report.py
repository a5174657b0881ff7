"""Output of `tissue-sim simulate`: the JSON object, the printed force curve and remarks on the solution."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from scenes.commands.shared.text_table import TABLES

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console

    from tissue_sim import Recording

#: Entries of the solver report that appear in the JSON object only if they apply to the test.
OPTIONAL_KEYS = ("force_error", "penetration_mm", "penetration_tolerance_mm", "slipping_points", "self_weight")


def make_simulation_json_object(recordings: Sequence[Recording], resolution: str, failure: Exception | None,
                                warnings: list[str], *, replicates: bool = False) -> dict[str, Any]:
    """Return the object of ``simulate --json``; the names of the keys contain the units.

    Args:
        recordings: one recording, or all replicates; the curve is that of the first one.
        resolution: resolution of the flag.
        failure: error that stopped the solver; None if it finished.
        warnings: warnings, one sentence each.
        replicates: whether the object contains the forces of all recordings.
    """
    recording = recordings[0]
    solver = recording.metadata.get("solver", {})
    answer = {
        "displacement_mm": (recording.displacement * 1e3).tolist(),
        "time_s": recording.time.tolist(),
        "force_N": recording.force.tolist(),
        **_make_wrench_entries(recording),
        **{name: labels.tolist() for name, labels in recording.labels.items()},
        "status": solver.get("status", "failed" if failure else "converged"),
        "message": str(failure) if failure else solver.get("message", ""),
        "warnings": warnings,
        "newton_iterations": solver.get("newton_iterations"),
        "wall_s": solver.get("wall_s"),
        "mesh": solver.get("mesh"),
        "resolution": solver.get("resolution", resolution),
        **{key: solver[key] for key in OPTIONAL_KEYS if solver.get(key) is not None},
    }
    if replicates:
        answer["replicates"] = [{"displacement_mm": (one.displacement * 1e3).tolist(), "force_N": one.force.tolist(),
                                 "seed": one.metadata["seed"]} for one in recordings]
    return answer


def _make_wrench_entries(recording: Recording) -> dict[str, Any]:
    """Return force and torque vectors on the tool as JSON entries; empty for an axisymmetric simulation."""
    if "Fx" not in recording:
        return {}
    force, torque = ([recording.channel(f"{kind}{axis}") for axis in "xyz"] for kind in "FT")
    return {"force_vector_N": [list(map(float, row)) for row in zip(*force, strict=True)],
            "torque_vector_Nm": [list(map(float, row)) for row in zip(*torque, strict=True)]}


def print_force_curve(recording: Recording, title: str, console: Console) -> None:
    """Print force against displacement, with time and segment if the protocol has several segments."""
    from rich.table import Table
    from rich.text import Text

    rows = select_printed_sample_indices(recording)
    table = Table(title=title)
    columns = []
    segments = [str(name) for name in recording.labels.get("segment", ())]
    several = len(set(segments)) > 1
    if several:
        table.add_column("segment")
        columns.append([segments[row] for row in rows])
    curves = [("time", recording.time, "s")] if several else []
    curves += [("displacement", recording.displacement * 1e3, "mm"), ("force", recording.force, "N")]
    for quantity, values, unit in curves:
        factor, prefix = (1e3, "m") if 0 < abs(values).max() < 0.1 and unit == "N" else (1.0, "")
        # Text instead of str, because rich interprets brackets in a str as markup.
        table.add_column(Text(f"{quantity} [{prefix}{unit}]"), justify="right")
        columns.append(format_number_column(values[rows] * factor))
    for row in zip(*columns, strict=True):
        table.add_row(*row)
    console.print(table)
    if len(rows) < len(recording):
        sentence = f"{len(rows)} of {len(recording)} samples are shown; -o CURVE.csv writes all samples"
        console.print(sentence, markup=False)


def select_printed_sample_indices(recording: Recording) -> np.ndarray:
    """Return the indices of the printed samples, at most `PrintedTableLimits.max_curve_rows`.

    A short curve is printed completely. Of a long one the last sample of each segment is printed (unless the segments
    would take more than half of the rows), and evenly spaced samples.
    """
    import numpy as np

    samples = len(recording)
    if samples <= TABLES.max_curve_rows:
        return np.arange(samples)
    changes = [labels[1:] != labels[:-1] for labels in recording.labels.values()]
    ends = np.flatnonzero(np.any(changes, axis=0)) if changes else np.array([], dtype=int)
    if ends.size > TABLES.max_curve_rows // 2:
        ends = ends[:0]
    return np.union1d(ends, np.linspace(0, samples - 1, TABLES.max_curve_rows - ends.size).round().astype(int))


def print_mesh_cost_and_remarks(recording: Recording, console: Console) -> None:
    """Print size, cost and force error of the solution, and remarks on contact and self-weight."""
    solver = recording.metadata.get("solver")
    if not solver:
        return
    mesh = solver["mesh"]
    console.print(f"{mesh['elements']} elements, {mesh['freedoms']} degrees of freedom, {solver['newton_iterations']} "
                  f"Newton iterations, {solver['wall_s']:.2f} s", markup=False)
    for sentence in iterate_error_contact_and_weight_remarks(solver):
        console.print(sentence, markup=False, soft_wrap=True)


def iterate_error_contact_and_weight_remarks(solver: dict) -> Iterator[str]:
    """Yield one sentence each on force error, penetration, friction and self-weight, as far as they apply."""
    if solver.get("force_error") is not None:
        yield (f"estimated force error: {100 * solver['force_error']:.2g} % of the largest force, from a comparison "
               "with another mesh and longer steps")
    if "penetration_mm" in solver:
        yield (f"largest penetration of tool and tissue: {solver['penetration_mm']:.2g} mm "
               f"(tolerance {solver['penetration_tolerance_mm']:.2g} mm)")
    if "slipping_points" in solver:
        yield f"friction: at most {solver['slipping_points']} contact points slip at the same time"
    if "self_weight" in solver:
        weight = solver["self_weight"]
        yield (f"self-weight: the specimen settles by {weight['sag_mm']:.3f} mm before the test, from a moulded height "
               f"of {weight['moulded_height_mm']:.3f} mm (density {weight['density_kg_m3']:g} kg/m3, g "
               f"{weight['gravity_m_s2']:g} m/s2)")


def format_number_column(values: np.ndarray, digits: int = 5) -> list[str]:
    """Format the numbers of a column with equal decimals; the largest number shows `digits` significant digits."""
    largest = float(abs(values).max())
    decimals = max(0, digits - 1 - math.floor(math.log10(largest))) if largest > 0 else digits - 1
    return [f"{value + 0.0:.{decimals}f}" if round(float(value), decimals) else f"{0:.{decimals}f}" for value in values]
