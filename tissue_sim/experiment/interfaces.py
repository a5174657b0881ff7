"""Interfaces between a face and the tissue. The module does not import numpy, so that ``--help`` stays fast."""

from __future__ import annotations

from numbers import Real

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words

#: Named interfaces: ``"bonded"`` (no relative motion), ``"stick"`` (no slip, but lift-off is possible), and
#: ``"frictionless"``. A number is Coulomb's coefficient of friction. All but the bonded one permit lift-off from the
#: tool; the specimen does not lift off from the base.
INTERFACES = ("bonded", "stick", "frictionless")
#: Interface of the base: the same as that of the tool's face.
AS_TOOL = "as_tool"
#: Largest accepted coefficient of friction; a larger one is probably a mistake.
LARGEST_FRICTION = 10.0


def validate_and_normalise_interface(value: str | float, name: str) -> str | float:
    """Check an interface and return it; a coefficient of friction of 0 becomes ``"frictionless"``.

    Args:
        value: name of `INTERFACES`, `AS_TOOL` (base only), or a coefficient of friction.
        name: field of the experiment.

    Raises:
        InputError: another value.
    """
    if isinstance(value, str):
        if value not in INTERFACES and not (value == AS_TOOL and name == "friction_base"):
            raise InputError(
                f"{value!r} is not an interface{make_hint_with_similar_or_known_words(value, INTERFACES)}, or a "
                "coefficient of friction", field=name)
        return value
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not (number and 0 <= value <= LARGEST_FRICTION):
        raise InputError(f"{value} is not a coefficient of friction; give 0 to {LARGEST_FRICTION:g}, or 'stick' for a "
                         "face without slip", field=name)
    return float(value) or "frictionless"
