"""The measurement that a scene is compared with: replicates of one test, their spread, and the model's residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from scenes.viewer.trace import on_grid
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol import STUDY_SPEED, Protocol
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.recording.file import read_recordings
from tissue_sim.recording.origin import other_tool
from tissue_sim.recording.recording import MIN_POINTS, Recording
from tissue_sim.recording.segmentation import load_and_unload

#: Depths of the grid on which replicates are averaged.
GRID_POINTS = 201
#: Samples of a motion that is simulated for a comparison: about 25 ms of the fast solver.
MOTION_SAMPLES = 50
#: How the samples of a motion are shared out: the time counts this much beside the way.
_TIME_WEIGHT = 0.25


@dataclass(frozen=True, eq=False)
class Envelope:
    """A branch of several replicates on the grid; N, each of shape (n,), NaN where a replicate does not reach."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    standard_deviation: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Measurement:
    """Replicates of one test, and their first loading and first unloading on one grid of depths.

    Attributes:
        recordings: the replicates, with displacement and force.
        depth: the grid, m, ascending from 0 (or from where the first replicate begins) to the deepest sample.
        load: of the first way in.
        unload: of the first way out after it; None where no replicate has one.
        ways: `load_and_unload` of each replicate.
    """

    recordings: tuple[Recording, ...]
    depth: np.ndarray
    load: Envelope
    unload: Envelope | None
    ways: tuple[tuple[np.ndarray, np.ndarray], ...]

    @property
    def name(self) -> str:
        """Of the first replicate."""
        return self.recordings[0].name

    @property
    def kind(self) -> str | None:
        """Kind of test, where the recordings say it."""
        return next((str(each.metadata["kind"]) for each in self.recordings if "kind" in each.metadata), None)

    def other_tool(self, tool: Tool) -> str:
        """With which tool it was measured, where its recordings say another shape or radius (1 %); else empty."""
        return next(filter(None, (other_tool(each, tool.shape, tool.radius) for each in self.recordings)), "")

    @property
    def noise(self) -> float | None:
        """Root mean square over depth and branches of the standard deviation of the replicates, N; None of one."""
        spreads = [each.standard_deviation for each in (self.load, self.unload)
                   if each is not None and each.standard_deviation is not None]
        known = np.concatenate([each[np.isfinite(each)] for each in spreads]) if spreads else np.empty(0)
        return float(np.sqrt(np.mean(known**2))) if known.size else None


@dataclass(frozen=True, eq=False)
class Residual:
    """Model minus measurement.

    Attributes:
        depth: m, shape (n,), the grid of the measurement.
        load, unload: model minus mean measured force, N, shape (n,), NaN where one of the two is missing.
        rmse: root mean square over the samples of both branches of all replicates that the model reaches, N: the model
            at the depth of each sample minus its force. Samples at which the tool stands or trembles do not count.
        samples: how many.
    """

    depth: np.ndarray
    load: np.ndarray
    unload: np.ndarray
    rmse: float
    samples: int


def read_measurement(paths: Sequence[str | Path], **reading) -> Measurement:
    """The replicates in these files.

    Args:
        paths: of files with one replicate or several.
        reading: as `tissue_sim.read_recordings` takes it, such as ``columns`` of a foreign CSV.

    Raises:
        InputError: no file, an unreadable one, one without displacement and force or with too few samples, or files
            of different tests.
    """
    return measurement([each for path in paths for each in read_recordings(path, **reading)])


def measurement(recordings: Sequence[Recording]) -> Measurement:
    """A measurement of replicates; errors as `read_measurement`."""
    recordings = tuple(recordings)
    if not recordings:
        raise InputError("needs at least one recording", field="measurement")
    kinds: dict[Any, Any] = {}
    for recording in recordings:
        file = recording.metadata.get("source")
        for channel in ("displacement", "force"):
            if channel not in recording:
                raise InputError(f"has no {channel}, which an overlay needs; it has {', '.join(recording.channels)}",
                                 file=file, field=channel)
        if len(recording) < MIN_POINTS:
            raise InputError(f"has {len(recording)} samples, expected at least {MIN_POINTS}", file=file)
        if not recording.displacement.max() > max(0.0, recording.displacement[0]):
            raise InputError("never goes deeper than where it begins; expected a displacement that is positive into "
                             "the tissue", file=file, field="displacement")
        kinds.setdefault(recording.metadata.get("kind"), file)
    named = [kind for kind in kinds if kind is not None]
    if len(named) > 1:
        raise InputError(f"is a {named[1]}, and the recordings before it are {named[0]}; give replicates of one test",
                         file=kinds[named[1]], field="kind")
    grid = np.linspace(max(0.0, min(each.displacement.min() for each in recordings)),
                       max(each.displacement.max() for each in recordings), GRID_POINTS)
    ways = tuple(load_and_unload(each) for each in recordings)
    out = [way for _, way in ways if way.size]
    unload = None
    if out:
        unload = _envelope([each for each, (_, way) in zip(recordings, ways, strict=True) if way.size], out, -1, grid)
    return Measurement(recordings, grid, _envelope(recordings, [way for way, _ in ways], 1, grid), unload, ways)


def _envelope(recordings: Sequence[Recording], ways: Sequence[np.ndarray], direction: int,
              grid: np.ndarray) -> Envelope:
    forces = np.array([on_grid(each.displacement[way], each.force[way], direction, grid)
                       for each, way in zip(recordings, ways, strict=True)])
    spread = forces.std(axis=0, ddof=1) if len(forces) > 1 else None
    return Envelope(forces.mean(axis=0), forces.min(axis=0), forces.max(axis=0), spread)


