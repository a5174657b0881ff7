"""Measures of strain and stress other than stretch and nominal stress: words in headers, and conversion.

The conversions hold for an incompressible specimen that deforms homogeneously (Holzapfel, Nonlinear Solid Mechanics,
2000, chapters 2 and 3). Uniaxial, of stretch l: logarithmic strain ln l; Green-Lagrange strain (l^2 - 1) / 2; Almansi
strain (1 - l^-2) / 2; nominal stress = true stress / l = l * second Piola-Kirchhoff stress. In simple shear the true
shear stress equals the nominal one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.recording.recording import Recording

ENGINEERING = "engineering"
#: Largest plausible logarithmic strain (a stretch of 148); a larger one has a wrong unit.
_LARGEST_LOGARITHMIC = 5.0


@dataclass(frozen=True)
class StrainOrStressMeasure:
    """A measure of strain or stress, such as logarithmic strain, with its conversion to stretch or nominal stress.

    Attributes:
        channel: channel of a recording that results from the conversion.
        title: name in sentences.
        words: pattern of the words of a header that name the measure, lower case.
        convert: converts values of the measure, SI, to the channel; a stress takes the stretch as second argument.
        formula: formula of the conversion in sentences.
        invert: converts values of the channel, SI, to the measure; a stress takes the stretch as second argument.
    """

    channel: str
    title: str
    words: str
    convert: Callable[..., np.ndarray]
    formula: str
    invert: Callable[..., np.ndarray]


def _stretch_from_logarithmic(strain: np.ndarray) -> np.ndarray:
    """Return the stretch exp(strain), shape (n,)."""
    largest = float(np.abs(strain).max())
    if largest > _LARGEST_LOGARITHMIC:
        raise InputError(f"logarithmic strains reach {largest:g}, which is a stretch of exp({largest:g}); state the "
                         'unit, such as unit = "%"', field="stretch")
    return np.exp(strain)


def _stretch_from_green_lagrange(strain: np.ndarray) -> np.ndarray:
    """Return the stretch sqrt(1 + 2 strain), shape (n,)."""
    if strain.min() <= -0.5:
        raise InputError(f"Green-Lagrange strains must be above -0.5; got {strain.min():g}. Check unit and sign",
                         field="stretch")
    return np.sqrt(1.0 + 2.0 * strain)


def _stretch_from_almansi(strain: np.ndarray) -> np.ndarray:
    """Return the stretch 1 / sqrt(1 - 2 strain), shape (n,)."""
    if strain.max() >= 0.5:
        raise InputError(f"Almansi strains must be below 0.5; got {strain.max():g}. Check unit and sign",
                         field="stretch")
    return 1.0 / np.sqrt(1.0 - 2.0 * strain)


#: Name in a campaign -> measure.
MEASURES: dict[str, StrainOrStressMeasure] = {
    "logarithmic": StrainOrStressMeasure("stretch", "logarithmic strain",
                                         r"true|log|ln|logarithmic|hencky|natural|wahre[rn]?|"
                                         r"logarithmische[rn]?|vraie?s?|logarithmique|umformgrad",
                                         _stretch_from_logarithmic, "stretch = exp(strain)", np.log),
    "green_lagrange": StrainOrStressMeasure("stretch", "Green-Lagrange strain",
                                            r"green|lagrange|lagrangian|lagrangesche",
                                            _stretch_from_green_lagrange, "stretch = sqrt(1 + 2 strain)",
                                            lambda stretch: (stretch**2 - 1.0) / 2.0),
    "almansi": StrainOrStressMeasure("stretch", "Almansi strain", r"almansi|euler|eulerian", _stretch_from_almansi,
                                     "stretch = 1 / sqrt(1 - 2 strain)", lambda stretch: (1.0 - stretch**-2) / 2.0),
    "true": StrainOrStressMeasure("nominal stress", "true (Cauchy) stress",
                                  r"true|cauchy|wahre[rn]?|vraie?s?|(?<!piola )kirchhoff",
                                  lambda stress, stretch: stress / stretch, "nominal stress = true stress / stretch",
                                  lambda stress, stretch: stress * stretch),
    "second_piola_kirchhoff": StrainOrStressMeasure(
        "nominal stress", "second Piola-Kirchhoff stress", r"(second|2nd|zweite[rn]?|deuxième|2) (piola|pk)|pk ?2|"
        r"piola kirchhoff (2|ii)", lambda stress, stretch: stress * stretch,
        "nominal stress = stretch * second Piola-Kirchhoff stress", lambda stress, stretch: stress / stretch),
}
_ENGINEERING = re.compile(r"\b(engineering|eng|nominal|nominale[rn]?|nominell\w*|technische[rn]?|technical|nenn\w*|"
                          r"ingenieur\w*|ingénieur|conventional|conventionnelle|first piola|pk ?1|1st piola|biot|"
                          r"cauchy strain)\b")
#: Words by which a column of stretches is one of logarithmic strains.
_LOGARITHM = re.compile(r"\b(ln|log|logarithmi\w*|hencky|strain|dehnung)\b")
_WORDS = {name: re.compile(rf"\b({measure.words})\b") for name, measure in MEASURES.items()}
_CHANNEL_OF_ROLE = {"strain": "stretch", "stretch": "stretch", "shear strain": "stretch", "stress": "nominal stress",
                    "nominal stress": "nominal stress"}


def find_measure_name_in_header_or_none(words: str, role: str) -> str | None:
    """Return the name of the measure in a header, `ENGINEERING` included; None: no word for a measure.

    Args:
        words: words of the header, lower case, separated by single blanks.
        role: role of the column.
    """
    channel = _CHANNEL_OF_ROLE.get(role)
    if channel is None:
        return None
    if channel == "stretch" and "cauchy" in words.split():
        return ENGINEERING
    for name, measure in MEASURES.items():
        if measure.channel == channel and _WORDS[name].search(words) and not (
                role == "stretch" and name == "logarithmic" and not _LOGARITHM.search(words)):
            return name
    return ENGINEERING if _ENGINEERING.search(words) else None


def list_other_measures_named_by_words(words: str, role: str) -> tuple[str, ...]:
    """Return other measures that the same words name.

    A Lagrangian strain is the Green-Lagrange strain or the engineering strain. A Piola-Kirchhoff stress is the first
    (nominal) or the second one.
    """
    channel, parts = _CHANNEL_OF_ROLE.get(role), words.split()
    if channel == "stretch" and any(part.startswith("lagrang") for part in parts) and "green" not in parts:
        return (ENGINEERING,)
    if channel == "nominal stress" and "piola" in parts and find_measure_name_in_header_or_none(words, role) is None:
        return ("second_piola_kirchhoff",)
    return ()


def require_valid_measure(measure: object, channel: str, channels: Mapping[str, object], field: str) -> None:
    """Refuse a measure that the channel does not have, or that lacks the stretch for its conversion.

    Raises:
        InputError: with the field.
    """
    axis = channel[len(channel.removesuffix(" 2")):]
    names = [name for name, each in MEASURES.items() if each.channel == channel.removesuffix(" 2")]
    if measure not in names:
        expected = f"one of {', '.join(names)}" if names else "left out: the channel has one measure only"
        raise InputError(f"measure of {channel} must be {expected}; got {measure!r}"
                         f"{make_hint_with_similar_or_known_words(str(measure), names) if names else ''}",
                         field=f"{field}.measure")
    if channel == f"nominal stress{axis}" and not {f"stretch{axis}", "shear strain"} & channels.keys():
        raise InputError(f"{MEASURES[str(measure)].title} needs the stretch to become a nominal stress; name a column "
                         "of stretch or strain too", field=f"{field}.measure")


def convert_recording_to_stretch_and_nominal(recording: Recording, measures: Mapping[str, str]) -> Recording:
    """Convert other measures to stretch and nominal stress, and add the measures to the metadata (``measures``).

    Args:
        recording: its channels ``stretch`` and ``nominal stress`` hold values of the measures, also those of a second
            axis.
        measures: channel -> name in `MEASURES`.

    Raises:
        InputError: values that the measure cannot have; a measure of stress that has no conversion in simple shear.
    """
    recording = recording.with_metadata(measures=dict(measures))
    for axis in ("", " 2"):
        recording = _convert_axis_to_stretch_and_nominal(recording, measures.get(f"stretch{axis}"),
                                                         measures.get(f"nominal stress{axis}"), axis)
    return recording


def _convert_axis_to_stretch_and_nominal(recording: Recording, strain: str | None, stress: str | None,
                                         axis: str) -> Recording:
    """Return a recording with the stretch and the nominal stress of one axis, whose channels end with `axis`."""
    if strain is not None:
        recording = recording.with_channels(**{f"stretch{axis}": MEASURES[strain].convert(
            recording.channel(f"stretch{axis}"))})
    if stress is None:
        return recording
    if f"stretch{axis}" in recording:
        stretch = recording.channel(f"stretch{axis}")
        if stretch.min() <= 0:
            raise InputError(f"{MEASURES[stress].title} needs stretches above zero; got {stretch.min():g}",
                             field=f"stretch{axis}")
        return recording.with_channels(**{f"nominal stress{axis}": MEASURES[stress].convert(
            recording.channel(f"nominal stress{axis}"), stretch)})
    if stress != "true":
        raise InputError(f"{MEASURES[stress].title} has no conversion to nominal stress in simple shear; give the "
                         "nominal or the true shear stress", field="nominal stress")
    return recording


def get_original_measures(recording: Recording) -> dict[str, StrainOrStressMeasure]:
    """Return the measures in the file: name of the channel -> measure.

    These are the measures before `convert_recording_to_stretch_and_nominal`.
    """
    stated = recording.metadata.get("measures")
    return {channel: MEASURES[name] for channel, name in (stated.items() if isinstance(stated, Mapping) else ())
            if channel in recording and name in MEASURES
            and MEASURES[name].channel == channel.removesuffix(" 2")}
