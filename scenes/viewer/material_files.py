"""Material files of the page: list, upload, slider ranges of the parameters, save as new files."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from tissue_sim.errors import InputError
from tissue_sim.material.file import MaterialFile, read_material_file, write_material_file
from tissue_sim.material.material import Material
from tissue_sim.parameters import Parameter, parameters, with_values
from tissue_sim.units import get_display_unit_and_factor

#: Suffix of material files.
SUFFIX = ".material.json"
#: Largest size of an uploaded material file, bytes; typical files have some thousand bytes.
LARGEST_UPLOAD = 1_000_000


@dataclass(frozen=True)
class SliderRangeSettings:
    """Rules for the ranges of the parameter sliders.

    Attributes:
        span: Largest value of a slider over the present value; also the present value over the smallest value if the
            material refuses zero.
        zero_tolerance: Magnitude of a parameter relative to the shear modulus below which the slider is centred at
            zero.
        smallest_modulus: Smallest shear modulus that one slider can set, relative to the present one.
        steps: Approximate number of steps of a slider.
    """

    span: float = 5.0
    zero_tolerance: float = 1e-3
    smallest_modulus: float = 0.01
    steps: int = 500


#: Settings of the viewer.
SETTINGS = SliderRangeSettings()


@dataclass(frozen=True)
class SliderRangeAndUnit:
    """Range of a linear slider for a parameter, in the unit of the page.

    Attributes:
        low: Smallest value, a multiple of `step`.
        high: Largest value, a multiple of `step`; the present value lies between `low` and `high`.
        step: Step.
        unit: Unit on the page; empty for a ratio.
        factor: Number on the page over the parameter's value in SI.
    """

    low: float
    high: float
    step: float
    unit: str
    factor: float


def list_material_files(folder: str | Path) -> list[Path]:
    """Return the paths of the ``*.material.json`` files in a folder, sorted by name.

    Raises:
        InputError: The folder does not exist.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError("this folder does not exist; name a folder for *.material.json files", file=folder)
    return sorted((path for path in folder.glob(f"*{SUFFIX}") if path.is_file()), key=lambda path: path.name)


def read_uploaded_material(name: str, content: bytes) -> Material:
    """Read the material of an uploaded file.

    Args:
        name: Name of the file on the user's computer, for messages.
        content: Content of the file.

    Raises:
        InputError: The file is larger than `LARGEST_UPLOAD`, or `tissue_sim.read_material_file` refuses it.
    """
    if len(content) > LARGEST_UPLOAD:
        raise InputError(f"must be at most {LARGEST_UPLOAD / 1e6:g} MB; got {len(content) / 1e6:.1f} MB. Upload a "
                         f"material file NAME{SUFFIX}.", file=name)
    with tempfile.TemporaryDirectory(prefix="tissue_sim_") as folder:
        path = Path(folder) / f"upload{SUFFIX}"
        path.write_bytes(content)
        try:
            return read_material_file(path).material
        except InputError as error:
            raise InputError(error.problem, file=name, line=error.line, field=error.field) from None


def compute_parameter_slider_ranges(material: Material) -> dict[str, SliderRangeAndUnit]:
    """Return the slider range of each parameter of a material, by the path of the parameter.

    With s = `SliderRangeSettings.span`, the range of a positive value v is [0, s v], or [v / s, s v] if the material
    refuses zero; for a negative value it is mirrored. A value near zero gets a range of plus and minus the shear
    modulus, or plus and minus 1 for exponents and ratios. Each range is then reduced to values that the material
    accepts and for which the finite elements are verified, with the other parameters fixed, and rounded to a round
    step.
    """
    return {name: _compute_slider_range(material, each) for name, each in parameters(material).items()}


def format_parameter_values_by_path(material: Material) -> dict[str, str]:
    """Return the value of each parameter with nine digits and its unit on the page, by the path of the parameter."""
    texts = {}
    for each in parameters(material).values():
        unit, factor = get_display_unit_and_factor(each.declaration.unit)
        texts[each.path] = f"{factor * each.value:.9g} {unit}".rstrip()
    return texts


