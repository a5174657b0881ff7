"""Summary of a material file: moduli, stability, effects beyond the hyperelastic law, valid range and provenance."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from calibration.report.quantities import format_pressure
from tissue_sim.closed_form.confined import CONFINED
from tissue_sim.laws import find_stability_range
from tissue_sim.material.file import EFFECTS
from tissue_sim.material.fractional_zener import FractionalRelaxation

if TYPE_CHECKING:
    from rich.console import Console

    from tissue_sim import Experiment, MaterialFile, Recording

#: Stretches may exceed the valid range by this much without a warning; two meshes of one test differ by about as much.
RANGE_TOLERANCE = 0.01


def summarise_material_file(material_file: MaterialFile) -> dict[str, Any]:
    """Return the JSON object of ``material show``; the names of the keys contain the units.

    It holds formula, parameters, moduli, effects beyond the hyperelastic law, stability in each loading mode, valid
    range and provenance.
    """
    material = material_file.material
    stability = find_stability_range(material.energy_law, material.values)
    bulk_modulus = material.bulk_modulus
    return {
        "name": material.name,
        "law": material.law,
        "title": material.energy_law.title,
        "formula": material.energy_law.formula(),
        "parameters": {name: msgspec.to_builtins(parameter) for name, parameter in material_file.parameters.items()},
        "E0_Pa": material.E0,
        "mu0_Pa": material.mu0,
        "E_long_term_Pa": material.E_long_term,
        "mu_long_term_Pa": material.mu_long_term,
        "K_Pa": bulk_modulus if math.isfinite(bulk_modulus) else None,
        "incompressible": not math.isfinite(bulk_modulus),
        "density_kg_m3": material.density,
        **{key: msgspec.to_builtins(getattr(material_file, key)) for key in EFFECTS},
        "prony_expansion": FractionalRelaxation.describe_or_none(material.viscoelastic),
        "stability": {"stable": stability.is_stable_in_whole_range,
                      "stable_from": stability.stable_from,
                      "stable_to": stability.stable_to, "stretch_range": list(stability.stretch_range),
                      "modes": {mode: list(limits) for mode, limits in stability.limits.items()},
                      "text": stability.describe()},
        "valid_range": msgspec.to_builtins(material_file.valid_range),
        "provenance": msgspec.to_builtins(material_file.provenance),
    }


def describe_drucker_instability(material_file: MaterialFile) -> str | None:
    """Describe the loss of Drucker stability of a law inside the valid stretch range of its file.

    The law must be stable in uniaxial, planar and equibiaxial loading, also in each region. A file without a valid
    range is checked at rest only.

    Returns:
        One sentence; None for a stable law.
    """
    material = material_file.material
    low, high = get_fitted_stretch_range_or_unity(material_file)
    checked_range = (min(low, 1.0), max(high, 1.0))
    for region, local in {"": material, **material.regions}.items():
        stability = find_stability_range(local.energy_law, local.values, checked_range)
        if not (stability.is_stable_in_whole_range and np.all(np.isfinite(local.values))):
            subject = f"region {region} is " if region else ""
            return f"{subject}unstable inside its valid range of stretches {low:g} to {high:g}: {stability.describe()}"
    return None


def _compute_mean_stretches(experiment: Experiment, motion: float) -> tuple[float, float]:
    """Return the smallest and the largest mean stretch along an axis, at most and at least 1, at a motion, m or rad.

    In shear by gamma these are sqrt(1 + gamma^2/4) -+ gamma/2; in torsion gamma is the shear strain at the rim.
    """
    grip, specimen = experiment.grip, experiment.specimen
    if grip is None or (grip.axis[2] and not grip.is_rotation):
        stretch = 1 + (motion if grip else -motion) / specimen.height
        return min(stretch, 1.0), max(stretch, 1.0)
    gamma = abs(motion) / specimen.height * (specimen.outer_radius if grip.is_rotation else 1.0)
    mean = math.sqrt(1.0 + 0.25 * gamma**2)
    return mean - 0.5 * gamma, mean + 0.5 * gamma


def _merge_ranges(ranges: Iterable[tuple[float, float]]) -> tuple[float, float]:
    """Return the smallest range that contains all ranges."""
    lows, highs = zip(*ranges, strict=True)
    return min(lows), max(highs)


def list_warnings_if_test_leaves_range(material_file: MaterialFile, recording: Recording,
                                       experiment: Experiment) -> list[str]:
    """Return warnings about a simulated test in which the material leaves its valid range or its stable range.

    Args:
        material_file: material of the specimen.
        recording: simulated test; with fields, their principal stretches are compared with the valid range.
        experiment: simulated experiment.

    Returns:
        Warnings, one sentence each.
    """
    sentences = []
    motion = recording.channel(experiment.channels[0])
    if experiment.grip is None:
        # Above the touch only a bonded tool that has touched before stretches the specimen.
        is_loaded = np.logical_or.accumulate(motion >= 0.0) if experiment.friction == "bonded" else motion >= 0.0
        motion = np.where(is_loaded, motion, 0.0)
    extremes = [int(np.argmin(motion)), int(np.argmax(motion))]
    mean = _merge_ranges(_compute_mean_stretches(experiment, float(motion[sample])) for sample in extremes)
    # A calibration derives its valid range from the same local stretches. Under a needle they differ much from the
    # mean stretch of the specimen.
    if experiment.has_lateral_wall:
        # The volume changes; the law and its valid range refer to isochoric stretches.
        mean = lowest, highest = CONFINED.find_extreme_stretches(*mean)
    else:
        fields = recording.fields
        lowest, highest = mean if fields is None else _merge_ranges(fields.stretch_range(each) for each in extremes)
    if material_file.valid_range is not None and material_file.valid_range.stretch is not None:
        low, high = material_file.valid_range.stretch
        if lowest < low - RANGE_TOLERANCE or highest > high + RANGE_TOLERANCE:
            sentences.append(f"the stretches of the tissue are {lowest:.3g} to {highest:.3g}, but the material was "
                             f"fitted to stretches from {low:.3g} to {high:.3g} only")
    material = material_file.material
    stability = find_stability_range(material.energy_law, material.values, mean)
    if not stability.is_stable_in_whole_range:
        sentences.append(f"the law is unstable within the mean stretches of this test, {mean[0]:.3g} to "
                         f"{mean[1]:.3g}: {stability.describe()}")
    return sentences


def get_fitted_stretch_range_or_unity(material_file: MaterialFile) -> tuple[float, float]:
    """Return the lowest and highest stretch of the valid range; (1, 1) if the file states none."""
    stated = msgspec.to_builtins(material_file.valid_range) or {}
    low, high = stated.get("stretch") or (1.0, 1.0)
    return float(low), float(high)


def list_moduli_lines(summary: dict[str, Any]) -> list[str]:
    """Return lines with the moduli: one line of an elastic material; instantaneous and long-term of a relaxing one."""
    K = "incompressible" if summary["incompressible"] else f"K {format_pressure(summary['K_Pa'])}"
    E0, mu0 = format_pressure(summary["E0_Pa"]), format_pressure(summary["mu0_Pa"])
    if summary["mu_long_term_Pa"] == summary["mu0_Pa"]:
        return [f"E0 {E0}, mu0 {mu0}, {K}"]
    stated = (summary["viscoelastic"] or {}).get("moduli", "instantaneous").replace("_", "-")
    return [f"instantaneous E0 {E0}, mu0 {mu0}, {K}",
            f"long-term E {format_pressure(summary['E_long_term_Pa'])}, mu "
            f"{format_pressure(summary['mu_long_term_Pa'])}; the parameters above are {stated} values"]


def list_effect_and_region_lines(summary: dict[str, Any]) -> list[str]:
    """Return one line for each effect beyond the hyperelastic law, such as viscoelasticity, and for each region."""
    lines = []
    if series := summary["viscoelastic"]:
        if model := series.get("fractional_zener"):
            alpha, g, tau = (_format_with_error(model, key) for key in ("alpha", "g", "tau_s"))
            lines += [f"viscoelastic (fractional Zener model of the {series['form'].replace('_', ' ')} stress): alpha "
                      f"{alpha}, g {g}, tau {tau} s", summary["prony_expansion"]]
        terms = "; ".join(f"g {_format_with_error(term, 'g')}, tau {_format_with_error(term, 'tau_s')} s"
                          for term in series.get("terms", ()))
        if terms:
            lines.append(f"viscoelastic (Prony series of the {series['form'].replace('_', ' ')} stress): {terms}")
    if soft := summary["softening"]:
        lines.append(f"softening on first load: loss {_format_with_error(soft, 'loss')}, "
                     f"modulus {_format_with_error(soft, 'modulus_Pa', 0.0)} Pa, "
                     f"fraction {_format_with_error(soft, 'share', 1.0)}, form {soft.get('form', 'tanh')}")
    lines += [f"layer of {_format_with_error(layer, 'thickness_mm')} mm: moduli multiplied by "
              f"{_format_with_error(layer, 'modulus_ratio')}" for layer in summary["layers"] or ()]
    if pores := summary["poroelasticity"]:
        lines.append(f"drainage (poroelasticity): phi {_format_with_error(pores, 'phi')}, diffusivity "
                     f"{_format_with_error(pores, 'diffusivity_mm2_per_s')} mm2/s")
    if hole := summary["puncture"]:
        lines.append(f"puncture at {_format_with_error(hole, 'depth_mm')} mm: the force drops by a fraction of "
                     f"{_format_with_error(hole, 'drop')}")
    for name, region in (summary["regions"] or {}).items():
        numbers = [f"{key} {_format_with_error(parameter, 'value')} {parameter['unit'].replace('1', '')}".strip()
                   for key, parameter in region["parameters"].items()]
        others = [key for key in EFFECTS if region.get(key)]
        lines.append(f"region {name}: {', '.join([region['law'], *numbers])}"
                     f"{', with ' + ', '.join(others) if others else ''}")
    return lines


def _format_with_error(entry: dict[str, Any], key: str, absent: float | None = None) -> str:
    """Format a value with its standard error, if stated; `absent` replaces the value of a missing key."""
    error = entry.get("standard_error", entry.get("standard_errors", {}).get(key))
    return f"{entry.get(key, absent):.6g}" + ("" if error is None else f" +- {error:.2g}")


def print_material_summary_as_text(summary: dict[str, Any], console: Console) -> None:
    """Print the object of `summarise_material_file` as text and a table."""
    from rich.table import Table

    def print_unwrapped_line(text: str) -> None:
        """Print a text literally, on one line of any length."""
        console.print(text, markup=False, soft_wrap=True)

    print_unwrapped_line(f"{summary['name'] or 'unnamed'}: {summary['title']} ({summary['law']})")
    print_unwrapped_line(summary["formula"])
    table = Table("parameter", "value", "standard error", "unit")
    for column in table.columns[1:3]:
        column.justify = "right"
    for name, parameter in summary["parameters"].items():
        error = parameter.get("standard_error")
        table.add_row(name, f"{parameter['value']:.6g}", "-" if error is None else f"{error:.3g}", parameter["unit"])
    console.print(table)
    for sentence in list_moduli_lines(summary):
        print_unwrapped_line(sentence)
    for sentence in list_effect_and_region_lines(summary):
        print_unwrapped_line(sentence)
    if summary["density_kg_m3"] is not None:
        print_unwrapped_line(f"density {summary['density_kg_m3']:g} kg/m3")
    low, high = summary["stability"]["stretch_range"]
    for mode, (lower, upper) in summary["stability"]["modes"].items():
        ends = " and ".join(name for name, lost in (("below", lower > low), ("above", upper < high)) if lost)
        print_unwrapped_line(f"stable in {mode} loading: stretch {lower:.3g} to {upper:.3g} "
                             f"({f'unstable {ends}' if ends else 'no instability found'})")
    for title in ("valid_range", "provenance"):
        content = summary[title]
        print_unwrapped_line(f"{title.replace('_', ' ')}: {'not stated' if not content else ''}".rstrip())
        for key, value in (content or {}).items():
            if value not in (None, [], {}):
                print_unwrapped_line(f"  {key}: {_format_range_or_provenance_value(value)}")


def _format_range_or_provenance_value(value: Any) -> str:
    """Format an entry of valid range or provenance on one line."""
    if isinstance(value, list | tuple):
        if all(isinstance(entry, dict) for entry in value):
            return ", ".join(str(entry["file"]) for entry in value)
        return " to ".join(_format_range_or_provenance_value(entry) for entry in value)
    if isinstance(value, dict):
        return ", ".join(f"{key} {_format_range_or_provenance_value(entry)}" for key, entry in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)
