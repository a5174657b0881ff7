"""Checks of single campaign tables; every failure names the field."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibration.campaign.parameters import Named
from calibration.campaign.schema import BY_PARAMETER, FitTable, NoiseTable, TestTable
from tissue_sim.bounded import bounded
from tissue_sim.errors import InputError, located
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.experiment.tools.tool import TOOLS, read_shape
from tissue_sim.files import exists, find_files
from tissue_sim.frozen_mapping import read_only
from tissue_sim.material.material import BULK_RATIOS
from tissue_sim.recording.formats.columns import check_columns


def require_positive(value: float | None, field: str, unit: str = "") -> None:
    """Refuse zero, negative and non-finite numbers; None passes."""
    if value is not None and not (np.isfinite(value) and value > 0):
        raise InputError(f"{value:g}{unit} is not positive; give a number above zero", field=field)


def check_bulk_ratio(ratio: float | None) -> None:
    """Refuse a K / mu0 that the finite elements would refuse later; None passes."""
    if ratio is not None and not BULK_RATIOS[0] <= ratio <= BULK_RATIOS[1]:
        raise InputError(f"K / mu0 = {ratio:g} is outside {BULK_RATIOS[0]:g} to {BULK_RATIOS[1]:g}, which the finite "
                         "elements are checked for; leave it out for an incompressible material",
                         field="fit.bulk_ratio")


def check_available(entry: TestTable, field: str) -> None:
    """Refuse kinds, tools and keys that the analytical method does not take."""
    kind = KINDS[entry.kind]
    if kind.closed_form is None:
        known = ", ".join(name for name, other in KINDS.items() if other.closed_form is not None)
        raise InputError(f"the analytical method takes {known}; for {entry.kind!r} set fit.method = 'inverse_fem'",
                         field=f"{field}.kind")
    if entry.tool is not None and not TOOLS.find(read_shape(entry.tool)[0], f"{field}.tool").is_plate:
        raise InputError(f"a homogeneous test is done with a plate, not with {entry.tool!r}; leave it out",
                         field=f"{field}.tool")
    for key in ("protocol", "rig"):
        if getattr(entry, key) is not None:
            raise InputError("does not belong to the analytical method; leave it out, or set fit.method = "
                             "'inverse_fem'", field=f"{field}.{key}")


def read_columns_key(entry: TestTable, field: str) -> Mapping[str, Any] | None:
    """Column map for `tissue_sim.read_recording`, None where the file names its own channels."""
    if entry.columns is None:
        return None
    try:
        columns = check_columns(entry.columns)
    except InputError as error:
        raise error.located(field=field) from None
    present = {*columns, "displacement"} if entry.speed_mm_s is not None and {"time", "force"} <= columns.keys() \
        else columns
    KINDS[entry.kind].require_channels(present, f"columns has {', '.join(columns)}", field=f"{field}.columns")
    return read_only(columns)


def find_recordings(patterns: list[str], folder: Path, field: str) -> tuple[Path, ...]:
    """Files of the patterns, sorted, relative to the campaign's folder."""
    if not patterns:
        raise InputError("a test needs at least one recording", field=field)
    found: list[Path] = []
    for i, pattern in enumerate(patterns):
        place = f"{field}[{i}]"
        path = Path(pattern)
        base, relative = (Path(path.anchor), path.relative_to(path.anchor)) if path.is_absolute() else (folder, path)
        if not pattern.strip() or relative == Path():
            raise InputError(f"{pattern!r} names no file; give a path or a pattern such as 'run_*.csv'", field=place)
        # A plain path wins over its reading as a pattern: file names may hold brackets.
        plain = base / relative
        matches = [plain] if exists(plain) else []
        if not matches and set("*?[") & set(pattern):
            # A pattern can be one that looks at the whole disk.
            with located(field=place):
                matches = bounded(find_files, base, str(relative), file=base, size=0)
        if not matches:
            raise InputError(f"no file matches {pattern!r} in {base}; paths are relative to the campaign file",
                             field=place)
        for match in matches:
            if match.resolve() in {other.resolve() for other in found}:
                raise InputError(f"{match.name} is listed twice; a replicate counts once", field=place)
            found.append(match)
    return tuple(sorted(found))


def check_unused(table: FitTable, noise: NoiseTable) -> None:
    """Refuse keys that would be read and have no effect."""
    if table.method == "analytical":
        if table.starts is not None:
            raise InputError("the analytical method makes its own starts; leave it out", field="fit.starts")
    else:
        if table.strain_points is not None:
            raise InputError("an inverse fit takes the samples as they are; leave it out", field="fit.strain_points")
        for key in ("offset_bounds_mm", "zero_bounds_N"):
            if getattr(table, key) is not None:
                raise InputError("an inverse fit holds offsets and zeros by their priors, not by bounds; leave it out",
                                 field=f"fit.{key}")
    if table.offset == "none":
        for key in ("offset_bounds_mm", "offset_prior_mm", "zero_bounds_N", "zero_prior_N"):
            if getattr(table, key) is not None:
                raise InputError('it counts with offset = "fit" only; leave it out or set that', field=f"fit.{key}")
    elif table.method == "inverse_fem":
        for key in ("contact_jitter_mm", "zero_jitter_N"):
            if getattr(noise, key) == "estimate" or getattr(noise, key) == 0:
                raise InputError('offset = "fit" needs the prior of the offsets: give a standard deviation, or leave '
                                 "offset out", field=f"noise.{key}")


def check_closed(table: FitTable, named: Mapping[str, Named]) -> None:
    """Refuse parameters that a closed form does not have."""
    others = [name for name in named if not named[name].of_law]
    if others and table.strain_points is not None:
        raise InputError(f"points at even strains have no history, and {others[0]} needs one; leave it out",
                         field="fit.strain_points")
    for name, what in named.items():
        if not what.of_material:
            key = next(key for key in ("scope", *BY_PARAMETER) if name in getattr(table, key))
            raise InputError("the analytical method fits material alone; leave it out, or set fit.method = "
                             "'inverse_fem'", field=f"fit.{key}.{name}")


def check_parameters(table: FitTable) -> None:
    """Refuse numbers of start, fixed, prior and bounds that contradict each other or are none."""
    for key in BY_PARAMETER:
        for name, value in getattr(table, key).items():
            if np.isnan(value).any() or (key != "bounds" and not np.isfinite(value).all()):
                raise InputError(f"{value} is not finite; give a number", field=f"fit.{key}.{name}")
    for name, (low, high) in table.bounds.items():
        if not low < high:
            raise InputError(f"[{low:g}, {high:g}] is empty; give the lower bound first", field=f"fit.bounds.{name}")
    for name, (_, deviation) in table.prior.items():
        if deviation <= 0:
            raise InputError(f"the standard deviation {deviation:g} is not positive; a prior is [mean, standard "
                             "deviation]",
                             field=f"fit.prior.{name}")
    for name in table.fixed:
        for key in ("start", "prior"):
            if name in getattr(table, key):
                raise InputError(f"{name} is fixed, so it takes no {key}; keep one of the two",
                                 field=f"fit.{key}.{name}")