def _compute_slider_range(material: Material, parameter: Parameter) -> SliderRangeAndUnit:
    """Return the slider range of one parameter, as `compute_parameter_slider_ranges` defines it."""
    name, value = parameter.path, parameter.value
    unit, factor = get_display_unit_and_factor(parameter.declaration.unit)
    scale = material.mu0 if unit == "kPa" else 1.0
    if value == 0 or (name in material.parameters and abs(value) < SETTINGS.zero_tolerance * scale):
        ends = [_find_nearest_usable_value(material, name, value, end) for end in (-scale, scale)]
    else:
        inner = 0.0 if _is_simulatable_parameter_value(material, name, 0.0) else value / SETTINGS.span
        ends = sorted([_find_nearest_usable_value(material, name, value, inner),
                       _find_nearest_usable_value(material, name, value, SETTINGS.span * value)])
    low, high = (factor * end for end in ends)
    now = factor * value
    step = 10.0 ** math.floor(math.log10(max(high - low, 1e-3 * abs(now), 1e-12) / SETTINGS.steps))
    step *= max(n for n in (1, 2, 5) if n * step <= max((high - low) / SETTINGS.steps, step))
    # Round inwards to accepted values, but keep the present value inside.
    low, high = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    low += not _is_simulatable_parameter_value(material, name, _remove_binary_rounding_error(low * step) / factor)
    high -= not _is_simulatable_parameter_value(material, name, _remove_binary_rounding_error(high * step) / factor)
    return SliderRangeAndUnit(min(_remove_binary_rounding_error(low * step), now),
                              max(_remove_binary_rounding_error(high * step), now), step, unit, factor)


def _remove_binary_rounding_error(number: float) -> float:
    """Round to 12 digits, which removes the binary rounding error of a multiple of a decimal step."""
    return float(f"{number:.12g}")


def _is_simulatable_parameter_value(material: Material, name: str, value: float) -> bool:
    """Return whether a value of a parameter is valid and the material can still be simulated."""
    try:
        changed = with_values(material, {name: value})
    except InputError:
        return False
    return changed.mu0 >= SETTINGS.smallest_modulus * material.mu0 and changed.is_bulk_ratio_verified


def _find_nearest_usable_value(material: Material, name: str, value: float, target: float) -> float:
    """Return the number between the accepted `value` and `target` that is nearest to `target` and accepted.

    The function bisects 40 times, so the result is exact up to 1e-12 of the interval.
    """
    if _is_simulatable_parameter_value(material, name, target):
        return target
    accepted, refused = value, target
    for _ in range(40):
        middle = 0.5 * (accepted + refused)
        accepted, refused = (middle,
                             refused) if _is_simulatable_parameter_value(material, name, middle) else (accepted, middle)
    return accepted


def save_edited_material(material: Material, folder: str | Path, name: str, *, source: str) -> Path:
    """Write a material that was edited by hand into a new file.

    The file contains no standard errors, covariance, residual and valid range, because they belong to the fitted
    values.

    Args:
        material: The edited material.
        folder: Folder for the file; the function creates a missing folder.
        name: Name of the material and of the file without ``.material.json``.
        source: Material that was edited, such as the name of its file; it is written into the provenance.

    Returns:
        Path of the file.

    Raises:
        InputError: The name is not a valid file name, the file exists already, or the folder cannot be written.
    """
    path = require_unused_material_path(folder, name)
    provenance = {"method": "edited by hand", "settings": {"edited_from": source}}
    named = replace(material, name=path.name.removesuffix(SUFFIX))
    write_material_file(MaterialFile.of(named, provenance=provenance), path)
    return path


def require_unused_material_path(folder: str | Path, name: str) -> Path:
    """Return the path for a new material file without writing the file.

    Args:
        folder: Folder of the file.
        name: Name with or without ``.material.json``.

    Raises:
        InputError: The name is not a valid file name, or the file exists already.
    """
    name = name.strip().removesuffix(SUFFIX)
    if not name or name.startswith(".") or not name.isprintable() or set(name) & set('/\\:*?"<>|') or len(name) > 100:
        raise InputError("must be a name of a material file: 1 to 100 printable characters without / \\ : * ? \" < > | "
                         f"and without a leading '.'; got {name!r}", field="name")
    path = Path(folder) / f"{name}{SUFFIX}"
    if path.exists():
        raise InputError("exists already and is not overwritten. Choose another name.", file=path)
    return path
