"""Operations of a motion: moves of the tool, and calls of the simulator between two moves.

`paths` lists the true paths of the tool that the operations imply. A path holds each pose at which the tool really was
since the tissue was untouched; inputs that must be refused, and excursions that `Restore` undoes, are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from benchmarks.motions.scenes import Scene
from tissue_sim.pose import Pose

#: Index of a path tick whose answer is not compared.
NOT_COMPARED = -1


@dataclass(frozen=True)
class Move:
    """A step of the simulator.

    Attributes:
        pose, dt: arguments of `step`, valid or not. A callable is called for the pose, since `Pose` may refuse it.
        truth: pose at which the tool is, such that the scene can represent it; None: the input must be refused.
        off_axis: whether the axisymmetric scene cannot represent the pose, so that the answer must be marked.
        may_refuse: whether a refusal is right, too.
        is_unknown: whether no truth is known: any answer is right that is finite and bounded.
        like: index of the operation whose force is right here, too, as the tissue is as new; None: no such.
        copy: whether the move is of the copy that `Fork` made.
    """

    pose: Any
    dt: Any
    truth: Pose | None
    off_axis: bool = False
    may_refuse: bool = False
    is_unknown: bool = False
    like: int | None = None
    copy: bool = False


@dataclass(frozen=True)
class Reset:
    """`reset()`."""


@dataclass(frozen=True)
class Save:
    """`save()`."""


@dataclass(frozen=True)
class Restore:
    """`restore()` of the saved state.

    Attributes:
        elsewhere: whether a new simulator of the same model takes the state and the place of the old one.
    """

    elsewhere: bool = False


@dataclass(frozen=True)
class Fork:
    """Copy the simulator.

    Attributes:
        how: "deepcopy", "copy", "pickle" or "clone".
    """

    how: str


@dataclass(frozen=True)
class Scale:
    """`set_parameters` with all moduli times a factor.

    Attributes:
        factor: over the scene's own moduli.
    """

    factor: float


@dataclass(frozen=True)
class RefusedParameters:
    """`set_parameters` with values that must be refused.

    Attributes:
        values: name and value.
    """

    values: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class ForeignState:
    """`restore` of a state of another model, which must be refused.

    Attributes:
        scene: the other model; depth: of its tool when it was saved, m.
    """

    scene: Scene
    depth: float


@dataclass(frozen=True)
class Inspect:
    """`surface()` and `snapshot()`, which must not change the state."""


@dataclass(frozen=True)
class OtherSimulator:
    """Steps of another simulator in the same process, which must not change this one.

    Attributes:
        scene: of the other one; depths: of its tool, m.
    """

    scene: Scene
    depths: tuple[float, ...]


@dataclass(frozen=True)
class Handover:
    """All further steps are called in another thread, one at a time."""


Operation = (Move | Reset | Save | Restore | Fork | Scale | RefusedParameters | ForeignState | Inspect | OtherSimulator
             | Handover)


@dataclass(frozen=True)
class Motion:
    """A scene and the operations on its simulator.

    Attributes:
        trap: name of the fault that is provoked, or "clean".
        scene: what is simulated.
        operations: in their order.
        checks_stiffness: whether the stiffness of each answer is compared.
    """

    trap: str
    scene: Scene
    operations: tuple[Operation, ...]
    checks_stiffness: bool = False


@dataclass(frozen=True)
class PathTick:
    """A pose of the tool on a true path.

    Attributes:
        pose: of the tool; dt: time since the pose before, s.
        factor: of the moduli.
        index: of the operation whose answer is compared, or `NOT_COMPARED`.
    """

    pose: Pose
    dt: float
    factor: float
    index: int


def paths(operations: Sequence[Operation]) -> list[list[PathTick]]:
    """Return the true paths of the tool, each from untouched tissue."""
    done: list[list[PathTick]] = []
    current: list[list[PathTick]] = [[], []]
    saved: list[PathTick] = []
    factor = 1.0
    for index, operation in enumerate(operations):
        match operation:
            case Move(truth=Pose() as truth, dt=dt, copy=copy, is_unknown=False):
                current[copy].append(PathTick(truth, float(dt), factor, index))
            case Scale(factor=factor):
                pass
            case Reset():
                done.append(current[0])
                current[0] = []
            case Save():
                saved = _not_compared(current[0])
            case Restore():
                done.append(current[0])
                current[0] = list(saved)
            case Fork():
                current[1] = _not_compared(current[0])
    return [path for path in (*done, *current) if any(tick.index != NOT_COMPARED for tick in path)]


def _not_compared(path: Sequence[PathTick]) -> list[PathTick]:
    return [replace(tick, index=NOT_COMPARED) for tick in path]
