"""Interfaces: how a face holds the tissue. Nothing here needs numpy, so that help answers at once."""

from __future__ import annotations

from numbers import Real

from tissue_sim.errors import InputError, nearest

#: How a face holds the tissue: ``"bonded"`` (no motion against the face), ``"stick"`` (no slip, but it can lift off),
#: ``"frictionless"``, or a number: Coulomb's coefficient of friction. All but the bonded one can lift off; the base
#: keeps the specimen on itself.
INTERFACES = ("bonded", "stick", "frictionless")
#: A base that holds the tissue as the tool's face does, whatever that is.
AS_TOOL = "as_tool"
#: Above this a coefficient of friction is taken for a mistake.
LARGEST_FRICTION = 10.0


def checked_interface(value: str | float, name: str) -> str | float:
    """An interface of `INTERFACES` or a coefficient of friction above 0; 0 is frictionless; of the base also `AS_TOOL`.

    Raises:
        InputError: neither, with the field.
    """
    if isinstance(value, str):
        if value not in INTERFACES and not (value == AS_TOOL and name == "friction_base"):
            raise InputError(f"{value!r} is not an interface{nearest(value, INTERFACES)}, or a coefficient of friction",
                             field=name)
        return value
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not (number and 0 <= value <= LARGEST_FRICTION):
        raise InputError(f"{value} is not a coefficient of friction; give 0 to {LARGEST_FRICTION:g}, or 'stick' for a "
                         "face without slip", field=name)
    return float(value) or "frictionless"