def branches_on_grid(recording: Recording, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Load and unload of a recording on a grid of depths, N, NaN where it does not reach.

    Monotone cubics between the samples (Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5 (1984) 300): a simulation
    for a comparison has few.
    """
    load, unload = load_and_unload(recording)
    return _smooth(recording, load, 1, grid), _smooth(recording, unload, -1, grid)


def _smooth(recording: Recording, way: np.ndarray, direction: int, depth: np.ndarray) -> np.ndarray:
    from scipy.interpolate import PchipInterpolator

    way = way[::direction]
    if way.size < 2:
        return np.full(depth.shape, np.nan)
    x = recording.displacement[way]
    # A sample at the very end of the way may miss it by rounding of its file.
    slack = 1e-9 * (x[-1] - x[0])
    inside = (depth >= x[0] - slack) & (depth <= x[-1] + slack)
    return np.where(inside, PchipInterpolator(x, recording.force[way])(np.clip(depth, x[0], x[-1])), np.nan)


def residual(model: Recording, measured: Measurement) -> Residual:
    """What the model misses; see `Residual`.

    Args:
        model: `simulate` of `motion(measured)`, or of any motion that reaches the same depths.
        measured: the measurement.

    Raises:
        InputError: the model reaches no sample of the measurement.
    """
    load, unload = branches_on_grid(model, measured.depth)
    ways = dict(zip((1, -1), load_and_unload(model), strict=True))
    gaps = []
    for recording, both in zip(measured.recordings, measured.ways, strict=True):
        for direction, way in zip((1, -1), both, strict=True):
            at = _smooth(model, ways[direction], direction, recording.displacement[way])
            gaps.append(at - recording.force[way])
    missed = np.concatenate(gaps)
    missed = missed[np.isfinite(missed)]
    if not missed.size:
        raise InputError("reaches none of the measured depths; simulate the measured motion", field="model")
    out = np.full(measured.depth.size, np.nan) if measured.unload is None else unload - measured.unload.mean
    return Residual(measured.depth, load - measured.load.mean, out, float(np.sqrt(np.mean(missed**2))), missed.size)


def motion(measured: Measurement, *, samples: int = MOTION_SAMPLES, speed: float | None = None) -> Protocol:
    """The motion to simulate for a comparison: that of the replicate nearest to the mean, from its first sample to the
    end of its first unloading, thinned.

    The samples are spread evenly over way and time; where the tool turns round or starts to hold one is kept.

    Args:
        measured: the measurement.
        samples: about how many; never more.
        speed: m/s, for recordings without time; None: ``speed_mm_s`` of their metadata, else the study's.

    Raises:
        InputError: a speed that is not positive.
    """
    recording, (load, unload) = typical(measured)
    end = int(unload[-1] if unload.size else load[-1]) + 1
    depth = recording.displacement[:end]
    time = recording.time[:end] if "time" in recording else _time(depth, recording, speed)
    # Time that stands still is no step of a motion; the first of such samples stays.
    later = np.concatenate([[True], np.diff(np.maximum.accumulate(time)) > 0])
    kept = np.flatnonzero(later)
    time, depth = time[kept], depth[kept]
    turns = [0, load[0], load[-1], *([unload[0], unload[-1]] if unload.size else [])]
    corners = np.unique(np.minimum(np.searchsorted(kept, turns), kept.size - 1))
    chosen = np.union1d(corners, _spread(time, depth, corners, max(samples - corners.size, 2)))
    labels = {name: values[:end][kept][chosen] for name, values in recording.labels.items()
              if values.dtype.kind in {"segment": "U", "cycle": "iu"}[name]}
    return Protocol(time[chosen], depth[chosen], **labels)


def typical(measured: Measurement) -> tuple[Recording, tuple[np.ndarray, np.ndarray]]:
    """The replicate whose loading is nearest to the mean, and its `Measurement.ways`."""
    def distance(pair) -> float:
        recording, (way, _) = pair
        away = on_grid(recording.displacement[way], recording.force[way], 1, measured.depth) - measured.load.mean
        return float(np.nansum(away**2))

    return min(zip(measured.recordings, measured.ways, strict=True), key=distance)


def _time(depth: np.ndarray, recording: Recording, speed: float | None) -> np.ndarray:
    if speed is None:
        stated = recording.metadata.get("speed_mm_s")
        speed = stated * 1e-3 if isinstance(stated, int | float) and not isinstance(stated, bool) else STUDY_SPEED
    if not 0 < speed < np.inf:
        raise InputError(f"{speed:g} m/s is not a speed; give a number above zero",
                         file=recording.metadata.get("source"), field="speed")
    return np.concatenate([[0.0], np.cumsum(np.abs(np.diff(depth)))]) / speed


def _spread(time: np.ndarray, depth: np.ndarray, corners: np.ndarray, count: int) -> np.ndarray:
    """Indices of about `count` samples, evenly spread over way (between corners, without its trembling) and time."""
    way = np.zeros(depth.size)
    for begin, end in pairwise(corners.tolist()):
        gone = np.maximum.accumulate(np.sign(depth[end] - depth[begin]) * (depth[begin:end + 1] - depth[begin]))
        way[begin:end + 1] = way[begin] + np.maximum(gone, 0.0)
    measure = way / max(way[-1], 1e-12) + _TIME_WEIGHT * (time - time[0]) / max(time[-1] - time[0], 1e-12)
    return np.unique(np.searchsorted(measure, np.linspace(0.0, measure[-1], count)).clip(0, depth.size - 1))


def gap(model: Recording | None, measured: Measurement | None) -> Residual | None:
    """Model minus measurement; None where there is nothing to compare, as of a model that stopped at once."""
    if model is None or measured is None:
        return None
    try:
        return residual(model, measured)
    except InputError:
        return None
