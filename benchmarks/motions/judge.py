"""Play a motion on a simulator and judge every answer against the true force."""

from __future__ import annotations

import copy
import pickle
import signal
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from typing import Any

import numpy as np

import tissue_sim as ts
from benchmarks.motions.course import (
    ForeignState,
    Fork,
    Handover,
    Inspect,
    Motion,
    Move,
    OtherSimulator,
    RefusedParameters,
    Reset,
    Restore,
    Save,
    Scale,
    paths,
)
from benchmarks.motions.scenes import Scene, scaled_parameters, simulator, tissue_of
from benchmarks.motions.truth import NOTHING, Truth, truths

#: Largest error of a force that is right, over the peak force of the motion.
FORCE_TOLERANCE = 0.03
#: Largest relative error of a stiffness that is right.
STIFFNESS_TOLERANCE = 0.05
#: Stiffnesses are compared where the force exceeds this fraction of the peak.
LEAST_FORCE_OF_STIFFNESS = 0.2
#: Least peak force, over the force of a press to the scene's depth.
LEAST_PEAK = 0.1
#: Most that the force of a STOPPED step may be, over that of a press to the pose of its last equilibrium.
STOPPED_BOUND = 2.0
#: CPU time of a step after which it counts as one that does not end, s.
STEP_LIMIT = 5.0
#: CPU time after which the truth of a path is given up, s.
TRUTH_LIMIT = 60.0
#: Wrong answers of a motion that are described.
DESCRIBED = 3


class EndlessStepError(Exception):
    """A step took more than `STEP_LIMIT`."""


class Verdict(Enum):
    """Verdict on one answer."""

    RIGHT = "right"
    REFUSED = "refused rightly"
    LATE_OFF = "not converged, force off"
    LATE_NEAR = "not converged, force within tolerance"
    WRONG = "silently wrong"
    DECLARED = "wrong, but within the error that the answer states"
    FAULT = "fault"
    UNKNOWN = "no truth"


@dataclass
class Judgement:
    """Verdicts on the answers of one motion.

    Attributes:
        counts: ticks by verdict.
        notes: the first wrong answers and faults in words.
        largest_error: of CONVERGED forces, over the peak.
        seconds: CPU time.
    """

    counts: Counter[Verdict] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    largest_error: float = 0.0
    seconds: float = 0.0

    def note(self, verdict: Verdict, text: str) -> None:
        """Count a verdict; describe the first ones."""
        self.counts[verdict] += 1
        if self.counts[verdict] <= DESCRIBED:
            self.notes.append(f"{verdict.value}: {text}")

    @property
    def outcome(self) -> str:
        """The motion's worst verdict."""
        for verdict in (Verdict.WRONG, Verdict.FAULT, Verdict.DECLARED):
            if self.counts[verdict]:
                return verdict.value
        late = self.counts[Verdict.LATE_OFF] + self.counts[Verdict.LATE_NEAR]
        return "not converged" if late else "right"

    @property
    def answered(self) -> tuple[int, int]:
        """Valid ticks with a CONVERGED answer, and all valid ticks."""
        answered = sum(self.counts[each] for each in (Verdict.RIGHT, Verdict.WRONG, Verdict.DECLARED))
        return answered, answered + self.counts[Verdict.LATE_OFF] + self.counts[Verdict.LATE_NEAR]


@cache
def nominal_force(scene: Scene) -> float:
    """Return the magnitude of the force of a slow press to the depth of the scene, N."""
    still = Scene(**{**scene.__dict__, "inertia": "off", "max_solves": None, "prony": (),
                     "solver": "solid" if scene.solver == "multirate" else scene.solver})
    return float(np.linalg.norm(simulator(still, bounded=False).step(ts.Pose.at_depth(scene.depth), 1e-3).force_vector))


def judged(motion: Motion) -> Judgement:
    """Play a motion and judge all of its answers."""
    began = time.process_time()
    judgement = Judgement()
    answers = _Player(motion, judgement).play()
    known: dict[int, Truth] = {}
    for path in paths(motion.operations):
        signal.setitimer(signal.ITIMER_PROF, TRUTH_LIMIT)
        try:
            known |= truths(motion.scene, path)
        except EndlessStepError:
            judgement.counts[Verdict.UNKNOWN] += len(path)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
    for index, operation in enumerate(motion.operations):
        if isinstance(operation, Move) and operation.like in known:
            known[index] = known[operation.like]
    peak = max([np.linalg.norm(truth.force) for truth in known.values()] + [LEAST_PEAK * nominal_force(motion.scene)])
    for index, answer in answers.items():
        operation = motion.operations[index]
        assert isinstance(operation, Move)
        if operation.truth is None:
            _judge_refusal(judgement, index, operation, answer)
            continue
        if operation.is_unknown:
            _judge_bound(judgement, motion, index, answer)
        elif index in known:
            _judge(judgement, motion, index, answer, known[index], float(peak))
    judgement.seconds = time.process_time() - began
    return judgement


