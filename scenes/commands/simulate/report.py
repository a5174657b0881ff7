"""What `tissue-sim simulate` prints of its recordings: the JSON object, the printed curve, the remarks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console

    from tissue_sim import Recording

#: Rows of a printed curve; of a longer one, some samples are left out.
MOST_ROWS = 60
#: Entries of the solver's report that are there where they apply.
WHERE_THEY_APPLY = ("force_error", "penetration_mm", "penetration_tolerance_mm", "slipping_points", "self_weight")


def as_json(recordings: Sequence[Recording], resolution: str, failure: Exception | None, warnings: list[str], *,
            replicates: bool = False) -> dict[str, Any]:
    """The object of ``simulate --json``; units are in the names of the keys.

    Args:
        recordings: the curve is that of the first; with `replicates` the forces of all follow.
        resolution: as it was asked for.
        failure: what stopped the solver.
        warnings: sentences.
    """
    recording = recordings[0]
    solver = recording.metadata.get("solver", {})
    answer = {
        "displacement_mm": (recording.displacement * 1e3).tolist(),
        "time_s": recording.time.tolist(),
        "force_N": recording.force.tolist(),
        **_vectors(recording),
        **{name: labels.tolist() for name, labels in recording.labels.items()},
        "status": solver.get("status", "failed" if failure else "converged"),
        "message": str(failure) if failure else solver.get("message", ""),
        "warnings": warnings,
        "newton_iterations": solver.get("newton_iterations"),
        "wall_s": solver.get("wall_s"),
        "mesh": solver.get("mesh"),
        "resolution": solver.get("resolution", resolution),
        **{key: solver[key] for key in WHERE_THEY_APPLY if solver.get(key) is not None},
    }
    if replicates:
        answer["replicates"] = [{"displacement_mm": (one.displacement * 1e3).tolist(), "force_N": one.force.tolist(),
                                 "seed": one.metadata["seed"]} for one in recordings]
    return answer


def _vectors(recording: Recording) -> dict[str, Any]:
    """Force and torque on the tool, where there is more than a force along z."""
    if "Fx" not in recording:
        return {}
    force, torque = ([recording.channel(f"{kind}{axis}") for axis in "xyz"] for kind in "FT")
    return {"force_vector_N": [list(map(float, row)) for row in zip(*force, strict=True)],
            "torque_vector_Nm": [list(map(float, row)) for row in zip(*torque, strict=True)]}


def print_curve(recording: Recording, title: str, console: Console) -> None:
    """Print force against displacement; with time and segment where there is more than one segment."""
    from rich.table import Table
    from rich.text import Text

    rows = shown_rows(recording)
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
        # As text: rich reads brackets as markup.
        table.add_column(Text(f"{quantity} [{prefix}{unit}]"), justify="right")
        columns.append(aligned(values[rows] * factor))
    for row in zip(*columns, strict=True):
        table.add_row(*row)
    console.print(table)
    if len(rows) < len(recording):
        console.print(f"{len(rows)} of {len(recording)} samples are shown; -o CURVE.csv keeps all", markup=False)


def shown_rows(recording: Recording) -> np.ndarray:
    """Indices of the samples that are printed: all of a short curve; of a long one some that are evenly spread, and
    the last one of each segment while there is room for them."""
    import numpy as np

    samples = len(recording)
    if samples <= MOST_ROWS:
        return np.arange(samples)
    changes = [labels[1:] != labels[:-1] for labels in recording.labels.values()]
    ends = np.flatnonzero(np.any(changes, axis=0)) if changes else np.array([], dtype=int)
    if ends.size > MOST_ROWS // 2:
        ends = ends[:0]
    return np.union1d(ends, np.linspace(0, samples - 1, MOST_ROWS - ends.size).round().astype(int))


def print_solver(recording: Recording, console: Console) -> None:
    """Print size and cost of the solution, how far it errs, and what was assumed of contact and weight."""
    solver = recording.metadata.get("solver")
    if not solver:
        return
    mesh = solver["mesh"]
    console.print(f"{mesh['elements']} elements, {mesh['freedoms']} freedoms, {solver['newton_iterations']} Newton "
                  f"iterations, {solver['wall_s']:.2f} s", markup=False)
    for sentence in remarks(solver):
        console.print(sentence, markup=False, soft_wrap=True)


def remarks(solver: dict) -> Iterator[str]:
    """How far the force errs, and what was assumed of contact and weight, a sentence each."""
    if solver.get("force_error") is not None:
        yield (f"the force errs by about {100 * solver['force_error']:.2g} % of its largest, by comparison with "
               "another mesh and longer steps")
    if "penetration_mm" in solver:
        yield (f"the surface enters the tool by {solver['penetration_mm']:.2g} mm at most "
               f"(tolerance {solver['penetration_tolerance_mm']:.2g} mm)")
    if "slipping_points" in solver:
        yield f"friction: {solver['slipping_points']} points of the surface slip at once at most"
    if "self_weight" in solver:
        weight = solver["self_weight"]
        yield (f"self-weight: the specimen sags {weight['sag_mm']:.3f} mm before the test, from a moulded height of "
               f"{weight['moulded_height_mm']:.3f} mm (assumed: density {weight['density_kg_m3']:g} kg/m3, g "
               f"{weight['gravity_m_s2']:g} m/s2)")


def aligned(values: np.ndarray, digits: int = 5) -> list[str]:
    """Numbers of one column with the same decimals, so many that the largest shows `digits` digits."""
    largest = float(abs(values).max())
    decimals = max(0, digits - 1 - math.floor(math.log10(largest))) if largest > 0 else digits - 1
    return [f"{value + 0.0:.{decimals}f}" if round(float(value), decimals) else f"{0:.{decimals}f}" for value in values]
