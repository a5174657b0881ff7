"""Effects of the tissue that can be added: a file each, by name in material files, campaigns and reports.

An effect is a frozen dataclass that derives from one of the classes here and declares its numbers with
`tissue_sim.parameters.parameter`. `EFFECTS` knows the classes by name; a `Material` carries the effects themselves.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import Field, dataclass
from math import inf, prod
from typing import Any, ClassVar

import numpy as np

from tissue_sim.parameters import declaring
from tissue_sim.registry import Registry


class TissueEffect(ABC):
    """What time, loading or place do to a tissue.

    Attributes:
        name: key in material files.
        title: for people.
        ages: whether the force depends on time because of it.
        remembers: whether it depends on how the tool came to where it is.
    """

    name: ClassVar[str]
    title: ClassVar[str] = ""
    ages: ClassVar[bool] = False
    remembers: ClassVar[bool] = False
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


@dataclass(frozen=True, slots=True)
class ToolHistory:
    """Where the tool has been.

    Attributes:
        depth: now, m.
        deepest: so far, this place included, m.
        time: in the tissue, s.
    """

    depth: float
    deepest: float
    time: float = 0.0


class ReducedEffect(TissueEffect):
    """An effect in reduced form: it scales the force of the tool, and leaves the fields as they are.

    Attributes:
        under_plates: whether it acts under plates, too, and not under needles only.
    """

    under_plates: ClassVar[bool] = True

    @abstractmethod
    def share(self, history: ToolHistory) -> float:
        """Force of the tool over what it would be without the effect; 1 where the parameters are absent."""

    def shares(self, depth: np.ndarray, deepest: np.ndarray, time: np.ndarray) -> np.ndarray:
        """`share` at many places, those of a `ToolHistory`, all of one shape; an effect may have it faster."""
        places = zip(depth.ravel().tolist(), deepest.ravel().tolist(), time.ravel().tolist(), strict=True)
        return np.array([self.share(ToolHistory(*place)) for place in places]).reshape(depth.shape)


class PointEffect(TissueEffect):
    """An effect with a stress of its own at every point of the tissue, and a memory there.

    The same formula serves elements of every kind, so it is written in three dimensions, in plain Python and numpy's
    elementary functions (exp, log, sqrt, tanh, sin, cos, tan, abs, maximum, minimum, where): the kernels take it over
    operation by operation when they are compiled. It may loop, index and call as it likes, but must not branch on a
    number; fields that are no declared parameters are constants of the formula.

    Attributes:
        rest: state variables of tissue that nothing has happened to; as many as there are.
    """

    rest: ClassVar[tuple[float, ...]] = ()
    remembers: ClassVar[bool] = True

    @abstractmethod
    def response(self, C: list, state: list, dt: Any) -> tuple[list, list[list], list]:
        """Stress at the end of a step.

        Symmetric tensors are lists of six, 11, 22, 33, 12, 13, 23; in an axisymmetric solid 1 is the radius, 2 the
        axis and 3 the circumference.

        Args:
            C: right Cauchy-Green tensor at the end of the step.
            state: state variables at its start.
            dt: its length, s; 0: sudden.

        Returns:
            The second Piola-Kirchhoff stress, Pa, which is added to that of the law, in layers times their ratio; its
            tangent, six rows of six, dS with the Green strain whose shears are doubled (S_12 with 2 E_12), Pa, which
            must be symmetric; and the state variables at the end of the step.
        """


class ReducedForce:
    """What effects in reduced form leave of the force on a tool, along its way.

    Args:
        effects: those that act.

    Attributes:
        history: of the tool at the last place that was final.
    """

    def __init__(self, effects: Sequence[ReducedEffect]):
        self._effects = tuple(effects)
        self.history = ToolHistory(-inf, -inf)

    def share(self, depth: float, dt: float = 0.0) -> float:
        """Of the force (or its derivative) at a depth, m, that is tried dt s later."""
        here = self._at(depth, dt)
        return prod((effect.share(here) for effect in self._effects), start=1.0)

    def go(self, depth: float, dt: float = 0.0) -> float:
        """The same at a depth that is final."""
        share, self.history = self.share(depth, dt), self._at(depth, dt)
        return share

    def _at(self, depth: float, dt: float) -> ToolHistory:
        return ToolHistory(depth, max(self.history.deepest, depth), self.history.time + dt)


#: Name -> class.
EFFECTS: Registry[type[TissueEffect]] = Registry(
    "effect of the tissue", "tissue_sim.effects",
    {"stiffness_scale": "tissue_sim.material.stiffness_scale:StiffnessScale"}, accepts=declaring(TissueEffect),
    expected="a frozen dataclass that derives from tissue_sim.TissueEffect and declares its parameters")