def _judge_refusal(judgement: Judgement, index: int, move: Move, answer: Any) -> None:
    """Judge the answer to an input that must be refused."""
    if isinstance(answer, ts.InputError) or (isinstance(answer, ts.ToolForce)
                                             and answer.status is ts.ForceStatus.REFUSED):
        judgement.counts[Verdict.REFUSED] += 1
    elif isinstance(answer, Exception):
        judgement.note(Verdict.FAULT, f"{index}: {type(answer).__name__}: {str(answer)[:120]}")
    elif answer.status is ts.ForceStatus.CONVERGED:
        judgement.note(Verdict.WRONG, f"{index}: an input that must be refused is CONVERGED, {answer.force:.4g} N")
    else:
        judgement.note(Verdict.FAULT, f"{index}: an input that must be refused is {answer.status.name}")


def _judge(judgement: Judgement, motion: Motion, index: int, answer: Any, truth: Truth, peak: float) -> None:
    """Judge the answer to a valid input."""
    move = motion.operations[index]
    assert isinstance(move, Move)
    if isinstance(answer, Exception):
        if isinstance(answer, ts.InputError) and move.may_refuse:
            judgement.counts[Verdict.REFUSED] += 1
        else:
            judgement.note(Verdict.FAULT, f"{index}: {type(answer).__name__}: {str(answer)[:120]}")
        return
    error = _error(motion.scene, answer, truth) / peak
    described = (f"{index}: {answer.status.name} F {_mN(answer.force_vector)} mN, right {_mN(truth.force)} mN, "
                 f"off by {100 * error:.1f} % of the peak, stated error {answer.force_error}")
    if answer.status is not ts.ForceStatus.CONVERGED:
        if move.may_refuse:
            judgement.counts[Verdict.REFUSED] += 1
        elif not np.isfinite(error):
            judgement.note(Verdict.FAULT, described)
        elif answer.status is ts.ForceStatus.STOPPED and _is_unbounded(motion.scene, answer):
            _judge_bound(judgement, motion, index, answer)
        else:
            judgement.counts[Verdict.LATE_OFF if error > FORCE_TOLERANCE else Verdict.LATE_NEAR] += 1
        return
    if move.off_axis and not answer.is_on_axis:
        judgement.counts[Verdict.RIGHT] += 1
        return
    if move.off_axis and np.linalg.norm(truth.force) > FORCE_TOLERANCE * peak:
        judgement.note(Verdict.WRONG, f"{index}: a pose off the axis is CONVERGED and not marked, "
                       f"{answer.force:.4g} N")
        return
    if not truth.is_known:
        judgement.counts[Verdict.UNKNOWN] += 1
        return
    judgement.largest_error = max(judgement.largest_error, error)
    if not error <= FORCE_TOLERANCE:
        is_stated = answer.force_error is not None and error * peak <= answer.force_error
        judgement.note(Verdict.DECLARED if is_stated else Verdict.WRONG, described)
    elif motion.checks_stiffness and _is_stiffness_wrong(answer, truth, peak):
        judgement.note(Verdict.WRONG, f"{index}: stiffness {answer.stiffness:.4g} N/m, right {truth.stiffness:.4g}, "
                       f"age {answer.stiffness_age:g} s, force off by {100 * error:.2f} %")
    elif not move.off_axis and not answer.is_on_axis:
        judgement.note(Verdict.FAULT, f"{index}: a pose on the axis is marked as off the axis")
    else:
        judgement.counts[Verdict.RIGHT] += 1


def _is_unbounded(scene: Scene, answer: ts.ToolForce) -> bool:
    """Return whether a force exceeds that of an equilibrium at the same pose."""
    force = float(np.linalg.norm(answer.force_vector))
    if force <= STOPPED_BOUND * nominal_force(scene):
        return False
    there = simulator(scene, bounded=False).step(answer.pose, 0.0)
    return not force <= STOPPED_BOUND * float(np.linalg.norm(there.force_vector))


def _judge_bound(judgement: Judgement, motion: Motion, index: int, answer: Any) -> None:
    """Judge an answer without a known truth: the force of a STOPPED step must be bounded."""
    if isinstance(answer, EndlessStepError):  # nothing bounds a step without max_solves or budget
        judgement.counts[Verdict.UNKNOWN] += 1
    elif isinstance(answer, Exception):
        verdict = Verdict.REFUSED if isinstance(answer, ts.InputError) else Verdict.FAULT
        judgement.note(verdict, f"{index}: {type(answer).__name__}: {str(answer)[:120]}")
    elif answer.status is ts.ForceStatus.STOPPED and _is_unbounded(motion.scene, answer):
        judgement.note(Verdict.FAULT, f"{index}: STOPPED with {_mN(answer.force_vector)} mN, last equilibrium at "
                       f"{answer.pose}")
    else:
        judgement.counts[Verdict.REFUSED] += answer.status is not ts.ForceStatus.CONVERGED


def _mN(force: Any) -> list[float]:
    return [round(1e3 * float(part), 2) for part in force]


