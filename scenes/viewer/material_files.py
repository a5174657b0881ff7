"""Materials on the page: found in a folder, uploaded, changed by sliders, saved as new files."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from tissue_sim.errors import InputError
from tissue_sim.material.file import MaterialFile, read_material_file, write_material_file
from tissue_sim.material.material import BULK_RATIOS, Material
from tissue_sim.parameters import Parameter, parameters, with_values
from tissue_sim.units import shown

SUFFIX = ".material.json"
#: Largest upload, bytes; a material file has some thousands.
LARGEST_UPLOAD = 1_000_000
#: A slider reaches so many times the value; and where zero is refused, down to one part in so many.
REACH = 5.0
#: A parameter of the law that is smaller than this share of the shear modulus is about zero.
_NEAR_ZERO = 1e-3
#: No slider alone makes a material softer than this share of what it is.
_SOFTEST = 0.01
#: Steps of a slider, about.
_STEPS = 500


@dataclass(frozen=True)
class SliderRange:
    """A linear slider for a parameter; `low`, `high` and `step` are in the unit of the page.

    Attributes:
        low, high: multiples of `step`, with the value between them.
        unit: on the page; ``""`` of a ratio.
        factor: number on the page over the parameter's value, SI.
    """

    low: float
    high: float
    step: float
    unit: str
    factor: float


def list_materials(folder: str | Path) -> list[Path]:
    """The ``*.material.json`` of a folder, sorted by name.

    Raises:
        InputError: no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError("is not a folder; name the one with the *.material.json files", file=folder)
    return sorted((path for path in folder.glob(f"*{SUFFIX}") if path.is_file()), key=lambda path: path.name)


def read_upload(name: str, content: bytes) -> Material:
    """The material in an uploaded file.

    Args:
        name: of the file on the user's machine, for messages.
        content: its bytes.

    Raises:
        InputError: more than `LARGEST_UPLOAD`, or what `tissue_sim.read_material_file` refuses, with the field's path.
    """
    if len(content) > LARGEST_UPLOAD:
        raise InputError(f"has {len(content) / 1e6:.1f} MB, expected a material file of at most "
                         f"{LARGEST_UPLOAD / 1e6:g} MB; upload NAME{SUFFIX}", file=name)
    with tempfile.TemporaryDirectory(prefix="tissue_sim_") as folder:
        path = Path(folder) / f"upload{SUFFIX}"
        path.write_bytes(content)
        try:
            return read_material_file(path).material
        except InputError as error:
            raise InputError(error.problem, file=name, line=error.line, field=error.field) from None


def parameter_ranges(material: Material) -> dict[str, SliderRange]:
    """A slider for every parameter that the material has, by its path.

    From 0, or from 1/`REACH` of the value where the material refuses zero, to `REACH` times the value, shortened to
    what the material accepts, and the finite elements are checked for, while its other parameters stay; mirrored for a
    negative value. Around zero the slider reaches as far as the shear modulus (of an exponent or a ratio: 1) at either
    side. The numbers on it are round.
    """
    return {name: _range(material, each) for name, each in parameters(material).items()}


def exact_values(material: Material) -> dict[str, str]:
    """Path -> value of every parameter, with its unit on pages and all its digits."""
    texts = {}
    for each in parameters(material).values():
        unit, factor = shown(each.declaration.unit)
        texts[each.path] = f"{factor * each.value:.9g} {unit}".rstrip()
    return texts


def _range(material: Material, parameter: Parameter) -> SliderRange:
    name, value = parameter.path, parameter.value
    unit, factor = shown(parameter.declaration.unit)
    size = material.mu0 if unit == "kPa" else 1.0
    if value == 0 or (name in material.parameters and abs(value) < _NEAR_ZERO * size):
        ends = [_accepted(material, name, value, -size), _accepted(material, name, value, size)]
    else:
        inner = 0.0 if _accepts(material, name, 0.0) else value / REACH
        ends = sorted([_accepted(material, name, value, inner), _accepted(material, name, value, REACH * value)])
    low, high = (factor * end for end in ends)
    now = factor * value
    step = 10.0 ** math.floor(math.log10(max(high - low, 1e-3 * abs(now), 1e-12) / _STEPS))
    step *= max(n for n in (1, 2, 5) if n * step <= max((high - low) / _STEPS, step))
    # Rounded inwards to what is accepted, yet never past the value itself.
    low, high = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    low += not _accepts(material, name, _tidy(low * step) / factor)
    high -= not _accepts(material, name, _tidy(high * step) / factor)
    return SliderRange(min(_tidy(low * step), now), max(_tidy(high * step), now), step, unit, factor)


def _tidy(number: float) -> float:
    """Without the dust of binary multiples of a decimal step."""
    return float(f"{number:.12g}")


def _accepts(material: Material, name: str, value: float) -> bool:
    """Whether the material takes the value and stays one that can be simulated."""
    try:
        changed = with_values(material, {name: value})
    except InputError:
        return False
    if changed.mu0 < _SOFTEST * material.mu0:
        return False
    low, high = BULK_RATIOS
    return math.isinf(changed.bulk_modulus) or low <= changed.bulk_modulus / changed.mu0 <= high


def _accepted(material: Material, name: str, value: float, wanted: float) -> float:
    """`wanted`, or the number nearest to it on the way from `value` that the material accepts."""
    if _accepts(material, name, wanted):
        return wanted
    good, bad = value, wanted
    for _ in range(40):
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if _accepts(material, name, middle) else (good, middle)
    return good


def save_edited(material: Material, folder: str | Path, name: str, *, source: str) -> Path:
    """Write a material that was changed by hand as a new file.

    Standard errors, covariance, residual and valid range stay behind: they belong to the values that were fitted.

    Args:
        material: as it is to be.
        folder: where the file goes; it is made where it is missing.
        name: of the material, and of the file without ``.material.json``.
        source: the material that was changed, such as the name of its file; it stands in the provenance.

    Returns:
        The file.

    Raises:
        InputError: a name that cannot be a file's, a file that is there already, a place that cannot be written.
    """
    path = new_file(folder, name)
    provenance = {"method": "edited by hand", "settings": {"edited_from": source}}
    named = replace(material, name=path.name.removesuffix(SUFFIX))
    write_material_file(MaterialFile.of(named, provenance=provenance), path)
    return path


def new_file(folder: str | Path, name: str) -> Path:
    """Where a material of this name goes, with or without ``.material.json``; nothing is written.

    Raises:
        InputError: a name that cannot be a file's, a file that is there already.
    """
    name = name.strip().removesuffix(SUFFIX)
    if not name or name.startswith(".") or not name.isprintable() or set(name) & set('/\\:*?"<>|') or len(name) > 100:
        raise InputError(f"{name!r} is no name of a file; give up to 100 letters, digits, blanks or - _ .",
                         field="name")
    path = Path(folder) / f"{name}{SUFFIX}"
    if path.exists():
        raise InputError("is there already and is not replaced; give another name", file=path)
    return path
