"""Check single tables of a campaign file; each error states the field."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibration.campaign.parameters import ScopedCampaignParameter
from calibration.campaign.schema import BY_PARAMETER, FitTable, NoiseTable, TestTable
from tissue_sim.bounded import run_in_sandbox
from tissue_sim.errors import InputError, located_and_converted_errors
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.experiment.tools.tool import TOOLS, interpret_shape_or_profile_path
from tissue_sim.files import find_files, is_valid_and_existing_path
from tissue_sim.material.material import BULK_RATIOS
from tissue_sim.recording.formats.columns import normalize_column_mapping
from tissue_sim.settings import make_shallow_read_only_copy


def require_positive_if_stated(value: float | None, field: str, unit: str = "") -> None:
    """Require a positive finite number or None.

    Args:
        value: the number.
        field: dotted field for the error message.
        unit: unit for the error message, with a leading space.

    Raises:
        InputError: the number is zero, negative or not finite.
    """
    if value is not None and not (np.isfinite(value) and value > 0):
        raise InputError(f"{field.rpartition('.')[2]} must be positive; got {value:g}{unit}", field=field)


def check_bulk_ratio(ratio: float | None) -> None:
    """Raise an `InputError` for a ratio K / mu0 outside the validated range of the finite elements; None is allowed."""
    if ratio is not None and not BULK_RATIOS[0] <= ratio <= BULK_RATIOS[1]:
        raise InputError(f"bulk_ratio must be {BULK_RATIOS[0]:g} to {BULK_RATIOS[1]:g}, the validated range of the "
                         f"finite elements; got {ratio:g}. Leave bulk_ratio out for an incompressible material",
                         field="fit.bulk_ratio")


def require_analytical_support_of_test_table(entry: TestTable, field: str) -> None:
    """Raise an `InputError` if a test table has a kind, tool or key that the analytical method does not support."""
    kind = KINDS[entry.kind]
    if kind.closed_form is None:
        known = ", ".join(name for name, other in KINDS.items() if other.closed_form is not None)
        raise InputError(f"kind must be one of {known} for the analytical method; got {entry.kind!r}. Set fit.method = "
                         "'inverse_fem' for other kinds", field=f"{field}.kind")
    if entry.tool is not None and not TOOLS.find(interpret_shape_or_profile_path(entry.tool)[0],
                                                 f"{field}.tool").is_plate:
        raise InputError(f"tool must be a plate in a homogeneous test; got {entry.tool!r}. Leave tool out",
                         field=f"{field}.tool")
    for key in ("protocol", "rig"):
        if getattr(entry, key) is not None:
            raise InputError(f"the analytical method does not use {key}; leave {key} out, or set fit.method = "
                             "'inverse_fem'", field=f"{field}.{key}")


def read_column_map_or_none(entry: TestTable, field: str) -> Mapping[str, Any] | None:
    """Check the key ``columns`` of a test table; return the columns of each channel, or None without the key."""
    if entry.columns is None:
        return None
    try:
        columns = normalize_column_mapping(entry.columns)
    except InputError as error:
        raise error.with_location(field=field) from None
    present = {*columns, "displacement"} if entry.speed_mm_s is not None and {"time", "force"} <= columns.keys() \
        else columns
    KINDS[entry.kind].require_channels(present, f"columns has {', '.join(columns)}", field=f"{field}.columns")
    return make_shallow_read_only_copy(columns)


def find_recording_files(patterns: list[str], folder: Path, field: str) -> tuple[Path, ...]:
    """Return the sorted files that match paths or patterns, which are relative to the folder of the campaign.

    Raises:
        InputError: no pattern, a pattern without matching file, or a file that is listed twice.
    """
    if not patterns:
        raise InputError("recordings must contain at least one path or pattern; got none. Add the files of the test.",
                         field=field)
    found: list[Path] = []
    for i, pattern in enumerate(patterns):
        entry_field = f"{field}[{i}]"
        path = Path(pattern)
        base, relative = (Path(path.anchor), path.relative_to(path.anchor)) if path.is_absolute() else (folder, path)
        if not pattern.strip() or relative == Path():
            raise InputError(f"recording must be a path or a pattern such as 'run_*.csv'; got {pattern!r}. "
                             "Name a file.",
                             field=entry_field)
        # An existing file has priority over a pattern, because file names may contain brackets.
        plain = base / relative
        matches = [plain] if is_valid_and_existing_path(plain) else []
        if not matches and set("*?[") & set(pattern):
            # The search is limited: a pattern may match the whole disk.
            with located_and_converted_errors(field=entry_field):
                matches = run_in_sandbox(find_files, base, str(relative), file=base, size=0)
        if not matches:
            raise InputError(f"recording must be an existing file; no file matches {pattern!r} in {base}. Paths are "
                             "relative to the campaign file.", field=entry_field)
        for match in matches:
            if match.resolve() in {other.resolve() for other in found}:
                raise InputError(f"recording must be listed once; {match.name} is listed twice. List each replicate "
                                 "once.", field=entry_field)
            found.append(match)
    return tuple(sorted(found))


def reject_fit_and_noise_keys_without_effect(table: FitTable, noise: NoiseTable) -> None:
    """Raise an `InputError` for a key of ``[fit]`` or ``[noise]`` without effect with the other settings."""
    if table.method == "analytical":
        if table.starts is not None:
            raise InputError("the analytical method does not use starts; leave starts out", field="fit.starts")
    else:
        if table.strain_points is not None:
            raise InputError("an inverse fit does not interpolate the samples; leave strain_points out",
                             field="fit.strain_points")
        for key in ("offset_bounds_mm", "zero_bounds_N"):
            if getattr(table, key) is not None:
                raise InputError(f"an inverse fit limits offsets and zeros by priors, not by bounds; leave {key} out",
                                 field=f"fit.{key}")
    if table.offset == "none":
        for key in ("offset_bounds_mm", "offset_prior_mm", "zero_bounds_N", "zero_prior_N"):
            if getattr(table, key) is not None:
                raise InputError(f'{key} requires offset = "fit"; set offset, or leave {key} out', field=f"fit.{key}")
    elif table.method == "inverse_fem":
        for key in ("contact_jitter_mm", "zero_jitter_N"):
            if getattr(noise, key) == "estimate" or getattr(noise, key) == 0:
                raise InputError(f'{key} must be a positive standard deviation with offset = "fit"; got '
                                 f"{getattr(noise, key)!r}. State one, or leave offset out", field=f"noise.{key}")


def require_analytical_support_of_fit_table(table: FitTable, named: Mapping[str, ScopedCampaignParameter]) -> None:
    """Raise an `InputError` for parameters and settings that the closed forms do not support.

    Args:
        table: table ``[fit]`` with ``method = "analytical"``.
        named: parameters by their names in the file.
    """
    others = [name for name in named if not named[name].is_law_parameter]
    if others and table.strain_points is not None:
        raise InputError(f"strain_points removes the time history that {others[0]} requires; leave strain_points out",
                         field="fit.strain_points")
    for name, parameter in named.items():
        if not parameter.is_material_parameter:
            key = next(key for key in ("scope", *BY_PARAMETER) if name in getattr(table, key))
            raise InputError(f"the analytical method fits material parameters only; leave {name} out, or set "
                             "fit.method = 'inverse_fem'", field=f"fit.{key}.{name}")


def check_values_finite_and_consistent(table: FitTable) -> None:
    """Raise an `InputError` for invalid or contradictory numbers in ``start``, ``fixed``, ``prior`` and ``bounds``."""
    for key in BY_PARAMETER:
        for name, value in getattr(table, key).items():
            if np.isnan(value).any() or (key != "bounds" and not np.isfinite(value).all()):
                raise InputError(f"{key} must be finite; got {value}", field=f"fit.{key}.{name}")
    for name, (low, high) in table.bounds.items():
        if not low < high:
            raise InputError(f"bounds must be [low, high] with low < high; got [{low:g}, {high:g}]",
                             field=f"fit.bounds.{name}")
    for name, (_, deviation) in table.prior.items():
        if deviation <= 0:
            raise InputError("a prior must be [mean, standard deviation] with a positive standard deviation; got "
                             f"{deviation:g}", field=f"fit.prior.{name}")
    for name in table.fixed:
        for key in ("start", "prior"):
            if name in getattr(table, key):
                raise InputError(f"{name} is fixed and has a {key}; keep one of the two",
                                 field=f"fit.{key}.{name}")