def _error(scene: Scene, answer: ts.ToolForce, truth: Truth) -> float:
    """Return the magnitude of the force error, N; for a bonded tool in space also torque error over radius."""
    error = float(np.linalg.norm(np.array(answer.force_vector) - truth.force))
    if scene.is_bonded and scene.solver != "axisymmetric":
        torque = float(np.linalg.norm(np.array(answer.torque_vector) - truth.torque))
        return float(np.nanmax([error, torque / scene.radius])) if np.isfinite(error) else error
    return error


def _is_stiffness_wrong(answer: ts.ToolForce, truth: Truth, peak: float) -> bool:
    if truth is NOTHING or truth.stiffness is None or answer.stiffness_age > 0.0:
        return False
    if np.linalg.norm(truth.force) < LEAST_FORCE_OF_STIFFNESS * peak:
        return False
    return abs(answer.stiffness - truth.stiffness) > STIFFNESS_TOLERANCE * abs(truth.stiffness)


class _Player:
    """Carries out the operations of a motion on a simulator and, after a `Fork`, on its copy."""

    def __init__(self, motion: Motion, judgement: Judgement):
        self._motion, self._judgement = motion, judgement
        self._tissues: list[Any] = [tissue_of(motion.scene), None]
        self._saved: Any = None
        self._thread: ThreadPoolExecutor | None = None

    def play(self) -> dict[int, Any]:
        """Return answers or exceptions, by the index of their move."""
        answers: dict[int, Any] = {}
        signal.signal(signal.SIGPROF, _interrupt)
        for index, operation in enumerate(self._motion.operations):
            if isinstance(operation, Move):
                if (tissue := self._tissues[operation.copy]) is not None:
                    answers[index] = self._step(tissue, operation)
                    if isinstance(answers[index], EndlessStepError):
                        break
                continue
            try:
                self._do(operation)
            except Exception as error:
                self._judge_exception(index, operation, error)
            else:
                if isinstance(operation, ForeignState | RefusedParameters):
                    self._judgement.note(Verdict.FAULT, f"{index}: {type(operation).__name__} was taken")
        if self._thread is not None:
            self._thread.shutdown()
        return answers

    def _step(self, tissue: Any, move: Move) -> Any:
        signal.setitimer(signal.ITIMER_PROF, STEP_LIMIT)
        try:
            pose = move.pose() if callable(move.pose) else move.pose
            if self._thread is not None:
                return self._thread.submit(tissue.step, pose, move.dt).result()
            return tissue.step(pose, move.dt)
        except Exception as error:
            return error
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)

    def _do(self, operation: Any) -> None:
        scene, tissue = self._motion.scene, self._tissues[0]
        match operation:
            case Reset():
                tissue.reset()
            case Save():
                self._saved = tissue.save()
            case Restore(elsewhere=elsewhere):
                if elsewhere:
                    self._tissues[0] = tissue_of(scene)
                self._tissues[0].restore(self._saved)
            case Fork(how=how):
                self._tissues[1] = _copied(tissue, how)
            case Scale(factor=factor):
                tissue.set_parameters(**scaled_parameters(scene, factor))
            case RefusedParameters(values=values):
                tissue.set_parameters(**dict(values))
            case ForeignState(scene=other, depth=depth):
                donor = simulator(other)
                donor.step(depth, 1e-3)
                tissue.restore(donor.save())
            case Inspect():
                if hasattr(tissue, "surface"):
                    tissue.surface()
                tissue.snapshot()
            case OtherSimulator(scene=other, depths=depths):
                stranger = simulator(other)
                for depth in depths:
                    stranger.step(depth, 1e-3)
            case Handover():
                self._thread = ThreadPoolExecutor(1)

    def _judge_exception(self, index: int, operation: Any, error: Exception) -> None:
        """Judge an operation that raised an exception: a refusal with a message is right where it is allowed."""
        text = f"{index}: {type(operation).__name__}: {type(error).__name__}: {str(error)[:120]}"
        if isinstance(operation, Fork) and isinstance(error, AttributeError) and operation.how == "clone":
            self._judgement.notes.append("no clone()")
        elif (isinstance(error, ts.InputError) if isinstance(operation, ForeignState | RefusedParameters) else
              isinstance(operation, Fork) and _is_refusal(self._motion.scene, operation, error)):
            self._judgement.counts[Verdict.REFUSED] += 1
        else:
            self._judgement.note(Verdict.FAULT, text)


def _interrupt(number: int, frame: Any) -> None:
    raise EndlessStepError(f"more than {STEP_LIMIT:g} s of CPU time")


def _is_refusal(scene: Scene, operation: Fork, error: Exception) -> bool:
    """Return whether an exception refuses a copy with a message; the message of a simulator must name `save`."""
    if scene.solver == "multirate":
        refusal = "cannot be cloned" if operation.how == "clone" else "cannot be copied"
        return isinstance(error, ts.InputError | TypeError) and refusal in str(error)
    return operation.how != "clone" and "save()" in str(error)


def _copied(tissue: Any, how: str) -> Any:
    match how:
        case "deepcopy":
            return copy.deepcopy(tissue)
        case "copy":
            return copy.copy(tissue)
        case "pickle":
            return pickle.loads(pickle.dumps(tissue))
    return tissue.clone()
