"""One random model through its test: outcome, cost, and check of its equilibria."""

from __future__ import annotations

import signal
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict

import numpy as np

import tissue_sim as ts
from benchmarks.random_models.equilibrium_check import EquilibriumCheck
from benchmarks.random_models.generator import Description, build

#: CPU that a test may take, s; without the check.
LIMIT = 90.0
#: How many times as many samples the finer test has.
FINER = 4
ENDS = ("end", "stopped", "refused", "exception", "time-out")
_SHAPES = {"plate": "plates", "flat": "flat needle", "round": "round needle"}


class OutOfTimeError(Exception):
    """The CPU time limit is exceeded."""


class Clock:
    """CPU time of this process while the clock is on; more than `LIMIT` seconds raise `OutOfTimeError`.

    Attributes:
        spent: so far, s.
    """

    def __init__(self):
        self.spent = 0.0

    def _ring(self, number, frame) -> None:
        raise OutOfTimeError

    @contextmanager
    def on(self) -> Iterator[None]:
        before, began = signal.signal(signal.SIGPROF, self._ring), time.process_time()
        signal.setitimer(signal.ITIMER_PROF, LIMIT)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            signal.signal(signal.SIGPROF, before)
            self.spent += time.process_time() - began

    @contextmanager
    def off(self) -> Iterator[None]:
        left, began = signal.setitimer(signal.ITIMER_PROF, 0.0)[0], time.process_time()
        yield
        self.spent -= time.process_time() - began
        signal.setitimer(signal.ITIMER_PROF, max(left, 1e-3))


class _Watch:
    """Equilibrium check whose time does not count; a failure of the check itself ends the run."""

    def __init__(self, check: EquilibriumCheck, clock: Clock, seed: int):
        self._check, self._clock, self._seed = check, clock, seed

    def before_first_step(self, solver) -> None:
        with self._clock.off():
            self._do(self._check.before_first_step, solver)

    def after_sample(self, solver, factor: float) -> None:
        with self._clock.off():
            self._do(self._check.after_sample, solver, factor)

    def _do(self, work, *arguments) -> None:
        try:
            work(*arguments)
        except Exception as error:
            raise SystemExit(f"seed {self._seed}: the check itself failed: {error!r}") from error


def stratum(one: Description) -> str:
    """Return tool and face as a class of models."""
    return f"{_SHAPES.get(one.shape, one.shape)}, {one.face}"


def warm_up() -> None:
    """Compile the kernels of these laws, with and without slip, with the clock off."""
    for law, parameters in (("neo_hooke", {"C10": 500.0}), ("ogden_1", {"mu1": 1e3, "alpha1": 3.0})):
        for friction in ("frictionless", 0.3):
            experiment = ts.Experiment(ts.Specimen(0.02, 0.02), ts.Protocol.ramp(1e-4, 2), tool=ts.Tool("round", 2e-3),
                                       friction=friction)
            ts.simulate(ts.Model(experiment, ts.Material(law, parameters, ts.Bulk("bulk_ratio", 100.0))))


def run(one: Description, resolution: str, finer: int = 1, *, check: bool = True) -> dict:
    """A test, as plain values: status (of `ENDS`), message, samples and of how many, CPU seconds, force (N) and time
    (s), newton_iterations, cuts, and with the check warnings and force_error; of the check worst and faults (see
    `equilibrium_check`), failed_samples, and early."""
    clock, status, message, recording, samples, found = Clock(), "end", "", None, 0, None
    try:
        with clock.on():
            model = build(one, finer)
            samples = model.experiment.protocol.time.size
            found = EquilibriumCheck(model) if check else None
            recording = ts.simulate(model, resolution=resolution,
                                    watch=None if found is None else _Watch(found, clock, one.seed),
                                    estimate_error=check)
    except ts.ConvergenceError as error:
        status, message, recording = "stopped", str(error), error.recording
    except ts.InputError as error:
        status, message = "refused", str(error)
    except OutOfTimeError:
        status, message = "time-out", f"not at the end after {LIMIT:g} s of CPU"
    except Exception as error:
        status, message = "exception", "".join(traceback.format_exception_only(error)).strip()
    entry = {"status": status, "message": message, "of": samples, "samples": 0, "cpu_s": clock.spent, "force": [],
             "time": [], "newton_iterations": 0, "cuts": 0, "warnings": [], "force_error": None, "worst": {},
             "faults": [], "failed_samples": 0, "early": 0.0}
    if recording is not None:
        solved = recording.metadata["solver"]
        entry |= {"samples": int(recording.force.size), "force": recording.force.tolist(),
                  "time": recording.time.tolist()}
        entry |= {name: solved[name] for name in ("newton_iterations", "cuts", "warnings", "force_error")}
        if not np.isfinite(recording.force).all():
            entry |= {"status": "exception", "message": "a force is not a number"}
    if found is not None:
        # Of a test that ended without a recording what was seen until then.
        findings = found.found if recording is None else found.finish(recording)
        entry |= {"worst": findings.worst, "faults": [asdict(fault) for fault in findings.faults.values()],
                  "failed_samples": len(findings.failed), "early": findings.early}
    return entry


def run_quarter(one: Description, resolution: str, coarse: dict) -> dict:
    """The test with `FINER` times as many samples: status, message, cpu_s, and where both reached the end
    `difference`, the largest of common samples over the largest force."""
    fine = run(one, resolution, FINER, check=False)
    answer = {name: fine[name] for name in ("status", "message", "cpu_s")}
    if coarse["status"] == fine["status"] == "end":
        force, when = np.array(fine["force"]), np.array(fine["time"])
        same = np.abs(when[:, None] - np.array(coarse["time"])).argmin(axis=0)
        # The steps of a hold are others.
        common = np.abs(when[same] - coarse["time"]) <= 1e-9 * max(when[-1], 1e-300)
        apart = np.abs(force[same] - coarse["force"])[common]
        answer["difference"] = float(apart.max() / max(np.abs(force).max(), 1e-300))
    return answer
