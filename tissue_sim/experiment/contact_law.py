"""Interfaces between a face and the tissue: friction, and additional contact laws such as adhesion.

A law is a frozen dataclass that derives from `ContactLaw` and declares its parameters with
`tissue_sim.parameters.parameter`. `CONTACT_LAWS` contains the classes by name; an `Experiment` contains the laws.
Impenetrability and Coulomb friction are constraints of the solvers and not laws of this kind.

The module does not import numpy, so that ``--help`` stays fast.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from numbers import Real
from typing import Any, ClassVar, NamedTuple

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.parameters import make_parameter_dataclass_predicate
from tissue_sim.registry import Registry

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


class Traction(NamedTuple):
    """Traction of a law at a point of the tissue.

    Attributes:
        pull: normal traction that attracts the tissue to the tool, Pa.
        drag: tangential traction against the slip, along two directions of the surface, Pa; positive against a
            positive slip.
        pull_rate: derivative of the pull with respect to the gap, Pa/m.
        drag_rates: derivative of the drag with respect to the slip, 2 x 2 and symmetric, Pa/m. Both derivatives only
            enter Newton's tangent; 0 is allowed, for instance where the pull decreases so fast that the tissue jumps.
    """

    pull: Any = 0.0
    drag: tuple[Any, Any] = (0.0, 0.0)
    pull_rate: Any = 0.0
    drag_rates: tuple[tuple[Any, Any], tuple[Any, Any]] = ((0.0, 0.0), (0.0, 0.0))


class ContactLaw(ABC):
    """Traction between the tool and tissue that has touched it, in addition to contact and friction.

    Attributes:
        name: key in files.
        title: name in reports.
    """

    name: ClassVar[str]
    title: ClassVar[str] = ""

    @property
    def acts(self) -> bool:
        """Whether the law has an effect with its parameters."""
        return True

    @property
    @abstractmethod
    def reach(self) -> float:
        """Gap from which on the law has no effect, m; tissue farther away must touch the tool again."""

    @abstractmethod
    def traction(self, gap: Any, pressure: Any, slip: tuple[Any, Any], face: Any) -> Traction:
        """Compute the traction at a point that has touched the tool.

        The formula is compiled into kernels, like `tissue_sim.material.effect.PointEffect.response`: plain Python and
        numpy's elementary functions, without a branch on a number.

        Args:
            gap: distance between the surfaces, m; below 0 they overlap within the tolerance of the contact.
            pressure: contact pressure, Pa, 0 where the surfaces are apart.
            slip: displacement of the tissue along the tool since it touched, or with friction since it last stuck, m,
                in two directions of the surface; an axisymmetric solid uses the first.
            face: area of the tool's face at the largest depth, m2.
        """


def evaluate_traction(law: ContactLaw, gap: Any, pressure: Any, slip: tuple[Any, Any], face: Any) -> Traction:
    """Compute the traction of a law; arguments as in `ContactLaw.traction`.

    Raises:
        InputError: the law does not return a `Traction`.
    """
    found = law.traction(gap, pressure, slip, face)
    if not isinstance(found, Traction):
        raise InputError(f"traction() must return a tissue_sim.Traction; got {type(found).__name__}.",
                         field=f"contact_laws.{law.name}")
    return found


def sum_attractive_tractions_at_zero_gap(laws: tuple[ContactLaw, ...], face: float) -> float:
    """Sum of the pulls of all laws at zero gap, pressure and slip, Pa; `face` is the area of the tool's face, m2.

    Raises:
        InputError: a law does not return a `Traction`.
    """
    return float(sum(evaluate_traction(law, 0.0, 0.0, (0.0, 0.0), face).pull for law in laws))


#: Name -> class of a contact law.
CONTACT_LAWS: Registry[type[ContactLaw]] = Registry(
    "law of a contact", "tissue_sim.contact_laws", {"adhesion": "tissue_sim.experiment.adhesion:Adhesion"},
    accepts=make_parameter_dataclass_predicate(ContactLaw),
    expected="a frozen dataclass that derives from tissue_sim.ContactLaw and declares its parameters")
