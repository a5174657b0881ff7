"""Assumptions about a recording that its signals support: samples left out, contact, controlled quantity."""

from __future__ import annotations

from collections.abc import Iterator

from tissue_sim.recording.contact import Contact
from tissue_sim.recording.formats.assumption import AlternativeValue, Assumption
from tissue_sim.recording.screening import EQUAL_LOAD, Screening, format_sample_numbers


def list_signal_based_assumptions(screening: Screening, contact: Contact | None, *, has_air: bool | None,
                                  stressed: bool, controlled: str | None = None) -> tuple[Assumption, ...]:
    """Return the assumptions about one recording that its signals show: omitted samples, contact, controlled quantity.

    Args:
        screening: findings on the recording, with the controlled quantity.
        contact: contact of the tool; None: not searched.
        has_air: whether motion in air precedes contact; None: unknown.
        stressed: whether the recording has strain and stress.
        controlled: controlled quantity as the user states; None: found in the signals.
    """
    return tuple(_iterate_signal_based_assumptions(screening, contact, has_air=has_air, stressed=stressed,
                                                   controlled=controlled))


def _iterate_signal_based_assumptions(screening: Screening, contact: Contact | None, *, has_air: bool | None,
                                      stressed: bool,
                                      controlled: str | None) -> Iterator[Assumption]:
    """Yield the assumptions about one recording; see `list_signal_based_assumptions`."""
    control = screening.control
    if screening.left_out_sample_numbers:
        sentences = [*(each.sentence for each in screening.left_out), *(each.sentence for each in screening.saturation)]
        yield Assumption("samples left out", format_sample_numbers(screening.left_out_sample_numbers), tuple(sentences))
    if contact is not None and contact.has_air_before_contact:
        yield Assumption("contact", "after air" if has_air else "at the first sample",
                         (contact.in_words(stressed=stressed),))
    if controlled is not None:
        yield Assumption("controlled quantity", controlled, (), flag=f"--control {controlled}", is_stated=True)
    elif control is not None and control.equal_samples:
        # The modulus at the held load, or that of the loading alone: the ratio is not known before a fit.
        yield Assumption("controlled quantity", "the force is held, and its column holds the set value",
                         (EQUAL_LOAD.format(control.equal_samples),), (),
                         (AlternativeValue("the load cell is saturated", None, "--control displacement"),),
                         "--control force")
    elif control is not None and control.quantity is not None:
        evidence = {"creep": "the force is constant while the displacement creeps",
                    "staircase": "the displacement is constant in several holds under load",
                    "ramp and hold": "the displacement is constant in a hold under load"}.get(
            control.pattern, f"the {control.quantity} is a line in time, the other channel is not")
        yield Assumption("controlled quantity", f"{control.quantity} ({control.pattern})", (evidence,))
    elif control is not None and control.pattern == "oscillation":
        yield Assumption("controlled quantity", "oscillation", (
            f"{control.frequency:.3g} Hz" + ("" if control.loss_factor is None else
                                             f", loss factor {control.loss_factor:.2f}"),))
