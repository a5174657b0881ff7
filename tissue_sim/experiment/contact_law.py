"""Laws of the contact between tool and tissue that can be added: a file each, by name.

A law is a frozen dataclass that derives from `ContactLaw` and declares its numbers with
`tissue_sim.parameters.parameter`. `CONTACT_LAWS` knows the classes by name; an `Experiment` carries the laws
themselves. That surfaces do not go through each other, and Coulomb's friction, are not laws of this kind: they are
constraints.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

from tissue_sim.errors import InputError
from tissue_sim.parameters import declaring
from tissue_sim.registry import Registry


class Traction(NamedTuple):
    """What a law answers at a point of the tissue.

    Attributes:
        pull: draws the tissue to the tool, Pa.
        drag: resists the slip, along two directions in the surface, Pa: a positive one acts against a positive slip.
        pull_rate: of the pull with the gap, Pa/m; drag_rates: of the drag with the slip, 2 x 2 and symmetric, Pa/m.
            They only help Newton's iteration: 0 where it does without, as where a pull falls so fast that the tissue
            jumps.
    """

    pull: Any = 0.0
    drag: tuple[Any, Any] = (0.0, 0.0)
    pull_rate: Any = 0.0
    drag_rates: tuple[tuple[Any, Any], tuple[Any, Any]] = ((0.0, 0.0), (0.0, 0.0))


class ContactLaw(ABC):
    """A traction between the tool and tissue that has touched it, beside contact and friction.

    Attributes:
        name: key in files.
        title: for people.
    """

    name: ClassVar[str]
    title: ClassVar[str] = ""

    @property
    def acts(self) -> bool:
        """Whether it does anything with these parameters."""
        return True

    @property
    @abstractmethod
    def reach(self) -> float:
        """Gap from which on it does nothing, m; tissue that is further away has to touch the tool anew."""

    @abstractmethod
    def traction(self, gap: Any, pressure: Any, slip: tuple[Any, Any], face: Any) -> Traction:
        """The traction at a point that has touched the tool.

        Like `tissue_sim.material.effect.PointEffect.response` it is taken over by the kernels: plain Python and numpy's
        elementary functions, without a branch on a number.

        Args:
            gap: between the surfaces, m; below 0 they overlap by what the contact's tolerance allows.
            pressure: of the contact, Pa, 0 where the surfaces are apart.
            slip: of the tissue along the tool from where it touched, m, in two directions of the surface, of which an
                axisymmetric solid uses the first; with friction, from where it last stuck.
            face: area of the tool's face at the largest depth, m2.
        """


def traction_of(law: ContactLaw, gap: Any, pressure: Any, slip: tuple[Any, Any], face: Any) -> Traction:
    """What a law answers; arguments as of `ContactLaw.traction`.

    Raises:
        InputError: no traction.
    """
    found = law.traction(gap, pressure, slip, face)
    if not isinstance(found, Traction):
        raise InputError("its traction is no tissue_sim.Traction; return one", field=f"contact_laws.{law.name}")
    return found


def strength(laws: tuple[ContactLaw, ...], face: float) -> float:
    """Pull of all laws where the surfaces touch without pressure, Pa; `face` is its area, m2.

    Raises:
        InputError: a law that answers no traction.
    """
    return float(sum(traction_of(law, 0.0, 0.0, (0.0, 0.0), face).pull for law in laws))


#: Name -> class.
CONTACT_LAWS: Registry[type[ContactLaw]] = Registry(
    "law of a contact", "tissue_sim.contact_laws", {"adhesion": "tissue_sim.experiment.adhesion:Adhesion"},
    accepts=declaring(ContactLaw),
    expected="a frozen dataclass that derives from tissue_sim.ContactLaw and declares its parameters")
