"""Effects of time, loading history and depth on the tissue: base classes, and registry by name.

An effect is a frozen dataclass that derives from one of the classes here and declares its parameters with
`tissue_sim.parameters.parameter`. `EFFECTS` contains the classes by name; a `Material` contains the effects. The names
are used in material files, campaigns and reports.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import Field, dataclass
from math import inf, prod
from typing import Any, ClassVar

import numpy as np

from tissue_sim.parameters import make_parameter_dataclass_predicate
from tissue_sim.public_names import make_getattr_for_old_names, rename_old_members_of_subclass, with_old_names
from tissue_sim.registry import Registry

__getattr__ = make_getattr_for_old_names(__name__, {"ReducedEffect": "ForceScalingEffect",
                                                    "ReducedForceFactor": "CombinedForceFactor"})


#: Old names of members that plug-ins define -> new names.
_OLD_MEMBERS = {"ages": "is_time_dependent", "remembers": "is_history_dependent"}
#: The same for effects that scale the force.
_OLD_MEMBERS_OF_SCALING = {"share": "compute_force_factor", "shares": "compute_force_factors"}


@with_old_names(**_OLD_MEMBERS)
class TissueEffect(ABC):
    """Effect of time, loading history or position on a tissue.

    Attributes:
        name: key in material files.
        title: name in reports.
        is_time_dependent: whether the effect makes the force depend on time.
        is_history_dependent: whether the effect makes the force depend on the path of the tool.
    """

    name: ClassVar[str]
    title: ClassVar[str] = ""
    is_time_dependent: ClassVar[bool] = False
    is_history_dependent: ClassVar[bool] = False
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        rename_old_members_of_subclass(cls, _OLD_MEMBERS)


@dataclass(frozen=True, slots=True)
class ToolHistory:
    """Present depth of the tool, its largest depth so far, and the time.

    Attributes:
        depth: present depth, m.
        deepest: largest depth so far, the present one included, m.
        time: time since the start, s.
    """

    depth: float
    deepest: float
    time: float = 0.0


@with_old_names(**_OLD_MEMBERS_OF_SCALING)
class ForceScalingEffect(TissueEffect):
    """Effect in reduced form: a factor on the force of the tool; displacements and stresses are not changed.

    Attributes:
        under_plates: whether the effect acts under plates as well as under needles.
    """

    under_plates: ClassVar[bool] = True

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        rename_old_members_of_subclass(cls, _OLD_MEMBERS_OF_SCALING)

    @abstractmethod
    def compute_force_factor(self, history: ToolHistory) -> float:
        """Return the ratio of the tool's force with the effect to the force without it, 1.

        The ratio is 1 if the parameters have their absent values (`Declaration.absent`).
        """

    def compute_force_factors(self, depth: np.ndarray, deepest: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Evaluate `compute_force_factor` for arrays of histories; a subclass may override this with a faster version.

        Args:
            depth: `ToolHistory.depth` of each history.
            deepest: `ToolHistory.deepest` of each history.
            time: `ToolHistory.time` of each history.

        Returns:
            Ratios, with the shape of the arguments.
        """
        histories = zip(depth.ravel().tolist(), deepest.ravel().tolist(), time.ravel().tolist(), strict=True)
        return np.array([self.compute_force_factor(ToolHistory(*one)) for one in histories]).reshape(depth.shape)


class PointEffect(TissueEffect):
    """Effect with an additional stress and state variables at every point of the tissue.

    One formula serves elements of every type: three-dimensional tensors, plain Python and numpy's elementary functions
    (exp, log, sqrt, tanh, sin, cos, tan, abs, maximum, minimum, where). The kernels record its operations when they are
    compiled, so that it may use loops, indices and calls, but no branch on a number. Fields that are not declared
    parameters are constants of the formula.

    Attributes:
        rest: initial values of the state variables; their number is the number of state variables.
    """

    rest: ClassVar[tuple[float, ...]] = ()
    is_history_dependent: ClassVar[bool] = True

    @abstractmethod
    def response(self, C: list, state: list, dt: Any) -> tuple[list, list[list], list]:
        """Compute stress, tangent and state variables at the end of a step.

        Symmetric tensors are lists of six components 11, 22, 33, 12, 13, 23. In an axisymmetric solid 1 is the radial,
        2 the axial and 3 the circumferential direction.

        Args:
            C: right Cauchy-Green tensor at the end of the step.
            state: state variables at the start of the step.
            dt: length of the step, s; 0 for a sudden step.

        Returns:
            Second Piola-Kirchhoff stress, Pa, which is added to that of the law and multiplied by the modulus ratio in
            layers; its tangent dS/dE, six rows of six, Pa, symmetric, with doubled shears in E (S_12 with 2 E_12); and
            the state variables at the end of the step.
        """


class CombinedForceFactor:
    """Factor of all effects in reduced form on the force of a tool, and the tool's history.

    Args:
        effects: effects that act.

    Attributes:
        history: history of the tool up to the last committed position.
    """

    def __init__(self, effects: Sequence[ForceScalingEffect]):
        self._effects = tuple(effects)
        self.history = ToolHistory(-inf, -inf)

    def compute_force_factor_at_depth(self, depth: float, dt: float = 0.0) -> float:
        """Return the factor on the force of the tool at a trial depth, m, reached dt s after the last recorded depth.

        The factor is the product over all effects in reduced form. The history is not changed.
        """
        return self._multiply_factors_of_all_effects_at(self._make_history_at(depth, dt))

    def record_depth_and_get_force_factor(self, depth: float, dt: float = 0.0) -> float:
        """Record a depth, m, reached dt s after the last one, in `history`; return the factor on the force at it.

        The factor is the product over all effects in reduced form.
        """
        here = self._make_history_at(depth, dt)
        share, self.history = self._multiply_factors_of_all_effects_at(here), here
        return share

    def _multiply_factors_of_all_effects_at(self, here: ToolHistory) -> float:
        """Return the product of the factors of all effects at a point of the history of the tool."""
        return prod([effect.compute_force_factor(here) for effect in self._effects], start=1.0)

    def _make_history_at(self, depth: float, dt: float) -> ToolHistory:
        """Return a copy of the history that continues to a depth, m, dt s later; `history` is not changed."""
        return ToolHistory(depth, max(self.history.deepest, depth), self.history.time + dt)


#: Name -> class of an effect.
EFFECTS: Registry[type[TissueEffect]] = Registry(
    "effect of the tissue", "tissue_sim.effects",
    {"stiffness_scale": "tissue_sim.material.force_scaling:StiffnessScale"},
    accepts=make_parameter_dataclass_predicate(TissueEffect),
    expected="a frozen dataclass that derives from tissue_sim.TissueEffect and declares its parameters")
