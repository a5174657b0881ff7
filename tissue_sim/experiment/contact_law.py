"""Additional contact laws between tool and tissue, such as adhesion: contract, and registry by name.

A law is a frozen dataclass that derives from `ContactLaw` and declares its parameters with
`tissue_sim.parameters.parameter`. `CONTACT_LAWS` contains the classes by name; an `Experiment` contains the laws.
Impenetrability and Coulomb friction are constraints of the solvers and not laws of this kind.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

from tissue_sim.errors import InputError
from tissue_sim.parameters import make_parameter_dataclass_predicate
from tissue_sim.registry import Registry


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
